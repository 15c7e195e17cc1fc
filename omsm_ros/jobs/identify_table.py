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
from omsm_ros.storage.table_file import load_columns


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
    """Read two columns of a CSV file, one line a ``period`` [s]; ``duration`` [s], 0 = all."""
    columns = load_columns(path, (input, output))
    lines = round(duration / period) or len(columns[0])
    u, y = (column[:lines] for column in columns)
    return SampledRecord(u, y, np.ones(len(y), np.bool_), period)


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
