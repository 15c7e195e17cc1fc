"""Exposure from amplitudes that fall with speed; vibration removed in the accelerometer's phase.

Scans and accelerations are made here in plain numpy: a texture averaged over the exposure by a sum,
a vibration sampled at 1 and 10 kHz.
"""

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.ripple.accelerometer import acceleration_lines, accelerations_of
from omsm_ros.core.ripple.exposure import (
    Exposure,
    PassingTexture,
    declared_exposure,
    estimate_exposure,
    passing_frequency,
    passing_textures,
    spot_share,
)
from omsm_ros.core.ripple.ripple_guard import analyse_scans, name_lines
from omsm_ros.core.ripple.scan_signal import scan_signal
from omsm_ros.core.ripple.vibration_removal import REMOVED, remove_vibrations
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.errors import ConfigurationError

RADIUS, WAVES = 6e-3, 2371
RATE = 1000.0


def circle(rpm, seconds=4.0, exposure=0.0, noise=2e-9, seed=1, added=0.0, marks=11e-9, wander=0.0):
    """Return a signal of marks, each reading the mean of 200 instants of its exposure.

    wander: amplitude of the spindle's angle beside its steady turning [rad]
    """
    time = np.arange(int(seconds * RATE)) / RATE
    within = (np.arange(200) + 0.5) / 200 * exposure - exposure

    def angle(at):
        return 2 * np.pi * rpm / 60 * at + wander * np.sin(2 * np.pi * 1.3 * at)

    phase = WAVES * angle(time[:, np.newaxis] + within)
    height = 2**0.5 * marks * np.mean(np.cos(phase), axis=1)
    height = height + np.random.default_rng(seed).normal(0, noise, len(time)) + added
    sample = np.arange(len(time))
    axes = (sample, np.full(len(time), RADIUS), np.zeros(len(time)), angle(time))
    return scan_signal(f"{rpm} rpm", 1 / RATE, (sample, height), axes)


@pytest.mark.parametrize(
    ("exposure", "wander"), [*soaked((0.4e-3, 0.0), (1e-3, 0.0)), (0.4e-3, 1e-4)]
)
def test_the_exposure_is_found_and_undone(exposure, wander):
    """A spindle that wanders by a twentieth of a wave would cost 2 % of an amplitude over time."""
    signals = [
        circle(rpm, exposure=exposure, seed=k, wander=wander)
        for k, rpm in enumerate((1.875, 15.0, 30.0))
    ]
    studied = analyse_scans([(signal, None) for signal in signals])
    pairs = list(zip(studied, name_lines(studied), strict=True))
    found = estimate_exposure(passing_textures(pairs), 1e-3)
    assert found.resolved
    assert found.seconds == pytest.approx(exposure, abs=4 * found.uncertainty)
    assert found.uncertainty < 0.02e-3
    wave = 2 * np.pi * RADIUS / WAVES
    for scan, named in pairs:
        line = max((row.line for row in named), key=lambda one: one.amplitude)
        passing = passing_frequency(scan.signal, wave)
        on_part, sigma = found.undone(
            passing, 0.0, wave, line.amplitude, line.amplitude_uncertainty
        )
        assert on_part == pytest.approx(2**0.5 * 11e-9, abs=4 * sigma)
        assert sigma < 0.6e-9


def test_the_uncertainty_of_the_exposure_is_that_of_the_amplitudes():
    """σ of a ratio of amplitudes over the slope of sinc, also finer than the first search."""
    fast, true, sigma = 1200.0, 0.5e-3, 1e-12
    share = np.sinc(fast * true)
    texture = PassingTexture(
        [np.array([1e-3]), np.array([fast])], 1e-8 * np.array([1.0, share]), np.full(2, sigma)
    )
    found = estimate_exposure([texture], 1e-3)
    slope = (np.cos(np.pi * fast * true) - share) / true
    assert found.seconds == pytest.approx(true, abs=2 * found.uncertainty)
    expected = 1e-4 * np.hypot(1, share) / abs(slope)
    assert found.uncertainty == pytest.approx(expected, rel=0.05)
    assert expected < 0.1e-6


def test_amplitudes_that_do_not_fall_give_a_limit_only():
    flat = PassingTexture(
        [np.array([20.0]), np.array([200.0])], np.full(2, 1e-8), np.full(2, 2e-10)
    )
    found = estimate_exposure([flat], 1e-3)
    assert not found.resolved
    # (π f T)²/6 of the amplitude is below two σ of a difference of both.
    assert found.longest == pytest.approx(np.sqrt(6 * 2 * 2**0.5 * 0.02) / np.pi / 200, rel=0.05)
    assert found.undone(np.array([200.0]), 0.0, 1e-5, 1e-8, 1e-10) is None
    assert estimate_exposure([PassingTexture([np.ones(1)], np.ones(1), np.ones(1))], 1e-3) is None


def test_two_exposures_that_do_alike_are_not_resolved():
    """|sinc| of 0.5 is that of 1.13 and others: two speeds far apart leave several."""
    fast = np.array([1500.0])
    size = 1e-8 * abs(np.sinc(1500 * 1.6e-3))
    found = estimate_exposure(
        [PassingTexture([np.array([10.0]), fast], np.array([1e-8, size]), np.full(2, 2e-10))], 1e-3
    )
    assert not found.resolved
    with pytest.raises(ConfigurationError, match="exposure"):
        declared_exposure(-1.0)
    known = declared_exposure(1e-3)
    assert isinstance(known, Exposure)
    assert known.undone(np.array([1000.0]), 0.0, 1e-5, 1e-9, 1e-10) is None  # a zero of sinc


def test_the_spot_is_the_mean_over_a_disc():
    x, y = np.meshgrid(*[np.linspace(-0.9e-6, 0.9e-6, 801)] * 2)
    inside = np.hypot(x, y) <= 0.9e-6
    for wave in (15e-6, 5e-6):
        mean = np.mean(np.cos(2 * np.pi * x[inside] / wave))
        assert spot_share(wave, 1.8e-6) == pytest.approx(mean, abs=1e-3)
    assert spot_share(15e-6, 1.8e-6) == pytest.approx(1 - 0.0177, abs=2e-4)


def shaken(time, frequency, size, wander=0.0, fast=1.0):
    """Return a vibration [m] at ``time``, of slowly wandering phase."""
    slow = wander * np.sin(2 * np.pi * 0.13 * time * fast)
    return size * np.cos(2 * np.pi * frequency * time * fast + 0.7 + slow)


def recorded(frequency, size, wander=0.0, ppm=0.0, seconds=4.0, noise=0.02, late=0):
    """Return blocks of an accelerometer at 10 kHz; ``ppm``: by which its clock is fast."""
    time = (np.arange(int(seconds * 1e4)) + late) / 1e4 * (1 - ppm * 1e-6)
    omega = 2 * np.pi * frequency
    z = -(omega**2) * shaken(time, frequency, size, wander) if size else np.zeros(len(time))
    random = np.random.default_rng(9).normal(0, noise, (3, len(time)))
    return [AccelerationBlock(
        stamp_ns=0, first_sample=late, sample_period=1e-4, x=random[0], y=random[1],
        z=z + random[2],
    )]  # fmt: skip


def cleaned(signal, blocks):
    studied = analyse_scans([(signal, acceleration_lines(*accelerations_of(blocks)))])[0]
    return studied, remove_vibrations(studied, signal.time, blocks)


@pytest.mark.parametrize(
    ("wander", "ppm", "late"), [(0, 0, 0), (0, 80, 0), (0, 0, 3000), *soaked((0.5, 0, 0))]
)
def test_the_aliased_vibration_is_removed_and_the_marks_stay(wander, ppm, late):
    time = np.arange(4000) / RATE
    # An exposure lowers it to 0.39 and is part of the gain, as in a probe.
    added = 0.39 * shaken(time, 680.0, 12e-9, wander)
    signal = circle(15.0, exposure=1e-3, added=added)
    _, found = cleaned(signal, recorded(680.0, 12e-9, wander, ppm, late=late))
    done = [one for one in found if one.outcome == REMOVED]
    if wander:
        assert sum(one.amplitude for one in done) == pytest.approx(4.7e-9, rel=0.05)
    else:
        assert len(done) == 1
        assert done[0].frequency == pytest.approx(680 * (1 - ppm * 1e-6), abs=0.01)
        assert done[0].gain == pytest.approx(0.39, rel=0.03)
        assert done[0].clock_ppm == pytest.approx(ppm, abs=10)
    removed = sum(one.removed for one in done)
    covered = time >= late / 1e4
    assert np.std((removed - added)[covered]) < 0.2e-9
    # The image of the marks, 407 Hz, keeps its amplitude.
    wave = np.exp(-2j * np.pi * WAVES * 0.25 * time)
    before, after = (2 * abs(np.mean(h * wave)) for h in (signal.height, signal.height - removed))
    assert after == pytest.approx(before, rel=0.01)


@pytest.mark.soak
def test_a_modulated_vibration_is_one_line():
    """Sidebands at three resolutions, as of a spindle, are removed with their line."""
    time = np.arange(20_000) / RATE
    wave = (1 + 0.3 * np.cos(2 * np.pi * 0.15 * time)) * shaken(time, 709.6, 4e-9, fast=1 + 6e-5)
    signal = circle(15.0, seconds=20.0, added=wave)
    at = np.arange(200_000) / 1e4
    seen = (1 + 0.3 * np.cos(2 * np.pi * 0.15 * at)) * shaken(at, 709.6, 4e-9)
    z = -((2 * np.pi * 709.6) ** 2) * seen + np.random.default_rng(3).normal(0, 2e-3, len(at))
    zero = np.zeros(len(at))
    block = AccelerationBlock(stamp_ns=0, first_sample=0, sample_period=1e-4, x=zero, y=zero, z=z)
    _, found = cleaned(signal, [block])
    (done,) = (one for one in found if one.outcome == REMOVED)
    assert done.amplitude == pytest.approx(4e-9 * (1 + 0.3**2 / 2) ** 0.5, abs=3 * done.uncertainty)
    left = wave - done.removed
    assert np.std(left) < 0.1e-9
    assert 2 * abs(np.mean(left * np.exp(2j * np.pi * 290.357 * time))) < done.left


def test_nothing_is_removed_where_there_is_no_line():
    """Neither with a quiet accelerometer, nor with one whose line the heights do not have.

    592.4 Hz has its alias 0.35 Hz beside the image of the marks, at 407.25 Hz.
    """
    signal = circle(15.0, exposure=1e-3)
    for blocks in (recorded(680.0, 0.0), recorded(743.21, 12e-9), recorded(592.4, 12e-9)):
        _, found = cleaned(signal, blocks)
        assert [one for one in found if one.outcome == REMOVED] == []
        assert all(not len(one.removed) for one in found)


def test_a_line_among_the_waves_of_form_is_left_alone():
    """Z follows the form twice a turn, and the accelerometer feels it; the form is the part's."""
    time = np.arange(4000) / RATE
    signal = circle(120.0, added=shaken(time, 20.0, 50e-9))
    _, found = cleaned(signal, recorded(20.0, 50e-9, noise=1e-6))
    assert [one.outcome for one in found if abs(one.frequency - 20) < 1] == ["like_form"]
