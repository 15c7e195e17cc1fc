"""The last motion of the cell, kept while it happens, for an identification on request."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.samples.continuity import TIME_JUMP_S
from omsm_ros.core.samples.merging import consecutive, joined
from omsm_ros.units import NANOSECONDS_PER_S

B = TypeVar("B", AxisBlock, DistanceBlock)

# A block takes some 2 kB beside its samples, which is much for a block of one and little for one
# of a hundred: that many blocks are joined as long as they hold fewer samples than that each.
_MANY = 100


class BlockBuffer(Generic[B]):
    """Blocks of one topic since its trigger counter last started anew, bounded in samples.

    The oldest blocks go when ``capacity`` samples are exceeded; ``forgotten`` counts theirs.
    Short blocks that follow on are joined, so that memory is that of their samples.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._blocks: deque[B] = deque()
        self._samples = 0
        self._apart = 0  # of the newest blocks, those not joined yet
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
        self._apart += 1
        if self._apart > _MANY:
            self._join()
        while self._samples > self._capacity and len(self._blocks) > 1:
            self._forget(1)

    def _join(self) -> None:
        """Join short blocks but the newest, which a late one may still have to stand before."""
        newest = self._blocks.pop()
        blocks: list[B] = [self._blocks.pop() for _ in range(self._apart - 1)][::-1]
        if sum(map(len, blocks)) < _MANY * len(blocks):
            blocks = [joined(run) for run in consecutive(blocks)]
        self._blocks.extend(blocks)
        self._blocks.append(newest)
        self._apart = 1

    def forget(self) -> None:
        """Forget all blocks: what comes does not belong to them."""
        self._forget(len(self._blocks))

    def _forget(self, blocks: int) -> None:
        for _ in range(blocks):
            samples = len(self._blocks.popleft())
            self._samples -= samples
            self.forgotten += samples
        self._apart = min(self._apart, len(self._blocks))

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
