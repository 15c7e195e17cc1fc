"""Each kind of extension needs one change in one folder, and then appears everywhere.

The answers in words stand in docs/design/where-things-belong.md.
"""

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest

import omsm_ros
from omsm_ros.core.calibration.certificate import REJECTS, WARNING, Finding
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.identification import checks, identify, response_uncertainty
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface import nominal
from omsm_ros.io.descriptions import load_surface

PACKAGE = Path(omsm_ros.__file__).resolve().parent


@pytest.fixture
def motion(step_test):
    return assemble([step_test.axes], [step_test.distance])


# A nominal surface.


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Bent along x."""

    curvature: float

    def height(self, x, y):
        return 0.5 * self.curvature * np.square(x) + 0.0 * y


def test_a_nominal_surface_is_added_in_core_surface(monkeypatch, tmp_path):
    """One entry of SHAPES: its YAML has the names of its fields, and bad ones are refused."""
    monkeypatch.setitem(nominal.SHAPES, "cylinder", Cylinder)
    path = tmp_path / "surface.yaml"
    path.write_text("shape: cylinder\ncurvature: 2.0\n")
    assert load_surface(path).height(np.array([3.0]), np.array([1.0])) == [9.0]
    path.write_text("shape: cylinder\nradius: 2.0\n")
    with pytest.raises(omsm_ros.errors.SurfaceError, match="radius"):
        load_surface(path)


# A residual test, a further doubt.


def test_a_residual_test_is_added_in_core_identification(monkeypatch, motion):
    """One entry of CHECKS: it sees the residual; its words, limits and verdict are certified."""

    def skewed(evidence):
        residual = evidence.fit.residual
        skew = float(np.mean(residual**3) / np.mean(residual**2) ** 1.5)
        yield Finding("skewed", REJECTS, {"skewness": skew}, {"skewness_greatest": 0.0})
        yield Finding("look at it", WARNING)

    monkeypatch.setattr(identify, "CHECKS", (*checks.CHECKS, skewed))
    certificate = identify.identify(motion, order=2).calibration.certificate
    (reason,) = certificate.reasons
    assert abs(reason.values["skewness"]) < 0.1
    assert reason.limits["skewness_greatest"] == 0.0
    assert certificate.verdict == "rejected"
    assert str(reason) == "skewed"
    assert "look at it" in map(str, certificate.warnings)


def test_what_the_data_cannot_show_is_added_in_core_identification(monkeypatch, motion):
    """One entry of COVARIANCE_TERMS: the covariance and every band widen by it."""
    before = identify.identify(motion, order=2).calibration

    def doubt(prepared, fit):
        further = np.zeros_like(before.covariance)
        further[-1, -1] = (100e-6) ** 2
        return further

    every = (*response_uncertainty.COVARIANCE_TERMS, doubt)
    monkeypatch.setattr(response_uncertainty, "COVARIANCE_TERMS", every)
    after = identify.identify(motion, order=2).calibration
    added = after.covariance - before.covariance
    assert added[-1, -1] == pytest.approx(1e-8)
    assert np.count_nonzero(added) == 1


# An uncertainty source.


@pytest.mark.parametrize("source", [field.name for field in fields(ErrorSources)])
def test_an_uncertainty_source_is_added_in_core_correction(source, true_calibration, small_scan):
    """Every field of ErrorSources reaches the points and the budget, alone and under its name."""
    part = slice(0, 3000)
    axes, distance = (
        replace(block, **{name: getattr(block, name)[part] for name in names})
        for block, names in (
            (small_scan.axes, "xyzbc"),
            (small_scan.distance, ("distance", "intensity", "status")),
        )
    )

    time = axes.sample_period * np.arange(len(axes))
    # Smooth, so that nothing scatters by more than is stated.
    axes = replace(axes, z=1e-4 * np.sin(2 * np.pi * time))
    distance = replace(distance, distance=1e-5 * np.cos(2 * np.pi * time))

    def corrected(**sources):
        # A pitch moves a beam one metre off the encoder's line by a metre a radian.
        options = CorrectionOptions(
            geometry=Geometry(abbe_arm=1.0), sources=ErrorSources(**sources)
        )
        corrector = Corrector(true_calibration, options)
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        return join_points([corrector.finish()]), corrector.budget

    points, budget = corrected(**{source: 1e-6})
    silent, nothing = corrected()
    assert not any(nothing.values())
    assert {name for name, value in budget.items() if value} == {source}
    assert np.all(silent.uncertainty == 0)
    mean_square = np.mean(np.square(points.uncertainty))
    assert mean_square > 0
    assert budget[source] == pytest.approx(np.sqrt(mean_square), rel=1e-6, abs=0)


# Additions that change the source are tested on a copy of it.


def changed_copy(folder, path, *changes):
    """The package with some text of one file replaced; returns how to run Python with it."""
    copy = folder / "omsm_ros"
    shutil.copytree(PACKAGE, copy)
    shutil.copytree(PACKAGE.parent / "msg_defs", folder / "msg_defs")
    text = (copy / path).read_text(encoding="utf-8")
    for old, new in changes:
        assert text.count(old) == 1, f"{old!r} in {path}"
        text = text.replace(old, new)
    (copy / path).write_text(text, encoding="utf-8")

    def run(*arguments):
        command = f"import sys; sys.path.insert(0, {str(folder)!r}); "
        done = subprocess.run(
            [sys.executable, "-c", command + arguments[0], *arguments[1:]],
            capture_output=True,
            text=True,
            cwd=folder,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_a_column_of_the_cloud_is_added_in_core_correction(tmp_path):
    """One line where it is laid out, and one where it is computed: file and message have it."""
    run = changed_copy(
        tmp_path,
        "core/correction/surface_points.py",
        ('("sample", "<u4"),\n)', '("sample", "<u4"),\n    ("slope", "<f8"),\n)'),
        ("    uncertainty: FloatArray\n", "    uncertainty: FloatArray\n    slope: FloatArray\n"),
    )
    script = """
import json, sys
import numpy as np
from omsm_ros.core.correction.surface_points import SurfacePoints, pack_points
from omsm_ros.io.results import CloudFile, PlyWriter
from omsm_ros.io.message_mapping import Messages, cloud_array, cloud_message
from types import SimpleNamespace
names = "x y height dynamic_error uncertainty intensity slope".split()
made = SurfacePoints(sample=np.arange(3), **{n: np.arange(3.0) for n in names})
with PlyWriter("cloud.ply") as writer:
    writer.write(made)
kinds = dict.fromkeys(("Time", "Header", "PointCloud2", "PointField"), SimpleNamespace)
messages = Messages(kinds, lambda values, dtype: np.asarray(values, dtype).tobytes())
message = cloud_message(messages, pack_points(made), 0)
print(json.dumps({
    "file": CloudFile("cloud.ply").read()["slope"].tolist(),
    "message": cloud_array(message)["slope"].tolist(),
    "fields": [field.name for field in message.fields],
}))
"""
    answer = json.loads(run(f"exec({script!r})"))
    assert answer["file"] == answer["message"] == [0.0, 1.0, 2.0]
    assert answer["fields"][-1] == "slope"


def test_an_offline_command_is_added_in_cli(tmp_path):
    """A module with COMMANDS, and a row of its word: help, --json and exit status follow."""
    run = changed_copy(
        tmp_path, "cli/words.py", ('"begin": """\n', '"begin": """\nweigh: what it weighs\n')
    )
    (tmp_path / "omsm_ros" / "cli" / "weigh.py").write_text(
        "from omsm_ros.cli.command import CliCommand\n"
        "def declare(add):\n    add('grams', float)\n"
        "COMMANDS = [CliCommand('weigh', declare,\n"
        "    lambda args: {'kg': args.grams / 1000}, print)]\n"
    )
    main = "from omsm_ros.cli import main; sys.exit(main(sys.argv[1:]))"
    assert json.loads(run(main, "weigh", "--json", "250")) == {"kg": 0.25}
    assert "what it weighs" in run(main, "--help")
