"""Analog sensors through a converter, to blocks: an accelerometer, a capacitive probe."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from omsm_ros.core.samples.blocks import AccelerationBlock, Block, DistanceBlock, FloatArray, Status
from omsm_ros.devices.analog_inputs import AnalogInput
from omsm_ros.devices.blocks import BlockPair
from omsm_ros.devices.clock import DeviceClock
from omsm_ros.units import NANOSECONDS_PER_S

STANDARD_GRAVITY = 9.80665
"""[m/s²], exact by definition."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalogSettings:
    """sample_period: [s];  block_size: samples in a block."""

    sample_period: float
    block_size: int


class AnalogDevice:
    """Samples a converter that runs freely and cuts what it gives into blocks.

    The converter numbers nothing, so samples are counted here; after a loss the count goes on by
    the time that passed, and the difference is ``lost``. A kind of sensor fills in ``_block``.
    """

    def __init__(
        self,
        source: AnalogInput,
        settings: AnalogSettings,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """now_ns: the host clock that stamps refer to [ns];  monotonic: for the time lost [s]."""
        self._source, self._settings = source, settings
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
        waiting = self._waiting if len(self._waiting) else volts[:0]
        self._waiting = np.concatenate([waiting, volts])
        newest = self._first + len(self._waiting) - 1
        self._clock.observe(self._device_ns(newest), self._now_ns())
        blocks = []
        while len(self._waiting) >= self._settings.block_size:
            blocks.append(self._take(self._settings.block_size))
        return blocks

    def close(self) -> list[Any]:
        """Stop and return the partial block, if any."""
        blocks = [self._take(len(self._waiting))] if len(self._waiting) else []
        self._source.close()
        return blocks

    @property
    def identity(self) -> dict[str, str]:
        """A converter knows nothing of its sensor."""
        return {}

    @property
    def trouble(self) -> str:
        """Return why the samples cannot be used; they always can."""
        return ""

    def counts(self) -> dict[str, float]:
        """Return what became of every sample: ``decoded = delivered + pending``; lost, gaps."""
        return {
            "decoded": self._decoded,
            "delivered": self._delivered,
            "pending": len(self._waiting),
            "lost": self._lost,
            "gaps": self._gaps,
        }

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


class Accelerometer(AnalogDevice):
    """Three axes; it cannot see 0 Hz if it is an IEPE sensor, and its offset is not removed."""

    def __init__(
        self, source: AnalogInput, settings: AnalogSettings, sensitivity: float, **clocks: Any
    ) -> None:
        """sensitivity: [V/(m/s²)]; the paper's PCB 356A17 has 0.5 V/g."""
        super().__init__(source, settings, **clocks)
        self._sensitivity = sensitivity

    def _block(self, volts: FloatArray, common: dict[str, Any]) -> AccelerationBlock:
        x, y, z = np.ascontiguousarray(volts.T / self._sensitivity)
        return AccelerationBlock(**common, x=x, y=y, z=z)


class AnalogReference(AnalogDevice):
    """A displacement sensor with a voltage; beyond its range it measures no distance."""

    def __init__(
        self,
        source: AnalogInput,
        settings: AnalogSettings,
        *,
        sensitivity: float,
        full_scale: float,
        polarity: int = 1,
        zero: float = 0.0,
        **clocks: Any,
    ) -> None:
        """sensitivity: [V/m], the paper's CPL190 has 80 mV/µm;  full_scale: range, from 0 V [m]
        polarity: +1 if the reading falls as z rises;  zero: reading that is distance zero [m]
        """
        super().__init__(source, settings, **clocks)
        self._sensitivity, self._full_scale = sensitivity, full_scale
        self._polarity, self._zero = polarity, zero

    def _block(self, volts: FloatArray, common: dict[str, Any]) -> BlockPair:
        reading = volts[:, 0] / self._sensitivity
        outside = ~((reading >= 0) & (reading <= self._full_scale))
        distance = np.where(outside, np.nan, self._polarity * (reading - self._zero))
        status = np.where(outside, Status.OUT_OF_RANGE, Status.OK).astype(np.uint8)
        return BlockPair(None, DistanceBlock(**common, distance=distance, status=status))
