"""Axes without device time that miss triggers: no point of two triggers is ever published.

Both wires are written here, in plain numpy and text: a probe that sends its own time, and axes as
``halsampler`` prints them, in portions whose last sample is up to a period old.
"""

from __future__ import annotations

import itertools
import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import two_counters
from soaked import soaked

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.instruments.arrivals import MissedTriggerDetector
from omsm_ros.instruments.blocks import BlockCutter, BlockSettings, Channels
from omsm_ros.instruments.counting import SAMPLE, CountedRun
from omsm_ros.instruments.emulator import AXIS_SCALING
from omsm_ros.instruments.six_channel.device import (
    CsvSettings,
    CsvStreamDevice,
    GenericStreamDevice,
    StreamSettings,
)
from omsm_ros.instruments.six_channel.protocol import ENCODED_SIZE, FRAME, encode_frames

from .scripted_stream import Script

# `OMSM_MISSED_TRIGGERS=200` tries as many.
CASES = int(os.environ.get("OMSM_MISSED_TRIGGERS", "1"))
PERIOD, SECONDS = 1e-3, 7.0
UPTIME_S = 123_456.0  # of the host, from which its monotonic clock counts
EPOCH_NS = 1_700_000_000 * 10**9
COLUMNS = ("sequence", "x", "y", "z", "b", "c")


class Wire:
    """Plays portions at their times; a read waits for the next one, and for the host's delay."""

    name = "tcp://axes:1"

    def __init__(
        self, parts: list[bytes], taken: np.ndarray, edges: np.ndarray, delays: np.ndarray
    ) -> None:
        self.parts = parts
        ends = np.searchsorted(taken, edges)
        pieces = zip(edges[1:], ends[:-1], ends[1:], strict=True)
        self.portions = [(float(at), b"".join(parts[a:b])) for at, a, b in pieces if b > a]
        self.now, self.delays = 0.0, iter(delays)

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def write(self, data: bytes) -> None:
        raise AssertionError("nobody is spoken to")

    def read(self, timeout: float) -> bytes:
        if self.portions and self.portions[0][0] <= self.now + timeout:
            self.now, data = max(self.now, self.portions[0][0]) + float(next(self.delays)), b""
            while self.portions and self.portions[0][0] <= self.now:
                data += self.portions.pop(0)[1]
            return data
        self.now += timeout
        return b""

    def clock_ns(self) -> int:
        return EPOCH_NS + round(self.now * 1e9)


@dataclass
class Outcome:
    """Points published before the missed trigger, after it, and of two triggers.

    last: count of the last point;  withheld: until the end of the run;  waited: at its end
    """

    wrong: int
    right: int
    again: int
    last: int
    found_after: float | None
    missed: int
    withheld: int
    waited: int


def run(
    seed: int, missed: int, busy: float = 0.0, when: tuple[float, float] = (3.5, 5.0)
) -> Outcome:
    """Miss ``missed`` triggers at a random time, with portions of 2 to 50 ms.

    busy: mean delay of most reads by a host that is busy now and then [s]
    when: range of the time [s]
    """
    random = np.random.default_rng(seed)
    true = np.arange(round(SECONDS / PERIOD))
    taken = true * PERIOD * (1 + random.uniform(-50e-6, 50e-6))
    at = max(int(random.uniform(*when) / PERIOD), 1)
    seen = np.concatenate([true[:at], true[at + missed :]])
    axes, probe = lines(seen), frames(true, taken)
    portion = float(random.choice([0.002, 0.005, 0.01, 0.02, 0.05]))
    late = float(random.choice([2e-5, 1e-4, 3e-4]))
    wires = [
        Wire(parts, taken[which], portions(random, portion, late), delays(random, busy))
        for parts, which in ((axes, seen), (probe, true))
    ]
    block = int(random.choice([20, 50, 100]))
    common: dict[str, Any] = {"sample_period": PERIOD, "block_size": block}
    first = CsvStreamDevice(
        wires[0],
        CsvSettings(columns=COLUMNS, **common),
        wires[0].clock_ns,
        lambda: UPTIME_S + wires[0].now,
    )
    second = GenericStreamDevice(
        wires[1], StreamSettings(**common), wires[1].clock_ns, lambda: UPTIME_S + wires[1].now
    )
    return followed(wires, (first, second), at, float(taken[at]))


def portions(random: np.random.Generator, portion: float, late: float) -> np.ndarray:
    """Ends of portions of a loop that sleeps, each sent late by a scheduler [s]."""
    naps = portion + abs(random.normal(1e-4, 5e-5, round(SECONDS / portion)))
    edges = np.cumsum(naps)
    return np.maximum.accumulate(edges + abs(random.normal(0.0, late, len(edges))))


def delays(random: np.random.Generator, busy: float) -> np.ndarray:
    """Return the delays of reads [s], (n,), in busy and quiet times of some hundred reads."""
    scale = np.repeat(random.uniform(0.3, 3.0, 100) * (random.random(100) < 0.5), 100) * busy
    return random.exponential(1.0, len(scale)) * scale * (random.random(len(scale)) < 0.8)


def followed(wires: list[Wire], devices: tuple[Any, Any], at: int, miss: float) -> Outcome:
    for device in devices:
        device.open()
    corrector = Corrector(two_counters.CALIBRATION, CorrectionOptions())
    samples, found = [np.empty(0, np.int64)], None
    true = np.full(len(wires[0].parts) + 100, -1)
    while wires[0].portions or wires[1].portions:
        turn = int(wires[1].now < wires[0].now)
        for axes, distance in devices[turn].poll(0.002):
            if turn:
                corrector.push_distance(distance)
            else:
                true[axes.first_sample : axes.end] = np.rint(axes.x * 1e10)
                corrector.push_axes(axes)
        if (points := corrector.take()) is not None:
            samples.append(points.sample)
        if found is None and wires[turn].now > miss and devices[0].statistics.missed:
            found = wires[turn].now - miss
    axes = devices[0].statistics
    assert axes.decoded == axes.delivered + axes.withheld + axes.pending
    devices[0].close()
    if (points := corrector.finish()) is not None:
        samples.append(points.sample)
    published = np.concatenate(samples)
    wrong = int(np.sum(true[published] != published))
    before = int(np.sum(published < at))
    return Outcome(
        wrong,
        before,
        len(published) - before - wrong,
        int(published.max(initial=-1)),
        found,
        axes.missed,
        axes.withheld,
        axes.pending,
    )


def lines(true: np.ndarray) -> list[bytes]:
    z = 20e-6 * np.sin(2 * np.pi * 3.1 * true * PERIOD) * 1e10
    return [b"%d %d 0 %d 0 0\n" % (n, t, v) for n, (t, v) in enumerate(zip(true, z, strict=True))]


def frames(true: np.ndarray, taken: np.ndarray) -> list[bytes]:
    made = np.zeros(len(true), FRAME)
    made["sequence"], made["distance"] = true, true % 50_000
    made["device_time"] = (taken * (1 + 2e-5) * 1e9).astype(np.int64)
    wire = encode_frames(made)
    return [wire[i : i + ENCODED_SIZE] for i in range(0, len(wire), ENCODED_SIZE)]


@pytest.mark.parametrize("seed", range(CASES))
def test_no_point_of_two_triggers_is_published(seed: int) -> None:
    missed = 1 + seed % 2
    outcome = run(seed, missed)
    assert outcome.wrong == 0, outcome
    assert outcome.right > 2000
    assert outcome.found_after is not None
    assert 0 < outcome.found_after <= 1.0, outcome
    assert outcome.missed == missed, outcome
    assert outcome.withheld > 0, outcome
    assert outcome.again > 0, outcome


@pytest.mark.parametrize("seed", range(CASES))
def test_nor_is_one_on_a_busy_host(seed: int) -> None:
    outcome = run(seed, 1 + seed % 4, busy=0.01)
    assert outcome.wrong == 0, outcome
    assert outcome.withheld + outcome.waited > 0


SOON = [(seed, (0.25, 1.0, 5.0)[seed % 3]) for seed in range(CASES)]


@pytest.mark.parametrize(("seed", "until"), [*SOON, *soaked((41, 0.5), (123, 0.25))])
def test_nor_is_one_after_a_trigger_missed_soon_after_the_start(seed: int, until: float) -> None:
    """Several missed in the first second look like another rate of the device."""
    outcome = run(seed, 1 + seed % 3, when=(0.0, until))
    assert outcome.wrong == 0, outcome


def test_a_busy_host_alone_costs_no_sample() -> None:
    outcome = run(0, 0, busy=0.01)
    assert (outcome.withheld, outcome.missed) == (0, 0)
    assert outcome.right + outcome.again > 0.98 * outcome.last


@pytest.mark.parametrize("seconds", [0.5, 0.95, 1.05, 1.2, 3.0])
def test_a_recording_in_time_lapse_ends_without_doubt(seconds: float) -> None:
    detector, confirmed = MissedTriggerDetector(PERIOD), False
    for taken in np.arange(0.0, 10 * seconds, 0.1):
        confirmed = detector.confirms(taken, UPTIME_S + taken / 10)
    assert confirmed or detector.trusts_last()


def test_late_arrivals_alone_are_no_missed_triggers() -> None:
    """A host that is busy for a while delays arrivals by chance, but never all of them."""
    random, detector = np.random.default_rng(1), MissedTriggerDetector(PERIOD)
    due = np.arange(1, 3000) * 0.01
    arrivals = UPTIME_S + due + random.exponential(2e-3, len(due)) * (random.random(len(due)) < 0.7)
    for d, a in zip(due, arrivals, strict=True):
        detector.confirms(float(d), float(a))
        assert detector.missed == 0
    assert detector.least_missed == 1


@pytest.mark.parametrize(("period", "at"), [(1e-3, 5.0), (2e-4, 5.0), (1e-3, 2.0)])
def test_missed_triggers_are_certain_within_two_seconds(period: float, at: float) -> None:
    random, detector = np.random.default_rng(3), MissedTriggerDetector(period)
    missed, certain, counted, resumed = 2, 0.0, 0, 0.0
    for due in np.arange(1, 1000) * 0.01:
        taken = due + missed * period * (due > at)
        arrival = UPTIME_S + taken + random.uniform(0, 0.9 * period)
        confirmed = detector.confirms(due + counted * period, arrival)
        assert not (confirmed and taken > at and not counted)
        if confirmed and counted and not resumed:
            resumed = taken
        if not confirmed and (found := detector.forget_missed()):
            counted, certain = counted + found, taken
    assert counted == missed
    assert certain - at < 2.0
    assert certain < resumed < certain + 0.1


@pytest.mark.parametrize(("quick", "latest"), [(0.2, 8.5), (0.02, 28.0)])
def test_a_busy_host_tells_later_how_many_were_missed(quick: float, latest: float) -> None:
    """After the missed triggers a share ``quick`` of the arrivals is in time, the others late."""
    random, detector = np.random.default_rng(4), MissedTriggerDetector(PERIOD)
    missed, certain = 2, 0.0
    for due in np.arange(1, 3000) * 0.01:
        taken = due + missed * PERIOD * (due > 5.0)
        late = random.exponential(0.03) * (random.random() > quick) * (due > 5.0)
        arrival = UPTIME_S + taken * (1 + 3e-5) + late + random.uniform(0, PERIOD)
        confirmed = detector.confirms(due, arrival)
        assert not (confirmed and taken > 5.0)
        if not confirmed and (found := detector.forget_missed()):
            certain = taken
            break
    assert found == missed
    assert certain < latest


def test_what_the_arrivals_cannot_show_is_stated_and_confirms_nothing() -> None:
    """Even the earliest of all arrivals of a second is late by more than two periods."""
    random, detector = np.random.default_rng(2), MissedTriggerDetector(PERIOD)
    due = np.arange(1, 1000) * 0.01
    for d, a in zip(due, np.maximum.accumulate(due + random.uniform(0, 0.1, 999)), strict=True):
        assert not detector.confirms(float(d), UPTIME_S + float(a))
    assert detector.least_missed > 3


@pytest.mark.parametrize("deviation", [0.005, 0.02])
def test_another_rate_is_confirmed_once_the_arrivals_show_it(deviation: float) -> None:
    detector = MissedTriggerDetector(PERIOD)
    confirmed = [
        detector.confirms(due, UPTIME_S + due * (1 + deviation))
        for due in (np.arange(1, 1000) * 0.01).tolist()
    ]
    assert not any(confirmed[:200])
    assert all(confirmed[-200:])


@pytest.mark.parametrize("latency", [1e-5, 2e-4])
@pytest.mark.parametrize("at", [0.801, 1.401])
def test_a_trigger_missed_by_single_samples_is_seen_whatever_the_drift(
    latency: float, at: float
) -> None:
    """Half a period of drift in the seconds after it would make all arrivals lie on one line."""
    random, detector, period = np.random.default_rng(12), MissedTriggerDetector(5e-4), 5e-4
    confirmed = []
    for taken in np.arange(1, 5000) * 4 * period:
        due = taken - period * (taken > at)
        arrival = UPTIME_S + taken * (1 + 2e-5) + random.exponential(latency)
        if detector.confirms(float(due), arrival):
            confirmed.append(float(taken))
        if (found := detector.forget_missed()) != 0:
            assert found == 1
            break
    assert at / 2 < max(confirmed) < at


def cut(
    missed_at: float = np.inf,
    stall: float = np.inf,
    pause: float = np.inf,
    level: float = 0.0,
    reset: int = 100_000,
) -> tuple[np.ndarray, np.ndarray, BlockCutter]:
    """Return counts and true triggers of the samples of axes that a cutter hands over in 12 s.

    Two triggers are missed. The host stands still for 0.5 s, or the trigger does.

    level: mean delay of most arrivals by a host that is busy now and then [s]
    reset: sample from which the device, and the true triggers, count from zero again
    """
    random = np.random.default_rng(5)
    cutter = BlockCutter(
        BlockSettings(sample_period=PERIOD),
        Channels(distance=False, axes=AXIS_SCALING, timed=False),
    )
    late = delays(random, level)
    published, heard, read, now = [np.empty((2, 0), np.int64)], 0.0, 0, 0.0
    for k, edge in enumerate(np.arange(1, 1200) * 0.01 + random.uniform(0, 1e-3, 1199)):
        now = max(now, stall + 0.5 if stall <= edge < stall + 0.5 else edge + late[k])
        taken = edge if edge < pause else max(edge - 0.5003, pause)
        true = int(taken / PERIOD)
        end = true - 2 * (taken > missed_at)
        if end <= read:
            continue
        samples = np.zeros(end - read, SAMPLE)
        counts = np.arange(read, end)
        triggers = counts + 2 * (counts >= missed_at / PERIOD)
        samples["counts"][:, 0] = triggers - reset * (counts >= reset)
        runs = [
            CountedRun(samples[part], int(counts[part][0]) - first, counts[part][0] == reset)
            for part, first in ((counts < reset, 0), (counts >= reset, reset))
            if part.any()
        ]
        at, after = UPTIME_S + now, now - heard > 0.2
        for axes, _ in cutter.add(runs, round(at * 1e9), at, after_silence=after):
            triggers = np.rint(axes.x * AXIS_SCALING[0].counts_per_unit).astype(int)
            published.append(np.array([np.arange(axes.first_sample, axes.end), triggers]))
        heard, read = now, end
    counts, triggers = np.concatenate(published, axis=1)
    return counts, triggers, cutter


@pytest.mark.parametrize(
    ("at", "level"), [(0.6, 0.01), (5.9, 0.0), *soaked((0.6, 0.0), (5.9, 0.01))]
)
def test_a_missed_trigger_is_detected_at_the_start_and_near_pauses_of_the_host(
    at: float, level: float
) -> None:
    counts, triggers, cutter = cut(missed_at=at, stall=6.0, level=level)
    np.testing.assert_array_equal(counts, triggers)
    assert cutter.detector.missed == 2
    assert cutter.unconfirmed or counts[-1] > 9000  # half a second may not show their number


def test_a_host_that_stands_still_costs_no_sample() -> None:
    counts, triggers, cutter = cut(stall=6.0, level=0.005)
    np.testing.assert_array_equal(counts, triggers)
    assert (cutter.withheld, cutter.detector.missed) == (0, 0)
    assert len(counts) > 11_800


@pytest.mark.parametrize(("at", "resumes"), [(np.inf, True), (5.0, False)])
def test_after_a_pause_of_the_trigger_only_a_doubt_before_it_withholds(
    at: float, resumes: bool
) -> None:
    counts, triggers, cutter = cut(missed_at=at, pause=5.6)
    np.testing.assert_array_equal(counts, triggers)
    assert (counts[-1] > 11_000) == resumes
    assert cutter.unconfirmed != resumes


def test_a_counter_reset_in_a_running_stream_costs_only_the_portion_before_it() -> None:
    counts, triggers, cutter = cut(reset=5003)
    np.testing.assert_array_equal(counts, triggers)
    begin = int(np.argmin(np.diff(counts))) + 1
    assert counts[begin] == 0
    assert cutter.withheld == 5003 - begin < 10


@pytest.mark.parametrize(("pause", "within"), [(0.0, 5), (0.0503, 100), (0.1503, 100)])
def test_an_arrival_in_time_after_a_reset_confirms_at_once(pause: float, within: int) -> None:
    """If the trigger pauses at the reset, for no longer than a busy host, the line is new."""
    random, detector, reset = np.random.default_rng(7), MissedTriggerDetector(PERIOD, 0.2), 4_000
    polls = np.arange(1, 501) * 0.01 + random.uniform(0, 5e-3, 500)
    confirmed, before = [], 0
    for poll in polls:
        count = int(min(poll, max(poll - pause, reset * PERIOD)) / PERIOD)
        if count >= reset > before:
            detector.restart(ahead=reset * PERIOD)
        if count > before:
            due = (count - reset * (count >= reset)) * PERIOD
            confirmed.append((poll, detector.confirms(due, UPTIME_S + poll)))
        before = count
    later = [confirms for poll, confirms in confirmed if poll > reset * PERIOD]
    assert any(later[:within])
    assert any(later[:5]) == (pause == 0)


@pytest.mark.parametrize(
    ("after", "level"),
    [(0.0, 0.0), (0.002, 0.005), (1.0, 0.0), *soaked((0.0, 0.005), (0.002, 0.0), (1.0, 0.005))],
)
def test_a_trigger_missed_at_or_after_a_reset_is_seen(after: float, level: float) -> None:
    counts, triggers, cutter = cut(reset=5003, missed_at=5.003 + after, level=level)
    np.testing.assert_array_equal(counts, triggers)
    assert cutter.unconfirmed or cutter.detector.missed == 2


def followed_to(late: Any, fewer_at: int = -1) -> CsvStreamDevice:
    """A device of 1 kHz that sent ten lines each 10 ms for 6 s, ``late(taken)`` [s].

    fewer_at: portion of only nine lines
    """
    now = [UPTIME_S]

    class Late(Script):
        def read(self, timeout: float) -> bytes:
            size = 10 - (next(portions) == fewer_at)
            count[0] += size
            taken = count[0] * PERIOD
            now[0] = max(now[0], UPTIME_S + taken + late(taken))
            return b"".join(b"%d 0 0 0 0 0\n" % k for k in range(count[0] - size, count[0]))

    count, portions = [0], itertools.count()
    settings = CsvSettings(columns=COLUMNS, sample_period=PERIOD, block_size=10)
    device = CsvStreamDevice(Late(), settings, lambda: round(now[0] * 1e9), lambda: now[0])
    device.open()
    for _ in range(600):
        device.poll(0.0)
    return device


def test_samples_that_arrive_too_unevenly_are_withheld_with_the_remedy() -> None:
    random = np.random.default_rng(4)
    device = followed_to(lambda taken: random.exponential(0.05))
    assert device.statistics.delivered == 0 < device.statistics.withheld
    assert re.search(r"too unevenly .* withheld: .* its time with it", device.trouble)


def test_polls_in_step_with_the_trigger_need_a_restart_after_a_missed_one() -> None:
    device = followed_to(lambda taken: PERIOD * (0.4 + (taken > 3)), fewer_at=300)
    assert 2000 < device.statistics.delivered <= 3000
    assert re.search(r"do not show how many.*restart the counters of both", device.trouble)
    blocks = followed_to(lambda taken: PERIOD * (0.4 + (taken > 3)))
    assert (blocks.statistics.missed, blocks.trouble) == (1, "")
    assert blocks.statistics.delivered > 5000
