"""The folder of a spectrum holds only files of the last run."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import plain_readers
import pytest

from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.ripple.density import Density
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.pipelines import spectrum
from omsm_ros.pipelines.spectrum import SpectrumOptions, cleaned_points, publish_spectra


def points(count):
    ramp = np.arange(count, dtype=np.float64)
    return SurfacePoints(
        sample=np.arange(count), x=ramp, y=ramp, height=ramp, dynamic_error=ramp,
        uncertainty=ramp, intensity=ramp.astype(np.float32),
    )  # fmt: skip


class Named(SimpleNamespace):
    """A signal with a name and a length."""

    def __init__(self, name, count):
        super().__init__(name=name, count=count)

    def __len__(self):
        return self.count


def scan(name, count, removed=0.25):
    values = Density(np.arange(3.0), np.ones(3), 1.0)
    studied = SimpleNamespace(signal=Named(name, count), coordinates={}, density=lambda _: values)
    read = SimpleNamespace(points=points(count))
    return SimpleNamespace(studied=studied, read=read, removed=np.full(count, removed))


@pytest.fixture
def publish(monkeypatch, tmp_path):
    """Replace the analysis; these tests are about files only."""
    monkeypatch.setattr(spectrum, "summary_of", lambda scans, _: {"scans": len(scans)})

    def made(counts, stop=((1.0, 2.0),)):
        scans = [scan(f"s{k}", count) for k, count in enumerate(counts)]
        monkeypatch.setattr(spectrum, "spectra_of", lambda *_: scans)
        options = SpectrumOptions(stop=stop)
        return publish_spectra([""] * len(scans), options, tmp_path / "out", report=False)

    return made


def held(tmp_path):
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    return [name for name in names if not name.startswith("density")]


def test_each_scan_has_its_cloud_without_the_band(publish, tmp_path):
    summary = publish([5, 7])
    assert held(tmp_path) == ["band_stopped_1.ply", "band_stopped_2.ply", "spectrum.json"]
    assert json.loads((tmp_path / "out" / "spectrum.json").read_text()) == summary
    assert summary["files"] == {
        "spectrum": "spectrum.json", "s0 without the band": "band_stopped_1.ply",
        "s1 without the band": "band_stopped_2.ply",
        "density 1 over time": "density_1.csv", "density 2 over time": "density_2.csv",
    }  # fmt: skip
    for name, count in (("band_stopped_1.ply", 5), ("band_stopped_2.ply", 7)):
        cloud = plain_readers.ply(tmp_path / "out" / name)
        assert cloud["height"] == [k - 0.25 for k in range(count)]
        assert cloud["x"] == list(range(count))


@pytest.mark.parametrize(("counts", "stop"), [([3], ((1.0, 2.0),)), ([3, 4, 5], ())])
def test_clouds_of_an_earlier_run_with_more_scans_go(publish, tmp_path, counts, stop):
    publish([5, 6, 7])
    (tmp_path / "out" / "notes.txt").write_text("mine")
    publish(counts, stop)
    clouds = [f"band_stopped_{k + 1}.ply" for k in range(len(counts))] if stop else []
    assert held(tmp_path) == [*clouds, "notes.txt", "spectrum.json"]


def test_a_run_that_fails_leaves_the_earlier_one(publish, tmp_path, monkeypatch):
    publish([5, 6])
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    monkeypatch.setattr(spectrum, "cleaned_points", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        publish([1])
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_a_cloud_of_that_name_that_is_no_result_stays(publish, tmp_path):
    """Without a spectrum.json, files of that name are not removed."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "band_stopped_9.ply").write_text("mine")
    publish([5])
    assert (tmp_path / "out" / "band_stopped_9.ply").read_text() == "mine"


def test_points_that_were_not_analysed_are_refused():
    one = scan("s", 5)
    one.studied.signal.count = 4
    with pytest.raises(ConfigurationError, match="'s': its trigger counter restarted"):
        cleaned_points(one)


def test_the_folder_of_another_command_is_refused(publish, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "summary.json").write_text("{}")
    with pytest.raises(FileError, match=r"result of another command \(summary.json\)"):
        publish([5])


def test_the_density_of_each_scan_is_written_and_an_earlier_one_goes(publish, tmp_path):
    publish([3, 4], ())
    table = np.loadtxt(tmp_path / "out" / "density_2.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table, [[0, 1], [1, 1], [2, 1]])
    publish([3], ())
    assert [path.name for path in (tmp_path / "out").glob("density*")] == ["density_1.csv"]
