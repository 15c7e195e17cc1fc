"""Descriptions in YAML or JSON that were right before somebody changed a few places of them."""

from __future__ import annotations

import copy
import json
from typing import Any

from hostile.inputs import NUMBERS, VALUES, damaged
from hypothesis import strategies as st

from omsm_ros.core.calibration.calibration import content_id

_SCALES = st.sampled_from([-1, 0, 1e-30, 1e-6, 1e-3, 1e3, 1e6, 1e30])


def _places(content: Any) -> list[tuple[Any, Any]]:
    """Every container with every key or index in it."""
    if isinstance(content, dict | list):
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        return [place for key in keys for place in ((content, key), *_places(content[key]))]
    return []


@st.composite
def changed(draw: st.DrawFn, whole: Any) -> Any:
    """A copy with one to three places set, scaled, left out, doubled or renamed."""
    content = copy.deepcopy(whole)
    for _ in range(draw(st.integers(1, 3))):
        places = _places(content)
        if not places:
            break
        inside, key = draw(st.sampled_from(places))
        value = inside[key]
        match draw(st.sampled_from(["number", "value", "scale", "drop", "again", "rename"])):
            case "number":
                inside[key] = draw(NUMBERS)
            case "value":
                inside[key] = draw(VALUES)
            case "scale" if isinstance(value, int | float) and abs(value) < 2**64:
                inside[key] = value * draw(_SCALES)
            case "drop":
                del inside[key]
            case "again" if isinstance(inside, list):
                inside[key:key] = [value] * draw(st.sampled_from([1, 3, 60, 1200]))
            case "rename" if isinstance(inside, dict):
                inside[draw(st.text(max_size=8))] = inside.pop(key)
    return content


@st.composite
def changed_texts(draw: st.DrawFn, *wholes: Any) -> bytes:
    """One of the descriptions as JSON, which YAML has as a part, a little of it changed."""
    content = draw(changed(draw(st.sampled_from(wholes))))
    text = json.dumps(content).encode("utf-8", "surrogatepass")
    return draw(damaged(text)) if draw(st.integers(0, 6)) == 0 else text


@st.composite
def changed_calibrations(draw: st.DrawFn, whole: dict[str, Any]) -> bytes:
    """A calibration set with a few places changed, its ids made to fit where that can be."""
    content = draw(changed(whole))
    if draw(st.integers(0, 9)) and isinstance(content, dict):
        members = content.get("members")
        for member in members if isinstance(members, list) else ():
            if isinstance(member, dict):
                _sign(member.get("calibration"))
        _sign(content)
    return json.dumps(content).encode("utf-8", "surrogatepass")


def _sign(content: Any) -> None:
    if isinstance(content, dict):
        content.pop("id", None)
        try:
            content["id"] = content_id(content)
        except (ValueError, OverflowError):  # JSON has no such number
            content["id"] = "0" * 64


SURFACES: tuple[dict[str, Any], ...] = (
    {"shape": "flat", "level": 1e-3},
    {"shape": "sphere", "radius": -0.1, "pose": {"tip": 1e-3, "x": 1e-4, "clocking": 0.3}},
    {"shape": "off_axis_paraboloid", "parent_focal_length": 0.0254, "off_axis_distance": 0.05},
    {"shape": "asphere", "radius": 0.1, "conic_constant": -0.5, "even_terms": [0, 1.0, 10.0]},
    {"shape": "asphere", "radius": 0.1, "odd_terms": [0, 1e-3, 0.5]},
    {"shape": "toroid", "radius_x": 0.1, "radius_y": 0.2, "conic_constant": -1},
    {"shape": "biconic", "radius_x": 0.1, "radius_y": 0.2, "conic_x": -1, "conic_y": 0.1},
    {"shape": "xy_polynomial", "radius": 6e-3, "terms": [{"x": 2, "y": 1, "value": 1e-6}] * 3},
    {"shape": "zernike", "radius": 6e-3, "coefficients": [0, 0, 0, 1e-6, 1e-7, 1e-8]},
    {"shape": "zernike", "radius": 6e-3, "coefficients": [1e-7] * 9, "indexing": "noll"},
    {"shape": "q_bfs", "aperture_radius": 6e-3, "radius": 0.1, "coefficients": [1e-6, 1e-7]},
    {"shape": "q_freeform", "aperture_radius": 6e-3, "terms": [{"n": 1, "m": -2, "value": 1e-6}]},
    {"shape": "q_con", "aperture_radius": 6e-3, "radius": 0.1, "coefficients": [1e-6, 1e-7]},
    {"shape": "off_axis_section", "parent": {"shape": "sphere", "radius": 0.1}, "distance": 0.02},
    {"shape": "sum", "parts": [{"shape": "flat"}, {"shape": "sphere", "radius": 0.2}]},
    {"shape": "grid", "file": "good.xyz", "unit": "mm"},
)
SOURCES = {
    "schema": "omsm-sources/1",
    "sources": [
        {"source": name, "value": value, "unit": unit, "how": "declared", "reason": "gauge"} | more
        for name, value, unit, more in (
            ("tilt", 5e-6, "rad", {}),
            ("decentre", 1e-5, "m", {"distribution": "uniform"}),
            ("encoder_noise", 4e-10, "m", {}),
            ("spindle_axial", 8e-9, "m", {"per_turn": 2, "distribution": "arcsine"}),
            ("straightness_x", 2e-8, "m", {"correlation_length": 5e-3}),
            ("pitch", 1e-6, "rad", {"correlation_length": 0.1}),
            ("encoder_interpolation", 2e-9, "m", {"period": 2e-5}),
            ("probe_linearity", 5e-9, "m", {"half_range": 5e-5}),
            ("drift", 1e-8, "m", {"correlation_time": 600.0}),
            ("drift_walk", 1e-9, "m/√s", {}),
            ("probe_slope", 1e-8, "m/rad", {}),
        )
    ],
}
LIMITS = {
    "servo_frequency": 50.0, "probe_range": 1e-4, "spindle_speed_rpm": 120.0,
    "motion_frequency": 50.0, "z_acceleration": 1.0, "z_jerk": 100.0, "point_spacing": 5e-5,
    "exposure": 2e-4, "timing": 1e-6, "x_beyond": 4e-3,
}  # fmt: skip
GEOMETRY = {"centre_x": 1e-6, "centre_y": 1e-6, "beam_x": 1e-3, "abbe_arm": 0.05}
COLUMNS = {
    "sample_period": 1e-3,
    "start": 1763200000.0,
    "columns": {
        "trigger": {"name": "n"},
        "time": {"name": "t", "unit": "s"},
        "x": {"name": "X", "unit": "mm"},
        "y": {"constant": 0, "unit": "m"},
        "z": {"name": "Z", "unit": "mm", "sign": -1},
        "b": {"constant": 0, "unit": "rad"},
        "c": {"name": "C", "unit": "deg"},
        "distance": {"name": "d", "unit": "count", "count": 1.5e-9},
        "intensity": {"name": "i", "unit": "%"},
    },
    "invalid": [-9999],
}
