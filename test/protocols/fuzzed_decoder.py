"""Feeds one decoder with what atheris makes of its code: ``fuzzed_decoder.py NAME [-runs=N]``."""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["omsm_ros.protocols"]):
    from test_decoders_at_length import CASES

_name = sys.argv.pop(1)
_make, _, _bound = CASES[_name]


def once(data: bytes) -> None:
    """Feed ``data`` in two portions: nothing may be raised, little may be kept."""
    decoder = _make()
    cut = data[0] if data else 0
    for portion in (data[:cut], data[cut:]):
        decoder.feed(portion)
    pending = decoder.statistics.bytes_pending
    assert pending <= _bound + len(data), pending


atheris.Setup(sys.argv, once)
atheris.Fuzz()
