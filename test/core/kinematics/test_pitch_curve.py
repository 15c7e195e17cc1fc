"""A measured pitch is taken off an encoder that sits beside the beam, against the twin's truth."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.kinematics.kinematics import Geometry, PitchCurve
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io.descriptions import load_pitch
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.sensors import EncoderErrors, Pitch

ARM = 0.1


def test_what_an_autocollimator_saw_is_taken_off_the_encoder(true_calibration):
    """2 µrad over 0.1 m are 200 nm, over a way of half a millimetre."""
    pitch = Pitch(arm_m=ARM, periodic_rad=2e-6, period_m=0.5e-3)
    cell = Cell(
        probe=Probe(noise=0.0, resolution=0.0),
        encoder_noise=0.0,
        disturbances=Disturbances(encoder=EncoderErrors(pitch=pitch)),
    )
    scan = record(cell, Spiral(PAPER_MIRROR, 12.7e-3, 2e-3, 30.0), PAPER_MIRROR)
    z = np.linspace(-2e-3, 2e-3, 2001)
    curve = PitchCurve(z, 2e-6 * np.sin(2 * np.pi * z / 0.5e-3))
    spread = {}
    for name, used in (("raw", None), ("measured", curve)):
        options = CorrectionOptions(
            sources=ErrorSources(), geometry=Geometry(abbe_arm=ARM), pitch=used
        )
        corrector = Corrector(true_calibration, options)
        corrector.push_axes(scan.axes)
        corrector.push_distance(scan.distance)
        points = join_points([corrector.finish()])
        spread[name] = np.std(points.height - scan.surface_height[points.sample])
    assert spread["raw"] > 100e-9
    # The encoder's own reading stands for Z, and the filter for its lag.
    assert spread["measured"] < 0.02 * spread["raw"]


def test_beyond_what_was_measured_it_stays_as_it_was():
    curve = PitchCurve(np.array([0.0, 1e-3]), np.array([1e-6, 3e-6]))
    found = curve.over(ARM, np.array([-1.0, 0.5e-3, 1.0]))
    assert found == pytest.approx([1e-7, 2e-7, 3e-7])


@pytest.mark.parametrize("position", [[0.0], [0.0, 0.0], [1e-3, 0.0]])
def test_positions_that_do_not_increase_are_refused(position):
    with pytest.raises(ConfigurationError, match="do not increase"):
        PitchCurve(np.array(position), np.zeros(len(position)))


def test_a_pitch_is_read_from_its_table(tmp_path):
    path = tmp_path / "pitch.csv"
    path.write_text("z_m,pitch_rad\n0,1e-6\n1e-3,2e-6\n")
    assert load_pitch(path).over(1.0, np.array([0.5e-3])) == pytest.approx([1.5e-6])
    for text, says in (
        ("z_m,pitch_rad\n1e-3,0\n0,0\n", "do not increase"),
        ("z_m,pitch_rad\n0,0\n1,9\n", r"pitch_rad\[1\] is 9.0 rad"),
        ("z_m,angle\n0,0\n1,0\n", "0 columns 'pitch_rad'"),
    ):
        path.write_text(text)
        with pytest.raises(FileError, match=says):
            load_pitch(path)
