"""Results of one run never stand beside those of another."""

import os
import threading
from pathlib import Path

import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.files import FORM_FILES, MEASUREMENT_FILES, atomic_file, result_folder, save_text

NAMES = ("cloud", "report", "summary")


def put(path, text, names=NAMES):
    with result_folder(path, NAMES) as folder:
        for name in names:
            save_text(folder / name, text)


def broken(path, error):
    with result_folder(path, NAMES) as folder:
        save_text(folder / "cloud", "half")
        raise error


def held(path):
    return {part.name: part.read_text() for part in path.iterdir()}


def test_a_new_folder_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        broken(tmp_path / "out", KeyboardInterrupt())
    assert list(tmp_path.iterdir()) == []
    put(tmp_path / "out", "1")
    assert held(tmp_path / "out") == dict.fromkeys(NAMES, "1")
    assert [part.name for part in tmp_path.iterdir()] == ["out"]


def test_a_second_run_replaces_all_of_the_first_and_nothing_else(tmp_path):
    put(tmp_path / "out", "1")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    put(tmp_path / "out", "2", ("cloud", "summary"))
    assert held(tmp_path / "out") == {"cloud": "2", "summary": "2", "notes.txt": "mine"}


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_refused_or_interrupted_run_leaves_the_first_as_it_was(tmp_path, error):
    put(tmp_path / "out", "1")
    with pytest.raises(error, match="no"):
        broken(tmp_path / "out", error("no"))
    assert held(tmp_path / "out") == dict.fromkeys(NAMES, "1")


def test_two_writers_do_not_mix(tmp_path):
    def many(text):
        for _ in range(30):
            put(tmp_path / "out", text)

    writers = [threading.Thread(target=many, args=(text,)) for text in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert len(set(held(tmp_path / "out").values())) == 1
    assert [part.name for part in tmp_path.iterdir()] == ["out"]


def test_who_comes_second_into_a_new_folder_replaces_the_first(tmp_path, monkeypatch):
    """A worker that was taken for dead may finish beside the one that took its bag over."""
    put(tmp_path / "out", "1")
    with monkeypatch.context() as first_look:
        first_look.setattr(Path, "exists", lambda path: False)
        put(tmp_path / "out", "2")
    assert held(tmp_path / "out") == dict.fromkeys(NAMES, "2")
    assert [part.name for part in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("name", ["file", "file/below", "n" * 300, "\0"])
def test_what_can_be_no_folder_is_refused_by_name(tmp_path, name):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(FileError, match="cannot write results into"):
        put(tmp_path / name, "1")
    assert held(tmp_path) == {"file": "mine"}


def test_a_link_laid_for_the_temporary_name_is_not_followed(tmp_path, monkeypatch):
    """Even a name that was foreseen opens nothing that exists."""
    monkeypatch.setattr("secrets.token_hex", lambda _: "foreseen")
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / ".foreseen.part").symlink_to(victim)
    with pytest.raises(FileError, match="File exists"), atomic_file(tmp_path / "a"):
        pass
    assert victim.read_text() == "precious"


def test_temporary_names_differ(tmp_path):
    with atomic_file(tmp_path / "a") as one, atomic_file(tmp_path / "a") as other:
        assert one.name != other.name
    assert os.listdir(tmp_path) == ["a"]


SPECTRAL = ("report.html", "spectrum.json")


def test_a_folder_belongs_to_one_command(tmp_path):
    """A page of one command beside figures of another, or no page at all, would mislead."""
    with result_folder(tmp_path / "out", ("difference.csv", "report.html", "difference.json")) as f:
        for name in ("report.html", "difference.json"):
            save_text(f / name, "compared")
    done = []
    with (
        pytest.raises(FileError, match=r"\(difference.json\).*give another"),
        result_folder(tmp_path / "out", SPECTRAL),
    ):
        done.append("work that nobody will see")
    assert not done
    assert held(tmp_path / "out") == dict.fromkeys(("report.html", "difference.json"), "compared")
    # No name in common: nothing is mixed.
    with result_folder(tmp_path / "out", ("compensation.csv",)) as folder:
        save_text(folder / "compensation.csv", "offsets")
    assert held(tmp_path / "out")["compensation.csv"] == "offsets"
    assert [part.name for part in tmp_path.iterdir()] == ["out"]


def test_who_is_faster_into_a_folder_keeps_it(tmp_path):
    def mine():
        with result_folder(tmp_path / "out", SPECTRAL) as folder:
            save_text(folder / "spectrum.json", "mine")
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "summary.json").write_text("theirs")

    with pytest.raises(FileError, match="another command"):
        mine()
    assert held(tmp_path / "out") == {"summary.json": "theirs"}


@pytest.mark.parametrize("mine", [MEASUREMENT_FILES, FORM_FILES])
def test_a_measurement_may_have_a_form_and_a_form_has_no_measurement(tmp_path, mine):
    """A form written into the folder of a result must not invalidate the result."""
    out = tmp_path / "out"
    with result_folder(out, MEASUREMENT_FILES) as folder:
        for name in ("cloud.ply", "form.json", "summary.json"):
            save_text(folder / name, "measured")
    if mine is MEASUREMENT_FILES:
        with result_folder(out, mine) as folder:
            save_text(folder / "summary.json", "again")
        assert held(out) == {"summary.json": "again"}
    else:
        with pytest.raises(FileError, match="another command"), result_folder(out, mine):
            pass
        assert len(held(out)) == 3
