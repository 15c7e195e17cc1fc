"""Residuals of scans that should agree, against waves and noise of known size."""

import numpy as np
import pytest

from omsm_ros.core.adjustment.blocks import Blocks
from omsm_ros.core.adjustment.self_calibration import (
    HARMONICS,
    RINGS,
    ScanConsistency,
    consistency_of,
)

TURNS, POINTS = 40, 2000
ANGLE = np.linspace(0.0, 2 * np.pi * TURNS, TURNS * POINTS, endpoint=False)
RADIUS = np.linspace(1e-3, 10e-3, len(ANGLE))
NOISE = 2e-9


def agreement(left, unit=1.0, turn=0.0, scans=None):
    """Return the agreement of residuals of each scan, readings one by one."""
    number = scans or len(left)
    zero = np.zeros(len(left) * len(ANGLE))
    place = np.tile(RADIUS * np.exp(1j * (ANGLE + turn)), len(left))
    blocks = Blocks(
        scan=np.repeat(np.arange(len(left)), len(ANGLE)), turn=zero.astype(int), since=zero,
        x=place.real, y=place.imag, span=zero, count=zero + 1, variance=zero + (unit * NOISE) ** 2,
        deviation=zero, turning=zero, columns=zero[:, np.newaxis],
        noise=np.full(number, unit * NOISE),
    )  # fmt: skip
    return consistency_of(blocks, unit * np.concatenate(left))


def scattered(wave, seed=1):
    random = np.random.default_rng(seed)
    return [sign * wave + random.normal(0.0, NOISE, len(ANGLE)) for sign in (1.0, -1.0)]


def test_noise_alone_is_what_is_expected_of_it():
    found = agreement(scattered(np.zeros(len(ANGLE))))
    assert found.noise == pytest.approx(NOISE, rel=0.01)
    # The ratio is the mean of exponential variables of mean one.
    assert found.ratio == pytest.approx(1.0, abs=4 / np.sqrt(2 * RINGS * HARMONICS))
    assert found.holds


@pytest.mark.parametrize("harmonic", [1, 3, HARMONICS])
def test_a_wave_around_the_axis_shows_with_its_rms(harmonic):
    size = 30e-9
    found = agreement(scattered(size * np.cos(harmonic * ANGLE + 0.7)))
    assert found.disagreement == pytest.approx(size / np.sqrt(2), rel=0.02)
    # A sum of n values a cos²: (a n/2)², over the variance n σ² of one of all the harmonics.
    expected = 1 + (size / NOISE) ** 2 * len(ANGLE) / RINGS / 4 / HARMONICS
    assert found.ratio == pytest.approx(expected, rel=0.05)
    assert not found.holds


def test_what_is_finer_than_the_harmonics_is_no_disagreement():
    found = agreement(scattered(30e-9 * np.cos((HARMONICS + 3) * ANGLE)))
    assert found.disagreement < 1e-9


LEFT = scattered(20e-9 * np.cos(3 * ANGLE))


@pytest.mark.parametrize(
    ("left", "other"),
    [
        (LEFT, {"unit": 1e9}),
        (LEFT[::-1], {}),
        ([-one for one in LEFT], {}),
        (LEFT, {"turn": 0.4}),
        (LEFT, {"scans": 3}),  # of the third no reading was used
    ],
)
def test_agreement_knows_no_unit_order_sign_or_beginning_of_the_angle(left, other):
    plain, found, unit = agreement(LEFT), agreement(left, **other), other.get("unit", 1.0)
    assert found.ratio == pytest.approx(plain.ratio, rel=1e-9)
    assert found.disagreement == pytest.approx(unit * plain.disagreement, rel=1e-9)
    assert found.noise == pytest.approx(unit * plain.noise, rel=1e-9)


@pytest.mark.parametrize(
    ("ratio", "disagreement", "holds"),
    [(1.0, 1e-6, True), (50.0, 0.1e-9, True), (50.0, 1e-6, False)],
)
def test_only_what_is_beyond_noise_and_visible_is_a_contradiction(ratio, disagreement, holds):
    assert ScanConsistency(ratio, disagreement, 1e-9).holds is holds
