"""Estimate the rms of a part, free of the bias by noise and systematic errors; remove smooth form.

Form that the fit of the pose may have taken for a move is missing from the deviations. It is
independent of the form that is left, so its probable mean square is added; its uncertainty belongs
to the figure. Upper bounds of errors, as of an unknown latency, are not subtracted; the change of
the square by an error of that size belongs to the uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb
from typing import NamedTuple

import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap, GridCells, UncertainValue
from omsm_ros.core.form.zernike_fit import CHUNK, DIFFERENCES, normal_equations, passes
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# The best Σ c_ij x^i y^j, i + j ≤ 2; what is no irregularity (ISO 10110-5), and its rest without
# symmetry; form to be removed by ISO 25178-2: a Gaussian filter would leave it at the rim, where
# its window is cut off.
SECOND_ORDER = terms_up_to(2)
POWER = (ZernikeIndex(0, 0), ZernikeIndex(1, -1), ZernikeIndex(1, 1), ZernikeIndex(2, 0))
TILT = POWER[:3]
SYMMETRIC = POWER + tuple(ZernikeIndex(n, 0) for n in range(4, 14, 2))
FORM = terms_up_to(4)


def rms_of_part(map_: DeviationMap, beyond: tuple[float, float] = (0.0, 0.0)) -> UncertainValue:
    """Return the area-weighted rms of the part about zero, in closed form.

    beyond: mean square that form between the last track and the rim adds, and its standard
        uncertainty [m²]
    """
    if not map_.noise_known:
        return either(*(rms_of_part(one, beyond) for one in with_and_without(map_)))
    share = map_.area / map_.area.sum()
    weighted = map_.effects * share
    products = weighted @ map_.effects.T
    shared = weighted @ map_.deviation
    noise = map_.noise**2
    real, taken = real_effects(map_), slice(len(map_.taken))
    among_real, own = products[np.ix_(real, real)], np.diag(products)
    missing = float(np.sum(map_.taken * products[taken, taken]))
    square = float(share @ map_.deviation**2 - np.trace(among_real) - noise) + missing + beyond[0]
    of_form = 4 * max(float(np.sum(shared[real] ** 2)) - float(np.sum(among_real**2)), 0.0)
    of_form += 4 * float(np.sum(shared[taken] ** 2)) + (float(np.sum(own[taken])) - missing) ** 2
    # For e = Σ a_i f_i, the mean square of 2 d·e − e·e is 4 Σ (d·f_i)² + tr² P + 2 tr P², with P
    # the products of the f_i.
    bounded = float(np.sum(own[map_.bounds]))
    of_bounds = 4 * float(np.sum(shared[map_.bounds] ** 2)) + bounded**2
    of_errors = of_form + of_bounds + 2 * float(np.sum(products**2))
    variance = of_errors + beyond[1] ** 2
    # For each point 4 d²σ² from its form, 2 σ⁴ from its noise, and 2 σ⁴ from the scatter of σ; for
    # all what form may add to σ.
    by_noise = float(np.sum(share**2 * (4 * map_.deviation**2 * noise + 4 * noise**2)))
    by_noise += 4 * noise * map_.noise_error**2
    variance += max(by_noise, _variance_by_tracks(map_, share))
    return of_square(square, float(np.sqrt(variance)))


def with_and_without(map_: DeviationMap) -> tuple[DeviationMap, DeviationMap]:
    """Return the map as if all that may be noise were texture, and as if it were noise."""
    return replace(map_, noise=0.0, noise_known=True), replace(map_, noise_known=True)


def either(measured: UncertainValue, quiet: UncertainValue) -> UncertainValue:
    """Return the figure as measured; what may be noise counts in its uncertainty."""
    spread = max(measured.uncertainty or 0.0, quiet.uncertainty or 0.0)
    return UncertainValue(
        measured.value, length(spread, (measured.value or 0.0) - (quiet.value or 0.0))
    )


def real_effects(map_: DeviationMap) -> BoolArray:
    """Return which effects (e,) are of errors that are certainly present."""
    real = np.ones(len(map_.effects), np.bool_)
    real[map_.bounds] = False
    real[: len(map_.taken)] = False
    return real


def length(*shares: float) -> float:
    """Return the root of the sum of the squares of independent ``shares``."""
    return float(np.sqrt(sum(share**2 for share in shares)))


def _variance_by_tracks(map_: DeviationMap, share: FloatArray) -> float:
    """Return the variance of the mean square [m⁴] from form between the tracks.

    The mean squares of successive passes of the path vary smoothly where the tracks resolve the
    form; their fourth differences show what they do not (systematic samples: K. Wolter,
    Introduction to Variance Estimation, 2007, ch. 8).
    """
    begins = passes(map_.x, map_.y)
    if begins is None:
        return 0.0
    weight = np.maximum(np.add.reduceat(share, begins), np.finfo(np.float64).tiny)
    means = np.add.reduceat(share * map_.deviation**2, begins) / weight
    # The first and the last pass stand for less, at the rim, and may be incomplete.
    about = (means - np.sum(weight * means))[1:-1]
    of_areas = about**2 * _rough_squares(weight[1:-1])
    return float(np.sum(weight**2 * _rough_squares(means)) + np.sum(of_areas))


def _rough_squares(values: FloatArray) -> FloatArray:
    """Return the squares of what is not smooth in ``values`` (n,), from their differences."""
    rough = np.diff(values, DIFFERENCES) ** 2 / comb(2 * DIFFERENCES, DIFFERENCES)
    before = DIFFERENCES // 2
    return np.asarray(np.pad(rough, (before, len(values) - len(rough) - before), "edge"))


def of_square(square: float, spread: float) -> UncertainValue:
    """Return the root of a ``square`` [m²] with its standard uncertainty ``spread`` [m²].

    The uncertainty is half the larger side of the interval of the root for k = 2 of the square. A
    square may be negative by chance; the interval then ends at the root of ``spread``.
    """
    value = float(np.sqrt(max(square, 0.0)))
    high = float(np.sqrt(max(square + 2 * spread, spread)))
    low = float(np.sqrt(max(square - 2 * spread, 0.0)))
    return UncertainValue(value, max(high - value, value - low) / 2)


def fitted(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Solve normal equations; for points on a line, where columns coincide, by minimum norm."""
    return np.asarray(np.linalg.pinv(gram, rcond=1e-12, hermitian=True) @ right)


def best_fit(map_: DeviationMap) -> DeviationMap:
    """Return the map after best-fit alignment in all fitted and held pose parameters.

    It contains neither the uncertainty of the pose nor form that looks like a move.
    """
    moves = map_.effects[map_.moves]
    size = np.sqrt(np.mean(moves**2, axis=1))
    columns = moves[size > 0] / size[size > 0, np.newaxis]
    weighted = columns * map_.area
    right = np.column_stack([weighted @ map_.deviation, weighted @ map_.effects.T])
    shares = fitted(weighted @ columns.T, right)
    deviation = map_.deviation - shares[:, 0] @ columns
    return replace(map_, deviation=deviation, effects=map_.effects - shares[:, 1:].T @ columns)


class SmoothTerms(NamedTuple):
    """Zernike ``terms`` of a map on a ``disc``, and sums from which each choice of them is fitted.

    gram: area-weighted products of the terms (k, k);  right: with deviation and effects (k, 1 + e)
    """

    map: DeviationMap
    disc: Aperture
    terms: tuple[ZernikeIndex, ...]
    gram: FloatArray
    right: FloatArray

    @classmethod
    def of(cls, map_: DeviationMap, disc: Aperture, terms: Sequence[ZernikeIndex]) -> SmoothTerms:
        """Return the ``terms`` of a map."""
        values = np.vstack([map_.deviation, map_.effects])
        sums = normal_equations(map_.x, map_.y, values, terms, disc, map_.area)
        return cls(map_, disc, tuple(terms), *sums)

    def sums(self, terms: Sequence[ZernikeIndex]) -> tuple[FloatArray, FloatArray]:
        """Return the sums of some of the ``terms``: (t, t) and (t, 1 + e)."""
        chosen = [self.terms.index(term) for term in terms]
        return self.gram[np.ix_(chosen, chosen)], self.right[chosen]

    def without(self, terms: Sequence[ZernikeIndex]) -> DeviationMap:
        """Return the map without the fit of some of the ``terms``."""
        shares, map_ = fitted(*self.sums(terms)), self.map
        deviation, effects = np.empty_like(map_.deviation), np.empty_like(map_.effects)
        for begin in range(0, len(map_), CHUNK):
            part = slice(begin, begin + CHUNK)
            columns = zernike_values(*self.disc.scaled(map_.x[part], map_.y[part]), terms)
            deviation[part] = map_.deviation[part] - shares[:, 0] @ columns
            effects[:, part] = map_.effects[:, part] - shares[:, 1:].T @ columns
        return replace(map_, deviation=deviation, effects=effects)


def short_waves(map_: DeviationMap, cells: GridCells, longest: float) -> DeviationMap:
    """Return the points less the waves of their ``cells`` longer than ``longest`` [m]."""
    from scipy.ndimage import map_coordinates  # takes long to load

    images = cells.low_pass(longest)(np.concatenate([cells.mean[np.newaxis], cells.effects]))
    at = [(map_.y - cells.y[0]) / cells.steps[1], (map_.x - cells.x[0]) / cells.steps[0]]
    low = np.array([map_coordinates(image, at, order=1, mode="nearest") for image in images])
    return replace(map_, deviation=map_.deviation - low[0], effects=map_.effects - low[1:])


# Noise adds to an extent with the first power of its size where many points compete for it, with
# the second where one has it. The middle is used, the others are limits of a uniform error.
_POWERS = (1.0, 1.5, 2.0)


def without_noise(once: float, again: FloatArray) -> tuple[float, float]:
    """Return an extent [m] without noise, from extents ``again`` (draws,) with twice the variance.

    It may be negative by chance. Second is the standard uncertainty of the extrapolation [m].
    """
    left = [once**p - (np.mean(again**p) - once**p) / (2 ** (p / 2) - 1) for p in _POWERS]
    found = [float(np.sign(v) * abs(v) ** (1 / p)) for v, p in zip(left, _POWERS, strict=True)]
    return found[1], float(np.ptp(found)) / np.sqrt(12)
