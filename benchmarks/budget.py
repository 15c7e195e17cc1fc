"""Are the stated uncertainties of PV, RMS and Zernike terms those of repeated scans?

Every scan is of another part on another machine: each source, the part's pose among them, is drawn
from what is stated of it, and the calibration comes from a step test of its own. The truth is the
figure error of the part, less the freedoms that were fitted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.row import Row, between, shown
from omsm_ros.core.correction.budget import scan_budget
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource
from omsm_ros.core.correction.scan_fields import ScanFields, scan_fields
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.latency import declared, with_latency
from omsm_ros.core.form.analyse import Form, analyse_form
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.core.surface.placement import Portion
from omsm_ros.twin.cell import Recording
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.encoder import EncoderErrors
from omsm_ros.twin.machine_errors import (
    Drift,
    Harmonic,
    MachineErrors,
    SpindleError,
    Straightness,
)
from omsm_ros.twin.part_pose import PartPose
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.scenario import Scenario, scan_of, step_test_of
from omsm_ros.units import NANOMETRE_M, PPM

TERMS = 15
LATENCY_S, LATENCY_UNCERTAINTY_S = 50e-6, 2e-6
_SIZES: dict[str, tuple[float, dict[str, float]]] = {
    "tilt": (1e-6, {}),
    "decentre": (0.1e-6, {}),
    "clocking": (50e-6, {}),
    "centre_x": (0.05e-6, {}),
    "spindle_axial": (5e-9, {"per_turn": 2}),
    "spindle_radial": (20e-9, {"per_turn": 2}),
    "spindle_tilt": (0.2e-6, {"per_turn": 1}),
    "straightness_x": (10e-9, {}),
    "encoder_scale": (2 * PPM, {}),
    "probe_linearity": (10e-9, {"half_range": 50e-6}),
    "probe_slope": (0.1e-6, {}),
    "drift_walk": (1e-9, {}),
    "drift_rate": (0.1e-9, {}),
}
"""Plausible standard uncertainties of a sound machine, in SI, with their parameters."""


NONE = ScanFields((), np.empty((0, 0)), 1)
FITS = (("piston",), ("piston", "tip", "tilt"))


def stated() -> MachineSources:
    """What is said of the machines from which each scan's is drawn."""
    return MachineSources(
        tuple(
            StatedSource(source=name, value=size, reason="drawn from this", parameters=parameters)
            for name, (size, parameters) in _SIZES.items()
        )
    )


def drawn(seed: int) -> Disturbances:
    """A machine and a part, drawn from what is stated."""
    random = np.random.default_rng(1000 + seed)

    def size(name: str) -> float:
        return float(random.normal(0.0, _SIZES[name][0]))

    def wave(name: str) -> Harmonic:
        along, across = size(name), size(name)
        return Harmonic(
            amplitude=float(np.hypot(along, across)),
            per_turn=int(_SIZES[name][1]["per_turn"]),
            phase_rad=float(np.arctan2(across, along)),
        )

    pose = PartPose(
        x_m=size("decentre"),
        y_m=size("decentre"),
        tilt_x_rad=size("tilt"),
        tilt_y_rad=size("tilt"),
        clocking_rad=size("clocking"),
    )
    return Disturbances(
        probe=ProbeErrors(
            latency_s=LATENCY_S + float(random.normal(0.0, LATENCY_UNCERTAINTY_S)),
            cubic_m=size("probe_linearity"),
            slope_error_m_per_rad=size("probe_slope"),
        ),
        machine=MachineErrors(
            pose=pose,
            mount=Geometry(centre_x=size("centre_x")),
            spindle=SpindleError(
                axial_m=(wave("spindle_axial"),),
                radial_m=(wave("spindle_radial"),),
                tilt_rad=(wave("spindle_tilt"),),
            ),
            x_slide_along_z=Straightness(
                bow_m=size("straightness_x"), half_travel_m=PAPER_MIRROR_RADIUS_M
            ),
            drift=Drift(
                ramp_m_per_s=size("drift_rate"),
                random_walk_m_per_root_s=_SIZES["drift_walk"][0],
            ),
        ),
        encoder=EncoderErrors(scale_ppm=size("encoder_scale") / PPM),
    )


@dataclass(frozen=True, eq=False)
class Scan:
    """A corrected scan, the form that it tells, and the true one."""

    measured: Form
    true: Form


def scan(seed: int, feed: float, fitted: Sequence[str]) -> Scan:
    """Calibrate, scan, correct, fit and judge one machine and part."""
    disturbances = drawn(seed)
    scenario = Scenario(seed=seed, feed_per_turn=feed)
    calibration = _calibrated(scenario, disturbances)
    points, fields = _corrected(calibration, scan_of(scenario, disturbances))
    x, y = points.x, points.y
    true = scenario.part.height(x, y)
    return Scan(_form(x, y, points.height, fields, fitted), _form(x, y, true, NONE, fitted))


def _calibrated(scenario: Scenario, disturbances: Disturbances) -> Calibration:
    """From a step test of this machine on a quiet day, its latency known as stated.

    What drift and a bent scale of the probe do to a step test is a matter of its certificate.
    """
    quiet = Disturbances(probe=ProbeErrors(latency_s=disturbances.probe.latency_s))
    made = identify(step_test_of(scenario, quiet).motion_record()).calibration
    lag = made.dynamics.low_frequency_delay
    latency = declared(lag, LATENCY_S, LATENCY_UNCERTAINTY_S, "measured with a light switch")
    return with_latency(made, latency)


def _corrected(calibration: Calibration, made: Recording) -> tuple[SurfacePoints, ScanFields]:
    sources = replace(ErrorSources.of(calibration), **stated().of_points())
    corrector = Corrector(calibration, CorrectionOptions(sources=sources, accept_other_rate=True))
    corrector.push_axes(made.axes)
    corrector.push_distance(made.distance)
    points = join_points([corrector.finish()])
    trace = corrector.trace.points().with_slopes(PAPER_MIRROR)
    budget = scan_budget(
        calibration, sources, corrector.budget, Geometry(), stated(), trace, corrector.trace.seen
    )
    return points, scan_fields(budget.fields, corrector.trace.every, budget.bounds)


def _form(
    x: np.ndarray, y: np.ndarray, height: np.ndarray, fields: ScanFields, fitted: Sequence[str]
) -> Form:
    portion = Portion(x, y, height, fields.at(0, len(x)))
    return analyse_form(
        PAPER_MIRROR, lambda: [portion], fitted, sources=fields.names, bounds=fields.bounds
    )


def deviations(scans: Iterable[Scan]) -> dict[str, list[tuple[float, float]]]:
    """By figure, the error and the stated standard uncertainty of each scan [m]."""
    found: dict[str, list[tuple[float, float]]] = {}
    for made in scans:
        for name in ("peak_to_valley", "robust_peak_to_valley", "rms"):
            told, true = made.measured.deviation[name], made.true.deviation[name]
            found.setdefault(name, []).append((told.value - true.value, told.uncertainty))
        told_terms, true_terms = made.measured.zernike, made.true.zernike
        errors = told_terms.coefficients - true_terms.coefficients
        for k in range(TERMS):
            pair = float(errors[k]), float(told_terms.uncertainty[k])
            found.setdefault(f"zernike {k + 1}", []).append(pair)
    return found


def rows(full: bool) -> Iterator[Row]:
    """Coverage at k = 2, and the rms error over the rms of what is stated."""
    runs, feed = (200, 1e-3) if full else (6, 1e-3)
    bars = (92.0, 98.0) if full else (60.0, 100.0)
    for fitted in FITS:
        found = deviations(scan(seed, feed, fitted) for seed in range(1, runs + 1))
        terms = [p for name, pairs in found.items() if name.startswith("zernike") for p in pairs]
        groups = {n: p for n, p in found.items() if not n.startswith("zernike")}
        for name, pairs in (groups | {f"first {TERMS} Zernike terms": terms}).items():
            label = f"{name.replace('_', ' ')}, {len(fitted)} fitted"
            yield from _coverage(label, np.array(pairs), bars)


def _coverage(label: str, pairs: np.ndarray, bars: tuple[float, float]) -> Iterator[Row]:
    error, spread = pairs.T
    covered = 100 * np.mean(abs(error) <= 2 * spread)
    yield between(f"{label}: truth within k = 2", covered, "%", *bars, runs=len(pairs))
    stated_ = float(np.sqrt(np.mean(spread**2)))
    ratio = float(np.sqrt(np.mean(error**2))) / stated_
    yield shown(f"{label}: rms error / stated", ratio, "1", stated_ / NANOMETRE_M, len(pairs))
