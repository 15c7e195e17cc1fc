"""Long blocks out of many messages hold what each message holds, taken apart by itself."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.streams.blocks import AxisBlock, Block, DistanceBlock
from omsm_ros.errors import BagError, DataError
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.bags import long_blocks

RANDOM = np.random.default_rng(7)


def axes(first: int, samples: int, stamp: int | None = None, period: float = 1e-3) -> AxisBlock:
    channels = {name: RANDOM.normal(size=samples) for name in "xyzbc"}
    stamp = first * 1_000_000 if stamp is None else stamp
    return AxisBlock(stamp_ns=stamp, first_sample=first, sample_period=period, **channels)


def distance(first: int, samples: int, optional: str = "both") -> DistanceBlock:
    intensity = RANDOM.random(samples if optional in ("both", "intensity") else 0)
    status = RANDOM.integers(0, 5, samples if optional in ("both", "status") else 0)
    return DistanceBlock(
        stamp_ns=10**18 + first,
        first_sample=first,
        sample_period=1e-3,
        distance=RANDOM.normal(size=samples),
        intensity=intensity.astype(np.float32),
        status=status.astype(np.uint8),
    )


def serialised(block: Block, frame: str = "machine") -> bytes:
    if isinstance(block, AxisBlock):
        message = message_mapping.block_message(message_mapping.bag_messages(), block, frame)
        kind = "AxisBlock"
    else:
        message = message_mapping.block_message(message_mapping.bag_messages(), block, frame)
        kind = "DistanceBlock"
    return bytes(message_mapping.typestore().serialize_cdr(message, f"omsm_msgs/msg/{kind}"))


def joined(blocks: Sequence[Block]) -> dict[str, np.ndarray]:
    return {
        f.name: np.concatenate([getattr(b, f.name) for b in blocks])
        for f in fields(blocks[0])
        if f.name != "parts" and isinstance(getattr(blocks[0], f.name), np.ndarray)
    }


@settings(max_examples=60)
@given(
    samples=st.integers(1, 9),
    frame=st.text("abc", max_size=9),
    optional=st.sampled_from(["both", "intensity", "status", "none"]),
)
def test_what_continues_is_one_block_of_the_same_values(
    samples: int, frame: str, optional: str
) -> None:
    for kind, made in (
        (AxisBlock, [axes(k * samples, samples) for k in range(4)]),
        (DistanceBlock, [distance(k * samples, samples, optional) for k in range(4)]),
    ):
        found = long_blocks(kind, [serialised(b, frame) for b in made])
        assert found is not None
        (block,) = found
        expected = joined(made)
        for name, values in expected.items():
            assert getattr(block, name).tobytes() == values.tobytes(), name
            assert getattr(block, name).flags.aligned
        for name in ("stamp_ns", "first_sample", "sample_period"):
            assert getattr(block, name) == getattr(made[0], name)
        # All stamps are kept, since they show an offset of two counters.
        assert block.parts.tolist() == [[b.first_sample, b.stamp_ns] for b in made]


@pytest.mark.parametrize(
    "second",
    [axes(101, 100), axes(100, 100, stamp=0), axes(100, 100, period=2e-3), axes(0, 100)],
    ids=["gap", "time set back", "another period", "restart"],
)
def test_what_does_not_continue_begins_a_block(second: AxisBlock) -> None:
    first = axes(0, 100, stamp=1000)
    found = long_blocks(AxisBlock, [serialised(first), serialised(second)])
    assert found is not None
    for block, made in zip(found, (first, second), strict=True):
        assert block.first_sample == made.first_sample
        assert block.stamp_ns == made.stamp_ns
        assert np.array_equal(block.c, made.c)


def test_messages_of_one_size_but_another_layout_are_left_to_be_taken_apart() -> None:
    one, other = axes(0, 3), axes(3, 3)
    mixed = [serialised(one, "a" * 8), serialised(other, "a" * 9)]
    assert len(mixed[0]) == len(mixed[1])
    assert long_blocks(AxisBlock, mixed) is None


@pytest.mark.parametrize("cut", range(0, 180, 7))
def test_a_message_cut_short_or_forged_is_left_to_be_taken_apart(cut: int) -> None:
    whole = serialised(axes(0, 3))
    assert long_blocks(AxisBlock, [whole[:cut]]) is None
    forged = bytearray(whole)
    forged[cut : cut + 4] = b"\xff\xff\xff\xff"
    found = long_blocks(AxisBlock, [bytes(forged)])
    # Either the layout does not fit any more, or one value of it is another one: which one
    # the block's own class judges.
    with suppress(DataError):
        assert found is None or len(next(iter(found)).z) == 3


def test_big_endian_is_left_to_be_taken_apart() -> None:
    message = bytearray(serialised(axes(0, 3)))
    message[1] = 0
    assert long_blocks(AxisBlock, [bytes(message)]) is None


def test_a_period_that_is_none_is_refused() -> None:
    message = bytearray(serialised(axes(0, 3)))
    place = bytes(message).index(np.float64(1e-3).tobytes())
    message[place : place + 8] = np.float64(-1.0).tobytes()
    with pytest.raises(DataError, match="sample_period"):
        list(long_blocks(AxisBlock, [bytes(message)]) or ())


def test_a_bag_gives_the_same_samples_either_way(tmp_path) -> None:
    sizes, path = [100] * 30 + [37] + [100] * 5, tmp_path / "a.mcap"
    starts = np.cumsum([0, *sizes])
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for first, n in zip(starts.tolist(), sizes, strict=False):
            bag.write_block(axes(first, n))
            bag.write_block(replace(distance(first, n), stamp_ns=first * 1_000_000))
    with bags.BagReader(path) as bag:
        short = list(bag.records(bags.AXES_TOPIC, bags.DISTANCE_TOPIC))
        long = list(bag.blocks(bags.AXES_TOPIC, bags.DISTANCE_TOPIC))
    assert long[-1][0] == len(short) == 2 * len(sizes)
    assert len(long) < 10
    for topic in (bags.AXES_TOPIC, bags.DISTANCE_TOPIC):
        expected = joined([b for t, b in short if t == topic])
        found = joined([b for _, t, b in long if t == topic])
        assert all(
            np.array_equal(found[name], values, equal_nan=True) for name, values in expected.items()
        )


def test_a_block_without_samples_is_a_damaged_bag(tmp_path) -> None:
    path = tmp_path / "empty.mcap"
    message = message_mapping.block_message(message_mapping.bag_messages(), axes(0, 1))
    for name in "xyzbc":
        setattr(message, name, np.empty(0))
    with BagWriter(path, (bags.AXES_TOPIC,)) as bag:
        bag.write(bags.AXES_TOPIC, 0, message)
    with bags.BagReader(path) as bag, pytest.raises(BagError, match="0 samples"):
        list(bag.blocks(bags.AXES_TOPIC))
