"""Which freedoms of its pose does a surface determine?

A freedom is taken up if it changes the deviation in a way that those before it do not. A sphere
that is turned about its axis stays what it is; moved sideways it does what a tilt does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.registration.form_model import FormBasis
from omsm_ros.core.registration.placement import (
    DEGREES_OF_FREEDOM,
    Aperture,
    Placed,
    Placement,
    PointBatch,
    dof_columns,
    placed,
)
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import quantity
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, NANOMETRE_M

AUTO = "auto"
HELD = "freedoms held"
"""Name of the source of error that a freedom is which was held."""
RIGID = DEGREES_OF_FREEDOM[:6]
MOVES = ("x", "y", "clocking")
"""Freedoms that a chuck settles; piston, tip and tilt no part comes without."""
# Odds that a part was moved, at which it is said to be: strong evidence. Less may be its form.
_CLEARLY_DETERMINED = 20.0
_LEAST_FORM_M = NANOMETRE_M


def typical_range(dof: str) -> float:
    """Return how far a freedom may be off on a part that was put on its chuck by hand [m], [rad].

    One that a nanometre of form would move further than this is not determined by the surface.
    """
    if dof == "power":
        return 1.0
    return MILLIMETRE_M if dof in ("x", "y", "piston") else DEGREE_RAD


class DegreesOfFreedom(NamedTuple):
    """What is fitted, in the order of its columns, and why something else is not.

    refused: the surface does not determine it;  held: at its nominal value, see :func:`weakest_dof`
    """

    fitted: tuple[str, ...]
    refused: dict[str, str]
    held: dict[str, str]

    def without(self, name: str, reason: str) -> DegreesOfFreedom:
        """Return the freedoms with one of them held."""
        left = tuple(n for n in self.fitted if n != name)
        return DegreesOfFreedom(left, self.refused, {**self.held, name: reason})


def parse_dofs(text: str) -> tuple[str, ...]:
    """Return the freedoms of 'auto' or of a list such as 'piston,tip,tilt'.

    Raises ConfigurationError for a name that is no freedom, or stands twice.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    known = [AUTO, *DEGREES_OF_FREEDOM]
    for name in names:
        if name not in known or names.count(name) > 1:
            why = "is unknown" if name not in known else "stands twice"
            raise ConfigurationError(f"freedom {name!r} {why}, expected a list of {known}")
    if not names:
        raise ConfigurationError(f"no freedom is named, expected a list of {known}")
    return tuple(names)


def determined_dofs(asked: Sequence[str], gram: FloatArray, points: int) -> DegreesOfFreedom:
    """Return which of the freedoms ``asked`` for are determined.

    asked: of :data:`DEGREES_OF_FREEDOM`, or "auto", alone or beside "power": the rigid ones that are
    gram: sums of products (7, 7) of the columns of all freedoms over ``points``

    Raises DataError for a freedom that was named and is not determined.
    """
    automatic = AUTO in asked
    wanted = [n for n in DEGREES_OF_FREEDOM if n in asked or (automatic and n in RIGID)]
    fitted: list[str] = []
    refused: dict[str, str] = {}
    for name in wanted:
        reason = _undetermined(name, fitted, gram / points)
        if not reason:
            fitted.append(name)
        elif automatic and name not in asked:
            refused[name] = reason
        else:
            raise DataError(f"{name} cannot be fitted: {reason}; leave it out of the fit")
    return DegreesOfFreedom(tuple(fitted), refused, {})


def weakest_dof(
    names: Sequence[str], values: FloatArray, covariance: FloatArray, gram: FloatArray
) -> tuple[str, str] | None:
    """Return which move had better be held at its nominal value, and why; None if none had.

    One that takes away hardly more form than its uncertainty leaves open says nothing of the part:
    the odds that it moved, against one that sits as it should, are the density of its place at
    zero before the fit over that after it (J. Dickey, Ann. Math. Stat. 42, 204).

    values: of ``names`` (p,) as they were found;  covariance: of these (p, p)
    gram: mean products of what they do to the deviation (p, p)
    """
    spread = np.sqrt(np.diag(covariance))
    scale = np.sqrt(np.diag(gram))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-14, hermitian=True)
    # The part of its column that no other freedom has.
    own = scale / np.sqrt(np.maximum(np.diag(inverse), 1.0))
    found = [
        ((values[k] / spread[k]) ** 2 / 2 - np.log(typical_range(name) / spread[k]), k)
        for k, name in enumerate(names)
        if name in MOVES and own[k] * spread[k] > _LEAST_FORM_M
    ]
    if not found or min(found)[0] > np.log(_CLEARLY_DETERMINED):
        return None
    k = min(found)[1]
    unit = "rad" if names[k] == "clocking" else "m"
    return names[k], (
        f"form looks like it here: the points determine it to {quantity(spread[k], unit, 2)} only, "
        f"which is {quantity(own[k] * spread[k], 'm', 2)} rms of form, and do not show that the "
        f"part was moved ({quantity(values[k], unit, 2)} was found); what that opens widens every "
        "figure"
    )


def _undetermined(name: str, before: Sequence[str], gram: FloatArray) -> str:
    """Return why a freedom is not determined beside those ``before`` it, empty if it is."""
    places, own = [DEGREES_OF_FREEDOM.index(n) for n in before], DEGREES_OF_FREEDOM.index(name)
    alone = float(np.sqrt(gram[own, own]))
    if alone * typical_range(name) < _LEAST_FORM_M:
        return "the surface stays as it is when it is moved so"
    scale = np.sqrt(np.diag(gram))[places]
    shared = gram[places, own] / scale / alone
    normal = gram[np.ix_(places, places)] / np.outer(scale, scale)
    share = np.linalg.lstsq(normal, shared, rcond=1e-14)[0] if places else shared
    left = alone * np.sqrt(max(1 - float(shared @ share), 0.0))
    # Beneath this share of the column the difference is rounding.
    if left > 1e-6 * alone and left * typical_range(name) >= _LEAST_FORM_M:
        return ""
    same = [n for n, s in zip(before, share, strict=True) if abs(s) > 0.05]
    return f"on this surface it does what {' and '.join(same)} do" if len(same) > 1 else (
        f"on this surface it does what {''.join(same)} does"
    )  # fmt: skip


# How well is it known how the part sits, and what does that do to its form?


@dataclass(frozen=True, eq=False, kw_only=True)
class Registration:
    """How the part sits, and how well that is known.

    surface: the nominal;  placement: of the part;  dofs: what was fitted, and what could not be
    from_source: standard uncertainty of each (p,) by where it comes from
    pose_effects: steps of the freedoms (p, p), each of an independent part of the pose's own error
    taken: mean products of how much of each form is likely to have made (p, p), at most one
    held_effects: steps of those that are held (h, h), as far as the points bound them
    moved: by how much each systematic source, off by its uncertainty, moves the freedoms, and
        then by how much what is held does (p, s + 2h)
    spread: standard uncertainty of each freedom that was asked for [m], [rad] or [1/m]
    correlated_moves: by freedom that no points determine: what it does to each of the fitted, in the first
        and second order (2,), where it is off by as much as it may be
    limit: deviation from the smooth form beyond which a point is an outlier [m]
    disc: the aperture, or what holds all points;  form: the smooth form in its basis (k,) [m rms]
    noise: of one point about the smooth form [m];  before: rms deviation before the fit [m]
    """

    surface: Surface
    placement: Placement
    dofs: DegreesOfFreedom
    from_source: dict[str, FloatArray]
    pose_effects: FloatArray
    taken: FloatArray
    held_effects: FloatArray
    moved: FloatArray
    spread: dict[str, float]
    correlated_moves: dict[str, dict[str, FloatArray]]
    limit: float
    disc: Aperture
    basis: FormBasis
    form: FloatArray
    noise: float
    before: float

    def uncertainty(self, dof: str) -> float | None:
        """Return the standard uncertainty of a freedom, None if nobody asked for it."""
        return self.spread.get(dof)

    def effects(self, points: Placed, systematic: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the pose (p, n) and the sources (s + 2h, n) may do to the deviations [m].

        systematic: effects on the heights (s, n), which the pose then follows. The last 2h of the
        sources are the freedoms that were held.
        """
        columns = dof_columns(self.placement, points, self.dofs.fitted)
        names = tuple(self.dofs.held)
        held = held_dof_effects(self.surface, self.placement, points, names, self.held_effects)
        sources = np.concatenate([systematic * points.normal[2], held])
        return self.pose_effects @ columns, sources + self.moved.T @ columns

    def undetermined_displacements(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return how far (r, 2, n) [m] places x, y (n,) [m] of the part may lie beside where found.

        For each of r freedoms that no points determine, off by as much as it may be; the others
        follow, and the points stay on the surface.
        """
        fitted = self.dofs.fitted
        steps = [
            [typical_range(name), *(others[n][0] for n in fitted)]
            for name, others in self.correlated_moves.items()
        ]
        ways = [
            self._moved((n, *fitted), s, x, y)
            for n, s in zip(self.correlated_moves, steps, strict=True)
        ]
        return np.array(ways).reshape(-1, 2, len(x))

    def displaced(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the same (e, 2, n) [m] for each row of :meth:`effects`, one below the other."""
        fitted, held = self.dofs.fitted, tuple(self.dofs.held)
        own = np.zeros((len(self.pose_effects) + self.moved.shape[1], len(fitted) + len(held)))
        own[:, : len(fitted)] = np.concatenate([self.pose_effects, self.moved.T])
        # Of what is held, the second order moves no place.
        first = len(own) - 2 * len(held)
        own[first::2, len(fitted) :] = self.held_effects
        return np.array([self._moved((*fitted, *held), step, x, y) for step in own])

    def _moved(
        self, names: Sequence[str], step: Sequence[float] | FloatArray, x: FloatArray, y: FloatArray
    ) -> FloatArray:
        """Return where places x, y of the part come to lie by a step of its freedoms (2, n) [m]."""
        pose = self.placement.pose
        places = np.stack([x, y, np.nan_to_num(self.surface.height(x, y))])
        there = pose.rotation @ places + pose.origin[:, np.newaxis]
        moved = self.placement.moved(names, np.asarray(step)).pose
        back = moved.rotation.T @ (there - moved.origin[:, np.newaxis])
        return np.asarray((back - places)[:2])

    @property
    def moves(self) -> IntArray:
        """Return which rows of :meth:`effects`, one below the other, are moves of the part.

        Those of the pose, and of what was held its first order.
        """
        fitted, sources = self.moved.shape
        first = fitted + sources - 2 * len(self.held_effects)
        held = np.arange(first, fitted + sources, 2)
        return np.asarray([*range(fitted), *held], np.int64)

    def good(self, points: Placed) -> BoolArray:
        """Return which points (n,) are no outliers."""
        smooth = self.form @ self.basis.columns(points.x, points.y)
        return np.asarray(np.abs(points.deviation - smooth) <= self.limit)


def held_dof_effects(
    surface: Surface, at: Placement, points: Placed, names: Sequence[str], steps: FloatArray
) -> FloatArray:
    """Return what ``steps`` (h, h) of freedoms that were held do to the deviations (2h, n) [m].

    Of each the first and the second order: what is held may be off by tenths of a millimetre.
    """
    there = points.from_origin + at.pose.origin[:, np.newaxis]
    portion = PointBatch(there[0], there[1], there[2], np.empty((0, len(points.x))))
    rows = np.zeros((2 * len(steps), len(points.x)))
    for k, step in enumerate(steps):
        high, low = (
            placed(surface, at.moved(names, side * step), portion).deviation for side in (1, -1)
        )
        rows[2 * k], rows[2 * k + 1] = (high - low) / 2, (high + low) / 2 - points.deviation
    # At the rim a step may leave the surface.
    return np.nan_to_num(rows, copy=False)


class OpenUncertainty(NamedTuple):
    """What is not in the covariance of the fit.

    unknown: by freedom that no surface determines: what it does to each of the others, in first
        and second order
    held: mean products of what was held, value and covariance together (h, h)
    """

    unknown: dict[str, dict[str, FloatArray]]
    held: FloatArray

    @classmethod
    def of(cls, unknown: dict[str, dict[str, FloatArray]]) -> OpenUncertainty:
        """Return what is open where nothing is held."""
        return cls(unknown, np.empty((0, 0)))

    def by_source(
        self,
        names: Sequence[str],
        covariance: FloatArray,
        sources: Sequence[str],
        moved: FloatArray,
    ) -> dict[str, FloatArray]:
        """Return the standard uncertainties (p,) of the fitted ``names`` by where they come from.

        covariance: by noise and form (p, p);  moved: by each of the ``sources`` (p, s), of which
            several may have one name
        """
        found = {"noise and form": np.sqrt(np.diag(covariance))}
        for k, name in enumerate(sources):
            found[name] = np.hypot(found.get(name, 0.0), moved[:, k])
        for name, correlated_moves in self.unknown.items():
            found[name] = np.array([np.linalg.norm(correlated_moves[n]) for n in names])
        return found

    def spread(self, dofs: DegreesOfFreedom, by_source: dict[str, FloatArray]) -> dict[str, float]:
        """Return the standard uncertainty of each freedom that was asked for."""
        held = np.sqrt(np.diag(self.held))
        fitted = np.sqrt(np.sum([s**2 for s in by_source.values()], axis=0))
        found = dict(zip(dofs.fitted, map(float, fitted), strict=True))
        for name, own in zip(dofs.held, held, strict=True):
            correlated_moves = [np.linalg.norm(moves[name]) for moves in self.unknown.values()]
            found[name] = float(np.linalg.norm([own, *correlated_moves]))
        return found | {name: typical_range(name) for name in dofs.refused}


def root_of(covariance: FloatArray) -> FloatArray:
    """Return rows (p, p) whose outer products add up to the covariance."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray((np.sqrt(np.maximum(values, 0.0)) * vectors).T * scale, np.float64)


def shares_of(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return mean products (p, p) of amounts of ``rows`` (p, p) that make up the covariance."""
    scale = np.linalg.norm(rows, axis=0)
    amounts = np.linalg.pinv((rows / scale).T, rcond=1e-9)
    return np.asarray(amounts @ (covariance / np.outer(scale, scale)) @ amounts.T, np.float64)
