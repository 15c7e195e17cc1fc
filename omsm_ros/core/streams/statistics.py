"""How much do points scatter? Robustly, so that dust and edges do not count."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.linear_algebra import sosfilt

# Of the normal distribution, whose median absolute value is 0.6745 σ.
SIGMA_OF_MAD = 1.4826
_ORDER = 6
# Of white noise of unit size: Σ binomial(6, k)².
_GAIN = np.sqrt(924.0)
# Of normal values, whose mean size is √(2/π) σ; one speck of dust counts less than in a square.
_SIGMA_OF_MEAN_SIZE = np.sqrt(np.pi / 2)
# Differences over which it is averaged, exponentially: known to 2 % then.
_MEMORY = 2048
# Five standard deviations of that: what exceeds less is chance.
_EXCEEDS = 1.1
# No reading scatters by less; heights of metres are rounded to it.
_ROUNDING_M = 1e-12


def spread(values: FloatArray) -> float:
    """Return the standard deviation of Gaussian values (n,) about zero, whatever a few do."""
    return SIGMA_OF_MAD * float(np.median(np.abs(values)))


def median(values: FloatArray) -> float:
    """Return the median; of some hundred values numpy's own takes ten times as long."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half] + ordered[-1 - half]) / 2


def spread_about_median(values: FloatArray) -> float:
    """Return the standard deviation of normal values, little moved by others among them."""
    return SIGMA_OF_MAD * median(abs(values - median(values)))


def noise_of(deviation: FloatArray) -> float:
    """Return the standard deviation of what changes from point to point [m], robustly.

    From second differences of points in the order in which they were measured, for which form and
    slow drift are straight lines: ``median |d_(i−1) − 2 d_i + d_(i+1)| = 0.6745 √6 σ``.
    """
    if len(deviation) < 3:
        return 0.0
    return spread(np.diff(deviation, 2)) / float(np.sqrt(6))


class RunningScatter:
    """Follows the scatter of a scan's heights, sample by sample, however they are cut into blocks.

    A probe that looks at a turning part may be noisier than at rest before a flat: it sees less
    light, something vibrates, or readings step where noise at rest did not carry them over the
    step. That shows in the heights themselves, whatever the surface is: sixth differences of 0.3 mm
    at 40 Hz, sampled at 1 kHz, are 37 nm, those of white noise are √924 of it.

    expected: standard deviation of one height by what is stated of single readings [m]; zero where
        nothing is stated, and then every scatter exceeds it
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
        """Return the variance of each next height beyond what was expected [m²], (n,).

        session, sample: counts of its trigger, by which neighbours are known
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
        running = self._running(sizes)
        # Of each height, by the differences up to it: those of earlier blocks stand in front.
        seen = np.zeros(len(samples), np.int64)
        seen[_ORDER:] = np.cumsum(neighbours)
        scatter = running[seen[before:]]
        exceeds = scatter > max(_EXCEEDS * self._expected, _ROUNDING_M)
        return np.where(exceeds, scatter**2 - self._expected**2, 0.0)

    def _running(self, sizes: FloatArray) -> FloatArray:
        """Return the mean before any of ``sizes`` (n,) and after each of them, (n + 1,)."""
        sums = [self._faded(sizes, 0)]
        if 1.0 + self._decay * self._sums[1] == self._sums[1]:
            # As of some 50 000 samples one more does not change what all weigh together.
            return np.asarray(sums[0] / self._sums[1], np.float64)
        sums.append(self._faded(np.ones(len(sizes)), 1))
        return np.asarray(sums[0] / np.maximum(sums[1], np.finfo(np.float64).tiny), np.float64)

    def _faded(self, values: FloatArray, k: int) -> FloatArray:
        """Return the k-th fading sum before any of ``values`` (n,) and after each, (n + 1,)."""
        state = np.array([[self._decay * self._sums[k], 0.0]])
        sums = np.empty(len(values) + 1)
        sums[0] = self._sums[k]
        sosfilt(np.array([[1.0, 0.0, 0.0, 1.0, -self._decay, 0.0]]), values, state, sums[1:])
        self._sums[k] = float(sums[-1])
        return sums


# Which samples of a stream of unknown length stand for all of it, in bounded memory?


class EvenSelection:
    """Keeps every k-th row, k the least power of two with which no more than ``most`` are kept.

    What is kept does not depend on how the stream was cut. It lies in one piece: of small parts
    each would cost more than its rows, for as long as the stream lasts.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._every = 1
        self._seen = 0
        self._room: NDArray[Any] = np.empty(0)

    def __len__(self) -> int:
        """Rows kept."""
        return -(-self._seen // self._every)

    @property
    def every(self) -> int:
        """Of how many rows one is kept."""
        return self._every

    def add(self, rows: NDArray[Any]) -> None:
        """Take in the next ``rows`` (n, …)."""
        self.add_chosen(rows[self.chosen(len(rows))], len(rows))

    def chosen(self, rows: int) -> slice:
        """Return which of the next ``rows`` are wanted, for whoever makes only those."""
        while -(-(self._seen + rows) // self._every) > self._most:
            self._halve()
        return slice(-self._seen % self._every, rows, self._every)

    def add_chosen(self, part: NDArray[Any], rows: int) -> None:
        """Take in what :meth:`chosen` asked for, (k, …), of the next ``rows``."""
        held = len(self)
        self._seen += rows
        if len(part):
            self._make_room(held, part)
            self._room[held : held + len(part)] = part

    def _make_room(self, held: int, part: NDArray[Any]) -> None:
        needed = held + len(part)
        if needed > len(self._room):
            room = np.empty((min(max(2 * held, needed), self._most), *part.shape[1:]), part.dtype)
            if held:
                room[:held] = self._room[:held]
            self._room = room

    def _halve(self) -> None:
        """Leave out every other row."""
        held = len(self)
        self._room[: -(-held // 2)] = self._room[:held:2].copy()
        self._every *= 2

    def rows(self) -> NDArray[Any]:
        """Return all rows kept so far, in order, until the next are added; empty before any."""
        return self._room[: len(self)]
