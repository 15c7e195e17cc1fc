"""What the signals of a CHRocodile mean: telegrams ↔ distance, intensity, verdict, counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import FloatArray, IntArray, Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.protocols.chrocodile_telegram import (
    DISTANCE,
    DISTANCE_16,
    DISTANCE_NM,
    ENCODERS_AT_END,
    ENCODERS_AT_START,
    FLAGS,
    INTENSITY,
    INTENSITY_16,
    SAMPLE_COUNTER,
    Records,
)
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

# Finest first: 16 bits over 100 µm are steps of 3 nm.
DISTANCES = (DISTANCE_NM, DISTANCE, DISTANCE_16)
INTENSITIES = (INTENSITY, INTENSITY_16)
SATURATED, TRIGGER_LOST, TRIGGER_DELAYED = 1, 2, 4
LATCHES = {
    "start": (ENCODERS_AT_START,),
    "end": (ENCODERS_AT_END,),
    "mean": (ENCODERS_AT_START, ENCODERS_AT_END),
}
# The device's encoders are 32 bits wide.
ENCODER_RANGE = 2**32


def check_selection(signals: Sequence[int], encoders: Sequence[int]) -> None:
    """Raise ConfigurationError unless ``signals`` hold the counter and what axes are read from."""
    if SAMPLE_COUNTER not in signals:
        raise ConfigurationError(
            f"signals {signals!r} lack {SAMPLE_COUNTER}, the sample counter: without it lost "
            "samples would not show"
        )
    if missing := sorted({*encoders} - {*signals}):
        raise ConfigurationError(
            f"signals {signals!r} lack {missing!r}, the encoders of the axes: add them, or "
            "leave `encoders` empty"
        )


@dataclass(frozen=True, slots=True)
class ProbeReading:
    """``distance = polarity · (reading - zero)``.

    full_scale: measuring range, of which 16-bit distances are parts [m] (`$SCA`)
    zero: reading that is distance zero [m]
    polarity: +1 if the reading falls as the probe nears the target; -1 if it grows
    intensity_full_scale: reading that is intensity 1
    """

    full_scale: float = 100 * MICROMETRE_M
    zero: float = 0.0
    polarity: int = 1
    intensity_full_scale: float = 100.0

    def __post_init__(self) -> None:
        for name in ("full_scale", "intensity_full_scale"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ConfigurationError(f"{name} {value!r}, expected a positive finite number")
        if self.polarity not in (1, -1):
            raise ConfigurationError(f"polarity {self.polarity!r}, expected 1 or -1")
        if not np.isfinite(self.zero):
            raise ConfigurationError(f"zero {self.zero!r} m, expected a finite number")

    def unit(self, signal: int) -> float:
        """Return the step of a distance signal [m]."""
        sixteen = self.full_scale / 2**15
        return {DISTANCE: MICROMETRE_M, DISTANCE_NM: NANOMETRE_M, DISTANCE_16: sixteen}[signal]

    def distance(self, raw: FloatArray) -> FloatArray:
        """Return the distance [m] of a reading [m]."""
        return self.polarity * (raw - self.zero)

    def raw(self, distance: FloatArray) -> FloatArray:
        """Return the reading [m] at a distance [m]."""
        return self.zero + self.polarity * distance


def first_of(choice: Sequence[int], signals: Sequence[int]) -> int | None:
    """Return the first of ``choice`` that is among ``signals``."""
    return next((number for number in choice if number in signals), None)


def distance_of(
    records: Records, signals: Sequence[int], probe: ProbeReading
) -> tuple[FloatArray, NDArray[np.float32], NDArray[np.uint8]]:
    """Return distance [m], intensity (0-1; NaN where not selected) and status of ``records`` (n,).

    Distance zero and intensity zero together are no target; so is distance zero alone where
    no intensity is selected. Raises ConfigurationError if no distance is.
    """
    number = first_of(DISTANCES, signals)
    if number is None:
        raise ConfigurationError(f"signals {signals!r} hold no distance of {DISTANCES!r}")
    raw = records[str(number)].astype(np.float64) * probe.unit(number)
    intensity = np.full(len(records), np.nan, np.float32)
    nothing = raw == 0
    light = first_of(INTENSITIES, signals)
    if light is not None:
        reported = records[str(light)].astype(np.float32)
        intensity = np.clip(reported / probe.intensity_full_scale, 0, 1).astype(np.float32)
        nothing &= reported == 0
    nothing |= ~np.isfinite(raw)
    status = np.full(len(records), Status.OK, np.uint8)
    status[(raw < 0) | (raw > probe.full_scale)] = Status.OUT_OF_RANGE
    if FLAGS in signals:
        status[(records[str(FLAGS)].astype(np.int64) & SATURATED) > 0] = Status.SATURATED
    status[nothing] = Status.NO_TARGET
    return np.where(nothing, np.nan, probe.distance(raw)), intensity, status


def counts_of(records: Records, latch: str, order: Sequence[int]) -> IntArray:
    """Return the encoder counts (n, 5) of X, Y, Z, B, C, latched as ``latch`` says.

    order: which of the device's encoders X Y Z U V (0 to 4) is on each axis. The mean of
    start and end is rounded to a whole count.
    """
    at = [
        np.stack([records[str(numbers[i])].astype(np.int64) for i in order], axis=1)
        for numbers in LATCHES[latch]
    ]
    if len(at) == 1:
        return at[0]
    half = ENCODER_RANGE // 2
    travel = (at[1] - at[0] + half) % ENCODER_RANGE - half  # the counter may wrap in between
    return at[0] + travel // 2
