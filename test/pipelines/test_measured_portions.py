"""Reading a measurement again: every point once, in order, with its systematic fields."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.correction.systematic import ScanFields
from omsm_ros.errors import FileError
from omsm_ros.io.results import CloudFile, PlyWriter, save_fields
from omsm_ros.pipelines import form
from omsm_ros.pipelines.form import open_measurement
from omsm_ros.units import units_of

COUNT = 1000


@pytest.fixture
def result(tmp_path):
    ramp = np.arange(COUNT, dtype=np.float64)
    points = SurfacePoints(
        sample=np.arange(COUNT), x=np.sin(ramp), y=np.cos(ramp), height=ramp * 1e-9 + 1 / 3,
        dynamic_error=np.zeros(COUNT), uncertainty=np.full(COUNT, 1e-8),
        intensity=np.ones(COUNT, np.float32),
    )  # fmt: skip
    with PlyWriter(tmp_path / "cloud.ply") as ply:
        ply.write(points)
    return tmp_path


def joined(measured):
    parts = list(measured.portions())
    effects = np.concatenate([part.systematic for part in parts], axis=1)
    return [np.concatenate([getattr(p, n) for p in parts]) for n in ("x", "y", "height")], effects


@pytest.mark.parametrize("size", [1, 7, 500, 999, 1000, 5000])
@pytest.mark.parametrize("whole", [True, False])
def test_all_points_come_in_their_order_whatever_the_portions(result, monkeypatch, size, whole):
    monkeypatch.setattr(form, "_PORTION", size)
    measured = open_measurement(result if whole else result / "cloud.ply")
    cloud = CloudFile(result / "cloud.ply").read()
    for again in range(2):  # they can be read repeatedly
        columns, effects = joined(measured)
        for name, values in zip(("x", "y", "height"), columns, strict=True):
            assert values.dtype == np.float64
            np.testing.assert_array_equal(values, cloud[name], err_msg=f"{name} {again}")
        assert effects.shape == (0, COUNT)
    assert (measured.systematic, measured.sources, measured.notes) == (False, (), ())


@pytest.mark.parametrize("size", [1, 64, 300, 5000])
def test_fields_are_lines_between_their_points_across_portions(result, monkeypatch, size):
    """Fields are stored for every 37th point and interpolated linearly, as by numpy."""
    monkeypatch.setattr(form, "_PORTION", size)
    every, rng = 37, np.random.default_rng(1)
    kept = rng.normal(size=(2, -(-COUNT // every) + 1)).astype(np.float32)
    fields = ScanFields(("tilt", "drift"), kept.astype(np.float64), every, ("drift",))
    save_fields(result / "systematic.npz", fields)
    measured = open_measurement(result)
    assert measured.sources == ("tilt", "drift")
    assert measured.bounds == ("drift",)
    assert measured.systematic
    _, effects = joined(measured)
    stored_at = every * np.arange(kept.shape[1])
    for row, own in zip(effects, kept, strict=True):
        np.testing.assert_allclose(row, np.interp(np.arange(COUNT), stored_at, own), atol=1e-12)


def test_points_that_a_program_wrote_twice_count_once(tmp_path):
    rows = [(k, -k * k, k / 7) for k in range(9)]
    text = "x_m y_m z_m\n" + "".join(f"{x} {y} {z!r}\n" for x, y, z in rows + rows[3:6])
    (tmp_path / "a.xyz").write_text(text + "1 1 nan\n")
    measured = open_measurement(tmp_path / "a.xyz")
    (_, _, heights), _ = joined(measured)
    assert heights.tolist() == [z for _, _, z in rows]
    assert any("3 points are exact duplicates" in note for note in measured.notes)
    assert measured.missing == 1
    assert not measured.even


def test_a_map_says_that_it_is_even(tmp_path):
    rows = [f"{k % 6} {k // 6} {k * k}" for k in range(36)]
    (tmp_path / "a.xyz").write_text("x_mm y_mm z_nm\n" + "\n".join(rows) + "\n")
    measured = open_measurement(tmp_path / "a.xyz")
    assert measured.even
    (_, _, heights), _ = joined(measured)
    assert heights == pytest.approx([k * k * 1e-9 for k in range(36)])


@pytest.mark.parametrize(("unit", "notes"), [("m", 0), ("mm", 1)])
def test_a_unit_that_our_cloud_does_not_need_is_reported(result, unit, notes):
    measured = open_measurement(result, units_of(unit))
    assert (len(measured.notes), measured.sources) == (notes, ())
    assert all("--unit was not used" in note for note in measured.notes)


def test_missing_input_is_reported_with_the_option_to_give(tmp_path):
    with pytest.raises(FileError, match=r"no cloud at .*cloud.ply'; give a cloud, a map, or"):
        open_measurement(tmp_path)
    with pytest.raises(FileError, match=r"no cloud at .*none.xyz'"):
        open_measurement(tmp_path / "none.xyz")


def test_fields_of_others_are_not_taken_for_those_of_a_map(result):
    """Fields next to a map of another name belong to the cloud."""
    save_fields(result / "systematic.npz", ScanFields(("tilt",), np.ones((1, 3)), 500))
    (result / "map.xyz").write_text("x_m y_m z_m\n0 0 1\n1 0 2\n0 1 3\n")
    measured = open_measurement(result / "map.xyz")
    assert not measured.systematic
    assert joined(measured)[1].shape == (0, 3)
