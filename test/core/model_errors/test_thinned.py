"""Test the decimated diagnostics of a long step test against those of all samples."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.estimation.steps import Steps
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.model_errors.families import BACKLASH, CREEP, MODE, PERIODIC, low_pass_response
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics

PERIOD, LAG = 2e-3, 0.7e-3
STEPS = StepTest(dwell=4.0, rise=40e-3)
TIME = np.arange(round(STEPS.duration / PERIOD)) * PERIOD
LATE = STEPS.positions(TIME - LAG).z


def surveyed(added=0.0):
    random = np.random.default_rng(4)
    z = STEPS.positions(TIME).z + random.normal(0, 0.3e-9, len(TIME))
    record = record_from_arrays(PERIOD, z, -(LATE + added) + random.normal(0, 1e-8, len(z)))
    prepared = prepare(record, "encoder")
    late = fit(prepared.problem, Structure(0, 0, True), [np.array([0.1])])
    return ResidualDiagnostics(prepared.problem, late, prepared.steps)


@pytest.fixture(scope="module")
def long():
    return surveyed()


def test_relaxations_are_as_large_and_as_well_known_in_fewer_samples(long):
    every = list(zip(long.creep, long.thinned.creep, strict=True))
    assert len(every) > 5
    for all_, fewer in every:
        assert fewer.term.parameter == all_.term.parameter
        assert fewer.score.uncertainty == pytest.approx(all_.score.uncertainty, rel=0.15)
        off = (fewer.score.size[0] - all_.score.size[0]) / all_.score.uncertainty
        assert abs(off) < 0.3


def test_the_edges_are_where_they_were_in_time(long):
    fewer = long.thinned
    assert len(fewer.problem.input) < 0.6 * len(long.problem.input)
    for edge, other in zip(long.steps.edges, fewer.steps.edges, strict=True):
        before = other.start * fewer.problem.period
        assert before == pytest.approx(edge.start * PERIOD, abs=fewer.problem.period)
        assert other.height == edge.height
    assert fewer.plateau == pytest.approx(long.plateau, rel=0.01)


@pytest.mark.parametrize("time_constant", [0.1, 3.0])
def test_the_relaxation_that_is_there_is_the_one_found(time_constant):
    found = surveyed(2e-3 * (low_pass_response(LATE, PERIOD / time_constant) - LATE)).best[CREEP]
    assert found.significant
    assert abs(np.log(found.term.parameter / time_constant)) < 0.5
    assert len(found.term.columns) == len(TIME)


def test_each_family_has_the_same_terms_there(long):
    families = list(long.model_errors.families((CREEP, MODE, PERIODIC, BACKLASH)))
    assert {f.name for f in families} == {CREEP, MODE, PERIODIC, BACKLASH}
    for family in families:
        if len(family.parameters) == 1:
            continue
        alike = long.thinned.model_errors.alike(family)
        assert (alike.name, alike.width, alike.trials) == (family.name, family.width, family.trials)
        np.testing.assert_array_equal(alike.parameters, family.parameters)
        every = round(long.thinned.problem.period / PERIOD)
        rested = ~np.convolve(long.steps.moving, np.ones(200), "same").astype(bool)[::every]
        # The position in a backlash of 10 nm depends on noise.
        first = len(family.parameters) - 1 if family.name == BACKLASH else 0
        for index in (first, len(family.parameters) - 1):
            there, here = alike.term(index).columns, family.term(index).columns[::every]
            np.testing.assert_allclose(
                there[rested], here[rested], atol=0.03 * np.max(abs(here)), err_msg=family.name
            )


def test_a_short_one_a_restless_one_and_rounded_readings_are_taken_whole(long, clean):
    assert clean.thinned is None
    moving = np.ones(len(TIME), bool)
    assert replace(long, steps=Steps((), moving, 1e-9, 1e-4)).thinned is None
    assert replace(long, steps=replace(long.steps, moving=moving)).thinned is None
    assert replace(long, problem=replace(long.problem, shared=1e-18)).thinned is None
