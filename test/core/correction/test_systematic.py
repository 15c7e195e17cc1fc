"""Sensitivity fields against the geometry that they are derivatives of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.correction.source_kinds import KINDS, SystematicSource, standard_fields
from omsm_ros.core.correction.systematic import DECLARED, ScanPoints
from omsm_ros.core.kinematics.kinematics import Geometry, workpiece_points
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.twin.machine_errors import Harmonic, SpindleError
from omsm_ros.twin.part import MountedSurface, PartPose

from .systematic_scan import spiral_points

SMALL = 1e-6
PARAMETERS = {
    "static_gain": {"gain": 0.99},
    "spindle_axial": {"per_turn": 2},
    "spindle_radial": {"per_turn": 2},
    "spindle_tilt": {"per_turn": 1},
    "c_error": {"per_turn": 1},
    "encoder_interpolation": {"period": 4e-6},
    "probe_linearity": {"half_range": 50e-6},
    "probe_periodic": {"period": 7e-6},
    "pitch": {"arm": 0.1},
    "drift": {"correlation_time": 10.0},
}


@pytest.fixture(scope="module")
def points() -> ScanPoints:
    return spiral_points()


def made(name: str, value: float = 1.0) -> SystematicSource:
    return SystematicSource(name, value, DECLARED, "stated here", PARAMETERS.get(name, {}))


def fields(name: str, points: ScanPoints) -> np.ndarray:
    return made(name).standard_fields(points)


def difference(name: str, found: np.ndarray, expected: np.ndarray, limit: float = 2e-3) -> None:
    """Equal but for a piston, to a part in a thousand of the largest."""
    error = (found - expected) - np.mean(found - expected)
    assert np.max(abs(error)) < limit * np.ptp(expected), name


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_has_fields_in_proportion_to_its_size(name: str, points: ScanPoints) -> None:
    one, two = (made(name, size).standard_fields(points) for size in (1e-6, 2e-6))
    assert one.shape[1] == len(points)
    assert np.all(np.isfinite(one))
    assert np.allclose(two, 2 * one)
    # Only what comes from a calibration is nothing without one.
    assert np.any(one) or name in ("dynamics", "undetected_model_error")


POSES = {
    "tilt": (PartPose(tilt_y_rad=SMALL), PartPose(tilt_x_rad=SMALL)),
    "decentre": (PartPose(x_m=SMALL), PartPose(y_m=SMALL)),
    "clocking": (PartPose(clocking_rad=SMALL),),
}


@pytest.mark.parametrize("name", POSES)
def test_pose_is_what_the_posed_surface_says(name: str, points: ScanPoints) -> None:
    for field, pose in zip(fields(name, points), POSES[name], strict=True):
        moved = MountedSurface(PAPER_MIRROR, pose).height(points.x, points.y)
        # A tilt moves a point laterally by its height, which is left out: a hundredth here.
        limit = 2e-2 if name == "tilt" else 2e-3
        difference(name, field, (moved - points.height) / SMALL, limit)


GEOMETRIES = {
    "centre_x": (Geometry(centre_x=SMALL),),
    "centre_y": (Geometry(centre_y=SMALL),),
    "beam": (Geometry(beam_x=SMALL), Geometry(beam_y=SMALL)),
}


@pytest.mark.parametrize("name", GEOMETRIES)
def test_geometry_is_what_the_kinematics_say(name: str, points: ScanPoints) -> None:
    slides = (points.slide_x, points.slide_y, points.z)
    for field, geometry in zip(fields(name, points), GEOMETRIES[name], strict=True):
        seen = workpiece_points(geometry, slides, np.zeros(len(points)), points.c, points.distance)
        against = seen.height - PAPER_MIRROR.height(seen.x, seen.y)
        # The points come out where a machine without the fault would have looked: the other sign.
        sign = -1 if name.startswith("centre") else 1
        difference(name, field, sign * against / SMALL)


def test_the_spindle_is_the_twins(points: ScanPoints) -> None:
    """Both quadratures: the second is a quarter of a turn of the vector later."""
    wave = [Harmonic(amplitude=1.0, per_turn=2, phase_rad=phase) for phase in (0.0, np.pi / 2)]
    assert len(fields("spindle_axial", points)) == len(wave)
    for number, harmonic in enumerate(wave):
        axes = type("Axes", (), {"x": points.slide_x, "y": points.slide_y, "c": points.c})()
        axial = SpindleError(axial_m=(harmonic,)).shift(points.time, axes, [])
        found = fields("spindle_axial", points)[number]
        assert np.allclose(abs(found), abs(axial.z))
        radial = SpindleError(radial_m=(harmonic,)).shift(points.time, axes, [])
        shifted = Sphere(0.1).height(points.x, points.y)
        on_sphere = replace(points, height=shifted).with_slopes(Sphere(0.1))
        across = fields("spindle_radial", on_sphere)[number]
        # On a sphere only the component along the radius matters, here X of the machine.
        expected = radial.x * points.slide_x / 0.1
        # To second order in the aperture over the radius of curvature.
        assert np.allclose(across, -expected, atol=0.01 * np.max(abs(expected)))


def test_a_scale_of_the_encoder_stretches_z(points: ScanPoints) -> None:
    assert np.allclose(fields("encoder_scale", points)[0], points.z)


def test_expansion_is_the_swollen_part(points: ScanPoints) -> None:
    strain = 1e-6
    swollen = PAPER_MIRROR.height(points.x / (1 + strain), points.y / (1 + strain)) * (1 + strain)
    difference("expansion", fields("expansion", points)[0], (swollen - points.height) / strain)


def test_gain_and_linearity_follow_the_distance(points: ScanPoints) -> None:
    gain = 0.99
    found = points.distance * gain / (gain + SMALL) - points.distance
    difference("static_gain", fields("static_gain", points)[0], found / SMALL)
    assert np.max(fields("probe_linearity", points)) == pytest.approx(0.4**3, rel=1e-3)


def test_slopes_without_a_nominal_surface_are_those_of_the_points(points: ScanPoints) -> None:
    free = points.with_slopes(None)
    assert points.slope_x is not None
    assert free.slope_x is not None
    assert np.max(abs(free.slope_x - points.slope_x)) < 1e-3 * np.max(abs(points.slope_x))


def test_places_that_are_one_but_for_their_last_bits_have_no_slope(points: ScanPoints) -> None:
    bits = np.arange(len(points)) % 7 * 5e-324
    found = replace(points, x=bits, y=bits[::-1]).with_slopes(None)
    assert found.slope_x is not None
    assert np.max(np.abs(found.slope_x)) < 1e-3


def test_without_slopes_what_needs_them_is_refused() -> None:
    blind = replace(spiral_points(50), slope_x=None, slope_y=None)
    assert 5 < sum(kind.needs_slope for kind in KINDS.values()) < len(KINDS)
    for name, kind in KINDS.items():
        if kind.needs_slope:
            with pytest.raises(DataError, match="give a nominal surface"):
                fields(name, blind)
        else:
            fields(name, blind)


def test_sources_of_one_name_are_one_source(points: ScanPoints) -> None:
    twice = [SystematicSource("spindle_axial", 1e-9, DECLARED, "", {"per_turn": k}) for k in (1, 2)]
    assert standard_fields(twice, points)["spindle_axial"].shape == (4, len(points))


def test_a_flat_has_no_lateral_errors() -> None:
    flat = spiral_points(100).with_slopes(Flat())
    for name in ("decentre", "clocking", "centre_x", "spindle_radial", "probe_slope"):
        assert not np.any(fields(name, flat)), name


@pytest.mark.parametrize(
    ("name", "value", "parameters", "says"),
    [
        ("tilt", -1.0, {}, "tilt is -1.0 rad"),
        ("tilt", 1e-6, {"per_turn": 2}, "no parameter 'per_turn'"),
        ("spindle_axial", 1e-9, {}, "needs per_turn"),
        ("spindle_axial", 1e-9, {"per_turn": 0.5}, "whole number"),
        ("probe_periodic", 1e-9, {"period": 0.0}, "probe_periodic.period is 0.0 m"),
    ],
)
def test_what_is_no_source_is_refused(
    name: str, value: float, parameters: dict[str, float], says: str
) -> None:
    with pytest.raises(ConfigurationError, match=says):
        SystematicSource(name, value, DECLARED, "", parameters)


def test_a_source_of_no_number_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="tilt"):
        SystematicSource("tilt", float("nan"), DECLARED, "")


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.squares])
def test_sums_of_squares_are_those_of_the_fields(name: str, points: ScanPoints) -> None:
    source = made(name, 1e-6)
    expected = np.sum(source.standard_fields(points) ** 2, axis=0)
    # The components leave out a hundredth.
    assert np.max(abs(source.variance(points) - expected)) < 0.03 * np.max(expected)
