"""Fit the pose in which scattered points lie best on their nominal surface.

Gauss-Newton with exact derivatives on an even selection of the points until the pose converges,
then one pass over all points. Only sums of products are kept, so memory does not grow with the
scan. The fit includes the part's form error, see :mod:`omsm_ros.core.registration.form_model`;
points far from the smooth form (dust) are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.registration import form_model
from omsm_ros.core.registration.isolated_points import ISOLATED, DustRule, FarPoints
from omsm_ros.core.registration.placement import (
    POSE_PARAMETERS,
    Placed,
    Placement,
    PointBatch,
    PointBatches,
    dof_columns,
    inside_aperture,
    least_points,
    placed,
    selection,
)
from omsm_ros.core.registration.pose_parameters import (
    AUTO,
    HELD,
    OpenUncertainty,
    PoseParameters,
    Registration,
    determined_dofs,
    held_dof_effects,
    root_of,
    shape_asked,
    shares_of,
    typical_range,
    weakest_dof,
)
from omsm_ros.core.streams import statistics
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aperture import Aperture, disc_of, within_aperture
from omsm_ros.core.surface.area_weights import area_weights, covered_places, errors_at_gaps
from omsm_ros.core.surface.posed import PosedSurface
from omsm_ros.core.surface.shape_parameters import start_of
from omsm_ros.errors import DataError

# With the refinement that follows, spheres and off-axis paraboloids with form took 12 to 36
# iterations. Later steps are smaller: whole ones may go to and fro, and let points in and out.
_WHOLE_STEPS, _MOST_TURNS = 30, 40
# A pose has converged when its last step moved the points by less than this share of their spread.
SHARE_OF_SPREAD, _SETTLED_M = 1e-2, 1e-10


def coarse_placement(
    surface: Surface, chosen: PointBatch, names: Sequence[str], aperture: Aperture | None,
    at: Placement,
) -> Placement:  # fmt: skip
    """Return the least-squares placement without outliers, the start of the fit with form."""
    for turn in range(_MOST_TURNS):
        points = inside_aperture(placed(surface, at, chosen), aperture)
        if turn and len(points.x):
            middle = points.deviation - np.median(points.deviation)
            # The limit is wide, because the pose still contributes to the spread.
            limit = max(8 * statistics.spread(middle), form_model.LEAST_LIMIT_M)
            points = points.part(np.abs(middle) <= limit)
        if len(points.x) < least_points(points):
            break
        columns = -dof_columns(at, points, names)
        scale = np.sqrt(np.mean(columns**2, axis=1))
        columns /= scale[:, np.newaxis]
        step = _bounded_step(
            columns, points.deviation, np.array([at.value(n) for n in names]) * scale,
            [typical_range(n) for n in names] * scale,
        )  # fmt: skip
        step /= max(turn - _WHOLE_STEPS, 1)
        at = at.moved(names, step / scale)
        settled = max(SHARE_OF_SPREAD * statistics.spread(points.deviation), _SETTLED_M)
        # The joint effect counts: a tilt may cancel a shift.
        moved = float(np.sqrt(np.mean((step @ columns) ** 2)))
        if turn > 1 and moved < settled:
            return at
    raise DataError("registration.not_converged")


def _bounded_step(
    columns: FloatArray, deviation: FloatArray, at: FloatArray, widest_: FloatArray
) -> FloatArray:
    """Return the regularised least-squares step (p,) along ``columns`` (p, n).

    The residual, mostly form, is correlated over the part. A pose parameter with a smaller
    effect than the residual is therefore held near zero, within its plausible offset.

    at: present values;  widest_: plausible offsets;  both (p,), in the unit of the step
    """
    free = np.linalg.lstsq(columns.T, deviation, rcond=1e-12)[0]
    form = float(np.sqrt(np.mean((deviation - free @ columns) ** 2)))
    weight = np.sqrt(len(deviation)) * form / widest_
    rows = np.concatenate([columns.T, np.diag(weight)])
    found = np.linalg.lstsq(rows, np.concatenate([deviation, -weight * at]), rcond=1e-12)
    return np.asarray(found[0], np.float64)


# Points at a time: 49 columns of them are 6 MB.
CHUNK = 16_384
_MOST_SELECTED, _MOST_OF_BASIS, _MOST_REFINED = 40_000, 10_000, 30
# Tracks of a scan that covers an area; the next one lies within this many distances of tracks.
_FEWEST_TRACKS, _NEXT_TRACK = 4, 1.5
# Points without errors, for seven unknowns.
_ENOUGH_FOR_A_CURVE = 2000
# A pose has converged too when its last step is below this share of its uncertainty: where form
# and pose look alike, the estimate oscillates by a twentieth of it.
_SHARE_OF_UNCERTAINTY = 0.1


def register(
    surface: Surface, portions: PointBatches, asked: Sequence[str], *, sources: Sequence[str] = (),
    aperture: Aperture | None = None, even: bool = False, dust: DustRule = ISOLATED,
    declared: Mapping[str, float] = MappingProxyType({}),
) -> Registration:  # fmt: skip
    """Fit the pose parameters ``asked`` for, or "auto", of a part to its nominal ``surface``.

    portions: reads the points;  sources: names of their ``systematic`` rows
    aperture: of the part, beyond which points are ignored; None for all points
    even: the points form an evenly spaced grid
    dust: which points far from the smooth form are left out
    declared: standard uncertainties of the placement by pose parameter [m], [rad]

    Raises DataError for too few points, a pose parameter that the surface does not determine,
    or a fit that does not converge.
    """
    surface, aperture = within_aperture(surface, aperture)
    chosen, shape = selection(portions, _MOST_SELECTED), shape_asked(asked)
    start, vertex = start_of(surface, shape, *chosen[:3]) if shape else ({}, np.zeros(2))
    if {"x", "y"} & set(declared):
        vertex = np.zeros(2)
    chosen, near = _about(vertex, chosen), lambda: (_about(vertex, p) for p in portions())
    at = Placement(shape=tuple(start.items()))
    dofs = _determined(surface, chosen, asked, aperture, at, declared)
    # A conic constant decides what the surface determines.
    if seat := [n for n in dofs.fitted if n in (*POSE_PARAMETERS[:3], *shape)]:
        at = coarse_placement(surface, chosen, seat, aperture, at)
        dofs = _determined(surface, chosen, asked, aperture, at, declared)
    at = coarse_placement(surface, chosen, dofs.fitted, aperture, at)
    points = inside_aperture(placed(surface, at, chosen), aperture)
    disc = aperture.disc if aperture else disc_of(points.x, points.y)
    x, y, area = _measured_area(points.x, points.y, aperture or disc, even)
    basis = form_model.FormBasis.over(x, y, area, disc)
    fit = _PoseFit(surface, dofs, aperture, basis, at, even)
    stand = fit.refine(at, chosen)
    open_ = OpenUncertainty(fit.unknown(stand.at, chosen))
    if AUTO in asked:
        fit, stand, open_ = _useful(fit, stand, chosen, asked, open_)
    if aperture is None:
        points = inside_aperture(placed(surface, stand.at, chosen), None)
        disc = disc_of(points.x, points.y)
    found = _over_all(fit, stand, near, sources, open_, dust, disc)
    return replace(found, placement=found.placement.moved(("x", "y"), vertex))


def _measured_area(x: FloatArray, y: FloatArray, outline: Aperture, even: bool) -> FloatArray:
    """Return places x, y [m] and areas whose sums are integrals over what points cover (3, k).

    Where points x, y (n,) [m] cover the ``outline``, these are its nodes, else an even grid: areas
    of single points are not exact, so that coma would have a tilt.
    """
    nodes, step = outline.nodes(), float(np.median(np.hypot(np.diff(x), np.diff(y))))
    whole, path = float(np.sum(nodes[2])), step * len(x)  # a jump to the next line is no part of it
    track = max(float(np.sqrt(whole / len(x))), whole / (path or np.inf))
    if whole and min(np.ptp(x), np.ptp(y)) > _FEWEST_TRACKS * track:
        away, _ = scipy.spatial.cKDTree(np.column_stack([x, y])).query(nodes[:2].T)
        if np.max(away) < _NEXT_TRACK * track:
            return nodes
        if not even:
            grid = covered_places(x, y, outline)
            return np.append(grid, np.ones((1, grid.shape[1])), axis=0)
    x, y = (v[:: -(-len(v) // _MOST_OF_BASIS)] for v in (x, y))
    return np.stack([x, y, area_weights(x, y, even=even, outline=outline)])


def _about(vertex: FloatArray, portion: PointBatch) -> PointBatch:
    """Return points from the place x, y of the ``vertex`` (2,) [m]."""
    return portion._replace(x=portion.x - vertex[0], y=portion.y - vertex[1])


def _determined(
    surface: Surface, chosen: PointBatch, asked: Sequence[str], aperture: Aperture | None,
    at: Placement, declared: Mapping[str, float],
) -> PoseParameters:  # fmt: skip
    """Return which pose parameters the surface determines where the part is ``at``.

    Points on an untilted surface decide, because on a tilted one all rotations and shifts mix.
    """
    points = inside_aperture(placed(surface, at, chosen), aperture)
    level = Placement(shape=at.shape)
    height = level.of(surface).height(points.x, points.y)
    on_it = placed(surface, level, PointBatch(points.x, points.y, height, chosen.systematic[:0]))
    columns = dof_columns(level, on_it, (*POSE_PARAMETERS, *shape_asked(asked)))
    return determined_dofs(asked, columns @ columns.T, len(points.x), declared)


class _PlacementState(NamedTuple):
    """Converged fit of the selected points.

    at: placement;  like: coefficients of the free fit there (q,);  limit: of outliers [m]
    found, sums: estimate and its normal equations;  points, columns: of these (n,), (q, n)
    """

    at: Placement
    like: FloatArray
    limit: float
    found: form_model.Estimate
    sums: form_model.FormNormalEquations
    points: Placed
    columns: FloatArray


def _useful(
    fit: _PoseFit, stand: _PlacementState, chosen: PointBatch, asked: Sequence[str],
    open_: OpenUncertainty,
) -> tuple[_PoseFit, _PlacementState, OpenUncertainty]:  # fmt: skip
    """Hold the moves that were not asked for by name and that the points hardly determine."""
    first, names = stand, fit.dofs.fitted
    while True:
        fitted, free = fit.dofs.fitted, len(fit.dofs.fitted)
        values = np.array([stand.at.value(n) for n in fitted])
        covariance = stand.found.covariance[:free, :free]
        gram = stand.sums.gram[:free, :free] / stand.sums.points
        if (weak := weakest_dof(fit.dofs, asked, values, covariance, gram)) is None:
            break
        less = replace(fit, dofs=fit.dofs.without(*weak))
        back = stand.at.moved([weak[0]], np.array([-stand.at.value(weak[0])]))
        try:
            back = coarse_placement(fit.surface, chosen, less.dofs.fitted, fit.aperture, back)
            fixed = less.refine(back, chosen)
        except DataError:
            break
        # A nominal value that the points contradict takes what is asked for far away.
        away = np.abs([fixed.at.value(n) for n in fitted] - values)
        beyond = away > form_model.OUTLIER_SIGMAS * np.sqrt(np.diag(covariance))
        if np.any(beyond & np.isin(fitted, asked)):
            break
        fit, stand = less, fixed
    values = np.array([first.at.value(name) for name in names])
    covariance = first.found.covariance[: len(names), : len(names)]
    held = [names.index(n) for n in fit.dofs.held]
    square = covariance[np.ix_(held, held)] + np.outer(values[held], values[held])
    most = np.array([fit.dofs.declared.get(n, np.inf) for n in fit.dofs.held])
    less = np.minimum(most / np.sqrt(np.diag(square)), 1.0)
    square *= np.outer(less, less)
    return fit, stand, open_._replace(held=square)


@dataclass(frozen=True, eq=False)
class _PoseFit:
    """Fixed inputs of the passes;  plain: the least-squares placement;  even: points of a grid."""

    surface: Surface
    dofs: PoseParameters
    aperture: Aperture | None
    basis: form_model.FormBasis
    plain: Placement
    even: bool

    def unknown(self, at: Placement, chosen: PointBatch) -> dict[str, dict[str, FloatArray]]:
        """Return the effect (2,) of each undetermined pose parameter on each fitted one.

        A surface without errors is fitted again with the undetermined one at its largest plausible
        offset to either side. Half the difference and the mean of both are the first and second
        order.
        """
        every = max(len(chosen.x) // _ENOUGH_FOR_A_CURVE, 1)
        few = PointBatch(*(v[..., ::every] for v in chosen))
        few = few._replace(height=PosedSurface(at.of(self.surface), at.pose).height(few.x, few.y))
        few = PointBatch(*(v[..., np.isfinite(few.height)] for v in few))
        rigid = replace(at, power=0.0)
        found: dict[str, dict[str, FloatArray]] = {}
        for name in self.dofs.refused:
            offsets = np.array([[1.0], [-1.0]]) * self.dofs.range(name)
            starts = (rigid.moved([name], offset) for offset in offsets)
            fitted = self.dofs.fitted
            ends = [coarse_placement(self.surface, few, fitted, None, start) for start in starts]
            found[name] = {}
            for n in self.dofs.fitted:
                high, low = (end.value(n) - rigid.value(n) for end in ends)
                found[name][n] = np.array([(high - low) / 2, (high + low) / 2])
        return found

    def sums(
        self, stand: _PlacementState, portion: PointBatch, held_effects: FloatArray,
        sums: form_model.FormNormalEquations, far: FarPoints | None = None,
    ) -> PointBatch:  # fmt: skip
        """Add the points of a ``portion`` to ``sums``, with residuals from the free fit.

        Returns those beyond the outlier limit; with ``far`` they are recorded there and not added.
        """
        at, names, free = stand.at, tuple(self.dofs.held), len(self.dofs.fitted)
        beyond, begin = np.zeros(len(portion.x), bool), 0
        mix = np.eye(free + len(self.basis), free + self.basis.mix.shape[1])
        mix[free:, free:] = self.basis.mix
        like = stand.like @ mix
        for part in portion.chunks(CHUNK):
            whole = placed(self.surface, at, part)
            good = np.isfinite(whole.deviation)
            if self.aperture is not None:
                good &= self.aperture.holds(whole.x, whole.y)
            points = whole.part(good)
            held = held_dof_effects(self.surface, at, points, names, held_effects)
            systematic = np.concatenate([part.systematic[:, good] * points.normal[2], held])
            terms = self.basis.terms(points.x, points.y)
            columns = np.concatenate([-dof_columns(at, points, self.dofs.fitted), terms])
            residual = points.deviation - like @ columns
            near = None
            if far is not None:
                near = ~far.add(points, residual, good)
                beyond[begin + np.flatnonzero(good)[~near]] = True
            sums.add(columns, points.deviation, systematic, residual, near, mix=mix)
            begin += len(good)
        return PointBatch(*(v[..., beyond] for v in portion))

    def solved(
        self, at: Placement, sums: form_model.FormNormalEquations
    ) -> tuple[form_model.Estimate, float]:
        """Return the estimate, and the variance of one point's noise [m²]."""
        free = len(self.dofs.fitted)
        variance = sums.square / max(sums.points - sums.columns, 1)
        own = np.diag(sums.gram)[free:]
        # Correlated errors average out more slowly, by this factor of their variance.
        together = float(np.mean(sums.scores[free:] / own)) / variance if variance > 0 else 1.0
        square = sums.gram[:, : sums.columns]
        moments = sums.gram[:, sums.columns]
        # Deviations that a step of the pose corrects do not show how large the form is.
        scale = np.sqrt(np.diag(square)[:free])
        pose, right = square[:free, :free] / np.outer(scale, scale), moments[:free] / scale
        left = sums.total - float(right @ np.linalg.lstsq(pose, right, rcond=1e-12)[0])
        largest = max(left, sums.square) / max(sums.points, 1)
        noise, expected = variance * max(together, 1.0), self.expected(at)
        found = form_model.estimate(square, moments, noise, largest, self.basis.group, expected)
        return found, variance

    def at_gaps(
        self, stand: _PlacementState, found: form_model.Estimate, count: int, track: float
    ) -> FloatArray:
        """Return steps of the pose (p, g) by which the ends of the measured area are uncertain.

        Form has no piston and tilts over it.  found: from ``count`` points;  track: distance [m]
        """
        if self.even:
            return np.empty((len(found.step), 0))
        points, disc = stand.points, self.basis.disc
        # A guessed outline ends at the points.
        outline = self.aperture or replace(disc, radius=disc.radius + 2 * track)
        at_gaps = errors_at_gaps(points.x, points.y, outline, track)
        level = self.basis.level @ self.basis.terms(points.x, points.y)
        form = points.deviation - stand.found.step @ stand.columns[: len(found.step)]
        moments = stand.columns @ level.T @ at_gaps(level * form).T * count / len(form)
        return np.asarray(found.covariance[: len(found.step)] / found.noise @ moments)

    def expected(self, at: Placement) -> tuple[FloatArray, FloatArray]:
        """Return the values of the pose and the standard deviations of their priors, both (p,).

        A larger offset in the least-squares fit widens the prior, unless it is declared.
        """
        known = self.dofs.declared
        first = [0.0 if n in known else abs(self.plain.value(n)) for n in self.dofs.fitted]
        value = np.array([at.value(n) for n in self.dofs.fitted])
        return value, np.maximum([self.dofs.range(n) for n in self.dofs.fitted], first)

    def refine(self, at: Placement, chosen: PointBatch) -> _PlacementState:
        """Return the converged fit; raise DataError if there is none."""
        for turn in range(_MOST_REFINED):
            points = inside_aperture(placed(self.surface, at, chosen), self.aperture)
            z = self.basis.columns(points.x, points.y)
            columns = np.concatenate([-dof_columns(at, points, self.dofs.fitted), z])
            like, residual, near, gram = form_model.best_matching_sum(columns, points.deviation)
            sums = form_model.FormNormalEquations(len(self.dofs.fitted) + len(self.basis), 0)
            sums.add(columns, points.deviation, np.empty((0, len(near))), residual, near, gram)
            found, _ = self.solved(at, sums)
            settled = max(SHARE_OF_SPREAD * statistics.spread(residual), form_model.LEAST_LIMIT_M)
            # The joint effect counts: a tilt may cancel a shift.
            gram = sums.gram[: len(found.step), : len(found.step)]
            square = float(found.step @ gram @ found.step) / sums.points
            still = square < settled**2 or found.length < _SHARE_OF_UNCERTAINTY
            if turn > 1 and still:
                smooth = np.concatenate([found.step, found.form]) @ columns
                limit = form_model.outlier_limit(points.deviation - smooth)
                return _PlacementState(at, like, limit, found, sums, points, columns)
            # A longer step than the deviation corrects none of it: form would have to cancel it.
            longest = sums.total / sums.points / max(square, float(np.finfo(np.float64).tiny))
            share = min(1.0, float(np.sqrt(longest)))
            at = at.moved(self.dofs.fitted, share * found.step)
        raise DataError(form_model.NOT_SETTLED)


def _over_all(
    fit: _PoseFit, stand: _PlacementState, portions: PointBatches, sources: Sequence[str],
    open_: OpenUncertainty, dust: DustRule, disc: Aperture,
) -> Registration:  # fmt: skip
    """Return the registration from one pass over all points, in which dust comes last."""
    free, held = len(fit.dofs.fitted), root_of(open_.held)
    sums = form_model.FormNormalEquations(free + len(fit.basis), len(sources) + 2 * len(held))
    square, points, far, beyond = 0.0, 0.0, FarPoints(stand.limit), []
    for portion in portions():
        beyond.append(fit.sums(stand, portion, held, sums, far))
        for part in portion.chunks(CHUNK):
            before = placed(stand.at.of(fit.surface), Placement(), part).deviation
            square += float(np.nansum(before**2))
            points += float(np.sum(np.isfinite(before)))
    left_out, form = far.dust(dust)
    for portion in beyond:
        chosen, form = form[: len(portion.x)], form[len(portion.x) :]
        fit.sums(stand, PointBatch(*(v[..., chosen] for v in portion)), held, sums)
    found, variance = fit.solved(stand.at, sums)
    # Each column is the step of the pose for one standard uncertainty of a source.
    moved = found.covariance[:free] / found.noise @ sums.gram[:, sums.columns + 1 :]
    spacing, names = far.space().spacing, (*sources, *[HELD] * 2 * len(held))
    at_gaps = fit.at_gaps(stand, found, sums.points, spacing)
    covariance = found.covariance[:free, :free] + at_gaps @ at_gaps.T
    by_source = open_.by_source(fit.dofs.fitted, covariance, names, moved)
    at = stand.at.moved(fit.dofs.fitted, found.step)
    return Registration(
        surface=at.of(fit.surface), placement=at, dofs=fit.dofs, from_source=by_source,
        pose_effects=root_of(covariance), taken=shares_of(root_of(covariance), found.likely),
        held_effects=held, moved=moved, spread=open_.spread(fit.dofs, by_source),
        correlated_moves=open_.unknown, limit=stand.limit, dust=left_out,
        spacing=spacing, disc=disc, basis=fit.basis, form=found.form,
        noise=float(np.sqrt(variance)), before=float(np.sqrt(square / max(points, 1.0))),
    )  # fmt: skip
