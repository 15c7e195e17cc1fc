"""How well is it known how the part sits, and what does that do to its form?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.form_model import FormBasis
from omsm_ros.core.registration.freedoms import Freedoms, widest
from omsm_ros.core.registration.placement import (
    Aperture,
    Placed,
    Placement,
    Portion,
    freedom_columns,
    placed,
)
from omsm_ros.core.samples.blocks import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Registration:
    """How the part sits, and how well that is known.

    surface: the nominal;  placement: of the part;  freedoms: what was fitted, and what could not be
    from_source: standard uncertainty of each (p,) by where it comes from
    pose_effects: steps of the freedoms (p, p), each of an independent part of the pose's own error
    taken: mean products of how much of each form is likely to have made (p, p), at most one
    held_effects: steps of those that are held (h, h), as far as the points bound them
    moved: by how much each systematic source, off by its uncertainty, moves the freedoms, and
        then by how much what is held does (p, s + 2h)
    spread: standard uncertainty of each freedom that was asked for [m], [rad] or [1/m]
    dragged: by freedom that no points determine: what it does to each of the fitted, in the first
        and second order (2,), where it is off by as much as it may be
    limit: deviation from the smooth form beyond which a point is an outlier [m]
    disc: the aperture, or what holds all points;  form: the smooth form in its basis (k,) [m rms]
    noise: of one point about the smooth form [m];  before: rms deviation before the fit [m]
    """

    surface: Surface
    placement: Placement
    freedoms: Freedoms
    from_source: dict[str, FloatArray]
    pose_effects: FloatArray
    taken: FloatArray
    held_effects: FloatArray
    moved: FloatArray
    spread: dict[str, float]
    dragged: dict[str, dict[str, FloatArray]]
    limit: float
    disc: Aperture
    basis: FormBasis
    form: FloatArray
    noise: float
    before: float

    def uncertainty(self, freedom: str) -> float | None:
        """Return the standard uncertainty of a freedom, None if nobody asked for it."""
        return self.spread.get(freedom)

    def effects(self, points: Placed, systematic: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the pose (p, n) and the sources (s + 2h, n) may do to the deviations [m].

        systematic: effects on the heights (s, n), which the pose then follows. The last 2h of the
        sources are the freedoms that were held.
        """
        columns = freedom_columns(self.placement, points, self.freedoms.fitted)
        names = tuple(self.freedoms.held)
        held = effects_of_held(self.surface, self.placement, points, names, self.held_effects)
        sources = np.concatenate([systematic * points.normal[2], held])
        return self.pose_effects @ columns, sources + self.moved.T @ columns

    def glides(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return how far (r, 2, n) [m] places x, y (n,) [m] of the part may lie beside where found.

        For each of r freedoms that no points determine, off by as much as it may be; the others
        follow, and the points stay on the surface.
        """
        fitted = self.freedoms.fitted
        steps = [
            [widest(name), *(others[n][0] for n in fitted)] for name, others in self.dragged.items()
        ]
        ways = [
            self._moved((n, *fitted), s, x, y) for n, s in zip(self.dragged, steps, strict=True)
        ]
        return np.array(ways).reshape(-1, 2, len(x))

    def displaced(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the same (e, 2, n) [m] for each row of :meth:`effects`, one below the other."""
        fitted, held = self.freedoms.fitted, tuple(self.freedoms.held)
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


def effects_of_held(
    surface: Surface, at: Placement, points: Placed, names: Sequence[str], steps: FloatArray
) -> FloatArray:
    """Return what ``steps`` (h, h) of freedoms that were held do to the deviations (2h, n) [m].

    Of each the first and the second order: what is held may be off by tenths of a millimetre.
    """
    there = points.from_origin + at.pose.origin[:, np.newaxis]
    portion = Portion(there[0], there[1], there[2], np.empty((0, len(points.x))))
    rows = np.zeros((2 * len(steps), len(points.x)))
    for k, step in enumerate(steps):
        high, low = (
            placed(surface, at.moved(names, side * step), portion).deviation for side in (1, -1)
        )
        rows[2 * k], rows[2 * k + 1] = (high - low) / 2, (high + low) / 2 - points.deviation
    # At the rim a step may leave the surface.
    return np.nan_to_num(rows, copy=False)


class Open(NamedTuple):
    """What is not in the covariance of the fit.

    unknown: by freedom that no surface determines: what it does to each of the others, in first
        and second order
    held: mean products of what was held, value and covariance together (h, h)
    """

    unknown: dict[str, dict[str, FloatArray]]
    held: FloatArray

    @classmethod
    def of(cls, unknown: dict[str, dict[str, FloatArray]]) -> Open:
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
        for name, dragged in self.unknown.items():
            found[name] = np.array([np.linalg.norm(dragged[n]) for n in names])
        return found

    def spread(self, freedoms: Freedoms, by_source: dict[str, FloatArray]) -> dict[str, float]:
        """Return the standard uncertainty of each freedom that was asked for."""
        held = np.sqrt(np.diag(self.held))
        fitted = np.sqrt(np.sum([s**2 for s in by_source.values()], axis=0))
        found = dict(zip(freedoms.fitted, map(float, fitted), strict=True))
        for name, own in zip(freedoms.held, held, strict=True):
            dragged = [np.linalg.norm(moves[name]) for moves in self.unknown.values()]
            found[name] = float(np.linalg.norm([own, *dragged]))
        return found | {name: widest(name) for name in freedoms.refused}


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
