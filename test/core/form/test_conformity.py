"""A tolerance is held for certain, failed for certain, or neither."""

import pytest

from omsm_ros.core.form.deviation_map import FAILS, HOLDS, OPEN, Doubt, UncertainValue, conformity


@pytest.mark.parametrize(
    ("value", "uncertainty", "verdict"),
    [
        (80e-9, 9e-9, HOLDS),
        (80e-9, 10e-9, HOLDS),
        (80e-9, 11e-9, OPEN),
        (100e-9, 0.0, HOLDS),
        (100e-9, 1e-12, OPEN),
        (120e-9, 11e-9, OPEN),
        (121e-9, 10e-9, FAILS),
        (50e-9, None, OPEN),
        (5e-6, None, OPEN),
    ],
)
def test_with_its_expanded_uncertainty(value, uncertainty, verdict):
    found = conformity(UncertainValue(value, uncertainty), 100e-9)
    assert found.verdict == verdict
    assert found.entry()["tolerance"] == 100e-9
    assert found.expanded == (None if uncertainty is None else 2 * uncertainty)


def test_nothing_is_said_of_a_figure_without_a_value():
    assert conformity(UncertainValue(None, None), 100e-9) is None


@pytest.mark.parametrize(
    ("reaches", "verdict"), [(None, OPEN), (101e-9, OPEN), (99e-9, HOLDS), (0.0, HOLDS)]
)
def test_what_no_figure_contains_keeps_it_open_if_it_may_exceed_the_tolerance(reaches, verdict):
    found = conformity(UncertainValue(80e-9, 1e-9), 100e-9, [Doubt("a hole", reaches)])
    assert found.verdict == verdict
    assert found.reasons == ("a hole",) * (verdict == OPEN)
    failed = conformity(UncertainValue(120e-9, 1e-9), 100e-9, [Doubt("a hole", reaches)])
    assert failed.verdict == FAILS
