"""Self-calibration against scans made in closed form, and what must not touch its answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.adjustment.self_calibration import (
    CURVATURE,
    GAIN,
    LAG,
    LATENCY,
    Prior,
    SelfCalibration,
    self_calibrate,
)

from .synthetic_scans import coma, scanned

HARMONICS = 3
LATENCY_S, LAG_S, CURVATURE_S2 = 170e-6, 6e-6, 4e-7
PRIOR = Prior(np.diag([20e-6, 1e-6, 0.0, 1e-2]) ** 2)
SPEEDS = (30.0, 75.0)


def pair(speeds: tuple[float, ...] = SPEEDS, **made: float) -> list[ScanData]:
    """Scans in which Z follows one wave of three alone: only then a lag of Z is no latency."""
    return [scanned(rpm, followed=coma, seed=k, **made) for k, rpm in enumerate(speeds)]  # type: ignore[arg-type]


def fitted(scans: list[ScanData], prior: Prior = PRIOR) -> SelfCalibration:
    return self_calibrate(scans, prior, HARMONICS)


def spread(found: SelfCalibration, index: int) -> float:
    return float(np.sqrt(found.covariance[index, index]))


LATE = pair(latency=LATENCY_S, lag=LAG_S, curvature=CURVATURE_S2)


@pytest.fixture(scope="module")
def late() -> SelfCalibration:
    return fitted(LATE)


def test_lag_curvature_and_latency_come_apart(late: SelfCalibration) -> None:
    truth = {LAG: LAG_S, CURVATURE: CURVATURE_S2, LATENCY: LATENCY_S}
    for index, true in truth.items():
        assert abs(late.values[index] - true) < 4 * spread(late, index)
        assert spread(late, index) < 0.5 * PRIOR.covariance[index, index] ** 0.5
    assert late.values[GAIN] == pytest.approx(0.0, abs=1e-9)
    assert late.known.all()


def test_noise_points_and_speeds_are_those_of_the_scans(late: SelfCalibration) -> None:
    assert late.residual == pytest.approx(1e-9, rel=0.03)
    assert late.agreement.noise == pytest.approx(1e-9, rel=0.03)
    assert late.agreement.holds
    assert late.points == sum(map(len, LATE))
    # C turns against the path of the probe on the part.
    assert np.allclose(late.speeds, np.array(SPEEDS) * np.pi / 30, rtol=1e-12)


def test_amplitudes_are_those_of_the_surface(late: SelfCalibration) -> None:
    """40 µm u² of two waves and 30 µm u³ of one, rms over the radius, for u from 0.2 to 1."""
    radius = np.linspace(0.2, 1.0, 2001)
    one, two = (np.sqrt(np.mean((size * radius**p) ** 2)) for size, p in ((30e-6, 3), (40e-6, 2)))
    assert late.amplitudes[:2] == pytest.approx([one, two], rel=0.03)
    assert late.amplitudes[2] < 1e-3 * two


def same(found: SelfCalibration, expected: SelfCalibration, share: float = 1e-3) -> None:
    """Assert that both say the same, to a ``share`` of what they state as uncertainty."""
    for index in (LAG, CURVATURE, LATENCY):
        tolerance = share * spread(expected, index)
        assert found.values[index] == pytest.approx(expected.values[index], abs=tolerance)
        assert spread(found, index) == pytest.approx(spread(expected, index), rel=1e-2)


def test_a_surface_that_both_have_in_common_says_nothing(late: SelfCalibration) -> None:
    """It is seen where it is: without latency, for it is put on the heights after the fact."""

    def bowl(scan: ScanData) -> np.ndarray:
        # Without a slope along the path a latency leaves no trace on it.
        return np.asarray(scan.height + 5e-6 * (scan.x**2 + scan.y**2) / 10e-3**2)

    same(fitted([replace(s, height=bowl(s)) for s in LATE]), late, share=0.1)


def test_a_drift_of_the_second_scan_is_its_own(late: SelfCalibration) -> None:
    first, second = LATE
    at = second.time / second.time[-1]
    drifting = replace(second, height=second.height + 1e-6 * at - 400e-9 * at**3 + 50e-9)
    same(fitted([first, drifting]), late)


def test_a_tilt_within_what_is_allowed_is_its_own(late: SelfCalibration) -> None:
    first, second = LATE
    tilted = second.height + 1e-6 * second.x
    found = fitted([first, replace(second, height=tilted)])
    same(found, late, share=0.5)
    tilt, uncertainty = found.own[0][3], found.own_uncertainty[0][3]
    assert abs(tilt - late.own[0][3] - 1e-6) < 3 * uncertainty


def turned(scan: ScanData, angle: float) -> ScanData:
    place = (scan.x + 1j * scan.y) * np.exp(1j * angle)
    return replace(scan, x=place.real, y=place.imag)


def test_where_the_angle_begins_does_not_matter(late: SelfCalibration) -> None:
    found = fitted([turned(s, 0.7) for s in LATE])
    same(found, late)
    # Only the axes of shift and tilt turn along.
    for first in (1, 3):
        before = complex(*late.own[0][first : first + 2])
        assert complex(*found.own[0][first : first + 2]) == pytest.approx(
            before * np.exp(0.7j), abs=1e-3 * late.own_uncertainty[0][first]
        )


def test_a_part_and_its_mirror_image_have_one_latency(late: SelfCalibration) -> None:
    mirrored = [replace(s, y=-s.y, c=-s.c) for s in LATE]
    found = fitted(mirrored)
    same(found, late)
    assert np.allclose(found.speeds, -np.array(late.speeds))
    assert found.own[0][0] == pytest.approx(-late.own[0][0], abs=1e-3 * late.own_uncertainty[0][0])


def test_microinches_would_give_the_same_times(late: SelfCalibration) -> None:
    """Heights and motion in another unit: residuals grow, lags and latency do not."""
    unit = 39.37
    lengths = ("height", "distance", "motion")
    still = replace(PRIOR, shift=0.0, tilt=0.0)
    plain = fitted(LATE, still)
    scaled = fitted([replace(s, **{n: unit * getattr(s, n) for n in lengths}) for s in LATE], still)
    same(scaled, plain, share=0.02)
    assert scaled.residual == pytest.approx(unit * plain.residual, rel=1e-6)
    assert scaled.followed == pytest.approx(unit * plain.followed, rel=1e-2)
    assert scaled.agreement.ratio == pytest.approx(plain.agreement.ratio, rel=1e-3)


def test_which_scan_is_called_the_first_does_not_matter(late: SelfCalibration) -> None:
    found = fitted(LATE[::-1])
    for index in (LAG, CURVATURE, LATENCY):
        assert abs(found.values[index] - late.values[index]) < spread(late, index)
    # Exchanging the scans changes the sign of the clocking.
    both = np.hypot(found.own_uncertainty[0][0], late.own_uncertainty[0][0])
    assert abs(found.own[0][0] + late.own[0][0]) < both


def test_a_third_speed_tells_more() -> None:
    made = {"latency": LATENCY_S, "lag": LAG_S, "curvature": CURVATURE_S2}
    three = fitted(pair((30.0, 75.0, -75.0), **made))
    assert abs(three.values[LATENCY] - LATENCY_S) < 4 * spread(three, LATENCY)
    assert spread(three, LATENCY) < spread(fitted(pair(**made)), LATENCY)
    assert three.own.shape == (2, 5)


def test_a_clocking_within_what_is_allowed_is_found() -> None:
    """Where the dynamics are known: at a steady speed a latency would leave the same mark."""
    prior = replace(PRIOR, covariance=np.zeros((4, 4)), clocking=2e-4)
    found = fitted([scanned(30.0, seed=1), scanned(75.0, seed=2, clocking=1.5e-4)], prior)
    clocking, uncertainty = found.own[0][0], found.own_uncertainty[0][0]
    assert abs(clocking - 1.5e-4) < 4 * uncertainty < 3e-5


def test_a_part_that_shifted_is_found_where_it_went() -> None:
    prior = replace(PRIOR, shift=5e-6)
    scans = [scanned(30.0, seed=1), scanned(75.0, seed=2, moved=(3e-6, -2e-6))]
    found = fitted(scans, prior)
    for true, value, u in zip(
        (3e-6, -2e-6), found.own[0][1:3], found.own_uncertainty[0][1:3], strict=True
    ):
        assert abs(value - true) < 4 * u < 4e-6


def test_what_the_step_test_knows_exactly_stays() -> None:
    exact = replace(PRIOR, covariance=np.diag([0.0, 0.0, 0.0, 1e-2]) ** 2)
    found = fitted(pair(latency=LATENCY_S), exact)
    assert found.values[LAG] == pytest.approx(0.0, abs=1e-9)
    assert found.values[CURVATURE] == pytest.approx(0.0, abs=1e-12)
    assert abs(found.values[LATENCY] - LATENCY_S) < 4 * spread(found, LATENCY)
    assert found.prior_conflict < 10.0


def test_an_uncertain_gain_is_not_estimated_but_counts(late: SelfCalibration) -> None:
    """A gain that is ten times as uncertain leaves ten times as much on the rest."""
    grown = []
    for uncertainty in (1e-3, 1e-2):
        covariance = PRIOR.covariance.copy()
        covariance[GAIN, GAIN] = uncertainty**2
        found = fitted(LATE, replace(PRIOR, covariance=covariance))
        assert found.values == pytest.approx(late.values, rel=1e-9, abs=1e-15)
        assert spread(found, GAIN) == pytest.approx(uncertainty, rel=1e-6)
        grown.append(found.covariance[LATENCY, LATENCY] - late.covariance[LATENCY, LATENCY])
    assert grown[1] == pytest.approx(100 * grown[0], rel=1e-3, abs=0)


def test_structure_is_lag_less_latency(late: SelfCalibration) -> None:
    value, uncertainty = late.structure
    assert value == late.values[LAG] - late.values[LATENCY]
    two = late.covariance[np.ix_([LAG, LATENCY], [LAG, LATENCY])]
    assert uncertainty == pytest.approx(np.sqrt([1, -1] @ two @ [1, -1]), rel=1e-9)
    assert abs(value - (LAG_S - LATENCY_S)) < 4 * uncertainty


def test_scatter_over_repetitions_is_what_is_stated() -> None:
    """Ten pairs that differ in their noise alone; nothing between the scans is allowed for."""
    prior = Prior(np.diag([0.0, 0.0, 0.0, 1e-2]) ** 2, clocking=0.0, shift=0.0, tilt=0.0)
    off, stated = [], []
    for seed in range(10):
        scans = [
            scanned(rpm, turns=8, latency=LATENCY_S, noise=5e-9, seed=2 * seed + k)
            for k, rpm in enumerate((60.0, -60.0))
        ]
        found = fitted(scans, prior)
        off.append(found.values[LATENCY] - LATENCY_S)
        stated.append(spread(found, LATENCY))
    # A standard deviation of ten is known to 23 %.
    assert 0.5 < np.sqrt(np.mean(np.square(off))) / np.mean(stated) < 1.6


def test_the_same_there_and_back_contradicts_no_step_test() -> None:
    """Both directions at one speed tell hardly any lag; that it moves is no contradiction."""
    found = [
        fitted([scanned(rpm, seed=2 * seed + k) for k, rpm in enumerate((30.0, -30.0))])
        for seed in range(5)
    ]
    assert max(abs(f.values[LAG]) for f in found) < 1e-6
    assert max(f.prior_conflict for f in found) < 6.0


def test_a_lag_far_beyond_the_step_test_contradicts_it() -> None:
    prior = replace(PRIOR, covariance=np.diag([1e-6, 1e-7, 0.0, 1e-2]) ** 2)
    assert fitted(pair(latency=LATENCY_S), prior).prior_conflict < 14.0
    assert fitted(pair(latency=LATENCY_S, lag=100e-6), prior).prior_conflict > 100.0
