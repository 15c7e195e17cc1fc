"""A chosen speed keeps modes quiet and vibration out of the form, in a scan of plain numpy."""

import numpy as np
import pytest

from omsm_ros.core.kinematics.limits import KnownOfMachine, choose_motion, harmonic_orders, margins
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat

ORDERS = np.arange(1.0, 4.0)


def left_of_a_vibration(frequency, rpm, rate=1000.0, turns=8):
    """Return what the mean of ``turns`` neighbouring turns leaves of a vibration of size 1, rms."""
    count = int(turns * 60 / rpm * rate)
    time = np.arange(count) / rate
    angle = np.floor(time * rpm / 60 % 1 * 400).astype(int)
    wave = np.exp(2j * np.pi * frequency * time)
    mean = np.bincount(angle, wave.real, 400) / np.bincount(angle, minlength=400)
    return float(np.std(mean))


def test_a_vibration_that_stands_still_on_the_part_is_moved():
    """680 Hz at 1 kHz and 30 rpm is 640 waves of each turn: averaging turns leaves it."""
    known = KnownOfMachine(lines=(680.0,))
    assert margins(30.0, 1e-4, 1000.0, ORDERS, known).phase == pytest.approx(0.0, abs=1e-9)
    chosen = choose_motion(30.0, 1e-4, [1000.0], ORDERS, known)
    assert chosen.score == 1.0
    assert abs(chosen.rpm - 30) < 1
    # A bin of 400 holds a wave and a half; so compare with a vibration of few waves a turn.
    assert left_of_a_vibration(1010.0, 30.0) > 0.6
    slow = choose_motion(30.0, 1e-4, [1000.0], ORDERS, KnownOfMachine(lines=(1010.0,)))
    assert left_of_a_vibration(1010.0, slow.rpm) < 0.25 * left_of_a_vibration(1010.0, 30.0)


def test_a_harmonic_is_moved_off_a_mode():
    """The third harmonic at 1.5 Hz meets a mode of 2 %: a gain of 25, by its closed form."""
    known = KnownOfMachine(modes=((1.5, 0.02),))

    def gain(rpm):
        r = ORDERS * rpm / 60 / 1.5
        return np.max(1 / np.abs(1 - r**2 + 2j * 0.02 * r))

    chosen = choose_motion(30.0, 1e-4, [1000.0], ORDERS, known)
    assert gain(30.0) == pytest.approx(25.0)
    assert gain(chosen.rpm) < 6
    assert chosen.harmonic >= 4.97


def test_an_alias_on_a_mode_needs_another_rate():
    known = KnownOfMachine(modes=((338.0, 0.05),), lines=(680.0,))
    alone = choose_motion(30.0, 1e-4, [1000.0], ORDERS, known)
    assert alone.image == pytest.approx(18 / (338 * 0.05))
    assert alone.score < 1
    both = choose_motion(30.0, 1e-4, [1000.0, 2000.0], ORDERS, known)
    assert (both.rate, both.score) == (2000.0, 1.0)


def test_marks_have_no_long_image():
    """Rings of 16 µm, crossed each 97 µm: their image repeats within four turns."""
    known = KnownOfMachine(marks=(16e-6,))
    chosen = choose_motion(30.0, 96e-6, [1000.0], ORDERS, known)
    assert margins(30.0, 96e-6, 1000.0, ORDERS, known).pitch == pytest.approx(0.0, abs=1e-9)
    assert 0.8 * 96e-6 <= chosen.feed < 96e-6
    turns = np.arange(64)
    seen = np.cos(2 * np.pi * turns * chosen.feed / 16e-6)
    smooth = np.convolve(seen, np.ones(4) / 4, "valid")
    assert np.max(np.abs(smooth)) < 0.45


def test_the_orders_of_z_are_those_of_the_surface():
    """The paraboloid has mostly the second, and the third by its slope along the axis."""
    orders = harmonic_orders(PAPER_MIRROR, 12.7e-3)
    assert list(orders[:3]) == [1, 2, 3]
    assert not len(harmonic_orders(Flat(), 1e-2))
    assert (
        choose_motion(30.0, 1e-4, [1000.0], harmonic_orders(Flat(), 1e-2), KnownOfMachine()).rpm
        == 30
    )
