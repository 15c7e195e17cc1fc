"""Analog sensors: volts to SI, every sample counted, stamps even; NI's package played by a fake."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.analog.device import (
    AnalogAccelerometer,
    AnalogReference,
    BlockSettings,
    NidaqInput,
    SyntheticInput,
    analog_input,
)
from omsm_ros.instruments.scaling import ProbeReading

PERIOD_NS = 500_000
SETTINGS = BlockSettings(sample_period=5e-4, block_size=50)


class Source:
    """A converter whose samples the test hands over."""

    name = "the test"

    def __init__(self):
        self.rate, self.ready, self.broken = None, [], False

    def open(self, rate):
        self.rate, self.broken = rate, False

    def read(self, timeout):
        if self.broken:
            raise DeviceError("the test pulled the cable")
        return self.ready.pop(0) if self.ready else np.empty((0, 3))

    def close(self):
        self.rate = None


class Host:
    """A clock that the test moves."""

    def __init__(self):
        self.ns = 1_000_000_000_000

    def now_ns(self):
        return self.ns

    def monotonic(self):
        return self.ns * 1e-9


@pytest.fixture
def host():
    return Host()


def accelerometer(source, host):
    clocks = {"now_ns": host.now_ns, "monotonic": host.monotonic}
    return AnalogAccelerometer(source, SETTINGS, sensitivity=0.5 / 9.80665, **clocks)


def feed(device, source, host, volts):
    host.ns += len(volts) * PERIOD_NS
    source.ready.append(volts)
    return device.poll(0.0)


def test_volts_become_metres_per_second_squared(host):
    source = Source()
    device = accelerometer(source, host)
    device.open()
    assert source.rate == pytest.approx(2000.0)
    volts = np.tile([0.5, -0.25, 1.0], (120, 1))
    blocks = feed(device, source, host, volts) + device.close()
    assert [len(b) for b in blocks] == [50, 50, 20]
    assert [b.first_sample for b in blocks] == [0, 50, 100]
    # 0.5 V at 500 mV/g is one standard gravity.
    assert blocks[0].x == pytest.approx(np.full(50, 9.80665))
    assert blocks[2].y == pytest.approx(np.full(20, -9.80665 / 2))
    assert device.counts() == {
        "decoded": 120, "delivered": 120, "pending": 0, "lost": 0, "gaps": 0,
    }  # fmt: skip


def test_stamps_are_even_though_arrivals_are_not(host):
    source, random = Source(), np.random.default_rng(1)
    device = accelerometer(source, host)
    device.open()
    start = host.ns
    blocks = []
    for _ in range(400):
        count = int(random.integers(20, 180))
        late = int(random.uniform(0, 2e6))
        host.ns += count * PERIOD_NS + late
        source.ready.append(np.zeros((count, 3)))
        blocks += device.poll(0.0)
        host.ns -= late
    stamps = np.array([b.stamp_ns for b in blocks])[200:]
    true = np.array([start + b.first_sample * PERIOD_NS for b in blocks])[200:]
    assert np.all(np.diff(stamps) > 0)
    # The mean lateness of a millisecond stays; it cannot be distinguished from that of the sensor.
    assert np.std(stamps - true) < 100e3


def test_a_loss_is_a_gap_of_the_time_that_passed(host):
    source = Source()
    device = accelerometer(source, host)
    device.open()
    feed(device, source, host, np.zeros((60, 3)))
    source.broken = True
    with pytest.raises(DeviceError):
        device.poll(0.0)
    (rest,) = device.close()
    assert len(rest) == 10
    host.ns += 4000 * PERIOD_NS
    device.open()
    (block,) = feed(device, source, host, np.zeros((50, 3)))
    assert block.first_sample == 60 + 4000
    assert device.counts()["lost"] == 4000
    assert device.counts()["gaps"] == 1


def test_a_capacitive_probe_beyond_its_range_tells_no_distance(host):
    source = Source()
    device = AnalogReference(
        source, SETTINGS, 80e3, ProbeReading(full_scale=250e-6, polarity=-1, zero=125e-6),
        now_ns=host.now_ns, monotonic=host.monotonic,
    )  # fmt: skip
    device.open()
    volts = np.array([10.0, 0.0, 20.0, 20.1, -0.1] * 10)[:, np.newaxis]
    (pair,) = feed(device, source, host, volts)
    found = pair.distance
    assert found.distance[:3] == pytest.approx([0.0, 125e-6, -125e-6])
    assert np.all(np.isnan(found.distance[3:5]))
    assert found.status[:5].tolist() == [0, 0, 0, 3, 3]


def test_the_synthetic_input_keeps_its_rate_and_its_line(host):
    source = SyntheticInput("synthetic://?frequency=50&amplitude=2&noise=0.01", 3, host.monotonic)
    source.open(1000.0)
    parts = []
    for _ in range(100):
        host.ns += 10_000_000
        parts.append(source.read(0.0))
    volts = np.concatenate(parts)
    assert volts.shape == (1000, 3)
    spectrum = np.abs(np.fft.rfft(volts, axis=0)) / 500
    assert np.argmax(spectrum[:, 0]) == 50
    assert spectrum[50] == pytest.approx(2.0, rel=1e-2)


@pytest.mark.parametrize(
    "address",
    ["daq://", "daq://Dev1", "daq://Dev1/ai0?gain=3", "daq://Dev1/ai0?range=x", "tcp://h:1",
     "daq://Dev1/ai0?range=0", "synthetic://?volume=11", "synthetic://?noise=nan", "",
     "daq://[::1/ai0", "//[", "synthetic://[x]y"],
)  # fmt: skip
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(ConfigurationError, match="address"):
        analog_input(address, 3)


# NI's package, played.


class DaqError(Exception):
    error_code = 0


class Task:
    """The part of nidaqmx.Task that the driver uses, after NI's manual."""

    def __init__(self, world):
        self.world, self.started = world, False
        self.ai_channels = SimpleNamespace(add_ai_voltage_chan=self.add)
        self.timing = SimpleNamespace(cfg_samp_clk_timing=self.clock, samp_clk_rate=0.0)
        self.in_stream = SimpleNamespace(avail_samp_per_chan=0)
        world["task"] = self

    def add(self, lines, min_val, max_val):
        if lines.startswith("Dev9"):
            raise DaqError("Device identifier is invalid.\nTask Name: _unnamedTask<0>")
        first, _, last = lines.partition("ai")[2].partition(":")
        self.number_of_channels = int(last or first) - int(first) + 1
        self.world["range"] = (min_val, max_val)

    def clock(self, rate, source, sample_mode, samps_per_chan):
        self.timing.samp_clk_rate = self.world.get("coerced", rate)

    def start(self):
        self.started = True

    def read(self, number_of_samples_per_channel, timeout):
        if self.world.get("fails"):
            raise self.world["fails"]
        rows = [[c + 0.1 * i for i in range(number_of_samples_per_channel)]
                for c in range(self.number_of_channels)]  # fmt: skip
        # One channel comes as a flat list, as the package does it.
        return rows if self.number_of_channels > 1 else rows[0]

    def close(self):
        self.world["closed"] = True


@pytest.fixture
def daq(monkeypatch):
    world = {}
    acquisition = SimpleNamespace(AcquisitionType=SimpleNamespace(CONTINUOUS="continuous"))
    fake = SimpleNamespace(
        Task=lambda: Task(world), errors=SimpleNamespace(Error=DaqError), constants=acquisition
    )
    monkeypatch.setitem(sys.modules, "nidaqmx", fake)
    monkeypatch.setitem(sys.modules, "nidaqmx.constants", acquisition)
    return world


def test_channels_come_as_columns(daq):
    source = NidaqInput("daq://Dev1/ai0:2?range=5", 3)
    source.open(2000.0)
    daq["task"].in_stream.avail_samp_per_chan = 4
    volts = source.read(0.0)
    assert volts.shape == (4, 3)
    assert volts[1].tolist() == pytest.approx([0.1, 1.1, 2.1])
    assert daq["range"] == (-5.0, 5.0)
    one = NidaqInput("daq://Dev1/ai3", 1)
    one.open(2000.0)
    daq["task"].in_stream.avail_samp_per_chan = 4
    assert one.read(0.0).shape == (4, 1)
    daq["task"].in_stream.avail_samp_per_chan = 0
    assert one.read(0.0).shape == (0, 1)


def test_troubles_of_the_converter_are_one_line_with_a_remedy(daq):
    with pytest.raises(DeviceError, match=r"identifier is invalid\. Task.*; check the device's"):
        NidaqInput("daq://Dev9/ai0", 1).open(2000.0)
    assert daq["closed"]
    with pytest.raises(DeviceError, match="has 2 channels, expected 3"):
        NidaqInput("daq://Dev1/ai0:1", 3).open(2000.0)
    daq["coerced"] = 1980.2
    with pytest.raises(DeviceError, match=r"samples at 1980\.2 Hz .* set sample_period to 0\.0005"):
        NidaqInput("daq://Dev1/ai0", 1).open(2000.0)


def test_samples_that_were_overwritten_are_a_loss(daq):
    source = NidaqInput("daq://Dev1/ai0", 1)
    source.open(2000.0)
    daq["task"].in_stream.avail_samp_per_chan = 4
    daq["fails"] = DaqError("long story")
    daq["fails"].error_code = -200279
    with pytest.raises(DeviceError, match="overwritten before they were read"):
        source.read(0.0)


def test_a_converter_that_was_unplugged_is_an_error_of_the_device(daq):
    source = NidaqInput("daq://Dev1/ai0", 1)
    source.open(2000.0)

    def gone():
        raise DaqError("Device cannot be accessed.")

    daq["task"].close = gone
    source.close()
    with pytest.raises(DeviceError, match="is not open"):
        source.read(0.0)


def test_without_the_driver_the_remedy_is_reported():
    pytest.importorskip("nidaqmx", reason="nidaqmx is an optional package")
    with pytest.raises(DeviceError, match="NI-DAQmx"):
        NidaqInput("daq://Dev1/ai0", 1).open(1000.0)
