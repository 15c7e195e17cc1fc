"""A planned motion as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.quantities import POSITION, SAMPLE_PERIOD, TIME
from omsm_ros.storage.table_file import load_columns


def load_motion(path: Path | str) -> tuple[FloatArray, float]:
    """Read a planned motion, columns ``time_s`` and ``z_m`` of a CSV: z [m] and its period [s].

    Raises FileError for a table without these columns, or times that are not even.
    """
    time, z = load_columns(path, ("time_s", "z_m"))
    what = f"motion {str(path)!r}"
    TIME.checked_all(time, FileError, f"{what}: time_s")
    POSITION.checked_all(z, FileError, f"{what}: z_m")
    steps = np.diff(time)
    period = SAMPLE_PERIOD.checked(float(np.mean(steps)), FileError, f"{what}: step of time_s")
    if np.ptp(steps) > 0.01 * period:
        raise FileError(
            f"{what}: time_s runs in steps of {steps.min():g} to {steps.max():g} s, "
            "expected even steps; sample the motion evenly"
        )
    return z, period
