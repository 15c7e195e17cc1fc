"""Many small blocks as few large ones: a filter's call costs more than a sample.

Whoever falls behind finds more blocks waiting, and catches up by dealing with them at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from omsm_ros.core.samples.blocks import AxisBlock, Block, DistanceBlock
from omsm_ros.units import NANOSECONDS_PER_S

B = TypeVar("B", AxisBlock, DistanceBlock)
AnyBlock = TypeVar("AnyBlock", bound=Block)

MOST_TOGETHER = 100
"""Samples, as a driver's block has: each place in a queue keeps room for its longest message."""

# Stamps within one block are those of its first sample and the period; they are moved no further.
_STAMP_TOLERANCE_S = 1e-3
_NO_CHANNELS = ("stamp_ns", "first_sample", "sample_period", "parts")


def uninterrupted(blocks: Sequence[AnyBlock]) -> list[list[AnyBlock]]:
    """Return the blocks in runs, the count of each block following on that of the one before."""
    runs: list[list[AnyBlock]] = []
    for block in blocks:
        if runs and block.first_sample == runs[-1][-1].end:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs


def consecutive(blocks: Sequence[B]) -> list[list[B]]:
    """Return the blocks in their order, those in one list that :func:`joined` can make one.

    They have consecutive counts, one period, the same channels, and stamps that continue the
    first one's; beyond MOST_TOGETHER samples a list has one block.
    """
    runs: list[list[B]] = []
    length = 0
    for block in blocks:
        fits = length + len(block) <= MOST_TOGETHER
        if runs and fits and _continues(runs[-1][0], length, block):
            runs[-1].append(block)
            length += len(block)
        else:
            runs.append([block])
            length = len(block)
    return runs


def _continues(first: B, length: int, block: B) -> bool:
    period = first.sample_period
    if block.first_sample != first.first_sample + length or block.sample_period != period:
        return False
    off_ns = block.stamp_ns - first.stamp_ns - length * period * NANOSECONDS_PER_S
    return abs(off_ns) <= _STAMP_TOLERANCE_S * NANOSECONDS_PER_S and _given(first) == _given(block)


def _given(block: B) -> tuple[str, ...]:
    """Return names of the channels that have samples: an empty one means something of its own."""
    return tuple(name for name in _channels(block) if len(getattr(block, name)))


def _channels(block: B) -> tuple[str, ...]:
    return tuple(f.name for f in fields(block) if f.name not in _NO_CHANNELS)


def joined(run: Sequence[B]) -> B:
    """Return one block of the samples of several that follow on, with the first one's stamp."""
    if len(run) == 1:
        return run[0]
    return replace(
        run[0],
        **{
            name: np.concatenate([getattr(block, name) for block in run])
            for name in _channels(run[0])
        },
    )


def without_first(block: B, messages: int) -> B:
    """Return a block that was joined of several messages without the first of them."""
    if not messages:
        return block
    first, stamp_ns = block.parts[messages].tolist()
    start = first - block.first_sample
    return replace(
        block,
        first_sample=first,
        stamp_ns=stamp_ns,
        parts=block.parts[messages:],
        **{name: getattr(block, name)[start:] for name in _channels(block)},
    )
