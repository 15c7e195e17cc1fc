"""Test that a certificate names the disturbance that was made, or none, and never another."""

from __future__ import annotations

import pytest
from soaked import soaked

from benchmarks.disturbance_catalogue import CATALOGUE, SIZES, together
from benchmarks.named_causes import RIGHT, UNKNOWN, WRONG, judged
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.certificate import REJECTED, RESERVATION, Certificate, Finding
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.model_errors.families import PERIODIC
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import OmsmError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import Disturbances

# These move the part, which a step test on a mirror does not measure.
_OF_THE_PART = ("part", "spindle", "vibration, 11 times a turn")
_NAMED = (
    "vibration, 13.7 Hz",
    *soaked("drift, sine", "backlash", "friction", "linearity, periodic"),
)


def certified(disturbances: Disturbances, seed: int = 0) -> Certificate:
    """Return the certificate of a step test of the disturbed cell."""
    cell = Cell(disturbances=disturbances, seed=9000 + seed)
    made = record(cell, StepTest(), Flat(), stand_off=-49e-6)
    return identify(made.motion_record()).calibration.certificate


def named(name: str, size: int, seed: int = 0) -> str:
    """Return how the cause is named in a step test of the disturbed cell; empty for none."""
    try:
        certificate = certified(CATALOGUE[name][size], seed)
    except OmsmError:
        return UNKNOWN
    findings = [*certificate.reasons, *certificate.reservations]
    return judged(name, findings) if findings else ""


@pytest.mark.parametrize("name", _NAMED)
def test_a_disturbance_of_large_size_is_named(name: str) -> None:
    assert named(name, 2) == RIGHT


@pytest.mark.parametrize("size", soaked(0, 1, 2), ids=SIZES)
def test_a_nonlinear_scale_of_the_probe_is_no_drift(size: int) -> None:
    assert named("linearity, cubic", size) == RIGHT


@pytest.mark.soak
def test_slow_creep_of_large_size_is_no_backlash() -> None:
    assert named("creep, 2 s", 2) == RIGHT


def test_a_stiffness_that_grows_is_no_creep_and_no_mode() -> None:
    both = together(CATALOGUE["hardening"][2], CATALOGUE["creep, 0.2 s"][2])
    found = certified(both)
    assert found.verdict == REJECTED
    assert found.reasons[0].code == "identification.stiffening"
    # A mode at 100 Hz would imitate it, and the response would pass for accepted.
    assert judged("hardening", [*found.reasons, *found.reservations]) == RIGHT


@pytest.mark.soak
def test_errors_of_one_period_do_not_cancel_each_other() -> None:
    names = "linearity, periodic as the steps", "isolator, 2.5 Hz"
    both = together(*(CATALOGUE[name][1] for name in names))
    found = certified(both, 154)
    errors = [error for error in found.model_errors.modelled if error.family == PERIODIC]
    assert [error.parameter for error in errors] == pytest.approx([9.8e-6], rel=0.01)
    assert errors[0].size_m == pytest.approx(12e-9, rel=0.2)


@pytest.mark.soak  # three minutes
def test_no_disturbance_of_the_catalogue_is_named_wrongly() -> None:
    names = [name for name in CATALOGUE if not name.startswith(_OF_THE_PART)]
    outcomes = {
        f"{name}, {SIZES[size]}": named(name, size) for name in names for size in range(len(SIZES))
    }
    assert len(outcomes) > 100
    stated = [outcome for outcome in outcomes.values() if outcome]
    assert stated.count(RIGHT) > 50
    assert [name for name, outcome in outcomes.items() if outcome == WRONG] == []


def test_a_cause_is_right_unknown_or_wrong() -> None:
    backlash = Finding("identification.backlash", RESERVATION, {"size_m": 1e-8})
    differ = Finding("identification.sizes_differ", RESERVATION)
    assert judged("backlash", [backlash, differ]) == RIGHT
    assert judged("friction + backlash", [backlash]) == RIGHT
    assert judged("friction", [differ]) == UNKNOWN
    assert judged("friction", [backlash]) == WRONG
