"""Test that calibration files of version 1 are read, with the same numbers."""

from __future__ import annotations

import json

import numpy as np
import pytest

from omsm_ros.core.calibration.calibration import SCHEMA_1, content_id
from omsm_ros.core.calibration.certificate import RESERVATION, WARNING
from omsm_ros.errors import CalibrationError
from omsm_ros.io.calibration_file import load_calibration, save_calibration

LATENCY = {
    "delay_s": 1e-4, "uncertainty_s": 1e-6, "be" "side_z_s": 2e-6, "share": 0.3,
    "source": "declared", "reason": "data sheet",
}  # fmt: skip
CERTIFICATE = {
    "verdict": "accepted with reservations, supported by data from 0.0055 Hz to 66.2 Hz",
    "reasons": [], "reservations": ["backlash of 5 nm"], "warnings": ["pole at 100 Hz"],
    "input": "encoder", "recorded_ns": 5, "order": 1, "noise_m": 1.1e-8, "valid_from": 0.0055,
    "structure": {"poles": 1, "zeros": 0, "delay": True}, "static_gain_uncertainty": 3e-6,
    "candidates": [{"poles": 1, "zeros": 0, "delay": True, "bic": -3.5, "rms_m": 1e-8}],
    "noise_covariance": [0.0] * 9, "latency": LATENCY, "motion_error_m": 2e-9, "humidity": 0.4,
    "departures": [{"family": "backlash", "parameter": 0.0, "size_m": 5e-9, "uncertainty_m": 1e-9,
                    "modelled": "in addition"}],
    "limits": {"gain": 0.005, "phase_rad": 0.0087}, "two_mass": None, "static_gains": None,
}  # fmt: skip


@pytest.fixture
def content():
    made = {
        "schema": SCHEMA_1, "numerator": [1.0], "denominator": [1.0, 1e-3], "delay": 1e-4,
        "static_gain": 0.99, "sample_period": 1e-3, "valid_up_to": 66.2,
        "covariance": [0.0, 0.0, 0.0, 0.0, 1e-12, 0.0, 0.0, 0.0, 1e-14],
        "settings": {"machine": "a"}, "certificate": CERTIFICATE,
    }  # fmt: skip
    return made | {"id": content_id(made)}


def test_its_numbers_and_findings_are_kept(content, tmp_path):
    path = tmp_path / "cal.json"
    path.write_text(json.dumps(content))
    read = load_calibration(path)
    assert read.dynamics.denominator.tolist() == content["denominator"]
    assert np.array_equal(read.covariance.ravel(), content["covariance"])
    certificate = read.certificate
    assert certificate.verdict == "accepted with reservations"
    assert [(f.severity, str(f)) for f in certificate.findings] == [
        (RESERVATION, "backlash of 5 nm"),
        (WARNING, "pole at 100 Hz"),
    ]
    assert certificate.origin.made_from == content["id"]
    assert (read.latency.delay_s, read.latency.unshared_s) == (1e-4, 2e-6)
    assert certificate.model_errors.modelled[0].size_m == 5e-9
    assert certificate.candidates[0].structure == certificate.structure
    assert certificate.further == {"humidity": 0.4}


def test_written_again_it_is_of_version_2_and_says_the_same(content, tmp_path):
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    old.write_text(json.dumps(content))
    first = load_calibration(old)
    save_calibration(new, first)
    assert json.loads(new.read_text())["schema"] == "omsm-calibration/2"
    again = load_calibration(new)
    assert again.certificate == first.certificate
    assert again.id == first.id


def test_one_that_was_altered_is_refused(content, tmp_path):
    path = tmp_path / "cal.json"
    path.write_text(json.dumps(content | {"static_gain": 0.98}))
    with pytest.raises(CalibrationError, match="altered"):
        load_calibration(path)
