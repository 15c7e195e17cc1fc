"""Where does one measurement of a part lie on the other?

The second is moved until its heights, at the same places, come closest to the first's: by piston,
tip, tilt and power, which move no point sideways, and where it is asked for by shift and clocking.
Least squares over places of equal area; shift and clocking by Gauss-Newton with the slopes of the
local fits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.comparison.resampling import LocalHeights, LocalQuadratic
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import quantity

DEGREES_OF_FREEDOM = ("piston", "tip", "tilt", "power", "x", "y", "clocking")
"""In this order, with the signs of a pose: tip raises the side of +y, tilt lowers that of +x,
clocking turns from x towards y."""

SEATED = ("piston", "tip", "tilt")
_LATERAL = ("x", "y", "clocking")
# Each turn squares what is left; a thousandth of a place is beneath what resampling knows.
_TURNS = 8
_SETTLED = 1e-3
# Four for each of the 25 terms that are judged.
_FEWEST_PLACES = 100
# A freedom whose column the others explain but for this share is none of its own.
_LEAST_OWN_SHARE = 1e-3
# Of a column's square that is of the surface: Gauss-Newton with more noise than that in its
# slopes takes too short a step, and does not settle.
_LEAST_RELIABLE = 0.7


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Matched:
    """Two measurements at the same places (m,), the second moved onto the first.

    grid: of all places, height = difference a − b [m], NaN where one of them has none
    filled: which of the grid's places have one, flat
    x, y: [m];  a, b: heights [m], b less the fitted piston, tip, tilt and power
    columns: change of a − b by each fitted freedom (p, m)
    dofs: fitted;  moved: b by how much, [m], [rad], power [1/m]
    refused: freedoms that the surface does not determine, and why
    from_a, from_b: the local fits
    b_x, b_y: the places in the second measurement's own frame [m]
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
    refused: dict[str, str]
    from_a: LocalHeights
    from_b: LocalHeights
    b_x: FloatArray
    b_y: FloatArray

    @property
    def difference(self) -> FloatArray:
        """a − b at the places [m], (m,)."""
        return self.a - self.b

    def without_fit(self, values: FloatArray) -> FloatArray:
        """Return values (…, m) less what the fitted freedoms explain of them."""
        design = self.columns.T / np.linalg.norm(self.columns, axis=1)
        solved = np.linalg.lstsq(design, values.T, rcond=1e-10)[0]
        return np.asarray(values - (design @ solved).T, np.float64)


def ordered_dofs(names: Sequence[str]) -> tuple[str, ...]:
    """Return freedoms in their order; ConfigurationError for a name that is none."""
    for name in names:
        if name not in DEGREES_OF_FREEDOM:
            raise ConfigurationError(
                f"freedom {name!r} is unknown, expected one of {[*DEGREES_OF_FREEDOM]}"
            )
    return tuple(name for name in DEGREES_OF_FREEDOM if name in names)


def match(a: LocalQuadratic, b: LocalQuadratic, grid: HeightGrid, dofs: Sequence[str]) -> Matched:
    """Move ``b`` onto ``a`` by ``dofs`` and take both at the places of ``grid``.

    grid: whose heights do not matter

    Raises DataError where they share too few places, or a fit does not settle.
    """
    places = _Places(a, b, grid)
    wanted = ordered_dofs(dofs)
    moved = dict.fromkeys(wanted, 0.0)
    seen = places.seen(moved, wanted)
    refused = _not_determined(seen.columns, places.columns_of_first(seen.filled, wanted), grid.dx)
    left = tuple(name for name in wanted if name not in refused)
    for _ in range(_TURNS):
        seen = places.seen(moved, left)
        step = seen.step()
        lateral_step = {name: step.pop(name) for name in _LATERAL if name in step}
        if _is_converged(lateral_step, grid.dx, float(np.ptp(places.x))):
            return places.matched(seen, {**moved, **step}, step, refused)
        for name, value in lateral_step.items():
            moved[name] += value
    raise DataError(
        "shift and clocking of the second measurement do not settle; place it nearer, or fit "
        "fewer freedoms"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Both measurements where they have heights, and what each freedom does there (n,)."""

    filled: BoolArray
    a: FloatArray
    b: FloatArray
    columns: dict[str, FloatArray]
    there: LocalHeights
    u: FloatArray
    v: FloatArray

    def step(self) -> dict[str, float]:
        """Return the least-squares size of each freedom."""
        design = np.stack(list(self.columns.values()), axis=1)
        scale = np.linalg.norm(design, axis=0)
        solved = np.linalg.lstsq(design / scale, self.a - self.b, rcond=1e-10)[0] / scale
        return dict(zip(self.columns, map(float, solved), strict=True))


class _Places:
    """The places of a grid, and both measurements there."""

    def __init__(self, a: LocalQuadratic, b: LocalQuadratic, grid: HeightGrid) -> None:
        self._b, self._grid = b, grid
        self.x, self.y = (part.ravel() for part in np.meshgrid(grid.x, grid.y))
        self._here = a.at(self.x, self.y)

    def seen(self, moved: Mapping[str, float], dofs: Sequence[str]) -> _Seen:
        """Take the second measurement once it is ``moved``."""
        there, u, v = _resampled_after_move(self._b, self.x, self.y, moved)
        filled = np.isfinite(self._here.value) & np.isfinite(there.value)
        if np.sum(filled) < _FEWEST_PLACES:
            raise DataError(
                f"the two measurements share {np.sum(filled)} places of "
                f"{quantity(self._grid.dx, 'm')}, expected {_FEWEST_PLACES} or more; "
                "do they lie in one frame, and in one unit?"
            )
        columns = {n: _column(n, u, v, there)[filled] for n in dofs}
        heights = (self._here.value[filled], there.value[filled])
        return _Seen(filled, *heights, columns, there, u[filled], v[filled])

    def columns_of_first(self, filled: BoolArray, dofs: Sequence[str]) -> dict[str, FloatArray]:
        """Return what each freedom does to the first measurement where both have heights (n,)."""
        here, x, y = _heights_at(self._here, filled), self.x[filled], self.y[filled]
        return {name: _column(name, x, y, here) for name in dofs}

    def matched(
        self, seen: _Seen, moved: dict[str, float], step: dict[str, float], refused: dict[str, str]
    ) -> Matched:
        """Return what was found, the freedoms of ``step`` taken off."""
        level = sum((value * seen.columns[name] for name, value in step.items()), np.zeros(1))
        flat = np.full(self.x.size, np.nan)
        flat[seen.filled] = seen.a - seen.b - level
        shape = self._grid.height.shape
        return Matched(
            grid=replace(self._grid, height=flat.reshape(shape)),
            filled=seen.filled,
            x=self.x[seen.filled],
            y=self.y[seen.filled],
            a=seen.a,
            b=seen.b + level,
            columns=np.stack(list(seen.columns.values())),
            dofs=tuple(seen.columns),
            moved={name: value for name, value in moved.items() if name not in refused},
            refused=refused,
            from_a=_heights_at(self._here, seen.filled),
            from_b=_heights_at(seen.there, seen.filled),
            b_x=seen.u,
            b_y=seen.v,
        )


def _resampled_after_move(
    b: LocalQuadratic, x: FloatArray, y: FloatArray, moved: Mapping[str, float]
) -> tuple[LocalHeights, FloatArray, FloatArray]:
    """Return b where its points lie once moved to x, y, and those places in b's own frame."""
    angle = moved.get("clocking", 0.0)
    dx, dy = x - moved.get("x", 0.0), y - moved.get("y", 0.0)
    u = dx * np.cos(angle) + dy * np.sin(angle)
    v = -dx * np.sin(angle) + dy * np.cos(angle)
    return b.at(u, v), u, v


def _column(name: str, x: FloatArray, y: FloatArray, there: LocalHeights) -> FloatArray:
    """Change of b's height at a place if b is moved by one unit of the freedom."""
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
) -> dict[str, str]:
    """Return which lateral freedoms the surface does not separate from the others, and why.

    columns, of_first: of the second and of the first measurement. What both have in common is of
    the surface; the rest is the noise of their slopes.
    """
    refused: dict[str, str] = {}
    for name in _LATERAL:
        if name not in columns:
            continue
        others = [n for n in columns if n != name and n not in refused]
        own, first = (
            _independent_part(of[name], [of[n] for n in others]) for of in (columns, of_first)
        )
        share = float(np.linalg.norm(own)) / max(float(np.linalg.norm(columns[name])), 1e-300)
        # By one place, or by what that is at the rim: a smaller change nobody would see.
        reach = place if name != "clocking" else 1e-2
        common = max(float(np.mean(own * first)), 0.0)
        effect = np.sqrt(common) * reach
        noisy = common < _LEAST_RELIABLE * float(np.mean(own**2))
        if share < _LEAST_OWN_SHARE or effect < 1e-10 or noisy:
            refused[name] = (
                "the surface looks alike wherever it is: moved by "
                f"{quantity(reach, 'rad' if name == 'clocking' else 'm', 2)} it changes by "
                + (f"{quantity(effect, 'm', 1)}" if effect > 1e-12 else "nothing beyond noise")
            )
    return refused


def _independent_part(column: FloatArray, others: Sequence[FloatArray]) -> FloatArray:
    """Return the part of a column (n,) that the others, if there are any, do not explain."""
    if not others:
        return column
    design = np.stack(others, axis=1) / [float(np.linalg.norm(c)) for c in others]
    return np.asarray(column - design @ np.linalg.lstsq(design, column, rcond=1e-10)[0])


def _is_converged(lateral_step: dict[str, float], place: float, extent: float) -> bool:
    reach = {"x": place, "y": place, "clocking": 2 * place / extent}
    return all(abs(value) < _SETTLED * reach[name] for name, value in lateral_step.items())


def _heights_at(heights: LocalHeights, place: BoolArray) -> LocalHeights:
    return LocalHeights(*(getattr(heights, name)[place] for name in LocalHeights.__slots__))
