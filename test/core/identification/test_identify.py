"""Identification against the truth of the twin, and against data that cannot identify."""

import json
import pickle

import numpy as np
import pytest
from scipy import stats
from soaked import soaked

from benchmarks.identification import record_once
from benchmarks.recorded import two_mass_response
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED, Certificate
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.lti.modes import TwoMass, known_modes
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.twin.cell import Cell, blocks_of, record
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

from .recorded_motions import TRUTH, errors, from_noise, identified, record_of, recorded, resonance


def test_an_identification_with_its_settings_can_be_sent_to_another_process():
    found = identify(record_of(recorded()), settings={"exposure_s": 1e-4})
    assert found.calibration.settings == {"exposure_s": 1e-4}
    received = pickle.loads(pickle.dumps(found))
    assert received.calibration.id == found.calibration.id
    assert received.fit.rms == found.fit.rms


class TestStepTest:
    @pytest.mark.parametrize("seed", [1, *soaked(*range(2, 7))])
    def test_response_is_known_to_20_ppm_and_2_mdeg_where_scans_move(self, seed):
        gain, phase = errors(identified(seed), TRUTH, np.array([0.5, 1.0, 1.5]))
        assert np.max(np.abs(gain)) < 20e-6
        assert np.max(np.abs(np.degrees(phase))) < 2e-3

    @pytest.mark.parametrize("seed", [1, *soaked(*range(2, 7))])
    def test_phase_at_15_hz_is_known_to_20_mdeg(self, seed):
        _, phase = errors(identified(seed), TRUTH, np.array([15.0]))
        assert abs(np.degrees(phase[0])) < 0.02

    def test_static_gain_is_known_to_1e_5_and_says_so(self):
        calibration = identified()
        error = abs(calibration.static_gain / PAPER_STATIC_GAIN - 1)
        stated = calibration.certificate.static_gain.uncertainty
        assert error < 1.5e-5
        assert error < 4 * stated < 4e-5

    @pytest.mark.parametrize("seed", [1, *soaked(*range(2, 7))])
    def test_errors_lie_within_four_stated_sigmas(self, seed):
        frequency = np.array([1.0, 5.0, 15.0, 50.0])
        calibration = identified(seed)
        band = response_band(calibration.dynamics, calibration.covariance, frequency)
        gain, phase = errors(calibration, TRUTH, frequency)
        assert np.all(np.abs(gain) < 4 * band.gain)
        assert np.all(np.abs(phase) < 4 * band.phase)

    @pytest.mark.parametrize(("part", "hertz"), [("gain", 1.0), ("phase", 1.0), ("phase", 50.0)])
    @pytest.mark.soak
    def test_stated_sigmas_are_the_scatter(self, part, hertz):
        """Squared errors over stated add up to χ²; a band three times too wide gives 1.3, not 12.

        One run in a thousand may leave either way: 2.2 to 32.9.
        """
        total, seeds, frequency = 0.0, range(1, 13), np.array([hertz])
        for seed in seeds:
            calibration = identified(seed)
            band = response_band(calibration.dynamics, from_noise(calibration), frequency)
            error = dict(zip(("gain", "phase"), errors(calibration, TRUTH, frequency), strict=True))
            total += float((error[part] / getattr(band, part))[0] ** 2)
        least, greatest = stats.chi2.ppf([1e-3, 1 - 1e-3], len(seeds))
        assert least < total < greatest

    def test_dc_gain_is_one_and_the_covariance_leaves_it_fixed(self):
        calibration = identified()
        assert calibration.dynamics.dc_gain == 1.0
        assert np.all(from_noise(calibration)[0] == 0)
        assert np.all(np.linalg.eigvalsh(calibration.covariance) > -1e-20)

    def test_certificate_is_json_and_accepts(self):
        certificate = identified().certificate
        text = json.dumps(certificate.content(), allow_nan=False)
        assert Certificate.from_content(json.loads(text)) == certificate
        assert str(certificate.verdict).startswith("accepted")
        assert certificate.reasons == ()
        assert certificate.residual.edges == 20

    def test_trust_ends_below_nyquist_and_above_the_scan(self):
        assert 30 < identified().valid_up_to < 500

    def test_low_frequency_delay_is_the_papers(self):
        certificate = identified().certificate
        sigma = identified().low_frequency_delay_noise
        assert 0.2e-6 < sigma < 3e-6
        assert abs(certificate.response.low_frequency_delay_s - 339.7e-6) < 4 * sigma
        # The uncertainty of undetected model errors is added.
        assert sigma < certificate.response.low_frequency_delay_uncertainty_s < 3 * sigma

    def test_a_candidate_names_its_scores(self):
        candidates = identified().certificate.candidates
        assert len(candidates) > 1
        assert all(np.isfinite(c.bic) for c in candidates)

    def test_blocks_cut_anywhere_give_the_same(self):
        parts = blocks_of(recorded(), 137)
        cut = identify(assemble([a for a, _ in parts], [d for _, d in parts][::-1])).calibration
        assert cut.content() == identified().content()


class TestOtherMotions:
    def test_a_chirp_identifies_as_well_as_steps(self):
        recording = record(Cell(seed=4), Chirp(), Flat())
        calibration = identify(record_of(recording)).calibration
        gain, phase = errors(calibration, TRUTH, np.array([1.0, 5.0]))
        assert np.max(np.abs(gain)) < 30e-6
        assert np.max(np.abs(np.degrees(phase))) < 5e-3

    def test_a_forced_order_is_kept(self):
        calibration = identify(record_of(recorded()), order=3).calibration
        assert len(calibration.dynamics.denominator) == 4

    def test_the_reference_sensor_can_be_the_motion(self):
        recording = recorded()
        reference = recording.axes.z + np.random.default_rng(1).normal(0, 1e-9, len(recording.axes))
        calibration = identify(
            record_of(recording, reference=reference), input="reference"
        ).calibration
        gain, phase = errors(calibration, TRUTH, np.array([1.0]))
        assert abs(gain[0]) < 20e-6
        assert abs(np.degrees(phase[0])) < 2e-3
        gains = calibration.certificate.static_gain
        assert gains.reference_per_encoder.value == pytest.approx(1.0, abs=1e-5)
        assert gains.probe_per_reference.value == pytest.approx(PAPER_STATIC_GAIN, abs=5e-5)


TWO_MASS = TwoMass(m1=10.0, m2=2.0, k1=8e6, k2=4e5 * 4, c1=900.0, c2=60.0)


class TestOtherPlants:
    def band_holds(self, truth, frequency, sigmas=4.0):
        calibration = identify(record_of(recorded(plant=Plant(truth)))).calibration
        band = response_band(calibration.dynamics, calibration.covariance, frequency)
        gain, phase = errors(calibration, truth, frequency)
        assert np.all(np.abs(gain) < sigmas * band.gain + 1e-9)
        assert np.all(np.abs(phase) < sigmas * band.phase + 1e-9)
        return calibration

    @pytest.mark.soak
    def test_a_lone_light_mode(self):
        calibration = self.band_holds(resonance(60.0, 0.02), np.array([1.0, 15.0, 55.0]))
        (mode, *_) = known_modes(calibration.dynamics)
        assert mode.frequency == pytest.approx(60.0, rel=1e-4)
        assert mode.damping == pytest.approx(0.02, rel=1e-2)

    def test_a_pure_delay(self):
        truth = TransferFunction([1.0], [1.0], 0.7e-3)
        calibration = self.band_holds(truth, np.array([1.0, 15.0]))
        assert calibration.dynamics.low_frequency_delay == pytest.approx(0.7e-3, abs=5e-6)

    @pytest.mark.parametrize("collocated", [True, *soaked(False)])
    def test_two_masses(self, collocated):
        truth = two_mass_response(TWO_MASS, collocated=collocated)
        calibration = self.band_holds(truth, np.array([1.0, 15.0, 50.0]))
        found = [m.frequency for m in known_modes(calibration.dynamics)][:2]
        expected = [m.frequency for m in known_modes(truth)]
        np.testing.assert_allclose(found, expected, rtol=0.02)

    @pytest.mark.soak
    def test_the_pole_pair_of_eq_12_at_10_khz(self):
        motion = StepTest(rise=0.0, dwell=0.1, count=5)
        calibration = identify(record_of(recorded(motion=motion, sample_period=1e-4))).calibration
        pair = next(m for m in known_modes(calibration.dynamics) if m.damping < 0.9)
        assert pair.frequency == pytest.approx(804.0, rel=0.01)
        assert pair.damping == pytest.approx(0.19, rel=0.05)

    @pytest.mark.soak
    def test_a_higher_order_than_the_true_one_does_no_harm(self):
        truth = TransferFunction.from_ascending([1.0], [1.0, 3e-3])
        calibration = identify(record_of(recorded(plant=Plant(truth))), order=3).calibration
        gain, phase = errors(calibration, truth, np.array([1.0, 15.0]))
        assert np.max(np.abs(gain)) < 5e-4
        assert np.max(np.abs(np.degrees(phase))) < 0.05

    @pytest.mark.soak
    def test_a_lower_order_than_the_true_one_is_rejected(self):
        truth = resonance(60.0, 0.02)
        calibration = identify(record_of(recorded(plant=Plant(truth))), order=1).calibration
        assert calibration.certificate.verdict == "rejected"
        assert "misses something" in str(calibration.certificate.reasons[0])


@pytest.mark.parametrize("order", [6, *soaked(3, 4, 5, 8, 12)])
def test_an_accepted_order_can_be_read_back(order):
    """More poles than the motion determines are still poles that a filter can have."""
    calibration = identify(record_once(1, plant=Plant()), order=order).calibration
    if calibration.certificate.verdict != REJECTED:
        read = Calibration.from_content(calibration.content()).dynamics
        np.testing.assert_array_equal(read.denominator, calibration.dynamics.denominator)
