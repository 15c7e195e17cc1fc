"""Parameters of a nominal shape that are estimated from the points, such as its radius.

Radii and focal lengths are estimated as curvatures 1/R, in which heights are nearly linear.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError

INVERSE = ("radius", "radius_x", "radius_y", "parent_focal_length")
"""Parameters that are estimated as their inverse."""
SHAPE_PARAMETERS = (*INVERSE, "conic_constant", "conic_x", "conic_y", "off_axis_distance")
"""Names of the parameters that can be estimated, those of the shapes."""
ALIASES = {
    "conic": "conic_constant",
    "focal length": "parent_focal_length",
    "focal_length": "parent_focal_length",
}
# Largest radius [m], of a plane, and steps of central differences: relative, and least.
_FLAT_M, _SHARE, _STEP = 9e9, 1e-4, 1e-5
# Share of the radius within which the middle of the points is the origin, and of the curvature
# below which a direction is straight.
_CENTRED, _CYLINDER = 0.25, 1e-2
# Least radius at the start, in half widths of the points.
_LEAST_RADIUS = 1.2


def shape_range(name: str) -> float:
    """Return the largest plausible size of an estimated parameter [1/m], [1] or [m]."""
    return 1e4 if name in INVERSE else 100.0 if name.startswith("conic") else 1.0


def external(name: str, value: float, spread: float | None) -> tuple[float, float | None]:
    """Return value and standard uncertainty of the parameter itself from those estimated."""
    if name not in INVERSE:
        return value, spread
    return 1 / value, None if spread is None else spread / value**2


def _stated(surface: Any, name: str) -> Any:
    """Return the value of a parameter of the shape, or of that which it holds.

    Raises ConfigurationError if there is none.
    """
    inner = surface
    while not hasattr(inner, name):
        inner = getattr(inner, "surface", None) or getattr(inner, "parent", None)
        if inner is None:
            raise ConfigurationError("registration.no_parameter", name=name, surface=repr(surface))
    return getattr(inner, name)


def with_parameters(surface: Any, values: Mapping[str, float]) -> Any:
    """Return the surface with these ``values`` of its parameters themselves."""
    own = {f.name for f in fields(surface)}
    changes: dict[str, Any] = {name: value for name, value in values.items() if name in own}
    for name in own & {"surface", "parent"}:
        changes[name] = with_parameters(getattr(surface, name), values)
    return replace(surface, **changes) if changes else surface


def estimated_shape(surface: Any, values: Mapping[str, float]) -> Any:
    """Return the surface with these estimated ``values``, curvatures instead of radii."""
    made = {}
    for name, value in values.items():
        if name in INVERSE:
            value = 1 / (np.copysign(max(abs(value), 1 / _FLAT_M), value))
            value = abs(value) if name == "parent_focal_length" else value
        made[name] = float(value)
    return with_parameters(surface, made)


def shape_columns(
    surface: Surface, values: Mapping[str, float], x: FloatArray, y: FloatArray
) -> FloatArray:
    """Return the derivatives (s, n) of the height at x, y (n,) [m] by the estimated ``values``."""
    rows = np.empty((len(values), len(x)))
    for row, (name, value) in enumerate(values.items()):
        step = max(_SHARE * abs(value), _STEP)
        high, low = (
            estimated_shape(surface, {**values, name: value + s}).height(x, y)
            for s in (step, -step)
        )
        rows[row] = (high - low) / (2 * step)
    return np.nan_to_num(rows, copy=False)


def start_of(
    surface: Any, names: tuple[str, ...], x: FloatArray, y: FloatArray, height: FloatArray
) -> tuple[dict[str, float], FloatArray]:
    """Return values to start the estimate from: curvatures of the points, else those stated.

    The second value is the place x, y (2,) [m] where the vertex is expected: the origin, unless it
    is farther from the middle of the points than a quarter of their radius; then the place among
    them where they are level.

    Raises ConfigurationError for a parameter that the surface does not have.
    """
    stated = {name: _stated(surface, name) for name in names}
    inverse = [n for n in names if n in INVERSE]
    flat = estimated_shape(surface, dict.fromkeys(inverse, 0.0))
    rest = height - (flat.height(x, y) if inverse else 0.0)
    u, v = x - x.mean(), y - y.mean()
    columns = np.stack([np.ones_like(u), u, v, u * u / 2, v * v / 2, u * v])
    good = np.isfinite(rest)
    curved = np.linalg.lstsq(columns[:, good].T, rest[good], rcond=1e-12)[0]
    radius = float(np.hypot(u, v).max())
    most = 1 / (_LEAST_RADIUS * radius)
    curvature = {"radius_x": curved[3], "radius_y": curved[4], "parent_focal_length": 2 * curved[4]}
    found = {}
    for name in names:
        if name in INVERSE:
            value = float(curvature.get(name, (curved[3] + curved[4]) / 2))
            found[name] = float(np.clip(value, -most, most))
        else:
            found[name] = float(stated[name])
    if np.hypot(x.mean(), y.mean()) < _CENTRED * radius:
        return found, np.zeros(2)
    hessian = np.array([[curved[3], curved[5]], [curved[5], curved[4]]])
    away = -np.linalg.lstsq(hessian, curved[1:3], rcond=_CYLINDER)[0]
    away *= min(1.0, radius / max(float(np.hypot(*away)), 1e-300))
    return found, np.array([x.mean(), y.mean()]) + away
