"""Least squares with columns of any units, against the normal equations and by geometry."""

import numpy as np
import pytest

from omsm_ros.linear_algebra import basis_and_inverse, least_squares, unit_columns

RANDOM = np.random.default_rng(1)
COLUMNS = RANDOM.normal(size=(50, 3)) * [1e-9, 1.0, 1e12]


def test_columns_of_any_units_are_solved_exactly():
    """Unscaled, the column of nanometres would be taken for rounding beside that of 1e12."""
    truth = np.array([3e9, -2.0, 5e-12])
    assert least_squares(COLUMNS, COLUMNS @ truth) == pytest.approx(truth, rel=1e-9)
    plain = np.linalg.lstsq(COLUMNS, COLUMNS @ truth, rcond=None)[0]
    assert abs(plain[0] - truth[0]) > 1e9


def test_the_residual_is_orthogonal_to_every_column():
    values = RANDOM.normal(size=50)
    unit, scale = unit_columns(COLUMNS)
    assert np.linalg.norm(unit, axis=0) == pytest.approx(1.0)
    assert unit * scale == pytest.approx(COLUMNS)
    residual = values - COLUMNS @ least_squares(COLUMNS, values)
    assert unit.T @ residual == pytest.approx(0.0, abs=1e-12)


def test_a_column_of_zeros_gets_nothing():
    columns = np.column_stack([COLUMNS, np.zeros(50)])
    found = least_squares(columns, COLUMNS[:, 0])
    assert found[3] == 0.0
    assert np.all(np.isfinite(found))


def test_a_direction_below_the_tolerance_is_left_out():
    twice = np.column_stack([COLUMNS[:, 1], COLUMNS[:, 1] * (1 + 1e-9), COLUMNS[:, 2]])
    assert basis_and_inverse(twice, 1e-6)[0].shape == (50, 2)
    basis, parameters = basis_and_inverse(COLUMNS, 1e-6)
    assert COLUMNS @ parameters == pytest.approx(basis, abs=1e-12)
    assert basis.T @ basis == pytest.approx(np.eye(3), abs=1e-12)
    column = COLUMNS[:, 0] * 1e9
    assert basis @ (basis.T @ column) == pytest.approx(column, abs=1e-12)


def test_a_basis_of_many_rows_is_that_of_numpy():
    """Two columns of a walk differ by a millionth: the basis is orthogonal to the rounding left."""
    rng = np.random.default_rng(2)
    many = np.cumsum(rng.normal(size=(30_000, 5)), axis=0)
    many[:, 4] = many[:, 3] + 1e-6 * rng.normal(size=30_000)
    basis = basis_and_inverse(many, 1e-12)[0]
    assert basis.T @ basis == pytest.approx(np.eye(5), abs=1e-7)
    left = np.linalg.svd(unit_columns(many)[0], full_matrices=False)[0]
    assert np.abs(np.linalg.eigvalsh(basis.T @ left @ left.T @ basis)) == pytest.approx(1.0)
