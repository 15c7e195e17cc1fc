"""The part: Zernike terms, rings about the spindle, and cells for what they do not resolve.

Terms are regular at the axis, which errors of the machine need not be: one scan separates them by
that, except where they are rotationally symmetric. A turned part may have any profile over the
radius, a cone at the centre too: the cone is free, and rings are hat functions of one variance,
estimated from the scans. Without them a ring would pass for an error of the spindle centre, a
drift or a bend of a slide. Cells are random effects of one variance, common to all scans,
eliminated cell by cell.
"""

from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.adjustment.blocks import Blocks
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# Free up to degree 10 (tried: what a turned freeform has beyond is below 2 nm); the variance of
# each degree above is estimated.
FREE_DEGREE, HIGHEST_DEGREE = 10, 24
# Stands for a degree among the variances that are estimated.
RINGS = -1
# Stands for the degrees of rotationally symmetric terms above the free ones: turning leaves them,
# and their variance says nothing of the others.
SYMMETRIC = -2
# A tool that misses the centre turns a cone: power of the radius, not a degree of a term.
_CONE = 1
# Knots over the radius, a turn apart at least.
_MOST_KNOTS, _TURNS_A_KNOT = 64, 1
# A form that large is no form error of a finished part: no prior at all.
_FREE_M = 1e-5
# Of the radius: a spiral about the axis begins and ends within a pitch of where it should.
_CENTRED = 0.03
# Rings of half a millimetre on a part of 25 mm; two turns at least in a ring.
_MOST_RINGS, _TURNS_A_RING, _LEAST_RINGS = 24, 2, 3


@dataclass(frozen=True, eq=False)
class PartModel:
    """Terms and cells of the part.

    disc: that the terms are defined on;  terms: from degree 0
    inner, outer: radii about the spindle between which rings are [m];  ring_knots: their number
    rings: of the cells;  cell: of each block (b,);  cells: their number
    """

    disc: Aperture
    terms: tuple[ZernikeIndex, ...]
    rings: int
    cell: IntArray
    cells: int
    inner: float
    outer: float
    ring_knots: int

    def values(self, x: FloatArray, y: FloatArray, span: FloatArray | None = None) -> FloatArray:
        """Return terms, cone and rings at x, y [m], (n, k), terms averaged over arcs ``span``
        [rad]."""
        made = np.ascontiguousarray(zernike_values(*self.disc.scaled(x, y), self.terms).T)
        if span is not None:
            order = np.array([abs(t.m) for t in self.terms])
            for m in np.unique(order):
                made[:, order == m] *= np.sinc(span * m / (2 * np.pi))[:, np.newaxis]
        radius = np.hypot(x, y)
        cone = (radius / self.outer)[:, np.newaxis]
        return np.concatenate([made, cone, self._hats(radius)], axis=1)

    def _hats(self, radius: FloatArray) -> FloatArray:
        """Return hat functions of the radius about the spindle [m], (n, ring_knots)."""
        made = np.zeros((len(radius), self.ring_knots))
        place = np.clip(
            (radius - self.inner) / (self.outer - self.inner) * (self.ring_knots - 1),
            0.0,
            self.ring_knots - 1 - 1e-9,
        )
        left = place.astype(np.int64)
        row = np.arange(len(radius))
        made[row, left], made[row, left + 1] = 1 - (place - left), place - left
        return made

    @property
    def free(self) -> FloatArray:
        """Standard deviations where nothing is known [m]; 0 for those that are estimated."""
        terms = [_FREE_M if t.n <= FREE_DEGREE else 0.0 for t in self.terms]
        return np.array([*terms, _FREE_M, *np.zeros(self.ring_knots)])

    @property
    def degrees(self) -> IntArray:
        """Degree of each term and of the cone, ``SYMMETRIC`` or ``RINGS`` instead, (k,)."""
        rings = np.full(self.ring_knots, RINGS)
        terms = [SYMMETRIC if t.m == 0 and t.n > FREE_DEGREE else t.n for t in self.terms]
        return np.array([*terms, _CONE, *rings])

    def cell_of(self, x: FloatArray, y: FloatArray) -> IntArray:
        """Return the number of the cell at x, y [m] among all of the disc, (n,)."""
        u, v = self.disc.scaled(x, y)
        ring = np.clip((np.hypot(u, v) * self.rings).astype(np.int64), 0, self.rings - 1)
        share = (np.arctan2(v, u) / (2 * np.pi)) % 1.0
        # 6 j + 3 sectors in ring j: alike in area, 3 J² in all.
        sectors = 6 * ring + 3
        return np.asarray(3 * ring**2 + np.minimum((share * sectors).astype(np.int64), sectors - 1))


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
    about = np.hypot(blocks.x, blocks.y)
    knots = int(np.clip(turns // _TURNS_A_KNOT, 4, _MOST_KNOTS))
    empty = PartModel(
        Aperture(radius, x, y), terms, rings, np.zeros(0, np.int64), 3 * rings**2,
        float(np.min(about)), float(np.max(about)), knots,
    )  # fmt: skip
    return replace(empty, cell=empty.cell_of(blocks.x, blocks.y))
