"""Counts that no longer mean the same trigger are found by their stamps, and nothing else is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.streams.blocks import AxisBlock, StreamAccount
from omsm_ros.core.streams.pairing import Pairing, SampleRun, StreamInput
from omsm_ros.core.streams.trigger_slips import CommonTrigger, TriggerSlipDetector
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.arrivals import DeviceClock

PERIOD = 1e-3
EPOCH = 1_700_000_000 * 10**9


@dataclass(frozen=True)
class Device:
    """A device that counts triggers, each known by its number in truth.

    triggers: that it counted;  jitter: of its arrivals, ±, uniform [s]; None = exact stamps
    drift: its clock gains so much;  regressed: stamped by a driver's clock, not by arrival
    """

    triggers: np.ndarray
    length: int = 50
    period: float = PERIOD
    jitter: float | None = None
    drift: float = 0.0
    seed: int = 0
    regressed: bool = True
    first: int = 0

    def blocks(self) -> list[tuple[AxisBlock, np.ndarray]]:
        """Blocks that stand for either stream, and the true numbers of their triggers."""
        random, clock = np.random.default_rng(self.seed), DeviceClock()
        found = []
        for start in range(0, len(self.triggers), self.length):
            numbers = self.triggers[start : start + self.length]
            taken = numbers * self.period
            stamp = EPOCH + round(taken[0] * 1e9)
            if self.jitter is not None:
                late = random.uniform(-self.jitter, self.jitter)
                arrival = EPOCH + round((taken[-1] + late) * 1e9)
                device = [round(t * (1 + self.drift) * 1e9) for t in (taken[0], taken[-1])]
                if self.regressed:
                    clock.observe(device[1], arrival)
                    stamp = clock.to_host(device[0])
                else:
                    stamp = arrival - (device[1] - device[0])
            n = len(numbers)
            block = AxisBlock(
                stamp_ns=stamp,
                first_sample=self.first + start,
                sample_period=self.period,
                z=numbers.astype(float) * 1e-9,
                **dict.fromkeys("xybc", np.zeros(n)),
            )
            found.append((block, numbers))
        return found


@dataclass
class Joined:
    """Pairs and accounts of two streams."""

    axes: list[int] = field(default_factory=list)
    distance: list[int] = field(default_factory=list)
    slips: list[int] = field(default_factory=list)
    seen_from: int | None = None
    held: list[int] = field(default_factory=list)
    accounts: tuple[StreamAccount, StreamAccount] = (StreamAccount(), StreamAccount())
    watch: TriggerSlipDetector | None = None

    @property
    def wrong(self) -> np.ndarray:
        """True numbers of the axes' triggers that were paired with another one."""
        axes, distance = np.array(self.axes), np.array(self.distance)
        return np.asarray(axes[axes != distance])

    @property
    def slipped(self) -> int:
        return self.accounts[0].counted.get("slipped", 0)


def join(
    axes: Iterable[tuple[AxisBlock, np.ndarray]],
    distance: Iterable[tuple[AxisBlock, np.ndarray]],
    trigger: CommonTrigger = CommonTrigger(),  # noqa: B008
    order: Sequence[int] | None = None,
) -> Joined:
    """Push both in the order of their stamps, or as ``order`` says, or one after the other."""
    done = Joined()
    intakes = StreamInput(), StreamInput(trigger.counter_offset)
    pairing = Pairing(*intakes, trigger)
    queues = pairing.axes, pairing.distance
    both = [(k, *b) for k, blocks in enumerate((axes, distance)) for b in blocks]
    if order is None:
        both.sort(key=lambda item: item[1].stamp_ns)
    else:
        sides = [[b for b in both if b[0] == k] for k in (0, 1)]
        both = [sides[k].pop(0) for k in order] + sides[0] + sides[1]
    for k, block, numbers in both:
        if (arrival := intakes[k].new(block)) is not None:
            values = np.asarray(numbers, np.float64)[np.newaxis]
            queues[k].push(SampleRun.of(block, arrival, np.zeros(len(block), np.uint8), values))
        for a, d in pairing.pairs():
            done.axes += [int(v) for v in a.values[0]]
            done.distance += [int(v) for v in d.values[0]]
        done.slips.append(pairing.watch.state.samples)
        done.held.append(queues[0].held)
    for a, d in pairing.end():
        done.axes += [int(v) for v in a.values[0]]
        done.distance += [int(v) for v in d.values[0]]
    assert queues[0].held == queues[1].held == 0
    for queue in queues:
        queue.clear()
    accounts = [intake.tally.snapshot(0) for intake in intakes]
    for account in accounts:
        assert account.received == account.corrected + sum(account.counted.values())
    assert accounts[0].counted.get("slipped", 0) == accounts[1].counted.get("slipped", 0)
    done.accounts = accounts[0], accounts[1]
    done.seen_from, done.watch = pairing.watch.state.seen_from, pairing.watch
    return done


ALL = np.arange(6000)


def without(numbers: np.ndarray, first: int, samples: int) -> np.ndarray:
    return np.delete(numbers, np.arange(first, first + samples))


@pytest.mark.parametrize("missed", [1, 10, 100])
@pytest.mark.parametrize("who", ["axes", "distance"])
@pytest.mark.parametrize("jitter", [None, 1e-5], ids=["exact", "10 us"])
def test_missed_triggers_are_found_within_a_second(
    missed: int, who: str, jitter: float | None
) -> None:
    at = 3000
    lacking = without(ALL, at, missed)
    a, d = (lacking, ALL) if who == "axes" else (ALL, lacking)
    done = join(Device(a, jitter=jitter).blocks(), Device(d, jitter=jitter, seed=1).blocks())
    # With stamps as equal as one driver's, what is left of the block is paired already.
    assert len(done.wrong) <= (50 if jitter is None else 0)
    assert done.slips[-1] == (missed if who == "axes" else -missed)
    assert done.slipped == 6000 - missed - len(done.axes) > 1500
    assert done.watch is not None
    assert f"slipped by {done.slips[-1]} samples" in str(done.watch.found)


@pytest.mark.parametrize("length", [100, 250])
def test_a_slip_of_long_blocks_is_no_movement_of_clocks(length: int) -> None:
    """Eight blocks of 0.4 or 1 s last longer than the span of a verdict otherwise is."""
    lacking = without(ALL, 3000, 3)
    axes, distance = Device(ALL, 20, 4e-3, 1e-5), Device(lacking, length, 4e-3, 1e-5, seed=1)
    done = join(axes.blocks(), distance.blocks())
    assert len(done.wrong) == 0
    assert done.slips[-1] == -3
    assert done.axes[-1] > 3000 - 2 * length


@pytest.mark.parametrize("late", [1, 10, 300])
def test_nothing_is_paired_with_a_counter_that_was_started_late(late: int) -> None:
    done = join(Device(ALL).blocks(), Device(ALL[late:]).blocks())
    assert done.axes == []
    assert done.slips[-1] == -late
    assert done.slipped == 6000 - late


@pytest.mark.parametrize("late", [1, 10, 300])
def test_an_offset_that_is_stated_is_none(late: int) -> None:
    stated = CommonTrigger(counter_offset=late)
    done = join(Device(ALL).blocks(), Device(ALL[late:]).blocks(), stated)
    assert len(done.wrong) == done.slipped == 0
    assert len(done.axes) == 6000 - late
    swapped = join(
        Device(ALL[late:]).blocks(), Device(ALL).blocks(), CommonTrigger(counter_offset=-late)
    )
    assert len(swapped.wrong) == swapped.slipped == 0
    assert len(swapped.axes) == 6000 - late


def test_the_remedy_names_the_offset_that_would_do() -> None:
    done = join(Device(ALL).blocks(), Device(ALL[7:]).blocks())
    assert done.watch is not None
    assert "'counter_offset' 7 " in str(done.watch.state)


@pytest.mark.parametrize("who", [0, 1])
def test_a_device_that_begins_anew_alone_is_never_paired_wrongly_for_long(who: int) -> None:
    whole = Device(ALL).blocks()
    restarted = [*Device(ALL[:2000]).blocks(), *Device(ALL[2500:]).blocks()]
    done = join(restarted if who == 0 else whole, whole if who == 0 else restarted)
    assert len(done.wrong) == 0
    assert done.axes[:2000] == list(range(2000))


def test_it_heals_when_both_begin_anew() -> None:
    axes = [*Device(ALL[:3000]).blocks(), *Device(ALL[3500:]).blocks()]
    distance = [*Device(ALL[5:3000]).blocks(), *Device(ALL[3500:]).blocks()]
    done = join(axes, distance)
    assert min(done.slips) == -5
    assert done.slips[-1] == 0
    assert done.axes[-2500:] == done.distance[-2500:] == list(range(3500, 6000))


def test_it_heals_when_the_counts_agree_again() -> None:
    """One missed a trigger, and two seconds later the other did."""
    done = join(Device(without(ALL, 2000, 1)).blocks(), Device(without(ALL, 4000, 1)).blocks())
    assert max(done.slips) == 1
    assert done.slips[-1] == 0
    assert np.all((done.wrong >= 2000) & (done.wrong < 4000))
    assert done.axes[-1000:] == done.distance[-1000:]
    assert 1000 < done.slipped < 2600


@pytest.mark.parametrize("seed", [0, *soaked(*range(1, 6))])
@pytest.mark.parametrize("regressed", [True, False], ids=["regressed", "arrival"])
@pytest.mark.parametrize("length", [20, *soaked(50, 100)])
def test_jitter_and_drift_raise_no_alarm(seed: int, regressed: bool, length: int) -> None:
    axes = Device(ALL, length, jitter=1e-3, drift=50e-6, seed=seed, regressed=regressed)
    probe = Device(ALL, length, jitter=1e-3, drift=-50e-6, seed=seed + 99, regressed=regressed)
    if not regressed:  # the stamps are of arrival; what lies within a block is as the device says
        assert join(axes.blocks(), probe.blocks()).seen_from is not None
    done = join(axes.blocks(), probe.blocks())
    assert set(done.slips) == {0}
    assert len(done.axes) == 6000
    assert done.slipped == 0


@pytest.mark.parametrize("seed", [2, *soaked(3, 10)])
def test_arrivals_uneven_by_20_ms_raise_no_alarm_while_clocks_learn(seed: int) -> None:
    axes = Device(ALL, jitter=20e-3, drift=50e-6, seed=seed)
    probe = Device(ALL, jitter=20e-3, drift=-50e-6, seed=seed + 999)
    assert set(join(axes.blocks(), probe.blocks()).slips) == {0}


@pytest.mark.parametrize("seed", range(3))
def test_two_samples_are_found_within_a_second_of_uneven_arrivals(seed: int) -> None:
    axes = Device(ALL[:5000], jitter=1e-3, seed=seed)
    probe = Device(without(ALL[:5000], 3000, 2), jitter=1e-3, seed=seed + 999)
    done = join(axes.blocks(), probe.blocks())
    assert len(done.wrong) == 0
    assert done.slips.index(-2) * 50 / 2 < 3000 + 1000
    assert len(done.axes) + done.slipped == 4998


@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_at_70_khz_it_says_what_it_cannot_tell(seed: int) -> None:
    period = 1 / 70e3
    number = np.arange(70_000 * 4)
    axes = Device(number, 1400, period, jitter=1e-3, drift=50e-6, seed=seed)
    probe = Device(number, 1400, period, jitter=1e-3, seed=seed + 99)
    done = join(axes.blocks(), probe.blocks())
    assert set(done.slips) == {0}
    # 0.2 ms are 14 samples.
    assert done.seen_from is not None
    assert done.seen_from >= 15
    lacking = Device(without(number, 140_000, 700), 1400, period, jitter=1e-3, seed=seed + 99)
    found = join(axes.blocks(), lacking.blocks())
    assert found.slips[-1] == pytest.approx(-700, abs=35)
    assert len(found.wrong) == 0
    assert 140_000 - 70_000 < len(found.axes) <= 140_000


def test_blocks_of_one_sample_and_of_other_lengths() -> None:
    number = np.arange(3000)
    done = join(Device(number, 1).blocks(), Device(number, 70).blocks())
    assert set(done.slips) == {0}
    assert len(done.axes) == 3000
    slipped = join(Device(number, 1).blocks(), Device(without(number, 1500, 1), 70).blocks())
    assert slipped.slips[-1] == -1
    assert len(slipped.wrong) <= 70


@pytest.mark.parametrize("length", [200, 1000])
@pytest.mark.parametrize("jitter", [None, 3e-4])
def test_too_few_stamps_for_a_verdict_decide_at_the_end(length: int, jitter: float | None) -> None:
    """A second of blocks, of which one stream lacks two triggers or none."""
    axes = Device(ALL[:1000], length, jitter=jitter, seed=1).blocks()
    whole = join(axes, Device(ALL[:1000], 200, jitter=jitter, seed=2).blocks())
    assert len(whole.axes) == 1000
    lacking = join(axes, Device(ALL[2:1000], 200, jitter=jitter, seed=2).blocks())
    assert lacking.axes == []
    assert lacking.slipped == 998
    assert "slipped by -2 samples" in str(lacking.watch and lacking.watch.found)


def test_one_long_block_is_compared_and_no_stamps_tell_nothing() -> None:
    one = join(Device(ALL, 6000).blocks(), Device(ALL[3:], 100).blocks())
    assert one.axes == []
    assert len(join(Device(ALL, 6000).blocks(), Device(ALL, 100).blocks()).axes) == 6000
    coarse = Device(ALL, 50, period=PERIOD)
    zero = [(_stamped(block, 0), numbers) for block, numbers in coarse.blocks()]
    assert set(join(zero, zero).slips) == {0}


@pytest.mark.parametrize("lengths", [(50, 50), (100, 25), (70, 100), (100, 20)])
def test_time_lapse_raises_no_alarm(lengths: tuple[int, int]) -> None:
    streams = [
        [
            (_stamped(block, EPOCH + (block.stamp_ns - EPOCH) // 20), numbers)
            for block, numbers in Device(ALL, length).blocks()
        ]
        for length in lengths
    ]
    done = join(*streams)
    assert set(done.slips) == {0}
    assert done.seen_from is None
    # Nor if one of the two links is late by several of its short samples.
    late = [(_stamped(block, block.stamp_ns + 5_000_000), n) for block, n in streams[0]]
    assert set(join(late, streams[1]).slips) == {0}


@pytest.mark.parametrize("grain", [10**6, 10**7, 10**9])
def test_coarse_stamps_raise_no_alarm(grain: int) -> None:
    streams = [
        [(_stamped(b, b.stamp_ns // grain * grain), n) for b, n in Device(ALL, length).blocks()]
        for length in (30, 70)
    ]
    assert set(join(*streams).slips) == {0}


def test_a_link_known_to_be_late_is_tolerated() -> None:
    late = [(_stamped(b, b.stamp_ns + 8_000_000), n) for b, n in Device(ALL).blocks()]
    assert join(late, Device(ALL).blocks()).slips[-1] == 8
    done = join(late, Device(ALL).blocks(), CommonTrigger(stamp_tolerance=0.016))
    assert set(done.slips) == {0}
    assert done.seen_from == 17


@pytest.mark.parametrize("delay_ns", [300_000, 600_000])
def test_a_slip_that_cancels_the_delay_of_the_link_is_found_by_the_change(delay_ns: int) -> None:
    """After a slip by a sample the stamps agree to 0.7 ms or 0.4 ms, which alone is none."""
    late = [(_stamped(b, b.stamp_ns + delay_ns), n) for b, n in Device(ALL, jitter=1e-5).blocks()]
    done = join(late, Device(ALL, 80, jitter=1e-5, seed=1).blocks())
    assert set(done.slips) == {0}
    probe = Device(without(ALL, 4010, 1), 80, jitter=1e-5, seed=1).blocks()
    found = join(late, probe)
    assert found.slips[-1] == -1
    assert len(found.wrong) == 0
    assert 3900 < len(found.axes) <= 4010


@pytest.mark.parametrize("seed", range(4))
def test_the_outcome_does_not_depend_on_how_the_streams_were_interleaved(seed: int) -> None:
    axes = Device(without(ALL, 1700, 10), 40, jitter=2e-4, seed=1).blocks()
    probe = Device(without(ALL, 3900, 10), 90, jitter=2e-4, seed=2).blocks()
    live = join(axes, probe)
    order = np.random.default_rng(seed).permutation([0] * len(axes) + [1] * len(probe))
    for other in (join(axes, probe, order=[]), join(axes, probe, order=list(order))):
        assert (other.axes, other.distance) == (live.axes, live.distance)
        assert other.accounts == live.accounts
    assert live.slipped > 500


def test_what_was_stated_is_checked() -> None:
    with pytest.raises(ConfigurationError, match="counter_offset"):
        CommonTrigger(counter_offset=2**60)
    with pytest.raises(ConfigurationError, match="stamp_tolerance"):
        CommonTrigger(stamp_tolerance=-1.0)


def _stamped(block: AxisBlock, stamp_ns: int) -> AxisBlock:
    return replace(block, stamp_ns=stamp_ns)


@pytest.mark.parametrize("ahead", [0, 1])
def test_a_start_in_doubt_waits_and_is_refused_after_ten_seconds(ahead: int) -> None:
    """One trigger less a delay of 0.2 ms is between the limits without and with the scatter."""
    axes = Device(np.arange(ahead, 12_000), jitter=0.15e-3, regressed=False, seed=1).blocks()
    distance = Device(np.arange(12_000)).blocks()
    delayed = [
        (replace(block, stamp_ns=block.stamp_ns - 200_000), numbers) for block, numbers in axes
    ]
    short = [part[:120] for part in (delayed, distance)]  # six seconds
    early, done = join(*short), join(delayed, distance)
    assert early.watch is not None
    assert early.watch.in_doubt == bool(ahead)
    assert bool(early.axes) != bool(ahead)
    assert len(done.wrong) == 0
    assert bool(done.slips[-1]) == bool(ahead)
