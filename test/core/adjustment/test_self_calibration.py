"""Dynamics from scans of one part, against what the twin really does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by
from soaked import soaked

from omsm_ros.core.adjustment.resolved_calibration import (
    after_step_test,
    from_scans_alone,
    resolved,
    undetermined,
    unit_calibration,
    without_step_test,
)
from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.adjustment.self_calibration import (
    CURVATURE,
    GAIN,
    LAG,
    LATENCY,
    Prior,
    self_calibrate,
)
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.latency import REVERSAL, SPEEDS
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import DataError
from omsm_ros.pipelines.recording import scan_data
from omsm_ros.twin.cell import Cell, Probe, Recording, record
from omsm_ros.twin.disturbances import Disturbances, VibrationLine
from omsm_ros.twin.machine_errors import Drift, MachineErrors, PartPose
from omsm_ros.twin.plant import PAPER_DYNAMICS, Plant
from omsm_ros.twin.probe import ProbeErrors

LAG_S = PAPER_DYNAMICS.low_frequency_delay
TRUE_GAIN = Probe().scale
FEED = 1e-3
STEP_TEST_LAG_U = 1e-6


def disturbed(latency: float = 0.0, **machine: object) -> Disturbances:
    errors = MachineErrors(**machine)  # type: ignore[arg-type]
    return Disturbances(probe=ProbeErrors(latency_s=latency), machine=errors)


def made(
    rpm: float, seed: int, disturbances: Disturbances, plant: Plant | None = None, **cell: object
) -> Recording:
    twin = Cell(plant=plant or Plant(), seed=seed, disturbances=disturbances, **cell)  # type: ignore[arg-type]
    return record(twin, Spiral(PAPER_MIRROR, 12.7e-3, FEED, rpm), PAPER_MIRROR)


def corrected(recording: Recording, known: Calibration, **options: object) -> SurfacePoints:
    corrector = Corrector(known, CorrectionOptions(**options))  # type: ignore[arg-type]
    corrector.push_axes(recording.axes)
    corrector.push_distance(recording.distance)
    return join_points([corrector.finish()])


def scanned(recording: Recording, known: Calibration) -> ScanData:
    points = corrected(recording, known, probe_latency=0.0)
    return scan_data([recording.axes], [points], 1e-3)[0]


def step_test(latency: float, off: float = 0.0) -> Calibration:
    """Return a step test of the paper's structure and a late probe, with a lag wrong by ``off``."""
    g = PAPER_DYNAMICS
    dynamics = TransferFunction(g.numerator, g.denominator, latency + 50e-6 + off)
    # Part of the structure's lag stands as delay, so that an error of either sign has room.
    numerator = g.numerator + np.array([0.0, 50e-6, 50e-6 * g.numerator[1] + 50e-6**2 / 2])
    p = len(numerator) + len(g.denominator)
    covariance = np.zeros((p, p))
    covariance[-1, -1] = STEP_TEST_LAG_U**2
    return Calibration(
        dynamics=replace(dynamics, numerator=numerator),
        static_gain=TRUE_GAIN,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=covariance,
        certificate=certified_by({"verdict": "accepted", "noise_m": 10e-9}),
    )


def error_left(calibration: Calibration, latency: float) -> float:
    """PV of the corrected heights of a noise-free scan against the true surface [m]."""
    quiet = Probe(noise=0.0, resolution=0.0)
    recording = made(30.0, 9, disturbed(latency), probe=quiet, encoder_noise=0.0)
    points = corrected(recording, calibration)
    error = points.height - PAPER_MIRROR.height(points.x, points.y)
    inside = np.hypot(points.x, points.y) > 0.2e-3
    return float(np.ptp(error[inside]))


@pytest.mark.parametrize("share", [*soaked(0.0, 0.5), 1.0])
def test_two_speeds_and_a_step_test_divide_the_lag(share: float) -> None:
    latency = share * LAG_S
    known = step_test(latency, off=0.7e-6)
    pair = [scanned(made(rpm, s, disturbed(latency)), known) for s, rpm in ((1, 30.0), (2, 60.0))]
    calibrated = self_calibrate(pair, after_step_test(known))
    assert np.allclose(calibrated.speeds, [np.pi, 2 * np.pi], rtol=1e-3)
    result = resolved(known, calibrated)
    found = result.latency
    assert found.source == SPEEDS
    assert found.uncertainty_s is not None
    assert found.uncertainty_s < 1.6e-6
    assert abs(found.delay_s - latency) < 2.5 * found.uncertainty_s
    assert error_left(result, latency) < 5e-9
    if share:
        # Without the scans the correction itself makes an error of this size.
        assert error_left(known, latency) > 400e-9
    else:
        assert result.certificate.verdict == "accepted"


def test_without_a_step_test_the_surface_scanned_is_corrected() -> None:
    latency = 0.5 * LAG_S
    plain = unit_calibration(1e-3, TRUE_GAIN)
    pair = [scanned(made(rpm, s, disturbed(latency)), plain) for s, rpm in ((1, 30.0), (2, 60.0))]
    found = self_calibrate(pair, without_step_test(1e-4))
    assert not found.known[LATENCY]
    structure, uncertainty = found.structure
    assert abs(structure - LAG_S) < 3 * uncertainty < 3e-6
    assert any("latency" in str(text) for text in undetermined(found))
    result = from_scans_alone(found, 1e-3, TRUE_GAIN, {})
    assert result.latency.share is None
    assert result.latency.uncertainty_s is None
    assert error_left(result, latency) < 5e-9
    assert str(result.certificate.verdict).startswith("accepted")
    # Both speeds reach further than a few turns a second, and no further than the harmonics.
    assert 3.0 < result.valid_up_to < 12.0


def test_two_directions_are_the_same_estimator() -> None:
    latency = 0.5 * LAG_S
    known = step_test(latency)
    pair = [scanned(made(rpm, s, disturbed(latency)), known) for s, rpm in ((1, 30.0), (2, -30.0))]
    found = resolved(known, self_calibrate(pair, after_step_test(known))).latency
    assert found.source == REVERSAL
    assert found.share == pytest.approx(1 / 3, abs=0.005)


@pytest.mark.soak
def test_the_stated_uncertainty_is_that_of_repetition() -> None:
    """Nothing but noise differs, so nothing but noise is allowed for."""
    known = step_test(0.0)
    exact = after_step_test(replace(known, covariance=0 * known.covariance))
    still = Prior(exact.covariance, clocking=0.0, shift=0.0, tilt=0.0)
    errors, stated = [], []
    for seed in range(10):
        pair = [
            scanned(made(rpm, 2 * seed + k, disturbed()), known)
            for k, rpm in enumerate((60.0, 120.0))
        ]
        found = self_calibrate(pair, still, harmonics=4)
        errors.append(found.values[LATENCY])
        stated.append(np.sqrt(found.covariance[LATENCY, LATENCY]))
    # The scatter of ten has a relative uncertainty of 23 %.
    assert 0.4 < np.std(errors) / np.mean(stated) < 1.7
    assert np.mean(stated) < 0.3e-6


def test_drift_and_vibration_do_not_pass_for_a_lag() -> None:
    vibration = (
        VibrationLine(amplitude_m=25e-9, per_turn=2.0, phase_rad=0.3),
        VibrationLine(amplitude_m=20e-9, frequency_hz=680.0),
    )
    known = step_test(0.0)
    pair = []
    for seed, rpm, ramp in ((1, 30.0, 1e-9), (2, 60.0, -1e-9)):
        errors = replace(disturbed(drift=Drift(ramp_m_per_s=ramp)), vibration=vibration)
        pair.append(scanned(made(rpm, seed, errors), known))
    found = self_calibrate(pair, after_step_test(known))
    assert abs(found.values[LATENCY]) < 2.5 * np.sqrt(found.covariance[LATENCY, LATENCY])
    assert found.agreement.holds


def test_a_part_that_moved_is_found_where_it_went() -> None:
    known = step_test(0.0)
    moved = disturbed(pose=PartPose(x_m=0.5e-6, tilt_y_rad=1.5e-6))
    pair = [scanned(made(30.0, 1, disturbed()), known), scanned(made(60.0, 2, moved), known)]
    found = self_calibrate(pair, after_step_test(known))
    assert abs(found.values[LATENCY]) < 2.5 * np.sqrt(found.covariance[LATENCY, LATENCY])
    _, shift_x, shift_y, _, _ = found.own[0]
    _, spread_x, spread_y, _, _ = found.own_uncertainty[0]
    assert abs(shift_x - 0.5e-6) < 3 * spread_x
    assert abs(shift_y) < 3 * spread_y


def test_scans_of_different_parts_contradict_each_other() -> None:
    known = step_test(0.0)
    one = scanned(made(30.0, 1, disturbed()), known)
    other = scanned(made(60.0, 2, disturbed()), known)
    dented = replace(other, height=other.height + 30e-9 * np.cos(5 * np.arctan2(other.y, other.x)))
    result = resolved(known, self_calibrate([one, dented], after_step_test(known)))
    assert result.certificate.verdict == "rejected"
    assert "contradict each other by" in str(result.certificate.reasons[0])


def test_a_step_test_that_the_scans_contradict_is_reported() -> None:
    # The probe has no latency; the step test was made with a slower structure. Its excess lag looks
    # like a negative latency, except for the following error, which shows the conflict.
    slow = step_test(0.0, off=300e-6)
    pair = [scanned(made(rpm, s, disturbed()), slow) for s, rpm in ((1, 30.0), (2, 60.0))]
    found = self_calibrate(pair, after_step_test(slow))
    result = resolved(slow, found)
    assert result.certificate.verdict == "rejected"
    assert "scans and step test contradict each other" in str(result.certificate.reasons[0])


def test_a_probe_that_would_be_early_is_reported() -> None:
    stiff = step_test(0.0, off=-30e-6)
    pair = [scanned(made(rpm, s, disturbed()), stiff) for s, rpm in ((1, 30.0), (2, 60.0))]
    result = resolved(stiff, self_calibrate(pair, after_step_test(stiff)))
    assert result.certificate.verdict == "rejected"
    assert "µs early" in str(result.certificate.reasons[0])


def test_one_speed_and_direction_tell_nothing() -> None:
    known = step_test(0.0)
    pair = [scanned(made(60.0, s, disturbed()), known) for s in (1, 2)]
    with pytest.raises(DataError, match="in the other direction"):
        self_calibrate(pair, after_step_test(known))


def test_a_part_mounted_anew_tells_nothing() -> None:
    plain = unit_calibration(1e-3, TRUE_GAIN)
    pair = [scanned(made(rpm, s, disturbed()), plain) for s, rpm in ((1, 30.0), (2, 60.0))]
    unknown = replace(without_step_test(), clocking=10.0)
    with pytest.raises(DataError, match="without removing it"):
        self_calibrate(pair, unknown)


def test_what_is_known_before_is_what_the_covariance_says() -> None:
    prior = after_step_test(step_test(0.0)).covariance
    assert prior[LAG, LAG] == pytest.approx(STEP_TEST_LAG_U**2, rel=1e-6, abs=0)
    assert prior[CURVATURE, CURVATURE] == 0.0
    assert prior[GAIN, GAIN] == 0.0


def test_scans_without_any_noise_say_that_nobody_measured() -> None:
    """A distance that is zero throughout, and a Z that stands: no surface, no scatter."""
    plain = unit_calibration(1e-3, TRUE_GAIN)
    pair = [scanned(made(rpm, s, disturbed()), plain) for s, rpm in ((1, 30.0), (2, 60.0))]
    names = ("height", "distance", "motion")
    still = [replace(scan, **{n: np.zeros(len(scan)) for n in names}) for scan in pair]
    with pytest.raises(DataError, match="without any noise"):
        self_calibrate(still, without_step_test())
