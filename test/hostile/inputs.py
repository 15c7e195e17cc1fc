"""Hostile inputs for every door: files, messages and arguments, one or a few things wrong."""

from __future__ import annotations

import json
import math
from typing import Any

from hypothesis import strategies as st

from omsm_ros.core.calibration.calibration import content_id

NUMBERS = st.one_of(
    st.sampled_from([0, -0.0, 1, -1, 5, 1e-300, 1e300, -1e300, 5e-324, 1e-15, 1e15, 1e5, 1000.0]),
    st.sampled_from([2**31, 2**32, 2**53, 2**62, 2**63 - 1, 2**63, 2**64, -(2**63), 10**400]),
    st.sampled_from([math.nan, math.inf, -math.inf]),
    st.floats(),
    st.floats(-1, 1),
)
TEXTS = st.one_of(
    st.sampled_from(["", "yes", "accepted", "\ud800", "\0", "n" * 300, "../../etc/passwd", "%s"]),
    st.text(max_size=20),
)
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.one_of(NUMBERS, TEXTS, st.none(), st.booleans()),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Bytes with some changed, cut off, doubled or put in."""
    content = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(content) - 1, 0)))
        match draw(st.sampled_from(["flip", "cut", "insert", "zero", "repeat", "head"])):
            case "flip" if content:
                content[place] ^= draw(st.integers(1, 255))
            case "cut":
                del content[place:]
            case "insert":
                content[place:place] = draw(st.binary(max_size=40))
            case "zero":
                length = len(content[place : place + 64])
                content[place : place + length] = bytes(length)
            case "repeat":
                content[place:place] = content[place : place + 500]
            case "head":
                del content[: min(place, 64)]
    return bytes(content)


# Calibrations.


@st.composite
def calibration_texts(draw: st.DrawFn, content: dict[str, Any]) -> bytes:
    """``CAL.json`` with a few fields changed, its id made to fit or not, or damaged as a text."""
    changed: dict[str, Any] = json.loads(json.dumps(content))
    changed.pop("id", None)
    for _ in range(draw(st.integers(0, 3))):
        _change(draw, changed)
    if draw(st.integers(0, 9)):
        try:
            changed["id"] = content_id(changed)
        except (ValueError, OverflowError):  # JSON has no such number: sign what it reads
            changed["id"] = "0" * 64
    text = json.dumps(changed).encode("utf-8", "surrogatepass")
    return draw(damaged(text)) if draw(st.integers(0, 4)) == 0 else text


@st.composite
def model_texts(draw: st.DrawFn, content: dict[str, Any]) -> bytes:
    """``MODEL.json`` with a few fields changed, its parts' too, or damaged as a text."""
    changed: dict[str, Any] = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(0, 3))):
        part = draw(st.just(changed))
        if isinstance(part, dict) and part:
            _change(draw, part)
    text = json.dumps(changed).encode("utf-8", "surrogatepass")
    return draw(damaged(text)) if draw(st.integers(0, 4)) == 0 else text


def _change(draw: st.DrawFn, content: dict[str, Any]) -> None:
    name = draw(st.sampled_from(sorted(content)))
    value = content[name]
    if isinstance(value, list) and value and draw(st.booleans()):
        place = draw(st.integers(0, len(value) - 1))
        match draw(st.sampled_from(["set", "scale", "drop", "more"])):
            case "set":
                value[place] = draw(NUMBERS)
            case "scale" if isinstance(value[place], int | float) and abs(value[place]) < 2**64:
                value[place] *= draw(st.sampled_from([-1, 0, 1e-30, 1e-3, 1e3, 1e5, 1e30]))
            case "drop":
                del value[place]
            case "more":
                value[place:place] = draw(st.lists(NUMBERS, max_size=70))
    elif isinstance(value, dict) and draw(st.booleans()):
        known = sorted(value) or ["verdict"]
        named = st.sampled_from([*known, "verdict", "reasons", "noise_m", "latency"])
        value[draw(named)] = draw(VALUES)
    elif draw(st.integers(0, 5)) == 0:
        del content[name]
    else:
        content[name] = draw(st.one_of(NUMBERS, VALUES))


# YAML and CSV.

_YAML_PARTS = st.sampled_from([
    "shape: sphere", "radius: 0.1", "radius: 1e300", "radius: .nan", "radius: !!float 1",
    "radius: !!timestamp 2020-01-01", "radius: &a [*a]", "a: &a [1,1]", "b: &b [*a,*a]",
    "c: [*b,*b]", "shape: off_axis_paraboloid", "parent_focal_length: 0.0254",
    "off_axis_distance: 0.0508", "radius: " + "9" * 400, "radius: 0x10", "radius: 1:30",
    "shape: flat", "level: 1e-3", "level: -1e9", "<<: {radius: 1}", "? [1, 2]\n: 3", "- 1",
    "radius: !!python/object/apply:os.system [ls]", "centre_x: 1e-5", "beam_x: 0.01",
    "beam_x: 7", "centre_x: null", "probe_z: yes", "abbe_arm: 1e-400", "---", "...", "radius: 0",
    "centre_x: {a: 1}", "\tx: 1", "%YAML 9.9", "'\\x'", "\"\\ud800\": 1", "radius: '0.1'",
])  # fmt: skip
YAML_TEXTS = st.one_of(
    st.lists(_YAML_PARTS, max_size=5).map(lambda parts: "\n".join(parts).encode()),
    st.builds(lambda n, c: (c * n).encode(), st.integers(0, 2000), st.sampled_from("[{-:&*!?\"' ")),
    st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass")),
    st.binary(max_size=200),
    st.dictionaries(
        st.sampled_from(["shape", "radius", "level", "centre_x", "beam_x", "probe_z"]), VALUES
    ).map(lambda content: json.dumps(content).encode()),
)


@st.composite
def motion_texts(draw: st.DrawFn) -> bytes:
    """A planned motion with a few numbers or lines wrong."""
    period = draw(st.sampled_from([1e-3, 1e-3, 1e-3, 1e-8, 1e-300, 0.0, 1e3, 1e300]))
    lines = ["time_s,z_m", *(f"{k * period!r},{1e-6 * math.sin(k / 9)!r}" for k in range(600))]
    for _ in range(draw(st.integers(0, 4))):
        place = draw(st.integers(0, len(lines) - 1))
        lines[place] = draw(
            st.one_of(
                st.tuples(NUMBERS, NUMBERS).map(lambda pair: ",".join(map(str, pair))),
                st.sampled_from(["", ",", "a,b", "1", "1,2,3", "#", "1;2", "0x1,1", "1e-3,1e-6"]),
                st.text(max_size=10),
            )
        )
    text = "\n".join(lines).encode("utf-8", "surrogatepass")
    return draw(damaged(text)) if draw(st.integers(0, 5)) == 0 else text
