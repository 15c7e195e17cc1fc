"""Match two measurements of one part: move the second onto the first by least squares.

Piston, tip, tilt and power are linear; shift and clocking, on request, are found by Gauss-Newton
with the slopes of the local fits. All places have the same area.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.comparison.resampling import LocalHeights, LocalQuadratic
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.errors import ConfigurationError, DataError, Notice
from omsm_ros.linear_algebra import least_squares, unit_columns

MATCHING_PARAMETERS = ("piston", "tip", "tilt", "power", "x", "y", "clocking")
"""Pose parameters in this order, with the signs of a pose: tip raises the side of +y, tilt
lowers the side of +x, clocking turns from x towards y."""

SEATED = ("piston", "tip", "tilt")
LATERAL = ("x", "y", "clocking")
# Convergence is quadratic; resampling does not resolve a thousandth of a place.
_TURNS = 8
_SETTLED = 1e-3
# Four places for each of the 25 tested terms.
_FEWEST_PLACES = 100
# A pose parameter with a smaller independent share of its column is not separable.
_LEAST_OWN_SHARE = 1e-3
# Least share of the surface in the mean square of a column; with more noise in the slopes
# Gauss-Newton takes too short steps and does not converge.
_LEAST_RELIABLE = 0.7
# Clocking by which an undetermined rotation is tested [rad].
_TESTED_RAD = 1e-2
# Combinations of columns weaker than this part of the strongest are rounding.
_SINGULAR = 1e-10
# Heights below this are not measured [m].
_LEAST_EFFECT_M = 1e-10


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Matched:
    """Two measurements at the same places (m,), the second moved onto the first.

    grid: of all places, with the difference a − b [m], NaN where one of both has no height
    filled: which places of the grid have a difference, flat
    x, y: [m];  a, b: heights [m], b without the fitted piston, tip, tilt and power
    columns: change of a − b by each fitted pose parameter (p, m)
    dofs: fitted;  moved: the step of each [m], [rad], power [1/m]
    refused: pose parameters that the surface does not determine, and why
    from_a, from_b: local fits;  b_x, b_y: places in the frame of the second measurement [m]
    """

    grid: HeightGrid
    filled: BoolArray
    x: FloatArray
    y: FloatArray
    a: FloatArray
    b: FloatArray
    columns: FloatArray
    dofs: tuple[str, ...]
    moved: dict[str, float]
    refused: dict[str, Notice]
    from_a: LocalHeights
    from_b: LocalHeights
    b_x: FloatArray
    b_y: FloatArray

    @property
    def difference(self) -> FloatArray:
        """a − b at the places [m], (m,)."""
        return self.a - self.b

    def step(self) -> dict[str, float]:
        """Return the least-squares step of each pose parameter."""
        solved = least_squares(self.columns.T, self.difference, _SINGULAR)
        return dict(zip(self.dofs, map(float, solved), strict=True))

    def levelled(self, step: Mapping[str, float]) -> Matched:
        """Return both with ``step`` of linear pose parameters removed from the second."""
        columns = dict(zip(self.dofs, self.columns, strict=True))
        level = sum((value * columns[name] for name, value in step.items()), np.zeros(1))
        flat = np.full(self.grid.height.size, np.nan)
        flat[self.filled] = self.a - self.b - level
        return replace(
            self, grid=replace(self.grid, height=flat.reshape(self.grid.height.shape)),
            b=self.b + level, moved={**self.moved, **step},
        )  # fmt: skip

    def without_fit(self, values: FloatArray) -> FloatArray:
        """Return values (…, m) without their fit by the fitted pose parameters."""
        design, _ = unit_columns(self.columns.T)
        solved = np.linalg.lstsq(design, values.T, rcond=_SINGULAR)[0]
        return np.asarray(values - (design @ solved).T, np.float64)


def ordered_dofs(names: Sequence[str]) -> tuple[str, ...]:
    """Return the pose parameters in their order; raise ConfigurationError for other names."""
    for name in names:
        if name not in MATCHING_PARAMETERS:
            raise ConfigurationError(
                "comparison.unknown_freedom", name=name, known=[*MATCHING_PARAMETERS]
            )
    return tuple(name for name in MATCHING_PARAMETERS if name in names)


def match(a: LocalQuadratic, b: LocalQuadratic, grid: HeightGrid, dofs: Sequence[str]) -> Matched:
    """Move ``b`` onto ``a`` by ``dofs`` and resample both at the places of ``grid``.

    Raises DataError for too few common places, or a fit that does not converge.
    """
    x, y = (part.ravel() for part in np.meshgrid(grid.x, grid.y))
    here = a.at(x, y)
    wanted = dict.fromkeys(ordered_dofs(dofs), 0.0)
    seen = _resampled(here, b, grid, wanted)
    of_first = {name: _column(name, seen.x, seen.y, seen.from_a) for name in wanted}
    of_second = dict(zip(wanted, seen.columns, strict=True))
    refused = _not_determined(of_second, of_first, grid.dx)
    moved = {name: value for name, value in wanted.items() if name not in refused}
    for _ in range(_TURNS):
        seen = _resampled(here, b, grid, moved)
        step = seen.step()
        lateral_step = {name: step.pop(name) for name in LATERAL if name in step}
        reach = {"x": grid.dx, "y": grid.dx, "clocking": 2 * grid.dx / float(np.ptp(x))}
        if all(abs(value) < _SETTLED * reach[name] for name, value in lateral_step.items()):
            return replace(seen.levelled(step), refused=refused)
        moved |= {name: moved[name] + value for name, value in lateral_step.items()}
    raise DataError("comparison.not_converged")


def _resampled(
    here: LocalHeights, b: LocalQuadratic, grid: HeightGrid, moved: Mapping[str, float]
) -> Matched:
    """Return the first measurement ``here``, and the second after it is ``moved``, at ``grid``."""
    x, y = (part.ravel() for part in np.meshgrid(grid.x, grid.y))
    angle = moved.get("clocking", 0.0)
    dx, dy = x - moved.get("x", 0.0), y - moved.get("y", 0.0)
    u = dx * np.cos(angle) + dy * np.sin(angle)
    v = -dx * np.sin(angle) + dy * np.cos(angle)
    there = b.at(u, v)
    filled = np.isfinite(here.value) & np.isfinite(there.value)
    if np.sum(filled) < _FEWEST_PLACES:
        raise DataError(
            "comparison.few_places", count=int(np.sum(filled)), side=grid.dx, least=_FEWEST_PLACES
        )
    columns = [_column(name, u, v, there)[filled] for name in moved]
    return Matched(
        grid=grid,
        filled=filled,
        x=x[filled],
        y=y[filled],
        a=here.value[filled],
        b=there.value[filled],
        columns=np.array(columns),
        dofs=tuple(moved),
        moved={**moved},
        refused={},
        from_a=LocalHeights(*(values[filled] for values in here)),
        from_b=LocalHeights(*(values[filled] for values in there)),
        b_x=u[filled],
        b_y=v[filled],
    )


def _column(name: str, x: FloatArray, y: FloatArray, there: LocalHeights) -> FloatArray:
    """Return the change of the height of b at a place for a unit step of ``name``."""
    if name == "piston":
        return np.ones_like(x)
    if name == "clocking":
        return np.asarray(y * there.slope_x - x * there.slope_y, np.float64)
    columns = {
        "tip": y, "tilt": -x, "power": (x**2 + y**2) / 2, "x": -there.slope_x, "y": -there.slope_y,
    }  # fmt: skip
    return columns[name]


def _not_determined(
    columns: dict[str, FloatArray], of_first: dict[str, FloatArray], place: float
) -> dict[str, Notice]:
    """Return the lateral pose parameters that the surface does not determine, and why.

    columns, of_first: of the second and of the first measurement. Their common part belongs to the
    surface; the rest is noise of the slopes.
    """
    refused: dict[str, Notice] = {}
    for name in LATERAL:
        if name not in columns:
            continue
        others = [n for n in columns if n != name and n not in refused]
        own, first = (
            _independent_part(of[name], [of[n] for n in others]) for of in (columns, of_first)
        )
        share = float(np.linalg.norm(own)) / max(float(np.linalg.norm(columns[name])), 1e-300)
        reach = place if name != "clocking" else _TESTED_RAD
        common = max(float(np.mean(own * first)), 0.0)
        effect = float(np.sqrt(common) * reach)
        noisy = common < _LEAST_RELIABLE * float(np.mean(own**2))
        if share < _LEAST_OWN_SHARE or effect < _LEAST_EFFECT_M or noisy:
            code = "comparison.shift_not_determined"
            if name == "clocking":
                code = "comparison.rotation_not_determined"
            refused[name] = Notice(code, step=reach, effect=effect)
    return refused


def _independent_part(column: FloatArray, others: Sequence[FloatArray]) -> FloatArray:
    """Return the part of a column (n,) that is independent of the ``others``."""
    if not others:
        return column
    design = np.stack(others, axis=1)
    return np.asarray(column - design @ least_squares(design, column, _SINGULAR))
