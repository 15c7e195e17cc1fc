"""Evaluate slopes and limits of a nominal surface, and compute offsets of the next cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.form.compensation import ToolPath, compensation, path_gcode, spiral_offsets
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.limits import MachineLimits, speed_limits
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.height_grid import gradient_of
from omsm_ros.errors import DataError
from omsm_ros.io.files import save_bytes, save_text
from omsm_ros.pipelines.form import MeasurementMeasuredPortions as OpenedMeasurement
from omsm_ros.quantities import SAMPLE_PERIOD
from omsm_ros.readable import percent, quantity
from omsm_ros.units import RPM_HZ

FIGURE = "surface.png"
_ACROSS = 401
# A spiral is fastest at the rim, so four turns there determine the demands on the axes.
_TURNS, _SAMPLES_PER_TURN = 4, 2000
_BAND = "calibrated band"


@dataclass(frozen=True)
class Scan:
    """A spiral from ``radius`` [m] with ``feed`` [m] a turn at ``speed`` [rpm]."""

    radius: float
    feed: float
    speed: float


def show_surface(
    surface: Surface,
    scan: Scan,
    limits: MachineLimits,
    probe_angle: float | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Return extent, steepest slope and limits of a surface over a disc; draw it into ``out``.

    probe_angle: largest angle to the normal at which the probe reads [rad]; None: unknown

    Raises DataError if the surface has no height somewhere on the disc.
    """
    x, y, height, steep = _over_disc(surface, scan.radius)
    place = int(np.argmax(steep))
    angle = float(np.arctan(steep[place]))
    evaluated, missing = speed_limits(_path(surface, scan), limits, np.inf, np.inf)
    evaluated = [limit for limit in evaluated if limit.name != _BAND]
    if probe_angle is None:
        missing.append("angle of the probe to the surface")
    if out is not None:
        # Imported on demand, because loading the figures takes longer than the evaluation.
        from omsm_ros.report.measurement.figures import deviation_map
        from omsm_ros.report.style import png

        made = deviation_map(
            x, y, height - height.min(), unit="µm", title="Nominal height [µm]",
            limits=(0.0, float(np.ptp(height)) or 1e-9), quantity="above the lowest point",
        )  # fmt: skip
        save_bytes(out / FIGURE, png(made))
    return {
        "radius": scan.radius,
        "peak_to_valley": float(np.ptp(height)),
        "steepest_slope": float(steep[place]),
        "steepest_angle": angle,
        "steepest_at": [float(x[place]), float(y[place])],
        "probe_angle": probe_angle,
        "probe_can_follow": None if probe_angle is None else bool(angle <= probe_angle),
        "axes_can_follow": all(limit.speed_factor >= 1 for limit in evaluated),
        "limits": [asdict(limit) for limit in evaluated],
        "not_evaluated": [_BAND, *(name for name in missing if name != _BAND)],
        **({"figure": FIGURE} if out is not None else {}),
    }


def _over_disc(
    surface: Surface, radius: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return x, y, height [m] and slope [1] on the disc, each (n,)."""
    line = np.linspace(-radius, radius, _ACROSS)
    x, y = (v.ravel() for v in np.meshgrid(line, line))
    inside = x**2 + y**2 <= radius**2
    x, y = x[inside], y[inside]
    height = surface.height(x, y)
    if not np.all(np.isfinite(height)):
        raise DataError(
            f"the surface has no height at {int(np.sum(~np.isfinite(height)))} of {len(x)} points "
            f"of a disc of radius {radius!r} m; give a smaller radius, or check its parameters"
        )
    return x, y, height, np.hypot(*gradient_of(surface, x, y))


def _path(surface: Surface, scan: Scan) -> ScanPath:
    spiral = Spiral(surface, scan.radius, scan.feed, scan.speed)
    period = max(1 / (abs(scan.speed) * RPM_HZ * _SAMPLES_PER_TURN), SAMPLE_PERIOD.low)
    turns = min(_TURNS * _SAMPLES_PER_TURN, int(spiral.duration / period))
    axes = spiral.positions(np.arange(max(turns, 100)) * period)
    return ScanPath(z=axes.z, sample_period=period, x=axes.x, c=axes.c)


COMPENSATION, PATH = "compensation.csv", "compensation.nc"
# Coverage factor beyond which an offset is significant, at 95 %.
_COVERAGE = 2.0
# With a smaller share of the area significant, the cut follows the noise of the measurement.
_LEAST_SIGNIFICANT_SHARE = 0.5
# A cut that leaves a larger share of the rms is not worth while.
_LARGEST_REMAINDER = 0.9
_HEAD = "x_m,y_m,offset_m,uncertainty_m\n"


def compensate_form(
    measured: OpenedMeasurement,
    surface: Surface,
    out: Path,
    low_pass: float,
    asked: Sequence[str],
    aperture: Aperture | None = None,
    spiral: tuple[float, int] | None = None,
) -> dict[str, Any]:
    """Write compensation.csv into ``out``: offsets to add to the height of the next cut.

    asked, aperture: as for ``omsm form``
    low_pass: cutoff wavelength, of which half is compensated [m]
    spiral: feed per turn [m] and points per turn of the next cut, for compensation.nc; None: none

    Raises DataError as ``omsm form`` does, and for a wavelength that the points do not resolve.
    """
    form = measured.form(surface, asked, aperture)
    found = compensation(form.map, surface, low_pass)
    x, y = np.meshgrid(found.x, found.y)
    known = np.isfinite(found.offset)
    columns = [values[known].tolist() for values in (x, y, found.offset, found.uncertainty)]
    lines = (",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    save_text(out / COMPENSATION, _HEAD + "\n".join(lines) + "\n")
    path = {} if spiral is None else _along(spiral_offsets(found, *spiral), out)
    sure = np.abs(found.offset[known]) > _COVERAGE * found.uncertainty[known]
    return {
        "file": COMPENSATION,
        **path,
        "places": int(np.sum(known)),
        "low_pass": low_pass,
        "removed": list(form.registration.dofs.fitted),
        "rms_before": found.before,
        "rms_after": found.after,
        "largest_offset": float(np.max(np.abs(found.offset[known]))),
        "largest_uncertainty": float(np.max(found.uncertainty[known])),
        "surer_than_zero": float(np.mean(sure)),
        "warnings": _warnings(float(np.mean(sure)), found.before, found.after),
        "sign": "add offset_m to the height of the surface that is cut, along z, positive away from"
        " the part; x and y are those of the nominal surface",
        "not_evaluated": [] if measured.systematic else ["systematic errors of the measurement"],
    }


def _along(path: ToolPath, out: Path) -> dict[str, Any]:
    save_text(out / PATH, path_gcode(path))
    return {"path": PATH, "path_places": len(path.offset), "path_left_out": path.left_out}


def _warnings(sure: float, before: float, after: float) -> list[str]:
    """Return warnings against the cut."""
    found = []
    if sure < _LEAST_SIGNIFICANT_SHARE:
        found.append(
            f"on {percent(1 - sure)} of the area the offset is less than twice its uncertainty: a "
            "cut would transfer measurement errors to the part; measure more accurately, fit fewer "
            "degrees of freedom (--fit piston,tip,tilt), or give a longer --low-pass"
        )
    if after > _LARGEST_REMAINDER * before:
        found.append(
            f"the cut would leave {quantity(after, 'm')} of {quantity(before, 'm')} rms, which is "
            "shorter than --low-pass"
        )
    return found
