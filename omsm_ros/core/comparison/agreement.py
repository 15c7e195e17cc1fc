"""Test the agreement of two measurements within their stated uncertainties.

``E_n = (a − b) / √(U_a² + U_b²)`` with expanded uncertainties (ISO 13528, 9.7); beyond ±1 the
measurements disagree. Several figures or Zernike terms are tested together, so their U holds for
all of them at once with 95 % (Šidák). In addition ``χ² = cᵀ C⁻¹ c`` tests all terms with their
covariance C.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import chdtrc, ndtri

from omsm_ros.core.calibration.repeatability import mahalanobis
from omsm_ros.core.comparison.matching import Matched
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# For about 95 % (GUM 6.3.3).
COVERAGE_FACTOR = 2.0
# Orders two to six, for which tolerances of form are stated.
TERMS: tuple[ZernikeIndex, ...] = terms_up_to(6, 2)
# Share of the area (ISO 10110-5:2015 calls for it to be stated).
ROBUST_SHARE = 0.995

# Coverage for all terms or figures at once, and for the place of the largest difference [%].
_TOGETHER, _PERCENTILE = 0.95, 99.0
# Draws that give a share of 95 % to 1.3 %, one of 99 % to 0.6 %.
_DRAWS = 300
# Share of the variance above which the smoothing is narrower than one place.
_HARDLY_SMOOTHED = 0.7
# A term with a smaller independent share is not separable from the others.
_LEAST_OWN_SHARE = 1e-4
# Eigenvalues of a correlation matrix below this share of the largest are rounding.
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementErrors:
    """Errors of one measurement at the places (m,).

    shapes: by source (k, m) [m], with independent amplitudes of standard deviation one
    single: independent standard deviation of each height [m], (m,)
    averaged: independent standard deviation for means over many places [m], (m,)
    """

    shapes: dict[str, FloatArray]
    single: FloatArray
    averaged: FloatArray


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """Figure of both measurements [m] and its E_n; ``expanded`` and ``e_n`` are None if unknown."""

    a: float
    b: float
    expanded: float | None
    e_n: float | None


@dataclass(frozen=True, slots=True)
class ComparedTerm:
    """Zernike term of the difference [m], one at the rim; ``expanded`` holds for all terms."""

    n: int
    m: int
    difference: float
    uncertainty: float
    expanded: float
    e_n: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ComparisonAgreement:
    """Agreement of two measurements in figures, Zernike terms and single places.

    figures: peak_to_valley, robust_peak_to_valley, rms;  terms: of the difference
    probability: of a larger χ² if only the stated errors were present
    within: share of the area with |E_n| < 1 (k = 2)
    uncertainty: of the difference at each place [m], k = 1, (m,)
    farthest: largest |difference| / uncertainty of all places;  at: its place [m]
    allowed: limit of ``farthest`` that 99 % of agreeing pairs keep
    aperture: radius and middle of the disc of the terms [m]
    """

    figures: dict[str, ComparedFigure]
    terms: tuple[ComparedTerm, ...]
    probability: float
    within: float
    uncertainty: FloatArray
    farthest: float
    allowed: float
    at: tuple[float, float]
    aperture: tuple[float, float, float]

    @property
    def largest(self) -> ComparedTerm:
        """The term of the largest |E_n|."""
        return max(self.terms, key=lambda term: abs(term.e_n))


def peak_to_valley(values: FloatArray) -> FloatArray:
    """Return the range of values (…, m)."""
    return np.asarray(np.ptp(values, axis=-1))


def robust_peak_to_valley(values: FloatArray) -> FloatArray:
    """Return the range of the middle 99.5 % of values (…, m)."""
    tail = 50 * (1 - ROBUST_SHARE)
    low, high = np.percentile(values, [tail, 100 - tail], axis=-1)
    return np.asarray(high - low)


def root_mean_square(values: FloatArray) -> FloatArray:
    """Return the rms of values (…, m) about zero."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)))


FIGURES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "peak_to_valley": peak_to_valley,
    "robust_peak_to_valley": robust_peak_to_valley,
    "rms": root_mean_square,
}


def figures_of(matched: Matched) -> dict[str, ComparedFigure]:
    """Return the figures of both measurements without the fitted pose or E_n."""
    a, b = matched.without_fit(np.stack([matched.a, matched.b]))
    return {
        name: ComparedFigure(float(figure(a)), float(figure(b)), None, None)
        for name, figure in FIGURES.items()
    }


def shapes_of_difference(
    errors: tuple[MeasurementErrors, MeasurementErrors], shared: Collection[str] = ()
) -> FloatArray:
    """Return the shapes (k, m) [m] of the errors of a − b.

    shared: sources of an error that both have in common, whose shapes are subtracted
    """
    own = [rows for e in errors for name, rows in e.shapes.items() if name not in shared]
    both = [errors[0].shapes[name] - errors[1].shapes[name] for name in shared]
    return np.concatenate([np.empty((0, len(errors[0].single))), *own, *both])


def judge(
    matched: Matched,
    errors: tuple[MeasurementErrors, MeasurementErrors],
    shared: Collection[str] = (),
) -> ComparisonAgreement:
    """Return the agreement of two measurements with known ``errors`` at the places.

    shared: sources of an error that both have in common
    """
    shapes = matched.without_fit(shapes_of_difference(errors, shared))
    uncertainty = np.sqrt(np.sum(shapes**2, axis=0) + sum(e.single**2 for e in errors))
    score = np.abs(matched.difference) / uncertainty
    worst = int(np.argmax(score))
    averaged = np.hypot(errors[0].averaged, errors[1].averaged)
    terms, probability, aperture = _terms(matched, shapes, averaged)
    drawn = _monte_carlo_errors(matched, errors, shared)
    farthest = np.max(np.abs(drawn[0] - drawn[1]) / uncertainty, axis=1)
    return ComparisonAgreement(
        figures=_figures(matched, drawn), terms=terms, probability=probability,
        within=float(np.mean(score < COVERAGE_FACTOR)), uncertainty=uncertainty,
        farthest=float(score[worst]), allowed=float(np.percentile(farthest, _PERCENTILE)),
        at=(float(matched.x[worst]), float(matched.y[worst])), aperture=aperture,
    )  # fmt: skip


def _figures(matched: Matched, drawn: Sequence[FloatArray]) -> dict[str, ComparedFigure]:
    """Return the figures with their E_n by Monte Carlo (GUM Supplement 1)."""
    heights = matched.without_fit(np.stack([matched.a, matched.b]))
    found = {}
    for name, figure in FIGURES.items():
        own = float(figure(heights[0])), float(figure(heights[1]))
        runs = [figure(height + errors) for height, errors in zip(heights, drawn, strict=True)]
        spread = float(np.std(runs[0] - runs[1]))
        # Noise increases a peak to valley; drawing it once more gives the bias to subtract.
        excess = [float(np.mean(run)) - value for run, value in zip(runs, own, strict=True)]
        expanded = _coverage_factor(len(FIGURES)) * spread
        e_n = ((own[0] - excess[0]) - (own[1] - excess[1])) / expanded if expanded > 0 else None
        found[name] = ComparedFigure(*own, expanded, e_n)
    return found


def _monte_carlo_errors(
    matched: Matched, errors: tuple[MeasurementErrors, MeasurementErrors], shared: Collection[str]
) -> list[FloatArray]:
    """Return draws of the errors of both, each (draws, m) [m], with a fixed seed."""
    random = np.random.default_rng(0)
    made = [_noise(matched, side, random) for side in errors]
    common: dict[str, FloatArray] = {}
    for place, side in enumerate(errors):
        for name, rows in side.shapes.items():
            sizes = random.standard_normal((_DRAWS, len(rows)))
            if name in shared:
                sizes = common.setdefault(name, sizes)
            made[place] = made[place] + sizes @ matched.without_fit(rows)
    return made


def _noise(matched: Matched, side: MeasurementErrors, random: np.random.Generator) -> FloatArray:
    """Return draws of the independent errors with the correlation of the local fits (draws, m) [m].

    Neighbouring places share points. White noise of the size ``averaged`` is smoothed to the size
    ``single``; a Gaussian of width σ leaves 1 / 4πσ² of the variance.
    """
    # Heights with a coarse resolution may have no scatter; they are not smoothed.
    ratios = np.divide(
        side.single, side.averaged, out=np.ones(len(side.single)), where=side.averaged > 0
    )
    ratio = float(np.median(ratios)) ** 2
    width = np.sqrt(1 / (4 * np.pi * min(ratio, 1.0)))
    shape = matched.grid.height.shape
    made = np.empty((_DRAWS, len(side.single)))
    for draw in made:
        white = random.standard_normal(shape)
        smooth = gaussian_filter(white, width, mode="wrap") if ratio < _HARDLY_SMOOTHED else white
        draw[:] = smooth.ravel()[matched.filled]
    return made * side.single / np.std(made)


def _coverage_factor(together: int) -> float:
    """Return the coverage factor for 95 % of ``together`` figures at once (Šidák, 1967)."""
    return float(ndtri((1 + _TOGETHER ** (1 / together)) / 2))


def _terms(
    matched: Matched, fitted: FloatArray, averaged: FloatArray
) -> tuple[tuple[ComparedTerm, ...], float, tuple[float, float, float]]:
    """Return the Zernike terms of the difference, the probability of all, and their disc."""
    x0, y0 = ((float(v.min()) + float(v.max())) / 2 for v in (matched.x, matched.y))
    radius = float(np.max(np.hypot(matched.x - x0, matched.y - y0)))
    u, v = (matched.x - x0) / radius, (matched.y - y0) / radius
    names, rows = _rows(matched, zernike_values(u, v, TERMS))
    value = rows @ matched.difference
    shapes = fitted @ rows.T
    covariance = shapes.T @ shapes + (rows * averaged**2) @ rows.T
    spread = np.sqrt(np.diag(covariance))
    chi_square, degrees = mahalanobis(value, covariance, _ROUNDING)
    factor = _coverage_factor(len(names))
    terms = tuple(
        ComparedTerm(term.n, term.m, float(d), float(s), factor * float(s), float(d / (factor * s)))
        for term, d, s in zip(names, value, spread, strict=True)
    )
    return terms, float(chdtrc(degrees, chi_square)), (radius, x0, y0)


def _rows(matched: Matched, values: FloatArray) -> tuple[list[ZernikeIndex], FloatArray]:
    free = matched.without_fit(values)
    own = np.linalg.norm(free, axis=1) / np.linalg.norm(values, axis=1)
    kept = np.flatnonzero(own > _LEAST_OWN_SHARE)
    design = free[kept].T
    return [TERMS[k] for k in kept], np.asarray(np.linalg.pinv(design, rcond=1e-8), np.float64)
