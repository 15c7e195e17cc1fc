"""Masses and springs against the equations of motion."""

import numpy as np
import pytest

from benchmarks.recorded import two_mass_response
from omsm_ros.core.lti.frequency_response import relative_response_jacobian
from omsm_ros.core.lti.modes import (
    FITTED,
    TwoMass,
    fit_two_mass,
    known_modes,
    oscillations,
    response_features,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import DataError, IdentificationError
from omsm_ros.twin.plant import PAPER_EQ_12

MACHINE = TwoMass(m1=10.0, m2=2.0, k1=8e6, k2=1.6e6, c1=900.0, c2=60.0)


def by_equations_of_motion(model, mass):
    """Force on m1 to the position of ``mass``, from M x'' + C x' + K x = f."""
    m = np.diag([model.m1, model.m2])
    c = np.array([[model.c1 + model.c2, -model.c2], [-model.c2, model.c2]])
    k = np.array([[model.k1 + model.k2, -model.k2], [-model.k2, model.k2]])
    inverse = np.linalg.inv(m)
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ k, -inverse @ c]])
    b = np.concatenate([np.zeros((2, 1)), inverse[:, :1]])
    row = np.zeros((1, 4))
    row[0, mass] = 1.0
    return a, b, row


@pytest.mark.parametrize("mass", [0, 1])
def test_eq_7_follows_from_the_equations_of_motion(mass):
    frequency = np.geomspace(0.5, 400, 50)
    a, b, row = by_equations_of_motion(MACHINE, mass)
    direct = np.array(
        [(row @ np.linalg.solve(2j * np.pi * f * np.eye(4) - a, b))[0, 0] for f in frequency]
    )
    ours = two_mass_response(MACHINE, collocated=not mass)
    np.testing.assert_allclose(ours.response(frequency), direct * MACHINE.k1, rtol=1e-8)


def test_a1_as_printed_would_make_an_ordinary_machine_unstable():
    assert two_mass_response(MACHINE, collocated=False).is_stable
    printed = two_mass_response(MACHINE, collocated=False).denominator.copy()
    printed[1] = (MACHINE.k1 + MACHINE.k2) * MACHINE.c1 / (MACHINE.k1 * MACHINE.k2)
    assert not TransferFunction([1.0], printed).is_stable


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_a_mass_must_be_positive(value):
    with pytest.raises(DataError, match="m2"):
        TwoMass(m1=1.0, m2=value, k1=1.0, k2=1.0, c1=1.0, c2=1.0)


def test_only_conjugate_pairs_oscillate():
    dynamics = two_mass_response(MACHINE, collocated=False)
    slow = np.polynomial.polynomial.polymul(dynamics.denominator, [1.0, 0.1])
    damped = TransferFunction(dynamics.numerator, slow)
    assert oscillations(damped) == pytest.approx([m.frequency for m in known_modes(dynamics)])


@pytest.mark.parametrize("collocated", [False, True])
def test_masses_and_springs_are_recovered(collocated):
    truth = two_mass_response(MACHINE, collocated=collocated)
    size = len(truth.numerator) + len(truth.denominator)
    covariance = np.zeros((size, size))
    covariance[len(truth.numerator), len(truth.numerator)] = (1e-4 * truth.denominator[1]) ** 2
    fitted = fit_two_mass(
        truth,
        covariance,
        table_mass=10.0,
        collocated=collocated,
        frequencies=np.linspace(1, 250, 250),
    )
    for name in ("m2", "k1", "k2", "c1", "c2"):
        assert getattr(fitted.model, name) == pytest.approx(getattr(MACHINE, name), rel=1e-3)
    assert np.all(np.isfinite(fitted.uncertainty))


@pytest.mark.soak
@pytest.mark.parametrize("collocated", [False, True])
def test_masses_and_springs_lie_within_what_is_stated_of_them(collocated):
    """Responses drawn from their covariance, with coefficients that the machine does not need."""
    soft = TwoMass(m1=1.0, m2=0.2, k1=2e5, k2=4e4, c1=45.0, c2=6.0)
    truth = two_mass_response(soft, collocated=collocated)
    numerator = np.zeros(4)
    numerator[: len(truth.numerator)] = truth.numerator
    lines = np.linspace(2, 80, 40)
    padded = TransferFunction(numerator, truth.denominator)
    jacobian = np.vstack(relative_response_jacobian(padded, lines))
    # The numerator but for G(0) = 1, the denominator but for its 1. A step test knows what is slow
    # much better than what is fast.
    known = np.tile(1e-7 * (1 + (lines / 4) ** 2), 2)[:, np.newaxis]
    free = range(1, jacobian.shape[1] - 1)
    size = np.linalg.norm(jacobian[:, free] / known, axis=0)
    scaled = jacobian[:, free] / known / size
    covariance = np.zeros((jacobian.shape[1],) * 2)
    covariance[np.ix_(free, free)] = (
        (2e-5) ** 2 * np.linalg.inv(scaled.T @ scaled) / np.outer(size, size)
    )
    root = np.linalg.cholesky(covariance[np.ix_(free, free)] * np.outer(size, size))
    random = np.random.default_rng(5)
    exact = np.log([soft.m2, soft.k1, soft.k2, soft.c1, soft.c2])
    errors, misfits = [], []
    for _ in range(16):
        drawn = np.concatenate([numerator, truth.denominator[1:]])
        drawn[1:] += root @ random.normal(size=len(free)) / size
        fitted = fit_two_mass(
            TransferFunction(drawn[:4], np.r_[1.0, drawn[4:]]),
            covariance,
            table_mass=1.0,
            collocated=collocated,
            frequencies=lines,
        )
        found = np.log([getattr(fitted.model, name) for name in FITTED])
        errors.append((found - exact) / fitted.uncertainty)
        misfits.append(fitted.misfit)
    assert max(misfits) < 3
    ratio = np.sqrt(np.mean(np.square(errors), axis=0))
    # An rms of 16 draws scatters by 18 %.
    assert np.all((ratio > 0.6) & (ratio < 1.4)), ratio


def test_one_mode_cannot_be_two_masses():
    one = TransferFunction.from_ascending([1.0], [1.0, 1e-4, 1e-6])
    with pytest.raises(IdentificationError, match="two oscillating modes"):
        fit_two_mass(one, np.zeros((3, 3)), table_mass=1.0, collocated=False, frequencies=[1.0])


def test_the_salient_points_of_eq_12():
    read = response_features(PAPER_EQ_12.normalised(), 2000.0)
    assert read["minimum"] == pytest.approx(347, abs=3)
    assert read["minimum_gain"] == pytest.approx(0.882 / PAPER_EQ_12.dc_gain, abs=2e-3)
    assert read["resonance"] == pytest.approx(850, abs=5)
    assert read["resonance_gain"] == pytest.approx(5.4 / PAPER_EQ_12.dc_gain, abs=0.1)
    assert 80 < read["bandwidth_1_percent"] < 100


def test_below_nyquist_eq_12_has_no_resonance():
    values = response_features(PAPER_EQ_12.normalised(), 500.0)
    assert values["resonance"] is None
    assert values["minimum"] == pytest.approx(347, abs=3)


def test_the_dip_of_a_driven_mass_is_where_the_other_absorbs():
    """However far the gain falls beyond the modes."""
    light = TwoMass(m1=10.0, m2=2.0, k1=8e6, k2=1.6e6, c1=900.0, c2=6.0)
    read = response_features(two_mass_response(light, collocated=True), 500.0)
    assert read["minimum"] == pytest.approx(np.sqrt(light.k2 / light.m2) / (2 * np.pi), rel=2e-3)
    modes = known_modes(two_mass_response(light, collocated=True))
    assert read["resonance"] == pytest.approx(modes[0].frequency, rel=0.01)


def test_a_covariance_that_rounding_made_indefinite_is_read_all_the_same():
    """Coefficients far apart in size: the least eigenvalue is rounding of the largest."""
    truth = two_mass_response(MACHINE, collocated=True)
    size = len(truth.numerator) + len(truth.denominator)
    values = np.concatenate([truth.numerator, truth.denominator[1:], [1e-6]])
    covariance = 1e-8 * np.outer(values, values)
    covariance[0] = covariance[:, 0] = 0.0
    covariance -= 2e-10 * np.diag(np.where(np.arange(size) == 1, values**2, 0.0))
    assert np.min(np.linalg.eigvalsh(covariance / np.max(covariance))) < 0
    fitted = fit_two_mass(
        truth,
        1e6 * covariance,
        table_mass=10.0,
        collocated=True,
        frequencies=np.linspace(1, 250, 50),
    )
    assert np.all(np.isfinite(fitted.uncertainty))
