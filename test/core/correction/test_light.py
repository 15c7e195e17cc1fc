"""Green only where everything was looked at and is small enough; each reason has its remedy."""

from __future__ import annotations

from dataclasses import replace

import pytest
from certified import certified_by

from omsm_ros.core.calibration.calibration import Calibration, with_latency
from omsm_ros.core.calibration.latency import declared_latency
from omsm_ros.core.correction.budget import (
    AMBER,
    GREEN,
    RED,
    TrafficLight,
    TrafficLightReason,
    excess_noise_reasons,
    traffic_light_of,
)
from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource

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
    return with_latency(true_calibration, declared_latency(3e-4, 0.0, 1e-7, "trigger of the maker"))


HEIGHTS = {"dynamics": 3e-9, "probe_latency": 4e-9}


def light(calibration: Calibration, sources: MachineSources, **more: object) -> TrafficLight:
    return traffic_light_of(calibration, HEIGHTS, sources, **more)  # type: ignore[arg-type]


def test_green_when_all_is_settled_for_what_is_asked_for(settled: Calibration) -> None:
    found = light(settled, all_but(), accuracy=20e-9)
    assert (found.level, found.reasons) == (GREEN, ())
    assert str(found.word) == "calibration valid up to 100 Hz, uncertainty below 20.0 nm (k = 2)"
    assert found.uncertainty == pytest.approx(10e-9)


@pytest.mark.parametrize("missing", LOOKED_AT)
def test_amber_for_each_thing_that_nobody_looked_at(settled: Calibration, missing: str) -> None:
    found = light(settled, all_but(missing), accuracy=20e-9)
    assert found.level == AMBER
    (reason,) = found.reasons
    assert "not evaluated" in str(reason.what)
    assert len(str(reason.remedy)) > 20


def test_pose_does_not_count_where_there_is_no_nominal_surface(settled: Calibration) -> None:
    pose = all_but("tilt", "decentre", "clocking")
    assert light(settled, pose).level == AMBER
    assert light(settled, pose, pose_open=()).level == GREEN
    assert light(settled, pose, pose_open=("clocking",)).level == AMBER


def test_a_part_that_was_registered_is_not_to_be_registered_again(settled: Calibration) -> None:
    pose = all_but("tilt", "decentre", "clocking")
    (reason,) = light(settled, pose, pose_open=("decentre",), registered=True).reasons
    assert "register the part" not in str(reason.remedy)
    assert "decentre" in str(reason.what)
    assert "--fit auto" in str(reason.remedy)
    (before,) = light(settled, pose, pose_open=("decentre",)).reasons
    assert "register the part" in str(before.remedy)


def test_an_open_latency_is_settled_where_it_is_small_for_what_is_asked(
    true_calibration: Calibration,
) -> None:
    assert light(true_calibration, all_but()).level == AMBER
    assert light(true_calibration, all_but(), accuracy=20e-9).level == AMBER
    (reason,) = light(true_calibration, all_but(), accuracy=20e-9).reasons
    assert "8.00 nm" in str(reason.what)
    assert "omsm selfcal" in str(reason.remedy)
    assert light(true_calibration, all_but(), accuracy=25e-9).level == GREEN


def test_red_when_what_is_known_is_too_much(settled: Calibration) -> None:
    found = light(settled, all_but(), accuracy=9e-9)
    assert (found.level, str(found.word)) == (RED, "accuracy not supported by data")
    assert "10.0 nm (k = 2) exceeds the accuracy of 9.00 nm" in str(found.reasons[0].what)
    assert "probe latency, which alone contributes 8.00 nm" in str(found.reasons[0].remedy)


def test_red_for_a_rejected_calibration_and_amber_without_a_certificate(
    settled: Calibration,
) -> None:
    refused = certified_by({"verdict": "rejected", "reasons": ["not linear"]}, settled.certificate)
    found = light(replace(settled, certificate=refused), all_but())
    assert found.level == RED
    assert TrafficLightReason("not linear") in found.reasons
    silent = replace(settled.certificate, verdict=None)
    assert light(replace(settled, certificate=silent), all_but()).level == AMBER


def test_other_doubts_make_it_amber(settled: Calibration) -> None:
    doubt = TrafficLightReason("half of the points are lost", "run slower")
    assert light(settled, all_but(), doubts=[doubt]).reasons == (doubt,)
    assert str(doubt) == "half of the points are lost: run slower"


def test_scatter_beyond_what_is_stated_is_reported_with_both() -> None:
    """3 and 4 nm stated are 5, with 12 beyond they are 13; what all heights share is no scatter."""
    budget = {"probe_noise": 3e-9, "vibration": 4e-9, "scan_scatter": 12e-9, "dynamics": 1e-6}
    (reason,) = excess_noise_reasons(budget)
    assert str(reason.what) == (
        "heights of this scan scatter by 13.0 nm, the stated sources of single readings by 5.00 nm"
    )
    assert "state probe_noise" in str(reason.remedy)


@pytest.mark.parametrize("beyond", [0.0, 1e-9, 2e-9])
def test_a_little_more_scatter_is_light_and_texture(beyond: float) -> None:
    assert not [*excess_noise_reasons({"probe_noise": 5e-9, "scan_scatter": beyond})]


def test_the_unit_of_the_scatter_does_not_matter() -> None:
    for size in (1e-12, 1e-9, 1e-3):
        assert [*excess_noise_reasons({"probe_noise": size, "scan_scatter": size})]
        assert not [*excess_noise_reasons({"probe_noise": size, "scan_scatter": 0.3 * size})]


def test_where_nothing_is_stated_nothing_is_exceeded() -> None:
    assert not [*excess_noise_reasons({"scan_scatter": 1e-6})]
    assert not [*excess_noise_reasons({})]


def test_what_all_heights_share_adds_in_squares(settled: Calibration) -> None:
    heights = {"dynamics": 2e-9, "tilt": 6e-9, "drift": 9e-9}
    found = traffic_light_of(settled, heights, all_but(), accuracy=30e-9)
    assert found.uncertainty == pytest.approx(22e-9)
    # Where none is asked for, the accuracy is what is stated.
    assert traffic_light_of(settled, heights, all_but()).accuracy == found.uncertainty
    nothing = traffic_light_of(settled, {}, all_but(), accuracy=1e-9)
    assert (nothing.uncertainty, nothing.level) == (0.0, GREEN)


def test_what_is_too_large_stands_before_what_nobody_looked_at(settled: Calibration) -> None:
    doubt = TrafficLightReason("half of the points are lost")
    found = traffic_light_of(settled, HEIGHTS, all_but("vibration"), accuracy=9e-9, doubts=[doubt])
    what = [str(reason.what) for reason in found.reasons]
    assert found.level == RED
    assert "exceeds the accuracy" in what[0]
    assert what[1:] == ["vibration not evaluated", "half of the points are lost"]
    assert str(doubt) == "half of the points are lost"


def test_the_entry_of_the_summary_has_every_reason(settled: Calibration) -> None:
    entry = light(settled, all_but("vibration"), accuracy=20e-9).entry()
    assert entry["level"] == AMBER
    assert entry["accuracy"] == 20e-9
    assert [reason["what"] for reason in entry["reasons"]] == ["vibration not evaluated"]
