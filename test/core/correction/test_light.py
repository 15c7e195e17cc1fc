"""Green only where everything was looked at and is small enough; each reason has its remedy."""

from __future__ import annotations

from dataclasses import replace

import pytest

from omsm_ros.core.correction.light import AMBER, GREEN, RED, Light, Reason, light_of
from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.latency import declared, with_latency

LOOKED_AT = {
    "tilt": {},
    "decentre": {},
    "clocking": {},
    "drift_walk": {},
    "centre_x": {},
    "spindle_axial": {"per_turn": 2},
    "straightness_x": {},
    "probe_linearity": {"half_range": 5e-5},
    "probe_slope": {},
    "encoder_scale": {},
    "pitch": {},
    "vibration": {},
    "lag_change": {},
}


def all_but(*left_out: str) -> MachineSources:
    return MachineSources(
        tuple(
            StatedSource(source=name, value=0.0, reason="looked at", parameters=parameters)
            for name, parameters in LOOKED_AT.items()
            if name not in left_out
        )
    )


@pytest.fixture
def settled(true_calibration: Calibration) -> Calibration:
    return with_latency(true_calibration, declared(3e-4, 0.0, 1e-7, "trigger of the maker"))


HEIGHTS = {"dynamics": 3e-9, "lateral_lag": 4e-9}


def light(calibration: Calibration, sources: MachineSources, **more: object) -> Light:
    return light_of(calibration, HEIGHTS, sources, **more)  # type: ignore[arg-type]


def test_green_when_all_is_settled_for_what_is_asked_for(settled: Calibration) -> None:
    found = light(settled, all_but(), accuracy=20e-9)
    assert (found.level, found.reasons) == (GREEN, ())
    assert found.word == "supported by data up to 100 Hz, to 20.0 nm (k = 2)"
    assert found.uncertainty == pytest.approx(10e-9)


@pytest.mark.parametrize("missing", LOOKED_AT)
def test_amber_for_each_thing_that_nobody_looked_at(settled: Calibration, missing: str) -> None:
    found = light(settled, all_but(missing), accuracy=20e-9)
    assert found.level == AMBER
    (reason,) = found.reasons
    assert "not evaluated" in reason.what
    assert len(reason.remedy) > 20


def test_pose_does_not_count_where_there_is_no_nominal_surface(settled: Calibration) -> None:
    pose = all_but("tilt", "decentre", "clocking")
    assert light(settled, pose).level == AMBER
    assert light(settled, pose, pose_open=()).level == GREEN
    assert light(settled, pose, pose_open=("clocking",)).level == AMBER


def test_a_part_that_was_registered_is_not_to_be_registered_again(settled: Calibration) -> None:
    pose = all_but("tilt", "decentre", "clocking")
    (reason,) = light(settled, pose, pose_open=("decentre",), registered=True).reasons
    assert "register the part" not in reason.remedy
    assert "decentre" in reason.what
    assert "--fit auto" in reason.remedy
    (before,) = light(settled, pose, pose_open=("decentre",)).reasons
    assert "register the part" in before.remedy


def test_an_open_latency_is_settled_where_it_is_small_for_what_is_asked(
    true_calibration: Calibration,
) -> None:
    assert light(true_calibration, all_but()).level == AMBER
    assert light(true_calibration, all_but(), accuracy=20e-9).level == AMBER
    (reason,) = light(true_calibration, all_but(), accuracy=20e-9).reasons
    assert "8.00 nm" in reason.what
    assert "omsm selfcal" in reason.remedy
    assert light(true_calibration, all_but(), accuracy=25e-9).level == GREEN


def test_red_when_what_is_known_is_too_much(settled: Calibration) -> None:
    found = light(settled, all_but(), accuracy=9e-9)
    assert (found.level, found.word) == (RED, "not supported by data")
    assert "10.0 nm (k = 2) exceeds the accuracy of 9.00 nm" in found.reasons[0].what
    assert "lateral lag, which alone makes 8.00 nm" in found.reasons[0].remedy


def test_red_for_a_rejected_calibration_and_amber_without_a_certificate(
    settled: Calibration,
) -> None:
    refused = {**settled.certificate, "verdict": "rejected", "reasons": ["not linear"]}
    found = light(replace(settled, certificate=refused), all_but())
    assert found.level == RED
    assert Reason("not linear") in found.reasons
    silent = {k: v for k, v in settled.certificate.items() if k != "verdict"}
    assert light(replace(settled, certificate=silent), all_but()).level == AMBER


def test_other_doubts_make_it_amber(settled: Calibration) -> None:
    doubt = Reason("half of the points are lost", "run slower")
    assert light(settled, all_but(), doubts=[doubt]).reasons == (doubt,)
    assert str(doubt) == "half of the points are lost: run slower"
