"""The emulated device through a real pseudo-terminal into the real driver, all accounted for."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from omsm_ros.errors import DeviceError
from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.emulator_ports import Pty
from omsm_ros.instruments.six_channel.device import GenericStreamDevice, StreamSettings
from omsm_ros.instruments.six_channel.emulator import (
    GenericStreamEmulator,
    PlayedCounts,
    StreamFaults,
)
from omsm_ros.instruments.six_channel.protocol import FRAME, encode_frames
from omsm_ros.instruments.transport import SerialTransport
from omsm_ros.twin.cell import Recording

from .playing import EVERY_FAULT, SOON, Playing


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    with Pty(tmp_path / "six-channel") as opened:
        yield opened


@pytest.fixture
def driver(pty: Pty) -> Iterator[GenericStreamDevice]:
    device = GenericStreamDevice(SerialTransport(pty.path), StreamSettings(pause=1e6))
    device.open()
    yield device
    device.close()


def drain(driver: GenericStreamDevice, playing: Playing) -> list[BlockPair]:
    """Everything the emulator sends, until it has ended and the line is empty."""
    blocks: list[BlockPair] = []
    deadline = time.monotonic() + SOON
    while time.monotonic() < deadline:
        ended, before = playing.done, driver.wire.bytes_received
        blocks += driver.poll(0.3)
        if ended and driver.wire.bytes_received == before:
            return blocks
    raise AssertionError("the emulator did not end")


def assert_reproduced(blocks: list[BlockPair], recording: Recording, offset: int = 0) -> None:
    """Each delivered sample is the twin's own, to half a count, whatever was lost around it."""
    for axes, distance in blocks:
        part = slice(axes.first_sample - offset, axes.first_sample - offset + len(axes))
        for name, half_count in (
            ("x", 5e-11),
            ("y", 5e-11),
            ("z", 5e-11),
            ("b", 5e-10),
            ("c", 5e-10),
        ):
            expected = getattr(recording.axes, name)[part]
            error = abs(getattr(axes, name) - expected)
            assert error.max() <= half_count * 1.0001 + 1e-15, name
        np.testing.assert_array_equal(distance.status, recording.distance.status[part])
        np.testing.assert_allclose(
            distance.distance, recording.distance.distance[part], rtol=0, atol=0.50001e-9
        )


# End to end.


def test_every_sample_arrives_as_the_twin_made_it(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    with Playing(GenericStreamEmulator(pty), recording) as playing:
        blocks = drain(driver, playing)
    blocks += driver.close()
    count = len(recording.axes)
    assert playing.played == PlayedCounts(samples=count, intact=count)
    assert playing.progress == count
    assert sum(len(axes) for axes, _ in blocks) == count
    assert [axes.first_sample for axes, _ in blocks] == list(range(0, count, 100))
    assert_reproduced(blocks, recording)
    found = driver.statistics
    assert (found.lost, found.duplicates, found.restarts) == (0, 0, 0)
    assert (driver.wire.bytes_discarded, driver.unknown_status, found.period_warnings) == (0, 0, 0)


@pytest.mark.parametrize("seed", [1, 2])
def test_every_sample_is_accounted_for_with_every_fault(
    pty: Pty, driver: GenericStreamDevice, recording: Recording, seed: int
) -> None:
    faults = StreamFaults(**EVERY_FAULT, jump_at=500, jump_by=1000, seed=seed)
    with Playing(GenericStreamEmulator(pty, faults=faults), recording) as playing:
        blocks = drain(driver, playing)
    blocks += driver.close()
    played, found = playing.played, driver.statistics
    assert min(played.spoilt, played.dropped, played.duplicated) > 0
    assert played.samples + played.duplicated == played.intact + played.spoilt + played.dropped
    assert driver.wire.frames == played.intact == found.delivered + found.duplicates
    last = blocks[-1][0].first_sample + len(blocks[-1][0]) - 1
    assert found.delivered + found.lost == last - blocks[0][0].first_sample + 1
    early = [pair for pair in blocks if pair[0].first_sample < 500]
    late = [pair for pair in blocks if pair[0].first_sample >= 500]
    assert all(axes.first_sample >= 1500 for axes, _ in late)
    assert_reproduced(early, recording)
    assert_reproduced(late, recording, offset=1000)


def test_noise_in_mid_stream_costs_what_it_hits_and_no_more(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    emulator = GenericStreamEmulator(pty)
    with Playing(emulator, recording) as playing:
        blocks = drain(driver, playing)
    pty.write(np.random.default_rng(3).bytes(1000) + b"\xff")
    with Playing(emulator, recording) as playing:
        blocks += drain(driver, playing)
    blocks += driver.close()
    count = len(recording.axes)
    # The noise runs into the first frame of the second play.
    assert driver.statistics.lost == 1
    assert sum(len(axes) for axes, _ in blocks) == 2 * count - 1
    assert_reproduced([p for p in blocks if p[0].first_sample > count], recording, offset=count)


def test_a_device_restarted_in_the_middle_of_a_frame(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    with Playing(GenericStreamEmulator(pty), recording) as playing:
        before = drain(driver, playing)
    pty.write(encode_frames(np.zeros(1, FRAME))[:40])
    with Playing(GenericStreamEmulator(pty), recording) as playing:
        after = drain(driver, playing)
    after += driver.close()
    count = len(recording.axes)
    assert [axes.first_sample for axes, _ in after[:2]] == [1, 101]
    assert_reproduced(before + after, recording)
    found = driver.statistics
    assert (found.restarts, driver.wire.bad_length) == (1, 1)
    assert found.delivered == 2 * count - 1


def test_the_port_vanishes_and_comes_back(tmp_path: Path, recording: Recording) -> None:
    link = tmp_path / "six-channel"
    driver = GenericStreamDevice(SerialTransport(str(link)), StreamSettings(pause=1e6))
    blocks: list[BlockPair] = []
    with Pty(link) as pty:
        driver.open()
        with Playing(GenericStreamEmulator(pty), recording) as playing:
            blocks += drain(driver, playing)
        pty.write(encode_frames(np.zeros(1, FRAME))[:40])
    with pytest.raises(DeviceError, match=r"six-channel.*was lost"):
        driver.poll(SOON)
    blocks += driver.close()
    with pytest.raises(DeviceError, match="cannot open"):
        driver.open()
    with Pty(link) as pty:
        driver.open()
        with Playing(GenericStreamEmulator(pty), recording) as playing:
            blocks += drain(driver, playing)
        blocks += driver.close()
    assert driver.statistics.delivered == 2 * len(recording.axes)
    assert driver.statistics.restarts == 1
    assert_reproduced(blocks, recording)


def test_a_driver_that_comes_back_sees_a_gap_for_what_it_missed(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    emulator = GenericStreamEmulator(pty)
    with Playing(emulator, recording) as playing:
        blocks = drain(driver, playing)
    blocks += driver.close()
    unheard = emulator.play(recording, math.inf)
    count = len(recording.axes)
    assert unheard == PlayedCounts(samples=count, unread=count)
    driver.open()
    with Playing(emulator, recording) as playing:
        blocks += drain(driver, playing)
    blocks += driver.close()
    found = driver.statistics
    assert (found.delivered, found.lost, found.gaps) == (2 * count, count, 1)
    assert_reproduced([p for p in blocks if p[0].first_sample < count], recording)
    assert_reproduced([p for p in blocks if p[0].first_sample >= count], recording, 2 * count)


def test_stopping_is_prompt_and_accounted_for(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    with Playing(GenericStreamEmulator(pty), recording, time_lapse=0.01) as playing:
        while not driver.wire.frames:
            driver.poll(SOON)
    assert 0 < playing.played.samples < len(recording.axes)
    assert playing.played.samples == playing.played.intact + playing.played.unread
