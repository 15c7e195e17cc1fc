import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.cli.words import WORDS
from omsm_ros.io import bags, calibration_file, results
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.twin.cell import blocks_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory, step_test, small_scan_blocks, true_calibration):
    """Three bags, a calibration and a nominal surface; the short scan has two and a half turns."""
    folder = tmp_path_factory.mktemp("cell")
    scans = (("scan", small_scan_blocks), ("short", small_scan_blocks[:50]))
    for name, blocks in (("steps", blocks_of(step_test)), *scans):
        with BagWriter(folder / f"{name}.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
            for axes, distance in blocks:
                bag.write_block(axes)
                bag.write_block(distance)
    calibration_file.save_calibration(folder / "cal.json", true_calibration)
    (folder / "mirror.yaml").write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    with BagWriter(folder / "empty.mcap", (bags.REFERENCE_TOPIC,)):
        pass
    (folder / "notes.txt").write_text("the mirror looks fine\n")
    return folder


def run(capsys, *arguments):
    status = cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return status, out, err


def test_identify_writes_a_calibration(capsys, folder, tmp_path):
    out = tmp_path / "new.json"
    status, text, err = run(
        capsys, "identify", folder / "steps.mcap", "--out", out, "--json", "--order", 2
    )
    assert (status, err) == (0, "")
    facts = json.loads(text)
    calibration = calibration_file.load_calibration(out)
    assert facts["id"] == calibration.id
    assert facts["low_frequency_delay"] == pytest.approx(0.3397e-3, abs=5e-6)
    assert facts["static_gain"] == pytest.approx(0.99213, abs=5e-5)


@pytest.mark.soak
def test_correct_writes_cloud_summary_and_report(capsys, folder, tmp_path):
    status, text, _ = run(
        capsys, "correct", folder / "scan.mcap", "--calibration", folder / "cal.json",
        "--out", tmp_path, "--nominal", folder / "mirror.yaml", "--json",
    )  # fmt: skip
    assert status == 0
    summary = json.loads(text)
    assert summary.pop("out") == str(tmp_path)
    assert summary == json.loads((tmp_path / "summary.json").read_text())
    for account in summary["samples"].values():
        assert account["received"] == 40_000
        assert account["corrected"] + sum(account["counted"].values()) == 40_000
    cloud = results.CloudFile(tmp_path / "cloud.ply").read()
    assert len(cloud) == summary["samples"]["distance"]["corrected"]
    # The figure error of the twin's mirror is a few nanometres here, the probe's noise 10 nm.
    assert summary["deviation"]["corrected"]["rms"] < 15e-9
    assert "<html" in (tmp_path / "report.html").read_text()
    assert {p.name for p in tmp_path.iterdir()} == {
        *("cloud.ply", "summary.json", "report.html", "systematic.npz")
    }


def test_a_scan_of_which_nothing_can_be_corrected_is_reported(
    capsys, folder, tmp_path, small_scan_blocks
):
    with BagWriter(tmp_path / "dark.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in small_scan_blocks[:20]:
            bag.write_block(axes)
            dark = np.full(len(distance.distance), np.nan)
            bag.write_block(dataclasses.replace(distance, distance=dark))
    arguments = ("correct", tmp_path / "dark.mcap", "--calibration", folder / "cal.json")
    status, text, err = run(capsys, *arguments, "--out", tmp_path / "out")
    assert (status, err) == (0, "")
    assert "none of 2000 readings is valid" in text
    assert "no sample could be corrected" in text


def test_correct_registers_the_part_in_its_pass(capsys, folder, tmp_path):
    arguments = ["correct", folder / "short.mcap", "--calibration", folder / "cal.json",
                 "--out", tmp_path, "--nominal", folder / "mirror.yaml", "--fit", "piston,tip,tilt",
                 "--json"]  # fmt: skip
    status, text, _ = run(capsys, *arguments, "--no-report")
    assert status == 0
    summary = json.loads(text)
    found = json.loads((tmp_path / "form.json").read_text())
    assert summary["form"]["deviation"] == found["deviation"]
    assert found["removed"]["not_evaluated"] == []
    assert found["points"]["read"] == summary["samples"]["distance"]["corrected"]
    assert found["deviation"]["rms"]["value"] < 15e-9
    assert summary["verdict"]["code"] == "not_verified"
    assert summary["figures"]["removed"] == ["piston", "tip", "tilt"]


def test_the_page_of_a_scan_names_the_scan(capsys, folder, tmp_path):
    words = ["form", folder / "short.mcap", "--calibration", folder / "cal.json", "--nominal",
             folder / "mirror.yaml", "--fit", "piston,tip,tilt"]  # fmt: skip
    assert run(capsys, *words, "--out", tmp_path)[0] == 0
    assert "<title>Form of short.mcap</title>" in (tmp_path / "report.html").read_text()


def test_a_fit_needs_a_surface(capsys, folder, tmp_path):
    words = ["correct", folder / "scan.mcap", "--calibration", folder / "cal.json"]
    status, _, err = run(capsys, *words, "--out", tmp_path, "--fit", "auto")
    assert status == 2
    assert "--nominal" in err


def test_inspect_counts_what_is_there(capsys, folder):
    status, text, _ = run(capsys, "inspect", folder / "scan.mcap", "--json")
    assert status == 0
    topics = {t["topic"]: t for t in json.loads(text)["topics"]}
    axes = topics[bags.AXES_TOPIC]
    assert (axes["samples"], axes["gaps"], axes["restarts"]) == (40_000, 0, 0)
    assert axes["sample_period"] == 1e-3
    status, text, err = run(capsys, "inspect", folder / "scan.mcap")
    assert (status, err) == (0, "")
    assert text.splitlines()[-1].split() == ["faults", "none", "found"]


def test_a_truncated_bag_is_repaired_into_a_new_file_next_to_it(capsys, folder, tmp_path):
    cut = tmp_path / "cut.mcap"
    whole = (folder / "scan.mcap").read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    status, _, err = run(capsys, "inspect", cut)
    assert status == 2
    assert "omsm inspect --repair" in err
    status, text, _ = run(capsys, "inspect", cut, "--repair")
    assert status == 0
    assert "messages saved" in text
    assert "lost" in text
    assert "cut short" in text
    status, text, _ = run(capsys, "inspect", tmp_path / "cut.repaired.mcap", "--json")
    axes, distance = json.loads(text)["topics"]
    assert axes["samples"] == pytest.approx(20_000, abs=6000)  # except for the last chunk
    assert abs(axes["samples"] - distance["samples"]) <= 100
    assert run(capsys, "inspect", cut, "--repair")[0] == 2  # it exists already


@pytest.mark.parametrize("command", ["identify", "correct", "inspect"])
def test_every_command_speaks_to_people_too(capsys, folder, tmp_path, command):
    arguments = {
        "identify": [folder / "steps.mcap", "--out", tmp_path / "c.json", "--order", 2],
        "correct": [
            folder / "short.mcap",
            "--calibration",
            folder / "cal.json",
            "--out",
            tmp_path,
            "--no-report",
        ],
        "inspect": [folder / "scan.mcap"],
    }
    status, text, _ = run(capsys, command, *arguments[command])
    assert status == 0
    assert len(text.splitlines()) >= 3


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["identify", "/no/such/bag", "--out", "{tmp}/c.json"], "/no/such/bag"),
        (["identify", "{folder}/empty.mcap", "--out", "{tmp}/c.json"], "/omsm/axes"),
        (["identify", "{folder}/steps.mcap", "--out", "{tmp}/c.json", "--order", "-3"], "-3"),
        (["inspect", "{folder}/notes.txt"], "notes.txt"),
        (["correct", "{folder}/scan.mcap", "--calibration", "{folder}/notes.txt", "--out", "{tmp}"],
         "notes.txt"),
        (["correct", "/no/such/bag", "--calibration", "{folder}/cal.json", "--out", "{tmp}"],
         "/no/such/bag"),
        (["correct", "{folder}/scan.mcap", "--calibration", "{folder}/cal.json", "--out", "{tmp}",
          "--nominal", "{folder}/notes.txt"], "notes.txt"),
        (["correct", "{folder}/scan.mcap", "--calibration", "{folder}/cal.json",
          "--out", "{folder}/notes.txt"], "notes.txt"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_2(capsys, folder, tmp_path, arguments, named):
    given = [a.format(folder=folder, tmp=tmp_path) for a in arguments]
    status, out, err = run(capsys, *given, *(["--json"] if "--json" not in given else []))
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert named in err
    assert not (tmp_path / "cloud.ply").exists()


def test_commands_work_without_ros(folder):
    """The offline commands run in a Python that cannot import any ROS package."""
    block = (
        "import sys\n"
        "class NoRos:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('rclpy', 'omsm_msgs', 'std_msgs', 'sensor_msgs'):\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, NoRos())\n"
        "from omsm_ros.cli import main\n"
        f"sys.exit(main(['inspect', {str(folder / 'scan.mcap')!r}, '--json']))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", block], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["topics"]


def test_every_word_is_where_main_looks_for_it():
    import importlib

    for module in {word.module for word in WORDS.values()} - {""}:
        made = importlib.import_module(f"omsm_ros.cli.{module}").COMMANDS
        assert {c.name for c in made} == {n for n, word in WORDS.items() if word.module == module}


@pytest.mark.parametrize(("word", "modules"), [("--help", set()), ("export", {"export"})])
def test_only_what_is_asked_for_is_loaded(word, modules):
    block = (
        "import json, sys\n"
        "from omsm_ros.cli import main\n"
        "try:\n    main(sys.argv[1:])\n"
        "except SystemExit:\n    print(json.dumps(list(sys.modules)), file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", block, word, *(["--help"] if modules else [])],
        capture_output=True, text=True, timeout=200, check=True,
    )  # fmt: skip
    loaded = set(json.loads(done.stderr))
    ours = {f"omsm_ros.cli.{word.module}" for word in WORDS.values()}
    assert loaded & ours == {f"omsm_ros.cli.{module}" for module in modules}
    if not modules:
        assert not loaded & {"scipy", "rosbags", "matplotlib"}


@pytest.mark.parametrize(
    "loading", ["omsm_ros.cli.command_line", "omsm_ros.cli.recordings", "numpy"]
)
def test_ctrl_c_while_a_command_loads_is_one_line(loading):
    block = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Typed:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {loading!r}:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Typed())\n"
        "from omsm_ros.cli import main\n"
        "sys.exit(main(['inspect', 'none.mcap']))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", block], capture_output=True, text=True, timeout=200
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "omsm: interrupted; no unfinished file was left\n"


def test_the_help_of_the_command_is_named_where_its_arguments_are_wrong(capsys):
    assert cli.main(["history", "--no-such-option"]) == 2
    assert "see 'omsm history --help'" in capsys.readouterr().err


def test_the_list_of_commands_has_each_once_with_its_task(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    said = capsys.readouterr().out
    for word in WORDS:
        (line,) = (one for one in said.splitlines() if one.startswith(f"  {word} "))
        assert len(line.split()) > 2, "what it does"


@pytest.mark.parametrize(
    ("command", "shown"),
    [
        ("twin", "spindle speed [rpm]; default: 30.0\n"),
        ("demo", "default: out/demo\n"),
        ("sources", "\npasses: X over the same line ten times"),
        ("history", "default:\n                        $OMSM_CATALOGUE\n"),
    ],
)
def test_help_shows_defaults_and_lists(capsys, command, shown):
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    assert shown in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--json"], "command"),
        (["frob"], "'frob'"),
        (["identify"], "--out"),
        (["inspect", "a", "b"], "b"),
        (["compare", "a"], "required: NEW.json; see"),
        (["identify", "a.csv", "--out", "b", "--output", "u"], "needs --output, its output column"),
        (["identify", "a", "--out", "b", "--order", "9" * 400], "order"),
        (["identify", "a", "--out", "b", "--duration", "nan"], "duration"),
        (["align", "a", "--calibration", "b", "--out", "c", "--radius", "0"], "radius"),
        (["predict", "a", "--calibration", "b", "--budget", "1e300"], "allowed error"),
        (["correct", "a", "--calibration", "b", "--out", "c", "--settings", '{"a": NaN}'], "NaN"),
        (["correct", "a", "--calibration", "b", "--out", "c", "--settings", "[" * 9999], "nested"),
        (["plan", "steps", "--out", "a", "--count", "100000", "--step", "1e-10"], "fewer steps"),
        (["demo", "--seed", "1e99"], "seed"),
    ],
)
def test_a_wrong_argument_is_one_line_with_a_remedy(capsys, arguments, named):
    assert cli.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert named in err
    assert len(err) < 600


def test_a_rejected_identification_leaves_a_good_calibration_alone(capsys, tmp_path, step_test):
    """For a moving target the residual is far above the noise of a stationary segment."""
    import numpy as np

    moves = np.abs(np.gradient(step_test.axes.z)) > 1e-9
    wobble = 2e-6 * np.sin(0.37 * np.arange(len(moves))) * moves
    path, good = tmp_path / "steps.mcap", tmp_path / "cal.json"
    good.write_text("precious")
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks_of(step_test):
            at = slice(distance.first_sample, distance.first_sample + len(distance))
            bag.write_block(axes)
            shaken = distance.distance + wobble[at]
            bag.write_block(dataclasses.replace(distance, distance=shaken))
    short = ("--order", 2, "--duration", 6)
    status, text, err = run(capsys, "identify", path, "--out", good, *short, "--json")
    facts = json.loads(text)
    assert (status, facts["verdict"]) == (2, "rejected")
    assert err.count("\n") == 1
    assert facts["reasons"][0] in err
    assert good.read_text() == "precious"
    kept = json.loads((tmp_path / "cal.rejected.json").read_text())
    assert kept["certificate"]["verdict"] == "rejected"


def test_a_defect_of_ours_is_one_line_that_says_what_to_report(capsys, monkeypatch, folder):
    from omsm_ros.cli import recordings

    def broken(*_):
        raise AttributeError("'NoneType' object has no\nattribute 'z'")

    monkeypatch.setattr(recordings, "inspect_bag", broken)
    status, out, err = run(capsys, "inspect", folder / "scan.mcap", "--json")
    assert (status, out) == (70, "")
    assert err.count("\n") == 1
    assert "AttributeError: 'NoneType' object has no attribute 'z' in broken" in err
    assert "report" in err
    monkeypatch.setenv("OMSM_DEBUG", "1")
    with pytest.raises(AttributeError):
        cli.main(["inspect", str(folder / "scan.mcap")])


def test_what_nobody_knows_is_null(capsys, monkeypatch, folder):
    from omsm_ros.cli import recordings

    reported = {"topics": [{"a": float("nan"), "b": [float("inf")]}], "faults": []}
    monkeypatch.setattr(recordings, "inspect_bag", lambda *_: reported)
    status, out, _ = run(capsys, "inspect", folder / "scan.mcap", "--json")
    assert status == 0
    assert json.loads(out)["topics"] == [{"a": None, "b": [None]}]
