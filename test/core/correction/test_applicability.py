"""Stale and foreign calibrations."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.calibration.applicability import admit, objections
from omsm_ros.core.calibration.calibration import Calibration, settings_with
from omsm_ros.core.calibration.certificate import Certificate
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import CalibrationError

SETTINGS = {"exposure_s": 0.5e-3, "averaging": 1, "machine": "Nanoform 250", "triggered": True}


def objection_texts(known: Calibration, **options: object) -> tuple[str, ...]:
    return tuple(map(str, objections(known, **options)))  # type: ignore[arg-type]


def calibration(**certificate: object) -> Calibration:
    return Calibration(
        dynamics=TransferFunction(np.ones(1), np.array([1.0, 1e-4])),
        static_gain=1.0,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=np.zeros((3, 3)),
        settings=SETTINGS,
        certificate=certified_by({"verdict": "accepted", **certificate}),
    )


PROBE = {"probe.averaging": 4.0, "probe.model": "A"}


@pytest.mark.parametrize(
    ("reported", "reasons"),
    [
        ([], ()),
        ([PROBE], ()),
        ([{"probe.averaging": 4}], ()),
        ([{"probe.lamp": 50.0}], ()),
        ([PROBE | {"probe.averaging": 8.0}], ("probe.averaging is 8.0, calibrated with 4.0",)),
        ([PROBE, PROBE | {"probe.model": "B"}] * 2, ("probe.model is 'B', calibrated with 'A'",)),
    ],
)
def test_what_the_probe_tells_is_compared_where_both_know(reported, reasons):
    known = replace(calibration(), settings=SETTINGS | PROBE)
    assert objection_texts(known, probe=reported) == reasons
    assert objection_texts(known, settings=SETTINGS, probe=reported) == reasons


def test_a_calibration_belongs_to_one_setting_of_the_probe():
    assert settings_with({"machine": "A"}, []) == {"machine": "A"}
    assert settings_with({"machine": "A"}, [PROBE, PROBE]) == {"machine": "A", **PROBE}
    with pytest.raises(CalibrationError, match=r"averaging is 4\.0, then 8\.0 in one motion"):
        settings_with({}, [PROBE, {"probe.averaging": 8.0}])


def test_the_same_settings_raise_no_objection() -> None:
    known = calibration(verdict="accepted up to 80 Hz", polarity=1)
    assert objections(known, sample_period=1e-3, settings=SETTINGS, polarity=1) == ()


def test_what_is_not_asked_is_not_objected_to() -> None:
    assert objections(calibration()) == ()


def test_a_calibration_that_nobody_judged_is_objected_to() -> None:
    unjudged = replace(calibration(), certificate=Certificate())
    assert objection_texts(unjudged) == ("its certificate states no verdict",)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("exposure_s", 1e-3, "exposure_s is 0.001, calibrated with 0.0005"),
        ("averaging", 4, "averaging is 4, calibrated with 1"),
        ("machine", "other", "machine is 'other', calibrated with 'Nanoform 250'"),
        ("triggered", False, "triggered is False, calibrated with True"),
        ("triggered", 1.5, "triggered is 1.5, calibrated with True"),
    ],
)
def test_a_setting_that_differs_is_reported_with_both_values(
    name: str, value: object, text: str
) -> None:
    assert objection_texts(calibration(), settings=SETTINGS | {name: value}) == (text,)


def test_a_setting_that_is_no_longer_known_is_reported() -> None:
    now = {k: v for k, v in SETTINGS.items() if k != "averaging"}
    assert objection_texts(calibration(), settings=now) == (
        "averaging is not known, calibrated with 1",
    )


def test_numbers_are_compared_as_numbers() -> None:
    assert objections(calibration(), settings=SETTINGS | {"averaging": 1.0}) == ()
    assert objections(calibration(), settings=SETTINGS | {"exposure_s": 0.5000000001e-3}) == ()


def test_another_rate_is_reported() -> None:
    found = objection_texts(calibration(), sample_period=0.5e-3)
    assert found == ("sample period is 0.0005 s, calibrated at 0.001 s",)


def test_a_failed_certificate_tells_its_reasons() -> None:
    failed = calibration(verdict="rejected", reasons=["too noisy", "too few edges"])
    (text,) = objection_texts(failed)
    assert text == "its certificate says 'rejected' (too noisy; too few edges)"


def test_a_probe_turned_round_since_is_reported() -> None:
    (text,) = objection_texts(calibration(polarity=1), polarity=-1)
    assert text.startswith("polarity is -1, calibrated with 1 (the distance falls as z rises)")
    assert text.endswith("state polarity 1 ('polarity')")
    assert "rises as z rises" in objection_texts(calibration(polarity=-1), polarity=1)[0]


def test_objections_refuse_unless_overridden_and_are_recorded() -> None:
    known = calibration(verdict="rejected")
    reasons = objections(known, sample_period=0.5e-3)
    with pytest.raises(CalibrationError, match=r"rejected.*0\.0005 s.*override") as refusal:
        admit(known, reasons, override=False)
    assert known.id[:12] in str(refusal.value)
    recorded = json.loads(json.dumps(admit(known, reasons, override=True)))
    assert recorded == {
        "calibration": known.id,
        "objections": list(map(str, reasons)),
        "overridden": True,
    }


def test_without_objections_nothing_is_overridden() -> None:
    known = calibration()
    assert admit(known, (), override=True)["overridden"] is False
