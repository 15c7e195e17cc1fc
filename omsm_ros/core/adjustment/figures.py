"""Form of the part with its covariance: map, peak to valley, rms and Zernike terms.

The map is what terms and cells make together, at the middle of each cell and around the rim; its
pose is fitted and taken away, and its covariance goes through the same projection, so that no
figure counts what the fit has absorbed. PV and rms are not linear: their uncertainty comes from
draws of the map.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.adjustment.evidence import evidence_of
from omsm_ros.core.adjustment.network import Solution, solve
from omsm_ros.core.adjustment.part_terms import FREE_M, FormTerms
from omsm_ros.core.adjustment.refutation import Doubt, probabilities
from omsm_ros.core.adjustment.sources import FREE, Contribution, Family, base_name
from omsm_ros.core.kinematics.kinematics import Surface, slopes_by_differences
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

POSE = ("piston", "tip", "tilt")
"""What is fitted by default; ``x``, ``y`` and ``clocking`` may be too."""
# Directions to the rim, where a form of high order has its peaks.
_RIM = 96
# Turns from the rim: a spiral that begins there is up to one inside it where it comes round.
_LAST_TURNS = 1.5
# Draws: a standard deviation to 4 %.
_DRAWS = 300
# Two turns may both lie a quarter of the width of a ring off its middle.
_OFF_MIDDLE = 0.3
# Shares of a cell at which its two Gaussian nodes are.
_GAUSS = (0.5 - 12**-0.5, 0.5 + 12**-0.5)
# Terms that are reported, and those that are fitted in addition.
REPORTED_DEGREE, _FITTED_DEGREE = 4, 8


@dataclass(frozen=True)
class Figure:
    """A figure of the form [m]: value and standard uncertainty (k = 1)."""

    value: float
    uncertainty: float


@dataclass(frozen=True, eq=False)
class FormMap:
    """The form error over the part, its pose removed; cells, then the rim.

    x, y: part frame [m], (n,);  height: form error [m], (n,);  area: share of each (n,), 0 at the
        rim;  covariance: (n, n) [m²]
    pv, rms: figures;  terms: of degree 2 to 4 on ``disc``, coefficients one at its rim [m], and
        their covariance [m²]
    removed: names of the pose, with their values ``pose`` [m], [1], [rad]
    alike: families that the form looks like, the likeliest first, with the change of the map that
        each may have made, k = 1 (n,) [m];  dust: how far what is left out is off (d,) [m]
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    area: FloatArray
    covariance: FloatArray
    pv: Figure
    rms: Figure
    disc: Aperture
    terms: tuple[ZernikeIndex, ...]
    coefficients: FloatArray
    term_covariance: FloatArray
    removed: tuple[str, ...]
    pose: FloatArray
    alike: tuple[tuple[str, FloatArray], ...] = ()
    dust: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def uncertainty(self) -> FloatArray:
        """Standard uncertainty of each height (n,) [m]."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def resembled(self) -> tuple[tuple[str, float], ...]:
        """Families that the form looks like, with what each may do to it, rms over the part [m]."""
        return tuple((n, float(np.sqrt(self.area @ change**2))) for n, change in self.alike)

    @property
    def mean_uncertainty(self) -> float:
        """Standard uncertainty of the heights, rms over the part [m]."""
        return float(np.sqrt(self.area @ np.diag(self.covariance)))


@dataclass(frozen=True, eq=False)
class Places:
    """Where the map is made: x, y, span-free terms, cell of each place, and areas."""

    x: FloatArray
    y: FloatArray
    cell: IntArray
    area: FloatArray


def form_map(
    made: FormOf, doubts: Sequence[Doubt] = (), effects: Mapping[str, Effect] | None = None
) -> FormMap:
    """Return the form error ``made``.

    doubts: what they change is uncertain;  effects: of families, which the form may look like
    """
    solution, places = made.solution, made.places
    open_changes = made.open_changes(doubts)
    spread = solution.factor.forward(made.rows[:, solution.active].T)
    raw = spread.T @ spread
    raw += (made.member @ scipy.sparse.diags_array(made.share) @ made.member.T).toarray()
    covariance = made.free(made.free(raw).T)
    covariance += open_changes @ open_changes.T
    every, by_height = _term_fit(solution, places)
    alike = tuple(_resembled(made, covariance, every, by_height, effects or {}))
    more = made.open_changes((), alike)
    covariance += more @ more.T
    pv, rms = made.pv_and_rms(np.concatenate([open_changes, more[:, 1:]], axis=1))
    terms, coefficients, term_covariance = _reported(made, doubts)
    shown = by_height[[every.index(t) for t in terms]] @ more
    return FormMap(
        x=places.x, y=places.y, height=made.height, area=places.area, covariance=covariance,
        pv=pv,
        rms=rms,
        disc=solution.network.part.disc,
        terms=terms,
        coefficients=coefficients,
        term_covariance=term_covariance + shown @ shown.T,
        removed=made.removed,
        pose=made.pose,
        alike=alike,
    )  # fmt: skip


class Effect(NamedTuple):
    """Possible effect of a family on the form, rms over the part, k = 1 [m].

    left: by what scans and prior leave open;  free: by what the scans alone leave open if the prior
        is worth nothing, and the family may have its size ``wide``;  peak: of that, PV [m]
    shape: change of the map by the size ``wide`` of each parameter (n, size) [m]
    known: information that the scans have of the parameters over ``wide``, whatever form the part
        has (size, size)
    """

    left: float
    free: float
    peak: float
    shape: FloatArray
    known: FloatArray


NO_EFFECT = Effect(0.0, 0.0, 0.0, np.zeros((0, 0)), np.zeros((0, 0)))


def effects_on_form(made: FormOf) -> dict[str, Effect]:
    """Return by family what it may do to the form; all others are fitted together with it."""
    solution = made.solution
    # L P, with P the covariance of the parameters that take part.
    through = made.free(made.rows[:, solution.active] @ solution.covariance)
    # Which forms are probable counts once only, where the form is compared with each family.
    bands = dict.fromkeys(solution.scales.bands, FREE_M**2)
    scales, found = replace(solution.scales, bands=bands), {}
    any_part = solve(solution.network, solution.y, scales, solution.sizes, solution)
    for family in solution.network.families:
        if family.name not in solution.sizes:
            continue
        covariance = solution.covariance_of(solution.network.place[family.name])
        here = _part(solution, family)
        change = through[:, here] @ np.linalg.pinv(covariance, rcond=1e-10)
        share, axes = np.linalg.eigh(covariance)
        left = _rms(made.places, change @ (axes * np.sqrt(np.maximum(share, 0.0))))
        open_changes = change @ evidence_of(solution, family).free
        free, peak = _rms(made.places, open_changes), float(np.linalg.norm(pv_of(open_changes)))
        root = evidence_of(any_part, family).free
        # Without the plausible size itself: (root rootᵀ)⁻¹ = information + wide⁻².
        known = family.wide**2 * np.linalg.pinv(root @ root.T, rcond=1e-10) - np.eye(family.size)
        found[family.name] = Effect(left, max(left, free), peak, family.wide * change, known)
    return found


def largest_contribution(
    made: FormOf, effects: Mapping[str, Effect], doubts: Sequence[Doubt],
    alike: Sequence[tuple[str, FloatArray]], accuracy: float | None,
) -> Contribution | None:  # fmt: skip
    """Return the source without which PV is known best, and the size that ``accuracy`` allows.

    effects: of :func:`effects_on_form`;  doubts: as for :func:`form_map`;  alike: of its map
    accuracy: expanded uncertainty of PV asked for [m]; None, or more than there is: None
    """
    solution = made.solution
    known = [f for f in solution.network.families
             if f.name in effects and (f.named or f.name in FREE)]  # fmt: skip
    if accuracy is None or not known:
        return None
    errors, parameters = made.errors()
    changes = made.open_changes(doubts, alike)
    errors = made.free(errors) + changes @ _chances(changes.shape[1])

    def own(family: Family) -> FloatArray:
        found = effects[family.name].shape / family.wide @ parameters[_part(solution, family)]
        for k, (name, _) in enumerate(alike, changes.shape[1] - len(alike)):
            if name == family.name:
                found += np.outer(changes[:, k], _chances(changes.shape[1])[k])
        return np.asarray(found)

    def excess(factor: float, share: FloatArray) -> float:
        """Return U less ``accuracy`` where ``factor`` of a source is left [m]."""
        return 2 * figure(made.height, errors + (factor - 1) * share, pv_of).uncertainty - accuracy

    if excess(1.0, np.zeros_like(errors)) <= 0:
        return None
    family = min(known, key=lambda f: excess(0.0, own(f)))
    size = float(np.sqrt(np.mean(np.square(solution.sizes[family.name]))))
    share = own(family)
    allowed, over = float("nan"), excess(0.0, share)
    if over < 0:
        factor = scipy.optimize.brentq(excess, 0.0, 1.0, args=(share,), rtol=1e-3)
        # The scans determine the rest: 1 / left² = 1 / size² + information.
        covariance = solution.covariance_of(solution.network.place[family.name])
        left = float(np.mean(np.diag(covariance))) / size**2
        allowed = size / float(np.sqrt(1 + (factor**-2 - 1) / left))
    return Contribution(family.name, family.unit, size, allowed, over + accuracy)


def _part(solution: Solution, family: Family) -> slice:
    """Return where the parameters of a family are among those that take part."""
    first = int(np.searchsorted(solution.active, solution.network.place[family.name].start))
    return slice(first, first + family.size)


@dataclass(frozen=True, eq=False)
class FormOf:
    """The form error that ``solution`` found, without its pose, and what it depends on.

    nominal: for the slopes of ``x``, ``y`` and ``clocking``;  removed: names of the pose
    height: at ``places`` (n,) [m];  pose: values of what was removed
    values: terms of the part there (n, k);  rows: change of the map by all parameters (n, p)
    share, member: variance of cells, cell of each place (n, cells)
    columns, fit: of the pose (n, k), (k, n)
    """

    solution: Solution
    nominal: Surface | None
    removed: tuple[str, ...]
    places: Places
    height: FloatArray
    pose: FloatArray
    values: FloatArray
    rows: FloatArray
    share: FloatArray
    member: scipy.sparse.csr_array
    columns: FloatArray
    fit: FloatArray

    @classmethod
    def of(
        cls, solution: Solution, nominal: Surface | None, removed: Sequence[str] = POSE,
        places: Places | None = None,
    ) -> FormOf:  # fmt: skip
        """Return the form by ``solution`` at ``places``; None: at all that were scanned."""
        net, scales = solution.network, solution.scales
        places = places or places_of(solution)
        share = net.cell_share(net.weights(scales), scales)
        values = net.part.values(places.x, places.y)
        height = _heights(solution, values, places)
        # The cells follow from the parameters: a − A β.
        common, along = net.cell_sums(scales)
        rows = np.concatenate([common[places.cell], along[places.cell].toarray()], axis=1)
        rows *= -share[places.cell, np.newaxis]
        rows[:, net.terms] += values
        columns, fit = _pose(places, nominal, removed)
        member = scipy.sparse.eye_array(len(share), format="csr")[places.cell]
        return cls(
            solution, nominal, tuple(removed), places, height - columns @ (fit @ height),
            fit @ height, values, rows, share, member, columns, fit,
        )  # fmt: skip

    def pv_and_rms(self, open_changes: FloatArray | None = None) -> tuple[Figure, Figure]:
        """Return PV and rms with their uncertainty by draws.

        open_changes: further changes of the map (n, k), each as likely as a normal deviate [m]
        """
        changes = np.zeros((len(self.height), 1)) if open_changes is None else open_changes
        draws = self.free(self.errors()[0]) + changes @ _chances(changes.shape[1])
        rms = figure(self.height, draws, lambda h: np.sqrt(self.places.area @ h**2))
        return figure(self.height, draws, pv_of), rms

    def open_changes(
        self, doubts: Sequence[Doubt], alike: Sequence[tuple[str, FloatArray]] = ()
    ) -> FloatArray:
        """Return what ``doubts`` leave open, one standard uncertainty each, and last the changes
        of ``alike``, (n, k + 1) [m]."""
        found = [np.zeros(len(self.height))]
        for doubt in doubts:
            before, after = (
                _heights(s, self.values, self.places) for s in (doubt.before, doubt.after)
            )
            found.append(doubt.share * self.free(after - before))
        return np.stack([*found, *(change for _, change in alike)], axis=1)

    def free(self, heights: FloatArray) -> FloatArray:
        """Return ``heights`` (n, …) without their pose."""
        return np.asarray(heights - self.columns @ (self.fit @ heights))

    def errors(self) -> tuple[FloatArray, FloatArray]:
        """Return errors of the map as they may be, (n, draws) [m], and of the parameters."""
        random, solution = np.random.default_rng(0), self.solution
        factor = solution.factor
        normal = random.standard_normal((len(solution.active), _DRAWS))
        moved = scipy.linalg.solve_triangular(factor.root, normal, lower=True, trans="T")
        moved *= factor.scale[:, np.newaxis]
        of_cells = np.sqrt(self.share)[:, np.newaxis] * random.standard_normal(
            (len(self.share), _DRAWS)
        )
        errors = self.rows[:, solution.active] @ moved + self.member @ of_cells
        return np.asarray(errors), np.asarray(moved)


def _heights(solution: Solution, values: FloatArray, places: Places) -> FloatArray:
    """Return the form by ``solution`` at ``places``, terms (n, k) and cells, (n,) [m]."""
    net = solution.network
    cells = net.cells_of(solution.scales, solution.residual)
    return np.asarray(values @ solution.values[net.terms] + cells[places.cell])


def _chances(number: int) -> FloatArray:
    """Return draws of ``number`` normal deviates, (number, draws), the same ones each time."""
    return np.random.default_rng([0, 1]).standard_normal((number, _DRAWS))


def pv_of(heights: FloatArray) -> FloatArray:
    """Return the peak to valley of ``heights`` (n, …) [m]."""
    return np.asarray(np.ptp(heights, axis=0))


def _rms(places: Places, shapes: FloatArray) -> float:
    """Return the rms over the part of the sum of independent ``shapes`` (n, k)."""
    return float(np.sqrt(np.sum(places.area @ shapes**2)))


def places_of(solution: Solution, within: BoolArray | None = None) -> Places:
    """Return the centre of the blocks of every cell that was scanned, and points of the rim.

    within: cells to which they are confined
    """
    net = solution.network
    blocks, part = net.blocks, net.part
    number = np.bincount(part.cell, minlength=part.cells)
    if within is not None:
        number = np.where(within, number, 0)
    seen = np.flatnonzero(number)
    x, y = (np.bincount(part.cell, v, part.cells)[seen] / number[seen]
            for v in (blocks.x, blocks.y))  # fmt: skip
    # Towards the rim cells are narrower than blocks: one without a block between two that have
    # some is scanned too, and they stand for half of it each.
    between = np.roll(number > 0, 1) & (number == 0) & np.roll(number > 0, -1)
    # In each direction the outermost block; within the last turns on to the rim, where a form of
    # high order has its peaks. The uncertainty of the terms holds on the way there, too.
    u, v = part.disc.scaled(blocks.x, blocks.y)
    out = np.hypot(u, v)
    # Blocks lie in the middle of a sector of the turn; a quarter off, none is near an end.
    sector = np.floor(np.arctan2(v, u) * (_RIM / (2 * np.pi)) + 0.25) % _RIM
    sector[number[part.cell] == 0] = _RIM
    outwards = np.lexsort((out, sector))
    rim = outwards[np.flatnonzero(np.diff(sector[outwards], append=_RIM + 1))]
    rim = rim[sector[rim] < _RIM]
    near = 1 - out[rim] < _LAST_TURNS / (float(np.max(blocks.turn)) + 1)
    to_rim = np.where(near, 1 / np.maximum(out[rim], 0.5), 1.0)
    weights = (1 + np.roll(between, 1) / 2 + np.roll(between, -1) / 2)[seen]
    return Places(
        np.append(x, part.disc.x + to_rim * (blocks.x[rim] - part.disc.x)),
        np.append(y, part.disc.y + to_rim * (blocks.y[rim] - part.disc.y)),
        np.append(seen, part.cell[rim]),
        np.append(weights / np.sum(weights), np.zeros(len(rim))),
    )


def nodes_of(solution: Solution) -> Places:
    """Return two Gaussian nodes in every cell that was scanned.

    Over the centres of the blocks terms of high degree are not orthogonal to the reported ones. A
    cell that was scanned in part, at an end of a ring or with its blocks off the middle, has the
    centre of the blocks instead.
    """
    part, centres = solution.network.part, places_of(solution)
    inside = centres.area > 0
    known = np.full((2, part.cells), np.nan)
    known[:, centres.cell[inside]] = centres.x[inside], centres.y[inside]

    def between(scanned: BoolArray) -> BoolArray:
        return np.roll(scanned, 1) & np.roll(scanned, -1)

    scanned = np.isfinite(known[0])
    scanned |= between(scanned)
    cell = np.flatnonzero(scanned)
    known = known[:, cell]
    off = np.hypot(*part.disc.scaled(*known)) * part.rings - np.floor(np.sqrt(cell / 3)) - 0.5
    partly = ~between(scanned)[cell] | (np.abs(off) > _OFF_MIDDLE)
    x, y = np.concatenate(
        [np.where(partly, known, part.place_in(cell, share)) for share in _GAUSS], axis=1
    )
    return Places(x, y, np.tile(cell, 2), np.full(len(x), 1 / len(x)))


def _pose(
    places: Places, nominal: Surface | None, removed: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return columns of the pose (n, k), and what fits them by least squares (k, n)."""
    x, y = places.x, places.y
    columns = {"piston": np.ones(len(x)), "tip": y, "tilt": -x}
    if nominal is not None:
        slope_x, slope_y = slopes_by_differences(nominal, x, y)
        columns |= {"x": -slope_x, "y": -slope_y, "clocking": slope_x * y - slope_y * x}
    made = np.stack([columns[name] for name in removed], axis=1)
    scale = np.sqrt(places.area @ made**2)
    root = np.sqrt(places.area)[:, np.newaxis]
    fit = np.linalg.pinv(made / scale * root, rcond=1e-9) * root.T / scale[:, np.newaxis]
    return made, np.asarray(fit)


def figure(height: FloatArray, draws: FloatArray, of: Callable[[FloatArray], FloatArray]) -> Figure:
    """Return a figure of ``height``, its uncertainty by draws: their spread and their bias."""
    value = float(of(height[:, np.newaxis])[0])
    many = of(height[:, np.newaxis] + draws)
    bias = float(np.mean(many)) - value
    return Figure(value, float(np.hypot(np.std(many), bias)))


def _term_fit(solution: Solution, places: Places) -> tuple[tuple[ZernikeIndex, ...], FloatArray]:
    """Return the fitted terms, and the matrix from heights to their coefficients."""
    every = terms_up_to(_FITTED_DEGREE)
    u, v = solution.network.part.disc.scaled(places.x, places.y)
    values = zernike_values(u, v, every).T
    root = np.sqrt(places.area)[:, np.newaxis]
    return every, np.asarray(np.linalg.pinv(values * root, rcond=1e-6) * root.T)


def _reported(
    form: FormOf, doubts: Sequence[Doubt]
) -> tuple[tuple[ZernikeIndex, ...], FloatArray, FloatArray]:
    """Return the reported terms, their coefficients [m] and covariance [m²]."""
    solution = form.solution
    made = FormOf.of(solution, form.nominal, form.removed, nodes_of(solution))
    every, fit = _term_fit(solution, made.places)
    kept = [k for k, t in enumerate(every) if 2 <= t.n <= REPORTED_DEGREE]
    # A pose that is removed is no uncertainty: decentre looks like astigmatism.
    fit = fit[kept] - fit[kept] @ made.columns @ made.fit
    spread = solution.factor.forward((fit @ made.rows[:, solution.active]).T)
    of_cells = (fit @ made.member) * np.sqrt(made.share)
    changes = fit @ made.open_changes(doubts)
    covariance = spread.T @ spread + of_cells @ of_cells.T + changes @ changes.T
    return tuple(every[k] for k in kept), fit @ made.height, covariance


def _resembled(
    made: FormOf, covariance: FloatArray, terms: Sequence[ZernikeIndex], by_height: FloatArray,
    effects: Mapping[str, Effect],
) -> list[tuple[str, FloatArray]]:  # fmt: skip
    """Return families that the scans leave open and that the form speaks for, likeliest first.

    Each has its name, and its change of the map as one standard uncertainty (n,) [m].
    """
    used = [k for k, t in enumerate(terms) if t.n >= 2]
    fit, degrees = by_height[used], np.array([terms[k].n for k in used])
    symmetric = np.array([terms[k].m == 0 for k in used])
    form = FormTerms(fit @ made.height, fit @ covariance @ fit.T, degrees, symmetric)
    least = float(np.sqrt(made.places.area @ np.diag(covariance)))
    found = []
    for family in made.solution.network.families:
        effect = effects.get(family.name, NO_EFFECT)
        if effect.free < least or not family.named or base_name(family.name) in FREE:
            continue
        shape, known = effect.shape, effect.known
        if family.smooth is not None:
            # Rounding of its many components would pass for information.
            shape, known = shape @ family.smooth, np.zeros((family.smooth.shape[1],) * 2)
        gain, values = form.looks_like(fit @ shape, known)
        found.append((family.name, gain, shape @ values))
    probable = probabilities([gain for _, gain, _ in found])
    return [(found[k][0], np.sqrt(probable[k]) * found[k][2]) for k in np.argsort(-probable)]
