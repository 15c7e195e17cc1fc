"""All figures of a scan in one call, by the names the page knows."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface import deviation as form
from omsm_ros.report.common import style
from omsm_ros.report.measurement import figures
from omsm_ros.report.measurement.cloud_view import CloudView

# Of the aperture: the width of a profile's band, and the length of its stretches.
_BAND_SHARE = 1 / 200
_STRETCHES = 200


def surface_figures(
    cloud: CloudView,
    nominal: Surface | None,
    *,
    true_height: FloatArray | None = None,
    true_error_left: FloatArray | None = None,
) -> dict[str, bytes]:
    """Return PNG files of a cloud; without a nominal surface a map of the height and of the error.

    true_height, true_error_left: of each point [m], (n,), known on the twin only
    """
    made = {"dynamic_error": _error_trace(cloud, true_error_left)}
    if true_error_left is not None:
        made["error_histogram"] = style.png(
            figures.error_histogram(
                cloud.dynamic_error, true_error_left, cloud.area, left="after (true error left)"
            )
        )
    if nominal is None:
        return {**made, **_height_maps(cloud)}
    heights = {"raw": cloud.raw_height, "corrected": cloud.height}
    if true_height is not None:
        heights["true"] = true_height
    deviations = {name: levelled(cloud, h, nominal) for name, h in heights.items()}
    return {**made, **_maps(cloud, deviations), **_profiles(cloud, deviations)}


def levelled(cloud: CloudView, height: FloatArray, nominal: Surface) -> FloatArray:
    """Return ``height`` (n,) [m] less the nominal surface and its mean over the area."""
    away = form.deviation(cloud.x, cloud.y, height, nominal)
    return form.level(cloud.x, cloud.y, away, weights=cloud.area)


def _error_trace(cloud: CloudView, left: FloatArray | None) -> bytes:
    return style.png(
        figures.dynamic_error(
            cloud.time, cloud.dynamic_error, after=left, uncertainty=cloud.uncertainty
        )
    )


def _height_maps(cloud: CloudView) -> dict[str, bytes]:
    height = cloud.height - cloud.height.min()
    limits = (0.0, float(height.max()) or 1.0)
    return {
        "height_map": style.png(
            figures.deviation_map(
                *(cloud.x, cloud.y, height),
                unit="µm",
                title="Height [µm]",
                limits=limits,
                quantity="above the lowest point",
            )
        ),
        "error_map": style.png(
            figures.deviation_map(
                *(cloud.x, cloud.y, cloud.dynamic_error),
                unit="µm",
                title="Dynamic error [µm]",
                quantity="dynamic error",
            )
        ),
    }


def _maps(cloud: CloudView, deviations: dict[str, FloatArray]) -> dict[str, bytes]:
    x, y, raw, corrected = cloud.x, cloud.y, deviations["raw"], deviations["corrected"]
    limits = figures.symmetric_limits(x, y, raw)
    drawn = {
        "raw_map": figures.deviation_map(
            x, y, raw, unit="µm", title="Uncorrected [µm]", limits=limits
        ),
        "corrected_map_same_scale": figures.deviation_map(
            x, y, corrected, unit="µm", title="Corrected, same scale [µm]", limits=limits
        ),
        "corrected_map": figures.deviation_map(
            x, y, corrected, unit="nm", title="Corrected, enlarged [nm]"
        ),
    }
    return {name: style.png(figure) for name, figure in drawn.items()}


_LINES = {
    "profile_x": (0.0, "Profile along x", "x"),
    "profile_y": (np.pi / 2, "Profile along y", "y"),
    "profile_diagonal": (np.pi / 4, "Profile at 45°", "distance along x = y"),
}


def _profiles(cloud: CloudView, deviations: dict[str, FloatArray]) -> dict[str, bytes]:
    x, y = cloud.x, cloud.y
    size = 2 * float(np.hypot(x, y).max())
    feed = _feed(cloud)
    # Whole turns: over a part of one the errors of other orders would not average out.
    spacing = feed * np.ceil(size / _STRETCHES / feed) if feed else size / _STRETCHES
    made = {}
    for name, (angle, title, position) in _LINES.items():
        cuts = {
            kind: form.line_profile(
                x, y, value, angle=angle,
                half_width=size * _BAND_SHARE / 2, spacing=spacing,
            )
            for kind, value in deviations.items()
        }  # fmt: skip
        if len(cuts["raw"].position):
            made[name] = _profile(cuts, title, position)
    rings = {
        kind: form.radial_profile(x, y, value, spacing=spacing)
        for kind, value in deviations.items()
    }
    if len(rings["raw"].position):
        made["profile_radius"] = _profile(rings, "Mean over each ring", "radius")
    return made


def _feed(cloud: CloudView) -> float:
    """Return the radius gained per turn of a spiral [m]; 0 where the cloud makes no turn."""
    turns = abs(np.ptp(np.unwrap(np.arctan2(cloud.y, cloud.x)))) / (2 * np.pi)
    return float(np.ptp(np.hypot(cloud.x, cloud.y)) / turns) if turns >= 1 else 0.0


def _profile(cuts: dict[str, form.Profile], title: str, position: str) -> bytes:
    return style.png(
        figures.profile(
            cuts["raw"], cuts["corrected"], title=title, position=position, true=cuts.get("true")
        )
    )
