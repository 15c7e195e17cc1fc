"""What errors that shift points laterally do to a cloud whose nominal surface nobody gave.

They cost height by the slope of the surface. While the points pass it is not known; once they have
passed, it is that of a polynomial through them, and the cloud is gone through once more.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.scan_fields import ScanFields, resolves_turns, scan_fields
from omsm_ros.core.correction.scan_trace import ScanTrace
from omsm_ros.core.correction.systematic import standard_fields
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.even_selection import EvenSelection
from omsm_ros.storage.cloud_file import widened

NOT_IN_POINTS = (
    "{names}: not in the uncertainty of the points, because the surface's slopes are not known; "
    "give --nominal SURFACE.yaml"
)


@dataclass(frozen=True, eq=False)
class LateralErrors:
    """heights: rms of what each such source does [m];  largest: uncertainty of a point now [m]

    points: evenly chosen, as they are in the cloud now;  warnings: what could not be had
    """

    heights: dict[str, float]
    largest: float
    points: NDArray[np.void]
    warnings: tuple[str, ...] = ()


def add_lateral_errors(
    cloud: Path, options: CorrectionOptions, trace: ScanTrace, most: int
) -> LateralErrors | None:
    """Add to the uncertainty of each point of ``cloud`` what shifts it laterally.

    most: points to return. Return None where there is no such source, or its slope was known while
    the points passed.
    """
    sources = [source for source in options.systematic if source.needs_slope]
    if not sources or options.surface is not None or not trace.seen:
        return None
    points = trace.points()
    if not resolves_turns(points):
        names = ", ".join(dict.fromkeys(source.name for source in sources))
        return LateralErrors({}, 0.0, np.empty(0), (NOT_IN_POINTS.format(names=names),))
    by_source = standard_fields(sources, points.with_slopes(None))
    fields = scan_fields(by_source, trace.every)
    kept, largest = EvenSelection(most), 0.0
    for rows in widened(cloud, lambda first, count: _variance(fields, first, count)):
        kept.add(rows)
        largest = max(largest, float(rows["uncertainty"].max()))
    heights = {name: float(np.sqrt(np.mean(np.sum(f**2, axis=0)))) for name, f in by_source.items()}
    return LateralErrors(heights, largest, kept.rows())


def _variance(fields: ScanFields, first: int, count: int) -> FloatArray:
    return np.asarray(np.sum(fields.at(first, count) ** 2, axis=0), np.float64)
