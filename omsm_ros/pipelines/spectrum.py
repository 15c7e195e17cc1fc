"""Compute spectra of scans and classify their lines: from bags to ``spectrum.json``."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros import __version__
from omsm_ros.core.adjustment.resolved_calibration import unit_calibration
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.ripple.accelerometer import (
    AccelerationLines,
    acceleration_lines,
    accelerations_of,
)
from omsm_ros.core.ripple.density import BandStopped, Density, band_stop, density
from omsm_ros.core.ripple.ripple_guard import NamedLine, analyse_scans, name_lines
from omsm_ros.core.ripple.scan_signal import (
    PATH,
    RADIUS,
    TIME,
    TURN,
    ScanSignal,
    sampling_over,
    scan_signal,
)
from omsm_ros.core.ripple.source_hypotheses import KINDS, UNDECIDED, StudiedScan
from omsm_ros.core.streams.blocks import AccelerationBlock, AxisBlock, FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.io import bags
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.correct import Admission, CorrectedScan
from omsm_ros.pipelines.progress import Progress, no_progress
from omsm_ros.pipelines.recording import Recording

SCHEMA = "omsm-spectrum/1"
NORMALISATION = (
    "densities are one-sided and per hertz (time) or per 1/m (path), Blackman-Harris window of "
    "mean square one: their sum times the spacing is the mean square; a line of amplitude a "
    "(half of peak to valley) has the power a²/2; significance is that of a normal variable with "
    "the probability that noise alone gives such a line anywhere in the spectrum"
)
# Twenty minutes at 1 kHz; more samples do not improve the lines.
MOST_SAMPLES = 1_250_000


@dataclass(frozen=True, kw_only=True)
class SpectrumOptions:
    """Options of a spectral analysis.

    calibration: None adds encoder and probe without a dynamic correction
    nominal: surface to subtract first;  stop: bands to remove from the heights [Hz]
    polarity: of the probe
    """

    calibration: Calibration | None = None
    admission: Admission = field(default_factory=Admission)
    nominal: Surface | None = None
    stop: tuple[tuple[float, float], ...] = ()
    polarity: int = 1


@dataclass(frozen=True, eq=False, kw_only=True)
class SpectrumOfScan:
    """Result of the spectral analysis of one scan.

    motion: density of the Z encoder's motion;  points: as corrected
    received: number of points before the cut to MOST_SAMPLES
    stopped: heights without the stopped bands, None without bands
    """

    studied: StudiedScan
    named: list[NamedLine]
    motion: Density
    points: SurfacePoints
    account: dict[str, Any]
    received: int
    stopped: BandStopped | None = None


@dataclass(frozen=True, eq=False)
class _Read:
    signal: ScanSignal
    acceleration_lines: AccelerationLines | None
    points: SurfacePoints
    motion: Density
    account: dict[str, Any]
    received: int


def spectra_of(
    paths: Sequence[AnyBag], options: SpectrumOptions, progress: Progress = no_progress
) -> list[SpectrumOfScan]:
    """Analyse all scans, and classify each spectral line.

    Raises BagError for a bag without samples, CalibrationError for a calibration of another
    machine, DataError for a scan that is too short.
    """
    names = _names(paths)
    read = [_read(path, name, options, progress) for path, name in zip(paths, names, strict=True)]
    studied = analyse_scans([(one.signal, one.acceleration_lines) for one in read])
    named = name_lines(studied)
    return [
        SpectrumOfScan(
            studied=scan,
            named=rows,
            motion=one.motion,
            points=one.points,
            account=one.account,
            received=one.received,
            stopped=_stopped(scan, options.stop) if options.stop else None,
        )
        for one, scan, rows in zip(read, studied, named, strict=True)
    ]


def _names(paths: Sequence[AnyBag]) -> list[str]:
    stems = [Path(str(path)).stem for path in paths]
    return [stem if stems.count(stem) == 1 else f"{stem} ({k + 1})" for k, stem in enumerate(stems)]


def _read(path: AnyBag, name: str, options: SpectrumOptions, progress: Progress) -> _Read:
    axes: list[AxisBlock] = []
    parts: list[SurfacePoints] = []
    how = CorrectionOptions(polarity=options.polarity, accept_other_rate=options.admission.override)
    with Recording(path, progress) as recording:
        calibration = options.calibration or unit_calibration(recording.sample_period())
        scan = CorrectedScan(recording, calibration, how, admission=options.admission)
        for block, points in scan.steps():
            if isinstance(block, AxisBlock):
                axes.append(block)
            if points is not None:
                parts.append(points)
        account, period = scan.account.as_dict(), scan.sample_period
        shaken = _acceleration_lines(recording)
    every = join_points(parts)
    points = every.part(slice(0, MOST_SAMPLES))
    height = points.height
    if options.nominal is not None:
        height = height - options.nominal.height(points.x, points.y)
    count = np.concatenate([np.arange(len(b)) + b.first_sample for b in axes])
    x, y, z, c = (np.concatenate([getattr(b, n) for b in axes]) for n in "xyzc")
    signal = scan_signal(name, period, (points.sample, height), (count, x, y, c))
    return _Read(
        signal=signal,
        acceleration_lines=shaken,
        points=points,
        motion=_motion_density(z, period),
        account=account,
        received=len(every),
    )


def _acceleration_lines(recording: Recording) -> AccelerationLines | None:
    if not recording.holds(bags.ACCELERATION_TOPIC):
        return None
    blocks = [block for _, block in recording.bag.records(bags.ACCELERATION_TOPIC)]
    return acceleration_lines(
        *accelerations_of([b for b in blocks if isinstance(b, AccelerationBlock)])
    )


def _motion_density(z: FloatArray, period: float) -> Density:
    known = z[np.isfinite(z)]
    return density(known - np.mean(known), period)


def _stopped(studied: StudiedScan, bands: Sequence[tuple[float, float]]) -> BandStopped:
    signal = studied.signal
    return band_stop(signal.sample, studied.formless.residual, signal.period, bands)


def without_bands(scan: SpectrumOfScan) -> SurfacePoints:
    """Return the points of ``scan`` with the stopped bands removed from their heights.

    Raises ConfigurationError if no band was stopped or the points are not those analysed.
    """
    if scan.stopped is None or len(scan.points) != len(scan.stopped.removed):
        raise ConfigurationError(
            f"{scan.studied.signal.name!r}: no band was stopped, or its trigger counter restarted; "
            "give --stop FROM TO and a scan in one piece"
        )
    return replace(scan.points, height=scan.points.height - scan.stopped.removed)


def summary_of(scans: Sequence[SpectrumOfScan], options: SpectrumOptions) -> dict[str, Any]:
    """Return the content of ``spectrum.json``, in SI units."""
    rows = [row for scan in scans for row in scan.named]
    calibration = options.calibration
    return {
        "schema": SCHEMA,
        "normalisation": NORMALISATION,
        "calibration": None if calibration is None else calibration.id,
        "counts": {kind: sum(row.kind == kind for row in rows) for kind in KINDS},
        "undecided": sum(row.kind == UNDECIDED for row in rows),
        "scans": [_scan_facts(scan, options) for scan in scans],
        "versions": {"omsm_ros": __version__},
    }


def _scan_facts(scan: SpectrumOfScan, options: SpectrumOptions) -> dict[str, Any]:
    studied, signal = scan.studied, scan.studied.signal
    turn, minutes = studied.coordinates.get(TURN), 60.0
    return {
        "name": signal.name,
        "samples": {"received": scan.received, "analysed": len(signal), "account": scan.account},
        "sample_rate": signal.rate,
        "duration": signal.duration,
        "turns": signal.turns,
        "spindle_speed_rpm": None if turn is None else turn.pace * minutes,
        "path_length": float(np.ptp(signal.path)),
        "sampling": [asdict(place) for place in sampling_over(signal)],
        "form": {
            "degree": studied.formless.degree,
            "rms_removed": studied.formless.removed,
            "rms_left": float(np.std(studied.formless.residual)),
        },
        "noise": {
            "rms": studied.spectrum.noise,
            "amplitude": float(np.median(studied.spectrum.amplitude_floor)),
        },
        "motion": _motion_facts(scan.motion, options.calibration),
        "accelerometer": _acceleration_facts(studied.acceleration_lines),
        "peaks": [_peak_facts(studied, row) for row in scan.named],
        "band_stop": _stop_facts(scan, options.stop),
    }


def _motion_facts(motion: Density, calibration: Calibration | None) -> dict[str, Any]:
    """Return rms of the motion in all, and of its content above the calibrated band [m]."""
    top = float(motion.frequency[-1])
    total = motion.power(0.0, top)
    if calibration is None:
        return {"rms": total**0.5, "valid_up_to": None, "outside_band_rms": None}
    beyond = motion.power(calibration.valid_up_to, top) if calibration.valid_up_to < top else 0.0
    return {
        "rms": total**0.5,
        "valid_up_to": calibration.valid_up_to,
        "outside_band_rms": beyond**0.5,
    }


def _acceleration_facts(found: AccelerationLines | None) -> dict[str, Any] | None:
    if found is None:
        return None
    lines = [asdict(line) | {"displacement": line.displacement} for line in found.lines]
    return {"highest": found.highest, "duration": found.duration, "lines": lines}


def _peak_facts(studied: StudiedScan, row: NamedLine) -> dict[str, Any]:
    line = row.line
    possible = line.possible
    place = studied.coordinates[line.coordinate]
    return {
        "kind": row.kind,
        "also": row.also or None,
        "frequency": possible.get(TIME),
        "frequency_uncertainty": line.frequency_uncertainty * place.pace,
        "wavelength_along_path": _over(possible.get(PATH)),
        "wavelength_along_radius": _over(possible.get(RADIUS)),
        "per_turn": possible.get(TURN),
        "sharpest_in": line.coordinate,
        "amplitude": line.amplitude,
        "amplitude_uncertainty": line.amplitude_uncertainty,
        "rms": line.amplitude / 2**0.5,
        "significance": line.significance,
        "true_frequency": row.frequency,
        "true_wavelength": row.wavelength,
        "order": row.order,
        "evidence": [*map(str, row.evidence)],
        "needs": None if row.needs is None else str(row.needs),
    }


def _over(frequency: float | None) -> float | None:
    return 1.0 / frequency if frequency else None


def _stop_facts(
    scan: SpectrumOfScan, bands: Sequence[tuple[float, float]]
) -> Mapping[str, Any] | None:
    stopped = scan.stopped
    if stopped is None:
        return None
    possible = [(row.line.possible.get(TIME), row.line.amplitude) for row in scan.named]
    return {
        "bands": [list(band) for band in bands],
        "filter": "Butterworth, fourth order, forward and backward",
        "phase": 0.0,
        "rms_before": stopped.rms_before,
        "rms_after": stopped.rms_after,
        "rms_removed": stopped.rms_removed,
        "settling_at_the_ends": stopped.settling,
        "peaks": [
            {
                "frequency": f,
                "amplitude_before": a,
                "amplitude_after": a * float(np.interp(f, stopped.frequency, stopped.response)),
            }
            for f, a in possible
            if f is not None
        ],
    }
