"""Compute spectra of scans and classify their lines: from bags to ``spectrum.json`` and report."""

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
from omsm_ros.core.ripple.accelerometer import acceleration_lines, accelerations_of
from omsm_ros.core.ripple.density import BandStopped, Density, band_stop, density
from omsm_ros.core.ripple.exposure import (
    Exposure,
    declared_exposure,
    estimate_exposure,
    passing_frequency,
    passing_textures,
    wavelength_of,
)
from omsm_ros.core.ripple.lines import MOST_LINES
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
from omsm_ros.core.ripple.vibration_removal import REMOVED, RemovedVibration, remove_vibrations
from omsm_ros.core.streams.blocks import AccelerationBlock, FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.io import bags
from omsm_ros.io.files import REPORT, SPECTRUM, result_folder, save_json, save_text
from omsm_ros.io.maps.columns_file import write_columns
from omsm_ros.io.results import PlyWriter
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.correct import Admission, CorrectedScan
from omsm_ros.pipelines.recording import Recording

SCHEMA = "omsm-spectrum/1"
NORMALISATION = (
    "Densities are one-sided and per hertz (time) or per 1/m (path), Blackman-Harris window of "
    "mean square one: their sum times the spacing is the mean square; a line of amplitude a "
    "(half of peak to valley) has the power a²/2; significance is that of a normal variable with "
    "the probability that noise alone gives such a line anywhere in the spectrum."
)
# Twenty minutes at 1 kHz; more samples do not improve the lines.
MOST_SAMPLES = 1_250_000


@dataclass(frozen=True, kw_only=True)
class SpectrumOptions:
    """Options of a spectral analysis.

    calibration: None adds encoder and probe without a dynamic correction
    nominal: surface to subtract first;  stop: bands to remove from the heights [Hz]
    polarity: of the probe;  remove_vibration: by the accelerometer, in its phase
    exposure: of the probe [s], None estimates it;  spot: diameter of its spot on the part [m]
    """

    calibration: Calibration | None = None
    admission: Admission = field(default_factory=Admission)
    nominal: Surface | None = None
    stop: tuple[tuple[float, float], ...] = ()
    polarity: int = 1
    remove_vibration: bool = False
    exposure: float | None = None
    spot: float = 0.0


@dataclass(frozen=True, eq=False)
class ReadScan:
    """A scan as read: its signal, points as corrected, and account of all samples.

    motion: density of the Z encoder's motion;  acceleration: blocks of the accelerometer
    received: number of points before the cut to MOST_SAMPLES
    """

    signal: ScanSignal
    acceleration: list[AccelerationBlock]
    points: SurfacePoints
    motion: Density
    account: dict[str, Any]
    received: int


@dataclass(frozen=True, eq=False)
class SpectrumOfScan:
    """Result of the spectral analysis of one scan.

    vibrations: lines of the accelerometer and what was removed of them
    stopped: heights without the stopped bands, None without bands
    """

    read: ReadScan
    studied: StudiedScan
    named: list[NamedLine]
    vibrations: Sequence[RemovedVibration] = ()
    stopped: BandStopped | None = None

    @property
    def removed(self) -> FloatArray:
        """Vibration and bands that were removed from the heights (n,) [m]."""
        parts = [one.removed for one in self.vibrations if one.outcome == REMOVED]
        parts += [] if self.stopped is None else [self.stopped.removed]
        return np.asarray(sum(parts, np.zeros(len(self.studied.signal))))


def spectra_of(paths: Sequence[AnyBag], options: SpectrumOptions) -> list[SpectrumOfScan]:
    """Analyse all scans, and classify each spectral line.

    Raises BagError for a bag without samples, CalibrationError for a calibration of another
    machine, DataError for a scan that is too short.
    """
    stems = [Path(str(path)).stem for path in paths]
    names = [s if stems.count(s) == 1 else f"{s} ({k})" for k, s in enumerate(stems, 1)]
    read = [_read(path, name, options) for path, name in zip(paths, names, strict=True)]
    shaken = [
        acceleration_lines(*accelerations_of(r.acceleration)) if r.acceleration else None
        for r in read
    ]
    studied = analyse_scans([(r.signal, s) for r, s in zip(read, shaken, strict=True)])
    scans = zip(read, studied, name_lines(studied), strict=True)
    return [_cleaned(SpectrumOfScan(*scan), options) for scan in scans]


def _cleaned(scan: SpectrumOfScan, options: SpectrumOptions) -> SpectrumOfScan:
    """Return ``scan`` with what is to be removed from it: first vibration, then bands."""
    signal, sample = scan.studied.signal, scan.read.points.sample
    if options.remove_vibration and len(sample) == len(signal):
        every = int(np.gcd.reduce(np.diff(sample.astype(np.int64))))
        time = sample * signal.period / every
        found = remove_vibrations(scan.studied, time, scan.read.acceleration)
        scan = replace(scan, vibrations=found)
    if options.stop:
        left = scan.studied.formless.residual - scan.removed
        stopped = band_stop(signal.sample, left, signal.period, options.stop)
        scan = replace(scan, stopped=stopped)
    return scan


def _read(path: AnyBag, name: str, options: SpectrumOptions) -> ReadScan:
    how = CorrectionOptions(polarity=options.polarity, accept_other_rate=options.admission.override)
    with Recording(path) as recording:
        calibration = options.calibration or unit_calibration(recording.sample_period())
        scan = CorrectedScan(recording, calibration, how, admission=options.admission)
        axes, parts = scan.read()
        account, period = scan.account.as_dict(), scan.sample_period
        shaken = []
        if recording.holds(bags.ACCELERATION_TOPIC):
            shaken = [block for _, block in recording.records(bags.ACCELERATION_TOPIC)]
    every = join_points(parts)
    points = every.part(slice(0, MOST_SAMPLES))
    height = points.height
    if options.nominal is not None:
        height = height - options.nominal.height(points.x, points.y)
    count = np.concatenate([np.arange(len(b)) + b.first_sample for b in axes])
    x, y, z, c = (np.concatenate([getattr(b, n) for b in axes]) for n in "xyzc")
    signal = scan_signal(name, period, (points.sample, height), (count, x, y, c))
    known = z[np.isfinite(z)]
    motion = density(known - np.mean(known), period)
    return ReadScan(signal, shaken, points, motion, account, len(every))


def cleaned_points(scan: SpectrumOfScan) -> SurfacePoints:
    """Return the points of ``scan`` without the vibration and the bands that were removed.

    Raises ConfigurationError if the points are not those analysed.
    """
    if len(scan.read.points) != len(scan.studied.signal):
        raise ConfigurationError(
            f"{scan.studied.signal.name!r}: its trigger counter restarted, so that its heights "
            "are not those analysed; give a scan in one piece"
        )
    return replace(scan.read.points, height=scan.read.points.height - scan.removed)


def summary_of(scans: Sequence[SpectrumOfScan], options: SpectrumOptions) -> dict[str, Any]:
    """Return the content of ``spectrum.json``, in SI units."""
    rows = [row for scan in scans for row in scan.named]
    calibration = options.calibration
    if options.exposure is None:
        textures = passing_textures([(scan.studied, scan.named) for scan in scans])
        longest = max(scan.studied.signal.period for scan in scans)
        exposure = estimate_exposure(textures, longest)
    else:
        exposure = declared_exposure(options.exposure)
    return {
        "schema": SCHEMA,
        "normalisation": NORMALISATION,
        "calibration": None if calibration is None else calibration.id,
        "counts": {kind: sum(row.kind == kind for row in rows) for kind in KINDS},
        "undecided": sum(row.kind == UNDECIDED for row in rows),
        "exposure": None
        if exposure is None
        else asdict(exposure) | {"spot": options.spot, "finding": str(exposure.finding())},
        "scans": [_scan_facts(scan, options, exposure) for scan in scans],
        "versions": {"omsm_ros": __version__},
    }


def _scan_facts(
    scan: SpectrumOfScan, options: SpectrumOptions, exposure: Exposure | None
) -> dict[str, Any]:
    studied, signal = scan.studied, scan.studied.signal
    turn, minutes = studied.coordinates.get(TURN), 60.0
    return {
        "name": signal.name,
        "samples": {
            "received": scan.read.received,
            "analysed": len(signal),
            "account": scan.read.account,
        },
        "sample_rate": signal.rate,
        "duration": signal.duration,
        "turns": signal.turns,
        "spindle_speed_rpm": None if turn is None else turn.pace * minutes,
        "path_length": float(np.ptp(signal.path)),
        "sampling": sampling_over(signal),
        "form": {
            "degree": studied.formless.degree,
            "rms_removed": studied.formless.removed,
            "rms_left": float(np.std(studied.formless.residual)),
        },
        "noise": {
            "rms": studied.spectrum.noise,
            "amplitude": float(np.median(studied.spectrum.amplitude_floor)),
        },
        "motion": _motion_facts(scan.read.motion, options.calibration),
        "accelerometer": None
        if (shaken := studied.acceleration_lines) is None
        else {
            "highest": shaken.highest,
            "duration": shaken.duration,
            "lines": [asdict(one) | {"displacement": one.displacement} for one in shaken.lines],
        },
        "peaks": [
            _peak_facts(studied, row) | _on_the_part(studied, row, exposure, options.spot)
            for row in scan.named
        ],
        "vibration_removed": [
            {name: value for name, value in asdict(one).items() if name != "removed"}
            | {"finding": str(one.finding())}
            for one in scan.vibrations
        ],
        "lines_limited": len(studied.spectrum.lines) >= MOST_LINES,
        "band_stop": _stop_facts(scan, options.stop),
    }


def _motion_facts(motion: Density, calibration: Calibration | None) -> dict[str, Any]:
    """Return rms of the motion in all, and of its content above the calibrated band [m]."""
    top = float(motion.frequency[-1])
    total = motion.power(0.0, top)
    known, beyond = None, None
    if calibration is not None:
        known = calibration.valid_up_to
        beyond = motion.power(known, top) ** 0.5 if known < top else 0.0
    return {"rms": total**0.5, "valid_up_to": known, "outside_band_rms": beyond}


def _peak_facts(studied: StudiedScan, row: NamedLine) -> dict[str, Any]:
    line = row.line
    possible = line.possible
    place = studied.coordinates[line.coordinate]
    return {
        "kind": row.kind, "also": row.also or None, "frequency": possible.get(TIME),
        "frequency_uncertainty": line.frequency_uncertainty * place.pace,
        "wavelength_along_path": _over(possible.get(PATH)),
        "wavelength_along_radius": _over(possible.get(RADIUS)), "per_turn": possible.get(TURN),
        "sharpest_in": line.coordinate, "amplitude": line.amplitude,
        "amplitude_uncertainty": line.amplitude_uncertainty, "rms": line.amplitude / 2**0.5,
        "significance": line.significance, "true_frequency": row.frequency,
        "true_wavelength": row.wavelength, "order": row.order,
        "evidence": [*map(str, row.evidence)],
        "needs": None if row.needs is None else str(row.needs),
    }  # fmt: skip


def _on_the_part(
    studied: StudiedScan, row: NamedLine, exposure: Exposure | None, spot: float
) -> dict[str, float | None]:
    """Return the amplitude of a texture without exposure and spot [m], None where unknown."""
    wave, found = wavelength_of(row), None
    if wave is not None and exposure is not None:
        passing = passing_frequency(studied.signal, wave)
        size, sigma = row.line.amplitude, row.line.amplitude_uncertainty
        found = exposure.undone(passing, spot, wave, size, sigma)
    amplitude, uncertainty = found or (None, None)
    return {"amplitude_on_part": amplitude, "amplitude_on_part_uncertainty": uncertainty}


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


def publish_spectra(
    paths: Sequence[AnyBag], options: SpectrumOptions, out: Path, *, report: bool = True
) -> dict[str, Any]:
    """Analyse the scans, write the results into ``out``, and return ``spectrum.json``'s content."""
    kind = "band_stopped" if options.stop else "vibration_removed"
    clouds = [f"{kind}_{k + 1}.ply" for k in range(len(paths))]
    densities = [n.format(k + 1) for k in range(len(paths)) for _, n, _ in _DENSITIES]
    kinds = ("band_stopped_*.ply", "vibration_removed_*.ply", "density_*.csv")
    earlier = [path.name for one in kinds for path in out.glob(one) if (out / SPECTRUM).is_file()]
    owned = (*clouds, *densities, *earlier, REPORT, SPECTRUM)
    with result_folder(out, owned) as folder:
        scans = spectra_of(paths, options)
        summary = summary_of(scans, options)
        files = {"spectrum": SPECTRUM}
        is_cleaned = options.stop or options.remove_vibration
        for name, scan in zip(clouds, scans, strict=True) if is_cleaned else ():
            with PlyWriter(folder / name, f"omsm_ros, metres, {kind.replace('_', ' ')}") as ply:
                ply.write(cleaned_points(scan))
            what = "the band" if options.stop else "its vibration"
            files[f"{scan.studied.signal.name} without {what}"] = name
        for k, scan in enumerate(scans, 1):
            for coordinate, name, units in _DENSITIES:
                if coordinate == TIME or coordinate in scan.studied.coordinates:
                    files[f"density {k} over {coordinate}"] = name.format(k)
                    found = scan.studied.density(coordinate)
                    columns = dict(zip(units, (found.frequency, found.density), strict=True))
                    write_columns(folder / name.format(k), columns, csv=True)
        if report:
            # Imported on demand, because loading the figures takes longer than the analysis.
            from omsm_ros.report.spectrum import drawn, render

            valid = options.calibration.valid_up_to if options.calibration else None
            figures = drawn([(s.studied, s.named, s.read.motion) for s in scans], valid)
            save_text(folder / REPORT, render(summary, figures))
            files["report"] = REPORT
        summary["files"] = files
        save_json(folder / SPECTRUM, summary)
    return summary


# Coordinate, file, and columns of the densities of each scan.
_DENSITIES = (
    (TIME, "density_{}.csv", ("frequency_Hz", "density_m2_per_Hz")),
    (PATH, "density_path_{}.csv", ("frequency_per_m", "density_m3")),
)
