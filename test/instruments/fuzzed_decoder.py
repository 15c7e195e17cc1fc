"""Feeds one decoder with what atheris makes of its code: ``fuzzed_decoder.py NAME [-runs=N]``."""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["omsm_ros.protocols"]):
    from test_decoders_at_length import CASES, good_ones

_name = sys.argv.pop(1)
_make, _, _bound = CASES[_name]


def once(data: bytes) -> None:
    """Feed ``data`` at once and in three portions: nothing may be raised, little may be kept."""
    at_once, in_portions = _make(), _make()
    at_once.feed(data)
    first = data[0] if data else 0
    second = first + 7 * (data[-1] if data else 0)
    for portion in (data[:first], data[first:second], data[second:]):
        in_portions.feed(portion)
    pending = in_portions.statistics.bytes_pending
    assert pending <= _bound + len(data), pending
    assert good_ones(in_portions) == good_ones(at_once)


atheris.Setup(sys.argv, once)
atheris.Fuzz()
