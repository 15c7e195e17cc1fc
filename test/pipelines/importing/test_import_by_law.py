"""An imported value is the number in the file times its unit, at the count of its row."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from omsm_ros.core.streams.blocks import Status
from omsm_ros.core.streams.imported_columns import Column, ColumnMap
from omsm_ros.errors import DataError, FileError
from omsm_ros.io import bags
from omsm_ros.io.tables.table import load_column_map
from omsm_ros.pipelines.importing import RowCounter, import_recording
from omsm_ros.pipelines.recording import Recording

METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "inch": 0.0254}
FEW = settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])


def imported(folder, mapping, text, name="t.csv"):
    (folder / "map.yaml").write_text(mapping, encoding="utf-8")
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    mapped, form = load_column_map(folder / "map.yaml")
    out = folder / "out.mcap"
    import_recording([folder / name], mapped, form, out)
    with Recording(out) as recording:
        return recording.recorded(*(one.role for one in recording.topics()))


@FEW
@given(
    rows=st.lists(
        st.tuples(st.integers(1, 4), st.integers(-(10**6), 10**6), st.integers(-(10**6), 10**6)),
        min_size=1, max_size=12,
    ),
    unit=st.sampled_from(sorted(METRES)), sign=st.sampled_from([1, -1]),
    marks=st.sampled_from([(",", "."), (";", ","), ("\\t", "."), (" ", "."), ("|", ",")]),
    end=st.sampled_from(["\n", "\r\n"]), quoted=st.booleans(),
)  # fmt: skip
def test_readings_come_out_in_si_at_their_triggers(
    tmp_path_factory, rows, unit, sign, marks, end, quoted
):
    """Numbers of four decimals in any notation; gaps of the trigger stay gaps."""
    folder = tmp_path_factory.mktemp("law")
    mark, point = marks[0].replace("\\t", "\t"), marks[1]
    trigger = np.cumsum([step for step, _, _ in rows]) - 1

    def cell(value):
        text = f"{value / 1e4:.4f}".replace(".", point)
        return f'"{text}"' if quoted and mark != " " else text

    z, d = ([v / 1e4 for v in column] for column in list(zip(*rows, strict=True))[1:])
    lines = [mark.join(("N", "Z", "D"))]
    lines += [
        mark.join((str(n), cell(a), cell(b)))
        for n, (_, a, b) in zip(trigger, rows, strict=True)
    ]  # fmt: skip
    still = "".join(f"  {axis}: {{constant: 0}}\n" for axis in "xybc")
    mapping = (
        f"sample_period: 0.001\ndelimiter: \"{marks[0]}\"\ndecimal: '{point}'\ncolumns:\n{still}"
        f"  trigger: {{name: N}}\n  z: {{name: Z, unit: nm, sign: {sign}}}\n"
        f"  distance: {{name: D, unit: {unit}}}\n"
    )
    if max(abs(v) for v in d) * METRES[unit] > 100:
        return  # beyond the range of any probe
    found = imported(folder, mapping, end.join(lines) + end)
    axes, distance = found[bags.AXES_TOPIC], found[bags.DISTANCE_TOPIC]
    for blocks in (axes, distance):
        counts = np.concatenate([b.first_sample + np.arange(len(b)) for b in blocks])
        assert counts.tolist() == trigger.tolist()
        # One block for each run of consecutive numbers.
        assert len(blocks) == 1 + int(np.sum(np.diff(trigger) != 1))
    assert np.concatenate([b.z for b in axes]).tolist() == [v * (1e-9 * sign) for v in z]
    assert np.concatenate([b.distance for b in distance]).tolist() == [v * METRES[unit] for v in d]
    assert not any(np.any(b.x) or np.any(b.c) for b in axes)


@FEW
@given(st.lists(st.sampled_from(["1.5", "", "nan", "-999", "n/a", " 2 "]), min_size=1, max_size=9))
def test_what_means_no_reading_is_lost_and_the_others_stay(tmp_path_factory, cells):
    folder = tmp_path_factory.mktemp("lost")
    mapping = (
        "sample_period: 0.001\ninvalid: [-999, 'n/a']\ncolumns:\n"
        "  trigger: {name: N}\n  distance: {name: D, unit: mm}\n"
    )
    text = "N,D\n" + "".join(f"{k},{cell}\n" for k, cell in enumerate(cells))
    (block,) = imported(folder, mapping, text)[bags.DISTANCE_TOPIC]
    for k, cell in enumerate(cells):
        good = cell.strip() in ("1.5", "2")
        assert block.status[k] == (Status.OK if good else Status.NO_TARGET)
        if good:
            assert block.distance[k] == float(cell) * 1e-3
        else:
            assert np.isnan(block.distance[k])


@pytest.mark.parametrize("kind", [".npy", ".npz", ".mat"])
def test_arrays_of_any_program_are_the_same_table(tmp_path, kind):
    """Files of numpy and scipy are read to the last bit."""
    table = np.column_stack([np.arange(20.0), np.sin(np.arange(20.0)) * 1e-3])
    path, name = tmp_path / f"t{kind}", "t"
    if kind == ".npy":
        np.save(path, table)
        name = ""
    elif kind == ".npz":
        np.savez(path, t=table, other=np.zeros(3))
    else:
        savemat(path, {"t": table})
    mapping = (
        "sample_period: 0.001\ncolumns:\n"
        f"  trigger: {{name: '{name}[0]'}}\n  distance: {{name: '{name}[1]', unit: m}}\n"
    )
    (block,) = imported(tmp_path, mapping, path.read_bytes(), path.name)[bags.DISTANCE_TOPIC]
    assert block.distance.tobytes() == table[:, 1].tobytes()
    assert block.first_sample == 0


# Counting of rows.


def counter(timed=False, triggered=False, period=1e-3):
    columns = {"distance": Column("d"), "trigger": Column("n"), "time": Column("t", unit="s")}
    return RowCounter("the table", ColumnMap(columns, period), timed, triggered)


def cut(table, edges):
    """Return the table in non-empty pieces, as readers do."""
    count = len(table["d"])
    inner = (edge for edge in edges if edge < count)
    return [
        {name: values[low:high] for name, values in table.items()}
        for low, high in pairwise(sorted({0, *inner, count}))
    ]


@pytest.mark.parametrize(("timed", "triggered"), [(True, False), (False, True), (False, False),
                                                  (True, True)])  # fmt: skip
@settings(max_examples=20)
@given(steps=st.lists(st.integers(1, 3), min_size=2, max_size=12),
       edges=st.lists(st.integers(1, 30), max_size=4), start=st.integers(0, 1000))  # fmt: skip
def test_rows_are_counted_alike_however_a_file_is_read_in_pieces(
    timed, triggered, steps, edges, start
):
    """Rows are counted by trigger, by time, or one by one; time may have any origin."""
    # Enough even steps first to determine the period, before a gap.
    number = np.cumsum([0] + [1] * 20 + steps) + (start if triggered else 0)
    table = {"n": number.astype(float), "t": 5.0 + number * 1e-3, "d": np.zeros(len(number))}
    found = []
    for pieces in (cut(table, edges), cut(table, [])):
        rows = counter(timed, triggered)
        # Two rows at least determine a period.
        zero, period = rows.begin(table)
        assert period == pytest.approx(1e-3)
        if timed:
            assert zero == pytest.approx(5.0)
            rows.start, rows.epoch, rows.zero = 100.0, zero, zero
        parts = [rows.count(piece) for piece in pieces]
        found.append((np.concatenate([p.counter for p in parts]),
                      np.concatenate([p.elapsed for p in parts])))  # fmt: skip
    (counts, elapsed), (whole, elapsed_whole) = found
    np.testing.assert_array_equal(counts, whole)
    np.testing.assert_allclose(elapsed, elapsed_whole, rtol=0, atol=1e-12)
    expected = number if timed or triggered else np.arange(len(number))
    np.testing.assert_array_equal(counts, expected)
    np.testing.assert_allclose(elapsed, expected * 1e-3, rtol=0, atol=1e-9)


def test_a_stream_without_time_needs_a_period():
    mapped = ColumnMap({"distance": Column("d"), "time": Column("t", unit="s")}, None)
    with pytest.raises(FileError, match="the table has no column of time; state sample_period"):
        RowCounter("the table", mapped, False, False)


@pytest.mark.parametrize(
    ("numbers", "reported"),
    [
        ([-1.0, 0.0], r"trigger\[0\] is -1.0, expected"),
        ([1e16, 2e16], r"trigger\[0\] is 1e\+16, expected"),
    ],
)
def test_impossible_trigger_counts_are_reported_with_their_row(numbers, reported):
    rows = counter(triggered=True)
    with pytest.raises(DataError, match=reported):
        rows.count({"n": np.array(numbers), "d": np.zeros(len(numbers))})
