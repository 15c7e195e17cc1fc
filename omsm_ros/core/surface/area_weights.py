"""Area of the surface that each point of a scan represents.

It depends on the path of the scan.

- A path about the spindle: a point represents the arc that it covers, ``r |Δθ|``, independent of
  speed and lost points. Rings of equal area and a few turns each have equal weights, independent
  of the feed; a ring that was measured in part has the weight of that part.
- A single line: a point represents the way between the midpoints to both neighbours.
- A raster, or points in no order: a point represents the area that is nearer to it than to any
  other point.
"""

from collections.abc import Callable

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.quantities import MAP_SPACING

# Turns about the spindle from which a path is a spiral; a raster does not make two.
_LEAST_TURNS = 2.0
# Share of steps in one direction from which wide steps are a path; it is half for random points.
_LEAST_ONWARD = 2 / 3
# Rings: most of them, and turns and points that each has at least, for a mean.
_MOST_RINGS, _TURNS_PER_RING, _POINTS_PER_RING = 2048, 2.0, 20
# Largest gap that its neighbours represent, as an angle [rad] and in usual steps of the path. A
# larger weight would bring the noise of a single point into every figure.
_LARGEST_ARC, _MOST_STEPS = np.pi / 6, 10.0
# Sectors of a turn: at least as wide as the largest gap, at most as many as a ring has points for.
_LEAST_SECTORS, _MOST_SECTORS = round(2 * np.pi / _LARGEST_ARC), 360
# Most cells along the side of a grid. When their size doubles, the number of occupied cells falls
# to a quarter if they fill the surface, and to a half along single tracks: limits between both for
# coarse grids, of which the rim takes this number of cells, and for fine ones, where tracks may be
# farther apart on a tenth of the surface.
_MOST_CELLS, _FILLED, _OF_RIM, _FINELY_FILLED = 768, 3.5, 2.5, 3.8
# Cells along the distance of two evenly spaced points, so that points move by an eighth of it.
_FINER = 4
# Longest step along a track, in usual steps and distances of points; nearest points of a place.
_LONGEST, _AROUND = 4.0, 6
# Points next to which gaps are looked for; they have no point within this share of the next track.
_MOST_AT_GAPS, _MISSED = 20_000, 0.7
# Largest width of a single line relative to its length.
LINE_WIDTH = 1e-6


def area_weights(
    x: FloatArray, y: FloatArray, *, even: bool = False, outline: Aperture | None = None
) -> FloatArray:
    """Return the area that each point represents (n,), with a mean of 1; points in scan order.

    even: the points are an evenly spaced grid, or every k-th of one, and have equal weights
    outline: of the part; points at its rim stand for the way to it, on any path
    """
    if even:
        return np.ones(len(x))
    along = _along_line(x, y)
    if along is not None:
        weights = _ways(along)
        return np.asarray(weights / np.mean(weights), np.float64)
    angle = np.unwrap(np.arctan2(y, x))
    turned = 0.0
    if outline is None and len(angle) and _is_path(angle):
        turned = float(abs(angle[-1] - angle[0]) / (2 * np.pi))
    share = np.ones(len(x))
    if turned >= _LEAST_TURNS:
        group, area = _rings(x, y, turned)
        share = _arcs(np.hypot(x, y), angle)
        area = area * _covered(group, angle, len(area))
    else:
        group, area = _nearest(x, y, outline)
    whole = np.bincount(group, share, minlength=len(area))
    weights = share * (area / np.where(whole > 0, whole, 1.0))[group]
    return np.asarray(weights / np.mean(weights), np.float64)


def covered_places(x: FloatArray, y: FloatArray, outline: Aperture) -> FloatArray:
    """Return an even grid of places in an ``outline`` that a scan covers (2, k) [m].

    x, y: of the points in scan order (n,) [m]
    """
    _, _, middles, _, scanned = _scanned(x, y, outline)
    return middles[:, scanned]


def _along_line(x: FloatArray, y: FloatArray) -> FloatArray | None:
    """Return the position of each point (n,) along a common line [m]; None if there is none."""
    across = np.stack([x - np.mean(x), y - np.mean(y)])
    direction = np.linalg.eigh(across @ across.T)[1]
    width, length = (float(np.ptp(way @ across)) for way in direction.T)
    if length == 0 or width > LINE_WIDTH * length:
        return None
    return np.asarray(direction[:, 1] @ across, np.float64)


def _ways(along: FloatArray) -> FloatArray:
    """Return the way (n,) that each point represents [m], without gaps."""
    order = np.argsort(along, kind="stable")
    steps = np.diff(along[order])
    steps = np.minimum(steps, _MOST_STEPS * _usual(steps))
    ways = np.empty(len(along))
    ways[order] = (np.r_[0.0, steps] + np.r_[steps, 0.0]) / 2
    return ways


def _is_path(angle: FloatArray) -> bool:
    """Return True if the points follow a path about the origin, False if they are in no order."""
    steps = np.diff(angle)
    moved = steps[steps != 0]
    if not len(moved) or _usual(np.abs(moved)) <= _LARGEST_ARC:
        return True
    onward = float(np.mean(moved > 0))
    return max(onward, 1 - onward) >= _LEAST_ONWARD


def _usual(steps: FloatArray) -> float:
    """Return the median of the steps that are not zero."""
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
    """Return the arc between the midpoints to both neighbours (n,) [m]."""
    steps = np.abs(np.diff(angle))
    steps = np.minimum(steps, min(_MOST_STEPS * _usual(steps), _LARGEST_ARC))
    covered = np.empty(len(angle))
    covered[0], covered[-1] = steps[0], steps[-1]
    covered[1:-1] = (steps[1:] + steps[:-1]) / 2
    return np.asarray(radius * covered, np.float64)


def _covered(group: IntArray, angle: FloatArray, count: int) -> FloatArray:
    """Return the share of each of ``count`` rings that was measured (count,), by sectors.

    Points of the neighbouring rings count too, because a fast feed crosses a ring in half a turn.
    """
    enough = len(group) // (count * _POINTS_PER_RING)
    sectors = int(np.clip(enough, _LEAST_SECTORS, _MOST_SECTORS))
    sector = np.floor(angle * (sectors / (2 * np.pi))).astype(np.int64) % sectors
    points = np.bincount(group * sectors + sector, minlength=count * sectors)
    seen = points.reshape(count, sectors) > 0
    around = seen.copy()
    around[1:] |= seen[:-1]
    around[:-1] |= seen[1:]
    return np.asarray(np.mean(around, axis=1), np.float64)


def _nearest(x: FloatArray, y: FloatArray, outline: Aperture | None) -> tuple[IntArray, FloatArray]:
    """Return the cell of each point (n,), and the area that is nearest to each cell (k,).

    The areas are the Voronoi polygons of the occupied cells within the scanned area.
    """
    cell, shape, _, nearest, scanned = _scanned(x, y, outline)
    owner = nearest[0, scanned] * shape[1] + nearest[1, scanned]
    return cell, np.bincount(owner, minlength=shape[0] * shape[1]).astype(np.float64)


def _scanned(
    x: FloatArray, y: FloatArray, outline: Aperture | None
) -> tuple[IntArray, tuple[int, int], FloatArray, IntArray, BoolArray]:
    """Return the tile of each point (n,), the number of tiles in x and y, and with a margin around:

    Their middles [m] and the tiles with points nearest to them, both (2, r, c), and which of them
    the scanned area has (r, c). It includes gaps that are narrower than the distance of two tracks,
    also to the ``outline``. At wider ones, a point stands for half a step along its track, and half
    the distance of two tracks across.
    """
    even = int(np.clip(np.sqrt(len(x)), 1, _MOST_CELLS))
    side = min(_FINER * even, _MOST_CELLS)
    cell, shape = _tiles(x, y, side)
    filled = (np.bincount(cell, minlength=shape[0] * shape[1]) > 0).reshape(shape)
    while even > 2:
        least = max(_FILLED, _FINELY_FILLED * (1 - _OF_RIM / even))
        if _occupied(x, y, even) >= least * _occupied(x, y, even // 2):
            break
        even //= 2
    reach = side / even
    # Morphological closing (Serra 1982) with a disc: dilation followed by erosion.
    margin = int(np.ceil(reach)) + 1
    wide = np.pad(filled, margin)
    distances = scipy.ndimage.distance_transform_edt
    nearest = distances(~wide, return_distances=False, return_indices=True)
    sides = [(np.ptp(v) or 1.0) / n for v, n in zip((x, y), shape, strict=True)]
    at = [v.min() + (np.arange(-margin, n + margin) + 0.5) * size
          for v, n, size in zip((x, y), shape, sides, strict=True)]  # fmt: skip
    middles = np.stack(np.meshgrid(*at, indexing="ij"))
    inside = np.ones(wide.shape, bool) if outline is None else outline.holds(*middles)
    far = scipy.ndimage.distance_transform_edt(inside & ~wide)
    away = scipy.ndimage.distance_transform_edt(far <= reach)
    scanned = (away > reach) & inside | wide
    if outline is not None and np.any(far > reach):
        places, area = inside & ~scanned & (away > 0), np.sum(scanned) * float(np.prod(sides))
        scanned[places] = _stand_for(x + 1j * y, middles[0, places] + 1j * middles[1, places], area)
    return cell, shape, middles, nearest - margin, scanned


def _stand_for(
    points: NDArray[np.complex128], places: NDArray[np.complex128], area: float
) -> BoolArray:
    """Return for which ``places`` (k,) [m] the ``points`` (n,) of a path over an ``area`` stand."""
    step, jumps = _steps(points, float(np.sqrt(area / len(points))))
    sizes = np.abs(np.diff(points))
    track = area / (np.sum(sizes) - np.sum(sizes[jumps]))
    rows = (v.view(np.float64).reshape(-1, 2) for v in (points, places))
    _, near = scipy.spatial.cKDTree(next(rows)).query(next(rows), _AROUND)
    step = step[near]
    # Along the track and across it, times the step.
    apart, size = (places[:, np.newaxis] - points[near]) * step.conj(), np.abs(step)
    within = (np.abs(apart.real) <= size**2 / 2) & (np.abs(apart.imag) <= size * track / 2)
    return np.asarray(np.any(within, axis=1))


def errors_at_gaps(
    x: FloatArray, y: FloatArray, outline: Aperture, track: float
) -> Callable[[FloatArray], FloatArray]:
    """Return the standard uncertainties (g, …) of means over the area of a path's points (…, n).

    A gap may begin anywhere up to the next point that is missing. The ends of tracks are off alike,
    because samples may be in step with turns or lines, as are points in a row along a gap.

    track: distance of neighbouring tracks [m]
    """
    points, every = x + 1j * y, max(len(x) // _MOST_AT_GAPS, 1)
    track = max(track, float(np.sqrt(np.ptp(x) * np.ptp(y) / len(x))))  # of every k-th point
    (step, _), steps = _steps(points, track), np.diff(points)
    tree = scipy.spatial.cKDTree(np.column_stack([x, y]))
    few, size = np.arange(0, len(x), every), np.abs(step)
    # A path ends at a gap where it jumps over it, or turns.
    last, first = (1 + np.flatnonzero(np.abs(np.diff(steps)) > np.abs(s))
                   for s in (steps[:-1], steps[1:]))  # fmt: skip
    ends, across = (len(x), 1), (2 * every, every)
    ways = [(last, steps[last - 1], ends), (first, -steps[first], ends)]
    ways += [(few, side * step[few], across) for side in (1j, -1j)]
    found = []
    for own, way, (in_a_row, each) in ways:
        there = points[own] + track * way / np.maximum(np.abs(way), np.finfo(np.float64).tiny)
        away, _ = tree.query(np.column_stack([there.real, there.imag]))
        own = own[outline.holds(there.real, there.imag) & (away > _MISSED * track)]
        found.append((np.append(True, np.diff(own) > in_a_row)[: len(own)], own, each * size[own]))
    new, own, errors = (np.concatenate(v) for v in zip(*found, strict=True))
    begins = np.append(np.flatnonzero(new), len(own))
    rows = errors / np.sum(size) / np.sqrt(12), own, begins
    areas = scipy.sparse.csr_array(rows, (len(begins) - 1, len(x)))
    return lambda values: np.asarray(areas @ values.T)


def _steps(points: NDArray[np.complex128], apart: float) -> tuple[NDArray[np.complex128], IntArray]:
    """Return the step of a path at each of its ``points`` (n,) [m], and the last before each jump.

    apart: distance of the points [m]
    """
    steps = np.diff(points)
    before, after, sizes = np.append(steps[:1], steps), np.append(steps, steps[-1:]), np.abs(steps)
    # A jump to another track is no part of the path.
    jumps = np.flatnonzero(sizes >= _LONGEST * max(float(np.median(sizes)), apart))
    return np.where(np.abs(before) < np.abs(after), before, after), jumps


def _tiles(x: FloatArray, y: FloatArray, side: int) -> tuple[IntArray, tuple[int, int]]:
    """Return the cell of each point (n,), and the number of cells in x and y, at most ``side``."""
    spans = np.array([np.ptp(x), np.ptp(y)])
    spans[spans < MAP_SPACING.low] = 0.0  # one place, up to rounding
    counts = np.maximum(np.round(side * spans / (spans.max() or 1.0)), 1.0).astype(np.int64)
    places = [
        # Points on the far edge belong to the last cell.
        np.minimum(((values - values.min()) * (count / (span or 1.0))).astype(np.int64), count - 1)
        for values, span, count in zip((x, y), spans, counts, strict=True)
    ]
    return np.asarray(places[0] * counts[1] + places[1]), (int(counts[0]), int(counts[1]))


def _occupied(x: FloatArray, y: FloatArray, side: int) -> int:
    return int(np.count_nonzero(np.bincount(_tiles(x, y, side)[0])))
