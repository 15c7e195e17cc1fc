"""Slopes and limits of a nominal surface, against closed forms."""

import json

import numpy as np
import pytest

from omsm_ros.cli import main
from omsm_ros.cli.form import show_surface
from omsm_ros.core.kinematics.limits import MachineLimits
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.surface.aspheres import Asphere, Sphere, Toroid
from omsm_ros.errors import DataError

SCAN = 0.01, 1e-4, 30.0


def test_extent_and_slope_are_those_of_the_sphere():
    found = show_surface(Spiral(Sphere(0.05), *SCAN), MachineLimits())
    assert found["peak_to_valley"] == pytest.approx(0.05 - np.sqrt(0.05**2 - 0.01**2), rel=1e-4)
    assert found["steepest_angle"] == pytest.approx(np.arcsin(0.2), rel=1e-4)
    assert np.hypot(*found["steepest_at"]) == pytest.approx(0.01, rel=1e-3)
    assert found["probe_can_follow"] is None
    assert "angle of the probe to the surface" in found["not_evaluated"]


@pytest.mark.parametrize("surface", [Sphere(0.5), Sphere(0.02), Asphere(0.02)])
def test_a_round_part_asks_for_no_motion_but_the_feed(surface):
    found = show_surface(Spiral(surface, *SCAN), MachineLimits())
    limit = next(each for each in found["limits"] if each["name"] == "motion frequency")
    assert limit["value"] == 0.0
    assert found["axes_can_follow"]


@pytest.mark.parametrize(("angle", "follows"), [(0.1, False), (0.3, True)])
def test_the_probe_follows_up_to_its_angle(angle, follows):
    assert (
        show_surface(Spiral(Sphere(0.05), *SCAN), MachineLimits(), angle)["probe_can_follow"]
        is follows
    )


def test_an_axis_follows_a_cylinder_only_as_fast_as_it_can():
    """Two swings a turn: amplitude r²/4R, acceleration (2ω)² of it."""
    amplitude, omega = 0.01**2 / 4 / 1.0, 2 * 2 * np.pi * 0.5
    found = show_surface(Spiral(Toroid(1.0), *SCAN), MachineLimits(z_acceleration=2e-3))
    limit = next(each for each in found["limits"] if each["name"] == "Z acceleration")
    assert limit["value"] == pytest.approx(amplitude * omega**2, rel=0.03)
    assert found["axes_can_follow"]
    slow = show_surface(Spiral(Toroid(1.0), *SCAN), MachineLimits(z_acceleration=0.9e-3))
    assert not slow["axes_can_follow"]


def test_beyond_its_end_there_is_nothing_to_show():
    with pytest.raises(DataError, match=r"no height at .* radius 0.01 m"):
        show_surface(Spiral(Asphere(0.009), *SCAN), MachineLimits())


def test_the_command_draws_it(tmp_path, capsys):
    path = tmp_path / "surface.yaml"
    path.write_text("shape: toroid\nradius_x: 0.1\nradius_y: 0.05\n")
    words = ["surface", "show", str(path), "--radius", "0.01", "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (tmp_path / found["figure"]).read_bytes().startswith(b"\x89PNG")
    assert main([*words[:-2], "--probe-angle", "0.1"]) == 0
    said = capsys.readouterr().out
    assert "CANNOT follow" in said
    assert "11.5°" in said
    for wrong in ("-0.1", "90"):
        assert main([*words[:-2], f"--probe-angle={wrong}"]) == 2
        assert "expected a number from 0 to 1.57" in capsys.readouterr().err
