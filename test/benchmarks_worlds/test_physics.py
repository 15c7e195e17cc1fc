"""The simulated machine obeys closed forms and reproduces the figures of the paper's system."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.worlds import effects
from benchmarks.worlds.dynamics import LinearSystem, backlash, presliding
from benchmarks.worlds.machine import Machine
from benchmarks.worlds.part import Flat, OffAxisParaboloid, Part, Pose, Sphere, Toric, slopes
from benchmarks.worlds.scans import scan, spiral, step_test, steps

STIFF = LinearSystem((1.0,), (1.0,))
IDEAL = Machine(structure=STIFF, servo=STIFF)
SMALL = Part(radius=4e-3)


def error(machine, part=SMALL, rpm=30.0, direction="in", pose=None, feed=3e-4):
    """Return recording and raw height minus true height."""
    clocking = pose.clocking if pose else 0.0
    path = spiral(part, rpm, direction, clocking, feed)
    recording = scan(machine, part, path, pose=pose)
    return recording, recording.raw_height - recording.height


def weighted_rms(value, weight):
    mean = np.sum(weight * value) / np.sum(weight)
    return np.sqrt(np.sum(weight * (value - mean) ** 2) / np.sum(weight))


@pytest.mark.parametrize("shape", [Sphere(0.1), Toric(0.15, 0.2)])
def test_curvature_at_the_vertex(shape):
    """Near the vertex the sag is r²/2R along each axis."""
    d = 1e-4
    along_y = 0.1 if isinstance(shape, Sphere) else 0.2
    along_x = 0.1 if isinstance(shape, Sphere) else 0.15
    assert shape.height(d, 0.0) == pytest.approx(d**2 / (2 * along_x), rel=1e-5)
    assert shape.height(0.0, d) == pytest.approx(d**2 / (2 * along_y), rel=1e-5)


def test_paraboloid_lies_on_its_parent():
    """Points of the off-axis piece fulfil X² + Y² = 4 f Z; along y its sag is 1.127 mm."""
    shape = OffAxisParaboloid()
    angle = np.linspace(0, 2 * np.pi, 361)
    x, y = 12.7e-3 * np.cos(angle), 12.7e-3 * np.sin(angle)
    h = shape.height(x, y)
    far = 50.8e-3 + (x - h) / np.sqrt(2)
    up = 25.4e-3 + (x + h) / np.sqrt(2)
    np.testing.assert_allclose(far**2 + y**2, 4 * 25.4e-3 * up, rtol=1e-12)
    assert shape.height(0.0, 12.7e-3) == pytest.approx(1.127e-3, abs=5e-7)


def test_equation_12():
    """Gain and phase of Eq. 12 at the frequencies of the reference table."""
    answer = LinearSystem.paper(unit_gain=False).at(np.array([1.0, 15.0, 100.0]))
    np.testing.assert_allclose(np.abs(answer), [0.992125, 0.991804, 0.977985], atol=1e-6)
    np.testing.assert_allclose(np.degrees(np.angle(answer)), [-0.1223, -1.83556, -12.5635], 1e-4)


def test_integration_follows_the_response():
    """A sine comes out with gain and phase of the transfer function."""
    system = LinearSystem.paper().after(LinearSystem.side_mode(40.0, 0.2, 0.1))
    dt, f = 5e-5, 15.0
    t = dt * np.arange(40_000)
    out = system.respond(np.sin(2 * np.pi * f * t), dt)[20_000:]
    expected = np.imag(system.at(f) * np.exp(2j * np.pi * f * t[20_000:]))
    assert np.abs(out - expected).max() < 5e-6


@pytest.mark.parametrize(
    ("unit_gain", "pv", "rms"), [(False, 8.95e-6, 2.15e-6), (True, 1.23e-6, 0.25e-6)]
)
def test_dynamic_error_on_the_papers_mirror(unit_gain, pv, rms):
    """Scan the 25.4 mm circle at 30 rpm, 0.1 mm a turn: 254 000 points and the known error."""
    part = Part()
    machine = replace(IDEAL, structure=LinearSystem.paper(unit_gain))
    recording, wrong = error(machine, part, feed=1e-4)
    assert len(recording.t) == 254_000
    assert np.ptp(wrong) == pytest.approx(pv, abs=5e-9)
    assert weighted_rms(wrong, recording.x) == pytest.approx(rms, abs=5e-9)


def test_step_error_of_the_papers_machine():
    """A critically damped 200 Hz axis that steps 10 µm through Eq. 12: 2.288 and 0.079 µm."""
    machine = Machine(structure=LinearSystem.paper(unit_gain=False), sampling=20e3)
    path = steps((10e-6,), count=1, dwell=0.1, edge=0.0, centred=False)
    height = step_test(replace(machine, reference_noise=0.0), path).raw_height
    start = height[1900]
    step = height[1950:3900] - start
    assert np.abs(step).max() == pytest.approx(2.288e-6, abs=2e-9)
    assert step[-1] == pytest.approx(0.079e-6, abs=1e-9)


def test_distance_falls_when_z_rises():
    recording = step_test(IDEAL, steps((10e-6,), count=2))
    assert np.polyfit(recording.z, recording.distance, 1)[0] == pytest.approx(-1, abs=1e-9)


@pytest.mark.parametrize("direction", ["in", "out"])
@pytest.mark.parametrize("rpm", [30.0, -60.0])
def test_lag_is_time_times_rate(direction, rpm):
    """A pure lag of Z changes the height by τ dz/dt, in each direction."""
    tau = 1e-4
    machine = IDEAL.plus("structure", effects.lagging(lambda now: tau))
    recording, wrong = error(machine, direction=direction, rpm=rpm)
    expected = tau * np.gradient(recording.z, 1e-3)
    assert np.abs(expected).max() > 1e-8
    assert np.abs(wrong - expected)[2:-2].max() < 1e-3 * np.abs(expected).max()


def test_latency_does_not_show_where_z_follows():
    """A late probe gives the same height, for Z follows the surface without error."""
    _, wrong = error(replace(IDEAL, latency=3e-4))
    assert np.abs(wrong).max() < 1e-12
    _, wrong = error(replace(IDEAL, exposure=1e-3))
    assert np.abs(wrong).max() < 1e-12


def test_latency_shifts_what_z_does_not_follow():
    """On a tilted flat that Z does not follow, latency is τ times the rate of the distance."""
    pose = Pose(tilt=1e-3)
    part = Part(Flat(), radius=4e-3)
    recording, wrong = error(replace(IDEAL, latency=3e-4), part, pose=pose)
    expected = -3e-4 * np.gradient(recording.height, 1e-3)
    assert np.abs(wrong - expected)[2:-2].max() < 1e-3 * np.abs(expected).max()
    np.testing.assert_allclose(recording.height, -np.tan(1e-3) * recording.part_x, atol=1e-18)


def test_spindle_harmonic_adds_to_the_height():
    machine = IDEAL.plus("loop", effects.axial(3, 20e-9, 0.4))
    recording, wrong = error(machine)
    np.testing.assert_allclose(wrong, 20e-9 * np.cos(3 * recording.c + 0.4), atol=1e-14)


@pytest.mark.parametrize("along", ["x", "y"])
def test_centre_acts_by_the_slope(along):
    """An offset of the beam changes the height by the slope along the machine's axis."""
    offset = 1e-6
    machine = IDEAL.plus("place", effects.offset_beam(**{f"d{along}": offset}))
    r, wrong = error(machine)
    gx, gy = slopes(SMALL.nominal.height, r.x * np.cos(r.c), -r.x * np.sin(r.c))
    slope = {"x": gx * np.cos(r.c) - gy * np.sin(r.c), "y": gx * np.sin(r.c) + gy * np.cos(r.c)}
    np.testing.assert_allclose(wrong, offset * slope[along], atol=1e-11)
    assert np.abs(wrong).max() > 1e-9


def test_clocking_is_right_handed():
    """A part clocked by 0.3 shows at −C what the unclocked one shows at −C − 0.3."""
    r, wrong = error(IDEAL, pose=Pose(clocking=0.3))
    np.testing.assert_allclose(wrong, 0, atol=1e-14)
    np.testing.assert_allclose(r.part_x, r.x * np.cos(-r.c - 0.3), atol=1e-15)
    np.testing.assert_allclose(r.part_y, r.x * np.sin(-r.c - 0.3), atol=1e-15)


@pytest.mark.parametrize("clocking", [0.0, 0.7])
def test_a_slanted_beam_meets_the_same_place_where_z_follows(clocking):
    """Aside by slope × distance, which is zero however the part is clocked."""
    _, wrong = error(replace(IDEAL, beam=(2e-4, 2e-4)), pose=Pose(clocking=clocking))
    assert np.max(np.abs(wrong)) < 1e-12


@pytest.mark.parametrize("clocking", [0.0, 0.7])
def test_an_error_by_slope_follows_the_clocked_part(clocking):
    """The slope along X is that of the nominal surface at the place of the clocked part."""
    seen = []
    machine = IDEAL.plus("probe", lambda now, d: seen.append(now.slope[0]) or 0 * d)
    path = spiral(SMALL, 1e-3, "in", clocking, 3e-4)
    recording = scan(machine, SMALL, replace(path, duration=1.0), pose=Pose(clocking=clocking))
    x, c = recording.x, recording.c + clocking
    along = slopes(SMALL.nominal.height, x * np.cos(c), -x * np.sin(c))
    expected = along[0] * np.cos(c) - along[1] * np.sin(c)
    assert np.max(np.abs(seen[0] - expected)) < 1e-6 * np.max(np.abs(expected))


def test_late_latch_of_z():
    """A late latch of z looks like a lag of the same time."""
    r, wrong = error(replace(IDEAL, z_late=1e-4))
    expected = 1e-4 * np.gradient(r.z, 1e-3)
    assert np.abs(wrong - expected)[2:-2].max() < 1e-3 * np.abs(expected).max()


def test_backlash_and_friction_are_loops():
    """After a full reversal the output lags by half the play, or by the whole force."""
    t = np.linspace(0, 4 * np.pi, 20_001)
    z = 1e-4 * np.sin(t)
    late = (t > np.pi) & (np.abs(np.cos(t)) > 0.4)
    way = np.sign(np.cos(t))[late]
    np.testing.assert_allclose((z - backlash(z, 4e-8))[late], 2e-8 * way, atol=1e-20)
    np.testing.assert_allclose((z - presliding(z, 3e-8, 1e-6))[late], 3e-8 * way, atol=2e-11)


def test_scan_starts_without_the_servos_transient():
    """The servo's start has died away by the first trigger."""
    _, wrong = error(Machine(structure=STIFF))
    assert np.abs(wrong).max() < 1e-12
