"""A recording written by a plain script gives what the bag of the same samples gives."""

import json

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.streams.imported_columns import Column, ColumnMap
from omsm_ros.errors import BagError, FileError, OmsmError
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.tables.table import TableForm, load_column_map
from omsm_ros.pipelines.importing import import_recording
from omsm_ros.pipelines.recording import Recording
from omsm_ros.twin.cell import blocks_of

MAP = """
sample_period: 0.001
start: 1763200000.25
columns:
  trigger: {name: n}
  x: {name: X, unit: mm}
  y: {constant: 0}
  z: {name: Z, unit: um, sign: -1}
  b: {constant: 0}
  c: {name: C, unit: deg}
  distance: {name: probe, unit: count, count: 1.0e-9}
"""


def columns(blocks):
    """Return all samples of pairs of blocks as arrays."""
    axes = {a: np.concatenate([getattr(b, a) for b, _ in blocks]) for a in "xyzbc"}
    return {**axes, "distance": np.concatenate([d.distance for _, d in blocks])}


def write_csv(path, samples, rows=slice(None)):
    """Write a CSV file as a logger of a workshop does, with other units, signs and order."""
    n = np.arange(len(samples["z"]))[rows]
    lines = ["probe,n,X,Z,C,note"]
    # All digits of a float, so that only the units cause rounding.
    d, x = samples["distance"] / 1e-9, samples["x"] * 1e3
    z, c = -samples["z"] * 1e6, np.degrees(samples["c"])
    lines += [f"{float(d[i])!r},{i},{float(x[i])!r},{float(z[i])!r},{float(c[i])!r},ok" for i in n]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def steps(step_test):
    return columns(list(blocks_of(step_test)))


def imported(tmp_path, mapping, *files):
    (tmp_path / "map.yaml").write_text(mapping)
    mapped, form = load_column_map(tmp_path / "map.yaml")
    out = tmp_path / "out.mcap"
    found = import_recording([tmp_path / f for f in files], mapped, form, out)
    return found, out


def test_a_bag_that_exists_is_refused_and_stays(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((9, 2)))
    (tmp_path / "out.mcap").write_bytes(b"precious")
    mapping = "sample_period: 0.001\ncolumns:\n  distance: {name: '[0]', unit: um}\n"
    with pytest.raises(BagError, match=r"out\.mcap' exists"):
        imported(tmp_path, mapping, "a.npy")
    assert (tmp_path / "out.mcap").read_bytes() == b"precious"


def blocks_in(path):
    """Return the blocks of a bag by topic, axes first."""
    with Recording(path) as recording:
        topics = sorted(topic.role for topic in recording.topics())
        return recording.recorded(*topics)


def samples_of(bag):
    blocks = blocks_in(bag)
    return columns(list(zip(*blocks.values(), strict=True))), blocks


def test_a_step_test_as_csv_gives_the_calibration_of_its_bag(capsys, tmp_path, step_test, steps):
    write_csv(tmp_path / "steps.csv", steps)
    (tmp_path / "map.yaml").write_text(MAP)
    arguments = ["import", tmp_path / "steps.csv", "--map", tmp_path / "map.yaml"]
    assert cli.main([*map(str, arguments), "--out", str(tmp_path / "a.mcap"), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["files"][0]["rows"] == len(steps["z"])
    with BagWriter(tmp_path / "b.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks_of(step_test):
            bag.write_block(axes)
            bag.write_block(distance)
    calibrations = []
    for name in "ab":
        out = tmp_path / f"{name}.json"
        cli.main(["identify", str(tmp_path / f"{name}.mcap"), "--out", str(out), "--order", "2"])
        calibrations.append(json.loads(out.read_text()))
    one, other = calibrations
    # Rounding of the units moves the end of the search a little: the lag by some 20 ns.
    for name in ("numerator", "denominator"):
        assert one[name] == pytest.approx(other[name], rel=1e-4)
    assert one["delay"] == pytest.approx(other["delay"], abs=1e-7)
    assert one["valid_up_to"] == pytest.approx(other["valid_up_to"], rel=1e-2)


def test_units_signs_and_counts_come_out_in_si(tmp_path, steps):
    write_csv(tmp_path / "steps.csv", steps)
    _, out = imported(tmp_path, MAP, "steps.csv")
    samples, blocks = samples_of(out)
    for name in ("x", "z", "c", "distance"):
        assert samples[name] == pytest.approx(steps[name], rel=1e-12, abs=1e-15)
    first = blocks[bags.AXES_TOPIC][0]
    assert (first.stamp_ns, first.first_sample) == (1763200000_250000000, 0)


def test_files_of_the_same_columns_continue_each_other(tmp_path, steps):
    write_csv(tmp_path / "1.csv", steps, slice(0, 700))
    write_csv(tmp_path / "2.csv", steps, slice(700, 1500))
    found, out = imported(tmp_path, MAP, "1.csv", "2.csv")
    assert [f.rows for f in found] == [700, 800]
    samples, _ = samples_of(out)
    assert samples["z"] == pytest.approx(steps["z"][:1500], rel=1e-12)


def test_axes_and_probe_may_lie_in_two_files(tmp_path, steps):
    rows = range(1000)
    axes = "\n".join(f"{i},{float(steps['z'][i])!r}" for i in rows)
    (tmp_path / "axes.csv").write_text(f"i,Z\n{axes}\n")
    np.savez(tmp_path / "probe.npz", gap=steps["distance"][:1000] * 1e6)
    mapping = """
sample_period: 0.001
columns:
  trigger: {name: i}
  z: {name: Z, unit: m}
  x: {constant: 0}
  y: {constant: 0}
  b: {constant: 0}
  c: {constant: 0}
  distance: {name: gap, unit: um}
"""
    found, out = imported(tmp_path, mapping, "axes.csv", "probe.npz")
    assert [(f.axes, f.distance) for f in found] == [(True, False), (False, True)]
    samples, _ = samples_of(out)
    assert samples["z"] == pytest.approx(steps["z"][:1000], rel=1e-15)
    assert samples["distance"] == pytest.approx(steps["distance"][:1000], rel=1e-12)


def test_missing_triggers_stay_a_gap_and_are_counted(tmp_path, steps):
    rows = np.r_[0:300, 340:900]
    write_csv(tmp_path / "a.csv", steps, rows)
    (found,), out = imported(tmp_path, MAP, "a.csv")
    assert (found.rows, found.missing) == (860, 40)
    _, blocks = samples_of(out)
    assert [b.first_sample for b in blocks[bags.AXES_TOPIC]] == [0, 340]


# Time as the counter.

TIMED = """
columns:
  time: {name: t, unit: ms}
  distance: {name: d, unit: nm}
"""


def write_timed(path, times, d=None):
    d = np.arange(len(times)) if d is None else d
    rows = [f"{t:.4f};{v:g}" for t, v in zip(times, d, strict=True)]
    path.write_text("\n".join(["t;d", *rows]))


def test_time_counts_the_samples_though_its_clock_drifts(tmp_path):
    times = np.arange(5000) * 0.5 * (1 + 3e-4)
    write_timed(tmp_path / "a.csv", np.delete(times, range(2000, 2100)))
    (found,), out = imported(tmp_path, TIMED + 'delimiter: ";"\n', "a.csv")
    assert found.missing == 100
    assert found.sample_period == pytest.approx(0.5e-3 * (1 + 3e-4), rel=1e-6)
    blocks = blocks_in(out)[bags.DISTANCE_TOPIC]
    assert blocks[-1].first_sample == 2100


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([0, 1, 2, 2, 3, 4], "time does not rise"),
        ([0, 1, 2, 1.5, 3, 4], "time does not rise"),
        ([0, 1, 2, 3, 4, 5.4, 6.4, 7.4], r"comes 1\.3\d* periods"),
        ([0], "expected at least 2"),
    ],
)
def test_time_that_is_no_even_grid_is_refused(tmp_path, times, said):
    write_timed(tmp_path / "a.csv", times)
    with pytest.raises(OmsmError, match=said):
        imported(tmp_path, TIMED + 'delimiter: ";"\n', "a.csv")
    assert not (tmp_path / "out.mcap").exists()


def test_a_stated_period_that_time_contradicts_is_refused(tmp_path):
    write_timed(tmp_path / "a.csv", np.arange(100.0))
    with pytest.raises(OmsmError, match=r"sample_period is 0.002 s, but the column of time says"):
        imported(tmp_path, TIMED + 'delimiter: ";"\nsample_period: 0.002\n', "a.csv")


# Content of logs.

PROBE = "sample_period: 0.001\ncolumns:\n  distance: {name: d, unit: um}\n"


def distances(tmp_path, text, mapping=PROBE):
    (tmp_path / "a.csv").write_text(text)
    (found,), out = imported(tmp_path, mapping, "a.csv")
    blocks = blocks_in(out)[bags.DISTANCE_TOPIC]
    return found, np.concatenate([b.distance for b in blocks]) * 1e6


def test_decimal_commas(tmp_path):
    mapping = PROBE + 'delimiter: ";"\ndecimal: ","\n'
    _, values = distances(tmp_path, "t;d\n0;1,25\n1;-2,5\n", mapping)
    assert values == pytest.approx([1.25, -2.5])


def test_decimal_commas_that_the_map_does_not_tell_are_no_other_number(tmp_path):
    # "1,25,3,5" has four cells under two names, so that columns would be shifted.
    with pytest.raises(FileError, match="line 2"):
        distances(tmp_path, "d,e\n1,25,3,5\n2,5,4,5\n")
    with pytest.raises(FileError, match="decimal: ','"):
        distances(tmp_path, "d;e\n1,25;3,5\n", PROBE + 'delimiter: ";"\n')


def test_empty_cells_nan_and_error_codes_are_no_reading(tmp_path):
    mapping = PROBE + "invalid: [-999]\n"
    found, values = distances(tmp_path, "i,d\n0,1\n1,\n2,nan\n3,-999\n4,5\n", mapping)
    assert (found.rows, found.invalid) == (5, 3)
    assert np.flatnonzero(np.isfinite(values)).tolist() == [0, 4]


def test_a_repeated_header_is_counted_and_costs_no_row(tmp_path):
    found, values = distances(tmp_path, "i,d\n0,1\ni,d\n1,2\n\n2,3\n")
    assert values == pytest.approx([1, 2, 3])
    assert found.repeated_names == 1


def test_lines_about_the_file_are_skipped_as_the_map_says(tmp_path):
    mapping = PROBE + "lines_before_names: 2\nlines_after_names: 1\n"
    _, values = distances(tmp_path, "Logger 3\n2026-01-01\ni,d\n-,um\n0,1\n1,2\n", mapping)
    assert values == pytest.approx([1, 2])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("i,d\n0,1\n1,oops\n", r"line 3: '1,oops' is no row"),
        ("i,d\n0,1_000\n", "line 2"),
        ("i,d\n0\n", "line 2"),
        ("i,d\n", "no row of numbers"),
        ("", "no line of names"),
        ("i,D\n0,1\n", r"none of the columns \['d'\]"),
        ("d,d\n0,1\n", r"none of the columns \['d'\]"),
    ],
)
def test_what_is_no_table_is_named_with_its_line(tmp_path, text, said):
    with pytest.raises(FileError, match=said):
        distances(tmp_path, text)
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.soak
def test_a_table_longer_than_a_piece(tmp_path):
    rows = 230_000
    text = "d,i\n" + "\n".join(f"{i % 50},{i}" for i in range(rows))
    found, values = distances(tmp_path, text, PROBE + "  trigger: {name: i}\n")
    assert (found.rows, found.missing) == (rows, 0)
    assert values == pytest.approx(np.arange(rows) % 50)


# Other files.


def test_matlab_and_numpy_tables_by_index(tmp_path):
    scipy_io = pytest.importorskip("scipy.io")
    table = np.column_stack([np.arange(50), np.linspace(0, 9, 50)])
    scipy_io.savemat(tmp_path / "a.mat", {"log": table, "who": "the shop"})
    np.save(tmp_path / "a.npy", table)
    for name, column in (("a.mat", "log[1]"), ("a.npy", "[1]")):
        mapping = f"sample_period: 0.001\ncolumns:\n  distance: {{name: '{column}', unit: um}}\n"
        (found,), out = imported(tmp_path, mapping, name)
        (block,) = blocks_in(out)[bags.DISTANCE_TOPIC]
        assert block.distance == pytest.approx(table[:, 1] * 1e-6)
        assert found.rows == 50
        out.unlink()


def test_hdf5_by_group_and_channel(tmp_path):
    h5py = pytest.importorskip("h5py", reason="h5py is an optional package")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["probe/gap"] = np.arange(20.0)
    mapping = "sample_period: 0.001\ncolumns:\n  distance: {name: probe/gap, unit: um}\n"
    imported(tmp_path, mapping, "a.h5")
    (block,) = blocks_in(tmp_path / "out.mcap")[bags.DISTANCE_TOPIC]
    assert block.distance == pytest.approx(np.arange(20) * 1e-6)


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.mat", "a.h5"])
def test_a_damaged_file_is_one_clear_error(tmp_path, name):
    if name == "a.h5":
        pytest.importorskip("h5py", reason="h5py is an optional package")
    (tmp_path / name).write_bytes(b"PK\x03\x04 not what it claims to be")
    with pytest.raises(FileError, match="cannot be read"):
        imported(tmp_path, PROBE, name)


def test_a_pickle_is_not_opened(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"run": "me"}], dtype=object), allow_pickle=True)
    with pytest.raises(FileError, match="pickle"):
        imported(tmp_path, PROBE, "a.npy")


# The map.


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        ("columns: {distance: {name: d}}\nsample_period: 0.001", "distance has no unit"),
        ("columns: {distance: {name: d, unit: furlong}}\nsample_period: 1", "'furlong'"),
        ("columns: {distance: {name: d, unit: count}}\nsample_period: 1", "one count in SI"),
        ("columns: {distance: {name: d, unit: count, count: 5}}\nsample_period: 1", "one count is"),
        ("columns: {distance: {name: d, unit: um}}", "neither sample_period nor"),
        ("columns: {z: {name: d, unit: um}}\nsample_period: 1", "no column for x, y, b, c"),
        ("columns: {q: {name: d, unit: um}}\nsample_period: 1", "'q' is unknown"),
        ("columns: {distance: {name: d, unit: um, constant: 0}}\nsample_period: 1", "one of them"),
        ("columns: {x: {constant: 3}}\nsample_period: 1", "x has no unit"),
        ("columns: {}\nsample_period: 1", "write one of them into the map"),
        ("columns: {distance: {name: d, unit: um}}\nsample_period: 1e9", "sample_period"),
        (
            'columns: {distance: {name: d, unit: um}}\nsample_period: 1\ndecimal: ","',
            "decimal sign",
        ),
    ],
)
def test_what_a_map_leaves_unclear_is_asked_for(tmp_path, mapping, said):
    (tmp_path / "map.yaml").write_text(mapping)
    with pytest.raises(FileError, match=said):
        load_column_map(tmp_path / "map.yaml")


def test_a_column_that_two_kinds_of_files_have_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("d\n1\n2\n")
    (tmp_path / "b.csv").write_text("d,i\n1,0\n2,1\n")
    mapped = ColumnMap({"distance": Column("d", 1e-6), "trigger": Column("i")}, sample_period=1e-3)
    with pytest.raises(FileError, match="files with different columns have"):
        import_recording(
            [tmp_path / "a.csv", tmp_path / "b.csv"], mapped, TableForm(), tmp_path / "o.mcap"
        )
