"""Voltages of an analog-to-digital converter: National Instruments', or a synthetic one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol
from urllib.parse import parse_qs

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.devices.addresses import parts_of
from omsm_ros.errors import ConfigurationError, DeviceError

# The driver's buffer holds ten seconds: longer than any pause of a healthy host.
_BUFFER_S = 10.0
# NI-DAQmx: samples were overwritten before they were read.
_OVERWRITTEN = (-200279, -200278)


class AnalogInput(Protocol):
    """Several channels sampled together and evenly.

    name: for messages
    """

    @property
    def name(self) -> str:
        """Return what the input is called in messages."""
        ...

    def open(self, rate: float) -> None:
        """Begin to sample at ``rate`` [Hz]; raises DeviceError."""

    def read(self, timeout: float) -> FloatArray:
        """Return what was sampled since, (n, channels) [V], waiting up to ``timeout`` [s].

        Raises DeviceError where samples were lost or the converter is gone.
        """

    def close(self) -> None:
        """Stop; does nothing when not open."""


class NidaqInput:
    """``daq://Dev1/ai0:2?range=10&clock=PFI0``: by NI's own driver and its Python package.

    range: largest voltage [V];  clock: terminal of an external sample clock, such as the probe's
    trigger; the converter's own without. Imported where it is opened; untried on hardware.
    """

    def __init__(self, address: str, channels: int) -> None:
        """Raise ConfigurationError for an address that is none."""
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
                f"{self.name} samples at {found:.6g} Hz where {rate:.6g} Hz was asked for; set "
                f"sample_period to {1 / found:.9g} s"
            )

    def read(self, timeout: float) -> FloatArray:
        """Return what was sampled since, (n, channels) [V]; raises DeviceError."""
        if self._task is None:
            raise DeviceError(f"{self.name} is not open")
        nidaqmx = _nidaqmx()
        try:
            waiting = int(self._task.in_stream.avail_samp_per_chan)
            if not waiting:
                time.sleep(min(timeout, 0.02))
                waiting = int(self._task.in_stream.avail_samp_per_chan)
            if not waiting:
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
            task.close()


class SyntheticInput:
    """``synthetic://?frequency=680&amplitude=0.01&noise=0.001``: a sine on noise, in volts.

    On each channel a quarter of a turn later. For trials without a converter: it samples the host's
    monotonic clock, so that its rate is true.
    """

    def __init__(
        self, address: str, channels: int, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        """Raise ConfigurationError for an address that is none."""
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
        """Return what a converter would have sampled since, (n, channels) [V]."""
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


def analog_input(address: str, channels: int) -> AnalogInput:
    """Return the input that ``address`` names (``daq://``, ``synthetic://``), not yet open.

    Raises ConfigurationError.
    """
    scheme = parts_of(address).scheme
    if scheme == "daq":
        return NidaqInput(address, channels)
    if scheme == "synthetic":
        return SyntheticInput(address, channels)
    raise ConfigurationError(f"address {address!r}, expected daq://Dev1/ai0 or synthetic://")


def _nidaqmx() -> Any:
    try:
        import nidaqmx
        import nidaqmx.constants
    except ImportError as err:
        raise DeviceError("daq:// needs nidaqmx: pip install nidaqmx") from err
    return nidaqmx
