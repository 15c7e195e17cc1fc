"""Plans that a machine can run and that hide nothing between samples."""

import re

import numpy as np
import pytest

from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.trajectories import StepPlan, plan_csv, plan_steps
from omsm_ros.core.model_errors.families import low_pass_response
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.gcode_file import steps_gcode
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant

PLAN = plan_steps(sample_period=1e-3)


def test_the_plan_comes_home():
    z = PLAN.z(np.array([0.0, PLAN.duration]))
    np.testing.assert_allclose(z, 0, atol=1e-15)
    every = PLAN.z(np.linspace(0, PLAN.duration, 5000))
    # It starts in the middle of its travel.
    assert (np.min(every), np.max(every)) == (pytest.approx(-49e-6), pytest.approx(49e-6))


def test_a_motion_about_its_middle_tells_creep_from_drift():
    """Part of a slow relaxation that gain, lag, offset and drift do not explain."""
    time = np.arange(0.0, PLAN.duration, 1e-3)
    to_the_end = StepPlan(PLAN.starts, (9.8e-6,) * 10 + (-9.8e-6,) * 10, PLAN.rise, PLAN.duration)
    left = [
        np.linalg.norm(projected(low_pass_response(z, 1e-3 / PLAN.duration) - z, z))
        for z in (PLAN.z(time), to_the_end.z(time))
    ]
    assert left[0] > 1.4 * left[1]


def projected(column, z):
    """``column`` less what offset, drift, gain and lag imitate of it, each (n,)."""
    ramp = np.linspace(-1, 1, len(z))
    others = np.column_stack([np.ones(len(z)), ramp, 1e6 * z, 1e6 * np.gradient(z)])
    return column - others @ np.linalg.lstsq(others, column, rcond=None)[0]


def test_edges_are_spread_over_the_sample_period():
    phase = np.sort((np.array(PLAN.starts) / 1e-3) % 1.0)
    gaps = np.diff(np.append(phase, phase[0] + 1))
    assert np.max(gaps) < 0.15


def test_a_planned_test_identifies_without_objection():
    recording = record(Cell(seed=3), PLAN, Flat(), stand_off=0.0)
    calibration = identify(assemble([recording.axes], [recording.distance])).calibration
    assert str(calibration.certificate.verdict).startswith("accepted")
    ratio = calibration.dynamics.response(1.0) / Plant().dynamics.response(1.0)
    assert abs(np.degrees(np.angle(ratio))) < 2e-3


def test_csv_is_the_motion():
    lines = plan_csv(PLAN, 1e-2).splitlines()
    assert lines[0] == "time_s,z_m"
    values = np.array([[float(v) for v in line.split(",")] for line in lines[1:]])
    np.testing.assert_allclose(values[:, 1], PLAN.z(values[:, 0]), atol=1e-17)
    assert values[-1, 0] == pytest.approx(PLAN.duration)


def test_gcode_moves_add_up_to_nothing_and_last_as_planned():
    text = steps_gcode(PLAN)
    moves = [float(m) for m in re.findall(r"^G1 Z(\S+)", text, re.M)]
    feeds = [float(m) for m in re.findall(r"^G1 .* F(\S+)", text, re.M)]
    rests = [float(m) for m in re.findall(r"^G4 P(\S+)", text, re.M)]
    assert len(moves) == 20
    assert sum(moves) == pytest.approx(0, abs=1e-12)
    moving = sum(abs(move) / feed * 60 for move, feed in zip(moves, feeds, strict=True))
    assert moving + sum(rests) == pytest.approx(PLAN.duration, abs=1e-3)
    assert "G21" in text
    assert text.rstrip().endswith("M2")


@pytest.mark.parametrize(
    ("options", "match"),
    [({"rise": 5e-3}, "too short"), ({"count": 11}, "range"), ({"dwell": 0.05}, "no rest")],
)
def test_a_plan_that_cannot_work_is_refused(options, match):
    with pytest.raises(ConfigurationError, match=match):
        plan_steps(**{"sample_period": 1e-3, **options})


def test_two_heights_alternate_and_come_back_to_the_start():
    plan = plan_steps(sample_period=1e-3, second_step=3e-6)
    assert plan.heights[:4] == (3e-6, 9.8e-6, 3e-6, 9.8e-6)
    assert sum(plan.heights) == pytest.approx(0.0, abs=1e-18)
    assert np.ptp(plan.z(np.linspace(0, plan.duration, 1000))) == pytest.approx(64e-6)
    assert plan.travel == pytest.approx(64e-6)


def test_a_smaller_second_step_makes_room_for_more():
    plan_steps(sample_period=1e-3, second_step=3e-6, count=15)
    with pytest.raises(ConfigurationError, match=r"15 steps travel 147 µm.*range"):
        plan_steps(sample_period=1e-3, count=15)


def test_each_plateau_is_as_long_as_was_asked_for_but_for_the_dither():
    """Edge k comes k dwells after the start, and by less than a sample period later."""
    late = np.array(PLAN.starts) - 0.5 * np.arange(1, 21)
    assert np.all((late >= -1e-12) & (late < 1e-3))
