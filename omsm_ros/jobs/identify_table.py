"""A model between two columns of a table, or two channels of a bag; and its run over another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omsm_ros.core.sampled.free_run import FreeRun, free_run
from omsm_ros.core.sampled.identify_samples import identify_samples
from omsm_ros.core.sampled.model import SampledModel
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.errors import DataError, FileError
from omsm_ros.foreign_units import seconds_of
from omsm_ros.readable import quantity
from omsm_ros.storage.table_file import first_line, load_columns

# Clocks of two computers differ by a tenth of this.
_SAME_PERIOD = 5e-3
# Periods; a time that is written with few digits scatters by one.
_GAP = 2.5


@dataclass(frozen=True, eq=False)
class SampledRecord:
    """Samples (n,) of two quantities, ``period`` [s] apart; ``used`` where the output counts."""

    input: FloatArray
    output: FloatArray
    used: BoolArray
    period: float


def record_of_table(
    path: Path, input: str, output: str, period: float, duration: float = 0.0
) -> SampledRecord:
    """Read two columns of a CSV file, one line a ``period`` [s]; ``duration`` [s], 0 = all.

    Raises DataError where a column of time says otherwise.
    """
    _check_time(path, period)
    columns = load_columns(path, (input, output))
    lines = round(duration / period) or len(columns[0])
    u, y = (column[:lines] for column in columns)
    return SampledRecord(u, y, np.ones(len(y), np.bool_), period)


def _check_time(path: Path, period: float) -> None:
    """Raise DataError where a column of time, which says its unit, contradicts the ``period`` [s].

    Frequencies would all be wrong by the same factor, and no residual would show it; where lines
    are missing, what comes after them is of another instant.
    """
    named = {name: one for name in first_line(path) if (one := seconds_of(name)) is not None}
    for name, second in named.items():
        try:
            (time,) = load_columns(path, (name,))
        except FileError:  # dates, or the like
            continue
        steps = np.diff(time) * second
        mean, most = float(np.mean(steps)), float(np.max(steps))
        even = abs(float(np.median(steps)) / period - 1) < _SAME_PERIOD
        if even and most > _GAP * period:
            raise DataError(
                f"table {str(path)!r}: {name!r} goes on by {quantity(most, 's')} after row "
                f"{int(np.argmax(steps)) + 1}, where rows are {quantity(period, 's')} apart: cut "
                "the record there"
            )
        if abs(mean / period - 1) > _SAME_PERIOD:
            raise DataError(
                f"table {str(path)!r}: by {name!r} a row takes {mean:.6g} s, not {period:.6g} s; "
                "give the period of the record, or correct the name of that column"
            )


def record_of_motion(motion: MotionRecord) -> SampledRecord:
    """Return the axis's position [m] and the probe's distance [m]."""
    return SampledRecord(motion.z, motion.distance, motion.ok, motion.sample_period)


def model_of(
    record: SampledRecord, *, hold: str, order: int = 0, max_delay: int = 3
) -> SampledModel:
    """Identify the output from the input; options as of ``identify_samples``."""
    return identify_samples(
        record.input,
        record.output,
        record.period,
        hold=hold,
        order=order,
        max_delay=max_delay,
        used=record.used,
    )


def run_of(model: SampledModel, record: SampledRecord) -> FreeRun:
    """Run ``model`` over the input of ``record``, beside its output."""
    return free_run(model, record.input, record.output, record.used)


def text_of_run(record: SampledRecord, run: FreeRun) -> str:
    """Return time, input, output and the model's output as CSV."""
    time = record.period * np.arange(len(record.input))
    rows = np.column_stack([time, record.input, record.output, run.output])
    lines = [",".join(f"{value:.12g}" for value in row) for row in rows.tolist()]
    return "\n".join(["time_s,input,output,model", *lines]) + "\n"
