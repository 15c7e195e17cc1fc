"""The paper's experiments reproduce Eq. 12 and Table 1, and the page compares them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.calibration.verification import excited_bands
from omsm_ros.errors import FileError
from omsm_ros.pipelines import paper_experiments
from omsm_ros.pipelines.paper_experiments import ExperimentPage, run_experiment
from omsm_ros.twin.scenario import Scenario


@pytest.fixture(autouse=True)
def known(monkeypatch, true_calibration):
    """Replace the identification, which is slow and has its own tests."""
    monkeypatch.setattr(paper_experiments, "_calibrated", lambda seed: true_calibration)


def test_the_chirp_lags_as_equation_12_and_is_corrected(tmp_path, capsys):
    out = tmp_path / "chirp"
    assert cli.main(["demo", "--experiment", "chirp", "--out", str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["rms_before"] == pytest.approx(0.262e-6, rel=0.01)  # by integration of Eq. 12
    assert facts["rms_after"] < 11e-9  # noise and resolution of the probe: 10.4 nm
    assert facts["lag_at_14_5_hz"] == pytest.approx(facts["true_lag"], rel=0.02)
    assert abs(facts["lag_after"]) < 2e-4
    assert facts["bands"] == [[k, k + 1] for k in range(15)]
    page = (out / "report.html").read_text()
    assert "about 2°" in page
    assert page.count("data:image/png") == 1


def test_the_vibration_is_found_folded(tmp_path, monkeypatch):
    monkeypatch.setattr(paper_experiments, "_CIRCLE_SECONDS", 6.0)
    facts = run_experiment("vibration", tmp_path / "v")
    quiet, shaken = facts["spectrum"]["scans"]
    assert [p["kind"] for p in quiet["peaks"]] == ["on the part"]
    aliased = next(p for p in shaken["peaks"] if p["kind"] == "aliased vibration")
    assert aliased["true_frequency"] == pytest.approx(680.0, abs=0.01)
    assert aliased["frequency"] == pytest.approx(320.0, abs=0.05)
    assert json.loads((tmp_path / "v/experiment.json").read_text())["experiment"] == "vibration"


def test_the_mirror_loses_its_dynamic_error(tmp_path, monkeypatch):
    small = Scenario(start_radius=2e-3)
    monkeypatch.setattr(paper_experiments, "Scenario", lambda seed=1: replace(small, seed=seed))
    facts = run_experiment("mirror", tmp_path / "m")
    found = facts["summary"]["deviation"]
    raw, after = (found[when]["rms_area_weighted"] for when in ("raw", "corrected"))
    assert after < 15e-9
    assert raw > after
    page = (tmp_path / "m/report.html").read_text()
    assert "290 011 in 6 minutes" in page.replace("\u202f", " ")
    # The folder is a complete measurement that can be evaluated again.
    assert json.loads((tmp_path / "m/summary.json").read_text())["samples"]
    # Fig. 8 shows maps before and after, and sections.
    assert page.count("data:image/png") == 5


def test_an_experiment_leaves_what_is_measured_alone(tmp_path, monkeypatch):
    """A recording or measurement is not overwritten; an earlier experiment is."""

    def quick(out, seed):
        (out / "chirp.mcap").write_text(f"of seed {seed}")
        return paper_experiments._Done({}, ExperimentPage("", "", []))

    monkeypatch.setitem(paper_experiments.EXPERIMENTS, "chirp", quick)
    for name, said in (("chirp.mcap", "is there and no result"), ("summary.json", "of another")):
        (tmp_path / name).write_text("{}")
        with pytest.raises(FileError, match=said):
            run_experiment("chirp", tmp_path)
        assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [(name, "{}")]
        (tmp_path / name).unlink()
    for seed in (1, 2):
        run_experiment("chirp", tmp_path, seed)
        assert (tmp_path / "chirp.mcap").read_text() == f"of seed {seed}"


def test_bands_that_a_motion_does_not_excite_are_not_reported():
    """A chirp to 15 Hz with the encoder's noise: nothing at 45 Hz."""
    time = np.arange(25_000) * 1e-3
    z = 20e-6 * np.cos(np.pi * 0.6 * time**2)
    noisy = z + np.random.default_rng(1).normal(0, 1e-9, len(z))
    assert excited_bands(noisy, 1e-3) == tuple((float(k), k + 1.0) for k in range(15))
    two = 1e-6 * np.sin(2 * np.pi * 3.5 * time) + 1e-6 * np.sin(2 * np.pi * 40.5 * time)
    assert excited_bands(two, 1e-3) == ((3.0, 4.0), (40.0, 41.0))
