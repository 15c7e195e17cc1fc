"""Profiles of a map: along x, y and 45°, over the radius, and around."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from omsm_ros.core.form.figures import DeviationMap
from omsm_ros.core.form.power_density import Curve
from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.deviation import Profile, line_profile, radial_profile

# Shares of the radius: half the width of a line's band, and the length of its stretches.
_HALF_WIDTH, _SPACING = 1 / 100, 1 / 100
# Around, the outer third of the radius is averaged over each of so many degrees.
_OUTER, _DEGREES = 2 / 3, 2.0
# Rings are as narrow as the turns of the scan allow, but for a tenth of the radius.
_RINGS, _COVERED = (1 / 50, 1 / 25, 1 / 10), 0.8

Averaging = Callable[[FloatArray], Profile]


def profiles(map_: DeviationMap, disc: Aperture) -> dict[str, Curve]:
    """Return the mean deviations [m] over x, y, the diagonal, radius [m], and angle [rad].

    Uncertainties are from the points' noise and from all sources of error. A profile that no point
    is near to is left out.
    """
    x, y = map_.x - disc.x, map_.y - disc.y
    band = {"half_width": _HALF_WIDTH * disc.radius, "spacing": _SPACING * disc.radius}
    made: dict[str, Averaging] = {
        name: lambda d, angle=angle: line_profile(x, y, d, angle=angle, **band)  # type: ignore[misc]
        for name, angle in (("x", 0.0), ("y", np.pi / 2), ("diagonal", np.pi / 4))
    }
    width = _ring(x, y, disc.radius)
    made["radius"] = lambda d: radial_profile(x, y, d, spacing=width)
    made["angle"] = lambda d: _around(x, y, d, disc.radius)
    found = {name: _curve(map_, average) for name, average in made.items()}
    return {name: curve for name, curve in found.items() if len(curve.position)}


def _ring(x: FloatArray, y: FloatArray, radius: float) -> float:
    """Return the least width of rings [m] most of which were seen all around."""
    reach = np.hypot(x, y)
    extent = float(reach.max() - reach.min())
    for width in np.array(_RINGS) * radius:
        found = radial_profile(x, y, reach, spacing=float(width))
        if len(found.position) * width >= _COVERED * extent:
            return float(width)
    return float(_RINGS[-1] * radius)


def _around(x: FloatArray, y: FloatArray, deviation: FloatArray, radius: float) -> Profile:
    outer = np.hypot(x, y) >= _OUTER * radius
    angle = np.arctan2(y[outer], x[outer])
    count = round(360 / _DEGREES)
    place = np.floor((angle + np.pi) / (2 * np.pi) * count).astype(np.int64) % count
    points = np.bincount(place, minlength=count)
    filled = points > 0

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, values, count)[filled] / points[filled])

    return Profile(position=mean(angle), value=mean(deviation[outer]), points=points[filled])


def _curve(map_: DeviationMap, average: Averaging) -> Curve:
    profile = average(map_.deviation)
    variance = map_.noise**2 / np.maximum(profile.points, 1)
    for effect in map_.effects:
        variance = variance + average(effect).value ** 2
    return Curve(profile.position, profile.value, np.sqrt(variance))
