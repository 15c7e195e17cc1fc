"""The wires of the devices once more, from their manuals: byte after byte, in plain Python.

Nothing of the package is used here, so what it encodes wrongly, it is not decoded wrongly, too.
"""

from __future__ import annotations

import math


def little(value: int, size: int) -> bytes:
    """Two's complement, low byte first."""
    return bytes(value >> 8 * i & 0xFF for i in range(size))


def big(value: int, size: int) -> bytes:
    return little(value, size)[::-1]


def single(value: float) -> bytes:
    """IEEE 754 with 32 bits, low byte first; of normal numbers and zero."""
    if value == 0:
        return bytes(4)
    mantissa, exponent = math.frexp(abs(value))
    fraction = round((2 * mantissa - 1) * 2**23)
    return little((value < 0) << 31 | (exponent + 126) << 23 | fraction, 4)


def crc32(data: bytes) -> int:
    """The polynomial division of ISO-HDLC, bit after bit."""
    remainder = 0xFFFFFFFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder >> 1 ^ (0xEDB88320 if remainder & 1 else 0)
    return remainder ^ 0xFFFFFFFF


def stuffed(data: bytes) -> bytes:
    """COBS (Cheshire and Baker 1999): each run without a zero after its length and one."""
    made, run = b"", b""
    for byte in data:
        if byte:
            run += bytes([byte])
            if len(run) == 254:
                made, run = made + b"\xff" + run, b""
        else:
            made, run = made + bytes([len(run) + 1]) + run, b""
    return made + bytes([len(run) + 1]) + run


def six_channels(
    sequence: int, time_ns: int, nanometres: int, status: int, counts: list[int]
) -> bytes:
    body = little(sequence, 4) + little(time_ns, 8) + little(nanometres, 4) + bytes([status])
    body += b"".join(little(count, 8) for count in counts)
    return stuffed(body + little(crc32(body), 4)) + b"\0"


def telegram(*signals: tuple[int, float], sync: bytes = b"\xff\xff") -> bytes:
    """A dollar telegram of (bits, value): 16 bits high byte first, 32 low byte first, 0 a float."""
    made = sync
    for bits, value in signals:
        if bits == 0:
            made += single(value)
        else:
            made += big(int(value), 2) if bits == 16 else little(int(value), 4)
    return made


def packet(kind: int, body: bytes) -> bytes:
    """A packet of a CHRocodile 2: magic, whole length, eight reserved bytes, type."""
    return b"\x55\xaa\x55\xaa" + little(20 + len(body), 4) + bytes(8) + little(kind, 4) + body


def packet_command(name: str, flags: int, ticket: int, *arguments: bytes) -> bytes:
    body = name.encode().ljust(4, b"\0") + bytes(8) + little(flags, 2) + bytes(2)
    body += little(ticket, 2) + little(len(arguments), 2) + b"".join(arguments)
    return packet(0x00444D43, body)


def packet_format(counter: int, rate: float, *signals: tuple[int, int]) -> bytes:
    """signals: type and number, one channel each."""
    body = little(0, 4) + little(counter, 4) + single(rate) + little(len(signals), 4)
    for kind, number in signals:
        body += bytes([kind, 0]) + little(1, 2) + little(0, 2) + little(number, 2)
    return packet(0x00544644, body)


def packet_data(counter: int, seconds: int, fraction: int, count: int, samples: bytes) -> bytes:
    """fraction: of the second, in parts of 2^32."""
    body = little(0, 4) + little(counter, 4) + little(fraction, 4) + little(seconds, 4)
    return packet(0x00544144, body + little(count, 4) + samples)


def three_bytes(value: int, first: bool = True) -> bytes:
    """One value of a confocalDT over RS-422."""
    low, middle, high = value & 63, value >> 6 & 63, value >> 12 & 63
    return bytes([low, 64 + middle, (128 if first else 192) + high])


def block(kind: bytes, counter: int, frames: list[bytes], preamble: bytes = b"MEAS") -> bytes:
    """A block of a Micro-Epsilon controller; kind: eight bytes of flags, or channels and status."""
    head = preamble + little(2_418_004, 4) + little(11_020_009, 4) + kind
    head += little(len(frames), 2) + little(len(frames[0]), 2) + little(counter, 4)
    return head + b"".join(frames)
