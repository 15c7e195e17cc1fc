"""``DISTURBANCES.yaml``: what it may hold, and what it says of what it may not."""

from __future__ import annotations

from pathlib import Path

import pytest
from written_disturbances import write_disturbances

import omsm_ros
from benchmarks.disturbance_catalogue import CATALOGUE, together
from omsm_ros.errors import FileError
from omsm_ros.io.descriptions import load_disturbances
from omsm_ros.twin.disturbances import NOTHING

SHIPPED = Path(omsm_ros.__file__).resolve().parent.parent / "config" / "disturbances.yaml"


def _load(tmp_path, text):
    path = tmp_path / "disturbances.yaml"
    path.write_text(text)
    return load_disturbances(path)


@pytest.mark.parametrize("name", CATALOGUE)
def test_what_is_written_is_read_again(tmp_path, name):
    for size in CATALOGUE[name]:
        write_disturbances(tmp_path / "d.yaml", size)
        assert load_disturbances(tmp_path / "d.yaml") == size


def test_many_at_once_are_read_again(tmp_path):
    names = ("creep, 2 s", "base mode, 8 Hz", "spindle, axial twice a turn", "reference late")
    many = NOTHING
    for name in names:
        many = together(many, CATALOGUE[name][1])
    write_disturbances(tmp_path / "d.yaml", many)
    assert load_disturbances(tmp_path / "d.yaml") == many


def test_nothing_is_nothing(tmp_path):
    assert _load(tmp_path, "probe: {}\nvibration: []\n") == NOTHING


def test_the_shipped_file_says_what_its_comments_say():
    shipped = load_disturbances(SHIPPED)
    assert shipped.probe.slope_error_m_per_rad2 * 0.1**2 == pytest.approx(10e-9)
    assert shipped.structure.creep[0].time_constant_s == 5.0
    assert [line.per_turn for line in shipped.vibration] == [11]
    assert shipped.reference is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("prob: {}", "'prob' is unknown"),
        ("probe: {latency: 1e-3}", "'latency' is unknown"),
        (
            "probe: {latency_s: '1,5'}",
            "is '1,5', expected a number; write digits with a decimal point",
        ),
        ("probe: {latency_s: true}", "probe.latency_s is True, expected a number"),
        ("probe: {averages: 1.5}", "probe.averages is 1.5, expected a"),
        ("probe: {latency_s: -1e-3}", "probe: latency_s is -0.001"),
        ("probe: {latency_s: 100}", "probe: latency_s is 100"),
        ("structure: {creep: 3}", "structure.creep is 3, expected a list"),
        ("structure: {creep: [{fraction: 1e-3}]}", "time_constant_s is required"),
        ("vibration: [{amplitude_m: 1e-9}]", "frequency_hz and per_turn are both zero"),
        ("machine: {pose: {tilt_x_rad: 1e9}}", "machine: pose: tilt_x_rad is 1000000000"),
        ("machine: {mount: {beam_x: 7.0}}", "beam_x"),
        ("reference: null", "reference is None, expected names and values"),
        ("[1, 2]", "expected 'name: value' lines"),
    ],
)
def test_what_cannot_be_is_named_with_its_place(tmp_path, text, said):
    with pytest.raises(FileError) as caught:
        _load(tmp_path, text)
    assert said in str(caught.value)
    assert "disturbances.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rows_are_bounded(tmp_path):
    rows = "".join("- {amplitude_m: 1e-9, frequency_hz: 5}\n" for _ in range(101))
    with pytest.raises(FileError, match="expected at most 100"):
        _load(tmp_path, f"vibration:\n{rows}")


def test_a_file_that_is_not_there_is_said_so(tmp_path):
    with pytest.raises(FileError, match=r"nowhere\.yaml"):
        load_disturbances(tmp_path / "nowhere.yaml")
