"""Select the pose parameters of a pose that the points determine; bound the pose error.

A pose parameter is fitted if it changes the deviation in a way that the preceding ones do not.
A sphere that turns about its axis stays the same; a lateral shift of it acts like a tilt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.registration.form_model import FormBasis
from omsm_ros.core.registration.placement import (
    POSE_PARAMETERS,
    Placed,
    Placement,
    PointBatch,
    dof_columns,
    placed,
)
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.shape_parameters import ALIASES, SHAPE_PARAMETERS, shape_range
from omsm_ros.errors import ConfigurationError, DataError, Notice
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, NANOMETRE_M

AUTO = "auto"
HELD = "held pose parameters"
"""Name of the error source for pose parameters that are held at their nominal value."""
RIGID = POSE_PARAMETERS[:6]
MOVES = ("x", "y", "clocking")
"""Pose parameters that a chuck may hold at zero; piston, tip and tilt always vary."""
# Odds from which a move of the part counts as strong evidence (Kass and Raftery, 1995).
_STRONG_ODDS = 20.0
# Form below a nanometre is not resolved.
_LEAST_FORM_M = NANOMETRE_M


def typical_range(dof: str) -> float:
    """Return the largest plausible offset of a manually mounted part [m], [rad] or [1/m].

    A pose parameter that a nanometre of form would move by more is not determined.
    """
    if dof == "power":
        return 1.0
    if dof in SHAPE_PARAMETERS:
        return shape_range(dof)
    return MILLIMETRE_M if dof in ("x", "y", "piston") else DEGREE_RAD


class PoseParameters(NamedTuple):
    """Pose parameters that are fitted, in the order of their columns, and why others are not.

    refused: the surface does not determine it;  held: at its nominal value, see :func:`weakest_dof`
    declared: standard uncertainties of the placement [m], [rad], where they are known
    """

    fitted: tuple[str, ...]
    refused: dict[str, Notice]
    held: dict[str, Notice]
    declared: Mapping[str, float] = MappingProxyType({})

    def range(self, name: str) -> float:
        """Return the declared uncertainty of a parameter, else its largest plausible offset."""
        return self.declared.get(name, typical_range(name))

    def without(self, name: str, reason: Notice) -> PoseParameters:
        """Return these with ``name`` held for a ``reason``."""
        left = tuple(n for n in self.fitted if n != name)
        return self._replace(fitted=left, held={**self.held, name: reason})


def parse_dofs(text: str) -> tuple[str, ...]:
    """Return the names in 'auto' or in a list such as 'piston,tip,tilt'.

    Raises ConfigurationError for an unknown or repeated name.
    """
    stripped = [name.strip() for name in text.split(",") if name.strip()]
    names = [ALIASES.get(name, name) for name in stripped]
    known = [AUTO, *POSE_PARAMETERS, *SHAPE_PARAMETERS]
    for name in names:
        if name not in known:
            raise ConfigurationError("registration.unknown_freedom", name=name, known=known)
        if names.count(name) > 1:
            raise ConfigurationError("registration.repeated_freedom", name=name)
    if not names:
        raise ConfigurationError("registration.no_freedom", known=known)
    return tuple(names)


def determined_dofs(
    asked: Sequence[str], gram: FloatArray, points: int,
    declared: Mapping[str, float] = MappingProxyType({}),
) -> PoseParameters:  # fmt: skip
    """Return which of the pose parameters ``asked`` for the surface determines.

    asked: names, or "auto" for all rigid ones that are determined, alone or with "power"
    gram: sums of products of the columns of all pose parameters, and of the shape parameters asked
        for, over ``points``

    Raises DataError if one that was named is not determined.
    """
    automatic = AUTO in asked
    known = (*POSE_PARAMETERS, *shape_asked(asked))
    wanted = [n for n in known if n in asked or (automatic and n in RIGID)]
    fitted: list[str] = []
    refused: dict[str, Notice] = {}
    for name in wanted:
        size = declared.get(name, typical_range(name))
        reason = _undetermined(name, fitted, gram / points, known, size)
        if reason is None:
            fitted.append(name)
        elif automatic and name not in asked:
            refused[name] = reason
        else:
            raise DataError("registration.not_determined", name=name, reason=reason)
    return PoseParameters(tuple(fitted), refused, {}, declared)


def weakest_dof(
    dofs: PoseParameters, asked: Sequence[str], values: FloatArray, covariance: FloatArray,
    gram: FloatArray,
) -> tuple[str, Notice] | None:  # fmt: skip
    """Return the least supported move and the reason to hold it at its nominal value, or None.

    The odds that the part was moved, against a part at its nominal place, are the ratio of the
    prior to the posterior density at zero (Savage-Dickey ratio; J. Dickey, Ann. Math. Stat. 42,
    204).

    asked: names of those that are fitted in any case
    values: of the fitted ones (p,);  covariance: of ``values`` (p, p)
    gram: mean products of the columns (p, p)
    """
    spread = np.sqrt(np.diag(covariance))
    scale = np.sqrt(np.diag(gram))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-14, hermitian=True)
    # Size of the part of each column that is independent of the other columns.
    own = scale / np.sqrt(np.maximum(np.diag(inverse), 1.0))
    found = [
        ((values[k] / spread[k]) ** 2 / 2 - np.log(dofs.range(name) / spread[k]), k)
        for k, name in enumerate(dofs.fitted)
        if name in MOVES and name not in asked and own[k] * spread[k] > _LEAST_FORM_M
    ]
    if not found or min(found)[0] > np.log(_STRONG_ODDS):
        return None
    k = min(found)[1]
    angle = dofs.fitted[k] == "clocking"
    return dofs.fitted[k], Notice(
        "registration.held_angle" if angle else "registration.held_length", uncertainty=spread[k],
        form=own[k] * spread[k], value=values[k],
    )  # fmt: skip


def shape_asked(asked: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters of the nominal shape among those ``asked`` for."""
    return tuple(name for name in SHAPE_PARAMETERS if name in asked)


def _undetermined(
    name: str, before: Sequence[str], gram: FloatArray, known: Sequence[str], size: float
) -> Notice | None:
    """Return why ``name`` is not determined in a fit with those ``before`` it, None if it is."""
    places, own = [known.index(n) for n in before], known.index(name)
    alone = float(np.sqrt(gram[own, own]))
    if alone * size < _LEAST_FORM_M:
        return Notice("registration.surface_unchanged")
    scale = np.sqrt(np.diag(gram))[places]
    shared = gram[places, own] / scale / alone
    normal = gram[np.ix_(places, places)] / np.outer(scale, scale)
    share = np.linalg.lstsq(normal, shared, rcond=1e-14)[0] if places else shared
    left = alone * np.sqrt(max(1 - float(shared @ share), 0.0))
    # A difference below 1e-6 of the column is rounding.
    if left > 1e-6 * alone and left * size >= _LEAST_FORM_M:
        return None
    same = [n for n, s in zip(before, share, strict=True) if abs(s) > 0.05]
    return Notice("registration.same_effect", others=same)


@dataclass(frozen=True, eq=False, kw_only=True)
class Registration:
    """Pose of a part with its uncertainty.

    surface: nominal;  placement: of the part;  dofs: fitted, refused and held
    from_source: standard uncertainty of each fitted value (p,) by error source
    pose_effects: steps (p, p), one row for each independent part of the pose error
    taken: mean products (p, p) of the share of each row that form probably caused, at most one
    held_effects: steps (h, h) of the held pose parameters within the bounds of the points
    moved: steps (p, s + 2h) for one standard uncertainty of each systematic source, and then for
        the held pose parameters in first and second order
    spread: standard uncertainty of each pose parameter asked for [m], [rad] or [1/m]
    correlated_moves: for each undetermined pose parameter at its largest plausible offset: the
        effect on each fitted one, in first and second order (2,)
    limit: deviation from the smooth form beyond which a point is dust unless others confirm it [m]
    dust: indices of the points left out as dust, in the order of reading (d,)
    spacing: of the tracks [m]
    disc: the aperture, or a disc that holds all points
    form: coefficients of the smooth form in ``basis`` (k,) [m rms]
    noise: of one point about the smooth form [m];  before: rms deviation before the fit [m]
    """

    surface: Surface
    placement: Placement
    dofs: PoseParameters
    from_source: dict[str, FloatArray]
    pose_effects: FloatArray
    taken: FloatArray
    held_effects: FloatArray
    moved: FloatArray
    spread: dict[str, float]
    correlated_moves: dict[str, dict[str, FloatArray]]
    limit: float
    dust: IntArray
    spacing: float
    disc: Aperture
    basis: FormBasis
    form: FloatArray
    noise: float
    before: float

    def effects(self, points: Placed, systematic: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the effects of pose errors (p, n) and sources (s + 2h, n) on the deviations [m].

        systematic: effects of the sources on the heights (s, n); the fitted pose follows them. The
        last 2h sources are the held pose parameters.
        """
        columns = dof_columns(self.placement, points, self.dofs.fitted)
        names = tuple(self.dofs.held)
        held = held_dof_effects(self.surface, self.placement, points, names, self.held_effects)
        sources = np.concatenate([systematic * points.normal[2], held])
        return self.pose_effects @ columns, sources + self.moved.T @ columns

    def undetermined_displacements(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the possible lateral shift (r, 2, n) [m] of places x, y (n,) [m] on the part.

        One for each of the r undetermined pose parameters at its largest plausible offset; the
        fitted ones follow, so that the points stay on the surface.
        """
        fitted = self.dofs.fitted
        steps = [
            [self.dofs.range(name), *(others[n][0] for n in fitted)]
            for name, others in self.correlated_moves.items()
        ]
        ways = [
            self._moved((n, *fitted), s, x, y)
            for n, s in zip(self.correlated_moves, steps, strict=True)
        ]
        return np.array(ways).reshape(-1, 2, len(x))

    def displaced(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the lateral shift (e, 2, n) [m] of x, y for each row of :meth:`effects`."""
        fitted, held = self.dofs.fitted, tuple(self.dofs.held)
        own = np.zeros((len(self.pose_effects) + self.moved.shape[1], len(fitted) + len(held)))
        own[:, : len(fitted)] = np.concatenate([self.pose_effects, self.moved.T])
        # The second order of a held pose parameter shifts no place.
        first = len(own) - 2 * len(held)
        own[first::2, len(fitted) :] = self.held_effects
        return np.array([self._moved((*fitted, *held), step, x, y) for step in own])

    def _moved(
        self, names: Sequence[str], step: Sequence[float] | FloatArray, x: FloatArray, y: FloatArray
    ) -> FloatArray:
        """Return the shift (2, n) [m] of places x, y of the part for a ``step`` of its pose."""
        pose = self.placement.pose
        places = np.stack([x, y, np.nan_to_num(self.surface.height(x, y))])
        there = pose.rotation @ places + pose.origin[:, np.newaxis]
        moved = self.placement.moved(names, np.asarray(step)).pose
        back = moved.rotation.T @ (there - moved.origin[:, np.newaxis])
        return np.asarray((back - places)[:2])

    @property
    def moves(self) -> IntArray:
        """Return which rows of :meth:`effects` are moves of the part, to first order."""
        fitted, sources = self.moved.shape
        first = fitted + sources - 2 * len(self.held_effects)
        return np.asarray([*range(fitted), *range(first, fitted + sources, 2)], np.int64)

    def good(self, first: int, count: int) -> BoolArray:
        """Return which of ``count`` points from ``first`` on, as they are read, are no dust."""
        good = np.ones(count, bool)
        low, high = np.searchsorted(self.dust, (first, first + count))
        good[self.dust[low:high] - first] = False
        return good


def held_dof_effects(
    surface: Surface, at: Placement, points: Placed, names: Sequence[str], steps: FloatArray
) -> FloatArray:
    """Return the effects (2h, n) [m] of ``steps`` (h, h) of held pose parameters.

    In first and second order, because a held value may be off by tenths of a millimetre.
    """
    there = points.from_origin + at.pose.origin[:, np.newaxis]
    portion = PointBatch(there[0], there[1], there[2], np.empty((0, len(points.x))))
    rows = np.zeros((2 * len(steps), len(points.x)))
    for k, step in enumerate(steps):
        ends = (at.moved(names, way) for way in (step, -step))
        high, low = (placed(surface, end, portion).deviation for end in ends)
        rows[2 * k], rows[2 * k + 1] = (high - low) / 2, (high + low) / 2 - points.deviation
    # At the rim a step may leave the surface, where the effect is not defined.
    return np.nan_to_num(rows, copy=False)


class OpenUncertainty(NamedTuple):
    """Pose errors that the covariance of the fit does not contain.

    unknown: for each undetermined pose parameter: its effect on each of the others, in first
        and second order
    held: mean products of the held values, estimate and covariance together (h, h)
    """

    unknown: dict[str, dict[str, FloatArray]]
    held: FloatArray = np.empty((0, 0))

    def by_source(
        self, names: Sequence[str], covariance: FloatArray, sources: Sequence[str],
        moved: FloatArray,
    ) -> dict[str, FloatArray]:  # fmt: skip
        """Return the standard uncertainties (p,) of the fitted ``names`` by error source.

        covariance: from noise and form (p, p)
        moved: from each of the ``sources`` (p, s), of which several may have one name
        """
        found = {"noise and form": np.sqrt(np.diag(covariance))}
        for k, name in enumerate(sources):
            found[name] = np.hypot(found.get(name, 0.0), moved[:, k])
        for name, correlated_moves in self.unknown.items():
            found[name] = np.array([np.linalg.norm(correlated_moves[n]) for n in names])
        return found

    def spread(self, dofs: PoseParameters, by_source: dict[str, FloatArray]) -> dict[str, float]:
        """Return the standard uncertainty of each pose parameter that was asked for."""
        held = np.sqrt(np.diag(self.held))
        fitted = np.sqrt(np.sum([s**2 for s in by_source.values()], axis=0))
        found = dict(zip(dofs.fitted, map(float, fitted), strict=True))
        for name, own in zip(dofs.held, held, strict=True):
            correlated_moves = [np.linalg.norm(moves[name]) for moves in self.unknown.values()]
            found[name] = float(np.linalg.norm([own, *correlated_moves]))
        found |= {name: dofs.range(name) for name in dofs.refused}
        return {name: min(s, dofs.declared.get(name, s)) for name, s in found.items()}


def root_of(covariance: FloatArray) -> FloatArray:
    """Return rows (p, p) whose outer products add up to ``covariance``."""
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray((np.sqrt(np.maximum(values, 0.0)) * vectors).T * scale, np.float64)


def shares_of(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return mean products (p, p) of the multiples of ``rows`` that add up to ``covariance``."""
    scale = np.linalg.norm(rows, axis=0)
    amounts = np.linalg.pinv((rows / scale).T, rcond=1e-9)
    return np.asarray(amounts @ (covariance / np.outer(scale, scale)) @ amounts.T, np.float64)
