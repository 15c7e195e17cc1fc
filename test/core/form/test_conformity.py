"""A tolerance is held for certain, failed for certain, or neither."""

import pytest

from omsm_ros.core.form.deviation_map import FAILS, HOLDS, OPEN, UncertainValue, conformity


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
