"""Host stamps from device time, against simulated clocks whose truth is known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from soaked import soaked

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.arrivals import DeviceClock

MS = 1_000_000
EPOCH = 1_700_000_000_000_000_000


def stamps_of(clock: DeviceClock, device: np.ndarray, arrival: np.ndarray) -> np.ndarray:
    """Return the stamp of each sample, entered when it arrives."""
    found = []
    for taken, arrived in zip(device.tolist(), arrival.tolist(), strict=True):
        clock.observe(taken, arrived)
        found.append(clock.to_host(taken))
    return np.array(found)


def link(
    samples: int, *, drift: float = 0.0, jitter: float = 1.0, seed: int = 0, step_ms: int = 5
) -> tuple[np.ndarray, ...]:
    """Device time, true host time and arrival [ns], later by 0 to 2 ``jitter`` ms, evenly."""
    device = np.arange(samples, dtype=np.int64) * step_ms * MS
    host = EPOCH + np.rint(device * (1 + drift)).astype(np.int64)
    late = np.random.default_rng(seed).uniform(0, 2 * jitter, samples) * MS
    return device, host, np.maximum.accumulate(host + late.astype(np.int64))


@pytest.mark.parametrize("seed", [0, *soaked(1)])
@pytest.mark.parametrize("drift_ppm", [-50.0, *soaked(0.0, 50.0)])
def test_within_a_tenth_of_a_millisecond_after_ten_seconds(drift_ppm: float, seed: int) -> None:
    device, host, arrival = link(8000, drift=drift_ppm * 1e-6, seed=seed)
    stamps = stamps_of(DeviceClock(), device, arrival)
    error = (stamps - host)[2000:]
    assert abs(error).max() < 0.1 * MS
    assert np.all(np.diff(stamps) > 0)


def test_through_a_reconnection_too() -> None:
    device, host, arrival = link(12_000, drift=50e-6, seed=9)
    kept = np.r_[0:4000, 5000:12_000]  # five seconds of nothing
    stamps = stamps_of(DeviceClock(), device[kept], arrival[kept])
    assert abs(stamps - host[kept])[2000:].max() < 0.1 * MS
    assert np.all(np.diff(stamps) > 0)


def test_late_arrivals_of_a_busy_host_do_not_pull() -> None:
    device, host, arrival = link(8000, jitter=0.2)
    random = np.random.default_rng(1)
    late = np.where(random.random(8000) < 0.1, random.exponential(20 * MS, 8000), 0)
    arrival = np.maximum.accumulate(arrival + late.astype(np.int64))
    # Samples that arrive together are one arrival, that of the last.
    last = np.r_[np.diff(arrival) > 0, True]
    device, host, arrival = device[last], host[last], arrival[last]
    stamps = stamps_of(DeviceClock(), device, arrival)
    assert np.ptp(arrival - host) > 20 * MS
    assert abs(stamps - host)[2000:].max() < 1.0 * MS


@pytest.mark.parametrize("begun_s", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("pause_ms", [33, 90])
def test_a_pause_of_the_trigger_soon_after_the_start_is_no_rate(
    begun_s: float, pause_ms: int
) -> None:
    """A device without time counts periods, so that its count is late from the pause on."""
    device, host, arrival = link(2000, jitter=0.2)
    paused = (device > begun_s * 1e9) * pause_ms * MS
    stamps = stamps_of(DeviceClock(), device, arrival + paused)
    later = device > (begun_s + 3) * 1e9
    assert abs(stamps - host - paused)[later].max() < 1.0 * MS


def test_a_drift_that_changes_is_followed() -> None:
    """A crystal that warms up by 10 ppm in five minutes."""
    device = np.arange(60_000, dtype=np.int64) * 5 * MS
    seconds = device * 1e-9
    host = EPOCH + device + np.rint(1e9 * 10e-6 * seconds**2 / 600).astype(np.int64)
    jitter = np.random.default_rng(2).uniform(0, 2, len(device)) * MS
    stamps = stamps_of(DeviceClock(), device, np.maximum.accumulate(host + jitter.astype(np.int64)))
    assert abs(stamps - host)[4000:].max() < 0.1 * MS


def test_the_drift_is_reported() -> None:
    device, _, arrival = link(4000, drift=50e-6)
    clock = DeviceClock()
    stamps_of(clock, device[:100], arrival[:100])
    assert clock.drift is None
    stamps_of(clock, device[100:], arrival[100:])
    assert clock.drift == pytest.approx(50e-6, abs=10e-6)


@pytest.mark.parametrize("rate", [0.9, 1.1, 1 / 20])
def test_a_device_at_another_rate_is_followed_and_reported(rate: float) -> None:
    device, host, arrival = link(4000, drift=rate - 1)
    clock = DeviceClock()
    stamps = stamps_of(clock, device, arrival)
    assert clock.drift == pytest.approx(rate - 1, abs=1e-4)
    assert abs(stamps - host)[2000:].max() < 1 * MS


def test_stamps_between_arrivals_neither_jump_nor_bunch() -> None:
    device, _, arrival = link(3000)
    clock = DeviceClock()
    stamps_of(clock, device, arrival)
    inside = [clock.to_host(int(device[-1]) + t * MS) for t in range(1, 6)]
    np.testing.assert_allclose(np.diff(inside), MS, rtol=1e-3)


@given(
    st.lists(
        st.tuples(st.integers(0, 2**40), st.integers(-(2**40), 2**40), st.booleans()), min_size=1
    )
)
def test_stamps_rise_whatever_comes(events: list[tuple[int, int, bool]]) -> None:
    clock = DeviceClock()
    stamps = []
    for device, arrival, restart in events:
        if restart:
            clock.restart()
        clock.observe(device, arrival)
        stamps.append(clock.to_host(device))
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))


def test_a_restarted_device_gets_a_new_offset() -> None:
    clock = DeviceClock()
    clock.observe(50_000 * MS, EPOCH)
    clock.to_host(50_000 * MS)
    clock.restart()
    clock.observe(0, EPOCH + 2000 * MS)
    assert clock.to_host(0) == EPOCH + 2000 * MS


@pytest.mark.parametrize("step_ms", [-3_600_000, *soaked(3_600_000, 50)])
def test_a_clock_that_was_set_is_followed_after_a_while(step_ms: int) -> None:
    device, _, arrival = link(6000)
    arrival[2000:] += step_ms * MS
    clock = DeviceClock()
    found = []
    for taken, arrived in zip(device.tolist(), arrival.tolist(), strict=True):
        clock.observe(taken, arrived)
        found.append(clock._origin[1] + taken - clock._origin[0] + round(clock._offset * 1e9))
    after = 2000 + 2500 // 5
    assert abs(np.array(found) - arrival)[after:].max() < 5 * MS


def test_a_stall_of_the_host_moves_nothing() -> None:
    device, host, arrival = link(5000)
    arrival[3000:3200] = np.maximum(arrival[3000:3200], host[3200])
    error = stamps_of(DeviceClock(), device, arrival) - host
    assert abs(error[2000:]).max() < 1 * MS


def test_misuse_is_named() -> None:
    with pytest.raises(ConfigurationError, match="observe"):
        DeviceClock().to_host(0)


@pytest.mark.parametrize("first", [2**64 - 1, 2**63 - 1, -1, 0, 3 * 10**18])
@pytest.mark.parametrize("uptime_s", [10, *soaked(0, 3 * 10**9)])
def test_a_first_time_that_is_wrong_does_not_last(first: int, uptime_s: int) -> None:
    """As if the first frame had been sent before the device's clock was set."""
    device, host, arrival = link(1000)
    device = device + uptime_s * 10**9
    clock = DeviceClock()
    clock.observe(first, int(host[0]) - 5 * MS)
    clock.to_host(first)
    error = stamps_of(clock, device, arrival) - host
    assert abs(error).max() <= 1000 * MS  # half a second of uptime could be the truth
    if uptime_s:
        assert abs(error).max() < 10 * MS


def test_a_wrong_time_among_samples_that_arrive_together_is_not_believed() -> None:
    clock = DeviceClock()
    newest = 3 * 10**9 * 10**9
    clock.observe(newest, EPOCH)
    stamps = [clock.to_host(t) for t in (-1, newest - 2 * MS, 2**64 - 1)]
    assert all(abs(stamp - EPOCH) <= 2 * MS for stamp in stamps)
    assert clock.to_host(newest + 10 * MS) == EPOCH + 10 * MS


@pytest.mark.parametrize("seed", [0, *soaked(*range(1, 5))])
def test_uneven_arrivals_are_no_other_rate(seed: int) -> None:
    """A busy host, ±50 ms: no rate in the first five seconds, then one within a thousandth."""
    device, _, arrival = link(1100, jitter=50.0, seed=seed)
    clock, drifts = DeviceClock(), []
    for sent, came in zip(device, arrival, strict=True):
        clock.observe(int(sent), int(came))
        drifts.append(clock.drift)
    assert not any(drifts[:1000])
    found = [abs(drift) for drift in drifts[1000:] if drift is not None]
    assert found
    assert max(found) < 1e-3
