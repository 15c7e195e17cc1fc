"""Files that people write of their machine: every name by its unit, every refusal by its name."""

from __future__ import annotations

import math
from dataclasses import asdict, fields

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.kinematics.limits import MachineLimits
from omsm_ros.errors import FileError
from omsm_ros.io.descriptions import (
    load_geometry,
    load_limits,
    load_motion,
    load_pitch,
    save_geometry,
)
from omsm_ros.io.tables.table import load_column_map
from omsm_ros.units import UNITS

PLACE = st.floats(-1, 1)


@pytest.fixture
def file(tmp_path):
    def made(text, name="a.yaml"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return made


@settings(max_examples=40)
@given(st.lists(PLACE, min_size=7, max_size=7), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_a_geometry_comes_back_to_the_last_bit_and_any_yaml_reads_it(tmp_path_factory, at, bx, by):
    path = tmp_path_factory.mktemp("geometry") / "g.yaml"
    made = Geometry(**dict(zip((f.name for f in fields(Geometry)), at, strict=True))
                    | {"beam_x": bx, "beam_y": by})  # fmt: skip
    save_geometry(path, made)
    assert load_geometry(path) == made
    assert yaml.safe_load(path.read_text()) == asdict(made)


@pytest.mark.parametrize("name", [f.name for f in fields(MachineLimits)])
def test_each_limit_is_read_under_its_own_name_and_no_other_changes(file, name):
    found = load_limits(file(f"{name}: 0.5\n"))
    assert getattr(found, name) == 0.5
    others = {n: v for n, v in asdict(found).items() if n != name}
    assert others == {n: v for n, v in asdict(MachineLimits()).items() if n != name}


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("servo: 50\n", r"'servo' is unknown, expected one of \['exposure', 'motion_frequency'"),
        ("z_jerk: fast\n", "z_jerk is 'fast', expected a number; write digits with a decimal"),
        ("z_jerk: 0\n", "z_jerk is 0.0 .*expected a number from"),
        ("z_jerk: -3.0\n", "z_jerk is -3.0 .*expected a number"),
        ("exposure: 1e13\n", "exposure is 1.*give it in seconds"),
        ("- 3\n", "expected 'name: value' lines"),
    ],
)
def test_a_limit_that_cannot_be_is_named(file, text, reported):
    with pytest.raises(FileError, match=rf"^limits .*a.yaml'.*{reported}"):
        load_limits(file(text))


def test_a_pitch_is_read_by_its_names_in_si(file):
    curve = load_pitch(file("note,pitch_rad,z_m\n7,1e-6,-0.01\n8,3e-6,0.02\n", "p.csv"))
    assert curve.position.tolist() == [-0.01, 0.02]
    assert curve.angle.tolist() == [1e-6, 3e-6]


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("z_mm,pitch_rad\n0,0\n1,0\n", "has 0 columns 'z_m'"),
        ("z_m,pitch_rad\n0,0\n0,1e-6\n", "do not increase; sort them"),
        ("z_m,pitch_rad\n0,0\n1000,0\n", r"z_m\[1\] is 1000.0 m, expected .* give it in metres"),
        ("z_m,pitch_rad\n0,0\n1,90\n", r"pitch_rad\[1\] is 90.0 rad, expected"),
    ],
)
def test_a_pitch_that_cannot_be_is_named(file, text, reported):
    with pytest.raises(FileError, match=rf"p.csv'.*{reported}"):
        load_pitch(file(text, "p.csv"))


@settings(max_examples=30)
@given(
    st.lists(st.floats(-1, 1), min_size=2, max_size=8), st.floats(1e-5, 1.0), st.floats(-1e3, 1e3)
)
def test_a_motion_is_its_places_and_the_step_of_its_times(tmp_path_factory, z, period, start):
    path = tmp_path_factory.mktemp("motion") / "m.csv"
    times = [start + k * period for k in range(len(z))]
    rows = (f"{t!r},{v!r}" for t, v in zip(times, z, strict=True))
    path.write_text("time_s,z_m\n" + "\n".join(rows))
    places, found = load_motion(path)
    assert places.tolist() == z
    assert found == pytest.approx(period, rel=1e-3)


@pytest.mark.parametrize(
    ("times", "reported"),
    [
        ("0 1 2 2", "step|steps of 0 to 1 s, expected even steps; sample the motion evenly"),
        ("0 1 2 3.1", "steps of 1 to 1.1 s, expected even steps"),
        ("3 2 1 0", "step of time_s is -1.0 s"),
        ("0 100 200 300", "step of time_s is 100.0 s, expected .* to 10 s"),
    ],
)
def test_a_motion_of_uneven_times_is_refused(file, times, reported):
    text = "time_s,z_m\n" + "".join(f"{t},0\n" for t in times.split())
    with pytest.raises(FileError, match=rf"motion .*m.csv'.*({reported})"):
        load_motion(file(text, "m.csv"))


# MAP.yaml.


def mapping(extra="", **columns):
    still = dict.fromkeys("xybc", "{constant: 0}")
    lines = "".join(f"  {c}: {v}\n" for c, v in (still | columns).items())
    return f"sample_period: 0.001\n{extra}columns:\n{lines}"


@pytest.mark.parametrize(
    ("channel", "unit", "factor"),
    [(c, u, f) for c, units in UNITS.items() for u, f in units.items()],
)
def test_every_unit_of_every_channel_is_its_factor(file, channel, unit, factor):
    column = f"{{name: N, unit: '{unit}', sign: -1}}"
    mapped, _ = load_column_map(file(mapping(**{"z": "{name: Z, unit: m}", channel: column})))
    found = mapped.columns[channel]
    assert (found.name, found.factor) == ("N", 1.0 if channel == "trigger" else -factor)
    assert found.unit == unit


def test_the_metres_of_a_unit_are_those_of_the_si():
    """By decimal arithmetic and the definition of the inch and of the circle."""
    assert UNITS["z"] == {"m": 1, "mm": 0.001, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "inch": 0.0254}
    assert UNITS["c"]["deg"] == pytest.approx(math.pi / 180, rel=1e-15)
    assert UNITS["c"]["turn"] == pytest.approx(2 * math.pi, rel=1e-15)
    assert UNITS["time"]["unix_ms"] == 1e-3


@pytest.mark.parametrize("sign", [1, -1])
def test_a_constant_and_a_count_are_taken_in_their_unit(file, sign):
    text = mapping(z=f"{{name: Z, unit: count, count: 2.5e-9, sign: {sign}}}",
                   b=f"{{constant: 90, unit: deg, sign: {sign}}}")  # fmt: skip
    mapped, _ = load_column_map(file(text))
    assert mapped.columns["z"].factor == 2.5e-9 * sign
    assert mapped.columns["b"].constant == pytest.approx(sign * math.pi / 2)
    assert not mapped.has("b")


def test_how_a_text_is_written_is_taken_over(file):
    extra = ("delimiter: ';'\ndecimal: ','\nzone: '+01:00'\nlines_before_names: 3\n"
             "lines_after_names: 1\ninvalid: [-999, '---', 1e9]\n")  # fmt: skip
    mapped, form = load_column_map(file(mapping(extra, z="{name: Z, unit: mm}")))
    assert mapped.invalid == (-999.0, 1e9)
    assert (form.delimiter, form.decimal, form.zone) == (";", ",", "+01:00")
    assert (form.lines_before, form.lines_after) == (3, 1)
    assert form.missing == ("---",)
    assert form.named
    _, form = load_column_map(file(mapping(z="{name: '[3]', unit: mm}")))
    assert not form.named


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        (mapping(z="{name: Z, unit: rad}"), "z has the unit 'rad'; write one of"),
        (mapping(z="{name: Z, unit: count, count: 0}"), "z: one count is 0 in SI, expected"),
        (mapping(z="{unit: m}"), "z needs a column's name, or a constant; give one of them"),
        (mapping(trigger="{constant: 0}"), "trigger is constant, which tells no sample from"),
        (mapping(time="{constant: 0, unit: s}"), "time is constant, which tells no sample from"),
        (mapping(z="{name: Z, unit: m, sign: 2}"), r"columns.z.sign is 2, expected one of \[1, -1"),
        (mapping(z="{name: Z, unit: m, scale: 2}"), "'scale' is unknown, expected one of"),
        (mapping("zone: CET\n", z="{name: Z, unit: m}"), "zone is 'CET'"),
        (mapping("lines_before_names: -1\n", z="{name: Z, unit: m}"), "is -1, expected 0 to 1000"),
        (mapping("sample_period: 0.001\n", z="{name: Z, unit: m}"), "is repeated"),
        ("sample_period: 0.001\n", "columns is required and missing"),
    ],
)
def test_invalid_map_entries_are_reported_with_their_place(file, text, reported):
    with pytest.raises(FileError, match=rf"^map .*a.yaml'.*{reported}") as refused:
        load_column_map(file(text))
    assert "\n" not in str(refused.value)


def test_a_table_of_any_size_keeps_its_order(file):
    z = np.sin(np.arange(5000.0))
    text = "time_s,z_m\n" + "".join(f"{k / 1024!r},{v!r}\n" for k, v in enumerate(z.tolist()))
    places, period = load_motion(file(text, "m.csv"))
    np.testing.assert_array_equal(places, z)
    assert period == 1 / 1024
