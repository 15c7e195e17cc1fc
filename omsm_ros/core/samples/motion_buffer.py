"""The last motion of the cell, kept while it happens, for an identification on request."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.samples.continuity import TIME_JUMP_S
from omsm_ros.units import NANOSECONDS_PER_S

B = TypeVar("B", AxisBlock, DistanceBlock)


class BlockBuffer(Generic[B]):
    """Blocks of one topic since its trigger counter last started anew, bounded in samples.

    The oldest blocks go when ``capacity`` samples are exceeded; ``forgotten`` counts theirs.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._blocks: deque[B] = deque()
        self._samples = 0
        self.forgotten = 0

    def add(self, block: B) -> None:
        """Append a block; a counter that falls back behind the last block begins a new motion.

        Unless its stamp is a little older too: then the block came late, or once more.
        """
        if not self._blocks or block.first_sample >= self._blocks[-1].first_sample:
            self._blocks.append(block)
        elif 0 < self._blocks[-1].stamp_ns - block.stamp_ns <= TIME_JUMP_S * NANOSECONDS_PER_S:
            self._blocks.insert(len(self._blocks) - 1, block)
        else:
            self._forget(len(self._blocks))
            self._blocks.append(block)
        self._samples += len(block)
        while self._samples > self._capacity and len(self._blocks) > 1:
            self._forget(1)

    def forget(self) -> None:
        """Forget all blocks: what comes does not belong to them."""
        self._forget(len(self._blocks))

    def _forget(self, blocks: int) -> None:
        for _ in range(blocks):
            samples = len(self._blocks.popleft())
            self._samples -= samples
            self.forgotten += samples

    def __len__(self) -> int:
        """Samples held."""
        return self._samples

    def recent(self, duration: float = 0.0) -> list[B]:
        """Return blocks that reach into the last ``duration`` seconds of the motion; 0 = all."""
        if not self._blocks or duration == 0:
            return list(self._blocks)
        last = self._blocks[-1]
        first = last.end - duration / last.sample_period
        return [b for b in self._blocks if b.end > first]
