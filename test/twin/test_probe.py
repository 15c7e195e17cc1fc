"""Readings of the probe for distance, slope and light, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import Status
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.probe import LEVEL, Probe, ProbeErrors, Slope, read, slope_of

QUIET = Probe(scale=1.0, noise=0.0, resolution=0.0)
DISTANCE = np.linspace(-49e-6, 49e-6, 2001)


def _read(errors, distance=DISTANCE, slope=LEVEL, probe=QUIET):
    random = {"probe": np.random.default_rng(1), "dropout": np.random.default_rng(2)}
    return read(probe, errors, distance, slope, 1e-3, random)


def test_linearity_cubic_and_periodic():
    errors = ProbeErrors(cubic_m=50e-9, periodic_m=20e-9, period_m=9.8e-6)
    cubic = 50e-9 * (DISTANCE / 50e-6) ** 3
    wave = 20e-9 * np.sin(2 * np.pi * DISTANCE / 9.8e-6)
    np.testing.assert_allclose(_read(errors).distance - DISTANCE, cubic + wave, atol=1e-18)


def test_the_scale_is_on_top_of_the_linearity():
    half = Probe(scale=0.5, noise=0.0, resolution=0.0)
    found = _read(ProbeErrors(cubic_m=50e-9), probe=half).distance
    np.testing.assert_allclose(found, 0.5 * (DISTANCE + 50e-9 * (DISTANCE / 50e-6) ** 3))


def test_slope_of_a_sphere_is_position_over_height_of_the_centre():
    r, c = 0.1, 0.7
    x, y = np.array([3e-3, -5e-3, 0.0]), np.array([1e-3, 4e-3, 0.0])
    slope = slope_of(Sphere(r), x, y, np.full(3, c))
    depth = np.sqrt(r**2 - x**2 - y**2)
    # In the frame of the chuck the axes of the machine are (cos c, -sin c) and (sin c, cos c).
    np.testing.assert_allclose(slope.x, (x * np.cos(c) - y * np.sin(c)) / depth, atol=1e-8)
    np.testing.assert_allclose(slope.y, (x * np.sin(c) + y * np.cos(c)) / depth, atol=1e-8)
    np.testing.assert_allclose(slope.steepness, np.hypot(x, y) / depth, atol=1e-8)


def test_slope_errors_are_of_the_stated_size():
    slope = Slope(np.full(2001, 0.1), np.full(2001, 0.05))
    signed = _read(ProbeErrors(slope_error_m_per_rad=0.5e-6), slope=slope).distance - DISTANCE
    np.testing.assert_allclose(signed, 50e-9, atol=1e-18)
    square = _read(ProbeErrors(slope_error_m_per_rad2=5e-6), slope=slope).distance - DISTANCE
    np.testing.assert_allclose(square, 5e-6 * (0.1**2 + 0.05**2), atol=1e-18)


def test_light_falls_with_slope_and_noise_rises_as_it_falls():
    steep = Slope(np.repeat([0.0, 0.1, 0.2], 20_000), np.zeros(60_000))
    errors = ProbeErrors(intensity_slope_rad=0.2)
    loud = Probe(scale=1.0, noise=10e-9, resolution=0.0)
    found = _read(errors, np.zeros(60_000), steep, loud)
    light = np.exp(-np.array([0.0, 0.25, 1.0]))
    np.testing.assert_allclose(found.intensity[::20_000], 0.5 * light, rtol=1e-6)
    noise = found.distance.reshape(3, -1).std(axis=1)
    np.testing.assert_allclose(noise, 10e-9 / np.sqrt(light), rtol=0.03)


def test_no_target_where_it_is_too_steep():
    slope = Slope(np.linspace(0, 0.2, 2001), np.zeros(2001))
    found = _read(ProbeErrors(dropout_slope_rad=0.1), slope=slope)
    np.testing.assert_array_equal(found.ok, slope.x <= 0.1)
    assert np.all(np.isnan(found.distance[~found.ok]))
    assert set(found.status[~found.ok]) == {Status.NO_TARGET}
    assert np.all(found.intensity[~found.ok] == 0)


def test_dropouts_have_their_probability_and_leave_the_noise_alone():
    loud = Probe(noise=10e-9)
    zeros = np.zeros(50_000)
    with_some = _read(ProbeErrors(dropout_probability=0.02), zeros, probe=loud)
    without = _read(ProbeErrors(), zeros, probe=loud)
    assert np.mean(~with_some.ok) == pytest.approx(0.02, rel=0.1)
    ok = with_some.ok
    np.testing.assert_array_equal(with_some.distance[ok], without.distance[ok])


def test_the_looks_of_an_exposure_stand_for_its_mean():
    errors = ProbeErrors(latency_s=0.1e-3, exposure_s=0.2e-3, averages=3)
    before, weight = errors.exposure_instants()
    assert weight.sum() == pytest.approx(1.0)
    assert before.min() > 0.1e-3
    assert before.max() < 0.7e-3
    assert errors.lag_s == pytest.approx(0.4e-3)
    for power in range(8):
        exact = (0.7e-3 ** (power + 1) - 0.1e-3 ** (power + 1)) / (0.6e-3 * (power + 1))
        assert weight @ before**power == pytest.approx(exact, rel=1e-12, abs=0)
    # Marks of 15.9 µm of the paper's scan F4: 1186 Hz, of which an exposure leaves sinc(f T).
    before, weight = ProbeErrors(exposure_s=1e-3).exposure_instants()
    share = weight @ np.cos(2 * np.pi * 1186.0 * (before - 0.5e-3))
    assert share == pytest.approx(np.sinc(1.186), abs=1e-5)


def test_what_sees_no_slope_says_so():
    assert not ProbeErrors(latency_s=1e-3, cubic_m=1e-9).is_slope_sensitive
    assert ProbeErrors(dropout_slope_rad=0.1).is_slope_sensitive
    slope = slope_of(PAPER_MIRROR, np.zeros(1), np.zeros(1), np.zeros(1))
    assert abs(slope.x[0]) < 1e-9


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"exposure_s": -1e-3}, "exposure_s"),
        ({"exposure_s": 2.0}, "exposure_s"),
        ({"averages": 0}, "averages"),
        ({"averages": 20, "exposure_s": 0.1}, "1 s at most together"),
        ({"latency_s": 1e9}, "latency_s"),
        ({"periodic_m": 20.0}, "give it in metres"),
        ({"dropout_probability": 1.5}, "dropout_probability"),
        ({"intensity_slope_rad": 0.0}, "intensity_slope_rad"),
        ({"cubic_m": np.nan}, "cubic_m"),
    ],
)
def test_sizes_that_cannot_be_are_named(wrong, name):
    with pytest.raises(ConfigurationError, match=name):
        ProbeErrors(**wrong)
