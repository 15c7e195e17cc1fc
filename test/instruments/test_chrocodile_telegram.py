"""Telegrams of the CHRocodile: the wire by hand, every split, every damage."""

from __future__ import annotations

import itertools
import struct
import time

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from omsm_ros.errors import ConfigurationError, ProtocolError
from omsm_ros.instruments.chrocodile.protocol import BinaryDecoder, LineDecoder
from omsm_ros.instruments.chrocodile.telegram import (
    ENCODERS_AT_START,
    SAMPLE_COUNTER,
    SIGNALS,
    Layout,
    Records,
)

SIX_CHANNELS = (SAMPLE_COUNTER, 33024, *ENCODERS_AT_START)
LAYOUT = Layout.of(SIX_CHANNELS)

selections = st.lists(st.sampled_from(sorted(SIGNALS)), min_size=1, max_size=8, unique=True)


def some(count: int, layout: Layout = LAYOUT, seed: int = 0) -> Records:
    """Telegrams of random content, counted where there is a counter."""
    raw = np.random.default_rng(seed).bytes(count * layout.length)
    records = np.frombuffer(raw, layout.dtype).copy()
    records["sync"] = 0xFFFF
    if SAMPLE_COUNTER in layout.signals:
        records["83"] = (seed * 1000 + np.arange(count)) % 2**16
    return records


def decoder(layout: Layout = LAYOUT, *, synchronised: bool = True) -> BinaryDecoder:
    made = BinaryDecoder(layout)
    made.reset(synchronised=synchronised)
    return made


def everything(made: BinaryDecoder | LineDecoder, *portions: bytes) -> Records:
    parts = [*(made.feed(p) for p in portions), made.settle()]
    return np.frombuffer(b"".join(p.tobytes() for p in parts), parts[0].dtype)


# The wire, by hand.


def test_a_telegram_by_hand_mixes_its_byte_orders() -> None:
    layout = Layout.of((83, 256, 16640, 65, 64))
    wire = b"\xff\xff" + struct.pack(">H", 0x0102) + struct.pack("<f", 37.5)
    wire += struct.pack(">h", -2) + struct.pack("<i", -70_000) + struct.pack("<I", 4_000_000_000)
    (record,) = everything(decoder(layout), wire)
    assert [record[name].item() for name in ("83", "256", "16640", "65", "64")] == [
        0x0102, 37.5, -2, -70_000, 4_000_000_000,
    ]  # fmt: skip
    made = layout.records(1)
    made[0] = (0xFFFF, 0x0102, 37.5, -2, -70_000, 4_000_000_000)
    assert made.tobytes() == wire


def test_six_channels_and_the_counter_are_28_bytes() -> None:
    assert LAYOUT.length == 28


def test_a_line_by_hand() -> None:
    layout = Layout.of((83, 256, 65))
    made = layout.records(2)
    made["83"], made["256"], made["65"] = [7, 8], [12.25, -0.5], [-3, 0]
    assert layout.lines(made) == [b" 7 12.2500 -3\r\n", b" 8 -0.5000 0\r\n"]


# Layouts described by the device.


@given(selections)
def test_a_description_is_read_back(numbers: list[int]) -> None:
    layout = Layout.of(numbers)
    assert Layout.described(layout.describe()) == layout


@pytest.mark.parametrize(
    "text",
    [
        "12 83 2 2 256 6 4 65 5 8",
        "12, 83,2,2, 256,6,4, 65,5,8",
        "12 3\r\n83 2 2\r\n256 6 4\r\n65 5 8",
        "10 83 2 0 256 6 2 65 5 6",  # length and offsets without the sync
        "12 83 2 0 256 6 2 65 5 6",  # offsets without the sync
        "83 2 2;256 6 4;65 5 8",
    ],
)
def test_what_the_facts_leave_open_in_a_description_is_understood(text: str) -> None:
    assert Layout.described(text) == Layout.of((83, 256, 65))


def test_the_description_decides_on_types_and_gaps() -> None:
    layout = Layout.described("14 257 2 2 256 6 8")
    wire = b"\xff\xff" + struct.pack(">H", 99) + b"\xaa" * 4 + struct.pack("<f", 1.5) + b"\xbb\xbb"
    (record,) = everything(decoder(layout), wire)
    assert (record["257"], record["256"]) == (99, 1.5)


@pytest.mark.parametrize(
    "text", ["", "ready", "28", "28 83", "12 83 9 2", "12 83 2 2 83 2 4", "12 83 5 2 64 5 4"]
)
def test_a_senseless_description_is_refused(text: str) -> None:
    with pytest.raises(ProtocolError):
        Layout.described(text)


def test_a_signal_not_in_the_table_needs_a_description() -> None:
    with pytest.raises(ConfigurationError, match=r"\[264\].*DTF"):
        Layout.of((83, 264))
    with pytest.raises(ConfigurationError, match="sync"):
        Layout.of((83,), b"\xff")


# Every split, every place.


@given(selections, st.integers(1, 6), st.data())
def test_any_split_gives_the_same_telegrams(
    numbers: list[int], count: int, data: st.DataObject
) -> None:
    layout = Layout.of(numbers)
    records = data.draw(
        npst.arrays(np.uint8, count * layout.length).map(lambda a: a.view(layout.dtype).copy())
    )
    records["sync"] = 0xFFFF
    if SAMPLE_COUNTER in numbers:
        start = data.draw(st.integers(0, 2**16 - 1))
        records["83"] = (start + np.arange(count)) % 2**16
    wire = records.tobytes()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)))))
    portions = [wire[a:b] for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True)]
    made = decoder(layout)
    assert everything(made, *portions).tobytes() == wire
    assert made.statistics.bytes_discarded == made.statistics.losses_of_sync == 0


def test_byte_by_byte_with_syncs_all_over_the_data() -> None:
    records = some(50)
    for name in ("33024", "65", "66", "67", "68", "69"):
        records[name] = -1
    wire = records.tobytes()
    assert wire.count(b"\xff\xff\xff\xff") > 50
    found = everything(decoder(), *(wire[i : i + 1] for i in range(len(wire))))
    assert found.tobytes() == wire


@given(st.integers(1, 3 * 28), st.integers(0, 5))
def test_joined_in_the_middle_with_syncs_in_the_data(cut: int, seed: int) -> None:
    """Encoders at -1 are FF FF FF FF: only the counter tells where a telegram begins."""
    records = some(12, seed=seed)
    for name in ("65", "66", "67", "68", "69"):
        records[name] = -1
    found = everything(decoder(synchronised=False), records.tobytes()[cut:])
    assert found.tobytes() == records[-len(found) :].tobytes()
    assert len(found) >= 12 - cut // 28 - 2


# Damage.


@given(st.binary(max_size=300), st.integers(0, 5))
def test_after_any_garbage_the_next_telegram_but_one_is_decoded(noise: bytes, seed: int) -> None:
    records = some(6, seed=seed)
    made = decoder()
    found = everything(made, some(3, seed=9).tobytes() + noise + records.tobytes())
    assert found[-5:].tobytes() == records[1:].tobytes()
    total = made.statistics
    assert total.bytes_received == (
        28 * total.telegrams + total.bytes_discarded + total.bytes_pending
    )


@given(st.integers(0, 10 * 28 - 1), st.integers(1, 60))
def test_lost_bytes_invent_nothing(place: int, lost: int) -> None:
    assume(lost % 28)  # exactly one telegram's worth leaves every sync where it is due
    records = some(12)
    wire = records.tobytes()
    found = everything(decoder(), wire[:place] + wire[place + lost :])
    sent = {record.tobytes() for record in records}
    assert all(record.tobytes() in sent for record in found)
    assert len({record.tobytes() for record in found}) == len(found)
    hit = (place + lost - 1) // 28 - place // 28 + 1
    assert len(found) >= 12 - hit - 2


@pytest.mark.parametrize("seed", range(3))
def test_an_encoder_at_rest_around_zero_is_not_taken_for_a_sync(seed: int) -> None:
    """Its FF FF come in every telegram; what then looks like a counter may go on for a while."""
    random = np.random.default_rng(seed)
    records = some(4000, seed=3)
    k = np.arange(len(records))
    records["65"], records["66"], records["67"] = k, -3 * k - 1, 7 * k + 11
    records["68"], records["69"] = -1, -(k % 2)
    wire, losses = b"", 0
    for record in records:
        telegram = record.tobytes()
        if random.random() < 0.01:
            place, losses = int(random.integers(28)), losses + 1
            telegram = telegram[:place] + telegram[place + int(random.integers(1, 28)) :]
        wire += telegram
    portions = (wire[i : i + 700] for i in range(0, len(wire), 700))
    found = everything(decoder(), *portions)
    sent = {record.tobytes() for record in records}
    wrong = sum(record.tobytes() not in sent for record in found)
    # The remains of two telegrams may have the length of one and the next counter.
    assert losses > 20
    assert wrong <= losses / 20
    assert len(found) - wrong >= len(records) - 2.2 * losses


@pytest.mark.parametrize("restart", [0, 40_000])
def test_a_counter_that_leaps_costs_nothing_where_the_sync_is_in_its_place(restart: int) -> None:
    records = some(20)
    records["83"][10:] = restart + np.arange(10)
    assert everything(decoder(), records.tobytes()).tobytes() == records.tobytes()


def test_two_telegrams_that_make_one_are_none() -> None:
    """The remains of both have the length of one, with FF FF of the second as sync."""
    records = some(12)
    for name in ("66", "67", "68", "69"):
        records[name] = -1
    wire = records.tobytes()
    found = everything(decoder(), wire[: 5 * 28 + 8], wire[5 * 28 + 20 :])
    sent = {record.tobytes() for record in records}
    assert all(record.tobytes() in sent for record in found)
    assert len(found) >= 9


def test_after_a_leap_two_telegrams_and_a_silence_are_two() -> None:
    records = some(3)
    records["83"] = [7, 9000, 9001]
    assert everything(decoder(), records[:2].tobytes()).tobytes() == records[:2].tobytes()
    made = decoder()
    assert len(made.feed(records[:2].tobytes())) + len(made.settle()) == 2
    assert made.feed(records[2:].tobytes()).tobytes() + made.settle().tobytes() == (
        records[2:].tobytes()
    )


@given(st.lists(st.binary(max_size=200), max_size=30))
def test_noise_raises_nothing_and_is_not_kept(portions: list[bytes]) -> None:
    made = decoder()
    for portion in portions:
        made.feed(portion)
        assert made.statistics.bytes_pending <= 11 * 28 + 200
    for _ in range(3):
        made.feed(b"\xff" * 100_000)
        assert made.statistics.bytes_pending <= 11 * 28


def test_a_telegram_cut_off_is_never_completed_by_silence() -> None:
    made = decoder()
    assert len(made.feed(some(1).tobytes()[:-1])) == 0
    assert len(made.settle()) == 0


# Lines.


@given(selections, st.integers(1, 6), st.data())
def test_lines_give_the_same_records_at_any_split(
    numbers: list[int], count: int, data: st.DataObject
) -> None:
    layout = Layout.of(numbers)
    records = some(count, layout, seed=data.draw(st.integers(0, 100)))
    for number in numbers:
        if records[str(number)].dtype.kind == "f":
            records[str(number)] = np.round(np.linspace(-50, 50, count), 4)
    wire = b"".join(layout.lines(records))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)))))
    made = LineDecoder(layout)
    portions = [wire[a:b] for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True)]
    found = everything(made, *portions)
    for number in numbers:
        np.testing.assert_allclose(found[str(number)], records[str(number)], rtol=0, atol=1e-5)
    assert made.statistics.bytes_discarded == 0


@pytest.mark.parametrize(
    "line",
    [
        b"7 1.5 3",
        b" 7 1.5",
        b" 7 1.5 3 4",
        b" 7 1,5 3",
        b" 7.5 1.5 3",
        b" 70000 1.5 3",
        b" 7 nan 3",
    ],
)
def test_a_broken_line_is_no_record(line: bytes) -> None:
    made = LineDecoder(Layout.of((83, 256, 65)))
    assert len(made.feed(line + b"\r\n")) == 0
    assert len(made.feed(b" 8 1.5 3\r\n")) == 1


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_noise_on_lines_raises_nothing(portions: list[bytes]) -> None:
    made = LineDecoder(Layout.of((83, 256, 65)))
    for portion in [*portions, b"\xff" * 100_000]:
        made.feed(portion)
        assert made.statistics.bytes_pending <= 4096
    assert len(made.feed(b"\r\n 8 1.5 3\r\n")) == 1
    total = made.statistics
    assert total.bytes_discarded >= 0
    assume(portions)


@pytest.mark.parametrize("end", [b"x", b"", b" 1"])
def test_long_runs_of_digits_are_no_telegram_at_once(end: bytes) -> None:
    """Each of ten numbers could be split in four hundred ways: a line was tried for hours."""
    layout = Layout.of(tuple(range(64, 74)))
    started = time.process_time()
    made = LineDecoder(layout)
    garbled = b" ".join([b"", *[b"9" * 390] * 10])
    assert len(made.feed(b" 0" * 10 + b"\r\n" + garbled + end + b"\r\n")) == 1
    assert made.statistics.losses_of_sync == 1
    assert time.process_time() - started < 1.0


@pytest.mark.parametrize("seed", range(4))
def test_a_counter_with_a_flipped_bit_moves_no_reading_to_another_sample(seed: int) -> None:
    """Each reading that is handed over states its own number."""
    random = np.random.default_rng(seed)
    records = some(3000, seed=seed)
    records["33024"] = records["83"]  # the distance is the true number
    struck = random.random(len(records)) < 0.02
    records["83"] ^= np.where(struck, 1 << random.integers(0, 16, len(records)), 0).astype(">u2")
    wire = records.tobytes()
    cuts = [0, *np.sort(random.integers(0, len(wire), 300)), len(wire)]
    portions = (wire[a:b] for a, b in itertools.pairwise(cuts))
    found = everything(decoder(), *portions)
    np.testing.assert_array_equal(found["83"], found["33024"])
    assert len(found) > len(records) - 3 * struck.sum()


@pytest.mark.parametrize("kept", [{0}, {0, 2}, {0, 1, 3}])
@pytest.mark.parametrize("synchronised", [True, False])
def test_a_line_that_loses_samples_all_the_time_passes_the_others(
    kept: set[int], synchronised: bool
) -> None:
    """A line may be too slow, or another client divided the output of the serial port."""
    sent = some(5000)
    sent["65"] = -1  # holds the sync bytes, too
    sent = sent[[n % 5 in kept for n in range(len(sent))]]
    wire = sent.tobytes()
    portions = (wire[n : n + 1000] for n in range(0, len(wire), 1000))
    found = everything(decoder(synchronised=synchronised), *portions)
    assert len(found) > 0.99 * len(sent)
    np.testing.assert_array_equal(found["83"], sent["83"][np.isin(sent["83"], found["83"])])
