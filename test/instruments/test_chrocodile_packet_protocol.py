"""Packets of the CHRocodile 2: the wire by hand, every split, every damage."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.chrocodile.packet_protocol import (
    Data,
    DataFormat,
    Message,
    PacketCommand,
    PacketDecoder,
    encode_command,
    encode_data,
    encode_format,
    name_code,
)

FORMAT = DataFormat(3, 1000.0, ((65, 5, 1), (83, 2, 1), (256, 6, 1)))

values = st.lists(
    st.one_of(
        st.integers(-(2**31), 2**31 - 1),
        st.floats(width=32, allow_nan=False),
        st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
        st.binary(max_size=20),
    ),
    max_size=6,
)


def data(first: int, count: int, form: DataFormat = FORMAT) -> bytes:
    records = np.zeros(count, form.dtype)
    records["83"] = np.arange(first, first + count)
    records["65"] = -records["83"].astype(int)
    return encode_data(form, records, first * 1_000_000)


def decoded(wire: bytes, decoder: PacketDecoder | None = None) -> list[Message]:
    """Return the messages in ``wire``, the last bytes of a stream."""
    decoder = decoder or PacketDecoder()
    return decoder.feed(wire) + decoder.settle()


def counters(found: list[Message]) -> list[int]:
    return [int(c) for m in found if isinstance(m, Data) for c in m.records["83"]]


# By hand.


def test_a_command_by_hand() -> None:
    wire = encode_command(PacketCommand("SHZ", (1000.0, "ab"), 1, 7))
    body = struct.pack("<IIIHHHH", 0x5A4853, 0, 0, 1, 0, 7, 2)
    body += struct.pack("<If", 1, 1000.0) + struct.pack("<II", 2, 2) + b"ab\0\0"
    assert wire == struct.pack("<IiQI", 0xAA55AA55, 20 + len(body), 0, 0x00444D43) + body


def test_a_data_format_and_its_data_by_hand() -> None:
    head = struct.pack("<IiQI", 0xAA55AA55, 20 + 16 + 8, 0, 0x00544644)
    signal = struct.pack("<BBHHH", 6, 0, 1, 0, 256)
    form = head + struct.pack("<Iifi", 0, 9, 4000.0, 1) + signal
    body = struct.pack("<IiQi", 0, 9, 5 * 2**32 + 2**31, 2) + struct.pack("<ff", 1.5, -2.5)
    packet = struct.pack("<IiQI", 0xAA55AA55, 20 + len(body), 0, 0x00544144) + body
    described, measured = decoded(form + packet)
    assert described == DataFormat(9, 4000.0, ((256, 6, 1),))
    assert isinstance(measured, Data)
    assert measured.records["256"].tolist() == [1.5, -2.5]
    assert measured.times_ns.tolist() == [5_500_000_000, 5_500_250_000]


def test_codes_of_names_are_their_letters() -> None:
    assert name_code("SHZ") == ord("S") | ord("H") << 8 | ord("Z") << 16
    assert name_code("CONF").to_bytes(4, "little") == b"CONF"
    with pytest.raises(ConfigurationError):
        name_code("sh")


def test_a_triggered_sample_tells_its_own_time() -> None:
    form = DataFormat(1, 1000.0, ((91, 5, 1), (83, 2, 1)))
    records = np.zeros(2, form.dtype)
    records["91"] = [2**30, 2**31 - 1]
    found = decoded(encode_format(form) + encode_data(form, records, 10**9))
    assert isinstance(found[1], Data)
    np.testing.assert_allclose(found[1].times_ns, [1_250_000_000, 1_500_000_000], atol=1)


def test_several_channels_take_their_room() -> None:
    form = DataFormat(1, 1000.0, ((256, 6, 3), (83, 2, 1)))
    assert form.dtype.itemsize == 14
    wire = struct.pack("<fffH", 1.0, 2.0, 3.0, 77)
    record = np.frombuffer(wire, form.dtype)[0]
    assert (record["256"], record["83"]) == (1.0, 77)


def test_more_than_a_packet_holds_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="do not fit"):
        data(0, 1000)


# Every split, every damage.


@given(values, st.integers(0, 2**16 - 1), st.data())
def test_any_split_gives_the_same_messages(
    given_values: list[object], ticket: int, draw: st.DataObject
) -> None:
    asked = PacketCommand("SODX", tuple(given_values), 0, ticket)  # type: ignore[arg-type]
    wire = encode_command(asked) + encode_format(FORMAT) + data(0, 3) + data(3, 4)
    cuts = sorted(draw.draw(st.lists(st.integers(0, len(wire)))))
    decoder = PacketDecoder()
    found = []
    for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True):
        found += decoder.feed(wire[a:b])
    found += decoder.settle()
    assert found[0] == asked
    assert counters(found) == list(range(7))
    assert decoder.statistics.bytes_discarded == 0


def test_byte_by_byte() -> None:
    wire = (
        encode_format(FORMAT) + data(0, 50) + encode_command(PacketCommand("CONF")) + data(50, 50)
    )
    decoder = PacketDecoder()
    found = [m for i in range(len(wire)) for m in decoder.feed(wire[i : i + 1])]
    assert counters(found) == list(range(50))  # what follows the others has not come
    assert counters(found + decoder.settle()) == list(range(100))
    assert decoder.settle() == []


def test_what_is_not_whole_does_not_settle() -> None:
    decoder = PacketDecoder()
    wire = encode_format(FORMAT) + data(0, 5)
    decoder.feed(wire[:-3])
    assert decoder.settle() == []
    assert counters(decoded(wire[-3:], decoder)) == list(range(5))


def test_samples_that_bytes_were_added_to_are_none() -> None:
    wire = bytearray(data(0, 5) + data(5, 5) + data(10, 5))
    wire[60:60] = b"\x07\x08"
    decoder = PacketDecoder()
    decoder.feed(encode_format(FORMAT))
    assert counters(decoded(bytes(wire), decoder)) == list(range(5, 15))


@given(st.binary(max_size=300))
def test_after_any_garbage_the_next_packet_but_one_is_decoded(noise: bytes) -> None:
    decoder = PacketDecoder()
    decoder.feed(encode_format(FORMAT))
    found = decoded(noise + data(0, 5) + data(5, 5), decoder)
    assert counters(found)[-5:] == [5, 6, 7, 8, 9]


@given(st.integers(0, 400), st.integers(1, 150))
def test_a_packet_cut_off_does_not_swallow_the_next(place: int, lost: int) -> None:
    parts = [data(10 * i, 10) for i in range(5)]
    wire = b"".join(parts)
    place = min(place, len(wire) - 1)
    assume(lost != len(parts[0]))  # the end of one packet then fits the beginning of another
    decoder = PacketDecoder()
    decoder.feed(encode_format(FORMAT))
    left = wire[:place] + wire[place + lost :]
    found = counters(decoded(left, decoder))
    # A packet is whole as well if other bytes are where those were that it lost.
    whole = [i for i in range(5) if parts[i] in left]
    # A packet that no packet follows may have another's end: it is given up as well.
    last = max((i for i in whole if i * len(parts[0]) < place), default=None)
    expected = [[c for i in own for c in range(10 * i, 10 * i + 10)]
                for own in (whole, [i for i in whole if i != last])]  # fmt: skip
    assert found in expected


@given(st.lists(st.binary(max_size=200), max_size=20), st.integers(0, 200), st.integers(0, 255))
def test_noise_and_mutations_raise_nothing(portions: list[bytes], place: int, value: int) -> None:
    decoder = PacketDecoder()
    mutated = bytearray(
        encode_format(FORMAT) + data(0, 5) + encode_command(PacketCommand("SHZ", (1, "x")))
    )
    mutated[place % len(mutated)] = value
    for portion in [bytes(mutated), *portions]:
        decoder.feed(portion)
    found = decoder.statistics
    assert found.bytes_discarded >= 0
    assert found.bytes_pending <= 4096 + 200


def test_data_of_an_unknown_format_are_counted() -> None:
    decoder = PacketDecoder()
    assert decoded(data(0, 5), decoder) == []
    decoder.feed(encode_format(DataFormat(8, 1000.0, FORMAT.signals)))
    assert counters(decoded(data(0, 5), decoder)) == []
    assert decoder.statistics.unformatted == 10


@pytest.mark.parametrize(
    "form",
    [
        DataFormat(1, 0.0, ((83, 2, 1),)),
        DataFormat(1, 1.0, ((83, 2, 0),)),
        DataFormat(1, 1.0, ((83, 2, 1), (83, 2, 1))),
        DataFormat(1, 1.0, ((83, 9, 1),)),
        DataFormat(1, 1.0, ()),
        DataFormat(1, 1e-30, ((83, 2, 1),)),
        DataFormat(1, 1.0, ((91, 6, 1),)),
    ],
)
def test_a_senseless_format_is_malformed(form: DataFormat) -> None:
    decoder = PacketDecoder()
    assert decoder.feed(encode_format(form)) == []
    assert decoder.statistics.malformed == 1
