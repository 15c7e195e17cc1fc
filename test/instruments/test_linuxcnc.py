"""Lines of HAL's sampler: resolution, restarts and overruns."""

import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.linuxcnc.device import make
from omsm_ros.instruments.parameters import defaults
from omsm_ros.instruments.scaling import AXES

from .scripted_stream import Script


def read(portions, **given):
    device = make(
        defaults() | {"device": "linuxcnc", "port": "tcp://h:1"} | given,
        Script(*portions),
        lambda: 0,
    )
    device.open()
    blocks = [pair for _ in portions for pair in device.poll(0.0)]
    return [*blocks, *device.close()], device.counts()


def line(cycle, x=0.0, z=0.0, c=0.0, away=0, probe=0.0):
    axes = f"{x:.17g} 0 {z:.17g} 0 {c:.17g}"
    return f"{cycle} {cycle * 1_000_000} {axes} {away} {probe:.17g}\n".encode()


def test_a_picometre_of_a_millimetre_arrives():
    wire = b"".join(line(n, z=12.345678901234, c=359.123456789) for n in range(1, 4))
    (pair,), _ = read([wire])
    np.testing.assert_allclose(pair.axes.z, 12.345678901234e-3, rtol=0, atol=1e-12)
    np.testing.assert_allclose(pair.axes.c, np.radians(359.123456789), rtol=0, atol=2e-11)


def test_every_cycle_is_counted_and_a_restart_is_no_gap():
    wire = [b"".join(map(line, range(1, 6))), line(8) + b"overrun\n" + line(9) + line(10)]
    wire.append(b"".join(line(n, z=1.0) for n in range(1, 4)))
    blocks, counts = read(wire)
    assert (counts["lost"], counts["gaps"], counts["overruns"]) == (2, 1, 1)
    assert counts["restarts"] == counts["malformed"] == 1
    assert counts["decoded"] == counts["delivered"] == 11
    assert [b.axes.first_sample for b in blocks][:2] == [1, 8]


def test_after_a_restart_the_homed_axes_may_be_at_zero():
    before = b"".join(line(n, x=12.0, z=1.5, c=1e4) for n in range(5001, 5004))
    wire = [before, DeviceError("killed"), b"".join(map(line, range(700, 704)))]
    values = defaults() | {"device": "linuxcnc", "port": "tcp://h:1"}
    device = make(values, Script(*wire), lambda: 0)
    device.open()
    blocks = device.poll(0.0)
    with pytest.raises(DeviceError):
        device.poll(0.0)
    blocks += device.close()
    device.open()
    blocks += [*device.poll(0.0), *device.close()]
    assert [(b.axes.first_sample, len(b.axes)) for b in blocks] == [(5001, 3), (700, 4)]
    assert not device.trouble
    assert (device.counts()["restarts"], device.counts()["gaps"]) == (1, 0)


def test_the_probe_has_no_target_where_the_program_does_not_measure():
    (pair,), _ = read([line(1, away=1) + line(2, probe=-123.25)])
    assert pair.distance.ok.tolist() == [False, True]
    assert pair.distance.distance[1] == -123.25e-9


def test_stated_scales_are_kept():
    (pair,), _ = read([line(1, x=1.0) + line(2, x=1.0)], **{"x.counts_per_unit": 1 / 0.0254})
    np.testing.assert_allclose(pair.axes.x, 0.0254)


def test_the_scale_of_an_encoder_is_refused():
    """``config/axis_driver.yaml`` has one: millimetres would be taken for counts."""
    text = (Path(__file__).parents[2] / "config/axis_driver.yaml").read_text()
    (node,) = yaml.safe_load(text).values()
    stated = node["ros__parameters"]
    given = {f"{axis}.{name}": value for axis in AXES for name, value in stated[axis].items()}
    with pytest.raises(ConfigurationError, match="mm, inch or degrees: leave it out"):
        read([], columns=stated["columns"], **given)


def test_another_period_than_linuxcnc_states_is_not_delivered():
    """LinuxCNC runs at 1 kHz, ``sample_period`` states 4 kHz."""
    blocks, counts = read(
        [b"".join(map(line, range(1 + 50 * k, 51 + 50 * k))) for k in range(10)],
        sample_period=2.5e-4,
    )
    assert not blocks
    assert counts["withheld"] == 500


HAL = """
import pathlib

sampler_base = 0

class component:
    def __init__(self, name): pass
    def ready(self): pass

class stream:
    num_overruns = numbers = 0
    def __init__(self, *_): pass
    @property
    def readable(self): return pathlib.Path("sampling").exists() and self.numbers < 100
    def read(self):
        self.numbers += 1
        return [self.numbers]
"""


def test_a_client_that_left_before_the_first_sample_costs_none(tmp_path: Path) -> None:
    """A driver connects again while the machine is not homed; its last connection gets all."""
    (tmp_path / "hal.py").write_text(HAL)
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = free.getsockname()
    script = Path(__file__).parents[2] / "config" / "linuxcnc" / "send.py"
    command = [sys.executable, script, str(address[1]), "f"]
    with subprocess.Popen(command, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}) as sender:
        try:
            for _ in range(3):
                connected(address).close()
            with connected(address) as last:
                (tmp_path / "sampling").touch()
                said = b""
                while said.count(b"\n") < 100 and (more := last.recv(4096)):
                    said += more
        finally:
            sender.kill()
    assert [float(line) for line in said.split()] == list(range(1, 101))


def connected(address: tuple[str, int]) -> socket.socket:
    given_up = time.monotonic() + 20
    while True:
        try:
            return socket.create_connection(address, 20)
        except ConnectionRefusedError:
            assert time.monotonic() < given_up
            time.sleep(0.05)
