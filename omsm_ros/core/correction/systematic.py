"""Which errors act on a whole scan together, and what does each do to every height of it?

Noise averages out over points; a tilt, a centre that is off or a calibration that is wrong does
not. Such a source is a *sensitivity field* over the scan: the change of each height for one unit
of the source. With the standard uncertainty ``u`` of the source, the standard uncertainty of a
linear figure ``L`` of the heights (a mean, a Zernike coefficient) is ``u |L(field)|``; independent
sources, and the independent components of one source, add in squares (GUM, 5.1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from omsm_ros.core.machine.kinematics import workpiece_xy
from omsm_ros.core.machine.surface_height import Surface, slopes_by_differences
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.quantities import MAP_SPACING

EVALUATED, DECLARED, NOT_EVALUATED = "evaluated", "declared", "not evaluated"

# Without a nominal surface its slopes come from a polynomial through the points.
_POLYNOMIAL_DEGREE = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPoints:
    """Points of a scan in the order of time, each array (n,): what a sensitivity field looks at.

    time: since the start [s];  x, y, height: in the workpiece frame [m]
    z: of the probe, H(z) [m];  z_rate: its rate [m/s];  c: angle of the spindle [rad]
    distance: that the probe measured, growing with height [m]
    slope_x, slope_y: of the surface along the workpiece's x and y [1]; None where it is not known
    dynamics: of the heights by each independent direction of the calibration's covariance, per
        standard uncertainty [m], (r, n);  hidden: which of them are of what its step test could
        not show (r,)
    """

    time: FloatArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    z: FloatArray
    z_rate: FloatArray
    c: FloatArray
    distance: FloatArray
    slope_x: FloatArray | None = None
    slope_y: FloatArray | None = None
    dynamics: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    hidden: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))

    def __len__(self) -> int:
        return len(self.time)

    @property
    def slide_x(self) -> FloatArray:
        """Of the point from the spindle axis, along X of the machine [m], (n,)."""
        return self._slides[0]

    @property
    def slide_y(self) -> FloatArray:
        """Of the point from the spindle axis, along Y of the machine [m], (n,)."""
        return self._slides[1]

    @cached_property
    def _slides(self) -> tuple[FloatArray, FloatArray]:
        # Few sources ask for them, and a cosine costs as much as a filter.
        return workpiece_xy(self.x, self.y, -self.c)

    def with_slopes(self, surface: Surface | None) -> ScanPoints:
        """Return the points with the slopes of the nominal ``surface``.

        Without one they are those of a polynomial of degree 6 through the points themselves.
        """
        if surface is None:
            slope_x, slope_y = _polynomial_slopes(self.x, self.y, self.height)
        else:
            slope_x, slope_y = slopes_by_differences(surface, self.x, self.y)
        return replace(self, slope_x=slope_x, slope_y=slope_y)

    def sideways(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the change of height [m] at its place of points taken for ``x``, ``y`` [m] off.

        A point reported at x + δ has the height of x: against the surface ``-δ ∂S/∂x``.
        Raises DataError where the slopes are not known.
        """
        if self.slope_x is None or self.slope_y is None:
            raise DataError("the slope of the surface is not known; give a nominal surface")
        return np.asarray(-self.slope_x * x - self.slope_y * y, np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class SystematicSource:
    """A source of error that acts on the whole scan together.

    name: of the source;  unit: of its size, SI
    standard_uncertainty: of each of its independent components [unit], k = 1
    fields: change of each height [m] per unit of each component, (k, n), for ``ScanPoints``
    origin: EVALUATED from data, or DECLARED by somebody;  reason: in words
    needs_slope: True if the fields need the slope of the surface
    squares: sum of the squares of the fields, (n,), where that is had with less work

    Raises ConfigurationError for an uncertainty that is no finite number of zero or more.
    """

    name: str
    unit: str
    standard_uncertainty: float
    fields: Callable[[ScanPoints], FloatArray]
    origin: str = DECLARED
    reason: str = ""
    needs_slope: bool = False
    squares: Callable[[ScanPoints], FloatArray] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.standard_uncertainty < np.inf:
            raise ConfigurationError(
                f"{self.name}: standard uncertainty {self.standard_uncertainty!r} {self.unit}, "
                "expected zero or more"
            )

    def standard_fields(self, points: ScanPoints) -> FloatArray:
        """Return the change of the heights [m] per standard uncertainty, (k, n)."""
        return np.asarray(self.standard_uncertainty * self.fields(points), np.float64)

    def variance(self, points: ScanPoints) -> FloatArray:
        """Return the variance of each height [m²], (n,)."""
        if self.squares is None:
            return np.asarray(np.sum(self.standard_fields(points) ** 2, axis=0), np.float64)
        return np.asarray(self.standard_uncertainty**2 * self.squares(points), np.float64)


def standard_fields(
    sources: Sequence[SystematicSource], points: ScanPoints
) -> dict[str, FloatArray]:
    """Return by name the change of the heights [m] per standard uncertainty, each (k, n).

    Sources of one name are one source with all their components.
    """
    found: dict[str, list[FloatArray]] = {}
    for source in sources:
        found.setdefault(source.name, []).append(source.standard_fields(points))
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _polynomial_slopes(
    x: FloatArray, y: FloatArray, height: FloatArray
) -> tuple[FloatArray, FloatArray]:
    scale = float(max(np.max(abs(x), initial=0.0), np.max(abs(y), initial=0.0)))
    scale = scale if scale > MAP_SPACING.low else 1.0  # all is one place, but for the last bits
    powers = [(i, j) for i in range(_POLYNOMIAL_DEGREE + 1) for j in range(i + 1)]
    u, v = (np.vander(a / scale, _POLYNOMIAL_DEGREE + 1, increasing=True) for a in (x, y))
    design = np.stack([u[:, i - j] * v[:, j] for i, j in powers], axis=1)
    coefficient = np.linalg.lstsq(design, height, rcond=None)[0] / scale
    slope_x, slope_y = np.zeros(len(x)), np.zeros(len(x))
    for value, (i, j) in zip(coefficient, powers, strict=True):
        if i > j:
            slope_x += value * (i - j) * u[:, i - j - 1] * v[:, j]
        if j:
            slope_y += value * j * u[:, i - j] * v[:, j - 1]
    return slope_x, slope_y
