"""A long step test: chosen on fewer samples, fitted to all, and as true as a short one."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.model_order import coarser
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Problem, fit
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification import model_choice
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.identification.model_choice import choose_model
from omsm_ros.core.identification.residual_tests import follows_beyond
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant

from .recorded_motions import STAND_OFF

OMEGA = 2 * np.pi * 60
MODE = TransferFunction.from_ascending([1.0], [1.0, 0.2 / OMEGA, OMEGA**-2])
LINES = np.array([1.0, 5.0, 15.0, 50.0])


def recorded(truth):
    made = record(
        Cell(plant=Plant(truth), seed=8), StepTest(dwell=2.5), Flat(), stand_off=STAND_OFF
    )
    return assemble([made.axes], [made.distance])


@pytest.fixture(scope="module")
def of_mode():
    return recorded(MODE)


@pytest.mark.soak
def test_fewer_samples_choose_what_all_would(of_mode, monkeypatch):
    prepared = prepare(of_mode, "encoder")
    fewer, every = EvaluationBudget(), EvaluationBudget()
    found = choose_model(prepared, fewer)
    monkeypatch.setattr(model_choice, "decimation", lambda problem: 1)
    asked = choose_model(prepared, every)
    assert 0 < fewer.evaluations < every.evaluations
    assert found.chosen.fit.structure == asked.chosen.fit.structure
    np.testing.assert_allclose(
        found.chosen.fit.dynamics.response(LINES),
        asked.chosen.fit.dynamics.response(LINES),
        rtol=1e-6,
    )
    assert found.chosen.bic == pytest.approx(asked.chosen.bic, abs=0.1)


@pytest.mark.soak
def test_what_is_stated_holds_the_truth(of_mode):
    calibration = identify(of_mode).calibration
    assert calibration.certificate.verdict == "accepted"
    band = response_band(calibration.dynamics, calibration.covariance, LINES)
    off = np.log(calibration.dynamics.response(LINES) / MODE.response(LINES))
    assert np.all(abs(off) < 3 * np.hypot(band.gain, band.phase))


@pytest.mark.soak
def test_a_latency_that_jumps_rejects_a_long_test_too(of_mode):
    half = len(of_mode) // 2
    later = np.where(np.arange(len(of_mode)) < half, of_mode.distance, np.roll(of_mode.distance, 1))
    found = identify(
        record_from_arrays(of_mode.sample_period, of_mode.z, later)
    ).calibration.certificate
    assert found.verdict == "rejected"
    assert "identification.large_residual" in {finding.code for finding in found.reasons}


def driven(truth):
    """A broad motion, and what ``truth`` makes of it in noise, at 1 kHz."""
    rng = np.random.default_rng(5)
    time = np.arange(40_000) * 1e-3
    motion = sum(1e-5 * np.exp(-(((time - c) / 1.5e-3) ** 2)) for c in np.arange(0.4, 39, 0.37))
    frequency = np.fft.rfftfreq(len(motion), 1e-3)
    seen = np.fft.irfft(np.fft.rfft(motion) * truth.response(frequency), len(motion))
    used = np.ones(len(motion), bool)
    background = np.ones((len(motion), 1))
    noisy = seen + rng.normal(0, 1e-8, len(motion))
    return Problem(motion, noisy, used, 1e-3, background, 600.0)


def test_what_fewer_samples_cannot_show_is_seen_in_the_residual():
    """A weakly excited mode at 260 Hz, beyond the 167 Hz that every third sample resolves."""
    omega = 2 * np.pi * 260
    light = TransferFunction.from_ascending(
        [1.0, 0.04 / omega, 0.98 / omega**2], [1.0, 0.04 / omega, omega**-2]
    )
    structure = Structure(2, 2, False)
    start = ScaledStructure(structure, 600.0).nonlinear_of(light.poles() / 600.0, 0.0)
    problem = driven(light)
    coarse = coarser(problem, 3)
    without = fit(problem, Structure(0, 0, True), [np.array([0.0])])
    assert follows_beyond(problem, without, coarse) < 1e-6
    assert follows_beyond(problem, fit(problem, structure, [start]), coarse) > 1e-3


def test_noise_alone_follows_no_motion():
    problem = driven(TransferFunction.from_ascending([1.0], [1.0]))
    coarse = coarser(problem, 3)
    late = fit(problem, Structure(0, 0, True), [np.array([0.0])])
    values = [
        follows_beyond(
            problem,
            replace(late, residual=np.random.default_rng(s).normal(0, 1e-8, len(late.residual))),
            coarse,
        )
        for s in range(40)
    ]
    assert 0.2 < np.mean(values) < 0.8
    assert np.min(values) > 1e-4
