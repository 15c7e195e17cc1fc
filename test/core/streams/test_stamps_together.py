"""Stamps that a bag brings by thousands are judged as those that come one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import AxisBlock, joined, uninterrupted
from omsm_ros.core.streams.stamps import StampHistory

from .test_slips import Device, join, without

HALF_A_MINUTE = np.arange(30_000)
Blocks = Sequence[tuple[AxisBlock, np.ndarray]]


def as_a_bag_gives_them(blocks: Blocks) -> list[tuple[AxisBlock, np.ndarray]]:
    """Blocks that follow on as one, which keeps the stamps of all."""
    made: list[tuple[AxisBlock, np.ndarray]] = []
    place = 0
    for run in uninterrupted([block for block, _ in blocks]):
        parts = np.array([(block.first_sample, block.stamp_ns) for block in run])
        numbers = np.concatenate([n for _, n in blocks[place : place + len(run)]])
        made.append((replace(joined(run), parts=parts), numbers))
        place += len(run)
    return made


def lossy(blocks: Blocks, seed: int) -> list[tuple[AxisBlock, np.ndarray]]:
    """Every hundredth block or so was lost."""
    kept = np.random.default_rng(seed).random(len(blocks)) > 0.01
    return [block for block, keep in zip(blocks, kept, strict=True) if keep]


def moved(blocks: Blocks, since: int, by_ns: int) -> list[tuple[AxisBlock, np.ndarray]]:
    """Stamps from a sample on, moved."""
    return [
        (replace(b, stamp_ns=b.stamp_ns + by_ns) if b.first_sample >= since else b, n)
        for b, n in blocks
    ]


def two(jitter: float | None = 2e-5, lengths: tuple[int, int] = (100, 64)) -> tuple[Blocks, Blocks]:
    axes = Device(HALF_A_MINUTE, lengths[0], jitter=jitter, seed=1, regressed=False).blocks()
    probe = Device(HALF_A_MINUTE, lengths[1], jitter=jitter, seed=2, regressed=False)
    return axes, probe.blocks()


def slipped() -> tuple[Blocks, Blocks]:
    probe = Device(without(HALF_A_MINUTE, 15_111, 3), 64, jitter=2e-5, seed=2, regressed=False)
    return two()[0], probe.blocks()


def lost() -> tuple[Blocks, Blocks]:
    axes, probe = two()
    return lossy(axes, 3), lossy(probe, 4)


def paused() -> tuple[Blocks, Blocks]:
    axes, probe = two()
    return moved(axes, 12_000, 3 * 10**9), moved(probe, 12_000, 3 * 10**9)


def parted() -> tuple[Blocks, Blocks]:
    """One driver's, until the clock of one stream steps by less than what is a slip."""
    axes, probe = two(None, (100, 100))
    return axes, moved(probe, 15_000, 100_000)


RECORDINGS: dict[str, Callable[[], tuple[Blocks, Blocks]]] = {
    "one driver": lambda: two(None, (100, 100)),
    "one clock": lambda: two(None),
    "two drivers": two,
    "uneven": lambda: two(2e-4),
    "often off": lambda: two(8e-4),
    "short blocks": lambda: two(2e-5, (100, 16)),
    "slip": slipped,
    "lost": lost,
    "pause": paused,
    "part company": parted,
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_pairs_and_accounts_are_those_of_blocks_one_by_one(name: str) -> None:
    axes, probe = RECORDINGS[name]()
    each = join(axes, probe)
    together = join(as_a_bag_gives_them(axes), as_a_bag_gives_them(probe))
    assert (together.axes, together.distance) == (each.axes, each.distance)
    assert together.accounts == each.accounts
    assert together.seen_from == each.seen_from
    assert together.watch is not None
    assert each.watch is not None
    assert together.watch.found == each.watch.found
    assert (
        together.watch.same_stamps
        is each.watch.same_stamps
        is (name in ("one driver", "one clock"))
    )
    assert (each.slipped > 10_000) is (name == "slip")


def test_a_history_holds_the_last_rows_in_their_order() -> None:
    history, rows = StampHistory(10), np.arange(500.0).reshape(100, 5)
    for end, row in enumerate(rows, start=1):
        history.add(*row)
        assert np.array_equal(history.rows, rows[max(end - 10, 0) : end])
