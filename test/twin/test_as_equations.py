"""The twin once more as differential equations, integrated by scipy with a tight tolerance."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation

from benchmarks.twin_motions import respond
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.core.model_errors.families import dahl_friction
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.disturbances import VibrationLine
from omsm_ros.twin.part import AzimuthalRipple, PartPose
from omsm_ros.twin.plant import PAPER_DYNAMICS, Plant, TimeGrid, Trajectory, move
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.record_checks import is_default
from omsm_ros.twin.sensors import (
    AccelerationSensor,
    ClockErrors,
    EncoderErrors,
    Pitch,
    acceleration_of,
)
from omsm_ros.twin.structure import Creep, SoftMode, StructureErrors, backlash, deform, hardened

STEP = 1e-3
EXACT = {"rtol": 1e-9, "atol": 1e-16, "method": "LSODA"}


class Swing:
    """Two sines of 10 µm, from rest before time 0: smooth everywhere."""

    duration = 0.4

    def z(self, t):
        t = np.maximum(t, 0.0)
        return 1e-5 * (np.sin(60 * t) ** 2 + 0.3 * (1 - np.cos(2 * np.pi * 5 * t)))

    def positions(self, time):
        zero = np.zeros_like(time)
        return type(Chirp().positions(np.zeros(1)))(zero, zero, self.z(time), zero, zero)


def integrated(rate, states, times, start=0.0):
    """States at ``times`` of ``ds/dt = rate(t, s)``, from zero at ``start``."""
    found = solve_ivp(
        rate, (start, times[-1]), np.zeros(states), t_eval=times, max_step=2e-3, **EXACT
    )
    assert found.success
    return found.y


@pytest.mark.parametrize("bandwidth", [50.0, 200.0])
def test_servo_and_probe_obey_their_equations(bandwidth):
    """(1 + s/ω)² x = u;  a0 p + a1 p' + a2 p'' + a3 p''' = b0 x + b1 x' + b2 x''."""
    motion, plant = Swing(), Plant(servo_bandwidth=bandwidth)
    b, a = plant.dynamics.numerator, plant.dynamics.denominator
    omega = 2 * np.pi * bandwidth

    def rate(t, s):
        x, v, q0, q1, q2 = s
        # q is what all of the numerator acts on: a(d/dt) q = x, p = b(d/dt) q.
        q3 = (x - a[0] * q0 - a[1] * q1 - a[2] * q2) / a[3]
        return [v, omega**2 * (motion.z(t) - x) - 2 * omega * v, q1, q2, q3]

    times = np.arange(1, 150) * STEP
    x, _, q0, q1, q2 = integrated(rate, 5, times)
    # The error is of second order in the step: a quarter of the step leaves a picometre.
    found = respond(plant, motion, 150, STEP, substeps=64)
    np.testing.assert_allclose(found.slide[1:], x, atol=1.5e-12)
    np.testing.assert_allclose(found.probe[1:], b[0] * q0 + b[1] * q1 + b[2] * q2, atol=1.5e-12)


def swing(step=2e-4, lead=0.0):
    """Return a motion of half a millimetre on a grid that starts at standstill."""
    time = np.arange(-lead, 1.0, step)
    return Trajectory(-lead, step, Swing().z(time))


def test_what_creeps_and_swings_obeys_its_equations():
    """τ c' + c = p and m'' + 2ζω m' + ω² m = ω² p; each adds its part of what it lacks."""
    creep = Creep(fraction=0.01, time_constant_s=0.08)
    mode = SoftMode(frequency_hz=6.0, damping_ratio=0.1, participation=5e-3)
    probe, omega = swing(lead=1.0), 2 * np.pi * 6.0

    def rate(t, s):
        c, m, v = s
        p = Swing().z(t)
        return [(p - c) / creep.time_constant_s, v, omega**2 * (p - m) - 0.2 * omega * v]

    after = probe.times > 0
    c, m, _ = integrated(rate, 3, probe.times[after])
    p = probe.values[after]
    expected = p + 0.01 * (c - p) + 5e-3 * (m - p)
    errors = StructureErrors(creep=(creep,), soft_modes=(mode,))
    moved = deform(errors, (probe, probe), probe)
    np.testing.assert_allclose(moved.values[after], expected, atol=1e-12)


def test_friction_obeys_dahl_s_law_in_time():
    """dF/dt = (1 - F sgn ż) ż / z₀, through each reversal."""
    probe, presliding = swing(), 2e-6

    def rate(t, s):
        h = 1e-6
        speed = (Swing().z(t + h) - Swing().z(t - h)) / (2 * h)
        return [(speed - s[0] * abs(speed)) / presliding]

    times = probe.times[1:]
    (force,) = integrated(rate, 1, times)
    np.testing.assert_allclose(dahl_friction(probe.values, presliding)[0][1:], force, atol=2e-3)


def test_backlash_is_the_play_of_a_pin_in_a_slot():
    """The slot moves the pin only where it touches it, walked through in plain steps."""
    probe, width = swing(), 3e-6
    pin, walked = probe.values[0], []
    for position in probe.values:
        pin = min(max(pin, position - width / 2), position + width / 2)
        walked.append(pin)
    driven = backlash(probe, width)
    np.testing.assert_allclose(driven.values, walked, atol=1e-18)
    np.testing.assert_allclose(driven.at(probe.times), walked, atol=1e-18)
    # Between two steps of one direction it goes as its driver does; outside of the grid nothing is.
    middle = probe.times[100:-100] + probe.step / 2
    assert np.all(np.abs(driven.at(middle) - probe.at(middle)) <= width / 2 + 1e-15)


@pytest.mark.parametrize("scale", [1e-7, 1e-6])
def test_a_hardening_spring_carries_what_the_linear_one_does(scale):
    linear = np.linspace(-5e-6, 5e-6, 101)
    found = hardened(linear, scale)
    np.testing.assert_allclose(found + found**3 / scale**2, linear, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(found, -hardened(-linear, scale), atol=1e-20)


def test_pitch_under_acceleration_is_a_mode_that_is_shaken():
    """α'' + 2ζω α' + ω² α = k ω² z'', of which the encoder sees the arm's part."""
    pitch = Pitch(arm_m=0.1, rad_per_m_s2=2e-6, frequency_hz=15.0, damping_ratio=0.2)
    omega, slide = 2 * np.pi * 15.0, swing()

    def rate(t, s):
        a, w = s
        z = Swing().z(t)
        # In the form that needs no derivative of z: β = α - k ω² z.
        beta = a
        total = beta + 2e-6 * omega**2 * z
        return [w - 0.4 * omega * total, -(omega**2) * total]

    beta, _ = integrated(rate, 2, slide.times[1:])
    angle = beta + 2e-6 * omega**2 * slide.values[1:]
    np.testing.assert_allclose(pitch.angle(slide)[1:], angle, atol=2e-4 * np.ptp(angle))
    # A place to begin with is no acceleration.
    moved = Trajectory(0.0, slide.step, slide.values + 0.05)
    np.testing.assert_allclose(pitch.angle(moved), pitch.angle(slide), atol=1e-12)
    seen = EncoderErrors(pitch=pitch).seen(slide).values - slide.values
    np.testing.assert_allclose(seen[1:], 0.1 * angle, atol=2e-5 * np.ptp(angle))


def test_an_accelerometer_feels_the_second_derivative_through_its_high_pass():
    """y' = a' - y / τ, and a = d²z/dt² of a sine."""
    omega, amplitude, tau = 2 * np.pi * 3.0, 1e-3, 1 / (2 * np.pi * 0.5)
    motion = Trajectory(0.0, STEP, amplitude * np.sin(omega * np.arange(3000) * STEP))
    acceleration_lines = acceleration_of(motion)
    expected = -(omega**2) * motion.values[1:-1]
    np.testing.assert_allclose(acceleration_lines.values, expected, atol=1e-3 * np.ptp(expected))

    def rate(t, s):
        a = -(omega**2) * amplitude * np.sin(omega * (t + STEP))
        return [a - s[0] / tau]

    quiet = AccelerationSensor(noise_m_per_s2=0.0, cross_talk=0.02, scale_ppm=500.0)
    block = quiet.read(acceleration_lines.values, STEP, np.random.default_rng(1))
    times = np.arange(1, len(acceleration_lines.values)) * STEP
    (held,) = integrated(rate, 1, times)
    passed = (acceleration_lines.values[1:] - held / tau) * 1.0005
    np.testing.assert_allclose(block.z[1:], passed, atol=5e-3 * np.ptp(passed))
    np.testing.assert_allclose(block.x, 0.02 * block.z, atol=1e-15)


@pytest.mark.parametrize(("exposure", "averages"), [(0.0, 1), (2e-4, 1), (2e-4, 4)])
def test_the_looks_of_an_exposure_are_its_integral(exposure, averages):
    errors = ProbeErrors(latency_s=1e-4, exposure_s=exposure, averages=averages)
    before, weight = errors.exposure_instants()
    window = exposure * averages
    assert weight.sum() == pytest.approx(1.0, abs=1e-14)
    assert errors.lag_s == pytest.approx(1e-4 + window / 2)

    def seen(t):
        return np.sin(2 * np.pi * 300.0 * t + 0.4)

    at = 0.0123
    found = float(weight @ seen(at - before))
    if not window:
        assert found == seen(at - 1e-4)
        return
    mean, _ = quad(seen, at - 1e-4 - window, at - 1e-4, epsabs=1e-13)
    assert found == pytest.approx(mean / window, abs=1e-7)


@pytest.mark.parametrize("exposure", [0.0, 1e-3, 5e-3])
def test_a_line_in_an_exposure_is_its_mean(exposure):
    """Free and in step with the spindle at once, by the integral."""
    line = VibrationLine(amplitude_m=1e-7, frequency_hz=90.0, per_turn=12.0, phase_rad=0.7)
    speed, middle = 3.0, np.array([0.2, 0.5])
    c = speed * middle
    found = line.height(middle, c, exposure, np.full(2, speed * exposure))
    for at, height in zip(middle, found, strict=True):

        def seen(t):
            return 1e-7 * np.sin(2 * np.pi * 90.0 * t + 12.0 * speed * t + 0.7)

        mean = seen(at)
        if exposure:
            mean = quad(seen, at - exposure / 2, at + exposure / 2, epsabs=1e-18)[0] / exposure
        assert height == pytest.approx(mean, abs=1e-15)
    h = 1e-5
    three = [line.height(middle + k * h, speed * (middle + k * h), 0.0) for k in (-1, 0, 1)]
    second = (three[0] - 2 * three[1] + three[2]) / h**2
    shaken = line.acceleration(middle, c, np.full(2, speed))
    np.testing.assert_allclose(shaken, second, rtol=1e-4)


def test_a_line_needs_a_frequency_or_an_order():
    with pytest.raises(ConfigurationError, match="both zero"):
        VibrationLine(amplitude_m=1e-9)
    VibrationLine(amplitude_m=1e-9, per_turn=-2.0)


@pytest.mark.parametrize("angles", [(1e-3, 0, 0), (0, -2e-3, 0), (0, 0, 0.5), (0.1, 0.2, -0.3)])
def test_a_pose_turns_about_x_then_y_then_z(angles):
    pose = PartPose(tilt_x_rad=angles[0], tilt_y_rad=angles[1], clocking_rad=angles[2])
    # Lower case: about axes that stand still.
    expected = Rotation.from_euler("xyz", angles).as_matrix()
    np.testing.assert_allclose(pose.rotation, expected, atol=1e-15)


def test_azimuthal_ripple_is_two_waves_of_whole_number_on_a_circle():
    class Tilted:
        def height(self, x, y):
            return 1e-3 * x

    marks = AzimuthalRipple(Tilted(), radius=2e-3, wavelength=0.5e-3, rms=20e-9, second=0.25)
    waves = round(2 * np.pi * 2e-3 / 0.5e-3)
    assert marks.count == waves == 25
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    height = marks.height(2e-3 * np.cos(angle), 2e-3 * np.sin(angle)) - 1e-3 * 2e-3 * np.cos(angle)
    spectrum = np.fft.rfft(height) / len(angle)
    # A crest at angle zero, of √2 times the rms; the second half as often, a quarter as high.
    assert 2 * spectrum[25].real == pytest.approx(np.sqrt(2) * 20e-9, rel=1e-9)
    assert 2 * spectrum[50].real == pytest.approx(np.sqrt(2) * 5e-9, rel=1e-9)
    spectrum[[25, 50]] = 0
    assert np.max(np.abs(spectrum)) < 1e-18
    assert AzimuthalRipple(Tilted(), radius=1e-6, wavelength=1.0).count == 1


def test_no_draw_of_a_clock_lies_beyond_its_reach():
    clocks = ClockErrors(
        trigger_jitter_s=1e-5, probe_jitter_s=2e-5, probe_offset_s=-3e-4, probe_drift_ppm=40.0,
        z_latch_late_s=1e-4, c_latch_late_s=2e-4,
    )  # fmt: skip
    time = np.arange(20_000) * STEP
    instants = clocks.instants(time, np.random.default_rng(1))
    for taken in instants:
        assert np.max(np.abs(taken - time)) < clocks.reach_s(time[-1])
    np.testing.assert_allclose(instants.z - instants.trigger, 1e-4, atol=1e-12)
    np.testing.assert_allclose(instants.c - instants.trigger, 2e-4, atol=1e-12)
    late = instants.probe - instants.trigger
    slope, offset = np.polyfit(time, late, 1)
    assert slope == pytest.approx(40e-6, abs=4 * 2e-5 / np.sqrt(20_000) / np.std(time))
    assert offset == pytest.approx(-3e-4, abs=1e-6)
    assert np.std(late - slope * time) == pytest.approx(2e-5, rel=0.03)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"probe_offset_s": 2.0}, "probe_offset_s is 2.0 s, expected a number from -1 to 1 s"),
        ({"probe_jitter_s": -1e-9}, "probe_jitter_s is -1e-09 s, expected a number from 0"),
        ({"probe_drift_ppm": float("nan")}, "probe_drift_ppm is nan"),
        ({"probe_drift_ppm": 1e6}, r"from -100000 to 100000 ppm; check its unit"),
    ],
)
def test_a_number_beyond_every_machine_is_named_with_its_limits(given, named):
    with pytest.raises(ConfigurationError, match=named):
        ClockErrors(**given)


def test_a_record_is_its_default_until_something_is_set():
    assert is_default(ClockErrors())
    assert not is_default(ClockErrors(z_latch_late_s=1e-9))
    assert PartPose(x_m=-9.9).x_m == -9.9
    with pytest.raises(ConfigurationError, match=r"x_m is 10\.1"):
        PartPose(x_m=10.1)
    with pytest.raises(ConfigurationError, match="frequency_hz is 0"):
        SoftMode(frequency_hz=0.0, damping_ratio=0.1, participation=0.1)


def test_what_is_kept_of_the_simulation_lies_where_it_says():
    """Each kept value at its own time, however fine the steps are and whichever are kept."""
    grid = TimeGrid(lead=50, samples=200, sample_period=STEP, substeps=16, every=8)
    slide, probe = move(Plant(), Swing(), grid)
    coarse = respond(Plant(), Swing(), 200, STEP)
    times = slide.times
    assert times[0] == pytest.approx(-50 * STEP + STEP / 2)
    np.testing.assert_allclose(np.diff(times), STEP / 2)
    at = np.arange(1, 200) * STEP
    np.testing.assert_allclose(slide.at(at), coarse.slide[1:], atol=1e-16)
    np.testing.assert_allclose(probe.at(at), coarse.probe[1:], atol=1e-16)
    assert PAPER_DYNAMICS.dc_gain == pytest.approx(1.0)
