"""Robust scatter of readings, slopes of a lower hull, and an even selection from a long stream."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.linear_algebra import sosfilt

# The median absolute value of a normal distribution is 0.6745 σ.
SIGMA_OF_MAD = 1.4826
# Order of the differences that remove the shape of the surface.
_ORDER = 6
# Standard deviation of sixth differences of white noise of σ = 1: √Σ binomial(6, k)².
_GAIN = np.sqrt(924.0)
# The mean absolute value of a normal distribution is √(2/π) σ; outliers count less than in squares.
_SIGMA_OF_MEAN_SIZE = np.sqrt(np.pi / 2)
# Number of differences in the exponential average, which is then known to 2 %.
_MEMORY = 2048
# An excess of five standard deviations of the average; less is random.
_EXCEEDS = 1.1
# Rounding of heights of a metre.
_ROUNDING_M = 1e-12


def spread(values: FloatArray) -> float:
    """Return the standard deviation of normal values (n,) about zero, robust against outliers."""
    return SIGMA_OF_MAD * float(np.median(np.abs(values)))


def median(values: FloatArray) -> float:
    """Return the median of ``values`` (n,); numpy takes ten times as long for a few hundred."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half] + ordered[-1 - half]) / 2


def spread_about_median(values: FloatArray) -> float:
    """Return the standard deviation of normal values (n,), robust against outliers."""
    return SIGMA_OF_MAD * median(abs(values - median(values)))


def white_noise(values: FloatArray) -> float:
    """Return the standard deviation of white noise (n,): what neighbours do not share."""
    return float(np.sqrt(np.mean(np.diff(values, 2) ** 2) / 6))


def noise_of(deviation: FloatArray) -> float:
    """Return the standard deviation of the noise from point to point [m], robustly.

    Second differences of points in the order of measurement remove form and slow drift:
    ``median |d_(i−1) − 2 d_i + d_(i+1)| = 0.6745 √6 σ``.
    """
    if len(deviation) < 3:
        return 0.0
    return spread(np.diff(deviation, 2)) / float(np.sqrt(6))


# Widths of the steps of a falling density, from the resolution of its values on.
_WIDTHS = np.append(0.0, 0.01 * 2.0 ** np.arange(20))
_RISING = np.triu(np.ones((len(_WIDTHS), len(_WIDTHS)), bool), 1)
_ACROSS = np.where(_RISING, _WIDTHS - _WIDTHS[:, np.newaxis], 1.0)


def falling_density_likelihood(values: FloatArray) -> FloatArray:
    """Return the log likelihood (m,) of each row of positive ``values`` (m, n).

    The likeliest density that falls is the slope of the least concave curve above their cumulative
    number (Grenander 1956), here between ``_WIDTHS``.
    """
    number = np.count_nonzero(values[..., np.newaxis] <= np.append(-1.0, _WIDTHS[1:]), axis=1)
    up = np.where(_RISING, (number[:, np.newaxis] - number[..., np.newaxis]) / _ACROSS, -np.inf)
    most = np.maximum.accumulate(up[..., ::-1], axis=2)[..., ::-1]
    density = np.where(_RISING, most, np.inf).min(axis=1)[:, 1:] / values.shape[1]
    each = np.diff(number, axis=1)
    likely: FloatArray = np.sum(each * np.log(np.where(each, density, 1.0)), axis=1)
    return likely


class RunningScatter:
    """Running scatter of the heights of a scan, independent of their division into blocks.

    A probe over a turning part may be noisier than in the step test, because of less light,
    vibration or the resolution of its readings. Sixth differences of the heights show it for any
    surface: those of 0.3 mm at 40 Hz, sampled at 1 kHz, are 37 nm; those of white noise √924 σ.

    expected: standard deviation of one height by the stated sources of single readings [m]; any
        scatter exceeds zero
    """

    def __init__(self, expected: float) -> None:
        self._expected = expected
        self._decay = np.exp(-1 / _MEMORY)
        self._session: int | None = None
        self._begin()

    def _begin(self) -> None:
        prior = float(_MEMORY) if self._expected > 0 else 0.0
        self._sums = [self._expected * prior, prior]
        self._samples = np.empty(0, np.int64)
        self._heights = np.empty(0)

    def excess(self, session: int, sample: IntArray, height: FloatArray) -> FloatArray:
        """Return the variance of each next height beyond the expected one [m²], (n,).

        session, sample: of its trigger, to find neighbours
        """
        if session != self._session:
            self._session = session
            self._begin()
        before = len(self._samples)
        samples = np.concatenate([self._samples, sample])
        heights = np.concatenate([self._heights, height])
        self._samples, self._heights = samples[-_ORDER:], heights[-_ORDER:]
        neighbours = samples[_ORDER:] - samples[:-_ORDER] == _ORDER
        sizes = np.abs(np.diff(heights, _ORDER))[neighbours] * (_SIGMA_OF_MEAN_SIZE / _GAIN)
        # The running mean of the sizes, before the first and after each of them.
        total, weight = self._faded(sizes, 0), self._faded(np.ones(len(sizes)), 1)
        running = total / np.maximum(weight, np.finfo(np.float64).tiny)
        # The scatter at a height comes from the differences up to it, also of earlier blocks.
        seen = np.zeros(len(samples), np.int64)
        seen[_ORDER:] = np.cumsum(neighbours)
        scatter = running[seen[before:]]
        exceeds = scatter > max(_EXCEEDS * self._expected, _ROUNDING_M)
        return np.where(exceeds, scatter**2 - self._expected**2, 0.0)

    def _faded(self, values: FloatArray, k: int) -> FloatArray:
        """Return the k-th decaying sum before ``values`` (n,) and after each of them, (n + 1,)."""
        state = np.array([[self._decay * self._sums[k], 0.0]])
        sums = np.empty(len(values) + 1)
        sums[0] = self._sums[k]
        sosfilt(np.array([[1.0, 0.0, 0.0, 1.0, -self._decay, 0.0]]), values, state, sums[1:])
        self._sums[k] = float(sums[-1])
        return sums


class EvenSelection:
    """Keeps every k-th row of a stream, with the least power of two k that keeps ``most`` or fewer.

    The selection does not depend on the division into blocks.
    every: the step k from one kept row to the next
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self.every = 1
        self._seen = 0
        self._room: NDArray[Any] = np.empty(0)

    def __len__(self) -> int:
        return -(-self._seen // self.every)

    def add(self, rows: NDArray[Any]) -> None:
        """Take the next ``rows`` (n, …)."""
        self.add_chosen(rows[self.chosen(len(rows))], len(rows))

    def chosen(self, rows: int) -> slice:
        """Return which of the next ``rows`` will be kept, so that only those need be computed."""
        while -(-(self._seen + rows) // self.every) > self._most:
            held = len(self)
            self._room[: -(-held // 2)] = self._room[:held:2].copy()
            self.every *= 2
        return slice(-self._seen % self.every, rows, self.every)

    def add_chosen(self, part: NDArray[Any], rows: int) -> None:
        """Take the ``part`` (k, …) of the next ``rows`` that :meth:`chosen` returned."""
        held = len(self)
        self._seen += rows
        needed = held + len(part)
        if needed > len(self._room):
            room = np.empty((min(max(2 * held, needed), self._most), *part.shape[1:]), part.dtype)
            if held:
                room[:held] = self._room[:held]
            self._room = room
        if len(part):
            self._room[held:needed] = part

    def rows(self) -> NDArray[Any]:
        """Return the rows kept so far, in order; a view that is valid until the next are added."""
        return self._room[: len(self)]


def slopes_below(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the slopes of the edges of the lower convex hull of points (n,), in rising order."""
    hull: list[tuple[float, float]] = []
    for k in np.lexsort((y, x)):
        point = u, v = float(x[k]), float(y[k])
        if hull and u == hull[-1][0]:
            continue
        while len(hull) > 1:
            (a, b), (c, d) = hull[-2:]
            if (v - b) * (c - a) > (d - b) * (u - a):
                break
            hull.pop()
        hull.append(point)
    run, rise = np.diff(np.array(hull), axis=0).T
    return np.asarray(rise / run)
