"""Masses and springs in the certificate: where they are right, and where there are none."""

from functools import lru_cache

import numpy as np
import pytest
from scipy import stats
from soaked import soaked

from benchmarks.recorded import two_mass_response
from benchmarks.step_test import StepTest
from omsm_ros.core.identification.identify import identify, table_mass, two_mass_model
from omsm_ros.core.lti.modes import FITTED, TwoMass, fit_two_mass
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant

# Both modes, 57 and 89 Hz, lie where a step test tells them.
MACHINE = TwoMass(m1=10.0, m2=2.0, k1=2e6, k2=4e5, c1=450.0, c2=60.0)


@lru_cache(maxsize=4)
def calibrated(collocated, mass):
    dynamics = two_mass_response(MACHINE, collocated=collocated)
    recording = record(Cell(plant=Plant(dynamics)), StepTest(), Flat(), stand_off=-49e-6)
    settings = {} if mass is None else {"table_mass_kg": mass}
    return identify(assemble([recording.axes], [recording.distance]), settings=settings).calibration


@pytest.mark.parametrize("collocated", [False, *soaked(True)])
def test_an_identified_machine_is_known_within_its_uncertainty(collocated):
    entry = calibrated(collocated, 10.0).certificate.response.two_mass
    assert entry.collocated is collocated
    # The correct model exceeds this χ² once in a thousand.
    assert stats.chi2.sf(2 * entry.misfit**2, 2) > 1e-3
    assert entry.model["m1"] == 10.0
    assert entry.table_mass_kg == 10.0
    for name in FITTED:
        off = np.log(entry.model[name] / getattr(MACHINE, name))
        assert abs(off) < 4 * entry.relative_uncertainty[name], name


def test_a_response_says_nothing_of_the_scale():
    """Twice the mass is twice of everything, at the same misfit."""
    once = calibrated(False, 10.0)
    arguments = once.dynamics, once.covariance, once.valid_up_to
    first, second = (two_mass_model(*arguments, mass) for mass in (10.0, 20.0))
    for name in FITTED:
        assert second.model[name] == pytest.approx(2 * first.model[name], rel=1e-3)


@pytest.mark.soak
@pytest.mark.parametrize("collocated", [False, True])
def test_without_a_mass_all_is_per_mass_of_the_table(collocated):
    """The truth over m1, within the stated uncertainty, and the fit with a mass over it."""
    entry = calibrated(collocated, None).certificate.response.two_mass
    with_mass = calibrated(collocated, 10.0).certificate.response.two_mass
    assert entry.table_mass_kg is None
    assert entry.model["m1"] == 1.0
    assert entry.collocated is collocated
    assert entry.misfit == pytest.approx(with_mass.misfit, rel=1e-3)
    for name in FITTED:
        ratio, spread = entry.model[name], entry.relative_uncertainty[name]
        off = np.log(ratio * MACHINE.m1 / getattr(MACHINE, name))
        assert abs(off) < 4 * spread, name
        assert ratio == pytest.approx(with_mass.model[name] / 10.0, rel=1e-3 * spread)
        assert spread == pytest.approx(with_mass.relative_uncertainty[name], rel=1e-3)


def test_what_is_not_two_masses_is_not_called_so():
    """Eq. 7 of a second mass has no zeros on the imaginary axis; a driven first mass has."""
    chain = two_mass_response(MACHINE, collocated=False)
    anti_resonance = [1.0, 0.0, (2 * np.pi * 20.0) ** -2]
    odd = TransferFunction(np.array(anti_resonance), chain.denominator)
    covariance = np.diag([0.0, *(1e-3 * np.abs([1e-4, odd.numerator[2], *chain.denominator[1:]]))])
    covariance = np.pad(covariance, (0, 1)) ** 2
    assert two_mass_model(odd, covariance, 150.0, 10.0) is None


def test_one_mode_is_no_pair_of_masses():
    one = TransferFunction.from_ascending([1.0], [1.0, 1e-4, 1e-6])
    assert two_mass_model(one, np.zeros((4, 4)), 100.0, 10.0) is None


@pytest.mark.soak
def test_masses_do_not_explain_a_latency():
    chain = two_mass_response(MACHINE, collocated=False)
    late = TransferFunction(chain.numerator, chain.denominator, 5e-4)
    recording = record(Cell(plant=Plant(late)), StepTest(), Flat(), stand_off=-49e-6)
    found = identify(assemble([recording.axes], [recording.distance])).calibration
    assert found.certificate.verdict != "rejected"
    assert found.certificate.response.two_mass is None


@pytest.mark.soak  # many fits
def test_stated_uncertainty_and_misfit_are_those_of_repeated_fits():
    found = calibrated(False, 10.0)
    lines = np.linspace(found.valid_up_to / 40, found.valid_up_to, 40)
    centre = two_mass_response(MACHINE, collocated=False)
    # The structure that was identified has more zeros than the truth; they are zero there.
    numerator = np.zeros(len(found.dynamics.numerator))
    numerator[: len(centre.numerator)] = centre.numerator
    truth = TransferFunction(numerator, centre.denominator)
    # Small, for the statement is linear: a hundredth of the real uncertainty.
    covariance = 1e-4 * found.noise_covariance
    values, vectors = np.linalg.eigh(covariance)
    root, rng = vectors * np.sqrt(np.maximum(values, 0.0)), np.random.default_rng(4)
    fits = []
    for _ in range(60):
        off = root @ rng.normal(size=len(root))
        drawn = TransferFunction(
            truth.numerator + off[: len(numerator)],
            np.concatenate([[1.0], truth.denominator[1:] + off[len(numerator) : -1]]),
        )
        fits.append(
            fit_two_mass(drawn, covariance, table_mass=10.0, collocated=False, frequencies=lines)
        )
    logs = np.log([[getattr(fit.model, name) for name in FITTED] for fit in fits])
    stated = np.mean([fit.uncertainty for fit in fits], axis=0)
    # The scatter of 60 is known to 9 %: three of its sigmas.
    np.testing.assert_allclose(np.std(logs, axis=0), stated, rtol=0.28)
    # Seven coefficients scatter, five things are fitted: χ² with two degrees of freedom each.
    assert np.count_nonzero(np.diag(covariance)) == 7
    misfit = sum(2 * fit.misfit**2 for fit in fits)
    least, greatest = stats.chi2.ppf([1e-3, 1 - 1e-3], 2 * len(fits))
    assert least < misfit < greatest


@pytest.mark.parametrize("value", [0.0, -3.0, float("nan"), "heavy", True])
def test_a_mass_that_cannot_be_is_refused(value):
    with pytest.raises(ConfigurationError, match="table_mass_kg"):
        table_mass({"table_mass_kg": value})


def test_a_mass_is_read_or_absent():
    assert table_mass({"table_mass_kg": 120}) == 120.0
    assert table_mass({"probe": "any"}) is None
