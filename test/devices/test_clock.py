"""Host stamps from device time, against simulated clocks whose truth is known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.devices.clock import DEFAULT_CREEP, HOST_STEP_AFTER_NS, DeviceClock
from omsm_ros.errors import ConfigurationError

MS = 1_000_000
EPOCH = 1_700_000_000_000_000_000


def stamps_of(clock: DeviceClock, device: np.ndarray, arrival: np.ndarray) -> np.ndarray:
    """What the clock says of each frame, told of it as it arrives."""
    found = []
    for taken, arrived in zip(device.tolist(), arrival.tolist(), strict=True):
        clock.observe(taken, arrived)
        found.append(clock.to_host(taken))
    return np.array(found)


def link(samples: int, *, rate: float = 1.0, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Device time, true host time and arrival [ns]; the link takes 1 ms and up to 20 more."""
    device = np.arange(samples, dtype=np.int64) * 5 * MS
    host = EPOCH + np.rint(device * rate).astype(np.int64)
    late = np.random.default_rng(seed).exponential(3 * MS, samples).astype(np.int64)
    return device, host, np.maximum.accumulate(host + 1 * MS + np.minimum(late, 20 * MS))


def test_jitter_of_the_host_is_not_in_the_stamps() -> None:
    device, host, arrival = link(4000)
    error = stamps_of(DeviceClock(), device, arrival) - host
    settled = error[400:]
    assert np.ptp(arrival - host) > 10 * MS
    # The least delay remains, as it must; the envelope creeps between its touches.
    assert abs(settled - 1 * MS).max() < 0.1 * MS


@pytest.mark.parametrize("drift_ppm", [-30.0, 30.0])
def test_drift_of_the_device_clock_is_followed(drift_ppm: float) -> None:
    device, host, arrival = link(40_000, rate=1 + drift_ppm * 1e-6)
    error = (stamps_of(DeviceClock(), device, arrival) - host)[400:]
    assert abs((host - device - EPOCH)[-1]) > 5 * MS
    assert abs(error - 1 * MS).max() < 0.2 * MS


@pytest.mark.parametrize("lapse", [5.0, 40.0])
def test_time_lapse_is_followed(lapse: float) -> None:
    device, host, arrival = link(2000, rate=1 / lapse)
    stamps = stamps_of(DeviceClock(), device, arrival)
    assert abs(stamps - host)[10:].max() <= 21 * MS


def test_stamps_between_arrivals_neither_jump_nor_bunch() -> None:
    """At forty-fold speed, frames between two arrivals share the time between them evenly."""
    clock = DeviceClock()
    clock.observe(0, EPOCH)
    clock.observe(400 * MS, EPOCH + 10 * MS)
    inside = [clock.to_host(t * MS) - EPOCH for t in (100, 200, 300, 400)]
    assert inside == [2_500_000, 5_000_000, 7_500_000, 10_000_000]


def test_extrapolation_runs_at_the_device_rate() -> None:
    clock = DeviceClock()
    clock.observe(10 * MS, EPOCH)
    assert clock.to_host(3 * MS) == EPOCH - 7 * MS
    assert clock.to_host(15 * MS) == EPOCH + 5 * MS


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


@given(st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 10**8)), min_size=1, max_size=50))
def test_no_stamp_is_later_than_the_arrival(steps: list[tuple[int, int]]) -> None:
    """Causality: a frame was taken before it came, unless the host's clock fell back."""
    clock = DeviceClock()
    device = arrival = 0
    for taken, arrived in steps:
        device, arrival = device + taken + 1, arrival + arrived + 1
        clock.observe(device, arrival)
        assert clock.to_host(device) <= arrival


def test_a_restarted_device_gets_a_new_offset() -> None:
    clock = DeviceClock()
    clock.observe(50_000 * MS, EPOCH)
    clock.to_host(50_000 * MS)
    clock.restart()
    clock.observe(0, EPOCH + 2000 * MS)
    assert clock.to_host(0) == EPOCH + 2000 * MS


def test_host_clock_set_forward_is_followed_after_a_while() -> None:
    device, _, arrival = link(6000)
    arrival[1000:] += 3_600_000 * MS
    stamps = stamps_of(DeviceClock(), device, arrival)
    delay = arrival - stamps
    assert delay[1001] > 3_500_000 * MS
    after = 1000 + 2 * HOST_STEP_AFTER_NS // (5 * MS)
    assert delay[after:].max() < 25 * MS


def test_a_stall_of_the_host_moves_nothing() -> None:
    device, host, arrival = link(3000)
    arrival[1000:1400] = np.maximum(arrival[1000:1400], host[1400])
    error = (stamps_of(DeviceClock(), device, arrival) - host)[400:]
    assert abs(error - 1 * MS).max() < 0.3 * MS


def test_creep_is_the_slope_of_the_envelope() -> None:
    clock = DeviceClock()
    clock.observe(0, EPOCH)
    clock.observe(1000 * MS, EPOCH + 1500 * MS)
    assert clock.to_host(1000 * MS) - EPOCH - 1000 * MS == pytest.approx(1000 * MS * DEFAULT_CREEP)


def test_misuse_is_named() -> None:
    with pytest.raises(ConfigurationError, match=r"creep 1\.5"):
        DeviceClock(creep=1.5)
    with pytest.raises(ConfigurationError, match="observe"):
        DeviceClock().to_host(0)
