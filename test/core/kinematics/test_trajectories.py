import numpy as np
import pytest

from benchmarks.free_path import Multisine
from benchmarks.step_test import StepTest
from omsm_ros.core.kinematics.trajectories import Chirp, Circle, Spiral, s_curve
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.errors import ConfigurationError


def test_s_curve_is_limited_in_jerk():
    phase = np.linspace(0, 1, 4001)
    position = s_curve(phase)
    assert position[0] == 0
    assert position[-1] == 1
    assert position[2000] == pytest.approx(0.5)
    jerk = np.diff(position, 3) / (phase[1] - phase[0]) ** 3
    away_from_switching = np.abs((phase[1:-2] % 0.25) - 0.125) < 0.12
    np.testing.assert_allclose(abs(jerk[away_from_switching]), 32, rtol=1e-3)
    assert abs(jerk).max() < 32.1


def test_s_curve_rests_outside():
    np.testing.assert_array_equal(s_curve(np.array([-3.0, 1.0, 7.0])), [0, 1, 1])


@pytest.mark.parametrize("rise", [0.0, 20e-3])
def test_step_test_climbs_and_returns(rise):
    motion = StepTest(step=9e-6, count=3, dwell=0.1, rise=rise)
    assert motion.duration == pytest.approx(0.7)
    ends = motion.positions(np.arange(7) * 0.1 + 0.099).z
    np.testing.assert_allclose(ends / 9e-6, [0, 1, 2, 3, 2, 1, 0], atol=1e-12)
    assert motion.positions(np.array([-5.0])).z == 0


def test_default_step_test_stays_inside_the_probe():
    motion = StepTest()
    z = motion.positions(np.arange(0, motion.duration, 1e-3)).z
    assert np.ptp(z) < 100e-6


def test_spiral_runs_to_the_centre_over_the_surface():
    spiral = Spiral(PAPER_MIRROR, 12.7e-3, 1e-4, 30.0)
    assert spiral.duration == pytest.approx(254.0)
    time = np.linspace(0, spiral.duration, 1001)
    axes = spiral.positions(time)
    assert axes.x[-1] == pytest.approx(0, abs=1e-15)
    turns = np.ptp(axes.c) / (2 * np.pi)
    assert turns == pytest.approx(127)
    x = axes.x * np.cos(axes.c) + axes.y * np.sin(axes.c)
    y = -axes.x * np.sin(axes.c) + axes.y * np.cos(axes.c)
    np.testing.assert_array_equal(axes.z, PAPER_MIRROR.height(x, y))


def test_spiral_turns_at_constant_radius_before_it_starts():
    spiral = Spiral(Flat(), 5e-3, 1e-4, -60.0)
    before = spiral.positions(np.array([-1.0, -0.5]))
    np.testing.assert_array_equal(before.x, [5e-3, 5e-3])
    np.testing.assert_allclose(before.c, [2 * np.pi, np.pi])


def test_circle_keeps_its_radius():
    circle = Circle(PAPER_MIRROR, 6e-3, 30.0, turns=2)
    assert circle.duration == pytest.approx(4.0)
    np.testing.assert_array_equal(circle.positions(np.linspace(0, 4, 9)).x, np.full(9, 6e-3))


def test_chirp_rises_linearly_in_frequency():
    chirp = Chirp(peak_to_peak=2.0, start_frequency=1.0, end_frequency=5.0, duration=10.0)
    time = np.linspace(0, 10, 200_001)
    turns = np.unwrap(np.arccos(np.clip(chirp.positions(time).z, -1, 1)))
    crossings = np.sum(np.diff(np.sign(chirp.positions(time).z)) != 0)
    assert crossings / 2 == pytest.approx(0.5 * (1 + 5) * 10, abs=0.5)
    assert np.ptp(turns) > 0


def test_a_multisine_has_its_lines_and_no_others():
    motion = Multisine(frequencies=(2.0, 3.0, 7.0), amplitude=2e-6, duration=10.0)
    z = motion.positions(np.arange(10_000) * 1e-3).z
    lines = 2 * np.abs(np.fft.rfft(z)) / len(z)
    np.testing.assert_allclose(lines[[20, 30, 70]], 2e-6)
    lines[[20, 30, 70]] = 0.0
    assert np.max(lines) < 1e-15


@pytest.mark.parametrize(
    "make", [lambda: Spiral(Flat(), 0.0, 1e-4, 30.0), lambda: Spiral(Flat(), 1e-3, 1e-4, 0.0)]
)
def test_impossible_motions_are_refused(make):
    with pytest.raises(ConfigurationError):
        make()


def test_the_usual_chirp_is_the_papers():
    """0 to 15 Hz in 25 s, 40 µm peak to peak: 187.5 swings, each of which crosses zero twice."""
    chirp = Chirp()
    z = chirp.positions(np.linspace(0.0, 25.0, 500_001)).z
    assert chirp.duration == 25.0
    assert np.ptp(z) == pytest.approx(40e-6, rel=1e-6)
    assert np.sum(np.diff(np.sign(z)) != 0) == 375
