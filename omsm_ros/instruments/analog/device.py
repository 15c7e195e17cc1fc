"""Reads analog sensors through a converter: an accelerometer, a capacitive probe."""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from types import MappingProxyType
from typing import Any, TypeAlias
from urllib.parse import parse_qs

import numpy as np

from omsm_ros.core.streams.blocks import AccelerationBlock, Block, DistanceBlock, FloatArray, Status
from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.arrivals import DeviceClock
from omsm_ros.instruments.blocks import BlockPair, BlockSettings
from omsm_ros.instruments.parameters import NowNs, Values, block_settings, probe_reading_of
from omsm_ros.instruments.scaling import ProbeReading
from omsm_ros.instruments.transport import optional_package, parts_of
from omsm_ros.units import NANOSECONDS_PER_S

# The buffer of the converter's driver is longer than any pause of a healthy host [s].
_BUFFER_S = 10.0
# NI-DAQmx: samples were overwritten before they were read.
_OVERWRITTEN = (-200279, -200278)


class NidaqInput:
    """Reads ``daq://Dev1/ai0:2?range=10&clock=PFI0`` by NI-DAQmx; not tested on hardware.

    range: largest voltage [V];  clock: terminal of an external sample clock, such as the probe's
    trigger; without one the converter's own clock is used
    """

    def __init__(self, address: str, channels: int) -> None:
        """Raise ConfigurationError for an address that is not valid."""
        parts = parts_of(address)
        query = {name: values[0] for name, values in parse_qs(parts.query).items()}
        if not parts.netloc or len(parts.path) < 2 or set(query) - {"range", "clock"}:
            raise ConfigurationError(
                f"address {address!r}, expected daq://Dev1/ai0:{channels - 1}?range=10&clock=PFI0"
            )
        self.name = address
        self._channels = channels
        self._lines = f"{parts.netloc}{parts.path}"
        self._clock = query.get("clock", "")
        try:
            self._range = float(query.get("range", "10"))
        except ValueError as err:
            raise ConfigurationError(f"address {address!r}: range is no number of volts") from err
        if not 0 < self._range <= 1000:
            raise ConfigurationError(f"address {address!r}: range beyond 0 to 1000 V")
        self._task: Any = None

    def open(self, rate: float) -> None:
        """Begin to sample at ``rate`` [Hz]; raises DeviceError."""
        self.close()
        nidaqmx = _nidaqmx()
        try:
            self._task = nidaqmx.Task()
            self._task.ai_channels.add_ai_voltage_chan(
                self._lines, min_val=-self._range, max_val=self._range
            )
            self._task.timing.cfg_samp_clk_timing(
                rate,
                source=self._clock,
                sample_mode=nidaqmx.constants.AcquisitionType.CONTINUOUS,
                samps_per_chan=int(rate * _BUFFER_S) + 1,
            )
            found = float(self._task.timing.samp_clk_rate)
            count = int(self._task.number_of_channels)
            self._task.start()
        except nidaqmx.errors.Error as err:
            self.close()
            raise DeviceError(
                f"{self.name} cannot be read: {' '.join(str(err).split())[:300]}; check the "
                "device's name in NI MAX or nilsdev, and its channels"
            ) from err
        if count != self._channels:
            self.close()
            raise DeviceError(f"{self.name} has {count} channels, expected {self._channels}")
        if not self._clock and abs(found / rate - 1) > 1e-3:
            self.close()
            raise DeviceError(
                f"{self.name} samples at {found:.6g} Hz where {rate:.6g} Hz was requested; set "
                f"sample_period to {1 / found:.9g} s"
            )

    def read(self, timeout: float) -> FloatArray:
        """Return the samples since the last call, (n, channels) [V]; raises DeviceError."""
        if self._task is None:
            raise DeviceError(f"{self.name} is not open")
        nidaqmx = _nidaqmx()
        try:
            if not self._task.in_stream.avail_samp_per_chan:
                time.sleep(min(timeout, 0.02))
            if not (waiting := int(self._task.in_stream.avail_samp_per_chan)):
                return np.empty((0, self._channels))
            values = self._task.read(number_of_samples_per_channel=waiting, timeout=timeout + 1.0)
        except nidaqmx.errors.Error as err:
            lost = getattr(err, "error_code", 0) in _OVERWRITTEN
            reason = "samples were overwritten before they were read" if lost else str(err)
            raise DeviceError(
                f"{self.name}: {' '.join(reason.split())[:300]}; check cable, power and the "
                "computer's load"
            ) from err
        return np.asarray(values, np.float64).reshape(self._channels, -1).T.copy()

    def close(self) -> None:
        """Stop; does nothing when not open."""
        if self._task is not None:
            task, self._task = self._task, None
            with suppress(Exception):  # a converter that was unplugged refuses it
                task.close()


class SyntheticInput:
    """Makes ``synthetic://?frequency=680&amplitude=0.01&noise=0.001``: a sine with noise [V].

    Each channel lags the one before by a quarter of a period. For trials without a converter: it
    is sampled by the host's monotonic clock, so its rate is true.
    """

    def __init__(
        self, address: str, channels: int, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        """Raise ConfigurationError for an address that is not valid."""
        parts = parts_of(address)
        query = {name: values[0] for name, values in parse_qs(parts.query).items()}
        values = {"frequency": 100.0, "amplitude": 0.01, "noise": 1e-4}
        if set(query) - set(values) or parts.netloc:
            raise ConfigurationError(
                f"address {address!r}, expected synthetic://?frequency=680&amplitude=0.01&noise=1e-3"
            )
        try:
            values |= {name: float(text) for name, text in query.items()}
        except ValueError as err:
            raise ConfigurationError(f"address {address!r}: {err}") from err
        if not all(np.isfinite(v) and 0 <= v < 1e6 for v in values.values()):
            raise ConfigurationError(f"address {address!r}: values beyond 0 to 1e6")
        self.name = address
        self._values, self._channels, self._monotonic = values, channels, monotonic
        self._random = np.random.default_rng(1)
        self._rate = self._start = 0.0
        self._taken = -1

    def open(self, rate: float) -> None:
        """Begin at ``rate`` [Hz]."""
        self._rate, self._start, self._taken = rate, self._monotonic(), 0

    def read(self, timeout: float) -> FloatArray:
        """Return the samples since the last call, (n, channels) [V]."""
        if self._taken < 0:
            raise DeviceError(f"{self.name} is not open")
        due = int((self._monotonic() - self._start) * self._rate)
        if due == self._taken:
            time.sleep(min(timeout, 0.02))
            due = int((self._monotonic() - self._start) * self._rate)
        when = np.arange(self._taken, due) / self._rate
        self._taken = due
        quarter = np.arange(self._channels) * np.pi / 2
        phase = 2 * np.pi * self._values["frequency"] * when[:, np.newaxis] - quarter
        noise = self._random.normal(0.0, self._values["noise"] or 0.0, phase.shape)
        return np.asarray(self._values["amplitude"] * np.sin(phase) + noise)

    def close(self) -> None:
        """Stop."""
        self._taken = -1


Converter: TypeAlias = NidaqInput | SyntheticInput


def analog_input(address: str, channels: int) -> Converter:
    """Return the input that ``address`` names (``daq://``, ``synthetic://``), not yet open.

    Raises ConfigurationError.
    """
    scheme = parts_of(address).scheme
    if scheme == "daq":
        return NidaqInput(address, channels)
    if scheme == "synthetic":
        return SyntheticInput(address, channels)
    raise ConfigurationError(f"address {address!r}, expected daq://Dev1/ai0 or synthetic://")


_nidaqmx = partial(optional_package, "daq://", "nidaqmx.constants")

STANDARD_GRAVITY = 9.80665
"""[m/s²], exact by definition."""


class AnalogDevice:
    """Reads a free-running converter and cuts its samples into blocks.

    The converter does not number its samples, so they are counted here; after a loss the count
    continues by the time that passed, and the difference is ``lost``. A kind of sensor implements
    ``_block``.
    """

    # A converter does not know its sensor, and its samples can always be used.
    identity: Mapping[str, str] = MappingProxyType({})
    trouble = caution = ""

    def __init__(
        self,
        source: Converter,
        settings: BlockSettings,
        sensitivity: float,
        probe: ProbeReading | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """sensitivity: [V per unit of the quantity];  probe: its range begins at 0 V
        now_ns: the host clock of the stamps [ns];  monotonic: for the time lost [s]
        """
        self._source, self._settings = source, settings
        self._sensitivity, self._probe = sensitivity, probe or ProbeReading()
        self._now_ns, self._monotonic = now_ns, monotonic
        self._clock = DeviceClock()
        self._waiting: FloatArray = np.empty((0, 0))
        self._first = self._decoded = self._delivered = self._lost = self._gaps = 0
        self._heard = 0.0

    def open(self) -> None:
        """Begin to sample; raises DeviceError."""
        self._source.open(1.0 / self._settings.sample_period)
        now = self._monotonic()
        if self._decoded:
            missed = max(round((now - self._heard) / self._settings.sample_period), 0)
            self._lost += missed
            self._gaps += missed > 0
            self._first += missed
        self._heard = now

    def poll(self, timeout: float) -> list[Any]:
        """Return blocks completed by what comes within ``timeout`` [s]; raises DeviceError."""
        volts = self._source.read(timeout)
        if not len(volts):
            return []
        self._heard = self._monotonic()
        self._decoded += len(volts)
        self._waiting = np.concatenate([self._waiting.reshape(-1, volts.shape[1]), volts])
        newest = self._first + len(self._waiting) - 1
        self._clock.observe(self._device_ns(newest), self._now_ns())
        size = self._settings.block_size
        return [self._take(size) for _ in range(len(self._waiting) // size)]

    def close(self) -> list[Any]:
        """Stop and return the partial block, if any."""
        blocks = [self._take(len(self._waiting))] if len(self._waiting) else []
        self._source.close()
        return blocks

    def counts(self) -> dict[str, float]:
        """Return the counts of samples: ``decoded = delivered + pending``; lost, gaps."""
        names = ("decoded", "delivered", "lost", "gaps")
        return {name: getattr(self, f"_{name}") for name in names} | {"pending": len(self._waiting)}

    def _device_ns(self, number: int) -> int:
        return round(number * self._settings.sample_period * NANOSECONDS_PER_S)

    def _take(self, count: int) -> Any:
        volts, self._waiting = self._waiting[:count], self._waiting[count:]
        stamp = self._clock.to_host(self._device_ns(self._first))
        common = {
            "stamp_ns": stamp,
            "first_sample": self._first,
            "sample_period": self._settings.sample_period,
        }
        self._first += count
        self._delivered += count
        return self._block(volts, common)

    def _block(self, volts: FloatArray, common: dict[str, Any]) -> Block | BlockPair:
        """Return the block of ``volts`` (n, channels) [V]."""
        raise NotImplementedError


class AnalogAccelerometer(AnalogDevice):
    """Reads three axes; an IEPE sensor has no response at 0 Hz, and no offset is removed.

    Its sensitivity is in V/(m/s²); the paper's PCB 356A17 has 0.5 V/g.
    """

    def _block(self, volts: FloatArray, common: dict[str, Any]) -> AccelerationBlock:
        x, y, z = np.ascontiguousarray(volts.T / self._sensitivity)
        return AccelerationBlock(**common, x=x, y=y, z=z)


class AnalogReference(AnalogDevice):
    """Reads a displacement sensor; beyond its range there is no distance.

    Its sensitivity is in V/m; the paper's CPL190 has 80 mV/µm.
    """

    def _block(self, volts: FloatArray, common: dict[str, Any]) -> BlockPair:
        reading = volts[:, 0] / self._sensitivity
        outside = ~((reading >= 0) & (reading <= self._probe.full_scale))
        distance = np.where(outside, np.nan, self._probe.distance(reading))
        status = np.where(outside, Status.OUT_OF_RANGE, Status.OK).astype(np.uint8)
        return BlockPair(None, DistanceBlock(**common, distance=distance, status=status))


def make_accelerometer(values: Values, now_ns: NowNs) -> AnalogAccelerometer:
    """Return the accelerometer that ``values`` describe."""
    settings = BlockSettings(**block_settings(values))
    sensitivity = values["sensitivity"] / STANDARD_GRAVITY
    return AnalogAccelerometer(
        analog_input(values["port"], 3), settings, sensitivity, now_ns=now_ns
    )


def make_reference(values: Values, now_ns: NowNs) -> AnalogReference:
    """Return the displacement sensor that ``values`` describe."""
    return AnalogReference(
        analog_input(values["port"], 1),
        BlockSettings(**block_settings(values)),
        values["sensitivity"],
        probe_reading_of(values),
        now_ns=now_ns,
    )
