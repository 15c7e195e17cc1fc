"""Commands, echoes, answers and telegrams on one line, cut anywhere."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.chrocodile.emulator import RequestParser, answer_wire
from omsm_ros.instruments.chrocodile.protocol import Answer, BinaryDecoder, DollarStream, command
from omsm_ros.instruments.chrocodile.telegram import Layout

LAYOUT = Layout.of((83, 256, 65))


def telegrams(first: int, count: int) -> bytes:
    made = LAYOUT.records(count)
    made["83"] = np.arange(first, first + count)
    made["256"] = 1.5
    return made.tobytes()


def stream() -> DollarStream:
    made = DollarStream()
    made.decoder = BinaryDecoder(LAYOUT)
    made.decoder.reset(synchronised=True)
    return made


def counters(found: list[np.ndarray]) -> list[int]:
    return [int(c) for records in found for c in records["83"]]


def test_commands_by_hand() -> None:
    assert command("SHZ", 1000) == b"$SHZ 1000\r"
    assert command("SHZ", "?") == b"$SHZ ?\r"
    assert command("SODX", 83, 256, 65) == b"$SODX 83 256 65\r"
    assert command("LAI", 12.5) == b"$LAI 12.5\r"
    assert command("STO") == b"$STO\r"


@pytest.mark.parametrize(
    ("name", "argument"), [("sh", 1), ("SHZ", "1,5"), ("SHZ", "a\rb"), ("X", 1)]
)
def test_what_cannot_be_sent_is_refused(name: str, argument: object) -> None:
    with pytest.raises(ConfigurationError):
        command(name, argument)  # type: ignore[arg-type]


@given(st.lists(st.integers(0, 200), max_size=10))
def test_requests_at_any_split(cuts: list[int]) -> None:
    wire = b"noise\r" + command("SODX", 83, 256) + b"\n" + command("SHZ", "?") + command("STA")
    edges = sorted({0, len(wire), *(c for c in cuts if c < len(wire))})
    parser = RequestParser()
    found = [r for a, b in itertools.pairwise(edges) for r in parser.feed(wire[a:b])]
    assert [(r.name, r.arguments) for r in found] == [
        ("SODX", ("83", "256")),
        ("SHZ", ("?",)),
        ("STA", ()),
    ]
    assert b"".join(r.wire for r in found) == wire[6:].replace(b"\n", b"")


def test_endless_noise_at_the_device_is_not_kept() -> None:
    parser = RequestParser()
    for _ in range(100):
        parser.feed(b"$" + b"A" * 10_000)
    assert len(parser._buffer) <= 1024


@given(st.sampled_from(["", "1000", "SHZ 1000", "SHZ 1000\r\n"]), st.data())
def test_an_answer_between_telegrams_at_any_split(text: str, data: st.DataObject) -> None:
    asked = command("SHZ", "?")
    wire = telegrams(0, 3) + answer_wire(asked, text) + telegrams(5, 3)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)))))
    made = stream()
    made.expect(asked)
    found = []
    for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True):
        found += made.feed(wire[a:b])
    found += made.settle()
    assert counters(found) == [0, 1, 2, 5, 6, 7]
    answer = made.take_answer()
    assert answer == Answer(asked, text.strip())
    assert answer.numbers == ((1000.0,) if text else ())
    assert made.take_answer() is None


@pytest.mark.parametrize(
    "wire", [b"1000ready\r\n", b"1000 ready\r\n", b"1000\r\nready\n", b"SHZ1000ready\r\n"]
)
def test_no_separator_before_ready(wire: bytes) -> None:
    asked = command("SHZ", "?")
    made = stream()
    made.expect(asked)
    found = made.feed(asked + wire + telegrams(4, 2))
    answer = made.take_answer()
    assert answer is not None
    assert answer.text.endswith("1000")
    assert counters([*found, *made.settle()]) == [4, 5]


def test_a_telegram_before_the_echo_is_whole_although_nothing_follows_it() -> None:
    made = stream()
    made.expect(command("STO"))
    assert counters(made.feed(telegrams(0, 1) + command("STO"))) == [0]


def test_without_a_decoder_other_bytes_are_discarded() -> None:
    made = DollarStream()
    made.expect(command("STO"))
    assert made.feed(b"SSH-2.0-OpenSSH\r\n") == []
    assert made.take_answer() is None
    assert made.last_outside.startswith(b"SSH-2.0")
    made.feed(answer_wire(command("STO"), ""))
    assert made.take_answer() == Answer(command("STO"), "")


@given(st.lists(st.binary(max_size=200), max_size=20), st.booleans())
def test_noise_raises_nothing(portions: list[bytes], asked: bool) -> None:
    made = stream()
    if asked:
        made.expect(command("VER"))
    for portion in portions:
        made.feed(portion)
    made.settle()


def test_an_endless_answer_is_bounded() -> None:
    made = stream()
    made.expect(command("VER"))
    made.feed(command("VER"))
    for _ in range(30):
        made.feed(b"x" * 10_000)
    made.feed(b"ready\r\n")
    answer = made.take_answer()
    assert answer is not None
    assert len(answer.text) <= 80_000


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("1000", (1000.0,)),
        ("SCA 100", (100.0,)),
        ("CHR2 V1", ()),
        ("-1.5e-3 7 Hz", (-1.5e-3, 7.0)),
        ("1000Hz", (1000.0,)),
    ],
)
def test_numbers_of_an_answer(text: str, numbers: tuple[float, ...]) -> None:
    assert Answer(b"", text).numbers == numbers


@pytest.mark.parametrize("echo", [b"$AVD ?\r", b"$AVD ?", b"$AVD ?\r\n", b"$avd ?\r"])
@pytest.mark.parametrize(
    "ready", [b"ready\r\n", b"ready\n", b"ready", b"ready\r", b" ready \r\n", b"Ready\r\n"]
)
@pytest.mark.parametrize("portion", [1, 5, 100])
def test_other_ways_to_echo_and_to_end_are_understood(
    echo: bytes, ready: bytes, portion: int
) -> None:
    made = DollarStream()
    made.expect(command("AVD", "?"))
    wire = echo + b"12\r\n" + ready
    for start in range(0, len(wire), portion):
        made.feed(wire[start : start + portion])
    made.settle_answer()  # nothing more comes
    answer = made.take_answer()
    assert answer is not None
    assert answer.numbers == (12.0,)


@pytest.mark.parametrize("telegram", [b"\xff\xff\x00\x07", b" 7 1.5"])
def test_a_telegram_may_follow_ready_at_once(telegram: bytes) -> None:
    made = DollarStream()
    made.expect(command("STA"))
    made.feed(b"$STA\rready" + telegram)
    assert made.take_answer() == Answer(command("STA"), "")


def test_an_answer_that_goes_on_is_not_ended_by_a_pause() -> None:
    made = DollarStream()
    made.expect(command("VER"))
    made.feed(b"$VER\rCHRocodile 2")
    made.settle_answer()
    assert made.take_answer() is None
    made.feed(b" S\r\nready\r\n")
    assert made.take_answer() == Answer(command("VER"), "CHRocodile 2 S")
