"""Text of loggers, controls and spreadsheets is read correctly, or refused in one line."""

import numpy as np
import pytest

from omsm_ros.errors import OmsmError

PROBE = "sample_period: 0.001\ncolumns:\n  distance: {name: d, unit: um}\n"
DATED = "columns:\n  time: {name: t, unit: date}\n  distance: {name: d, unit: um}\n"


@pytest.fixture
def read(importer):
    """Return the distances [µm] of an imported text."""

    def distances(text, mapping=PROBE, encoding="utf-8"):
        data = text if isinstance(text, bytes) else text.encode(encoding)
        (importer.folder / "a.csv").write_bytes(data)
        importer.found = importer(mapping, "a.csv")[0]
        return np.concatenate([b.distance for b in importer.blocks()]) * 1e6

    distances.importer = importer
    return distances


def refusal(read, *given):
    """Return the error line; no bag is written."""
    with pytest.raises(OmsmError) as caught:
        read(*given)
    assert not read.importer.out.exists()
    said = str(caught.value)
    assert "\n" not in said
    return said


# Read correctly.


@pytest.mark.parametrize(
    ("text", "more"),
    [
        ("i,d\r\n0,1.5\r\n1,-2\r\n", ""),
        ("i,d\r0,1.5\r1,-2\r", ""),
        ("i\td\n0\t1.5\n1\t-2\n", 'delimiter: "\\t"\n'),
        ("i|d\n0|1.5\n1|-2", "delimiter: '|'\n"),
        ("   i      d\n   0    1.5\n   1   -2\n", "delimiter: ' '\n"),
        ('"i","d"\n"0","1.5"\n"1","-2"\n', ""),
        ("i,d,\n0,1.5,\n1,-2,\n", ""),
        ("i,d\n0,1.5,\n1,-2,\n", ""),
        ("i,d\n0,15E-1\n1,-0.2e+01\n", ""),
        ("i;d\n0;1,5\n1;-2,0\n", 'delimiter: ";"\ndecimal: ","\n'),
        ('i,d\n0,"1,5"\n1,"-2,0"\n'.replace(",", ";").replace("1;5", "1,5").replace("2;0", "2,0"),
         'delimiter: ";"\ndecimal: ","\n'),
        ("\n\n i , d \n0,1.5\n\n1,-2\n\n", ""),
        ('sep=,\ni,d\n0,1.5\n1,-2\n', "lines_before_names: 1\n"),
        ('"t, s",d\n0,1.5\n1,-2\n', ""),
        ("\td\n0\t1.5\n1\t-2\n", 'delimiter: "\\t"\n'),
    ],
    ids=[
        "Windows", "old Mac", "tabs", "bars", "blanks", "quotes", "delimiters at the ends",
        "delimiters below the names", "powers of ten", "German", "German in quotes", "blank lines",
        "Excel's separator", "a delimiter in a name", "an unnamed first column",
    ],
)  # fmt: skip
def test_the_same_two_numbers_however_they_are_written(read, text, more):
    assert read(text, PROBE + more) == pytest.approx([1.5, -2.0])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252", "cp437"])
def test_a_name_with_a_mu_in_any_encoding(read, encoding):
    mapping = "sample_period: 0.001\ncolumns:\n  distance: {name: 'gap [µm]', unit: µm}\n"
    assert read("gap [µm]\n1.5\n-2\n", mapping, encoding) == pytest.approx([1.5, -2.0])


@pytest.mark.parametrize(("mapped", "named"), ["\u03bc\u00b5", "\u00b5\u03bc"])
def test_a_greek_mu_is_a_micro_sign(read, mapped, named):
    mapping = f"sample_period: 0.001\ncolumns:\n  distance: {{name: 'gap [{mapped}m]', unit: um}}\n"
    assert read(f"gap [{named}m]\n1.5\n2\n", mapping) == pytest.approx([1.5, 2.0])


def test_a_text_without_names_is_read_by_place(read):
    mapping = "sample_period: 0.001\ncolumns:\n  distance: {name: '[1]', unit: um}\n"
    assert read("7,1.5\n8,-2\n", mapping) == pytest.approx([1.5, -2.0])


def test_words_for_no_reading_are_stated_and_counted(read):
    mapping = PROBE + "invalid: ['---', OVR]\n"
    values = read("i,d\n0,1\n1,---\n2,ovr\n3,4\n", mapping)
    assert np.isnan(values).tolist() == [False, True, True, False]
    assert read.importer.found.invalid == 2


def test_infinite_readings_are_none(read):
    assert np.isnan(read("d\n1\ninf\n-inf\n")).tolist() == [False, True, True]


def test_dates_count_the_samples_and_set_the_clock(read):
    rows = [f"2026-11-21T14:03:{5 + i // 100:02d}.{i % 100:02d}0+01:00,{i}" for i in range(300)]
    del rows[100:120]
    values = read("\n".join(["t,d", *rows]), DATED)
    assert len(values) == 280
    assert read.importer.found.missing == 20
    assert read.importer.found.sample_period == pytest.approx(0.01)
    block = read.importer.blocks()[0]
    expected = np.datetime64("2026-11-21T13:03:05", "ns").astype(np.int64)
    assert abs(block.stamp_ns - expected) < 1000


def test_dates_without_a_zone_take_the_map_s(read):
    rows = ["2026-11-21 14:03:05,500;1", "2026-11-21 14:03:06,500;2"]
    mapping = DATED + "delimiter: ';'\nzone: '-05:30'\n"
    read("\n".join(["t;d", *rows]), mapping)
    expected = np.datetime64("2026-11-21T19:33:05.5", "ns").astype(np.int64)
    assert abs(read.importer.blocks()[0].stamp_ns - expected) < 1000


def test_seconds_since_1970_set_the_clock(read):
    mapping = DATED.replace("date", "unix")
    read("t,d\n1763200000.25,1\n1763200000.26,2\n1763200000.27,3\n", mapping)
    assert abs(read.importer.blocks()[0].stamp_ns - 1763200000_250_000_000) < 1000


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_parts_of_a_second_since_1970_set_the_clock_where_they_are_reported(read, unit, scale):
    rows = [f"{round((1763200000.25 + i / 100) * scale)},{i}" for i in range(3)]
    text = "\n".join(["t,d", *rows])
    # Another unit would lose or change the date.
    for other in ("unix", unit):
        said = refusal(read, text, DATED.replace("date", other))
        assert f"write unit: unix_{unit}" in said
    read(text, DATED.replace("date", f"unix_{unit}"))
    assert abs(read.importer.blocks()[0].stamp_ns - 1763200000_250_000_000) < 1000
    read.importer.out.unlink()
    read(text, "start: 1.0\n" + DATED.replace("date", unit))
    assert read.importer.blocks()[0].stamp_ns == 1_000_000_000


def test_stamps_that_jitter_are_distinguished_from_a_wrong_period(read):
    random = np.random.default_rng(1)
    rows = [f"{1763200000 + i / 1000 + random.normal(0, 2e-4):.6f},{i}" for i in range(3000)]
    mapping = DATED.replace("date", "unix") + "sample_period: 0.001\n"
    said = refusal(read, "\n".join(["t,d", *rows]), mapping).replace("\n", " ")
    assert "leave time out and state sample_period" in said


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("0,1\n1,2\n1,2\n2,3\n", "trigger 1 is followed by 1; delete the row"),
        ("0,1\n2,2\n1,3\n", "trigger 2 is followed by 1; delete the row"),
        ("0,1\nnan,2\n2,3\n", "trigger is nan in the row after 0, expected whole"),
        ("0,1\n1.5,2\n2,3\n", "trigger is 1.5 in the row after 0, expected whole"),
    ],
)
def test_a_trigger_that_does_not_count_is_named_with_its_file(read, rows, said):
    reported = refusal(read, "i,d\n" + rows, PROBE + "  trigger: {name: i}\n")
    assert said in reported
    assert "a.csv" in reported


# Refused in one line.


@pytest.mark.parametrize(
    ("text", "more", "said"),
    [
        ("i;d\n0;1.234,5\n", 'delimiter: ";"\ndecimal: ","\n', "thousands"),
        ("i;d\n0;1.234\n", 'delimiter: ";"\ndecimal: ","\n', "thousands"),
        ("i,d\n0,1 234.5\n", "", "between thousands"),
        ("i;d\n0;1'234\n", 'delimiter: ";"\n', "between thousands"),
        ('i;d\n0;"1,234.5"\n', 'delimiter: ";"\n', "between thousands"),
        ('i,d\n0,"1,234.5"\n', "", "3 cells under 2 names"),
        ("i\td\n0\t1,5\n", 'delimiter: "\\t"\n', "decimal: ','"),
        ("i;d\n0;1\n", "", "delimiter: ';'"),
        ("Logger 7\nno. 12\ni,d\n0,1\n", "", "lines_before_names: 2"),
        ("i,d\n,um\n0,1\n", "", "lines_after_names: 1"),
        ("i,d\n0,1\nmean,1\n", "", "line 3"),
        ("i,d\n0,1\n1,2\n2", "", "check whether it was cut"),
        ("i,d\n0,---\n", "", "invalid: ['---']"),
        ("0,1\n1,2\n", "", "by place"),
        ("i,d\n0,=A1*2\n", "", "line 2"),
        ("i,d\n0,1.5 µm\n", "", "line 2"),
        ("i,d\n0,１２\n", "", ""),
    ],
)
def test_what_would_be_another_number_is_refused(read, text, more, said):
    if "１" in text:  # Python reads digits of other scripts, too
        assert read(text) == pytest.approx([12.0])
        return
    assert said in refusal(read, text, PROBE + more).replace("\n", " ")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"PK\x03\x04 a workbook", "save the sheet as CSV"),
        (b"\xd0\xcf\x11\xe0 an old one", "save the sheet as CSV"),
        ("d\n1\n".encode("utf-16-le"), "zero bytes"),
        (b"TDSm....", "name it .tdms"),
        (b"\x89HDF\r\n", "name it .h5"),
        (b"d\n" + b"1" * 5_000_000, "more than 100000 characters"),
    ],
)
def test_a_non_text_file_is_reported_with_its_kind(read, data, said):
    assert said in refusal(read, data)


@pytest.mark.parametrize(
    ("rows", "more", "said"),
    [
        (["2026-11-21T14:03:05,1"], "", "no time zone"),
        (["21.11.2026 14:03:05,1"], "", "ISO 8601"),
        (["11/21/2026 2:03:05 PM,1"], "", "ISO 8601"),
        (["45982.58,1"], "", "ISO 8601"),
        (["2026-13-41T14:03:05Z,1"], "", "line 2"),
        (["2026-11-21T14:03:05+25:00,1"], "", "ISO 8601"),
        # 2**64 ns after 2026-11-21, which 64-bit nanoseconds would wrap to that day.
        (["2611-06-11T13:37:38.709Z,1"], "", "from 1700-01-01 to 2261-12-31"),
        (["2026-11-21T14:03:05Z,1"], "zone: Z\n", "leave zone out"),
        (["2026-11-21T14:03:05Z,1"] * 3, "", "too coarsely"),
        (["2026-11-21T14:03:05Z,1", "2026-11-21T14:03:06Z,2"], "start: 5\n", "leave start out"),
    ],
)
def test_a_date_that_says_not_when_is_refused(read, rows, more, said):
    assert said in refusal(read, "\n".join(["t,d", *rows]), DATED + more)


@pytest.mark.parametrize("name", ["d [mm]", "d (mm)", "d/mm", "d_mm", "d mm", "d in mm"])
def test_a_unit_that_the_file_contradicts_is_refused(read, name):
    mapping = f"sample_period: 0.001\ncolumns:\n  distance: {{name: '{name}', unit: um}}\n"
    assert "in mm, the map in um" in refusal(read, f"{name}\n1\n2\n", mapping)
    stated = mapping.replace("unit: um", "unit: count, count: 1e-6")
    assert read(f"{name}\n1\n2\n", stated) == pytest.approx([1, 2])


@pytest.mark.parametrize("unit", ["V", "mV", "Å", "counts", "in", "deg"])
def test_a_unit_that_no_map_could_name_is_not_overruled_either(read, unit):
    mapping = f"sample_period: 0.001\ncolumns:\n  distance: {{name: 'd [{unit}]', unit: um}}\n"
    assert f"in {unit}, the map in um" in refusal(read, f"d [{unit}]\n1\n2\n", mapping)


@pytest.mark.parametrize("name", ["d [um]", "d [μm]", "d [micron]", "d_um", "d [slide]", "y_in"])
def test_other_words_for_the_same_unit_and_words_that_are_none_are_read(read, name):
    mapping = f"sample_period: 0.001\ncolumns:\n  distance: {{name: '{name}', unit: um}}\n"
    assert read(f"{name}\n1\n2\n", mapping) == pytest.approx([1, 2])


@pytest.mark.parametrize("unit", ["mm", "[mm]", " (mm) ", '"mm"'])
def test_a_line_of_units_that_contradicts_the_map_is_refused(read, unit):
    text = f"i,d\n-,{unit}\n0,1\n1,2\n"
    assert "'d' in mm, the map in um" in refusal(read, text, PROBE + "lines_after_names: 1\n")
    words = f"i,d\nrunning,number of\n-,{unit}\n0,1\n1,2\n"
    assert "'d' in mm, the map in um" in refusal(read, words, PROBE + "lines_after_names: 2\n")
    fits = text.replace("mm", "um")
    assert read(fits, PROBE + "lines_after_names: 1\n") == pytest.approx([1, 2])


@pytest.mark.parametrize(
    ("unit", "said"), [("'1'", "write unit: '%'"), ("count, count: 0.1", "of")]
)
def test_intensities_above_all_are_in_another_unit(read, unit, said):
    mapping = PROBE + f"  intensity: {{name: p, unit: {unit}}}\n"
    reported = refusal(read, "d,p\n0,48\n1,52\n2,50\n", mapping)
    assert "intensity is" in reported
    assert said in reported
    assert len(read("d,p\n0,48\n1,52\n2,50\n", mapping.replace(unit, "'%'"))) == 3


@pytest.mark.parametrize("counting", ["trigger: {name: n}", "time: {name: n, unit: s}"])
def test_a_count_that_no_file_has_is_asked_for(read, counting):
    said = refusal(read, "i,d\n0,1\n1,2\n", PROBE + f"  {counting}\n")
    assert "no column 'n' of" in said


def turning(importer, values, unit):
    """Import a spindle that reads ``values``."""
    rows = ["c,z", *(f"{v:.6f},0" for v in values)]
    (importer.folder / "c.csv").write_text("\n".join(rows))
    still = "".join(f"  {a}: {{constant: 0}}\n" for a in "xyb")
    c = f"  c: {{name: c, unit: {unit}}}\n  z: {{name: z, unit: mm}}\n"
    return importer("sample_period: 0.001\ncolumns:\n" + still + c, "c.csv")


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("low", [0.0, -0.5])
@pytest.mark.parametrize("counted", ["deg", "rad", "turn"])
def test_a_spindle_that_falls_back_by_a_turn_shows_its_unit(importer, counted, low, way):
    turn = {"deg": 360.0, "rad": 2 * np.pi, "turn": 1.0}
    share = (way * np.arange(900) * 0.0021 - low) % 1.0 + low
    for stated in turn:
        if stated == counted:
            assert turning(importer, share * turn[counted], stated)[0].rows == 900
            importer.out.unlink()
        else:
            with pytest.raises(OmsmError, match=f"an angle in {counted} does, the map says"):
                turning(importer, share * turn[counted], stated)


def test_a_spindle_that_goes_on_or_jumps_at_rest_shows_none(importer):
    for values in (np.arange(900) * 0.72, np.repeat([0.0, 359.0, 0.0], 300)):
        assert turning(importer, values, "rad")[0].rows == 900
        importer.out.unlink()


def test_trigger_gaps_with_a_file_that_cannot_contain_them_are_refused(importer):
    (importer.folder / "z.csv").write_text("n,Z\n" + "".join(f"{n},0\n" for n in (0, 1, 3, 4)))
    (importer.folder / "d.csv").write_text("d\n1\n2\n3\n4\n")
    mapping = PROBE + "  trigger: {name: n}\n  z: {name: Z, unit: mm}\n"
    mapping += "".join(f"  {a}: {{constant: 0}}\n" for a in "xybc")
    with pytest.raises(
        OmsmError, match=r"missing in .*z\.csv, and .*d\.csv has neither trigger nor time"
    ):
        importer(mapping, "z.csv", "d.csv")
    assert not importer.out.exists()
    (importer.folder / "z.csv").write_text("n,Z\n" + "".join(f"{n},0\n" for n in range(4)))
    importer(mapping, "z.csv", "d.csv")


def test_a_column_that_is_not_there_or_stands_twice_is_reported_by_the_names_of_the_file(read):
    mapping = PROBE + "  intensity: {name: p, unit: '1'}\n"
    missing = refusal(read, "p,D\n0,1\n1,2\n", mapping)
    assert "no column 'd' of distance, but ['p', 'D']" in missing
    twice = refusal(read, "d,p,d\n1,0,1\n2,1,2\n", mapping)
    assert "2 columns 'd', of which distance is one; rename the others" in twice


def test_a_name_that_yaml_reads_otherwise_wants_quotes(read):
    mapping = PROBE.replace("name: d", "name: d [um]")
    assert "quotes around a text with any of [ ]" in refusal(read, "d [um]\n1\n2\n", mapping)


def test_side_by_side_by_time_though_one_begins_later(importer):
    """Rows are paired by time, not by their position."""
    time = np.arange(0, 1, 0.001)
    z = ["t,Z", *(f"{t:.3f},{t}" for t in time)]
    gap = ["t,d", *(f"{t:.3f},{-t}" for t in time[250:])]
    (importer.folder / "z.csv").write_text("\n".join(z))
    (importer.folder / "d.csv").write_text("\n".join(gap))
    axes = "".join(f"  {a}: {{constant: 0}}\n" for a in "xybc")
    importer(
        "columns:\n  time: {name: t, unit: s}\n  z: {name: Z, unit: mm}\n"
        "  distance: {name: d, unit: mm}\n" + axes,
        "z.csv", "d.csv",
    )  # fmt: skip
    first = importer.blocks()[0]
    assert first.first_sample == 250
    assert first.stamp_ns == 250_000_000
