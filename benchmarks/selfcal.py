"""Compare self-calibration on scans of a part with the true dynamics and stated uncertainties."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.row import Row, at_least, shown
from benchmarks.twin_motions import step_test_of
from omsm_ros.core.adjustment.resolved_calibration import (
    after_step_test,
    from_scans_alone,
    resolved,
    unit_calibration,
    without_step_test,
)
from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.adjustment.self_calibration import self_calibrate
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.pipelines.recording import scan_data
from omsm_ros.twin.cell import Cell, Probe, Recording, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances, VibrationLine
from omsm_ros.twin.machine_errors import Drift, MachineErrors
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.scenario import Scenario
from omsm_ros.units import NANOMETRE_M

LAG_S = 0.34e-3
SHARES = (0.0, 0.5, 1.0)
# A quarter of the paper's turns; the uncertainty is twice that of the paper's scan.
FEED_M = 4e-4
_SMALL_NM = 5.0
WORSE = Disturbances(
    machine=MachineErrors(drift=Drift(ramp_m_per_s=1e-9)),
    vibration=(
        # Repeats with C in every scan, as a spindle error does.
        VibrationLine(amplitude_m=25 * NANOMETRE_M, per_turn=2.0, phase_rad=0.3),
        VibrationLine(amplitude_m=20 * NANOMETRE_M, frequency_hz=680.0),
    ),
)


def _late(share: float, also: Disturbances = NOTHING) -> Disturbances:
    return replace(also, probe=ProbeErrors(latency_s=share * LAG_S))


def _scan(rpm: float, seed: int, errors: Disturbances, **cell: object) -> Recording:
    twin = Cell(seed=seed, disturbances=errors, **cell)  # type: ignore[arg-type]
    return record(twin, Spiral(PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, FEED_M, rpm), PAPER_MIRROR)


def _points(made: Recording, known: Calibration, **options: object) -> SurfacePoints:
    corrector = Corrector(known, CorrectionOptions(**options))  # type: ignore[arg-type]
    corrector.push_axes(made.axes)
    corrector.push_distance(made.distance)
    return join_points([corrector.finish()])


def _pair(seed: int, errors: Disturbances, known: Calibration) -> list[ScanData]:
    scans = (_scan(rpm, 1000 * seed + k, errors) for k, rpm in enumerate((30.0, 60.0)))
    return [
        scan_data([s.axes], [_points(s, known, probe_latency=0.0)], s.axes.sample_period)[0]
        for s in scans
    ]


def _error_left(known: Calibration, share: float) -> float:
    """Return the PV error of the heights of a scan without noise [nm]."""
    quiet = Probe(noise=0.0, resolution=0.0)
    made = _scan(30.0, 1, _late(share), probe=quiet, encoder_noise=0.0)
    points = _points(made, known)
    error = points.height - PAPER_MIRROR.height(points.x, points.y)
    return float(np.ptp(error)) / NANOMETRE_M


def _with_a_step_test(runs: int, also: Disturbances = NOTHING) -> tuple[list[float], list[bool]]:
    errors, inside = [], []
    for share in SHARES:
        for seed in range(1, runs + 1):
            test = step_test_of(Scenario(seed=seed), _late(share))
            known = identify(test.motion_record()).calibration
            found = self_calibrate(_pair(seed, _late(share, also), known), after_step_test(known))
            made = resolved(known, found)
            latency = made.latency
            errors.append(_error_left(made, share))
            spread = latency.uncertainty_s or 0.0
            inside.append(abs(float(found.values[3]) - share * LAG_S) < 2 * spread)
    return errors, inside


def _without_a_step_test(runs: int) -> list[float]:
    errors = []
    for share in SHARES:
        for seed in range(1, runs + 1):
            gain = Probe().scale
            plain = unit_calibration(1e-3, gain)
            found = self_calibrate(_pair(seed, _late(share), plain), without_step_test(1e-4))
            errors.append(_error_left(from_scans_alone(found, 1e-3, gain, {}), share))
    return errors


def rows(full: bool) -> Iterator[Row]:
    """Yield the residual errors, and the coverage of the latency."""
    runs = 100 if full else 1
    errors, inside = _with_a_step_test(runs)
    yield from _judged("selfcal, step test + 30, 60 rpm", errors, inside, 93.0)
    yield from _judged("selfcal, no step test", _without_a_step_test(runs), [], 93.0)
    errors, inside = _with_a_step_test(runs, WORSE)
    yield from _judged("selfcal, disturbed", errors, inside, 90.0)


def _judged(name: str, errors: list[float], inside: list[bool], percent: float) -> Iterator[Row]:
    """Yield how many of the runs leave little, the most that any leaves, and the latency's share.

    errors: PV of each run [nm];  inside: is the latency where it is said to be?
    """
    runs = len(errors)
    small = 100 * float(np.mean(np.array(errors) <= _SMALL_NM))
    yield at_least(f"{name}: at most {_SMALL_NM:.0f} nm left, PV", small, "%", percent, runs=runs)
    yield shown(f"{name}: most left, PV", max(errors), "nm", runs=runs)
    if inside:
        held = 100 * float(np.mean(inside))
        yield at_least(f"{name}: latency within k = 2", held, "%", percent, runs=runs)
