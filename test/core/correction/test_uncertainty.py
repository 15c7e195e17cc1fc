"""Stated uncertainty against Monte Carlo of the whole correction, and closed forms."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from certified import certified_by
from numpy.polynomial import polynomial
from scipy import signal

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import NOTHING_STATED, whole_scan_sources
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.systematic import ScanPoints
from omsm_ros.core.correction.uncertainty import (
    ErrorSources,
    reading_variances,
    sensitivity_filters,
    with_lateral_uncertainty,
)
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import PAPER_EQ_12

PERIOD = 1e-3
TIME = np.arange(700) * PERIOD
# Fast and large, so that every parameter leaves its mark.
Z = 0.4e-3 * np.sin(2 * np.pi * 6.0 * TIME) + 0.05e-3 * np.cos(2 * np.pi * 31.0 * TIME)
DISTANCE = 40e-6 * np.cos(2 * np.pi * 2.0 * TIME)
GAIN = 0.9921
G = TransferFunction(*(PAPER_EQ_12.normalised().numerator, PAPER_EQ_12.denominator), 0.2e-3)


def correlated_covariance(scale: float = 2e-3) -> np.ndarray:
    """A full covariance of all parameters but the numerator's first, which is fixed."""
    values = np.concatenate([G.numerator, G.denominator[1:], [G.delay]])
    mixing = np.random.default_rng(8).normal(size=(len(values), len(values)))
    covariance = mixing @ mixing.T / len(values) * scale**2 * np.outer(values, values)
    covariance[0] = covariance[:, 0] = 0.0
    return 0.5 * (covariance + covariance.T)


def calibration(covariance: np.ndarray, **changes: object) -> Calibration:
    parts: dict[str, object] = {
        "dynamics": G,
        "static_gain": GAIN,
        "sample_period": PERIOD,
        "valid_up_to": 100.0,
        "covariance": covariance,
    }
    return Calibration(**(parts | changes))  # type: ignore[arg-type]


def correct(
    known: Calibration, z: np.ndarray, distance: np.ndarray, sources: ErrorSources
) -> SurfacePoints:
    zero = np.zeros(len(z))
    corrector = Corrector(known, CorrectionOptions(sources=sources))
    place = {"stamp_ns": 0, "first_sample": 0, "sample_period": PERIOD}
    corrector.push_axes(AxisBlock(**place, x=zero, y=zero, z=z, b=zero, c=zero))  # type: ignore[arg-type]
    corrector.push_distance(DistanceBlock(**place, distance=distance))  # type: ignore[arg-type]
    return join_points([corrector.finish()])


def perturbed(draw: np.ndarray) -> TransferFunction:
    m = len(G.numerator)
    return TransferFunction(draw[:m], np.r_[1.0, draw[m:-1]], draw[-1])


def monte_carlo(known: Calibration, sources: ErrorSources, runs: int) -> np.ndarray:
    """Heights of ``runs`` corrections with everything that is uncertain drawn anew."""
    rng = np.random.default_rng(11)
    centre = np.concatenate([G.numerator, G.denominator[1:], [G.delay]])
    scale = np.sqrt(np.diag(known.covariance)) + (np.diag(known.covariance) == 0)
    scaled = known.covariance / np.outer(scale, scale)
    draws = centre + scale * rng.multivariate_normal(np.zeros(len(centre)), scaled, runs)
    gains = GAIN + sources.static_gain * rng.normal(size=runs)
    heights = []
    for draw, gain in zip(draws, gains, strict=True):
        filtered = discretise(perturbed(draw), PERIOD)
        z = Z + sources.encoder_noise * rng.normal(size=len(Z))
        step = sources.probe_resolution
        reading = DISTANCE + sources.probe_noise * rng.normal(size=len(Z))
        reading += step * (rng.random(len(Z)) - 0.5)
        heights.append(signal.sosfilt(filtered.sections, z)[200:] + reading[200:] / gain)
    return np.array(heights)


SOURCES = ErrorSources(
    probe_noise=4e-9, probe_resolution=6e-9, encoder_noise=2e-9, static_gain=2e-4
)


@pytest.fixture(scope="module")
def runs() -> np.ndarray:
    return monte_carlo(calibration(correlated_covariance()), SOURCES, 1200)


def stated() -> SurfacePoints:
    points = correct(calibration(correlated_covariance()), Z, DISTANCE, SOURCES)
    keep = points.sample >= 200
    return points.part(keep)


def test_stated_uncertainty_is_that_of_monte_carlo_point_by_point(runs: np.ndarray) -> None:
    ratio = stated().uncertainty / np.std(runs, axis=0, ddof=1)
    # 1200 runs know a standard deviation to 2 %; the whole path is to agree within 5 %.
    assert abs(np.median(ratio) - 1) < 0.03
    assert np.mean(abs(ratio - 1) < 0.05) > 0.97
    assert np.all(abs(ratio - 1) < 0.10)


def test_two_standard_uncertainties_cover_95_percent(runs: np.ndarray) -> None:
    points = stated()
    true_height = signal.sosfilt(discretise(G, PERIOD).sections, Z)[200:] + DISTANCE[200:] / GAIN
    covered = np.mean(abs(runs - true_height) < 2 * points.uncertainty)
    assert 0.93 < covered < 0.97


def test_the_dynamics_are_a_visible_part_of_it() -> None:
    quiet = correct(calibration(correlated_covariance()), Z, DISTANCE, ErrorSources())
    assert np.max(quiet.uncertainty) > 10e-9


@pytest.mark.parametrize("parameter", range(1, 7))
@pytest.mark.parametrize("period", [1e-3, 1 / 70e3])
def test_each_sensitivity_is_the_derivative_of_the_response(parameter: int, period: float) -> None:
    centre = np.concatenate([G.numerator, G.denominator[1:], [G.delay]])
    deviation = 1e-4 * centre[parameter]
    covariance = np.zeros((7, 7))
    covariance[parameter, parameter] = deviation**2
    (found,) = sensitivity_filters(calibration(covariance), period)
    frequency = np.array([0.5, 3.0, 15.0, 40.0])
    up, down = centre.copy(), centre.copy()
    up[parameter] += deviation
    down[parameter] -= deviation
    difference = perturbed(up).response(frequency) - perturbed(down).response(frequency)
    assert np.allclose(abs(found["z"].response(frequency)), abs(difference) / 2, rtol=0.02)


def test_a_delay_of_a_response_that_does_not_fall_is_differentiated_too() -> None:
    covariance = np.diag([0.0, 0.0, 0.0, 1e-12])
    biproper = TransferFunction(np.array([1.0, 1e-4]), np.array([1.0, 3e-4]), 1e-4)
    (found,) = sensitivity_filters(calibration(covariance, dynamics=biproper), PERIOD)
    frequency = np.array([1.0, 10.0, 40.0])
    expected = 2 * np.pi * frequency * 1e-6 * abs(biproper.response(frequency))
    assert np.allclose(abs(found["z"].response(frequency)), expected, rtol=0.02)


def test_a_sharp_resonance_near_the_sample_rate_still_has_sensitivities() -> None:
    omega = 2 * np.pi * 833.0
    sharp = TransferFunction(np.ones(1), np.array([1.0, 2 * 0.01 / omega, 1 / omega**2]))
    covariance = np.diag([0.0, 1e-12, 1e-16, 0.0])
    found = sensitivity_filters(calibration(covariance, dynamics=sharp), PERIOD)
    frequency = np.array([1.0, 10.0])
    s = 2j * np.pi * frequency
    squared = sharp.response(frequency) ** 2
    expected = np.sqrt(abs(1e-6 * s * squared) ** 2 + abs(1e-8 * s**2 * squared) ** 2)
    total = np.sqrt(sum(abs(f["z"].response(frequency)) ** 2 for f in found))
    assert np.allclose(total, expected, rtol=0.02)


@pytest.mark.parametrize("certificate", [{}, {"valid_from": 0.5}])
@pytest.mark.parametrize("zeros", [[-900.0, 2500.0], [-300 + 700j, -300 - 700j]])
@pytest.mark.parametrize("extra", [0, 1])
def test_a_numerator_of_the_degree_of_the_denominator_has_sensitivities(
    certificate: dict[str, float], zeros: list[complex], extra: int
) -> None:
    """Every parameter in play, and a further coefficient that is zero and fixed."""
    poles = [-500 + 1200j, -500 - 1200j, *[-2000.0] * extra]
    rising, falling = (np.real(polynomial.polyfromroots(roots)) for roots in (zeros, poles))
    padded = np.append(rising, np.zeros(extra)) * falling[0] / rising[0]
    g = TransferFunction.from_ascending(padded, falling, 0.3e-3)
    values = np.concatenate([g.numerator, g.denominator[1:], [g.delay]])
    deviations = 1e-3 * values
    if not certificate:
        deviations[0] = 0.0
    known = calibration(np.diag(deviations**2), dynamics=g, certificate=certified_by(certificate))
    frequency = np.array([1.0, 10.0, 40.0])
    total = sum(abs(f["z"].response(frequency)) ** 2 for f in sensitivity_filters(known, PERIOD))
    m = len(g.numerator)

    def varied(j: int, by: float) -> np.ndarray:
        moved = values + by * (np.arange(len(values)) == j)
        return TransferFunction(moved[:m], np.r_[1.0, moved[m:-1]], moved[-1]).response(frequency)

    expected = sum(
        abs(varied(j, d) - varied(j, -d)) ** 2 / 4 for j, d in enumerate(deviations) if d
    )
    if certificate:
        ratio = frequency / certificate["valid_from"]
        expected = expected * ratio**2 / (1 + ratio**2)
    assert np.allclose(np.sqrt(total), np.sqrt(expected), rtol=0.02)


def test_a_known_response_needs_no_filters() -> None:
    assert sensitivity_filters(calibration(np.zeros((7, 7))), PERIOD) == []


def test_variances_of_readings_by_hand() -> None:
    sources = ErrorSources(
        probe_noise=2.0,
        probe_resolution=np.sqrt(12.0),
        encoder_noise=3.0,
        encoder_resolution=np.sqrt(12.0),
        vibration=5.0,
    )
    found = reading_variances(sources, 2.0, 0.5)
    expected = (16.0, 4.0, 36.0, 4.0, 25.0)
    assert list(found.values()) == pytest.approx(expected)


def test_variances_of_the_whole_scan_by_hand() -> None:
    sources = ErrorSources(
        static_gain=0.1, discretisation=5.0, pitch=2e-6, probe_latency=1e-3, motion_error=3.0
    )
    one, known = np.ones(2), calibration(np.zeros((7, 7)))
    points = ScanPoints(
        time=one, x=one, y=one, height=one, z=one, z_rate=np.array([0.0, 10.0]), b=one, c=one,
        distance=np.array([0.0, 4.0]),
    )  # fmt: skip
    acting = whole_scan_sources(known, sources, Geometry(abbe_arm=0.1), NOTHING_STATED)
    found = {source.name: source.variance(points) for source in acting}
    assert found["static_gain"] == pytest.approx([0.0, (0.4 / GAIN) ** 2])
    # A tenth of a metre off, a pitch of 2 µrad is 200 nm.
    assert found["pitch"] == pytest.approx((200e-9) ** 2, rel=1e-6, abs=0)
    assert found["probe_latency"] == pytest.approx([0.0, 1e-4])
    # Backlash counts where the axis stands, too.
    assert found["motion_error"] == pytest.approx([9.0, 9.0])
    assert set(found) == {"static_gain", "pitch", "probe_latency", "motion_error"}


def test_probe_latency_adds_its_uncertainty_times_the_speed() -> None:
    lag = 5e-6
    known = calibration(np.zeros((7, 7)))
    points = correct(known, Z, DISTANCE, ErrorSources(probe_latency=lag))
    moved = Z[points.sample] - points.dynamic_error
    speed = abs(np.gradient(moved, PERIOD))
    inner = slice(5, -5)
    expected = lag * speed
    assert np.allclose(points.uncertainty[inner], expected[inner], atol=0.01 * max(expected))


def test_lateral_uncertainty_counts_by_the_slope() -> None:
    points = correct(calibration(np.zeros((7, 7))), Z, DISTANCE, ErrorSources(probe_noise=3e-9))
    points = replace(points, x=np.full(len(points), 6e-3), y=np.full(len(points), 8e-3))
    bowl = with_lateral_uncertainty(points, Sphere(0.1), 1e-6)
    # tan of the angle whose sine is 10 mm / 100 mm.
    slope = 0.1 / np.sqrt(0.99)
    assert np.allclose(bowl.uncertainty, np.hypot(3e-9 / GAIN, slope * 1e-6), rtol=1e-5)
    assert np.all(
        with_lateral_uncertainty(points, PAPER_MIRROR, 0.0).uncertainty == points.uncertainty
    )


def test_the_certificate_tells_noise_and_gain() -> None:
    known = calibration(
        np.zeros((7, 7)),
        certificate=certified_by({"noise_m": 11e-9, "static_gain_uncertainty": 3e-5}),
    )
    # Any part of the lag may be latency.
    lag = G.low_frequency_delay / np.sqrt(3)
    expected = ErrorSources(probe_noise=11e-9, static_gain=3e-5, probe_latency=lag)
    assert ErrorSources.of(known) == expected


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vibration", np.nan),
        ("vibration", np.inf),
        *((f.name, -1e-9) for f in fields(ErrorSources)),
    ],
)
def test_a_senseless_uncertainty_is_named(name: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=name):
        ErrorSources(**{name: value})


def test_what_nobody_stated_is_no_source():
    assert all(getattr(ErrorSources(), field.name) == 0.0 for field in fields(ErrorSources))
