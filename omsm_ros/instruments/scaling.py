"""Counts of encoders and readings of probes, to and from metres and radians, and their turns.

The ranges of these figures are those of the drivers' parameters, which check them.
"""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.units import MICROMETRE_M

AXES = ("x", "y", "z", "b", "c")


def whole_counts(name: str, values: FloatArray, kind: type[np.signedinteger[Any]]) -> FloatArray:
    """Return ``values`` (n,); DataError, which calls them ``name``, if they do not fit ``kind``."""
    lowest = float(np.iinfo(kind).min)
    outside = ~((values >= lowest) & (values < -lowest))  # also true for NaN
    if outside.any():
        raise DataError(
            f"{name} of {float(values[outside][0])!r} counts does not fit {kind.__name__}"
        )
    return values


@dataclass(frozen=True, slots=True)
class AxisScaling:
    """``value = offset + sign · counts / counts_per_unit``.

    counts_per_unit: counts per metre or per radian;  sign: +1 or -1
    offset: position at count zero [m or rad]
    wrap: counts after which the encoder starts again at zero; 0 = it never does
    """

    counts_per_unit: float
    sign: int = 1
    offset: float = 0.0
    wrap: int = 0

    def values(self, counts: IntArray) -> FloatArray:
        """Return the positions [m or rad] of unwrapped ``counts`` (n,)."""
        return self.offset + counts / (self.sign * self.counts_per_unit)

    def counts(self, values: FloatArray) -> IntArray:
        """Return what the encoder reports at ``values`` [m or rad] (n,), in whole counts."""
        scaled = np.rint((values - self.offset) * (self.sign * self.counts_per_unit))
        whole = whole_counts("axis position", scaled, np.int64).astype(np.int64)
        return whole % self.wrap if self.wrap else whole


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

    def distance(self, raw: FloatArray) -> FloatArray:
        """Return the distance [m] of a reading [m]."""
        return self.polarity * (raw - self.zero)

    def raw(self, distance: FloatArray) -> FloatArray:
        """Return the reading [m] at a distance [m]."""
        return self.zero + self.polarity * distance


def encoder_places(text: str, letters: str, least: int = 0) -> tuple[int, ...]:
    """Return the places in ``letters`` of ``least`` or more in ``text``; ConfigurationError."""
    given = text.upper()
    if len(set(given)) < max(len(given), least) or set(given) - set(letters):
        expected = f"expected {least} or more of the letters {letters}, each once"
        raise ConfigurationError(f"encoders {text!r}, {expected}")
    return tuple(map(letters.index, given))


# No axis changes its step by more than this from one sample to the next [turn].
_LITTLE = 1 / 64
# After this many nearly equal steps the position is accepted; counts spoilt by noise give such a
# row by chance once in 10⁹.
_ALIKE = 6

_Steps = TypeVar("_Steps", IntArray, int)


class Turns:
    """Adds the whole turns to counts that start again at zero after ``wrap``; 0 = never.

    The axis moves less than half a turn between two samples, so a step is the shorter way round.
    Two steps to a count spoilt by noise and back may add up to a whole turn. So the count before a
    jump is kept, and later counts get the turns that bring them next to it.
    """

    def __init__(self, wrap: int) -> None:
        self._wrap = wrap
        self._last = self._step = 0
        self._seen = 0  # samples since the first one that was accepted
        self._kept: int | None = None  # the count before a jump
        self._since = self._alike = 0

    def continued(self, counts: IntArray) -> IntArray:
        """Return the counts (n,) with their whole turns, from the first count on."""
        if not self._wrap:
            return counts
        if self._seen > _ALIKE and self._kept is None:
            steps = self._shorter(np.diff(counts, prepend=self._last))
            before = np.concatenate([[self._step], steps[:-1]])
            if np.all(np.abs(steps - before) <= _LITTLE * self._wrap):
                turned: IntArray = self._last + np.cumsum(steps)
                if len(turned):
                    self._last, self._step = int(turned[-1]), int(steps[-1])
                return turned
        return np.array([self._next(int(count)) for count in counts], dtype=np.int64)

    def _next(self, count: int) -> int:
        step = self._shorter(count - self._last)
        value = self._last + step
        differs = abs(step - self._step) > _LITTLE * self._wrap
        if self._kept is not None:
            value, step = self._follow_jump(value, step, differs)
        elif self._seen <= _ALIKE:
            if self._seen == 0 or (self._seen > 1 and differs):  # the one before was spoilt
                value, step, self._seen = count, 0, 0
            self._seen += 1
        elif differs:
            self._kept, self._since, self._alike = self._last, 0, 0
        self._last, self._step = value, step
        return value

    def _follow_jump(self, value: int, step: int, differs: bool) -> tuple[int, int]:
        assert self._kept is not None
        self._since += 1
        self._alike = 0 if differs else self._alike + 1
        off = self._shorter(value - self._kept)
        if abs(off) <= _LITTLE * self._wrap:
            value, step, self._kept = self._kept + off, 0, None
        elif self._alike >= _ALIKE:
            if self._alike < self._since - 1:  # else it moved there in a gap
                value = self._kept + off
            self._kept = None
        return value, step

    def _shorter(self, steps: _Steps) -> _Steps:
        half = self._wrap // 2
        return (steps + half) % self._wrap - half
