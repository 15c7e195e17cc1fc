"""Axes that move show missed triggers by their steps, where arrivals are too uneven to do so."""

from __future__ import annotations

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.instruments.blocks import BlockCutter, BlockSettings, Channels
from omsm_ros.instruments.counting import SAMPLE, CountedRun
from omsm_ros.instruments.scaling import AxisScaling

PERIOD = 1e-3
UPTIME_S = 123_456.0  # of the host, from which its monotonic clock counts
EPOCH_NS = 1_700_000_000 * 10**9
MODULUS = 100_003
"""Axis B has the number of the trigger times 7919, modulo this: its steps are not even for long."""


def moved(
    x: np.ndarray,
    seen: np.ndarray,
    *,
    z: np.ndarray | None = None,
    reset: int = 0,
    rate: float = 1e3,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, BlockCutter]:
    """Portions of 5 that a busy host reads: number by the driver and true one, arrival [s].

    x, z: counts of the axes at every trigger;  seen: triggers with a sample
    reset: trigger at which both counters begin again
    """
    random, axes = np.random.default_rng(11), (AxisScaling(1.0),) * 5
    cutter = BlockCutter(
        BlockSettings(sample_period=1 / rate, block_size=20),
        Channels(distance=False, axes=axes, timed=False),
    )
    first, found, now = int(np.searchsorted(seen, reset)) if reset else 0, [], 0.0
    for start in range(0, len(seen), 5):
        part = np.arange(start, min(start + 5, len(seen)))
        now = max(now, seen[part[-1]] / rate + random.exponential(20 / rate))
        runs = []
        for new, of in ((False, part[part < first]), (True, part[part >= first])):
            if len(of):
                samples = np.zeros(len(of), SAMPLE)
                samples["counts"][:, 0] = x[seen[of]]
                samples["counts"][:, 2] = 0 if z is None else z[seen[of]]
                samples["counts"][:, 3] = seen[of] * 7919 % MODULUS
                begins = int(of[0]) - (first if new else 0)
                runs.append(CountedRun(samples, begins, bool(reset and of[0] == first)))
        for axes_block, _ in cutter.add(runs, EPOCH_NS + round(now * 1e9), UPTIME_S + now):
            assert axes_block is not None
            true = np.rint(axes_block.b).astype(np.int64) * pow(7919, -1, MODULUS) % MODULUS
            number = axes_block.first_sample + np.arange(len(true)) + reset * (true >= reset)
            found.append(np.stack([number, true, np.full(len(true), now)]))
    return *(np.concatenate(found, axis=1) if found else np.empty((3, 0))), cutter


TURNING = np.rint(5000.4 * np.arange(4000) + np.random.default_rng(5).normal(0, 20, 4000))
TURNING = TURNING.astype(np.int64)
ALL = np.arange(4000)


def without(*missed: int) -> np.ndarray:
    return np.setdiff1d(ALL, missed)


@pytest.mark.parametrize(
    "missed", [(1500,), (300, 2000), *soaked(((1500, 1501, 1502),), ((1500, 1550),))]
)
def test_an_axis_that_turns_shows_missed_triggers_where_arrivals_cannot(
    missed: tuple[int, ...],
) -> None:
    number, true, now, cutter = moved(TURNING, without(*missed))
    np.testing.assert_array_equal(number, true)
    assert now[0] < 0.3
    after = now[true > missed[-1]]
    assert after[0] < missed[-1] * PERIOD + 0.3
    assert true[-1] > 3900
    assert cutter.detector is not None
    assert cutter.detector.missed == len(missed)


def test_an_axis_that_is_even_by_chance_decides_nothing() -> None:
    """A sine has nearly equal steps about its greatest speed, but not for long enough after."""
    sine = np.rint(1e6 * np.sin(2 * np.pi * (ALL - 1490) / 160)).astype(np.int64)
    number, true, _, cutter = moved(TURNING, without(1500), z=sine)
    np.testing.assert_array_equal(number, true)
    assert true[-1] > 3900
    assert cutter.detector is not None
    assert cutter.detector.missed == 1


def test_it_shows_at_once_that_none_was_missed_at_a_reset_of_the_counter() -> None:
    number, true, now, _ = moved(TURNING, ALL, reset=2000)
    np.testing.assert_array_equal(number, true)
    assert now[true >= 2000][0] < 2.3
    assert len(true) > 3850


def test_nothing_is_shown_by_an_axis_that_stops_while_triggers_are_missed() -> None:
    """Its step over them is as large as one before; the steps of another axis contradict."""
    stopped = np.minimum(TURNING, TURNING[1500])
    other = np.rint(70 * ALL).astype(np.int64)
    for z in (None, other):
        number, true, _, _ = moved(stopped, without(1500, 1501, 1502), z=z)
        assert len(true) > 1000
        np.testing.assert_array_equal(number, true)


def test_nor_by_one_that_turns_back_while_triggers_are_missed() -> None:
    """Its step over them is as large as those after it."""
    number, true, _, _ = moved(abs(5000 * (ALL - 1500)), without(1500, 1501))
    assert len(true) > 1000
    np.testing.assert_array_equal(number, true)


@pytest.mark.parametrize("speed", [0.0, 4.7, *soaked(0.3, 1.02)])
def test_steps_of_a_few_counts_show_nothing(speed: float) -> None:
    slow = np.rint(speed * ALL).astype(np.int64)
    _, true, _, cutter = moved(slow, ALL)
    assert cutter.detector is not None
    assert cutter.detector.missed == len(true) == 0


def test_equal_steps_of_every_other_trigger_show_nothing() -> None:
    """Arrivals then show another rate of the device, which is stated."""
    *_, now, _ = moved(TURNING, ALL[::2])
    assert now[0] > 0.6


@pytest.mark.parametrize("at", [80, 200, 450])
def test_a_trigger_missed_in_the_first_50_ms_of_10_khz_is_seen(at: int) -> None:
    number, true, now, _ = moved(TURNING, without(at), rate=1e4)
    np.testing.assert_array_equal(number, true)
    assert now[true > at][0] < at * 1e-4 + 0.05
