"""A planned motion as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError


def read_text(path: Path, limit: int, error: type[FileError], what: str) -> str:
    try:
        size = path.stat().st_size
        if size > limit:
            raise error(f"{what} {str(path)!r} has {size} bytes, at most {limit} are accepted")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as err:
        raise error(f"no {what} at {str(path)!r}; check the path") from err
    except (OSError, UnicodeDecodeError) as err:
        raise error(f"{what} {str(path)!r} cannot be read as text: {err}") from err


MAX_MOTION_BYTES = 200_000_000


def load_motion(path: Path | str) -> tuple[FloatArray, float]:
    """Read a planned motion, CSV ``time_s,z_m`` as 'omsm plan' writes it: z [m] and its period [s].

    Raises FileError for anything but two columns of numbers at even times.
    """
    path = Path(path)
    text = read_text(path, MAX_MOTION_BYTES, FileError, "motion")
    try:
        table = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1, ndmin=2)
    except ValueError as err:
        raise FileError(f"{str(path)!r} is not a table of time_s,z_m: {err}") from err
    if table.shape[0] < 2 or table.shape[1] != 2 or not np.all(np.isfinite(table)):
        raise FileError(
            f"{str(path)!r} holds {table.shape!r} values, expected two columns time_s,z_m"
        )
    steps = np.diff(table[:, 0])
    period = float(np.mean(steps))
    if not period > 0 or np.ptp(steps) > 0.01 * period:
        raise FileError(
            f"{str(path)!r}: time runs in steps of {steps.min()!r} to {steps.max()!r} s, "
            "expected even steps"
        )
    return np.asarray(table[:, 1], np.float64), period
