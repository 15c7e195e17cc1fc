"""How does the part sit? The pose in which scattered points lie best on their nominal surface.

Gauss–Newton with exact derivatives on an even selection of the points until the pose stands, then
one pass over all of them; sums of products of the columns are all that is kept, so memory does not
grow with the scan. Beside the pose the fit allows for the part's own form error, see
:mod:`omsm_ros.core.surface.form_model`; dust is left out by its distance from that smooth form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples import scatter
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.core.samples.even_selection import EvenSelection
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.core.surface.form_model import (
    LEAST_LIMIT_M,
    Estimate,
    FormBasis,
    estimate,
    limit_of,
    most_like,
    relaxed,
)
from omsm_ros.core.surface.freedoms import Freedoms, determined, widest
from omsm_ros.core.surface.normal_equations import NormalEquations
from omsm_ros.core.surface.placement import (
    FREEDOMS,
    Aperture,
    Placed,
    Placement,
    Portion,
    Portions,
    freedom_columns,
    placed,
)
from omsm_ros.core.surface.posed import PosedSurface
from omsm_ros.errors import DataError

# Points at a time: 7 freedoms and 42 polynomials of each are 6 MB.
CHUNK = 16_384
# Four points for each of these columns are the least.
_MOST_SELECTED, _LEAST_POINTS = 40_000, 200
_MOST_TURNS, _MOST_REFINED = 30, 30
_ENOUGH_FOR_A_CURVE = 2000
# A pose stands when its last step moved no point by more than this share of their spread.
_SHARE_OF_SPREAD, _SETTLED_M = 1e-2, 1e-10


@dataclass(frozen=True, eq=False, kw_only=True)
class Registration:
    """How the part sits, and how well that is known.

    placement: of the part;  freedoms: what was fitted, and what could not be
    covariance: of the fitted ones, from noise, form and systematic sources (p, p)
    from_source: standard uncertainty of each (p,) by where it comes from
    pose_effects: steps of the freedoms (p, p), each of an independent part of the pose's own error
    moved: by how much each systematic source, off by its uncertainty, moves the freedoms (p, s)
    limit: deviation from the smooth form beyond which a point is an outlier [m]
    disc: the aperture, or what holds all points;  form: the smooth form in its basis (k,) [m rms]
    noise: of one point about the smooth form [m];  before: rms deviation before the fit [m]
    """

    placement: Placement
    freedoms: Freedoms
    covariance: FloatArray
    from_source: dict[str, FloatArray]
    pose_effects: FloatArray
    moved: FloatArray
    limit: float
    disc: Aperture
    basis: FormBasis
    form: FloatArray
    noise: float
    before: float

    def uncertainty(self, freedom: str) -> float | None:
        """Return the standard uncertainty of a freedom, None if it was held.

        One that the surface does not determine may be anything that a hand leaves it at.
        """
        if freedom in self.freedoms.refused:
            return widest(freedom)
        if freedom not in self.freedoms.fitted:
            return None
        place = self.freedoms.fitted.index(freedom)
        return float(np.sqrt(self.covariance[place, place]))

    def good(self, points: Placed) -> BoolArray:
        """Return which points (n,) are no outliers."""
        smooth = self.form @ self.basis.columns(points.x, points.y)
        return np.asarray(np.abs(points.deviation - smooth) <= self.limit)


def register(
    surface: Surface,
    portions: Portions,
    asked: Sequence[str],
    *,
    sources: Sequence[str] = (),
    aperture: Aperture | None = None,
    even: bool = False,
) -> Registration:
    """Fit the freedoms ``asked`` for, or "auto", of a part whose nominal is ``surface``.

    portions: reads the points, whose ``systematic`` rows are named by ``sources``
    aperture: of the part, beyond which points do not count; None for all of them
    even: the points are those of an evenly spaced grid

    Raises DataError for too few points, a freedom that the surface does not determine, or a fit
    that does not converge.
    """
    chosen = _selection(portions)
    start = Placement()
    first = _usable(placed(surface, start, chosen), aperture)
    if len(first.x) < _LEAST_POINTS:
        raise DataError(
            f"{len(first.x)} points lie on the nominal surface, expected {_LEAST_POINTS} or more; "
            "check its parameters, the aperture and the units of the cloud"
        )
    columns = freedom_columns(start, first, FREEDOMS)
    freedoms = determined(asked, columns @ columns.T, len(first.x))
    at = _coarse(surface, chosen, freedoms.fitted, aperture, start)
    points = _usable(placed(surface, at, chosen), aperture)
    disc = aperture or _about_the_origin(points)
    basis = FormBasis.over(points.x, points.y, area_weights(points.x, points.y, even=even), disc)
    fit = _Fit(surface, freedoms, aperture, basis)
    at, like, limit = fit.refine(at, chosen)
    unknown = fit.unknown(at, chosen)
    return _over_all(fit, at, like, limit, portions, sources, unknown)


def _selection(portions: Portions) -> Portion:
    """Return points evenly chosen from all, without their systematic effects."""
    kept, count = EvenSelection(_MOST_SELECTED), 0
    for portion in portions():
        kept.add(np.stack([portion.x, portion.y, portion.height], axis=1))
        count += len(portion.x)
    if not count:
        raise DataError("0 points: there is nothing to register; check the cloud")
    x, y, height = kept.rows().T
    return Portion(x, y, height, np.empty((0, len(x))))


def _usable(points: Placed, aperture: Aperture | None) -> Placed:
    """Return the points with a deviation that lie within the aperture."""
    good = np.isfinite(points.deviation)
    if aperture is not None:
        good &= aperture.holds(points.x, points.y)
    return points.part(good)


def _about_the_origin(points: Placed) -> Aperture:
    """Return the disc about the part's origin that holds all points.

    About their middle where the origin lies outside of them.
    """
    ends = [(float(v.min()), float(v.max())) for v in (points.x, points.y)]
    inside = all(low < 0 < high for low, high in ends)
    x, y = (0.0, 0.0) if inside else ((low + high) / 2 for low, high in ends)
    return Aperture(float(np.hypot(points.x - x, points.y - y).max()) or 1.0, x, y)


def _coarse(
    surface: Surface,
    chosen: Portion,
    names: Sequence[str],
    aperture: Aperture | None,
    at: Placement,
) -> Placement:
    """Return the placement of least squares, points far from the others left out."""
    for turn in range(_MOST_TURNS):
        points = _usable(placed(surface, at, chosen), aperture)
        if turn:
            middle = points.deviation - np.median(points.deviation)
            # Generous: what is left here is still the pose.
            points = points.part(np.abs(middle) <= max(8 * scatter.spread(middle), LEAST_LIMIT_M))
        if len(points.x) < _LEAST_POINTS:
            break
        columns = -freedom_columns(at, points, names)
        scale = np.sqrt(np.mean(columns**2, axis=1))
        step = np.linalg.lstsq((columns / scale[:, np.newaxis]).T, points.deviation, rcond=1e-12)
        at = at.moved(names, step[0] / scale)
        # The refinement that follows converges from far more.
        settled = max(_SHARE_OF_SPREAD * scatter.spread(points.deviation), _SETTLED_M)
        if turn > 1 and float(np.max(np.abs(step[0]))) < settled:
            return at
    raise DataError(
        "the points do not settle on the nominal surface; check its parameters, the sign of its "
        "radii and the units of the cloud, or fit fewer freedoms"
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """What stays the same over the passes."""

    surface: Surface
    freedoms: Freedoms
    aperture: Aperture | None
    basis: FormBasis

    @property
    def names(self) -> tuple[str, ...]:
        return self.freedoms.fitted

    def new_sums(self, sources: int) -> NormalEquations:
        return NormalEquations(len(self.names) + len(self.basis), sources)

    def unknown(self, at: Placement, chosen: Portion) -> dict[str, FloatArray]:
        """Return what each freedom that the surface does not determine does to the others (2, p).

        They follow it along a curve: a surface without errors, in the pose found, is fitted once
        more where the freedom is off by as much as it may be to either side. Half the difference
        of the two, and their mean, are the first and second order.
        """
        every = max(len(chosen.x) // _ENOUGH_FOR_A_CURVE, 1)
        few = Portion(*(v[..., ::every] for v in chosen))
        few = few._replace(height=PosedSurface(self.surface, at.pose).height(few.x, few.y))
        few = Portion(*(v[..., np.isfinite(few.height)] for v in few))
        rigid = replace(at, power=0.0)
        found = {}
        for name in self.freedoms.refused:
            ends = [
                _coarse(self.surface, few, self.names, None, rigid.moved([name], np.array([off])))
                for off in (widest(name), -widest(name))
            ]
            moves = [[e.value(n) - rigid.value(n) for n in self.names] for e in ends]
            high, low = np.array(moves)
            found[name] = np.stack([(high - low) / 2, (high + low) / 2])
        return found

    def sums(
        self, at: Placement, portion: Portion, like: FloatArray, limit: float, sums: NormalEquations
    ) -> None:
        """Add a portion's points to ``sums``, residuals from the sum ``like`` of columns."""
        for begin in range(0, len(portion.x), CHUNK):
            part = Portion(*(v[..., begin : begin + CHUNK] for v in portion))
            whole = placed(self.surface, at, part)
            good = np.isfinite(whole.deviation)
            if self.aperture is not None:
                good &= self.aperture.holds(whole.x, whole.y)
            points = whole.part(good)
            systematic = part.systematic[:, good] * points.normal[2]
            z = self.basis.columns(points.x, points.y)
            columns = np.concatenate([-freedom_columns(at, points, self.names), z])
            residual = points.deviation - like @ columns
            near = np.abs(residual) <= limit
            sums.add(columns[:, near], points.deviation[near], systematic[:, near], residual[near])

    def solved(self, sums: NormalEquations) -> tuple[Estimate, float]:
        """Return the estimate, and the variance of one point's noise [m²]."""
        free = len(self.names)
        variance = sums.square / max(sums.points - sums.columns, 1)
        own = np.diag(sums.gram)[free:]
        # Errors that hang together average out more slowly: so much more of them is left.
        together = float(np.mean(sums.scores[free:] / own)) / variance if variance > 0 else 1.0
        square = sums.gram[:, : sums.columns]
        moments, largest = sums.gram[:, sums.columns], sums.total / max(sums.points, 1)
        found = estimate(square, moments, variance * max(together, 1.0), largest, self.basis.group)
        return found, variance

    def refine(self, at: Placement, chosen: Portion) -> tuple[Placement, FloatArray, float]:
        """Return the placement that stands, what columns are most like there, and the dust's limit.

        Raises DataError if none does.
        """
        share, last = 1.0, np.zeros(len(self.names))
        for turn in range(_MOST_REFINED):
            points = _usable(placed(self.surface, at, chosen), self.aperture)
            z = self.basis.columns(points.x, points.y)
            columns = np.concatenate([-freedom_columns(at, points, self.names), z])
            like, limit = most_like(columns, points.deviation)
            residual = points.deviation - like @ columns
            near = np.abs(residual) <= limit
            none = np.empty((0, int(near.sum())))
            sums = self.new_sums(0)
            sums.add(columns[:, near], points.deviation[near], none, residual[near])
            found, _ = self.solved(sums)
            own = np.sqrt(np.diag(sums.gram)[: len(self.names)] / sums.points)
            step = found.step * own
            settled = max(_SHARE_OF_SPREAD * scatter.spread(residual), LEAST_LIMIT_M)
            if turn > 3 and float(np.max(np.abs(step))) < settled:
                smooth = np.concatenate([found.step, found.form]) @ columns
                return at, like, limit_of(points.deviation - smooth)
            share, last = relaxed(share, last, step), step
            at = at.moved(self.names, share * found.step)
        raise DataError(
            "the pose does not settle: on these points it and the part's form look alike; hold "
            "what need not be fitted, as --fit piston,tip,tilt"
        )


def _over_all(
    fit: _Fit,
    at: Placement,
    like: FloatArray,
    limit: float,
    portions: Portions,
    sources: Sequence[str],
    unknown: dict[str, FloatArray],
) -> Registration:
    """Return the registration by all points, from one pass over them at a pose that stands."""
    free = len(fit.names)
    sums = fit.new_sums(len(sources))
    square = points = 0.0
    for portion in portions():
        fit.sums(at, portion, like, limit, sums)
        before = placed(fit.surface, Placement(), portion).deviation
        square += float(np.nansum(before**2))
        points += float(np.sum(np.isfinite(before)))
    found, variance = fit.solved(sums)
    gain = found.covariance[:free] / found.noise
    # A source that is off by its standard uncertainty moves the pose by one of these columns.
    moved = gain @ sums.gram[:, sums.columns + 1 :]
    covariance = found.covariance[:free, :free]
    by_source = {"noise and form": np.sqrt(np.diag(covariance))}
    for k, name in enumerate(sources):  # of one source there may be several independent effects
        by_source[name] = np.hypot(by_source.get(name, 0.0), moved[:, k])
    by_source |= {name: np.sqrt(np.sum(moves**2, axis=0)) for name, moves in unknown.items()}
    together = np.vstack([moved.T, *unknown.values()])
    return Registration(
        placement=at.moved(fit.names, found.step),
        freedoms=fit.freedoms,
        covariance=covariance + together.T @ together,
        from_source=by_source,
        pose_effects=_root(covariance),
        moved=moved,
        limit=limit,
        disc=fit.basis.disc,
        basis=fit.basis,
        form=found.form,
        noise=float(np.sqrt(variance)),
        before=float(np.sqrt(square / max(points, 1.0))),
    )


def _root(covariance: FloatArray) -> FloatArray:
    """Return rows (p, p) whose outer products add up to the covariance."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray((np.sqrt(np.maximum(values, 0.0)) * vectors).T * scale, np.float64)
