"""Zeros of sampled systems against closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.lti.discretisation import polynomial_hold_zeros

NONE = np.empty(0, np.complex128)


def test_a_gain_has_no_zeros() -> None:
    assert len(polynomial_hold_zeros(NONE, NONE, 3)) == 0


@pytest.mark.parametrize("rate", [1e-4, 0.1, 1.0, 20.0])
def test_first_order_hold_of_a_lag_by_hand(rate: float) -> None:
    # 1/(1 + s/p) over a ramp from u0 to u1: weights of u1 and u0 after one step.
    decay = np.exp(-rate)
    new = 1 - (1 - decay) / rate
    old = (1 - decay) / rate - decay
    found = polynomial_hold_zeros(NONE, np.array([-rate + 0j]), 1)
    assert found.shape == (2,)
    # y[k] = decay y[k-1] + new u[k] + old u[k-1]; the other zero cancels the spare state.
    assert np.min(abs(found - (-old / new))) < 1e-7 * max(1.0, old / new)
    assert np.min(abs(found)) < 1e-7


def response_by_brute_force(
    zeros: np.ndarray, poles: np.ndarray, order: int, angle: float, fine: int = 4000
) -> complex:
    """G acting on the interpolated samples of e^{jwk}, by quadrature of its modes' integrals."""
    # Residues of distinct poles; G strictly proper.
    residues = [np.prod(p - zeros) / np.prod([p - q for q in poles if q != p]) for p in poles]
    nodes = -np.arange(order + 1.0)
    v = (np.arange(fine) + 0.5) / fine - 1.0
    basis = np.array([np.prod([(v - k) / (j - k) for k in nodes if k != j], axis=0) for j in nodes])
    u = (basis * np.exp(1j * angle * nodes)[:, np.newaxis]).sum(axis=0)
    total = 0j
    for residue, pole in zip(residues, poles, strict=True):
        step = np.sum(np.exp(-pole * v) * u) / fine
        total += residue * step / (1 - np.exp(pole - 1j * angle))
    return complex(total)


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_response_of_the_sampled_system_is_that_of_the_integral(order: int) -> None:
    zeros = np.array([0.7, -2.0 + 0.5j, -2.0 - 0.5j])
    poles = np.array([-0.3 + 0.9j, -0.3 - 0.9j, -1.5, -4.0, -0.05])
    found = polynomial_hold_zeros(zeros, poles, order)
    assert len(found) == len(poles) + order

    def sampled(angle: float) -> complex:
        z = np.exp(1j * angle)
        monic = np.prod(1 - found / z) / np.prod(1 - np.exp(poles) / z)
        return complex(monic)

    angles = [0.1, 0.8, 2.0, 3.0]
    ours = np.array([sampled(a) for a in angles])
    truth = np.array([response_by_brute_force(zeros, poles, order, a) for a in angles])
    gain = truth[0] / ours[0]
    assert abs(gain.imag / gain.real) < 1e-5
    assert np.allclose(gain * ours, truth, rtol=2e-5)


def test_zeros_come_in_exact_conjugate_pairs() -> None:
    random = np.random.default_rng(6)
    for _ in range(50):
        real, imaginary = -random.uniform(0.01, 9, 3), random.uniform(0.1, 9, 3)
        poles = np.concatenate([real + 1j * imaginary, real - 1j * imaginary])
        found = polynomial_hold_zeros(np.zeros(2, np.complex128), poles, 3, dc_zeros=2)
        assert np.array_equal(np.sort_complex(found), np.sort_complex(found.conj()))


def test_a_differentiator_of_a_resonance_is_blind_to_rest() -> None:
    poles = np.array([-0.1 + 2j, -0.1 - 2j, -0.1 + 2j, -0.1 - 2j])
    found = polynomial_hold_zeros(np.zeros(3, np.complex128), poles, 5, dc_zeros=3)
    assert np.count_nonzero(found == 1.0) == 3


@pytest.mark.parametrize("slow", [-6e-3, -3e-3, 1e-3])
@pytest.mark.parametrize("fast", [1.0, 2.0, 3.0])
def test_a_slow_zero_near_one_at_dc_is_neither_lost_nor_doubled(slow: float, fast: float) -> None:
    """Rounding makes a conjugate pair of the two: 1 takes the place of one, the other stays."""
    above = [-21 + 55j, -21 - 55j, -29 + 14j, -29 - 14j]
    poles = np.array([*above, -0.08, *above, -0.08, -6e-3]) * fast
    zeros = np.array([1443.0, -4 + 33j, -4 - 33j, -22, 0.19, -0.1, -0.014, slow, 9e-4, 0j]) * fast
    found = polynomial_hold_zeros(zeros, poles, 5, dc_zeros=1)
    assert len(found) == len(poles) + 5
    assert np.array_equal(np.sort_complex(found), np.sort_complex(found.conj()))
    assert np.count_nonzero(found == 1.0) == 1
