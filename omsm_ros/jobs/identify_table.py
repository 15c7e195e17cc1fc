"""A model between two columns of a table, or two channels of a bag."""

from __future__ import annotations

from pathlib import Path

from omsm_ros.core.sampled.identify_samples import identify_samples
from omsm_ros.core.sampled.model import SampledModel
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.storage.table_file import load_columns


def model_of_table(
    path: Path,
    input: str,
    output: str,
    period: float,
    *,
    hold: str,
    order: int = 0,
    max_delay: int = 3,
    duration: float = 0.0,
) -> SampledModel:
    """Identify column ``output`` from column ``input`` of a CSV file, one line a ``period`` [s].

    duration: [s] to use, 0 = all;  the others as of ``identify_samples``
    """
    columns = load_columns(path, (input, output))
    lines = round(duration / period) or len(columns[0])
    u, y = (column[:lines] for column in columns)
    return identify_samples(u, y, period, hold=hold, order=order, max_delay=max_delay)


def model_of_motion(
    motion: MotionRecord, *, hold: str, order: int = 0, max_delay: int = 3
) -> SampledModel:
    """Identify the probe's distance from the axis's position [m], held between samples."""
    return identify_samples(
        motion.z,
        motion.distance,
        motion.sample_period,
        hold=hold,
        order=order,
        max_delay=max_delay,
        used=motion.ok,
    )
