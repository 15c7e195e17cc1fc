"""``SOURCES.yaml``: what it says arrives, what is wrong with it is named on one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.descriptions import load_sources

HEAD = "schema: omsm-sources/1\nsources:\n"
TILT = "{source: tilt, value: 5.0e-6, unit: rad, how: declared, reason: dial gauge}"
WAVE = (
    "{source: spindle_axial, per_turn: 2, value: 8.0e-9, unit: m, distribution: arcsine, "
    "how: evaluated, reason: ball}"
)
NOISE = "{source: probe_noise, value: 1.0e-8, unit: m, how: evaluated, reason: fixed target}"


def load(folder: Path, *items: str, head: str = HEAD):
    path = folder / "sources.yaml"
    path.write_text(head + "".join(f"  - {item}\n" for item in items), encoding="utf-8")
    return load_sources(path)


def test_what_is_stated_arrives(tmp_path):
    found = load(tmp_path, TILT, WAVE, NOISE)
    assert found.point_uncertainties() == {"probe_noise": 1e-8}
    tilt, wave = found.scan_sources()
    assert (tilt.name, tilt.standard_uncertainty, tilt.origin) == ("tilt", 5e-6, "declared")
    assert wave.standard_uncertainty == pytest.approx(8e-9 / 2**0.5)
    assert wave.reason == "ball"


def test_a_source_may_have_its_former_name(tmp_path):
    late = "{source: lateral_lag, value: 3.0e-6, unit: s, how: declared, reason: data sheet}"
    assert load(tmp_path, late).point_uncertainties() == {"probe_latency": 3e-6}


@pytest.mark.parametrize(
    ("item", "says"),
    [
        (TILT.replace("rad", "mrad"), "tilt is stated in 'mrad', expected 'rad'"),
        (NOISE.replace("unit: m", "unit: nm"), "probe_noise is stated in 'nm', expected 'm'"),
        (TILT.replace("unit: rad, ", ""), "unit is required and missing"),
        (TILT.replace("tilt", "tlit"), "'tlit' is unknown, expected one of"),
        (WAVE.replace("per_turn: 2, ", ""), "spindle_axial needs per_turn"),
        (TILT.replace("5.0e-6", "yes"), "value is 'yes', expected a number"),
        (TILT.replace("declared", "guessed"), "how is 'guessed'"),
        (TILT.replace("how", "who"), "'who' is unknown"),
        (TILT.replace("5.0e-6", "-5.0e-6"), "tilt is -5e-06 rad"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, item, says):
    with pytest.raises(FileError, match=says) as error:
        load(tmp_path, item)
    assert "\n" not in str(error.value)


def test_another_schema_is_refused(tmp_path):
    with pytest.raises(FileError, match="schema is 'omsm-sources/2', expected 'omsm-sources/1'"):
        load(tmp_path, TILT, head=HEAD.replace("/1", "/2"))


def test_two_statements_of_a_noise_are_refused(tmp_path):
    with pytest.raises(FileError, match="probe_noise is stated 2 times"):
        load(tmp_path, NOISE, NOISE)
