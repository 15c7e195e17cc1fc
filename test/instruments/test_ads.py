"""The ring buffer of a PLC, played by pyads' own server: every sample once, gaps counted."""

import ctypes
import socket
import struct
import time
from contextlib import ExitStack, suppress

import numpy as np
import pytest

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.six_channel.device import GenericStreamDevice
from omsm_ros.instruments.six_channel.latches import AdsRing
from omsm_ros.instruments.transport import transport_for

pytest.importorskip("pyads", reason="pyads is an optional package")
from pyads.testserver import AdsTestServer, AdvancedHandler, PLCVariable

# All threads here are those of pyads' server, which ends one with an error if a client is gone.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")

SAMPLES = 50
ADDRESS = f"ads://127.0.0.1?samples={SAMPLES}"


def _wait_for_the_server():
    for _ in range(100):
        with suppress(OSError), socket.create_connection(("127.0.0.1", 48898), 1.0):
            return
        time.sleep(0.02)


class Plc:
    """A ring of samples as a PLC writes it, by struct and not by our table."""

    def __init__(self):
        self.written = 0
        self.ring = [bytes(57)] * SAMPLES
        handler = AdvancedHandler()
        self.variable = PLCVariable("GVL.omsm", self.image(), 65, "OmsmRing")
        handler.add_variable(self.variable)
        self.server = AdsTestServer(handler=handler, logging=False)
        self.server.start()
        self.epoch = 0
        _wait_for_the_server()

    def image(self):
        return struct.pack("<Q", self.written) + b"".join(self.ring)

    def sample(self, count):
        for _ in range(count):
            n = self.written
            self.ring[self.written % SAMPLES] = struct.pack(
                "<IQiB5q",
                n,
                self.epoch + n * 1_000_000,
                -n,
                0,
                *(10 * n + axis for axis in range(5)),
            )
            self.written += 1
        self.variable.value = self.image()


@pytest.fixture
def plc():
    try:  # bound here first, for their server forgets its socket if it cannot bind it
        socket.create_server(("127.0.0.1", 48898)).close()
    except OSError as err:
        pytest.skip(f"port 48898 is in use: {err}")
    made = Plc()
    yield made
    made.server._run = False  # its stop would close the socket that its thread still waits on
    made.server.join(timeout=5.0)
    made.server.stop()


@pytest.fixture
def device(plc):
    made = GenericStreamDevice(transport_for(ADDRESS))
    made.open()
    yield made
    made.close()


def poll(device, times=3):
    return [pair for _ in range(times) for pair in device.poll(0.05)]


def test_every_sample_of_the_ring_comes_once(plc, device):
    assert poll(device, 1) == []
    for count in (7, 30, 45, 18):
        plc.sample(count)
        poll(device, 1)
    blocks = device.close()
    assert device.statistics.decoded == 100
    assert device.statistics.lost == 0
    assert device.statistics.delivered == 100
    assert blocks == []


def test_counts_and_distance_are_those_of_the_plc(plc, device):
    plc.sample(20)
    poll(device, 1)
    (pair,) = device.close()
    assert pair.distance.distance == pytest.approx(-np.arange(20) * 1e-9)
    scaled = pair.axes.z * 1e10
    assert scaled == pytest.approx(10 * np.arange(20) + 2)


def test_what_was_overwritten_is_a_gap(plc, device):
    plc.sample(10)
    poll(device, 1)
    plc.sample(SAMPLES + 13)
    poll(device, 1)
    device.close()
    assert device.statistics.decoded == 10 + SAMPLES
    assert device.statistics.lost == 13


def test_a_lost_connection_costs_no_sample_that_the_ring_still_holds(plc, device):
    plc.sample(20)
    poll(device, 1)
    device.close()
    plc.sample(SAMPLES - 1)
    device.open()
    poll(device, 1)
    assert device.statistics.decoded == 20 + SAMPLES - 1
    assert device.statistics.lost == 0


def test_a_number_of_samples_that_was_spoilt_repeats_no_sample(plc, device):
    plc.sample(70)
    poll(device, 1)
    plc.variable.value = struct.pack("<Q", 2**64 - 5) + plc.image()[8:]
    poll(device, 1)
    plc.sample(20)
    poll(device, 1)
    device.close()
    counted = device.statistics
    assert (counted.delivered, counted.lost, counted.restarts) == (50 + 20, 0, 0)


def test_a_plc_that_counts_anew_goes_on(plc, device):
    plc.sample(30)
    poll(device, 1)
    plc.written, plc.epoch = 0, 5_000_000_000
    plc.sample(12)
    poll(device, 1)
    device.close()
    assert device.statistics.decoded == 42
    assert device.statistics.restarts == 1


@pytest.mark.parametrize(("samples", "reported"), [(60, "packed to one byte"), (40, "has more")])
def test_a_ring_of_another_size_is_reported(plc, monkeypatch, samples, reported):
    # Half of the samples would be repeated or lost, if the first part of a larger ring were read.
    import pyads

    def as_twincat_reads(connection, name, kind, **more):
        if ctypes.sizeof(kind) > len(plc.image()):
            raise pyads.ADSError(0x705)
        return kind.from_buffer_copy(plc.image())

    monkeypatch.setattr(pyads.Connection, "read_by_name", as_twincat_reads)
    ring = AdsRing(f"ads://127.0.0.1?samples={samples}")
    with pytest.raises(DeviceError, match=reported):
        ring.open()


def test_a_symbol_that_is_not_there_is_reported(plc):
    # Their server does not answer such a request: the promised return within 2 s allows for one
    # answer that does not come.
    ring, begin = AdsRing(f"{ADDRESS}&symbol=GVL.other"), time.monotonic()
    with pytest.raises(DeviceError, match=r"GVL\.other"):
        ring.open()
    assert time.monotonic() - begin < 1.7


def test_a_plc_that_is_switched_off_is_given_up_soon():
    # A host that does not answer at all: the queue of connections that it accepts is full.
    with socket.create_server(("127.0.0.77", 48898), backlog=0), ExitStack() as others:
        for _ in range(3):
            other = others.enter_context(socket.socket())
            other.setblocking(False)
            other.connect_ex(("127.0.0.77", 48898))
        begin = time.monotonic()
        with pytest.raises(DeviceError, match="does not answer: timed out"):
            AdsRing("ads://127.0.0.77").open()
        assert time.monotonic() - begin < 1.7


def test_no_plc_is_one_clear_line():
    ring = AdsRing("ads://127.0.0.1:1?samples=5")
    with pytest.raises(DeviceError, match=r"route|packed"):
        ring.open()
    with pytest.raises(DeviceError, match="not open"):
        ring.read(0.0)


@pytest.mark.parametrize(
    "address",
    [
        "ads://",
        "ads://h?ring=3",
        "ads://h?samples=0",
        "ads://h?samples=x",
        "ads://h?samples=9999999",
        "ads://[::1",
    ],
)
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(ConfigurationError, match=r"expected ads://host|cannot be read"):
        transport_for(address)
