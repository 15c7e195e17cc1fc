"""After any fault while results are written, files of two runs are never read as one result."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import contextmanager
from pathlib import Path

import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.files import (
    atomic_file,
    exception_text,
    open_regular,
    read_result,
    read_text,
    result_folder,
    save_text,
)

NAMES = ("cloud", "form", "report", "summary")


def run(path, text, step=None):
    with pytest.MonkeyPatch.context() as patched, result_folder(path, NAMES) as folder:
        for name in NAMES:
            save_text(folder / name, text)
        if step is not None:
            fail_from(patched, step)


def fail_from(patched, step):
    """Let each change of a folder fail, from the one of that number on."""
    changes = iter(range(step))

    def faulty(real):
        def call(*arguments, **options):
            if next(changes, None) is None:
                raise OSError(errno.EIO, "Input/output error")
            return real(*arguments, **options)

        return call

    for name in ("unlink", "replace", "rename"):
        patched.setattr(Path, name, faulty(getattr(Path, name)))


def held(path):
    return {part.name: part.read_text() for part in path.iterdir()} if path.is_dir() else {}


@pytest.mark.parametrize("earlier", [True, False])
@pytest.mark.parametrize("step", range(10))
def test_a_fault_at_any_step_leaves_no_mixture(tmp_path, earlier, step):
    """The file that marks a complete result is never with files of another run."""
    out = tmp_path / "out"
    if earlier:
        run(out, "1")
    # In a new folder all comes by one step; over an earlier run two a file.
    if step < (2 * len(NAMES) if earlier else 1):
        with pytest.raises(FileError, match=r"cannot write .*out'.*Input/output error; check the"):
            run(out, "2", step)
        found = held(out)
        assert "summary" not in found or found == dict.fromkeys(NAMES, "1")
        assert step == 0 or "summary" not in found
    else:
        run(out, "2", step)
        assert held(out) == dict.fromkeys(NAMES, "2")
    assert [part.name for part in tmp_path.iterdir()] == ["out"][: int(out.is_dir())]
    # The next run repairs it.
    run(out, "3")
    assert held(out) == dict.fromkeys(NAMES, "3")


def test_a_folder_in_the_place_of_a_file_is_named_before_anything_goes(tmp_path):
    run(tmp_path / "out", "1")
    (tmp_path / "out" / "report").unlink()
    (tmp_path / "out" / "report").mkdir()
    with pytest.raises(FileError, match="'report' there is a folder; remove it"):
        run(tmp_path / "out", "2")
    assert (tmp_path / "out" / "summary").read_text() == "1"


def test_a_user_file_next_to_the_result_is_not_replaced(tmp_path):
    """Only files of an earlier run may be replaced, since others belong to the user."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes").write_text("mine")

    def with_notes(text):
        with result_folder(tmp_path / "out", NAMES) as folder:
            save_text(folder / "summary", text)
            save_text(folder / "notes", text)

    with pytest.raises(FileError, match="'notes' is there and no result; give another folder"):
        with_notes("1")
    assert held(tmp_path / "out") == {"notes": "mine"}
    (tmp_path / "out" / "notes").unlink()
    with_notes("2")
    with_notes("3")
    assert held(tmp_path / "out") == {"notes": "3", "summary": "3"}


def test_a_name_in_the_working_directory_is_where_it_is_when_the_run_begins(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    with result_folder("out", NAMES) as folder:
        monkeypatch.chdir(tmp_path)
        save_text(folder / "summary", "1")
    assert held(tmp_path / "a" / "out") == {"summary": "1"}


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("[1]", "expected a JSON object"),
        ('{"a": Infinity}', "Infinity is not a JSON number"),
        ("", "is not JSON"),
    ],
)
def test_an_invalid_result_is_reported_with_the_expected_kind(tmp_path, text, reported):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(FileError, match=rf"^the figures .*x.json'.*{reported}"):
        read_result(tmp_path / "x.json", "the figures")


# Single files.


@pytest.mark.parametrize("mode", [0o644, 0o600])
def test_a_file_has_the_rights_that_the_user_wants(tmp_path, mode):
    """Not those of a temporary file: others shall read what is shared."""
    before = os.umask(0o666 & ~mode)
    try:
        save_text(tmp_path / "a", "1")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == mode


def test_a_folder_on_the_way_is_made_and_a_longest_name_is_written(tmp_path):
    path = tmp_path / "deep" / "er" / ("n" * 255)
    save_text(path, "1")
    assert path.read_text() == "1"


def test_a_reader_of_the_old_file_reads_on(tmp_path):
    """A new file replaces the name; a reader of the old one sees none of the new bytes."""
    save_text(tmp_path / "a", "old text")
    with open_regular(tmp_path / "a", FileError, "note") as reader:
        save_text(tmp_path / "a", "new")
        assert reader.read() == b"old text"
    assert (tmp_path / "a").read_text() == "new"


def test_what_cannot_be_text_is_written_with_a_mark_and_not_refused(tmp_path):
    """A name of a file may be any bytes; a page that shows it is a page all the same."""
    save_text(tmp_path / "a", "a\udcffb")
    assert (tmp_path / "a").read_text() == "a?b"


@pytest.mark.parametrize("kind", ["folder", "pipe", "device"])
def test_what_is_no_file_is_neither_replaced_nor_read(tmp_path, kind):
    path = tmp_path / "a"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path = Path("/dev/null")
    with pytest.raises(FileError, match="it is a folder, a device or a pipe; check the folder"):
        save_text(path, "1")
    with pytest.raises(FileError, match="no regular file but a folder, a device or a pipe"):
        open_regular(path, FileError, "note")
    assert not path.is_file()


@contextmanager
def of_another(path):
    with atomic_file(path, "w") as stream:
        stream.write("half")
        yield


@pytest.mark.parametrize("error", [ValueError("mine"), KeyError("mine"), KeyboardInterrupt("mine")])
def test_an_error_of_who_writes_stays_what_it_is(tmp_path, error):
    """It is no fault of the disk; and the earlier file stays."""
    save_text(tmp_path / "a", "1")
    with pytest.raises(type(error), match="mine"), of_another(tmp_path / "a"):
        raise error
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a", "1")]


@pytest.mark.parametrize("size", [9, 10, 11])
def test_a_text_is_read_up_to_its_bound(tmp_path, size):
    (tmp_path / "a").write_text("x" * size)
    if size > 10:
        with pytest.raises(FileError, match=r"note '.*/a' has more than 10 bytes, the most that"):
            read_text(tmp_path / "a", 10, FileError, "note")
    else:
        assert read_text(tmp_path / "a", 10, FileError, "note") == "x" * size


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/a/secret"), "No space left on device"),
        (ValueError("two\n  lines\tand more"), "two lines and more"),
        (KeyError("a.b"), "its content is inconsistent"),
        (MemoryError(), "it needs more memory than there is"),
        (ValueError(), "ValueError"),
        (ValueError("x" * 999), "x" * 200),
    ],
)
def test_what_an_exception_says_is_one_short_line_without_its_path(error, text):
    assert exception_text(error) == text
