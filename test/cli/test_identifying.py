"""``omsm identify`` of tables, and of bags with a hold."""

import contextlib
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from soaked import soaked

from omsm_ros import cli
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.twin.cell import blocks_of

B, A = np.array([0.0, 0.3, 0.1]), np.array([1.0, -1.2, 0.5])


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([0.0, 2.0], 150), 4)
    y = signal.lfilter(B, A, u) + rng.normal(0, 0.01, 600)
    path = tmp_path_factory.mktemp("tables") / "record.csv"
    np.savetxt(path, np.column_stack([u, y]), delimiter=",", header="valve,flow", comments="")
    return path


def run(capsys, *arguments):
    status = cli.main([str(a) for a in ("identify", *arguments)])
    return status, capsys.readouterr()


COLUMNS = ("--input", "valve", "--output", "flow", "--period", 0.1)


@pytest.fixture(scope="module")
def identified(table):
    """The facts and the file of a model."""
    out, said = table.parent / "model.json", io.StringIO()
    words = ("identify", table, *COLUMNS, "--hold", "zero-order", "--out", out, "--json",
             "--report", table.parent / "page")  # fmt: skip
    with contextlib.redirect_stdout(said):
        assert cli.main([str(a) for a in words]) == 0
    return json.loads(said.getvalue()), out


def test_a_table_gives_a_model_that_runs_freely(table, identified):
    facts, out = identified
    assert facts["verdict"].startswith("accepted from")
    assert facts["predicted"] > 0.98
    model = json.loads(out.read_text())
    assert model["schema"] == "omsm-model/2"
    # Each section in z, by the bilinear transform of its polynomials in w.
    u, y = np.loadtxt(table, delimiter=",", skiprows=1).T
    late = np.concatenate([np.zeros(round(model["delays"][0] / 0.1)), u])[:600]
    free = model["direct"][0] * late
    for up, down in zip(model["numerators"][0], model["denominators"], strict=True):
        free = free + signal.lfilter(*signal.bilinear(up[::-1], [*down[::-1], 1.0], 10.0), late)
    assert np.std((free - y)[100:] - np.mean((free - y)[100:])) < 0.015
    assert len(model["covariance"]) == (2 + 4 * len(model["denominators"])) ** 2


def test_an_order_and_people(capsys, table, tmp_path):
    arguments = (
        table,
        *COLUMNS,
        "--hold",
        "zero-order",
        "--order",
        2,
        "--out",
        tmp_path / "m.json",
    )
    status, said = run(capsys, *arguments)
    assert status == 0
    for text in ("verdict", "validation", "valid", "m.json"):
        assert text in said.out


def test_a_model_is_drawn_and_runs_over_another_record(capsys, table, identified, tmp_path):
    (facts, model), page = identified, table.parent / "page"
    assert facts["report"] == str(page / "model.html")
    assert (page / "model.html").read_text().count("<figure>") == 3
    rng = np.random.default_rng(7)
    u = np.repeat(rng.choice([0.0, 2.0], 100), 6)
    y = signal.lfilter(B, A, u) + rng.normal(0, 0.01, 600)
    other, out = tmp_path / "other.csv", tmp_path / "run.csv"
    np.savetxt(other, np.column_stack([u, y]), delimiter=",", header="u,y", comments="")
    words = ("validate", model, other, "--input", "u", "--output", "y", "--out", out)
    assert cli.main([str(w) for w in (*words, "--json")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["residual_rms"] == pytest.approx(0.01, rel=0.1)
    written = np.loadtxt(out, delimiter=",", skiprows=1)
    assert np.std(written[:, 2] - written[:, 3]) == pytest.approx(facts["residual_rms"], rel=1e-3)
    assert written[1, 0] == pytest.approx(0.1)
    assert cli.main([str(w) for w in words]) == 0
    assert "simulation fit" in capsys.readouterr().out


def test_two_inputs_of_two_records_give_one_model(capsys, tmp_path):
    rng, paths = np.random.default_rng(5), [tmp_path / "a.csv", tmp_path / "b.csv"]
    for path in paths:
        u = np.repeat(rng.normal(size=(150, 2)), 4, axis=0)
        y = signal.lfilter(B, A, u[:, 0]) + signal.lfilter([0, 0.5], [1, -0.8], u[:, 1])
        rows = [f"{a},{b},{c}" for (a, b), c in zip(u, y + rng.normal(0, 0.01, 600), strict=True)]
        rows[300] = rows[300].rsplit(",", 1)[0] + ",nan"
        path.write_text("\n".join(["x,c,probe", *rows]))
    columns = ("--input", "x,c", "--output", "probe")
    options = (*columns, "--period", 0.1, "--hold", "zero-order", "--out", tmp_path / "m.json")
    status, said = run(capsys, *paths, *options, "--max-delay", 0, "--json")
    assert status == 0, said.err
    facts = json.loads(said.out)
    assert facts["samples"] == {"received": 1200, "compared": 1196}
    assert len(facts["valid"]) == 2
    words = ("validate", tmp_path / "m.json", paths[1], *columns, "--json")
    assert cli.main([str(w) for w in words]) == 0
    assert json.loads(capsys.readouterr().out)["residual_rms"] == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("axes", ["x,x", "x,q"])
def test_axes_that_a_bag_does_not_have_are_refused(capsys, tmp_path, axes):
    status, said = run(
        capsys, tmp_path / "a", "--input", f"encoder,{axes}", "--out", tmp_path / "m.json"
    )
    assert status == 2
    assert "besides Z" in said.err


def test_duration_cuts_the_table(capsys, table, tmp_path):
    arguments = ("--order", 2, "--duration", 30, "--out", tmp_path / "m.json", "--json")
    _, said = run(capsys, table, *COLUMNS, *arguments)
    assert json.loads(said.out)["samples"]["received"] == 300


def test_a_bag_behind_a_hold_gives_a_model_and_no_calibration(capsys, step_test, tmp_path):
    bag = tmp_path / "steps.mcap"
    with BagWriter(bag, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in blocks_of(step_test):
            writer.write_block(axes)
            writer.write_block(distance)
    arguments = ("--hold", "zero-order", "--duration", 1, "--order", 2, "--max-delay", 0)
    run(capsys, bag, *arguments, "--out", tmp_path / "model.json", "--json")
    (path,) = tmp_path.glob("model*.json")
    model = json.loads(path.read_text())
    # The distance decreases when Z increases.
    gain = model["direct"][0] + sum(b0 for b0, _ in model["numerators"][0])
    assert gain == pytest.approx(-1.0, abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--input", "valve", "--output", "flow"), "--period"),
        (("--input", "valve", "--period", 0.1), "--output"),
        (("--input", "valve", "--output", "leak", "--period", 0.1), "'leak'"),
        ((*COLUMNS, "--hold", "third-order"), "hold"),
        ((*COLUMNS, "--period", 0), "sample period"),
    ],
)
def test_wrong_arguments_are_one_line_and_status_2(capsys, table, tmp_path, arguments, says):
    try:
        status, said = run(capsys, table, *arguments, "--out", tmp_path / "m.json")
    except SystemExit as exit:
        status, said = exit.code, capsys.readouterr()
    assert status == 2
    assert says in said.err
    assert said.err.count("\n") == 1


def test_a_bag_needs_no_period(capsys, tmp_path):
    status, said = run(capsys, "steps.mcap", "--period", 0.001, "--out", tmp_path / "m.json")
    assert status == 2
    assert "for a table" in said.err


def test_a_rejected_model_replaces_none(capsys, tmp_path):
    rng = np.random.default_rng(3)
    path, out = tmp_path / "walk.csv", tmp_path / "model.json"
    walk = np.column_stack([rng.normal(size=400), np.cumsum(rng.normal(size=400))])
    np.savetxt(path, walk, delimiter=",", header="u,y", comments="")
    out.write_text("a good one")
    arguments = ("--input", "u", "--output", "y", "--period", 1, "--hold", "zero-order")
    status, said = run(capsys, path, *arguments, "--max-delay", 0, "--out", out)
    assert status == 2
    assert "rejected" in said.err
    assert out.read_text() == "a good one"
    assert (tmp_path / "model.rejected.json").exists()


def test_a_bag_of_two_counters_is_identified_by_its_stamps(capsys, step_test, tmp_path):
    with BagWriter(tmp_path / "two.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks_of(step_test):
            bag.write_block(axes)
            bag.write_block(replace(distance, first_sample=distance.first_sample + 10**6))
    arguments = (tmp_path / "two.mcap", "--order", 2, "--out", tmp_path / "cal.json")
    status, said = run(capsys, *arguments)
    assert status == 2
    assert "--by-stamps" in said.err
    status, said = run(capsys, *arguments, "--by-stamps")
    assert status == 0, said.err
    assert "accepted with reservations" in said.out
    assert "reservation  probe and axes were joined by their stamps" in said.out
    calibration = load_calibration(tmp_path / "cal.json")
    slow = 0.1
    true = -np.angle(step_test.truth.response.response(slow)) / (2 * np.pi * slow)
    off = calibration.dynamics.low_frequency_delay - float(true)
    assert abs(off) < 3 * calibration.low_frequency_delay_uncertainty


def test_what_becomes_a_bag_by_import_alone_says_so(capsys, table, tmp_path):
    old = tmp_path / "old.bag"
    old.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    for path, kind in ((old, "a bag of ROS 1"), (table, "a table, no bag")):
        assert cli.main(["inspect", str(path)]) == 2
        said = capsys.readouterr().err
        assert kind in said
        assert "omsm import" in said


def test_validate_writes_no_run_where_the_page_cannot_be(capsys, table, identified, tmp_path):
    model, out, page = identified[1], tmp_path / "run.csv", tmp_path / "page"
    page.write_text("a file")
    words = ["validate", str(model), str(table), *map(str, COLUMNS[:4]), "--out", str(out)]
    assert cli.main([*words, "--report", str(page)]) == 2
    assert "give a folder" in capsys.readouterr().err
    assert not out.exists()
    assert cli.main(words) == 0
    assert out.read_text().startswith("time_s,input,output,model")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--by-stamps",), "--by-stamps is for a bag"),
        (("--counter-offset", 2), "--counter-offset is for a bag"),
        (("--settings", '{"machine": "a"}'), "--settings is for a bag"),
        (("--max-delay", 5), "--max-delay is for a held input"),
    ],
)
def test_what_would_be_passed_over_is_refused(capsys, table, tmp_path, arguments, says):
    status, said = run(capsys, table, *COLUMNS, "--out", tmp_path / "m.json", *arguments)
    assert status == 2
    assert says in said.err


def test_a_hold_takes_no_reference(capsys, step_test, tmp_path):
    given = ("--hold", "zero-order", "--input", "reference", "--out", tmp_path / "m.json")
    status, said = run(capsys, tmp_path / "any.mcap", *given)
    assert status == 2
    assert "--hold takes the encoder of a bag" in said.err


@pytest.mark.parametrize(
    ("name", "step", "says"),
    [
        ("t [ms]", 100.0, None),
        ("Time (ms)", 200.0, "rows are 0.2 s apart in"),
        ("t/s", 1.0, "rows are 1 s apart in"),
        *soaked(("time_s", 0.1, None), ("t", 7.0, None), ("temperature_s", 7.0, None)),
    ],
)
def test_a_column_of_time_holds_the_period(capsys, table, tmp_path, name, step, says):
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    rows = np.column_stack([step * np.arange(len(rows)), rows])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header=f"{name},valve,flow", comments="")
    status, said = run(capsys, tmp_path / "r.csv", *COLUMNS, "--out", tmp_path / "m.json")
    assert says in said.err if says else status == 0
    assert status == (2 if says else 0)
    if not says:  # without --hold
        model = json.loads((tmp_path / "m.json").read_text())
        assert model["hold"] == "band-limited"
        assert model["covariance"]


def test_lines_that_are_missing_by_a_column_of_time_are_named(capsys, table, tmp_path):
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    time = 0.1 * np.arange(len(rows)) + 0.3 * (np.arange(len(rows)) >= 200)
    rows = np.column_stack([time, rows])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header="time_s,valve,flow", comments="")
    status, said = run(capsys, tmp_path / "r.csv", *COLUMNS, "--out", tmp_path / "m.json")
    assert status == 2
    assert "steps by 400 ms after row 200" in said.err
