"""Each disturbance through the whole cell: in the samples, in the truth, and fine enough."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks.disturbance_catalogue import CATALOGUE, SIZES, together
from benchmarks.step_test import StepTest
from benchmarks.twin_motions import step_test_of
from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.kinematics.trajectories import AxisPositions, Spiral
from omsm_ros.core.ripple.density import aliased_frequency
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances, VibrationLine
from omsm_ros.twin.machine_errors import Drift, MachineErrors, PartPose
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.scenario import Scenario, scan_of
from omsm_ros.twin.structure import Creep, StructureErrors
from omsm_ros.units import NANOMETRE_M

QUIET = Probe(scale=1.0, noise=0.0, resolution=0.0)
MIDDLE = -49e-6
FLAT = Flat()
SMALL = Spiral(PAPER_MIRROR, start_radius=1e-3, feed_per_turn=5e-4, spindle_speed=30.0)
ONE_TURN = Spiral(PAPER_MIRROR, start_radius=1e-3, feed_per_turn=1e-3, spindle_speed=60.0)


def quiet(disturbances, motion, surface=FLAT, **kwargs):
    cell = Cell(probe=QUIET, encoder_noise=0.0, disturbances=disturbances)
    return record(cell, motion, surface, **kwargs)


@dataclass(frozen=True)
class Swing:
    """Z swings for ever with ten micrometres' amplitude."""

    frequency: float
    duration: float = 3.0

    def positions(self, time):
        zero = np.zeros_like(time)
        z = 10e-6 * np.cos(2 * np.pi * self.frequency * time)
        return AxisPositions(zero, zero, z, zero, zero)


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_catalogue_rises_in_size_and_halving_the_step_changes_nothing(name):
    assert len(CATALOGUE[name]) == len(SIZES) == len(set(CATALOGUE[name]))
    # Looked at between the steps of the simulation, where interpolation has its say.
    off_the_grid = CATALOGUE[name][-1]
    if name != "trigger jitter":
        off_the_grid = together(off_the_grid, CATALOGUE["trigger jitter"][-1])
    short = StepTest(count=1, dwell=0.3)
    for motion, surface, where in ((short, FLAT, -4.9e-6), (ONE_TURN, PAPER_MIRROR, 0.0)):
        coarse, fine = (
            quiet(off_the_grid, motion, surface, stand_off=where, substeps=n) for n in (16, 32)
        )
        change = coarse.distance.distance - fine.distance.distance
        assert np.nanmax(abs(change)) < 0.1 * NANOMETRE_M
        assert np.max(abs(coarse.probe_motion - fine.probe_motion)) < 0.1 * NANOMETRE_M


# Disturbances that raise the part, and disturbances of the reading.
RAISING = (
    *("drift", "vibration", "straightness of X", "beam", "B swinging"),
    *("spindle, axial", "spindle, tilt", "spindle, asynchronous"),
)
MISREADING = ("noise", "linearity", "slope error")


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_reading_is_the_true_surface_less_the_true_motion_and_what_is_named(name):
    """Probe motion and reading give the true surface at the place that was looked at."""
    made = quiet(CATALOGUE[name][-1], SMALL, PAPER_MIRROR, stand_off=20e-6)
    truth = made.truth
    expected = truth.surface.height(truth.x, truth.y)
    # Within an exposure the mean height is not the height at the mean place, by h''(vt)²/24.
    np.testing.assert_allclose(made.surface_height, expected, rtol=0, atol=2e-11)
    raised = truth.distance + made.probe_motion + 20e-6 - made.surface_height
    if name.startswith(RAISING):
        assert np.max(abs(raised)) > 0.1 * NANOMETRE_M
    else:
        assert np.ptp(raised) < 1e-15
    reading_error = (made.distance.distance - truth.distance)[made.distance.ok]
    if name.startswith(MISREADING):
        assert np.max(abs(reading_error)) > 0.1 * NANOMETRE_M
    else:
        assert np.ptp(reading_error) < 1e-15


def test_switching_one_on_leaves_the_noise_of_the_others():
    drifting = Disturbances(machine=MachineErrors(drift=Drift(ramp_m_per_s=1e-9)))
    clean, drifted = (
        record(
            Cell(disturbances=d, probe=Probe(resolution=0.0)), StepTest(), Flat(), stand_off=MIDDLE
        )
        for d in (Disturbances(), drifting)
    )
    np.testing.assert_allclose(clean.axes.z, drifted.axes.z, rtol=0, atol=1e-17)
    moved = drifted.distance.distance - clean.distance.distance
    scale = Probe().scale
    np.testing.assert_allclose(moved, scale * 1e-9 * np.arange(len(moved)) * 1e-3, atol=1e-18)


@pytest.mark.parametrize("frequency", [0.7, 15.0, 120.0])
@pytest.mark.parametrize(
    "errors",
    [
        ProbeErrors(latency_s=0.34e-3),
        ProbeErrors(exposure_s=0.9e-3),
        ProbeErrors(latency_s=0.1e-3, exposure_s=0.2e-3, averages=4),
    ],
    ids=["latency", "exposure", "averaging"],
)
def test_a_swing_is_read_as_the_true_response_says(errors, frequency):
    made = quiet(Disturbances(probe=errors), Swing(frequency), substeps=64)
    response = made.truth.response.response(frequency)
    servo = Cell().plant.servo.response(frequency)
    turning = np.exp(2j * np.pi * frequency * np.arange(3000) * 1e-3)
    expected = (10e-6 * servo * response * turning).real
    np.testing.assert_allclose(made.probe_motion, expected, rtol=0, atol=3e-10)
    np.testing.assert_allclose(made.distance.distance, -expected, rtol=0, atol=3e-10)


@pytest.mark.parametrize("latency", [0.34e-3, 2e-3, 2.5e-3])
def test_latency_shifts_time_and_place_by_itself_exactly(latency):
    """The reading of a late probe is the earlier reading of one without latency."""

    @dataclass(frozen=True)
    class Earlier:
        duration = SMALL.duration

        def positions(self, time):
            return SMALL.positions(time - latency)

    late = quiet(Disturbances(probe=ProbeErrors(latency_s=latency)), SMALL, PAPER_MIRROR)
    prompt = quiet(Disturbances(), Earlier(), PAPER_MIRROR)
    assert np.max(abs(late.distance.distance - prompt.distance.distance)) < 1e-12
    assert np.max(abs(late.probe_motion - prompt.probe_motion)) < 1e-12
    assert np.max(abs(late.truth.x - prompt.truth.x)) < 1e-15
    assert late.truth.response.latency_s == latency


def test_the_reading_belongs_to_the_middle_of_the_exposure():
    half = quiet(Disturbances(probe=ProbeErrors(latency_s=0.4e-3)), SMALL, PAPER_MIRROR)
    exposed = quiet(
        Disturbances(probe=ProbeErrors(exposure_s=0.1e-3, averages=8)), SMALL, PAPER_MIRROR
    )
    assert exposed.truth.response.latency_s == pytest.approx(0.4e-3)
    assert np.max(abs(half.truth.x - exposed.truth.x)) < 1e-9
    # The feed sets in at time 0, which an exposure blurs.
    assert np.max(abs(half.distance.distance - exposed.distance.distance)) < 5e-11


def _spectrum(values, period=1e-3):
    window = np.hanning(len(values))
    amplitude = 2 * abs(np.fft.rfft(window * (values - values.mean()))) / window.sum()
    return np.fft.rfftfreq(len(values), period), amplitude


@pytest.mark.parametrize("frequency", [13.7, 50.0, 320.0, 680.0, 1234.0])
def test_a_line_is_seen_at_its_folded_frequency(frequency):
    line = VibrationLine(amplitude_m=20e-9, frequency_hz=frequency)
    made = quiet(Disturbances(vibration=(line,)), Swing(0.0, 10.0))
    where, amplitude = _spectrum(made.distance.distance)
    peak = np.argmax(amplitude)
    assert where[peak] == pytest.approx(aliased_frequency(frequency, 1000), abs=0.11)
    assert amplitude[peak] == pytest.approx(20e-9, rel=0.15)  # the window's scallop


@pytest.mark.parametrize("frequency", [300.0, 680.0, 1000.0])
def test_an_exposure_dims_a_line_by_the_sinc_of_its_length(frequency):
    line = VibrationLine(amplitude_m=20e-9, frequency_hz=frequency, phase_rad=0.0)
    errors = ProbeErrors(exposure_s=0.8e-3)
    made = quiet(Disturbances(probe=errors, vibration=(line,)), Swing(0.0, 1.0))
    middle = np.arange(1000) * 1e-3 - errors.lag_s
    expected = 20e-9 * np.sinc(frequency * 0.8e-3) * np.sin(2 * np.pi * frequency * middle)
    reading = made.distance.distance + made.probe_motion
    np.testing.assert_allclose(reading, expected, rtol=0, atol=1e-14)


def test_a_line_in_step_with_the_spindle_is_the_same_in_each_turn():
    line = VibrationLine(amplitude_m=20e-9, per_turn=11.0)
    made = quiet(Disturbances(vibration=(line,)), SMALL, PAPER_MIRROR)
    raised = made.distance.distance + made.probe_motion - made.surface_height
    turns = raised[: 2000 * (len(raised) // 2000)].reshape(-1, 2000)
    assert np.max(abs(turns - turns[0])) < 1e-15
    assert np.ptp(turns[0]) == pytest.approx(40e-9, rel=1e-3)


def test_the_seed_decides_phase_and_walk():
    on = Disturbances(
        vibration=(VibrationLine(amplitude_m=20e-9, frequency_hz=50.0),),
        machine=MachineErrors(drift=Drift(random_walk_m_per_root_s=5e-9)),
    )
    one, again, other = (
        record(
            Cell(seed=s, disturbances=on, probe=QUIET, encoder_noise=0.0),
            StepTest(),
            Flat(),
            stand_off=MIDDLE,
        ).distance.distance
        for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert np.std(one - other) > 1e-9


def test_the_part_has_a_pose_and_the_flat_of_the_step_test_none():
    tilted = Disturbances(machine=MachineErrors(pose=PartPose(tilt_x_rad=50e-6, x_m=5e-6)))
    scenario = Scenario(start_radius=1e-3, feed_per_turn=2e-4)
    clean, posed = (scan_of(scenario, d) for d in (Disturbances(), tilted))
    x, y = workpiece_xy(posed.axes.x, posed.axes.y, posed.axes.c)
    lifted = posed.surface_height - clean.surface_height
    # To first order a tilt about x lifts by y, a shift along x by the slope.
    slope = (PAPER_MIRROR.height(x + 1e-6, y) - PAPER_MIRROR.height(x - 1e-6, y)) / 2e-6
    np.testing.assert_allclose(lifted, 50e-6 * y - 5e-6 * slope, rtol=0, atol=1e-9)
    steps = [step_test_of(scenario, d) for d in (Disturbances(), tilted)]
    np.testing.assert_allclose(
        steps[0].distance.distance, steps[1].distance.distance, rtol=0, atol=1.01e-8
    )  # one resolution where rounding tips over


def test_a_recording_is_what_an_identification_takes():
    made = step_test_of(Scenario(), CATALOGUE["backlash"][1])
    taken = made.motion_record()
    np.testing.assert_array_equal(taken.z, made.axes.z)
    np.testing.assert_array_equal(taken.distance, made.distance.distance)


def test_noise_adds_in_quadrature():
    loud = record(
        Cell(
            disturbances=Disturbances(probe=ProbeErrors(noise_m=40e-9)),
            probe=replace(QUIET, noise=30e-9),
        ),
        StepTest(),
        Flat(),
        stand_off=MIDDLE,
    )
    error = loud.distance.distance + loud.probe_motion + MIDDLE
    assert np.std(error) == pytest.approx(50e-9, rel=0.03)


def test_two_disturbances_are_both():
    a = Disturbances(structure=StructureErrors(creep=(Creep(fraction=1e-3, time_constant_s=1.0),)))
    b = Disturbances(
        structure=StructureErrors(
            creep=(Creep(fraction=2e-3, time_constant_s=9.0),), backlash_m=1e-8
        ),
        probe=ProbeErrors(latency_s=1e-4),
    )
    both = together(a, b)
    assert both.structure.creep == a.structure.creep + b.structure.creep
    assert both.structure.backlash_m == 1e-8
    assert both.probe == b.probe
    assert together(Disturbances(), a) == together(a, Disturbances()) == together(a, a) == a
    with pytest.raises(ConfigurationError, match="latency_s is set twice"):
        together(b, Disturbances(probe=ProbeErrors(latency_s=2e-4)))


def test_every_pair_of_the_catalogue_can_be_or_says_why_not():
    made = failed = 0
    for first in CATALOGUE.values():
        for second in CATALOGUE.values():
            try:
                both = together(first[-1], second[-1])
            except ConfigurationError:
                failed += 1
            else:
                made += 1
                assert both != NOTHING
    assert failed < 0.05 * made


def everything():
    """One record of each family at least, all at once."""
    both = NOTHING
    names = (
        *("slow servo", "exposure", "linearity, cubic", "slope error, square", "dropouts"),
        *("creep, 2 s", "base mode, 8 Hz", "backlash", "friction", "hardening"),
        *("part tilted", "beam slanting", "spindle, asynchronous", "straightness of X"),
        *("drift, random walk", "vibration, 680 Hz", "encoder interpolation", "trigger jitter"),
        *("probe clock drift", "C latched late", "reference late", "stiffness along Z"),
    )
    for name in names:
        both = together(both, CATALOGUE[name][2])
    return both


@pytest.mark.parametrize("period", [1e-2, 1e-3, 1e-4])
def test_at_any_rate_half_the_step_changes_nothing_with_everything_at_once(period):
    cell = Cell(probe=QUIET, encoder_noise=0.0, sample_period=period, disturbances=everything())
    motion = StepTest(count=1, dwell=max(0.1, 50 * period))
    steps = max(16, round(period / 62.5e-6))
    default, finer = (
        record(cell, motion, FLAT, stand_off=-4.9e-6, substeps=n) for n in (None, 2 * steps)
    )
    change = default.distance.distance - finer.distance.distance
    assert np.nanmax(abs(change)) < 0.1 * NANOMETRE_M


def test_everything_at_once_has_one_truth():
    made = quiet(everything(), SMALL, PAPER_MIRROR)
    truth = made.truth
    assert 0.9 < np.mean(made.distance.ok) < 1.0
    for values in (made.probe_motion, made.surface_height, truth.x, truth.y, truth.distance):
        assert np.all(np.isfinite(values))
    posed = truth.surface.height(truth.x, truth.y)
    np.testing.assert_allclose(made.surface_height, posed, rtol=0, atol=2e-11)
    again = quiet(everything(), SMALL, PAPER_MIRROR)
    np.testing.assert_array_equal(made.distance.distance, again.distance.distance)
