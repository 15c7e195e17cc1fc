"""Effects of the options of planning and prediction, against closed forms."""

import json
import math
import socket

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.cli import campaign, command_line, doctor, start


def run(capsys, *words):
    status = cli.main([str(word) for word in words])
    out, err = capsys.readouterr()
    return status, out, err


def facts(capsys, *words):
    status, out, err = run(capsys, *words, "--json")
    assert status == 0, err
    return json.loads(out)


def planned(capsys, tmp_path, *more):
    found = facts(capsys, "plan", "steps", "--out", tmp_path, "--count", 4, *more)
    time, z = np.loadtxt(tmp_path / "steps.csv", delimiter=",", skiprows=1).T
    return found, time, z


def edges_of(time, z):
    """Return the instants [s] at which Z starts to move, and the durations of the moves [s]."""
    moving = np.abs(np.diff(z)) > 0
    begins = np.flatnonzero(np.diff(moving.astype(int), prepend=0) == 1)
    ends = np.flatnonzero(np.diff(moving.astype(int), append=0) == -1)
    return time[begins], time[ends + 1] - time[begins]


@pytest.mark.parametrize("period", [1e-3, 2.5e-4])
def test_a_plan_is_sampled_as_the_cell_is(capsys, tmp_path, period):
    found, time, _ = planned(capsys, tmp_path, "--sample-period", period)
    np.testing.assert_allclose(np.diff(time), period, rtol=1e-6)
    assert len(time) * period == pytest.approx(found["duration"], abs=2 * period)


@pytest.mark.parametrize("dwell", [0.5, 1.25])
def test_edges_are_a_dwell_apart_but_for_their_dither(capsys, tmp_path, dwell):
    _, time, z = planned(capsys, tmp_path, "--dwell", dwell)
    begins, _ = edges_of(time, z)
    assert len(begins) == 8
    # Edges are dithered by less than a sample period, and an S-curve starts smoothly.
    np.testing.assert_allclose(np.diff(begins), dwell, atol=2.5e-3)


@pytest.mark.parametrize("rise", [20e-3, 80e-3])
def test_an_edge_takes_its_rise(capsys, tmp_path, rise):
    found, time, z = planned(capsys, tmp_path, "--rise", rise)
    assert found["rise"] == rise
    _, lasts = edges_of(time, z)
    assert np.all(lasts <= rise + 2e-3)
    assert np.all(lasts > 0.9 * rise)


def test_a_probe_of_a_small_range_is_not_left(capsys, tmp_path):
    travel = planned(capsys, tmp_path)[0]["travel"]
    words = ("plan", "steps", "--out", tmp_path, "--count", 4, "--half-range")
    assert run(capsys, *words, 0.51 * travel)[0] == 0
    status, _, err = run(capsys, *words, 0.49 * travel)
    assert status == 2
    assert "use fewer or smaller steps" in err


AMPLITUDE_M, FREQUENCY_HZ = 20e-6, 2.0


@pytest.fixture
def sine(tmp_path):
    """Write a planned motion with known derivatives."""
    t = np.arange(0.0, 10.0, 1e-3)
    z = AMPLITUDE_M * np.sin(2 * np.pi * FREQUENCY_HZ * t)
    np.savetxt(tmp_path / "scan.csv", np.stack([t, z], axis=1), "%.12g", ",", header="time_s,z_m",
               comments="")  # fmt: skip
    return tmp_path / "scan.csv"


def predicted(capsys, sine, calibration, limits="", *more):
    words = ["predict", sine, "--calibration", calibration, *more]
    if limits:
        (sine.parent / "limits.yaml").write_text(limits)
        words += ["--limits", sine.parent / "limits.yaml"]
    return facts(capsys, *words)


def test_a_planned_motion_may_be_named_in_capitals(capsys, sine, calibration):
    """Suffixes in capitals are accepted."""
    expected = predicted(capsys, sine, calibration)
    assert predicted(capsys, sine.rename(sine.with_suffix(".CSV")), calibration) == expected


def test_limits_of_the_machine_are_held_against_the_motion(capsys, sine, calibration):
    omega = 2 * math.pi * FREQUENCY_HZ
    text = "z_acceleration: {}\nz_jerk: {}\n"
    roomy = predicted(capsys, sine, calibration, text.format(1.0, 100.0))
    limits = {limit["name"]: limit for limit in roomy["limits"]}
    acceleration = AMPLITUDE_M * omega**2
    assert limits["Z acceleration"]["value"] == pytest.approx(acceleration, rel=0.02)
    assert limits["Z acceleration"]["allowed"] == 1.0
    assert limits["Z jerk"]["value"] == pytest.approx(acceleration * omega, rel=0.02)
    # Acceleration grows with the square of the speed, so the speed factor is the square root.
    tight = predicted(capsys, sine, calibration, text.format(1.44 * acceleration, 100.0))
    assert tight["binding"] == "Z acceleration"
    assert tight["speed_factor"] == pytest.approx(1.2, rel=0.02)
    broken = predicted(capsys, sine, calibration, text.format(0.5 * acceleration, 100.0))
    assert not broken["safe"]
    unknown = predicted(capsys, sine, calibration)
    assert any("acceleration" in name for name in unknown["not_evaluated"])


def test_a_budget_that_is_smaller_lets_it_run_less_fast(capsys, sine, calibration):
    broad, narrow = (
        predicted(capsys, sine, calibration, "", "--budget", budget) for budget in (1e-6, 1e-12)
    )
    assert broad["safe"]
    assert broad["speed_factor"] >= narrow["speed_factor"]
    assert broad["peak_to_valley"] == narrow["peak_to_valley"]
    assert narrow["residual"] == broad["residual"]
    assert narrow["safe"] is (2 * narrow["residual"] <= 1e-12)


@pytest.fixture
def toroid(tmp_path):
    (tmp_path / "toroid.yaml").write_text("shape: toroid\nradius_x: 1.0\nradius_y: 0.5\n")
    (tmp_path / "limits.yaml").write_text("z_acceleration: 1.0\npoint_spacing: 1.0e-3\n")
    return tmp_path / "toroid.yaml"


def shown(capsys, toroid, *more):
    found = facts(capsys, "surface", "show", toroid, "--radius", 0.01, *more)
    return found, {limit["name"]: limit["value"] for limit in found["limits"]}


def test_a_surface_asks_for_more_of_the_axes_the_faster_it_turns(capsys, toroid):
    limits = ("--limits", toroid.parent / "limits.yaml")
    found, slow = shown(capsys, toroid, *limits, "--rpm", 30)
    _, fast = shown(capsys, toroid, *limits, "--rpm", 60)
    # Two swings a turn of r²/4 (1/R1 - 1/R2).
    omega, swing = 2 * math.pi, 0.01**2 / 4 * (1 / 0.5 - 1 / 1.0)
    assert slow["Z acceleration"] == pytest.approx(swing * omega**2, rel=0.03)
    assert fast["Z acceleration"] == pytest.approx(4 * slow["Z acceleration"], rel=0.03)
    assert found["axes_can_follow"] is True
    assert "Z acceleration" not in found["not_evaluated"]
    assert "Z acceleration" not in shown(capsys, toroid)[1]


def test_the_feed_of_a_spiral_is_the_distance_of_its_turns(capsys, toroid):
    limits = ("--limits", toroid.parent / "limits.yaml")
    _, coarse = shown(capsys, toroid, *limits, "--feed", 2e-4)
    _, fine = shown(capsys, toroid, *limits, "--feed", 1e-4)
    assert coarse.keys() == fine.keys()
    assert coarse["Z acceleration"] == pytest.approx(fine["Z acceleration"], rel=0.02)


def test_doctor_looks_for_the_port_that_is_named(capsys, monkeypatch):
    asked = []

    def examine(folder, port):
        asked.append((str(folder), port))
        return [doctor._serial(port)]

    monkeypatch.setattr(doctor, "examine_host", examine)
    status, out, err = run(capsys, "doctor", "--port", "/dev/ttyNONE", "--folder", "/data")
    assert status == 2
    assert "no /dev/ttyNONE" in out
    assert "serial port" in err
    assert asked == [("/data", "/dev/ttyNONE")]


MADE = {"steps": "s", "step_samples": 1, "scan": "b", "scan_samples": 2, "nominal": "n"}


def test_the_twin_is_made_as_its_options_say(capsys, monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(start, "record_twin", lambda *given: asked.append(given) or MADE)
    words = ["twin", "--out", tmp_path, "--seed", 7, "--part", 3, "--rpm", 45, "--feed", 2e-4]
    run(capsys, *words, "--radius", 1e-3, "--disturbances", "bad.yaml")
    run(capsys, *words[:5])
    (out, scenario, disturbances), (_, plain, nothing) = asked
    assert (out, str(disturbances), nothing) == (tmp_path, "bad.yaml", None)
    assert (scenario.spindle_speed, scenario.feed_per_turn) == (45.0, 2e-4)
    assert (scenario.start_radius, scenario.seed, plain.seed) == (1e-3, 7, 7)
    # Two scans of one part; without --part the seed is that of the part, too.
    r = np.linspace(0, 2e-3, 50)
    error = scenario.part.deviation(r, r)
    assert np.ptp(error) > 0
    other = type(scenario)(seed=99, part_seed=3).part.deviation(r, r)
    np.testing.assert_array_equal(error, other)
    assert not np.allclose(plain.part.deviation(r, r), error, atol=1e-12)


@pytest.mark.parametrize(
    "given",
    [
        [],
        ["--device", "capancdt", "--seed", "5"],
        ["--time-lapse", "4"],
        ["--disturbances", "demo"],
        ["--view", "--json"],
    ],
)
def test_the_demonstration_gets_the_requested_options(monkeypatch, tmp_path, given):
    called = []
    monkeypatch.setattr(command_line.subprocess, "call", lambda words: called.append(words) or 7)
    assert cli.main(["demo", "--out", str(tmp_path), *given]) == 7
    (words,) = called
    assert words[1:] == ["-m", "omsm_ros.nodes.start", "cell_demo", "--out", str(tmp_path), *given]


@pytest.mark.parametrize("address", ["nowhere", "http://a:1", "tcp://a"])
def test_a_scheduler_has_an_address_of_dask(capsys, tmp_path, calibration, address):
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags" / "a.mcap").write_bytes(b"")
    words = ("batch", tmp_path / "bags", "--calibration", calibration, "--out", tmp_path / "out")
    status, _, err = run(capsys, *words, "--scheduler", address)
    assert status == 2
    assert address in err
    assert err.count("\n") == 1


def test_a_scheduler_that_accepts_and_says_nothing_is_named(
    capsys, monkeypatch, tmp_path, calibration
):
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags" / "a.mcap").write_bytes(b"")
    monkeypatch.setattr(campaign, "_ANSWER_S", 0.1)
    words = ("batch", tmp_path / "bags", "--calibration", calibration, "--out", tmp_path / "out")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        status, _, err = run(capsys, *words, "--scheduler", address)
    assert status == 2
    assert f"no scheduler answers at '{address}': timed out; start one there" in err
    assert err.count("\n") == 1
