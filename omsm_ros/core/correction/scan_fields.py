"""What do the systematic errors of a scan do to each of its points, however many there are?

Sensitivity fields are had at some points, evenly chosen; between them they are interpolated in the
order of the scan. Components that hardly count are left out, so that a figure of the heights is
propagated through a few fields, not through hundreds.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.correction.systematic import ScanPoints
from omsm_ros.core.samples.blocks import BoolArray, FloatArray

# Of the variance of one source: half a hundredth of its standard uncertainty. Of that of all: a
# figure may look where the largest ones do nothing, so a five-hundredth of a standard uncertainty.
_LEFT_OUT_OF_ONE, _LEFT_OUT_OF_ALL = 1e-2, 4e-6
# Sources of the calibration: in every scan that it corrects, each of their directions has one size.
_OF_THE_CALIBRATION = ("dynamics", "could_hide", "lateral_lag", "static_gain")
# With fewer points a turn what repeats twice in it would be cut off between them.
_LEAST_POINTS_PER_TURN = 12


@dataclass(frozen=True, eq=False)
class ScanFields:
    """Independent systematic errors of a scan.

    names: of the source of each, (s,);  every: of how many points of the scan one is here
    fields: change of the heights [m] per standard uncertainty, (s, m)
    bounds: names of the sources of which only an upper bound is known
    aligned: names of the sources whose fields are, in this order, those of the same errors in
        every scan with the same calibration
    """

    names: tuple[str, ...]
    fields: FloatArray
    every: int
    bounds: tuple[str, ...] = ()
    aligned: tuple[str, ...] = ()

    def at(self, first: int, count: int) -> FloatArray:
        """Return the fields (s, count) [m] at the scan's points from ``first`` on."""
        if not self.fields.size:
            return np.zeros((len(self.names), count))
        last = self.fields.shape[1] - 1
        place = np.minimum((first + np.arange(count)) / self.every, last)
        below = np.minimum(place.astype(np.int64), max(last - 1, 0))
        share = place - below
        above = np.minimum(below + 1, last)
        return np.asarray(
            self.fields[:, below] * (1 - share) + self.fields[:, above] * share, np.float64
        )


def scan_fields(
    fields: Mapping[str, FloatArray], every: int, bounds: Collection[str] = ()
) -> ScanFields:
    """Return the components that count of ``fields``, by source (k, m) [m].

    bounds: names of the sources of which only an upper bound is known
    """
    names: list[str] = []
    rows: list[FloatArray] = []
    aligned = tuple(name for name in _OF_THE_CALIBRATION if name in fields)
    for name, found in fields.items():
        own = found if name in aligned else _principal(found)
        names += [name] * len(own)
        rows += list(own)
    if not rows:
        return ScanFields((), np.empty((0, 0)), every)
    counts = _count(np.array(rows), _LEFT_OUT_OF_ALL)
    # To be found again in another scan, they stay together.
    together = {name for name, own in zip(names, counts, strict=True) if own and name in aligned}
    kept = np.flatnonzero(counts | np.isin(names, list(together)))
    left = tuple(names[k] for k in kept)
    known = tuple(name for name in bounds if name in left)
    same = tuple(name for name in aligned if name in together)
    return ScanFields(left, np.array([rows[k] for k in kept]), every, known, same)


def resolves_turns(points: ScanPoints) -> bool:
    """Return whether ``points`` are close enough for what repeats with the spindle's turns."""
    # An angle that is wrapped jumps by a turn once a turn.
    steps = np.abs(np.diff(np.unwrap(points.c)))
    return not len(steps) or float(np.median(steps)) <= 2 * np.pi / _LEAST_POINTS_PER_TURN


def _principal(fields: FloatArray) -> FloatArray:
    """Return uncorrelated rows whose squares add up as those of ``fields``, but for small ones."""
    moved = fields - np.mean(fields, axis=1, keepdims=True)
    rows = np.linalg.eigh(moved @ moved.T)[1].T @ fields
    return np.asarray(rows[_count(rows, _LEFT_OUT_OF_ONE)], np.float64)


def _count(rows: FloatArray, left_out: float) -> BoolArray:
    """Return which ``rows`` (k, n) make up all but the share ``left_out`` of their variance."""
    own = np.var(rows, axis=1)
    order = np.argsort(own)
    small = order[np.cumsum(own[order]) <= left_out * own.sum()]
    counts = np.ones(len(rows), bool)
    counts[small] = False
    return counts
