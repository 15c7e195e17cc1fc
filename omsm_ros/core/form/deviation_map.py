"""Deviation map of a part, its means on cells with Gaussian filters, and conformity.

The mean of a cell is the deviation under a square window; cells without a point stay missing. The
filters of ISO 16610 divide by the weight of the cells present (ISO 16610-28, weighted regression
of order zero), so that edges are not drawn to zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.streams.statistics import noise_of, spread
from omsm_ros.errors import Notice


@dataclass(frozen=True, slots=True)
class UncertainValue:
    """A value and its standard uncertainty, in one unit; None: not evaluated."""

    value: float | None
    uncertainty: float | None

    def entry(self) -> dict[str, float | None]:
        """Return the JSON values for result files."""
        return {"value": self.value, "uncertainty": self.uncertainty}


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviationMap:
    """Deviations of a registered part, in the order of measurement.

    x, y: in the part's frame [m], (n,);  deviation: along the normal [m], (n,)
    area: that each point stands for, of mean one (n,)
    effects: of one standard uncertainty of each independent error source on the deviations
        (e, n) [m]
    bounds: indices of effects that are upper bounds of errors that may be absent
    moves: indices of effects that are moves of the part, to first order
    taken: the first t effects are form that the fit may have taken for a move, so that it is
        missing from the deviations; mean products of their probable shares (t, t), at most one
    noise: standard deviation of one point [m];  noise_error: standard uncertainty of it [m]
    noise_known: False for an upper bound, as of a profile that was measured once
    """

    x: FloatArray
    y: FloatArray
    deviation: FloatArray
    area: FloatArray
    effects: FloatArray
    noise: float
    bounds: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    moves: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    taken: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    noise_known: bool = True
    noise_error: float = 0.0

    def __len__(self) -> int:
        return len(self.x)

    def every(self, most: int) -> DeviationMap:
        """Return every k-th point, so that there are no more than ``most``."""
        return self.part(slice(None, None, -(-len(self) // most)))

    def equal_areas(self, most: int) -> IntArray:
        """Return the indices of ``most`` points, or all, that stand for equal areas."""
        ends, count = np.cumsum(self.area), min(most, len(self))
        begins = np.arange(count) / count * ends[-1] * (1 + 1e-12)  # rounding of the sums
        return np.asarray(np.searchsorted(ends, begins, "right"))

    def part(self, chosen: slice | IntArray) -> DeviationMap:
        """Return the ``chosen`` points."""
        names = ("x", "y", "deviation", "area", "effects")
        return replace(self, **{name: getattr(self, name)[..., chosen] for name in names})


# Neighbours whose plane predicts a point, and points that are predicted.
_NEIGHBOURS, _MOST_PREDICTED = 6, 6000
# Least singular value of a plane through neighbours; those of one track determine no slope across.
_LEAST_ACROSS = 1e-2
# Points of a stretch of the path whose spectrum is taken, and least number of stretches.
_STRETCH, _LEAST_STRETCHES = 64, 8


def neighbour_noise(x: FloatArray, y: FloatArray, deviation: FloatArray) -> float:
    """Return the noise of points (n,) in any order, from the plane through the nearest of each."""
    if len(x) <= _NEIGHBOURS:
        return noise_of(deviation)
    some = slice(None, None, -(-len(x) // _MOST_PREDICTED))
    places = np.column_stack([x, y])
    tree = scipy.spatial.cKDTree(places, balanced_tree=False, compact_nodes=False)  # for few places
    near = tree.query(places[some], _NEIGHBOURS + 1)[1][:, 1:]
    away = places[near] - places[some, np.newaxis]
    size = np.max(np.abs(away), axis=(1, 2), keepdims=True)
    away /= np.where(size > 0, size, 1.0)
    columns = np.concatenate([np.ones_like(away[..., :1]), away], axis=2)
    weights = np.linalg.pinv(columns, rcond=_LEAST_ACROSS)[:, 0]
    rest = deviation[some] - np.sum(weights * deviation[near], axis=1)
    gain = np.sqrt(1 + np.sum(weights**2, axis=1))
    # At the rim the plane is extrapolated.
    return spread((rest / gain)[gain <= np.sqrt(2)])


def path_noise(deviation: FloatArray) -> float:
    """Return the noise of points (n,) in the order of measurement, inf for few.

    It is the level of the upper half of the spectrum. Ripple and texture that differences would
    take for noise are lines in it, and local features are in some of the stretches.
    """
    count = len(deviation) // _STRETCH
    if count < _LEAST_STRETCHES:
        return np.inf
    values = deviation[: count * _STRETCH].reshape(count, _STRETCH)
    form = np.linalg.qr(np.vander(np.linspace(-1, 1, _STRETCH), 3))[0]
    window = np.hanning(_STRETCH)
    content = np.abs(np.fft.rfft((values - values @ form @ form.T) * window)) ** 2
    level = np.median(content, axis=0)[_STRETCH // 4 : -1]
    # The content of white noise has an exponential distribution.
    return float(np.sqrt(np.median(level) / np.log(2) / np.sum(window**2)))


# Share of repeated places that determines noise, and their size over the spacing of the points.
_LEAST_REPEATED, _SAME_PLACE = 0.1, 1 / 50
# Order of differences in which no smooth form is left. The scatter of white noise in them does not
# grow with the spacing of the points; texture whose density falls as 1/f² grows by √2 an octave.
_ORDER, _WHITE, _LEAST_WHITE = 6, 1.12, 100


def repeated_noise(x: FloatArray, y: FloatArray, deviation: FloatArray) -> float | None:
    """Return the noise of points (n,) from places measured several times; None without them."""
    spans = float(np.ptp(x)), float(np.ptp(y))
    side = max(np.sqrt(spans[0] * spans[1] / len(x)), max(spans) / len(x)) * _SAME_PLACE
    if side == 0:
        return None
    column, row = (np.round((v - v.min()) / side).astype(np.int64) for v in (x, y))
    _, place = np.unique(column * (int(row.max()) + 1) + row, return_inverse=True)
    counts = np.bincount(place)
    if len(x) - len(counts) < _LEAST_REPEATED * len(x):
        return None
    mean = np.bincount(place, deviation) / counts
    return float(np.sqrt(np.sum((deviation - mean[place]) ** 2) / (len(x) - len(counts))))


def profile_noise(along: FloatArray, deviation: FloatArray) -> tuple[float, bool]:
    """Return the noise of a profile measured once, and whether it is white, so no texture.

    along: positions on the line (n,), in any order
    """
    values = deviation[np.argsort(along, kind="stable")]
    root = math.sqrt(math.comb(2 * _ORDER, _ORDER))
    near, far = (spread(np.diff(v, _ORDER)) / root for v in (values, values[::2]))
    return near, len(along) >= _LEAST_WHITE and far <= _WHITE * near


# Four cells along, the shortest cutoff of a filter, hold 72 points.
_MOST_ACROSS, _POINTS_PER_CELL = 256, 4.5
# A profile has one row; its cells are as fine as its points. So are those of an even grid.
_MOST_ALONG, _MOST_OF_GRID = 1024, 512
# Constant of the weighting function exp(−π (x / α λ)²), which halves a sine of wavelength λ.
_ALPHA = float(np.sqrt(np.log(2) / np.pi))
# A mean over a width w passes sinc(f w), nearly a Gaussian of the cutoff w √(π² / 6 ln 2).
_CUTOFF_OF_MEAN = float(np.pi / np.sqrt(6 * np.log(2)))
# Steps between columns of a grid are a larger share of the widest, and its places that filled.
_LEAST_STEP, _LEAST_FILLED = 0.05, 0.2
# Points of a grid that determine its form of fourth order.
_MOST_FITTED = 20_000
# Reach of a Gaussian over its cutoff, where it is 1e-8.
_REACH = 1.15
# Share of the weight that keeps the slopes of a lone cell at zero.
_LEAST_SPREAD = 1e-7


@dataclass(frozen=True, eq=False)
class GridCells:
    """Means on cells, rows along y.

    x, y: middles of the columns (c,) and rows (r,) [m];  steps: of the cells along x and y [m]
    present: cells that have points (r, c)
    mean: of the deviations (r, c) [m], zero in empty cells;  noise: of each mean (r, c) [m]
    effects: means of the effects of each error source (e, r, c) [m]
    offset: of the mean position of the points from the middle, along y and x (2, r, c) [cells]
    width: over which the points of a cell are spread [cells]; 0: single points
    noise_known: that the noise is not texture that was measured once
    """

    x: FloatArray
    y: FloatArray
    steps: tuple[float, float]
    present: BoolArray
    mean: FloatArray
    noise: FloatArray
    effects: FloatArray
    offset: FloatArray = field(default_factory=lambda: np.zeros((2, 1, 1)))
    width: float = 0.0
    noise_known: bool = True

    @property
    def pitch(self) -> float:
        """Longer side of a cell [m]."""
        return max(self.steps)

    @classmethod
    def of(cls, map_: DeviationMap, *, even: bool = False) -> GridCells:
        """Return the means of a map on cells as fine as its points allow, at most 256 across.

        even: the points are an evenly spaced grid; each has its own cell, up to 512 across
        """
        of_grid = _of_grid(map_.x, map_.y) if even else None
        steps, before = of_grid or _of_scattered(map_.x, map_.y)
        at = [
            (values - values.min()) / step + before
            for values, step in zip((map_.x, map_.y), steps, strict=True)
        ]
        column, row = (values.astype(np.int64) for values in at)
        shape = int(row.max()) + 1, int(column.max()) + 1
        place = row * shape[1] + column
        size = shape[0] * shape[1]
        counts = np.bincount(place, minlength=size)
        divisor = np.maximum(counts, 1)

        def mean(values: FloatArray) -> FloatArray:
            return np.asarray(np.bincount(place, values, size) / divisor)

        inner = [at[1] - row - 0.5, at[0] - column - 0.5]
        offset = np.array([mean(away) for away in inner])
        across = [a - o[place] for a, o, n in zip(inner, offset, shape, strict=True) if n > 1]
        x, y = (
            np.asarray(values.min() + step * (np.arange(count) + 0.5 - before), np.float64)
            for values, step, count in zip((map_.x, map_.y), steps, reversed(shape), strict=True)
        )
        width = float(np.sqrt(12 * np.mean(np.square(across)))) if across else 0.0
        return cls(
            x=x, y=y, steps=steps, present=(counts > 0).reshape(shape),
            mean=mean(map_.deviation).reshape(shape), offset=offset.reshape(2, *shape),
            noise=(map_.noise / np.sqrt(divisor)).reshape(shape), width=width,
            effects=np.array([mean(e) for e in map_.effects]).reshape(-1, *shape),
            noise_known=map_.noise_known and not even,
        )  # fmt: skip

    def planes(self, cutoffs: tuple[float, float]) -> Callable[..., FloatArray]:
        """Return a low-pass: of images (k, r, c) level [m] and slopes [1] along x, y (3, k, r, c).

        Given numbers from 0 to 2, too, it returns only those of the three.

        Weighted linear regression with Gaussians of ``cutoffs`` along x and y [m] (ISO 16610-28).
        Inside the map it is the Gaussian filter of ISO 16610-61, its slopes are the derivatives.
        It takes the points of a cell where they are, and makes up for their mean.
        """
        shape, width = self.present.shape, _CUTOFF_OF_MEAN * self.width
        cells = np.array(cutoffs[::-1]) / self.steps[::-1]
        narrow = [float(value) for value in np.sqrt(cells**2 - width**2)]
        ways = [axis for axis, size in enumerate(shape) if size > 1]
        middle = np.indices(shape) - np.array(shape)[:, np.newaxis, np.newaxis] / 2.0
        at = (middle + self.offset)[ways]
        basis = np.concatenate([np.ones((1, *shape)), at]) * self.present
        products = _blurred(basis[:, np.newaxis] * basis, narrow)
        # From the middle of the map to that of each cell.
        for k, axis in enumerate(ways, 1):
            products[k] -= middle[axis] * products[0]
        for k, axis in enumerate(ways, 1):
            products[:, k] -= middle[axis] * products[:, 0]
        weight = np.where(self.present, products[0, 0], 1.0)
        products[range(len(basis)), range(len(basis))] += _LEAST_SPREAD * weight
        solve = _inverses(products) * self.present
        rows = {2 - axis: (solve[k], self.steps[1 - axis]) for k, axis in enumerate(ways, 1)}
        rows[0] = solve[0], 1.0

        def fitted(images: FloatArray, kinds: Sequence[int] = (0, 1, 2)) -> FloatArray:
            right = _blurred(basis[:, np.newaxis] * images, narrow)
            for k, axis in enumerate(ways, 1):
                right[k] -= middle[axis] * right[0]
            found = np.zeros((len(kinds), *images.shape))
            for plane, kind in zip(found, kinds, strict=True):
                row, step = rows.get(kind, ((), 1.0))
                for share, product in zip(row, right, strict=False):  # no slope along one cell
                    plane += share * product
                plane /= step
            return found

        return fitted

    def between(self, images: FloatArray) -> FloatArray:
        """Return slopes (k, n) [1] of images (k, r, c) between neighbouring present cells.

        They are weighted so that their mean square is the sum of the mean squares along x and y.
        """
        found = []
        for axis, step in zip((-1, -2), self.steps, strict=True):
            pairs = np.diff(self.present.astype(np.int8), axis=axis)
            both = (pairs == 0) & np.delete(self.present, 0, axis)
            found.append(np.diff(images, axis=axis)[:, both] / step)
        count = sum(slopes.shape[1] for slopes in found)
        weighted = [slopes * np.sqrt(count / max(slopes.shape[1], 1)) for slopes in found]
        return np.concatenate(weighted, axis=1)

    def low_pass(self, cutoff: float) -> Callable[[FloatArray], FloatArray]:
        """Return a Gaussian low-pass of ``cutoff`` [m] of images (…, r, c), also in empty cells."""
        rows, columns, weight = self.weights(cutoff)
        return lambda images: np.asarray(rows @ (images * self.present) @ columns / weight)

    def smoothed(self, images: FloatArray, cutoff: float) -> FloatArray:
        """Return images (…, r, c) after a Gaussian low-pass of ``cutoff`` [m] (ISO 16610-61)."""
        return self.low_pass(cutoff)(images) * self.present

    def weights(self, cutoff: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the weights of rows (r, r) and columns (c, c), and their sum by cell (r, c)."""
        sizes = zip(self.present.shape, reversed(self.steps), strict=True)
        rows, columns = (gaussian_weights(size, cutoff / step) for size, step in sizes)
        return rows, columns, np.maximum(rows @ self.present @ columns, np.finfo(np.float64).tiny)


def _of_scattered(x: FloatArray, y: FloatArray) -> tuple[tuple[float, float], float]:
    """Return the sides of square cells [m], and the place of the first point in its own [cells]."""
    spans = float(np.ptp(x)), float(np.ptp(y))
    # The area of a strip is at least 1e-6 of a square's, to keep the cells finite.
    side = np.sqrt(max(spans[0] * spans[1], 1e-6 * max(spans) ** 2) / len(x))
    pitch = max(float(side * np.sqrt(_POINTS_PER_CELL)), max(spans) / _MOST_ACROSS)
    if min(spans) == 0:
        pitch = max(spans) / min(max(len(x) - 1, 1), _MOST_ALONG) or 1.0
    # A point within rounding of an edge belongs to the next cell.
    return (pitch, pitch), 1e-9


def _of_grid(x: FloatArray, y: FloatArray) -> tuple[tuple[float, float], float] | None:
    """Return the same for cells that hold one point each of a grid, or whole blocks of them.

    None for a grid that is turned, so that its points form no columns and rows.
    """
    spacings = []
    for values in (x, y):
        steps = np.diff(np.sort(values))
        # Points of one column differ by rounding, and by what the tilt of the part moves them.
        apart = steps[steps > _LEAST_STEP * np.max(steps, initial=0.0)]
        spacings.append(float(np.median(apart)) if len(apart) else np.inf)
    counts = [round(np.ptp(v) / step) + 1 for v, step in zip((x, y), spacings, strict=True)]
    if min(counts) < 2 or np.prod(counts) * _LEAST_FILLED > len(x):
        return None
    block = int(np.ceil(np.sqrt(np.prod(counts)) / _MOST_OF_GRID))
    return (spacings[0] * block, spacings[1] * block), 0.5 / block


def square_slope(height: FloatArray, steps: tuple[float, float]) -> float:
    """Return the mean square slope of a map (r, c) [m] beyond its form of fourth order."""
    y, x = (np.linspace(-1.0, 1.0, size) for size in height.shape)
    row, column = (at[:: -(-len(at) // _MOST_FITTED)] for at in np.nonzero(np.isfinite(height)))
    columns = np.polynomial.polynomial.polyvander2d(y[row], x[column], (4, 4))
    form = np.linalg.lstsq(columns, height[row, column])[0].reshape(5, 5)
    rest = height - np.polynomial.polynomial.polygrid2d(y, x, form)
    slopes = [np.diff(rest, axis=axis) / step for axis, step in zip((1, 0), steps, strict=True)]
    return float(sum(np.nansum(s**2) / max(np.isfinite(s).sum(), 1) for s in slopes))


def gaussian_weights(size: int, cutoff: float) -> FloatArray:
    """Return the weight of each cell for each other (size, size); ``cutoff`` in cells."""
    apart = np.subtract.outer(np.arange(size), np.arange(size)) / (_ALPHA * cutoff)
    # Products with smaller weights have few digits, and take five times as long.
    return np.asarray(np.exp(-np.minimum(np.pi * apart**2, 100.0)))


def _inverses(matrices: FloatArray) -> FloatArray:
    """Return the inverses of positive definite ``matrices`` (k, k, …): Gauss-Jordan for all."""
    found = matrices.copy()
    for k in range(len(found)):
        pivot, row = found[k, k].copy(), found[k].copy()
        column = found[:, k] / pivot
        found -= column[:, np.newaxis] * row
        found[k], found[:, k] = row / pivot, -column
        found[k, k] = 1 / pivot
    return found


def _blurred(images: FloatArray, cutoffs: Sequence[float]) -> FloatArray:
    """Return images (…, r, c) times the Gaussian weights of ``cutoffs`` along y and x [cells]."""
    for axis, cutoff in zip((-2, -1), cutoffs, strict=True):
        kernel = gaussian_weights(2 * math.ceil(_REACH * cutoff) + 1, cutoff)
        images = scipy.ndimage.correlate1d(images, kernel[len(kernel) // 2], axis, mode="constant")
    return images


HOLDS, FAILS, OPEN = "holds", "fails", "cannot tell"
COVERAGE_FACTOR = 2.0


@dataclass(frozen=True)
class Conformity:
    """Conformity with a tolerance by the decision rule of ISO 14253-1.

    verdict: HOLDS, FAILS or OPEN;  value, tolerance: [m]
    expanded: uncertainty (k = 2) [m], None if it was not evaluated
    reasons: why it is open although the value alone would hold
    """

    verdict: str
    value: float
    expanded: float | None
    tolerance: float
    reasons: tuple[Notice | str, ...] = ()

    def entry(self) -> dict[str, Any]:
        """Return the JSON values for result files."""
        return {**asdict(replace(self, reasons=())), "reasons": [*map(str, self.reasons)]}


class Doubt(NamedTuple):
    """A part of the surface that no figure contains.

    reason: as a sentence;  peak_to_valley: of the surface with it [m], None if it is unknown
    """

    reason: Notice | str
    peak_to_valley: float | None


def conformity(
    figure: UncertainValue, tolerance: float, doubts: Sequence[Doubt] = ()
) -> Conformity | None:
    """Return whether ``figure`` is at most ``tolerance`` [m], None for a figure without a value.

    It holds if it does with the expanded uncertainty added, and fails if it does with that
    subtracted; in between the uncertainty leaves it open. With a doubt that may exceed the
    ``tolerance`` nothing is known to hold.
    """
    if figure.value is None:
        return None
    if figure.uncertainty is None:
        return Conformity(OPEN, figure.value, None, tolerance)
    expanded = COVERAGE_FACTOR * figure.uncertainty
    reasons = tuple(
        d.reason for d in doubts if d.peak_to_valley is None or d.peak_to_valley > tolerance
    )
    verdict = OPEN
    if figure.value + expanded <= tolerance:
        verdict = OPEN if reasons else HOLDS
    elif figure.value - expanded > tolerance:
        verdict = FAILS
    return Conformity(verdict, figure.value, expanded, tolerance, reasons)
