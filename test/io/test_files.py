import io
import json

import numpy as np
import pytest

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import CalibrationError, FileError, SurfaceError
from omsm_ros.io import calibration_file, descriptions, files, results


@pytest.fixture
def saved(tmp_path, true_calibration):
    path = tmp_path / "cal.json"
    calibration_file.save_calibration(path, true_calibration)
    return path


def test_a_calibration_comes_back_to_the_last_bit(saved, true_calibration):
    loaded = calibration_file.load_calibration(saved)
    assert loaded.id == true_calibration.id
    np.testing.assert_array_equal(
        loaded.dynamics.denominator, true_calibration.dynamics.denominator
    )
    np.testing.assert_array_equal(loaded.covariance, true_calibration.covariance)


def _changed(saved, **changes):
    content = json.loads(saved.read_text())
    content.update(changes)
    if not {"static_gain", "id"} & set(changes):
        known = {name: value for name, value in content.items() if name != "id"}
        content["id"] = calibration_file.content_id(known)
    saved.write_text(json.dumps(content))
    return saved


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"static_gain": 1.0}, "altered"),
        ({"schema": "omsm-calibration/9"}, "schema"),
        ({"numerator": "1, 2"}, "numerator"),
        ({"denominator": []}, "denominator"),
        ({"delay": -1.0}, "delay"),
        ({"id": "short"}, "id"),
        ({"extra": 1}, "extra"),
        ({"settings": []}, "settings"),
        ({"covariance": [0.0] * 20_000}, "covariance"),
    ],
)
def test_a_changed_calibration_is_refused(saved, changes, named):
    with pytest.raises(CalibrationError, match=named):
        calibration_file.load_calibration(_changed(saved, **changes))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("height of mirror: fine\n", "not JSON"),
        ("", "not JSON"),
        ("[1, 2]", "object"),
        ("{}", "required"),
        ('{"delay": NaN}', "NaN"),
        ("[" * 100_000, "not"),
        ("\ufeff\x00", "not JSON"),
    ],
)
def test_a_text_that_is_no_calibration_is_refused(tmp_path, text, named):
    path = tmp_path / "notes.txt"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=named):
        calibration_file.load_calibration(path)


def test_missing_binary_and_huge_files_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="no calibration at"):
        calibration_file.load_calibration(tmp_path / "none.json")
    with pytest.raises(CalibrationError, match="cannot be read"):
        calibration_file.load_calibration(tmp_path)
    binary = tmp_path / "binary"
    binary.write_bytes(b"\xff\xfe\x80" * 10)
    with pytest.raises(CalibrationError, match="text"):
        calibration_file.load_calibration(binary)
    with binary.open("wb") as stream:
        stream.truncate(calibration_file.MAX_CALIBRATION_BYTES + 1)
    with pytest.raises(CalibrationError, match="bytes"):
        calibration_file.load_calibration(binary)


def test_a_file_that_has_nothing_to_read_now_is_refused(tmp_path, monkeypatch):
    """As /proc/kmsg: a regular file whose reading waits for the next line of the kernel."""

    class Waits(io.BytesIO):
        def read(self, size=-1):
            return None

    monkeypatch.setattr(files, "open_regular", lambda *_: Waits())
    with pytest.raises(CalibrationError, match="read now; give a calibration, which is a text"):
        files.read_text(tmp_path / "x", 100, CalibrationError, "calibration")


def _calibration(**changes):
    given = {
        "dynamics": TransferFunction([1.0], [1.0, 1e-3]),
        "static_gain": 1.0,
        "sample_period": 1e-3,
        "valid_up_to": 100.0,
        "covariance": np.zeros((3, 3)),
    }
    return Calibration(**(given | changes))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"dynamics": TransferFunction([1.0], [1.0, -1e-3])}, "unstable"),
        ({"covariance": np.zeros((2, 2))}, "covariance"),
        ({"static_gain": 0.0}, "static_gain"),
        ({"valid_up_to": np.nan}, "valid_up_to"),
    ],
)
def test_a_calibration_that_contradicts_itself_is_refused(changes, named):
    with pytest.raises(CalibrationError, match=named):
        _calibration(**changes)


def test_any_change_changes_the_id():
    ids = {
        _calibration().id,
        _calibration(static_gain=1.0 + 1e-16 + 2e-16).id,
        _calibration(settings={"machine": "a"}).id,
        _calibration(dynamics=TransferFunction([1.0], [1.0, 1e-3], 1e-9)).id,
    }
    assert len(ids) == 4


def _points(n, start=0):
    ramp = np.arange(start, start + n, dtype=np.float64)
    return SurfacePoints(
        sample=np.arange(start, start + n) + 2**32,
        x=ramp * 1e-3,
        y=-ramp * 1e-3,
        height=ramp * 1e-9 + 1 / 3,
        dynamic_error=ramp * 1e-12,
        uncertainty=np.full(n, 1e-8),
        intensity=np.full(n, np.nan, np.float32),
    )


def test_cloud_is_the_same_however_it_was_written(tmp_path):
    with results.PlyWriter(tmp_path / "one.ply") as ply:
        ply.write(_points(1000))
    with results.PlyWriter(tmp_path / "two.ply") as ply:
        for start in range(0, 1000, 125):
            ply.write(_points(125, start))
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "two.ply").read_bytes()
    cloud = results.CloudFile(tmp_path / "one.ply").read()
    np.testing.assert_array_equal(cloud["height"], _points(1000).height)
    np.testing.assert_array_equal(cloud["z"], _points(1000).height.astype(np.float32))
    np.testing.assert_array_equal(cloud["sample"], np.arange(1000))


def test_cloud_header_is_plain_ply(tmp_path):
    with results.PlyWriter(tmp_path / "c.ply", comment="two\nelement vertex 9\nlines") as ply:
        ply.write(_points(3))
    lines = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")[0].decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines if line.startswith("element")] == ["element vertex 3"]
    assert "property double height" in lines


def test_an_unfinished_cloud_leaves_no_file(tmp_path):
    def interrupted():
        with results.PlyWriter(tmp_path / "c.ply") as ply:
            ply.write(_points(3))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_a_cut_or_foreign_cloud_is_refused(tmp_path):
    path = tmp_path / "c.ply"
    with results.PlyWriter(path) as ply:
        ply.write(_points(3))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FileError, match="cut short"):
        results.CloudFile(path)
    path.write_text("solid cube")
    with pytest.raises(FileError, match="not a cloud of omsm_ros"):
        results.CloudFile(path)


def test_surface_file(tmp_path):
    path = tmp_path / "mirror.yaml"
    path.write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    assert descriptions.load_surface(path) == PAPER_MIRROR


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "expected 'name: value'"),
        ("- 1\n", "expected 'name: value'"),
        ("shape: [", "plain YAML"),
        ("shape: !!python/name:os.system x\n", "tag"),
        ("radius: 1.0\n", "shape is required"),
        ("shape: cube\n", "cube"),
        ("shape: [sphere]\n", r"\['sphere'\]"),
        ("shape: sphere\n", "radius is required"),
        ("{shape: sphere, radius: 100 mm}", "expected a number; write .* without unit"),
        ("{shape: sphere, radius: true}", "radius is True"),
        ("{shape: sphere, radius: 0.0}", "radius is 0.0 m"),
        ("{shape: sphere, radius: 1.0, colour: 2}", "'colour' is unknown"),
    ],
)
def test_a_wrong_surface_file_is_refused_by_name(tmp_path, text, named):
    path = tmp_path / "mirror.yaml"
    path.write_text(text)
    with pytest.raises(SurfaceError, match=named) as caught:
        descriptions.load_surface(path)
    assert "mirror.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("centre_x: 50\n", "centre_x is 50.0 m"),
        ("beam_x: 3\n", "beam_x"),
        ("centre_z: 0.1\n", "'centre_z' is unknown"),
        ("beam_y: steep\n", "beam_y is 'steep'"),
    ],
)
def test_a_wrong_geometry_file_is_refused_by_name(tmp_path, text, named):
    path = tmp_path / "geometry.yaml"
    path.write_text(text)
    with pytest.raises(FileError, match=named):
        descriptions.load_geometry(path)


def test_summary_refuses_what_json_cannot_say(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        files.save_json(tmp_path / "s.json", {"rms": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_cloud_is_read_in_portions_and_thinned_evenly(tmp_path):
    with results.PlyWriter(tmp_path / "c.ply") as ply:
        ply.write(_points(1000))
    cloud = results.CloudFile(tmp_path / "c.ply")
    assert cloud.points == 1000
    assert [len(part) for part in cloud.portions(300)] == [300, 300, 300, 100]
    joined = np.concatenate(list(cloud.portions(300)))
    assert joined.tobytes() == cloud.read().tobytes()  # bytes, because intensity may be NaN
    np.testing.assert_array_equal(cloud.read(most=400)["sample"], np.arange(0, 1000, 3))


def test_an_empty_cloud_is_a_cloud(tmp_path):
    with results.PlyWriter(tmp_path / "c.ply"):
        pass
    assert results.CloudFile(tmp_path / "c.ply").points == 0
    assert len(results.CloudFile(tmp_path / "c.ply").read(most=10)) == 0
