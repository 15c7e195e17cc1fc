"""For how much of the surface does each point of a scan stand?

Read off the scan as it ran. Where the path turns about the spindle, a point stands for the arc that
it covers, ``r |Δθ|``, whatever the speed was and however many points beside it were lost; each ring
of equal area and a few turns counts alike, whatever the feed was while it was crossed, and one that
was seen in part, as at the rim of a part beside the spindle's axis, by that part. On a single line
a point stands for the way from half-way to the one before to half-way to the one after. Elsewhere,
as on a raster or where points come in no order, a point stands for what lies nearer to it than to
any other.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.quantities import MAP_SPACING

# A raster passes the axis now on this side, now on that, and never gets around it twice.
_LEAST_TURNS = 2.0
# Points in no order may, by chance: as many of their steps go back as go on. Of a path whose steps
# are as wide as gaps, so many go on.
_LEAST_ONWARD = 2 / 3
# Rings so fine that the rim is a thousandth of the area, of whole turns and points enough for a
# mean.
_MOST_RINGS, _TURNS_PER_RING, _POINTS_PER_RING = 2048, 2.0, 20
# Across a gap larger than this nobody has looked, and no point stands for it: as an angle [rad],
# and in steps of the path. A single point that stood for 30° of a turn of 2000 points would bring
# its noise into every figure.
_LARGEST_ARC, _MOST_STEPS = np.pi / 6, 10.0
# Of a turn: as wide as the widest arc that may be missing.
_SECTORS = round(2 * np.pi / _LARGEST_ARC)
# The side of a grid; the number of its cells falls to a quarter as their size doubles where they
# fill the surface, and to a half where they lie along single tracks.
_MOST_CELLS, _FILLED = 512, 3.5
# Half a cell is what a point is displaced by at most: an eighth of the way between even points.
_FINER = 4
# Of its length: as wide as a single line may be.
_LINE_WIDTH = 1e-6


def area_weights(x: FloatArray, y: FloatArray, *, even: bool = False) -> FloatArray:
    """Return the area that each point of a scan, in its order, stands for (n,), of mean 1.

    even: the points are of an evenly spaced grid, whole or every k-th; then all stand for one area
    """
    if even:
        return np.ones(len(x))
    along = _along_line(x, y)
    if along is not None:
        weights = _ways(along)
        return np.asarray(weights / np.mean(weights), np.float64)
    angle = np.unwrap(np.arctan2(y, x))
    turned = _turns(angle) if _is_path(angle) else 0.0
    share = np.ones(len(x))
    if turned >= _LEAST_TURNS:
        group, area = _rings(x, y, turned)
        share = _arcs(np.hypot(x, y), angle)
        area = area * _covered(group, angle, len(area))
    else:
        group, area = _nearest(x, y)
    whole = np.bincount(group, share, minlength=len(area))
    weights = share * (area / np.where(whole > 0, whole, 1.0))[group]
    return np.asarray(weights / np.mean(weights), np.float64)


def turns(x: FloatArray, y: FloatArray) -> float:
    """Return how many times the path gets around the origin."""
    return _turns(np.unwrap(np.arctan2(y, x)))


def _along_line(x: FloatArray, y: FloatArray) -> FloatArray | None:
    """Return the place of each point (n,) along the line that all lie on [m]; None if on none."""
    across = np.stack([x - np.mean(x), y - np.mean(y)])
    direction = np.linalg.eigh(across @ across.T)[1]
    width, length = (float(np.ptp(way @ across)) for way in direction.T)
    if length == 0 or width > _LINE_WIDTH * length:
        return None
    return np.asarray(direction[:, 1] @ across, np.float64)


def _ways(along: FloatArray) -> FloatArray:
    """Return the way (n,) that each point stands for [m]; across a gap nobody has looked."""
    order = np.argsort(along, kind="stable")
    steps = np.diff(along[order])
    steps = np.minimum(steps, _MOST_STEPS * _usual(steps))
    ways = np.empty(len(along))
    ways[order] = (np.r_[0.0, steps] + np.r_[steps, 0.0]) / 2
    return ways


def _turns(angle: FloatArray) -> float:
    return float(abs(angle[-1] - angle[0]) / (2 * np.pi)) if len(angle) else 0.0


def _is_path(angle: FloatArray) -> bool:
    """Return whether the points follow each other about the origin, or come in no order."""
    steps = np.diff(angle)
    moved = steps[steps != 0]
    if not len(moved) or _usual(np.abs(moved)) <= _LARGEST_ARC:
        return True
    onward = float(np.mean(moved > 0))
    return max(onward, 1 - onward) >= _LEAST_ONWARD


def _usual(steps: FloatArray) -> float:
    """Return the median of the steps; where the path rests, or a point is told again, is none."""
    return float(np.median(steps[steps > 0]))


def _rings(x: FloatArray, y: FloatArray, turned: float) -> tuple[IntArray, FloatArray]:
    """Return the ring of each point (n,), and the areas of the rings (k,)."""
    square = x**2 + y**2
    inner, span = float(square.min()), float(np.ptp(square))
    most = min(len(x) / _POINTS_PER_RING, turned / _TURNS_PER_RING)
    count = int(np.clip(most, 1, _MOST_RINGS)) if span > 0 else 1
    ring = ((square - inner) * (count / (span or 1.0))).astype(np.int64)
    return np.minimum(ring, count - 1), np.ones(count)


def _arcs(radius: FloatArray, angle: FloatArray) -> FloatArray:
    """Return the arc from half-way to the point before to half-way to the one after (n,) [m]."""
    steps = np.abs(np.diff(angle))
    steps = np.minimum(steps, min(_MOST_STEPS * _usual(steps), _LARGEST_ARC))
    covered = np.empty(len(angle))
    covered[0], covered[-1] = steps[0], steps[-1]
    covered[1:-1] = (steps[1:] + steps[:-1]) / 2
    return np.asarray(radius * covered, np.float64)


def _covered(group: IntArray, angle: FloatArray, count: int) -> FloatArray:
    """Return the share of each of ``count`` rings that the path has seen (count,), by sectors.

    Where the feed is fast a ring is crossed within half a turn; then those beside it see the rest.
    """
    sector = np.floor(angle * (_SECTORS / (2 * np.pi))).astype(np.int64) % _SECTORS
    points = np.bincount(group * _SECTORS + sector, minlength=count * _SECTORS)
    seen = points.reshape(count, _SECTORS) > 0
    around = seen.copy()
    around[1:] |= seen[:-1]
    around[:-1] |= seen[1:]
    return np.asarray(np.mean(around, axis=1), np.float64)


def _nearest(x: FloatArray, y: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the cell of each point (n,), and of each cell the area that lies nearest to it (k,).

    Cells with points share the scanned area as Voronoi's polygons do. The scanned area is that of
    these cells, and of the gaps into which no disc fits whose radius is the distance of tracks.
    """
    # Loading it takes as long as weighing; a scan that turns needs none of it.
    from scipy import ndimage

    even = int(np.clip(np.sqrt(len(x)), 1, _MOST_CELLS))
    side = min(_FINER * even, _MOST_CELLS)
    cell, shape = _tiles(x, y, side)
    filled = (np.bincount(cell, minlength=shape[0] * shape[1]) > 0).reshape(shape)
    reach = side / _filled_side(x, y, even)
    # Closing (Serra 1982): what a disc of that radius grows by, less what it would take back.
    margin = int(np.ceil(reach)) + 1
    own = np.s_[margin:-margin, margin:-margin]
    far, nearest = ndimage.distance_transform_edt(~np.pad(filled, margin), return_indices=True)
    scanned = ndimage.distance_transform_edt(far <= reach)[own] > reach
    row, column = (places[own] - margin for places in nearest)
    owner = (row * shape[1] + column)[scanned | filled]
    return cell, np.bincount(owner, minlength=filled.size).astype(np.float64)


def _filled_side(x: FloatArray, y: FloatArray, side: int) -> int:
    """Return how many cells, ``side`` at most, the longer side has where tracks fill them all."""
    while side > 2 and _occupied(x, y, side) < _FILLED * _occupied(x, y, side // 2):
        side //= 2
    return side


def _tiles(x: FloatArray, y: FloatArray, side: int) -> tuple[IntArray, tuple[int, int]]:
    """Return the cell of each point (n,), and how many there are in x and y; ``side`` at most."""
    spans = np.array([np.ptp(x), np.ptp(y)])
    spans[spans < MAP_SPACING.low] = 0.0  # one place, but for the last bits
    counts = np.maximum(np.round(side * spans / (spans.max() or 1.0)), 1.0).astype(np.int64)
    places = [
        # What lies on the far edge lies in the last cell.
        np.minimum(((values - values.min()) * (count / (span or 1.0))).astype(np.int64), count - 1)
        for values, span, count in zip((x, y), spans, counts, strict=True)
    ]
    return np.asarray(places[0] * counts[1] + places[1]), (int(counts[0]), int(counts[1]))


def _occupied(x: FloatArray, y: FloatArray, side: int) -> int:
    return int(np.count_nonzero(np.bincount(_tiles(x, y, side)[0])))
