"""``systematic.npz`` there and back, and nothing else is taken for it."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from omsm_ros.core.correction.systematic import ScanFields
from omsm_ros.errors import FileError
from omsm_ros.io.results import load_fields, save_fields

FIELDS = ScanFields(("tilt", "tilt"), np.arange(6.0).reshape(2, 3) * 1e-9, 32, ("tilt",), ("tilt",))


def test_there_and_back(tmp_path):
    path = tmp_path / "systematic.npz"
    save_fields(path, FIELDS)
    found = load_fields(path)
    assert (found.names, found.every) == (FIELDS.names, 32)
    assert (found.bounds, found.aligned) == (("tilt",), ("tilt",))
    assert np.allclose(found.fields, FIELDS.fields, rtol=1e-6, atol=0)
    none = ScanFields((), np.empty((0, 0)), 1)
    save_fields(path, none)
    assert load_fields(path).names == ()


def test_where_nobody_says_which_are_upper_bounds_each_may_be_one(tmp_path):
    path = tmp_path / "systematic.npz"
    np.savez(path, names=np.array(["tilt", "tilt", "pitch"]), fields=np.zeros((3, 4)), every=1)
    assert load_fields(path).bounds == ("pitch", "tilt")


def test_a_member_that_is_no_array_is_refused(tmp_path):
    path = tmp_path / "systematic.npz"
    save_fields(path, FIELDS)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["fields.npy"] = b"no array" + members["fields.npy"][8:]
    with zipfile.ZipFile(path, "w") as archive:
        for name, raw in members.items():
            archive.writestr(name, raw)
    with pytest.raises(FileError, match="damaged"):
        load_fields(path)


@pytest.mark.parametrize(
    "content",
    [
        {"names": np.array(["tilt"]), "fields": np.zeros((2, 3)), "every": 1},
        {"names": np.array(["tilt"]), "fields": np.zeros((1, 3)), "every": 0},
        {"names": np.array(["tilt"]), "fields": np.full((1, 3), np.nan), "every": 1},
        {"names": np.array(["tilt"]), "fields": np.zeros((1, 3))},
        {"names": np.array(["tilt"]), "fields": np.full((1, 3), 1e-9j), "every": 1},
        {"names": np.array(["tilt"]), "fields": np.zeros((1, 3)), "every": [[1]]},
        {"names": np.array(["tilt"]), "fields": np.array([["a"]]), "every": 1},
        {"names": np.array([{}], dtype=object), "fields": np.zeros((1, 3)), "every": 1},
    ],
)
def test_what_does_not_fit_is_refused_on_one_line(tmp_path, content):
    path = tmp_path / "systematic.npz"
    np.savez(path, **content)
    with pytest.raises(FileError, match="again") as error:
        load_fields(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("raw", [b"no archive", b""])
def test_what_is_no_archive_is_refused(tmp_path, raw):
    path = tmp_path / "systematic.npz"
    path.write_bytes(raw)
    with pytest.raises(FileError, match="damaged"):
        load_fields(path)


def test_a_damaged_number_is_refused_without_a_warning(tmp_path):
    """A signalling NaN, as turned bits leave it."""
    path = tmp_path / "systematic.npz"
    wrong = np.full((1, 4), 0x7F800001, np.uint32).view(np.float32)
    np.savez(path, names=np.array(["tilt"]), fields=wrong, every=1)
    with pytest.raises(FileError, match="hold values that are not finite; correct the scan again"):
        load_fields(path)


def test_sources_have_the_names_of_today_also_in_files_of_before(tmp_path):
    """The file is written by numpy alone, as version 1 wrote it."""
    path = tmp_path / "systematic.npz"
    former = np.array(["could_hide", "lateral_lag", "tilt"])
    np.savez(path, names=former, fields=np.eye(3), every=4, bounds=former[:1])
    found = load_fields(path)
    assert found.names == ("undetected_model_error", "probe_latency", "tilt")
    assert found.bounds == ("undetected_model_error",)
