"""Text of an error on one line: its length and its ends; and the limit of open files."""

import errno
import math
import os
import resource

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from omsm_ros.errors import (
    FileError,
    defect,
    one_line,
    open_files,
    printable,
    shortened,
    too_many_open_files,
)
from omsm_ros.quantities import shown


@settings(max_examples=40)
@given(st.text(max_size=40), st.integers(3, 50))
def test_what_is_short_enough_stays_and_what_is_not_keeps_both_ends(text, most):
    found = shortened(text, most)
    if len(text) <= most:
        assert found == text
        return
    begin, end = (
        found.split("…", 1) if "…" not in text else (found[: most - 1 - (most - 1) // 2], None)
    )
    assert len(found) == most
    assert text.startswith(begin)
    if end is not None:
        assert text.endswith(end)
        assert 0 <= len(begin) - len(end) <= 1


@pytest.mark.parametrize(
    "name", ["/a/" + "b" * 5000 + "/end.mcap", "/a/" + "b c/" * 2000 + "end.mcap"]
)
@pytest.mark.parametrize(
    "said",
    [
        "no bag at {!r}; check the path",
        "{!r}: no bag",
        "of ({!r}) nothing is known; give another",
        "the device's word {!r}; the axes' count",
    ],
)
def test_a_long_name_keeps_its_ends_and_the_sentence_around_it(said, name):
    before, after = said.split("{!r}")
    line = one_line(said.format(name))
    assert line.startswith(f"{before}'/a/b")
    assert line.endswith(f"end.mcap'{after}")
    assert len(line) < 250


def test_a_long_word_without_quotes_is_shortened_too():
    line = one_line(f"unrecognized arguments: --{'x' * 9000}y; see 'omsm --help'")
    assert line.startswith("unrecognized arguments: --xxx")
    assert line.endswith("xy; see 'omsm --help'")
    assert len(line) < 250


def test_each_of_several_names_keeps_its_ends():
    first, second = "/first" + "/x" * 400 + "/a.json", "/second" + "/y" * 400 + "/b.json"
    line = one_line(f"{first!r} and {second!r} are one; give another")
    for part in ("'/first/", "/a.json' and '/second/", "/b.json' are one; give another"):
        assert part in line


def test_usual_names_and_apostrophes_are_left_as_they_are():
    said = (
        "the scan's points and the part's own, of 'omsm correct': \"it's\" no form of what the "
        "device's counter and the axes' clocks, each by itself and both of them together, say of "
        f"'{'/folder' * 20}/scan.mcap' and of the machine's spindle; look at the maker's manual"
    )
    assert one_line(said) == said


@settings(max_examples=50)
@given(st.text(max_size=300))
@example("' 'a" * 2000)
@example('"' * 9000)
@example("'\\" * 4000)
def test_a_line_has_an_end_and_nothing_that_steers_a_terminal(text):
    line = one_line(text)
    assert len(line) <= 1500
    assert line.isprintable()
    assert printable(line) == line


def test_a_line_of_many_words_keeps_the_remedy():
    line = one_line("wrong: " + "word " * 2000 + "; do this")
    assert line.startswith("wrong: word")
    assert line.endswith("; do this")


def test_a_foreign_value_is_shown_with_its_end():
    found = shown("/data/" + "x" * 500 + "/scan.mcap")
    assert found.startswith("'/data/xxx")
    assert found.endswith("xxx/scan.mcap'")
    assert shown(10**5000) == "a int too large to print"


def chained(err, cause):
    try:
        try:
            raise cause
        except type(cause) as inner:
            raise err from inner
    except type(err) as outer:
        return outer


NO_MORE = OSError(errno.EMFILE, os.strerror(errno.EMFILE), "scan.mcap")


@pytest.mark.parametrize(
    "err",
    [
        NO_MORE,
        OSError(errno.ENFILE, os.strerror(errno.ENFILE)),
        ImportError(f"libfoo.so: cannot open shared object file: {os.strerror(errno.EMFILE)}"),
        RuntimeError(f"epoll: {os.strerror(errno.EMFILE)}"),
        chained(FileError("bag 'scan.mcap' cannot be read; check the path"), NO_MORE),
        chained(ValueError("x"), chained(KeyError("y"), NO_MORE)),
    ],
)
def test_the_limit_of_open_files_is_named_wherever_it_was_met(err):
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    said = too_many_open_files(err)
    assert said.startswith("too many open files")
    assert f" {most} " in said
    assert "ulimit -n" in said


@pytest.mark.parametrize(
    "err",
    [
        OSError(errno.ENOENT, os.strerror(errno.ENOENT)),
        FileError(f"no bag at '{os.strerror(errno.EMFILE)}'; check the path"),
        RuntimeError("something else"),
    ],
)
def test_other_errors_are_not_taken_for_it(err):
    assert too_many_open_files(err) == ""


def test_causes_that_go_round_end():
    first, second = ValueError("a"), ValueError("b")
    first.__cause__, second.__cause__ = second, first
    assert too_many_open_files(first) == ""


def test_the_number_of_open_files_may_be_without_a_limit(monkeypatch):
    assert open_files() == resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda which: unlimited)
    assert open_files() == math.inf


def test_a_defect_names_the_place_where_it_was_raised():
    def innermost():
        raise KeyError("z")

    def outer():
        innermost()

    with pytest.raises(KeyError) as raised:
        outer()
    said = defect(raised.value)
    assert "KeyError: 'z' in innermost:" in said
    assert "OMSM_DEBUG=1" in said
    assert " in " not in defect(KeyError("z")).split("KeyError")[1].split(";")[0]
