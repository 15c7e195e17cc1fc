"""Joined or not, the samples are the same, and so are the points made of them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from soaked import always

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import Corrector
from omsm_ros.core.correction.surface_points import join_points, pack_points
from omsm_ros.core.streams.blocks import (
    MOST_TOGETHER,
    AxisBlock,
    DistanceBlock,
    consecutive,
    joined,
)

PERIOD = 1e-3


def merged(blocks):  # type: ignore[no-untyped-def]
    return [joined(together) for together in consecutive(blocks)]


def cut(z: np.ndarray, edges: list[int], jitter_ns: int = 0) -> list[AxisBlock]:
    random = np.random.default_rng(1)
    return [
        AxisBlock(
            stamp_ns=a * 1_000_000 + int(random.integers(-jitter_ns, jitter_ns + 1)),
            first_sample=a,
            sample_period=PERIOD,
            z=z[a:b],
            **dict.fromkeys("xybc", np.zeros(b - a)),
        )
        for a, b in itertools.pairwise(edges)
    ]


def probe(first: int, values: np.ndarray, status: np.ndarray | None = None) -> DistanceBlock:
    extra = {} if status is None else {"status": status}
    return DistanceBlock(
        stamp_ns=first * 1_000_000,
        first_sample=first,
        sample_period=PERIOD,
        distance=values,
        **extra,
    )


def test_single_samples_become_one_block() -> None:
    z = np.arange(50.0)
    (block,) = merged(cut(z, list(range(51)), jitter_ns=400_000))
    assert np.array_equal(block.z, z)
    assert (block.first_sample, len(block)) == (0, 50)


def test_no_more_than_so_many_samples_become_one_block() -> None:
    """A node that had stood still publishes no cloud of minutes."""
    z = np.arange(10_250.0) * 1e-6
    blocks = merged(cut(z, [*range(0, 8001, 20), 10_000, 10_250]))
    assert np.array_equal(np.concatenate([block.z for block in blocks]), z)
    assert [len(block) for block in blocks] == [MOST_TOGETHER] * (8000 // MOST_TOGETHER) + [
        2000,
        250,
    ]


@pytest.mark.parametrize("gap", ["count", "stamp", "period"])
def test_what_does_not_follow_on_stays_apart(gap: str) -> None:
    blocks = cut(np.arange(30.0), [0, 10, 20, 30])
    changed = {
        "count": {"first_sample": 21},
        "stamp": {"stamp_ns": 25_000_000},
        "period": {"sample_period": 2e-3},
    }[gap]
    from dataclasses import replace

    blocks[2] = replace(blocks[2], **changed)
    assert [len(block) for block in merged(blocks)] == [20, 10]


def test_a_status_that_is_not_reported_is_not_invented() -> None:
    blocks = [
        probe(0, np.ones(5)),
        probe(5, np.ones(5), np.array([0, 0, 3, 0, 0], np.uint8)),
        probe(10, np.ones(5), np.zeros(5, np.uint8)),
    ]
    first, second = merged(blocks)
    assert len(first.status) == 0
    assert np.flatnonzero(second.status).tolist() == [2]


def test_stamps_of_a_time_lapse_move_by_no_more_than_a_millisecond() -> None:
    """Played twenty times as fast, a hundred samples take five milliseconds."""
    blocks = cut(np.arange(200.0), list(range(201)))
    from dataclasses import replace

    blocks = [replace(block, stamp_ns=block.stamp_ns // 20) for block in blocks]
    count = np.concatenate([b.first_sample + np.arange(len(b)) for b in merged(blocks)])
    stamp = np.concatenate([b.stamp_ns + np.arange(len(b)) * PERIOD * 1e9 for b in merged(blocks)])
    assert np.array_equal(count, np.arange(200))
    assert np.max(abs(stamp - count * 1e6 / 20)) <= 1e6


@pytest.mark.parametrize("seed", always(0, of=range(5)))
def test_points_are_the_same_to_the_last_bit(seed: int, true_calibration: Calibration) -> None:
    random = np.random.default_rng(seed)
    z = 1e-4 * np.sin(np.arange(3000) * 0.01)
    edges = [0, *sorted(set(random.integers(1, 3000, 300).tolist())), 3000]
    axes = cut(z, edges)
    distance = [probe(b.first_sample, -b.z) for b in axes]

    def points(join: bool) -> bytes:
        corrector = Corrector(true_calibration)
        parts = []
        for start in range(0, len(axes), 20):
            for stream, push in ((axes, corrector.push_axes), (distance, corrector.push_distance)):
                some = stream[start : start + 20]
                for block in merged(some) if join else some:  # type: ignore[type-var]
                    push(block)  # type: ignore[operator]
            parts.append(corrector.take())
        return pack_points(join_points([p for p in parts if p is not None])).tobytes()

    assert points(join=True) == points(join=False)
