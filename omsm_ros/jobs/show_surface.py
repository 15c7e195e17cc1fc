"""What a nominal surface asks of the probe and of the axes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.machine.limits import MachineLimits, speed_limits
from omsm_ros.core.machine.scan_path import ScanPath
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.machine.trajectories import Spiral
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.slopes import gradient_of
from omsm_ros.errors import DataError
from omsm_ros.quantities import SAMPLE_PERIOD
from omsm_ros.storage.files import save_bytes
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
        from omsm_ros.report.common.style import png
        from omsm_ros.report.measurement.figures import deviation_map

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
