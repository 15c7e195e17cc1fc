"""JSON, YAML and tables of text: what holds for every content, beside Python's own readers."""

from __future__ import annotations

import csv
import io
import json
import math
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.errors import FileError
from omsm_ros.io import json_and_yaml
from omsm_ros.io.tables.text_table import load_columns, rows_in, seconds_since_1970, shift_of

TEXT = st.text(st.characters(codec="utf-8"), max_size=12)
SCALAR = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1),
    st.floats(allow_nan=False, allow_infinity=False), TEXT,
)  # fmt: skip
JSON = st.recursive(
    SCALAR,
    lambda part: st.one_of(st.lists(part, max_size=4), st.dictionaries(TEXT, part, max_size=4)),
    max_leaves=12,
)


def typed(value):
    """A value with the type of each part: 1, 1.0 and True are one to Python."""
    if isinstance(value, dict):
        return {key: typed(part) for key, part in value.items()}
    if isinstance(value, list):
        return [typed(part) for part in value]
    return (type(value), value, math.copysign(1, value) if isinstance(value, float) else 0)


@settings(max_examples=25)
@given(JSON, st.sampled_from([None, 1]))
def test_json_comes_back_with_every_bit_and_type(value, indent):
    text = json_and_yaml.text_of(value, indent)
    assert typed(json.loads(text)) == typed(value)
    assert typed(json_and_yaml.value_of(text, FileError, "note")) == typed(value)


@settings(max_examples=25)
@given(JSON)
def test_what_is_unknown_becomes_null_and_nothing_else_changes(value):
    assert typed(json_and_yaml.unknown_as_null(value)) == typed(value)
    nested = {"a": [value, math.nan], "b": {"c": math.inf}}
    assert json_and_yaml.unknown_as_null(nested) == {"a": [value, None], "b": {"c": None}}


@settings(max_examples=25)
@given(st.text(alphabet='{}[]",:0123456789.eE+-truefalsn \\u\n', max_size=30))
def test_a_text_is_read_as_python_reads_it_or_refused(text):
    """Never another value: strictness takes away, and adds nothing."""
    try:
        found = json_and_yaml.value_of(text, FileError, "note")
    except FileError as err:
        said = str(err)
    else:
        assert typed(found) == typed(json.loads(text))
        said = "note is read"
    assert said.startswith("note is ")
    assert "\n" not in said


PLAIN = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1),
              st.floats(allow_nan=False, allow_infinity=False),
              st.text(st.characters(codec="ascii", min_codepoint=32), max_size=12)),
    lambda part: st.one_of(
        st.lists(part, max_size=3), st.dictionaries(st.text("ab:#-", max_size=4), part, max_size=3)
    ),
    max_leaves=8,
)  # fmt: skip


@settings(max_examples=25)
@given(st.dictionaries(st.text("xyz_ ", min_size=1, max_size=5), PLAIN, max_size=4))
def test_json_is_yaml(content):
    """YAML 1.2 holds all of JSON: the same names, values and types, to eight levels."""
    found = json_and_yaml.mapping_of(json.dumps(content), FileError, "surface")
    assert typed(found) == typed(content)


@settings(max_examples=25)
@given(
    st.lists(st.lists(st.floats(-1e50, 1e50), min_size=3, max_size=3), min_size=2, max_size=6),
    st.permutations(["a", "b [mm]", "c c"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.booleans(),
    st.sampled_from(["", "\ufeff"]),
    st.booleans(),
)
def test_columns_of_a_table_are_those_that_csv_reads(
    tmp_path_factory, rows, names, end, ended, mark, spaced
):
    blank = " " if spaced else ""
    lines = [f",{blank}".join(names)]
    lines += [f"{blank},{blank}".join(map(repr, row)) for row in rows]
    text = mark + end.join(lines) + (end if ended else "")
    path = tmp_path_factory.mktemp("table") / "t.csv"
    path.write_bytes(text.encode())
    wanted = ("c c", "a")
    plain = list(csv.DictReader(io.StringIO("\n".join(lines)), skipinitialspace=True))
    found = load_columns(path, wanted)
    for name, column in zip(wanted, found, strict=True):
        assert column.tolist() == [float(row[name]) for row in plain]


@settings(max_examples=30)
@given(st.integers(0, 4), st.sampled_from(["x", "1;2", "1,5,2,3", "", "1,2,3,4", "--,1,2"]))
def test_the_first_line_that_is_no_row_is_named_by_its_number(tmp_path_factory, place, bad):
    lines = ["a,b,c", *(f"{k},{k},{k}" for k in range(5))]
    lines.insert(1 + place, bad)
    path = tmp_path_factory.mktemp("table") / "t.csv"
    path.write_text("\n".join(lines) + "\n")
    if not bad:  # an empty line is none
        assert load_columns(path, ("b",))[0].tolist() == [0, 1, 2, 3, 4]
        return
    with pytest.raises(FileError, match=rf"t.csv', line {place + 2}: '{bad}' is no row of numbers"):
        load_columns(path, ("a", "c"))


@pytest.mark.parametrize(
    ("rows", "reported"),
    [
        (["1,2", "nan,2", "3,nan"], "a has no reading in 1 of 3 rows, first in row 2; cut the"),
        (["1,nan", "2,nan", "3,4"], "b has no reading in 2 of 3 rows, first in row 1; cut the"),
        (["1,2"], "1 lines of numbers; record more"),
        ([], "0 lines of numbers; record more"),
        (["1,2", "1e101,2"], r"a\[1\] is 1e\+101, expected .* scale it"),
        (["1,2", "inf,2"], r"a\[1\] is inf, expected"),
    ],
)
def test_a_column_that_is_not_whole_is_reported_with_its_row(tmp_path, rows, reported):
    (tmp_path / "t.csv").write_text("\n".join(["a,b", *rows]) + "\n")
    with pytest.raises(FileError, match=rf"table .*t.csv'.*{reported}"):
        load_columns(tmp_path / "t.csv", ("a", "b"))


def test_rows_of_text_are_counted_as_the_file_counts_them():
    lines = ["1 2", "  ", "3 4", "5 x"]
    with pytest.raises(FileError, match=r"^the map, line 14: '5 x' is no row of numbers; mend it"):
        rows_in(lines, "the map", "mend it", above=10)
    assert rows_in(lines[:3], "the map", "mend it").tolist() == [[1, 2], [3, 4]]
    assert rows_in([], "the map", "mend it").shape[0] == 0


ZONES = st.integers(-14 * 60, 14 * 60)


def zone_text(minutes, form):
    sign, size = "-" if minutes < 0 else "+", abs(minutes)
    return form.format(sign=sign, h=size // 60, m=size % 60)


@settings(max_examples=25)
@given(
    st.datetimes(datetime(1970, 1, 2), datetime(2100, 1, 1)), ZONES,
    st.sampled_from(["{sign}{h:02}:{m:02}", "{sign}{h:02}{m:02}"]),
    st.sampled_from("T "), st.sampled_from(".,"), st.integers(0, 9),
)  # fmt: skip
def test_a_date_is_the_instant_that_python_reads(when, minutes, form, between, point, digits):
    """To a quarter of a microsecond, whatever the zone, the digits and the comma."""
    fraction = f"{when.microsecond:06d}000"[:digits]
    zone = zone_text(minutes, form)
    text = f"{when:%Y-%m-%d}{between}{when:%H:%M:%S}" + (f"{point}{fraction}" if digits else "")
    shown = when.replace(microsecond=int(f"{fraction:0<6}"[:6] or 0))
    there = shown.replace(tzinfo=timezone(timedelta(minutes=minutes)))
    wanted = (there - datetime(1970, 1, 1, tzinfo=timezone.utc)).total_seconds()
    stated, given_ = seconds_since_1970([text + zone], "")[0], seconds_since_1970([text], zone)[0]
    assert stated == given_ == pytest.approx(wanted, abs=0.5e-6)


@pytest.mark.parametrize(
    ("zone", "seconds"),
    [("Z", 0), ("+00:00", 0), ("-00:30", -1800), ("+05:45", 20_700), ("-1130", -41_400),
     ("+14", 50_400)],
)  # fmt: skip
def test_how_far_a_zone_is_ahead(zone, seconds):
    assert shift_of(zone) == seconds


@pytest.mark.parametrize(
    ("text", "zone", "reported"),
    [
        ("2026-11-21T14:03:05", "", "no time zone; write it into the map, as zone: '.01:00'"),
        ("2026-11-21T14:03:05Z", "+01:00", "states its time zone; leave zone out of the map"),
        ("21.11.2026 14:03", "Z", "expected a date after ISO 8601"),
        ("2026-11-21", "Z", "expected a date after ISO 8601"),
        ("2026-11-21T14:03:05.1234567891Z", "", "expected a date after ISO 8601"),
        ("2026-02-30T14:03:05Z", "", "out of range"),
        ("2026-11-21T25:03:05Z", "", "out of range"),
    ],
)
def test_a_date_that_is_none_is_refused(text, zone, reported):
    with pytest.raises(ValueError, match=reported):
        seconds_since_1970([text], zone)


def test_dates_of_a_day_are_apart_by_what_their_clocks_say():
    texts = [f"2026-11-21T00:00:{k // 1000:02d}.{k % 1000:03d}Z" for k in range(3000)]
    np.testing.assert_allclose(np.diff(seconds_since_1970(texts, "")), 1e-3, atol=5e-7)
