"""Lines of the six-channel stream: by hand, every split, every damage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.six_channel.protocol import COLUMNS, CsvDecoder, encode_lines, row_dtype


def rows(count: int) -> np.ndarray:
    made = np.zeros(count, row_dtype(COLUMNS))
    made["sequence"] = np.arange(count)
    made["device_time"] = 1_700_000_000_123_456_789 + made["sequence"] * 1_000_000
    made["x"] = made["sequence"] / 3
    return made


def test_a_line_by_hand() -> None:
    (row,) = CsvDecoder().feed(b"7,1700000000123456789,-123,0,1,2.5,-3,4e3,5\n")
    assert row["device_time"] == 1_700_000_000_123_456_789  # more than a float holds
    assert [row[name] for name in ("sequence", "distance", "x", "y", "z", "b")] == [
        7, -123, 1, 2.5, -3, 4000,
    ]  # fmt: skip


def test_what_halsampler_pipes_out() -> None:
    decoder = CsvDecoder(("sequence", "x", "-", "c"))
    found = decoder.feed(b"0 12.345678 1 0.5 \n1 12.345679 0 0.6 \noverrun\n3 1 2 3\n")
    assert found["sequence"].tolist() == [0, 1, 3]
    assert found["x"].tolist() == [12.345678, 12.345679, 1.0]
    assert decoder.statistics.malformed == decoder.statistics.overruns == 1


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_any_line_end(end: bytes) -> None:
    wire = b"".join(encode_lines(rows(5))).replace(b"\n", end)
    decoder = CsvDecoder()
    found = np.concatenate([decoder.feed(wire[i : i + 1]) for i in range(len(wire))])
    assert found.tobytes() == rows(5).tobytes()
    assert decoder.statistics.malformed == 0


@given(st.integers(1, 8), st.data())
def test_any_split_gives_the_same_rows(count: int, data: st.DataObject) -> None:
    wire = b"".join(encode_lines(rows(count)))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)))))
    decoder = CsvDecoder()
    parts = [decoder.feed(wire[a:b]) for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True)]
    assert np.concatenate(parts).tobytes() == rows(count).tobytes()
    assert decoder.statistics.malformed == 0


@pytest.mark.parametrize(
    "line",
    [b"1,2", b"1,2,3,4,5,6,7,8,9,10", b"1.5,2,3,0,1,2,3,4,5", b"1,2,nan,0,1,2,3,4,5",
     b"x,2,3,0,1,2,3,4,5", b"1,99999999999999999999,3,0,1,2,3,4,5", b"1,2,1e400,0,1,2,3,4,5",
     b"-1,2,3,0,1,2,3,4,5", b"9223372036854775807,2,3,0,1,2,3,4,5",
     b"1,-9223372036854775807,3,0,1,2,3,4,5", b"1,2,3,0,1,2,3,4,2e12"],
)  # fmt: skip
def test_a_broken_line_is_no_sample(line: bytes) -> None:
    decoder = CsvDecoder()
    assert len(decoder.feed(line + b"\n")) == 0
    assert decoder.statistics.malformed == 1


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_noise_raises_nothing_and_is_not_kept(portions: list[bytes]) -> None:
    decoder = CsvDecoder()
    for portion in [*portions, b"\xff" * 10_000]:
        decoder.feed(portion)
        assert decoder.statistics.bytes_pending <= 1025
    decoder.feed(b"\n")
    assert len(decoder.feed(encode_lines(rows(1))[0])) == 1


@pytest.mark.parametrize(
    "columns", [("x",), ("sequence",), ("sequence", "x", "x"), ("sequence", "height")]
)
def test_senseless_columns_are_refused(columns: tuple[str, ...]) -> None:
    with pytest.raises(ConfigurationError, match="columns"):
        CsvDecoder(columns)
