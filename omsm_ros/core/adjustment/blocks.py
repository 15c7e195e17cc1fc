"""Means over sectors of each turn: the readings of the adjustment, linear in points.

All columns of the model are smooth over a few degrees of a turn, so that heights and columns may
be averaged over a sector before they are adjusted: heights over all points, columns over a few
that are evenly spread. Errors faster than a sector count as noise of the readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.adjustment.scan_data import ScanView
from omsm_ros.core.adjustment.sources import Family
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.streams.statistics import white_noise

# 0.8 mm of the rim of a part of 25 mm; the 12th harmonic of a turn loses 2.6 %.
SECTORS = 96
# Points of a block at which columns are computed, in pairs about its middle: half a sample off
# it turns a column by 2 mrad.
_NODES = 6
# Blocks whose columns are held at a time: 170 columns of their points are 14 MB.
_CHUNK = 2048


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means over blocks of points, of all scans one after the other, each (b,).

    scan: number of the scan;  turn: number of the turn within it;  since: time in the scan [s]
    x, y: in the part frame [m];  span: angle of the block about the axis [rad]
    count: points;  variance: of the mean by white noise [m²];  deviation: from nominal [m]
    turning: change of the height per angle by which C is off [m/rad]
    columns: of all families, (b, p);  noise: of a reading, each scan [m], (scans,)
    """

    scan: IntArray
    turn: IntArray
    since: FloatArray
    x: FloatArray
    y: FloatArray
    span: FloatArray
    count: FloatArray
    variance: FloatArray
    deviation: FloatArray
    turning: FloatArray
    columns: FloatArray
    noise: FloatArray

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def scans(self) -> int:
        """Number of scans."""
        return len(self.noise)

    def only(self, mine: BoolArray) -> Blocks:
        """Return the blocks ``mine`` without columns, their scans numbered from 0."""
        scans, number = np.unique(self.scan[mine], return_inverse=True)
        values = {
            name: value[mine] for name, value in vars(self).items() if name not in ("scan", "noise")
        }
        values["columns"] = np.zeros((int(np.sum(mine)), 0))
        return Blocks(**values, scan=number.astype(np.int64), noise=self.noise[scans])


def blocks_of(
    views: Sequence[ScanView],
    weights: Sequence[float],
    families: Sequence[Family],
    noise: float | None = None,
) -> Blocks:
    """Return the means of ``views`` over sectors of their turns.

    weights: readings that one point of each scan stands for
    noise: of a reading [m]; None: from second differences of the deviation
    """
    parts = [_of_scan(v, w, families, noise) for v, w in zip(views, weights, strict=True)]
    joined = {
        name: np.concatenate([p[name] for p in parts]) for name in parts[0] if name != "noise"
    }
    return Blocks(**joined, noise=np.array([float(p["noise"][0]) for p in parts]))


def _of_scan(
    view: ScanView, weight: float, families: Sequence[Family], noise: float | None
) -> dict[str, FloatArray | IntArray]:
    begins = block_begins(view)
    count = np.diff(np.append(begins, len(view))).astype(np.float64)
    per_reading = white_noise(view.deviation) if noise is None else noise

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values, begins) / count)

    x, y = mean(view.x), mean(view.y)
    # The mean of an arc lies inside it; the radius is that of the points.
    longer = mean(np.hypot(view.x, view.y)) / np.maximum(np.hypot(x, y), 1e-12)
    period = float(np.median(np.diff(view.since)))
    turn = np.abs(view.c - view.c[0]) // (2 * np.pi)
    return {
        "scan": np.full(len(begins), view.index),
        "turn": turn[begins].astype(np.int64),
        "since": mean(view.since),
        "x": x * longer,
        "y": y * longer,
        "span": count * period * abs(view.speed),
        "count": count * weight,
        "variance": per_reading**2 / (count * weight),
        "deviation": mean(view.deviation),
        "turning": mean(view.lateral_error(-view.y, view.x)),
        "columns": node_means(view, families),
        "noise": np.array([per_reading]),
    }


def block_columns(views: Sequence[ScanView], families: Sequence[Family]) -> FloatArray:
    """Return the means of ``families`` over all points of the blocks of all views, (b, k).

    For columns that are not smooth within a block, as lines in time.
    """
    made = []
    for view in views:
        begins = block_begins(view)
        values = np.concatenate([np.atleast_2d(f.columns(view)) for f in families])
        count = np.diff(np.append(begins, len(view)))
        made.append((np.add.reduceat(values, begins, axis=1) / count).T)
    return np.concatenate(made)


def block_begins(view: ScanView) -> IntArray:
    """Return where each block begins: a new sector of the turn, (b,)."""
    sector = np.floor(view.c * (SECTORS / (2 * np.pi)))
    return np.flatnonzero(np.diff(sector, prepend=sector[0] - 1))


def node_means(view: ScanView, families: Sequence[Family]) -> FloatArray:
    """Return the means of all columns over a few points of each block, (b, p).

    They are made a chunk of blocks at a time.
    """
    begins = block_begins(view)
    count = np.diff(begins, append=len(view))
    share = (np.arange(_NODES // 2) + 0.5) / _NODES
    before = (count[:, np.newaxis] * share).astype(np.int64)
    after = count[:, np.newaxis] - 1 - before
    nodes = begins[:, np.newaxis] + np.concatenate([before, after], axis=1)
    if np.all(count == 1):  # of a plan
        nodes = nodes[:, :1]
    made = np.empty((len(begins), sum(f.size for f in families)))
    for first in range(0, len(begins), _CHUNK):
        here = nodes[first : first + _CHUNK]
        part, place = view.part(here.ravel()), 0
        for family in families:
            values = np.atleast_2d(family.columns(part)).reshape(family.size, *here.shape)
            made[first : first + len(here), place : place + family.size] = values.mean(axis=2).T
            place += family.size
    return made
