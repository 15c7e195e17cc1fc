"""Does the sample period that a device writes agree with the time that its samples took?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omsm_ros.core.samples.blocks import Block, FloatArray
from omsm_ros.errors import DataError
from omsm_ros.readable import quantity
from omsm_ros.units import NANOSECONDS_PER_S

# Clocks of two computers differ by a tenth of this; a motion's lag by less than 1 %.
_GREATEST_DIFFERENCE = 5e-3
# Standard uncertainties of the stamped period that must lie between it and the written one.
_CLEARLY = 5.0
# A line through fewer does not know how uncertain it is.
_LEAST_BLOCKS = 5


def stamped_period(blocks: Sequence[Block]) -> tuple[float, float] | None:
    """Return the sample period by the stamps and its standard uncertainty [s], relative to none.

    A line through the stamps over the trigger count; None with too few blocks for one.
    """
    return _line(*_marks(blocks))


def _marks(blocks: Sequence[Block]) -> tuple[FloatArray, FloatArray]:
    """Return the counts and stamps [s] of first samples, each (n,), from those of the first."""
    count = np.array([block.first_sample - blocks[0].first_sample for block in blocks], np.float64)
    stamp = np.array([block.stamp_ns - blocks[0].stamp_ns for block in blocks]) / NANOSECONDS_PER_S
    return count, stamp


def _line(count: FloatArray, stamp: FloatArray) -> tuple[float, float] | None:
    if len(count) < _LEAST_BLOCKS:
        return None
    spread = float(np.sum((count - count.mean()) ** 2))
    if spread == 0:
        return None
    slope = float((count - count.mean()) @ stamp) / spread
    residual = stamp - stamp.mean() - slope * (count - count.mean())
    return slope, float(np.sqrt(residual @ residual / (len(count) - 2) / spread))


def check_period(name: str, blocks: Sequence[Block], time_lapse: float = 1.0) -> None:
    """Raise DataError where the stamps of ``blocks`` clearly contradict their sample period.

    time_lapse: how much faster than real time the recording was played [1]
    Frequencies and lags would all be wrong by the same factor, and no residual would show it.
    """
    if not blocks:
        return
    said = contradiction(name, *_marks(blocks), blocks[0].sample_period, time_lapse)
    if said is not None:
        raise DataError(said)


def contradiction(
    name: str, count: FloatArray, stamp: FloatArray, written: float, time_lapse: float = 1.0
) -> str | None:
    """Return what the stamps say against the ``written`` sample period [s], None if nothing.

    count, stamp: of first samples of blocks, (n,) and (n,) [s];  time_lapse: see `check_period`
    """
    stamped = _line(count, stamp)
    if stamped is None:
        return None
    period, uncertainty = stamped[0] * time_lapse, stamped[1] * time_lapse
    off = abs(period - written)
    if period <= 0 or off <= max(_GREATEST_DIFFERENCE * written, _CLEARLY * uncertainty):
        return None
    if (jumped := _jump(count, stamp, written / time_lapse)) is not None:
        place, size = jumped
        return (
            f"{name} blocks: the stamps jump by {quantity(size, 's')} at sample {place:.0f} of the "
            f"recording, and agree with a sample period of {written:.6g} s elsewhere: the clock "
            "was set meanwhile; record again, once it is set"
        )
    return (
        f"{name} blocks state a sample period of {written:.6g} s, but by their stamps it is "
        f"{period:.6g} s: correct sample_period of the driver and record again (or declare "
        'settings {"time_lapse": …} for a recording that was not made in real time)'
    )


def _jump(count: FloatArray, stamp: FloatArray, period: float) -> tuple[float, float] | None:
    """Return where and by how much [s] the stamps jump, None unless one jump explains them."""
    samples, passed = np.diff(count), np.diff(stamp)
    ahead = passed - samples * period
    place = int(np.argmax(np.abs(ahead)))
    others = np.delete(np.arange(len(ahead)), place)
    rest = float(np.sum(ahead[others])), float(np.sum(samples[others])) * period
    if abs(rest[0]) > _GREATEST_DIFFERENCE * abs(rest[1]):
        return None
    return float(count[place + 1]), float(ahead[place])
