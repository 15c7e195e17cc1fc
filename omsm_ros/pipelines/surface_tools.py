"""What a nominal surface asks of the probe and of the axes."""

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
# At the rim a spiral is fastest; four turns of it show what the axes must do.
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

    probe_angle: to the normal, at which the probe still reads [rad]; None: not known

    Raises DataError where the surface has no height within the disc.
    """
    x, y, height, steep = _over_disc(surface, scan.radius)
    place = int(np.argmax(steep))
    angle = float(np.arctan(steep[place]))
    evaluated, missing = speed_limits(_path(surface, scan), limits, np.inf, np.inf)
    evaluated = [limit for limit in evaluated if limit.name != _BAND]
    if probe_angle is None:
        missing.append("angle of the probe to the surface")
    if out is not None:
        # Here, because drawing takes longer to load than all else takes.
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
            f"the surface has no height on {int(np.sum(~np.isfinite(height)))} of {len(x)} places "
            f"of a disc of radius {radius!r} m; give a smaller radius, or check its parameters"
        )
    return x, y, height, np.hypot(*gradient_of(surface, x, y))


def _path(surface: Surface, scan: Scan) -> ScanPath:
    spiral = Spiral(surface, scan.radius, scan.feed, scan.speed)
    period = max(1 / (abs(scan.speed) * RPM_HZ * _SAMPLES_PER_TURN), SAMPLE_PERIOD.low)
    turns = min(_TURNS * _SAMPLES_PER_TURN, int(spiral.duration / period))
    axes = spiral.positions(np.arange(max(turns, 100)) * period)
    return ScanPath(z=axes.z, sample_period=period, x=axes.x, c=axes.c)


# From a measurement to the table of offsets for the next cut.

COMPENSATION, PATH = "compensation.csv", "compensation.nc"
# Of its standard uncertainty: an offset beyond it is there at 95 %.
_SURE = 2.0
# Of the area; with less of it sure, the cut follows the noise of the measurement.
_LEAST_SIGNIFICANT_SHARE = 0.5
# Of the rms before; a cut that leaves more is hardly worth it.
_MOST_LEFT = 0.9
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
    """Write compensation.csv into ``out``: what to add to the height of the next cut.

    low_pass: wavelength of which half is compensated [m]; the others as for ``omsm form``
    spiral: feed a turn [m] and places of each of the next cut, for compensation.nc; None: without

    Raises DataError as ``omsm form`` does, and for a wavelength finer than the points resolve.
    """
    form = measured.form(surface, asked, aperture)
    found = compensation(form.map, surface, low_pass)
    x, y = np.meshgrid(found.x, found.y)
    known = np.isfinite(found.offset)
    columns = [values[known].tolist() for values in (x, y, found.offset, found.uncertainty)]
    lines = (",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    save_text(out / COMPENSATION, _HEAD + "\n".join(lines) + "\n")
    path = {} if spiral is None else _along(spiral_offsets(found, *spiral), out)
    sure = np.abs(found.offset[known]) > _SURE * found.uncertainty[known]
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
    """Return what speaks against the cut."""
    found = []
    if sure < _LEAST_SIGNIFICANT_SHARE:
        found.append(
            f"on {percent(1 - sure)} of the area the offset is less than twice its uncertainty: a "
            "cut would put errors of the measurement onto the part; measure with less, hold "
            "freedoms (--fit piston,tip,tilt), or take a longer --low-pass"
        )
    if after > _MOST_LEFT * before:
        found.append(
            f"the cut would leave {quantity(after, 'm')} rms of {quantity(before, 'm')}: the rest "
            "is finer than --low-pass"
        )
    return found
