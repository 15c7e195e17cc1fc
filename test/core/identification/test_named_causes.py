"""Test that a certificate names the disturbance that was made, or none, and never another."""

from __future__ import annotations

import pytest
from soaked import soaked

from benchmarks.disturbance_catalogue import CATALOGUE, SIZES
from benchmarks.named_causes import RIGHT, UNKNOWN, WRONG, judged
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.certificate import RESERVATION, Finding
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import OmsmError
from omsm_ros.twin.cell import Cell, record

# These move the part, which a step test on a mirror does not measure.
_OF_THE_PART = ("part", "spindle", "vibration, 11 times a turn")
_NAMED = (
    "drift, sine",
    *soaked("backlash", "friction", "linearity, periodic", "vibration, 13.7 Hz"),
)


def named(name: str, size: int, seed: int = 0) -> str:
    """Return how the cause is named in a step test of the disturbed cell; empty for none."""
    cell = Cell(disturbances=CATALOGUE[name][size], seed=9000 + seed)
    made = record(cell, StepTest(), Flat(), stand_off=-49e-6)
    try:
        certificate = identify(made.motion_record()).calibration.certificate
    except OmsmError:
        return UNKNOWN
    findings = [*certificate.reasons, *certificate.reservations]
    return judged(name, findings) if findings else ""


@pytest.mark.parametrize("name", _NAMED)
def test_a_disturbance_of_large_size_is_named(name: str) -> None:
    assert named(name, 2) == RIGHT


@pytest.mark.parametrize("size", [*soaked(0, 1), 2], ids=SIZES)
def test_a_nonlinear_scale_of_the_probe_is_no_drift(size: int) -> None:
    assert named("linearity, cubic", size) == RIGHT


@pytest.mark.soak
def test_slow_creep_of_large_size_is_no_backlash() -> None:
    assert named("creep, 2 s", 2) == RIGHT


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
