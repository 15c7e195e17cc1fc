"""Error messages for long names, too few open files, and files in the way."""

import errno
import os
import resource
from contextlib import contextmanager

import pytest

from omsm_ros import cli
from omsm_ros.cli import doctor, recordings
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter

# Path components longer than any name can be, where nothing can be created.
LONG = "/".join(["folder" * 50] * 10)
END = "the_last.name"


def refused(capsys, *arguments):
    assert cli.main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("omsm: ")
    return err.strip()


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", f"{LONG}/{END}"],
        ["identify", f"{LONG}/{END}", "--out", "c.json"],
        ["identify", f"{LONG}/{END}.csv", "--out", "c", "--output", "y", "--period", "1e-3"],
        ["correct", "scan", "--calibration", f"{LONG}/{END}", "--out", "r"],
        ["compare", f"{LONG}/{END}", "new.json"],
        ["surface", "show", f"{LONG}/{END}", "--radius", "1"],
        ["history", "--catalogue", f"{LONG}/{END}"],
        ["twin", "--out", f"{LONG}/{END}"],
        ["plan", "steps", "--out", f"{LONG}/{END}"],
        ["plan", f"{LONG}/{END}", "--out", "x"],
        ["calset", f"{LONG}/{END}", "--out", "set.json"],
        ["correct", "s", "--calibration", "c", "--out", "r", "--fit", f"{LONG}/{END}"],
        ["correct", "s", "--calibration", "c", "--out", "r", "--settings", f"{LONG}/{END}"],
        ["inspect", "s", "--topics", f"{LONG}/{END}=a"],
        ["demo", "--experiment", f"{LONG}/{END}"],
        ["demo", "--seed", f"{LONG}/{END}"],
        [f"{LONG}/{END}"],
        ["inspect", "s", f"--{LONG}/{END}"],
        ["report", "result", "--calibration", f"{LONG}/{END}"],
        ["export", f"{LONG}/{END}", "--out", "c.csv"],
        ["import", f"{LONG}/{END}", "--map", f"{LONG}/{END}", "--out", "b.mcap"],
        ["form", f"{LONG}/{END}", "--nominal", f"{LONG}/{END}", "--out", "f"],
    ],
    ids=lambda words: " ".join(word[:12] for word in words),
)  # fmt: skip
def test_a_long_name_is_reported_by_its_beginning_and_its_end(
    capsys, tmp_path, monkeypatch, arguments
):
    monkeypatch.chdir(tmp_path)
    said = refused(capsys, *arguments)
    assert len(said) < 600
    assert "folder" * 25 not in said
    assert "folderfolder" in said
    assert END in said


@contextmanager
def open_files_at_most(more):
    """Limit this process to ``more`` files than it has open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    # The next file gets the lowest free number.
    lowest = os.open(os.devnull, os.O_RDONLY)
    os.close(lowest)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest + more, hard))
    try:
        yield lowest + more
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_command_that_may_open_no_more_files_says_so(capsys, tmp_path):
    path = tmp_path / "scan.mcap"
    with BagWriter(path, (bags.AXES_TOPIC,)):
        pass
    assert cli.main(["inspect", str(path)]) in (0, 2)  # loads all modules that it needs
    capsys.readouterr()
    with open_files_at_most(0) as most:
        said = refused(capsys, "inspect", path)
    assert f"a process may hold {most} here" in said
    assert "ulimit -n" in said
    assert "check the path" not in said


def test_a_library_that_may_open_no_more_files_is_no_defect(capsys, monkeypatch):
    def fails(*_):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(recordings, "inspect_bag", fails)
    assert "too many open files" in refused(capsys, "inspect", "a.mcap")


def test_doctor_names_the_limit_of_open_files(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "examine_host", lambda *_: [doctor._open_files()])
    assert cli.main(["doctor"]) == 0
    capsys.readouterr()
    with open_files_at_most(0) as most:
        status = cli.main(["doctor"])
    out, err = capsys.readouterr()
    assert (status, err.strip()) == (2, "omsm: not ready: open files; see the remedies above")
    assert f"NO  open files         a process may open {most} files" in out
    assert "→ give it more with 'ulimit -n 1024'" in out


def test_discovery_is_not_tried_with_too_few_files(monkeypatch):
    monkeypatch.setattr(doctor, "open_files", lambda: 12)
    monkeypatch.setattr(doctor.subprocess, "run", None)
    check = doctor._discovery()
    assert (check.state, check.found) == ("faulty", "not evaluated: too few open files")
    assert "ulimit" in check.remedy


WRITERS = {
    "plan": ["plan", "steps", "--out", "{}"],
    "twin": ["twin", "--out", "{}", "--radius", "1e-4", "--feed", "1e-4"],
    "history": ["history", "--catalogue", "c.sqlite", "--add", "CAL", "--plot", "{}/f.png"],
    "calset": ["calset", "CAL@x=0", "CAL@x=1e-3", "--out", "{}/set.json"],
    "latency": ["latency", "CAL", "--delay", "0", "--uncertainty", "1e-6",
                "--reason", "data sheet", "--out", "{}/cal.json"],
    "batch": ["batch", "bags", "--calibration", "CAL", "--out", "{}"],
}  # fmt: skip


@pytest.mark.parametrize(
    ("command", "below"),
    [
        *((command, below) for command in ("plan", "calset") for below in ("file", "file/below")),
        *((command, "file/below") for command in ("twin", "latency", "batch")),
        ("history", "file"),
    ],
)
def test_a_file_in_the_way_of_a_folder_is_named(
    capsys, tmp_path, monkeypatch, calibration, command, below
):
    if command == "history":
        pytest.importorskip("sqlalchemy")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "bags").mkdir()
    with BagWriter(tmp_path / "bags" / "scan.mcap", (bags.AXES_TOPIC,)):
        pass
    words = [w.replace("CAL", str(calibration)).format(below) for w in WRITERS[command]]
    said = refused(capsys, *words)
    assert "'file' is in the way, no folder" in said
    assert "File exists" not in said
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--delay", "1e-3"], "give --by-stamps"),
        (["--exposure", "1e-3"], "give --by-stamps"),
        (["--aperture", "0.01"], "give --fit auto"),
        (["--by-stamps", "--counter-offset", "1"], "leave out --counter-offset"),
        (["--by-stamps", "--stamp-tolerance", "1e-3"], "leave out --counter-offset"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(capsys, tmp_path, calibration, options, said):
    words = ["correct", "s.mcap", "--calibration", calibration, "--out", tmp_path / "r"]
    assert said in refused(capsys, *words, *options)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["corect", "--calibration"], "'correct'"),
        (["correct", "s.mcap", "--calibraton", "c.json"], "'--calibration'"),
        (["correct", "s.mcap", "--outt=o", "--calibration", "c.json"], "'--out'"),
    ],
)
def test_a_misspelt_word_is_named_before_what_is_missing_because_of_it(capsys, words, meant):
    assert f"did you mean {meant}" in refused(capsys, *words)


def test_a_word_without_hyphens_is_no_option(capsys):
    said = refused(capsys, "correct", "calibration", "--out", "help")
    assert "required: --calibration" in said


def test_a_file_without_a_length_is_no_cloud(capsys, tmp_path):
    assert "/proc/cpuinfo" in refused(
        capsys, "export", "/proc/cpuinfo", "--out", tmp_path / "a.csv"
    )


def test_limits_in_another_unit_are_refused(capsys, tmp_path, calibration):
    (tmp_path / "m.csv").write_text("time_s,z_m\n" + "".join(f"{k / 1e3},0\n" for k in range(99)))
    (tmp_path / "l.yaml").write_text("probe_range: 100.0  # micrometres\n")
    words = ("--calibration", calibration, "--limits", tmp_path / "l.yaml")
    said = refused(capsys, "predict", tmp_path / "m.csv", *words)
    assert "probe_range is 100.0 m" in said
    assert "give it in metres" in said


@pytest.mark.parametrize(
    ("feed", "said"), [("10", "feed of a turn is 10.0 m"), ("0.5", "less than one")]
)
def test_a_feed_that_makes_no_spiral_is_refused(capsys, tmp_path, feed, said):
    assert said in refused(capsys, "twin", "--out", tmp_path, "--radius", "0.001", "--feed", feed)
