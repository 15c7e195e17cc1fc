"""``omsm identify A B --multisine M --plan P``: bags of the twin, from the plan to the verdict."""

import json

import pytest

from benchmarks.step_test import StepTest
from omsm_ros import cli
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_multisine
from omsm_ros.pipelines.record_bags import write_recording
from omsm_ros.twin.cell import Cell, record


def run(capsys, *arguments):
    status = cli.main([str(a) for a in arguments])
    return status, capsys.readouterr()


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    out = tmp_path_factory.mktemp("bags")
    options = ("--up-to", 40, "--resolution", 1, "--half-range", 30e-6)
    assert cli.main([str(a) for a in ("plan", "multisine", "--out", out, *options)]) == 0
    motions = {"a": StepTest(count=8), "b": StepTest(count=8)}
    motions["multisine"] = load_multisine(out / "multisine.json")
    for seed, (name, motion) in enumerate(motions.items()):
        recording = record(Cell(seed=seed), motion, Flat(), stand_off=0.0)
        write_recording(out / f"{name}.mcap", recording)
    return out


def test_two_bags_and_a_multisine_make_one_calibration(capsys, bags, tmp_path):
    out = tmp_path / "cal.json"
    multisine = ("--multisine", bags / "multisine.mcap", "--plan", bags / "multisine.json")
    status, said = run(
        capsys, "identify", bags / "a.mcap", bags / "b.mcap", *multisine, "--out", out, "--json"
    )
    facts = json.loads(said.out)
    assert status == 0, facts
    certificate = load_calibration(out).certificate
    assert [part.parts for part in certificate.consistency][-1] == "recording 1 against the others"
    assert any("a multisine confirms the response" in note for note in facts["notes"])
    assert len(facts["multisine"]["frequency"]) == len(facts["multisine"]["distortion_m"])
    assert not any(facts["multisine"]["differs"])
    # The twin is linear: distortion below the noise of a reading.
    assert max(facts["multisine"]["distortion_m"]) < 5e-9


def test_a_multisine_without_its_plan_is_refused(capsys, bags, tmp_path):
    status, said = run(
        capsys, "identify", bags / "a.mcap", "--multisine", bags / "b.mcap", "--out", tmp_path / "c"
    )
    assert status == 2
    assert "go together" in said.err


def test_a_changed_plan_is_refused(capsys, bags, tmp_path):
    content = json.loads((bags / "multisine.json").read_text())
    (tmp_path / "plan.json").write_text(json.dumps({**content, "lines": content["lines"][::-1]}))
    words = ("--multisine", bags / "b.mcap", "--plan", tmp_path / "plan.json")
    status, said = run(capsys, "identify", bags / "a.mcap", *words, "--out", tmp_path / "c.json")
    assert status == 2
    assert "no plan that can be evaluated" in said.err
