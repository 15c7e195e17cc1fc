"""The part: Zernike terms, rings about the spindle, and cells for what they do not resolve.

Terms are regular at the axis, which errors of the machine need not be: one scan separates them by
that, except where they are rotationally symmetric. A turned part may have any profile over the
radius, a cone at the centre too: the cone is free, and rings are waves over the radius, with one
variance for each octave, estimated from the scans. Without them a ring would pass for an error of
the spindle centre, a drift or a bend of a slide. Cells are random effects of one variance, common
to all scans, eliminated cell by cell.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.adjustment.blocks import Blocks
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# Above degree 6 the variance of each degree is estimated: free terms would take what an error of
# the spindle centre has beyond the regular ones (tried: to degree 10 they raise U by a half).
FREE_DEGREE, HIGHEST_DEGREE = 6, 24
# Waves of 2 to 3 mm on a part of 25 mm would pass for an error of the spindle centre, where all
# angles meet. Only the lowest harmonics are large there, and above the twelfth no family acts.
_FINE_DEGREE, _LOW_HARMONIC, _HIGHEST_HARMONIC = 40, 4, 12
# Added to their degree, for polishing and turning leave more of them than of other harmonics.
_LOW = 100
# Among the variances that are estimated: rotationally symmetric terms above the free ones, for
# turning leaves them, and the first octave of the rings.
SYMMETRIC, RINGS = -1, -2
# A tool that misses the centre turns a cone: power of the radius, not a degree of a term.
_CONE = 1
# Half waves of the rings over the radius: what has a whole one in a turn looks like a centre.
_MOST_WAVES, _WAVES_A_TURN = 128, 1.5
# A form that large is no form error of a finished part: no prior at all.
FREE_M = 1e-5
# Of the radius: a spiral about the axis begins and ends within a pitch of where it should.
_CENTRED = 0.03
# Rings of half a millimetre on a part of 25 mm; two turns at least in a ring.
_MOST_RINGS, _TURNS_A_RING, _LEAST_RINGS = 24, 2, 3


@dataclass(frozen=True, eq=False)
class PartModel:
    """Terms and cells of the part.

    disc: that the terms are defined on;  terms: from degree 0
    inner, outer: radii about the spindle between which rings are [m];  waves: half waves of each
    rings: of the cells;  cell: of each block (b,);  cells: their number
    """

    disc: Aperture
    terms: tuple[ZernikeIndex, ...]
    rings: int
    cell: IntArray
    cells: int
    inner: float
    outer: float
    waves: IntArray

    def values(self, x: FloatArray, y: FloatArray, span: FloatArray | None = None) -> FloatArray:
        """Return terms, cone and rings at x, y [m], (n, k), terms averaged over arcs ``span``
        [rad]."""
        made = np.ascontiguousarray(zernike_values(*self.disc.scaled(x, y), self.terms).T)
        if span is not None:
            order = np.array([abs(t.m) for t in self.terms])
            for m in np.unique(order):
                made[:, order == m] *= np.sinc(span * m / (2 * np.pi))[:, np.newaxis]
        radius = np.hypot(x, y)[:, np.newaxis]
        return np.concatenate([made, radius / self.outer, self._rings(radius)], axis=1)

    @property
    def _octave(self) -> IntArray:
        """Octave of each ring, (w,)."""
        return np.asarray(np.log2(self.waves), np.int64)

    def _rings(self, radius: FloatArray) -> FloatArray:
        """Return rings at a radius (n, 1) [m], (n, w); an octave has mean square one."""
        place = np.clip((radius - self.inner) / (self.outer - self.inner), 0.0, 1.0)
        number = np.bincount(self._octave, minlength=1)[self._octave]
        return np.asarray(np.cos(np.pi * place * self.waves) * np.sqrt(2 / number))

    @property
    def free(self) -> FloatArray:
        """Standard deviations where nothing is known [m]; 0 for those that are estimated."""
        terms = [FREE_M if t.n <= FREE_DEGREE else 0.0 for t in self.terms]
        return np.array([*terms, FREE_M, *np.zeros(len(self.waves))])

    @property
    def degrees(self) -> IntArray:
        """Degree of each term and of the cone, or ``SYMMETRIC``; ``RINGS`` and below, (k,)."""
        n, m = np.array(self.terms).T
        # Two degrees together have eight such terms, which determine their variance.
        low = (n > FREE_DEGREE) & (np.abs(m) <= _LOW_HARMONIC)
        terms = np.where(low, _LOW + n + n % 2, n)
        terms[low & (m == 0)] = SYMMETRIC
        return np.array([*terms, _CONE, *(RINGS - self._octave)])

    def cell_of(self, x: FloatArray, y: FloatArray) -> IntArray:
        """Return the number of the cell at x, y [m] among all of the disc, (n,)."""
        u, v = self.disc.scaled(x, y)
        ring = np.clip((np.hypot(u, v) * self.rings).astype(np.int64), 0, self.rings - 1)
        share = (np.arctan2(v, u) / (2 * np.pi)) % 1.0
        # 6 j + 3 sectors in ring j: alike in area, 3 J² in all.
        sectors = 6 * ring + 3
        return np.asarray(3 * ring**2 + np.minimum((share * sectors).astype(np.int64), sectors - 1))

    def place_in(self, cell: IntArray, share: float) -> tuple[FloatArray, FloatArray]:
        """Return x, y [m] midway along each ``cell`` (n,), with ``share`` of it further in."""
        ring = np.sqrt(cell / 3).astype(np.int64)
        radius = self.disc.radius / self.rings * np.sqrt(ring**2 + share * (2 * ring + 1))
        angle = 2 * np.pi * (cell - 3 * ring**2 + 0.5) / (6 * ring + 3)
        return self.disc.x + radius * np.cos(angle), self.disc.y + radius * np.sin(angle)


def part_model(blocks: Blocks, turns: float, highest: int = HIGHEST_DEGREE) -> PartModel:
    """Return the terms and cells that ``blocks`` resolve.

    turns: of the shortest scan
    """
    ends = [(float(np.min(v)), float(np.max(v))) for v in (blocks.x, blocks.y)]
    x, y = ((low + high) / 2 for low, high in ends)
    extent = max(high - low for low, high in ends) / 2
    if max(abs(x), abs(y)) < _CENTRED * extent:
        x, y = 0.0, 0.0
    radius = float(np.max(np.hypot(blocks.x - x, blocks.y - y)))
    rings = int(np.clip(turns // _TURNS_A_RING, _LEAST_RINGS, _MOST_RINGS))
    terms = terms_up_to(highest)
    resolved = min(int(_WAVES_A_TURN * turns), _FINE_DEGREE)
    if highest == HIGHEST_DEGREE < resolved:
        terms = (
            *(t for t in terms if abs(t.m) <= _HIGHEST_HARMONIC),
            *(t for t in terms_up_to(resolved, highest + 1) if 0 < abs(t.m) <= _LOW_HARMONIC),
        )
    about = np.hypot(blocks.x, blocks.y)
    waves = np.arange(FREE_DEGREE + 1, min(int(_WAVES_A_TURN * turns), _MOST_WAVES) + 1)
    empty = PartModel(
        Aperture(radius, x, y), terms, rings, np.zeros(0, np.int64), 3 * rings**2,
        float(np.min(about)), float(np.max(about)), waves,
    )  # fmt: skip
    return replace(empty, cell=empty.cell_of(blocks.x, blocks.y))


# Amplitudes of turned and of polished parts fall with about the 1.5th power of the degree.
START_POWER = 3.0
# Sizes that are compared, over the plausible one; each is as probable.
_SIZES = 10.0 ** np.arange(-1.5, 1.1, 0.5)
# Share of the largest variance: twenty times what a factorisation of fifty rows loses.
_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False)
class FormTerms:
    """Coefficients of Zernike terms of the form: do they look like an error of the machine?

    A function of Z, where Z follows the part, is the same in all scans as in the part: nothing but
    its shape speaks against it. Errors of form become smaller with their degree, in all directions
    alike, or all rotationally symmetric ones; a form that follows one column of the machine is
    improbable. Two models of the coefficients c are compared by their likelihood, each with its
    best A and p: ``c ~ N(0, A n^-p + C)``, and with the columns S of a family of size w, of which
    the scans have the information I, ``c ~ N(0, A n^-p + C + S (I + w⁻²)⁻¹ Sᵀ)``. n is the degree,
    C the covariance by the adjustment, and A one of symmetric terms and another of all others.

    values: (k,) [m];  covariance: (k, k) [m²];  degrees, symmetric: of the terms (k,)
    """

    values: FloatArray
    covariance: FloatArray
    degrees: IntArray
    symmetric: BoolArray

    def looks_like(self, columns: FloatArray, known: FloatArray) -> tuple[float, FloatArray]:
        """Return twice the logarithm by which a family raises the likelihood, and its values.

        columns: change of the terms by its plausible size (k, size);  known: information that the
            scans have of its values (size, size), which are in units of that size, too
        """
        share, axes = np.linalg.eigh(known)
        gains, found = [], []
        for size in _SIZES:
            root = axes / np.sqrt(np.maximum(share, 0.0) + size**-2)
            likelihood, spread = self._best(columns @ root)
            gains.append(2 * (likelihood - self._alone))
            pulled = scipy.linalg.solve(spread, self.values, assume_a="pos")
            found.append(root @ (root.T @ (columns.T @ pulled)))
        weights = np.exp((np.array(gains) - max(gains)) / 2)
        gain = max(gains) + 2 * np.log(np.mean(weights))
        return float(gain), np.asarray(weights @ np.array(found) / np.sum(weights))

    @cached_property
    def _alone(self) -> float:
        return self._best(np.zeros((len(self.values), 1)))[0]

    def _best(self, columns: FloatArray) -> tuple[float, FloatArray]:
        """Return the largest log likelihood with ``columns`` of unit variance, and its spread."""
        share, axes = np.linalg.eigh(self.covariance + columns @ columns.T)
        # A small scan leaves terms of which only the rounding is known, of either sign.
        known = axes * np.maximum(share, _ROUNDING * share[-1]) @ axes.T
        # About the middle degree: amplitude and power are found apart, not along a narrow valley.
        degrees = self.degrees / np.exp(np.mean(np.log(self.degrees)))
        start = np.log(np.mean(self.values**2 * degrees**START_POWER) + 1e-30)

        def own(law: FloatArray) -> FloatArray:
            amplitude = np.exp(np.where(self.symmetric, law[1], law[0]))
            return np.asarray(amplitude * degrees ** -law[2])

        def misfit(law: FloatArray) -> tuple[float, FloatArray]:
            # Asked for ten thousand times: what checks the matrices would take most of it.
            variances = own(law)
            root, _ = scipy.linalg.lapack.dpotrf(known + np.diag(variances), lower=1)
            pulled, _ = scipy.linalg.lapack.dpotrs(root, self.values, lower=1)
            inverse, _ = scipy.linalg.lapack.dpotri(root, lower=1)
            slopes = variances * (inverse.diagonal() - pulled**2) / 2
            rises = self.symmetric @ slopes
            slope = [slopes.sum() - rises, rises, -slopes @ np.log(degrees)]
            value = np.log(root.diagonal()).sum() + self.values @ pulled / 2
            return float(value), np.array(slope)

        # The law of terms that are zero has no end: 50 is twenty orders of magnitude.
        bounds = [(start - 50, start + 50)] * 2 + [(0.0, 4 * START_POWER)]
        best = scipy.optimize.minimize(misfit, [start, start, START_POWER], method="L-BFGS-B",
                                       jac=True, bounds=bounds)  # fmt: skip
        return -float(best.fun), known + np.diag(own(best.x))
