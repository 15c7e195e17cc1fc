"""Test the parametrisation of structures."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soaked import always

from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.lti.transfer_function import Structure

EVERY = [Structure(n, m, d) for n in range(1, 6) for m in range(n) for d in (False, True)]


def random_shape(scaled, seed):
    shape = np.random.default_rng(seed).normal(0, 1, scaled.nonlinear_size)
    if scaled.structure.delay:
        shape[-1] = abs(shape[-1])
    return shape


@settings(max_examples=60)
@given(structure=st.sampled_from(EVERY), seed=st.integers(0, 10_000))
def test_every_shape_is_stable(structure, seed):
    scaled = ScaledStructure(structure, 300.0)
    numerator = np.ones(structure.zeros + 1)
    assert scaled.transfer_function(random_shape(scaled, seed), numerator).is_stable


@settings(max_examples=60)
@given(structure=st.sampled_from(EVERY), seed=st.integers(0, 10_000))
def test_the_lag_is_the_response_without_its_numerator(structure, seed):
    scaled = ScaledStructure(structure, 300.0)
    shape = random_shape(scaled, seed)
    numerator = np.concatenate([[1.0], np.random.default_rng(seed).normal(size=structure.zeros)])
    frequency = np.geomspace(0.1, 500, 20)
    s = 2j * np.pi * frequency / 300.0
    lag = scaled.lag(shape, s)
    direct = scaled.transfer_function(shape, numerator).response(frequency)
    np.testing.assert_allclose(np.polyval(numerator[::-1], s) * lag, direct, rtol=1e-9)


@pytest.mark.parametrize("structure", always(*EVERY[::6], EVERY[-1], of=EVERY), ids=str)
def test_the_gradient_is_that_of_finite_differences(structure):
    scaled = ScaledStructure(structure, 300.0)
    shape = random_shape(scaled, 7)
    s = 1j * np.geomspace(0.01, 10, 15)
    lag, relative = scaled.lag(shape, s), scaled.lag_slopes(shape, s)
    assert len(relative) == len(shape) == scaled.nonlinear_size
    for k in range(len(shape)):
        step = np.zeros_like(shape)
        step[k] = 1e-6
        difference = (scaled.lag(shape + step, s) - scaled.lag(shape - step, s)) / 2e-6
        np.testing.assert_allclose(relative[k] * lag, difference, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("structure", always(*EVERY[::6], EVERY[-1], of=EVERY), ids=str)
def test_the_jacobian_of_the_coefficients_is_that_of_finite_differences(structure):
    scaled = ScaledStructure(structure, 300.0)
    shape = random_shape(scaled, 5)
    numerator = np.concatenate([[1.0], np.arange(1.0, structure.zeros + 1)])

    def coefficients(vector):
        head = np.concatenate([[1.0], vector[: structure.zeros]])
        g = scaled.transfer_function(vector[structure.zeros :], head)
        return np.concatenate([g.numerator, g.denominator[1:], [g.delay]])

    vector = np.concatenate([numerator[1:], shape])
    jacobian = scaled.coefficient_jacobian(shape)
    assert jacobian.shape[1] == len(vector) > 0
    for k in range(len(vector)):
        step = np.zeros_like(vector)
        step[k] = 1e-6
        difference = (coefficients(vector + step) - coefficients(vector - step)) / 2e-6
        scale = np.abs(coefficients(vector)) + 1e-30
        np.testing.assert_allclose(jacobian[:, k] / scale, difference / scale, atol=1e-4)


def test_a_nonlinear_of_poles_has_those_poles():
    poles = np.array([-1 + 3j, -1 - 3j, -0.5, -4.0, -9.0], complex)
    scaled = ScaledStructure(Structure(5, 0, True), 200.0)
    g = scaled.transfer_function(scaled.nonlinear_of(poles, 0.25), np.ones(1))
    np.testing.assert_allclose(
        np.sort_complex(g.poles() / 200.0), np.sort_complex(poles), rtol=1e-6
    )
    assert g.delay == pytest.approx(0.25 / 200)


def test_containing_is_a_strict_order():
    small, large = Structure(1, 0, False), Structure(2, 1, True)
    assert large.contains(small)
    assert not small.contains(large)
    assert not large.contains(large)
    assert not Structure(3, 0, False).contains(Structure(1, 0, True))
