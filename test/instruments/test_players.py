"""Every emulated device over a real line into its real driver: the twin's motion comes out."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.emulator_factory import EMULATED, emulated, line_for, player_for
from omsm_ros.instruments.factory import make_axes, make_device, make_reference
from omsm_ros.instruments.parameters import AXIS_PARAMETERS, REFERENCE_PARAMETERS, defaults
from omsm_ros.instruments.reader import DeviceReader
from omsm_ros.twin.cell import Recording

SOON = 20.0
# Half a step of the distance [m]: a nanometre, or a part of the range where the protocol has that.
HALF_STEP = {"confocaldt": 100e-6 / 65_536 / 2}


def play(name: str, link: str, recording: Recording, lapse: float = 10.0) -> list[BlockPair]:
    """Return the blocks of a driver that reads a motion."""
    got: list[BlockPair] = []
    stop = threading.Event()
    with line_for(link) as line:
        player = player_for(name, line)
        values = defaults() | {"device": name, "port": line.path} | emulated(name).driver
        device = make_device(values)
        reader = DeviceReader(device, got.extend)
        thread = threading.Thread(target=reader.run, args=(stop,))
        thread.start()
        try:
            wait(lambda: reader.connections == 1, reader)
            player.start(recording, lapse)
            wait(lambda: device.statistics.delivered >= len(recording.axes), reader)
        finally:
            stop.set()
            thread.join(SOON)
            player.close()
        assert device.statistics.lost == device.statistics.duplicates == 0
    return got


def wait(done: object, reader: DeviceReader) -> None:
    deadline = time.monotonic() + SOON
    while not done():  # type: ignore[operator]
        assert time.monotonic() < deadline, reader.trouble
        time.sleep(0.02)


LINES = [(name, "tcp" if emulated(name).tcp else "pty") for name in EMULATED]
BY_TCP_TOO = [(name, "tcp") for name in EMULATED if not emulated(name).tcp]


@pytest.mark.parametrize(("name", "where"), [*LINES, BY_TCP_TOO[0], *soaked(*BY_TCP_TOO[1:])])
def test_the_twins_motion_comes_out(
    name: str, where: str, tmp_path: Path, step_test: Recording
) -> None:
    link = str(tmp_path / "probe") if where == "pty" else "tcp://127.0.0.1:0"
    blocks = play(name, link, step_test)
    axes = [b.axes for b in blocks if b.axes is not None]
    distances = [b.distance for b in blocks if b.distance is not None]
    # On a busy host a block may be closed early.
    counts = np.concatenate([b.first_sample + np.arange(len(b)) for b in distances])
    np.testing.assert_array_equal(counts, np.arange(len(step_test.axes)))
    distance = np.concatenate([b.distance for b in distances])
    status = np.concatenate([b.status for b in distances])
    np.testing.assert_array_equal(status == Status.OK, step_test.distance.status == Status.OK)
    half = 1.02 * HALF_STEP.get(name, 0.5e-9)
    np.testing.assert_allclose(distance, step_test.distance.distance, rtol=0, atol=half)
    if axes:
        for letter, half_count in (
            ("x", 5e-11),
            ("y", 5e-11),
            ("z", 5e-11),
            ("b", 2e-8),
            ("c", 2e-8),
        ):
            found = np.concatenate([getattr(b, letter) for b in axes])
            expected = getattr(step_test.axes, letter)
            np.testing.assert_allclose(found, expected, rtol=0, atol=half_count * 1.001)


@pytest.mark.parametrize("name", [name for name in EMULATED if emulated(name).second])
def test_the_second_device_measures_the_same_motion(
    name: str, tmp_path: Path, step_test: Recording
) -> None:
    second = emulated(name).second
    assert second is not None
    far = replace(step_test.distance, distance=0.5 * step_test.axes.z)
    recording = replace(step_test, reference=far)
    axes_wanted = second.node == "axis_driver"
    make = make_axes if axes_wanted else make_reference
    parameters = AXIS_PARAMETERS if axes_wanted else REFERENCE_PARAMETERS
    link = "tcp://127.0.0.1:0" if second.tcp else str(tmp_path / "second")
    got: list[BlockPair] = []
    stop = threading.Event()
    with line_for(str(tmp_path / "first")) as line, line_for(link) as other:
        player = player_for(name, line, other)
        values = {p.name: p.default for p in parameters} | {"port": other.path} | second.driver
        device = make(values)
        reader = DeviceReader(device, got.extend)
        thread = threading.Thread(target=reader.run, args=(stop,))
        thread.start()
        try:
            wait(lambda: reader.connections == 1, reader)
            player.start(recording, 20.0)
            wait(lambda: device.statistics.delivered >= len(recording.axes), reader)
        finally:
            stop.set()
            thread.join(SOON)
            player.close()
    if axes_wanted:
        z = np.concatenate([b.axes.z for b in got if b.axes is not None])
        np.testing.assert_allclose(z, recording.axes.z, rtol=0, atol=0.051e-9)
    else:
        distance = np.concatenate([b.distance.distance for b in got if b.distance is not None])
        step = 250e-6 / 0xFFFFFF
        np.testing.assert_allclose(distance, far.distance, rtol=0, atol=0.51 * step)


@pytest.mark.parametrize("link", ["tcp://192.168.0.1:7890", "tcp://127.0.0.1:x"])
def test_an_emulator_stays_on_this_machine(link: str) -> None:
    with pytest.raises(ConfigurationError, match="stays on this machine"):
        line_for(link)


@pytest.mark.parametrize("port", ["65536", "9999999999", "9" * 5000])
def test_a_port_beyond_all_ports_is_named(port: str) -> None:
    with pytest.raises(ConfigurationError, match=r"link 'tcp://127\.0\.0\.1:\d+"):
        line_for(f"tcp://127.0.0.1:{port}")


def test_a_link_too_long_for_a_name_is_refused() -> None:
    with pytest.raises(DeviceError, match="cannot create link"), line_for("x" * 5000):
        pass


def test_an_unknown_device_is_named() -> None:
    with pytest.raises(ConfigurationError, match="device 'ruler'"):
        emulated("ruler")
