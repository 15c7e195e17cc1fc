"""Does the sample period that a device writes agree with the time that its samples took?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omsm_ros.core.samples.blocks import Block
from omsm_ros.errors import DataError
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
    if len(blocks) < _LEAST_BLOCKS:
        return None
    count = np.array([block.first_sample - blocks[0].first_sample for block in blocks], np.float64)
    stamp = np.array([block.stamp_ns - blocks[0].stamp_ns for block in blocks]) / NANOSECONDS_PER_S
    spread = float(np.sum((count - count.mean()) ** 2))
    if spread == 0:
        return None
    slope = float((count - count.mean()) @ stamp) / spread
    residual = stamp - stamp.mean() - slope * (count - count.mean())
    return slope, float(np.sqrt(residual @ residual / (len(blocks) - 2) / spread))


def check_period(name: str, blocks: Sequence[Block], time_lapse: float = 1.0) -> None:
    """Raise DataError where the stamps of ``blocks`` clearly contradict their sample period.

    time_lapse: how much faster than real time the recording was played [1]
    Frequencies and lags would all be wrong by the same factor, and no residual would show it.
    """
    stamped = stamped_period(blocks)
    if stamped is None:
        return
    period, uncertainty = stamped[0] * time_lapse, stamped[1] * time_lapse
    written = blocks[0].sample_period
    off = abs(period - written)
    if period > 0 and off > max(_GREATEST_DIFFERENCE * written, _CLEARLY * uncertainty):
        raise DataError(
            f"{name} blocks state a sample period of {written:.6g} s, but by their stamps it is "
            f"{period:.6g} s: correct sample_period of the driver and record again (or declare "
            'settings {"time_lapse": …} for a recording that was not made in real time)'
        )
