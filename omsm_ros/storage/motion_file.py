"""A planned motion as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.quantities import POSITION, SAMPLE_PERIOD, TIME
from omsm_ros.storage.files import read_text
from omsm_ros.storage.table_file import numbers_in

# Two hours at 1 kHz, in three hundred megabytes of memory.
MAX_MOTION_BYTES = 200_000_000


def load_motion(path: Path | str) -> tuple[FloatArray, float]:
    """Read a planned motion, CSV ``time_s,z_m`` as 'omsm plan' writes it: z [m] and its period [s].

    Raises FileError for anything but two columns of numbers at even times.
    """
    text = read_text(path, MAX_MOTION_BYTES, FileError, "motion")
    what = f"motion {str(path)!r}"
    table = numbers_in(text.partition("\n")[2], what)
    if table.shape[0] < 2 or table.shape[1] != 2:
        raise FileError(f"{what} holds {table.shape!r} values, expected two columns time_s,z_m")
    time = TIME.checked_all(table[:, 0], FileError, f"{what}: time_s")
    z = POSITION.checked_all(table[:, 1], FileError, f"{what}: z_m")
    steps = np.diff(time)
    period = SAMPLE_PERIOD.checked(float(np.mean(steps)), FileError, f"{what}: step of time_s")
    if np.ptp(steps) > 0.01 * period:
        raise FileError(
            f"{what}: time_s runs in steps of {steps.min():g} to {steps.max():g} s, "
            "expected even steps; sample the motion evenly"
        )
    return np.ascontiguousarray(z, np.float64), period
