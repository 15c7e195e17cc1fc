"""``omsm reversal``, ``selfcal`` and ``latency``."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.calibration.certificate import Certificate
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io import calibration_file
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.plant import PAPER_STATIC_GAIN
from omsm_ros.twin.probe import ProbeErrors

from .written import facts, write


@pytest.mark.soak
def test_reversal_finds_no_latency_in_a_mechanical_lag(capsys, tmp_path, calibration):
    scans = [
        write(
            tmp_path / f"{name}.mcap",
            record(Cell(seed=seed), Spiral(PAPER_MIRROR, 6e-3, 4e-4, rpm), PAPER_MIRROR),
        )
        for name, rpm, seed in (("cw", 30.0, 5), ("ccw", -30.0, 6))
    ]
    found = facts(capsys, "reversal", *scans, "--calibration", calibration)
    assert abs(found["lag"]) < 4 * found["uncertainty"]
    assert found["uncertainty"] < 50e-6
    assert found["latency"] is False
    assert found["points"] == sum(s["axes"]["corrected"] for s in found["samples"]) > 59_900
    assert found["used"] == found["points"]
    assert all(s["axes"]["received"] == 30_000 for s in found["samples"])


@pytest.fixture(scope="module")
def late_pair(tmp_path_factory):
    """Write scans of one part at two speeds, with a latency of 0.1 ms."""
    folder = tmp_path_factory.mktemp("late")
    late = Disturbances(probe=ProbeErrors(latency_s=1e-4))
    return [
        write(
            folder / f"{rpm:.0f}.mcap",
            record(
                Cell(seed=seed, disturbances=late), Spiral(PAPER_MIRROR, 12.7e-3, 1e-3, rpm),
                PAPER_MIRROR,
            ),
        )
        for rpm, seed in ((60.0, 5), (120.0, 6))
    ]  # fmt: skip


@pytest.fixture
def sum_of_lags(tmp_path, true_calibration):
    """Write the calibration of a step test with the same latency."""
    g = true_calibration.dynamics
    late = TransferFunction(g.numerator, g.denominator, g.delay + 1e-4)
    covariance = np.zeros_like(true_calibration.covariance)
    covariance[-1, -1] = 1e-12
    made = replace(
        true_calibration,
        dynamics=late,
        covariance=covariance,
        certificate=Certificate(verdict="accepted"),
    )
    path = tmp_path / "step.json"
    calibration_file.save_calibration(path, made)
    return path


def test_selfcal_divides_the_lag_and_correct_uses_it(capsys, tmp_path, late_pair, sum_of_lags):
    out = tmp_path / "cal.json"
    found = facts(capsys, "selfcal", *late_pair, "--calibration", sum_of_lags, "--out", out)
    latency = found["latency"]
    assert latency["source"] == "several speeds"
    assert abs(latency["delay_s"] - 1e-4) < 3 * latency["uncertainty_s"] < 6e-6
    assert found["verdict"].startswith("accepted, valid")
    assert found["speeds_rpm"] == pytest.approx([60.0, 120.0], rel=1e-6)
    nominal = tmp_path / "mirror.yaml"
    nominal.write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 25.4e-3\noff_axis_distance: 50.8e-3\n"
    )
    sizes = {}
    for name, used in (("resolved", out), ("unresolved", sum_of_lags)):
        summary = facts(
            capsys, "correct", late_pair[1], "--calibration", used, "--nominal", nominal,
            "--out", tmp_path / name, "--no-report", "--settings", '{"machine": "twin"}',
        )  # fmt: skip
        sizes[name] = summary["deviation"]["corrected"]["rms"], summary["uncertainty_budget"]
        assert summary["latency"]["source"] == ("several speeds" if used == out else "unresolved")
    noise = np.hypot(10e-9, 10e-9 / np.sqrt(12))
    assert sizes["resolved"][0] < 1.2 * noise
    # The correction itself causes this error, and the budget includes it.
    assert sizes["unresolved"][0] > 5 * noise
    assert sizes["unresolved"][1]["probe_latency"] > sizes["unresolved"][0] / 2


@pytest.mark.soak
def test_selfcal_without_a_step_test_says_what_it_cannot_tell(capsys, tmp_path, late_pair):
    out = tmp_path / "cal.json"
    arguments = ["selfcal", *map(str, late_pair), "--out", str(out)]
    arguments += ["--static-gain", str(PAPER_STATIC_GAIN), "--gain-uncertainty", "1e-4"]
    found = facts(capsys, *arguments)
    assert found["latency"]["share"] is None
    assert abs(found["lag"] - 0.3397e-3) < 3 * found["lag_uncertainty"] < 6e-6
    assert any(text.startswith("latency") for text in found["unidentifiable"])
    assert cli.main(arguments) == 0
    assert "not identifiable" in capsys.readouterr().out


def test_a_latency_is_declared_with_a_reason(capsys, tmp_path, calibration):
    out = tmp_path / "declared.json"
    given = ["latency", calibration, "--delay", "1e-4", "--uncertainty", "5e-6", "--out", out]
    found = facts(capsys, *given, "--reason", "data sheet")
    assert found["latency"]["source"] == "declared"
    assert calibration_file.load_calibration(out).certificate.latency.delay_s == 1e-4
    assert cli.main([*map(str, given), "--reason", " "]) == 2
    assert "needs a reason" in capsys.readouterr().err
    given[3] = "0.1"
    assert cli.main([*map(str, given), "--reason", "data sheet"]) == 2
    assert "100 ms is more than the whole lag of Z" in capsys.readouterr().err


def test_reversal_writes_what_it_found(capsys, tmp_path, sum_of_lags):
    late = Disturbances(probe=ProbeErrors(latency_s=1e-4))
    scans = [
        write(
            tmp_path / f"{rpm}.mcap",
            record(
                Cell(seed=7, disturbances=late), Spiral(PAPER_MIRROR, 12.7e-3, 1e-3, rpm),
                PAPER_MIRROR,
            ),
        )
        for rpm in (60.0, -60.0)
    ]  # fmt: skip
    out = tmp_path / "resolved.json"
    found = facts(capsys, "reversal", *scans, "--calibration", sum_of_lags, "--out", out)
    latency = calibration_file.load_calibration(out).certificate.latency
    assert latency.source == "reversal"
    assert latency.delay_s == pytest.approx(found["lag"])
    assert found["latency"] is None
