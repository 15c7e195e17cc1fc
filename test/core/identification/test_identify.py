"""Identification against the truth of the twin, and against data that cannot identify."""

import json
from functools import lru_cache

import numpy as np
import pytest
from scipy import signal, stats

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.masses_and_springs import TwoMass
from omsm_ros.core.dynamics.response_band import response_band
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.machine.trajectories import Chirp, StepTest
from omsm_ros.core.samples.motion_record import MotionRecord, assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import (
    ConfigurationError,
    DataError,
    IdentificationError,
    StepTestError,
)
from omsm_ros.twin.cell import Cell, blocks_of, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import Drift, MachineErrors
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

STAND_OFF = -49e-6
STEPS, PLANT = StepTest(), Plant()
TRUTH = PLANT.dynamics


@lru_cache(maxsize=64)
def recorded(seed=1, motion=STEPS, plant=PLANT, sample_period=1e-3, drift=0.0):
    drifting = Disturbances(machine=MachineErrors(drift=Drift(ramp_m_per_s=drift)))
    cell = Cell(plant=plant, seed=seed, sample_period=sample_period, disturbances=drifting)
    return record(cell, motion, Flat(), stand_off=STAND_OFF)


def record_of(recording, **changed):
    seen = np.where(recording.distance.ok, recording.distance.distance, np.nan)
    arrays = {"z": recording.axes.z, "distance": seen, **changed}
    return MotionRecord.from_arrays(recording.axes.sample_period, **arrays)


@lru_cache(maxsize=64)
def identified(seed=1):
    recording = recorded(seed)
    return identify(assemble([recording.axes], [recording.distance])).calibration


def from_noise(calibration: Calibration):
    """Covariance of the coefficients from noise alone, without what could hide."""
    size = len(calibration.covariance)
    return np.reshape(calibration.certificate["noise_covariance"], (size, size))


def errors(calibration: Calibration, truth: TransferFunction, frequency):
    """Relative gain [1] and phase [rad] over the truth."""
    ratio = np.log(calibration.dynamics.response(frequency) / truth.response(frequency))
    return ratio.real, ratio.imag


class TestStepTest:
    @pytest.mark.parametrize("seed", range(1, 7))
    def test_response_is_known_to_20_ppm_and_2_mdeg_where_scans_move(self, seed):
        gain, phase = errors(identified(seed), TRUTH, np.array([0.5, 1.0, 1.5]))
        assert np.max(np.abs(gain)) < 20e-6
        assert np.max(np.abs(np.degrees(phase))) < 2e-3

    @pytest.mark.parametrize("seed", range(1, 7))
    def test_phase_at_15_hz_is_known_to_20_mdeg(self, seed):
        _, phase = errors(identified(seed), TRUTH, np.array([15.0]))
        assert abs(np.degrees(phase[0])) < 0.02

    def test_static_gain_is_known_to_1e_5_and_says_so(self):
        calibration = identified()
        error = abs(calibration.static_gain / PAPER_STATIC_GAIN - 1)
        stated = calibration.certificate["static_gain_uncertainty"]
        assert error < 1.5e-5
        assert error < 4 * stated < 4e-5

    def test_errors_lie_within_four_stated_sigmas(self):
        frequency = np.array([1.0, 5.0, 15.0, 50.0])
        for seed in range(1, 7):
            calibration = identified(seed)
            band = response_band(calibration.dynamics, calibration.covariance, frequency)
            gain, phase = errors(calibration, TRUTH, frequency)
            assert np.all(np.abs(gain) < 4 * band.gain)
            assert np.all(np.abs(phase) < 4 * band.phase)

    @pytest.mark.parametrize(("part", "hertz"), [("gain", 1.0), ("phase", 1.0), ("phase", 50.0)])
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
        assert json.loads(json.dumps(dict(certificate), allow_nan=False)) == certificate
        assert str(certificate["verdict"]).startswith("accepted")
        assert certificate["reasons"] == []
        assert certificate["edges"] == 20

    def test_trust_ends_below_nyquist_and_above_the_scan(self):
        assert 30 < identified().valid_up_to < 500

    def test_low_frequency_delay_is_the_papers(self):
        certificate = identified().certificate
        sigma = identified().low_frequency_delay_noise
        assert 0.2e-6 < sigma < 3e-6
        assert abs(certificate["low_frequency_delay_s"] - 339.7e-6) < 4 * sigma
        # What could hide comes on top.
        assert sigma < certificate["low_frequency_delay_uncertainty_s"] < 3 * sigma

    def test_a_candidate_names_its_scores(self):
        candidates = identified().certificate["candidates"]
        assert all(np.isfinite(c["bic"]) for c in candidates)

    def test_blocks_cut_anywhere_give_the_same(self):
        parts = blocks_of(recorded(), 137)
        cut = identify(assemble([a for a, _ in parts], [d for _, d in parts][::-1])).calibration
        assert cut.content() == identified().content()

    def test_settings_are_kept(self):
        calibration = identify(record_of(recorded()), settings={"exposure_s": 1e-4}).calibration
        assert calibration.settings == {"exposure_s": 1e-4}


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
        gains = calibration.certificate["static_gains"]
        assert gains["reference_per_encoder"]["value"] == pytest.approx(1.0, abs=1e-5)
        assert gains["probe_per_reference"]["value"] == pytest.approx(PAPER_STATIC_GAIN, abs=5e-5)


def resonance(frequency, damping):
    omega = 2 * np.pi * frequency
    return TransferFunction.from_ascending([1.0], [1.0, 2 * damping / omega, omega**-2])


TWO_MASS = TwoMass(m1=10.0, m2=2.0, k1=8e6, k2=4e5 * 4, c1=900.0, c2=60.0)


class TestOtherPlants:
    def band_holds(self, truth, frequency, sigmas=4.0):
        calibration = identify(record_of(recorded(plant=Plant(truth)))).calibration
        band = response_band(calibration.dynamics, calibration.covariance, frequency)
        gain, phase = errors(calibration, truth, frequency)
        assert np.all(np.abs(gain) < sigmas * band.gain + 1e-9)
        assert np.all(np.abs(phase) < sigmas * band.phase + 1e-9)
        return calibration

    def test_a_lone_light_mode(self):
        calibration = self.band_holds(resonance(60.0, 0.02), np.array([1.0, 15.0, 55.0]))
        (mode, *_) = calibration.dynamics.modes()
        assert mode.frequency == pytest.approx(60.0, rel=1e-4)
        assert mode.damping == pytest.approx(0.02, rel=1e-2)

    def test_a_pure_delay(self):
        truth = TransferFunction([1.0], [1.0], 0.7e-3)
        calibration = self.band_holds(truth, np.array([1.0, 15.0]))
        assert calibration.dynamics.low_frequency_delay == pytest.approx(0.7e-3, abs=5e-6)

    @pytest.mark.parametrize("collocated", [False, True])
    def test_two_masses(self, collocated):
        truth = TWO_MASS.collocated() if collocated else TWO_MASS.non_collocated()
        calibration = self.band_holds(truth, np.array([1.0, 15.0, 50.0]))
        found = [m.frequency for m in calibration.dynamics.modes()][:2]
        expected = [m.frequency for m in truth.modes()]
        np.testing.assert_allclose(found, expected, rtol=0.02)

    def test_the_pole_pair_of_eq_12_at_10_khz(self):
        motion = StepTest(rise=0.0, dwell=0.1, count=5)
        calibration = identify(record_of(recorded(motion=motion, sample_period=1e-4))).calibration
        pair = next(m for m in calibration.dynamics.modes() if m.damping < 0.9)
        assert pair.frequency == pytest.approx(804.0, rel=0.01)
        assert pair.damping == pytest.approx(0.19, rel=0.05)

    def test_a_higher_order_than_the_true_one_does_no_harm(self):
        truth = TransferFunction.from_ascending([1.0], [1.0, 3e-3])
        calibration = identify(record_of(recorded(plant=Plant(truth))), order=3).calibration
        gain, phase = errors(calibration, truth, np.array([1.0, 15.0]))
        assert np.max(np.abs(gain)) < 5e-4
        assert np.max(np.abs(np.degrees(phase))) < 0.05

    def test_a_lower_order_than_the_true_one_is_rejected(self):
        truth = resonance(60.0, 0.02)
        calibration = identify(record_of(recorded(plant=Plant(truth))), order=1).calibration
        assert calibration.certificate["verdict"] == "rejected"
        assert "misses something" in calibration.certificate["reasons"][0]


class TestImperfectData:
    def test_dropouts_drift_spikes_and_coloured_noise(self):
        recording = recorded(seed=11, drift=100e-9 / 60)
        rng = np.random.default_rng(2)
        n = len(recording.axes)
        coloured = signal.lfilter([1.0], [1.0, -0.8], rng.normal(0, 5e-9, n))
        distance = recording.distance.distance + coloured
        distance[rng.random(n) < 0.05] = np.nan
        spiked = np.arange(997, n, 997)
        distance[spiked] += 2e-6
        # Whether one stands apart from both neighbours can only be said where there are two.
        whole = sum(np.all(np.isfinite(distance[k - 1 : k + 2])) for k in spiked)
        calibration = identify(record_of(recording, distance=distance)).calibration
        frequency = np.array([1.0, 15.0])
        band = response_band(calibration.dynamics, calibration.covariance, frequency)
        gain, phase = errors(calibration, TRUTH, frequency)
        assert np.all(np.abs(gain) < 4 * band.gain)
        assert np.all(np.abs(phase) < 4 * band.phase)
        assert calibration.certificate["samples"]["spikes"] == whole == 7
        assert calibration.certificate["drift_m_s"] == pytest.approx(
            PAPER_STATIC_GAIN * 100e-9 / 60, rel=0.5
        )

    def test_coloured_noise_widens_the_band(self):
        recording = recorded(seed=12)
        noise = np.random.default_rng(3).normal(0, 5e-9, len(recording.axes))
        wide, narrow = (
            identify(record_of(recording, distance=recording.distance.distance + extra)).calibration
            for extra in (signal.lfilter([1.0], [1.0, -0.9], noise), noise)
        )
        key = "low_frequency_delay_uncertainty_s"
        assert wide.certificate[key] > 1.5 * narrow.certificate[key]

    def test_backlash_is_found_and_stated(self):
        recording = recorded(seed=13)
        z = recording.axes.z
        position, played = z[0], np.empty(len(z))
        for k, value in enumerate(z):
            position = np.clip(position, value - 20e-9, value + 20e-9)
            played[k] = value - position
        distance = recording.distance.distance + PAPER_STATIC_GAIN * played
        calibration = identify(record_of(recording, distance=distance)).calibration
        assert calibration.certificate["backlash_m"] == pytest.approx(40e-9, rel=0.2)
        assert calibration.static_gain == pytest.approx(PAPER_STATIC_GAIN, abs=1e-4)

    def test_sharp_edges_are_rejected_by_name_and_the_band_holds_the_truth(self):
        calibration = identify(record_of(recorded(motion=StepTest(rise=0.0)))).calibration
        assert calibration.certificate["verdict"] == "rejected"
        assert "between samples" in " ".join(calibration.certificate["reasons"])
        frequency = np.array([0.5, 1.0, 5.0, 15.0])
        band = response_band(calibration.dynamics, calibration.covariance, frequency)
        gain, phase = errors(calibration, TRUTH, frequency)
        assert np.all(np.abs(phase) < 1.96 * band.phase)
        assert np.all(np.abs(gain) < 1.96 * band.gain)

    def test_a_probe_mounted_the_other_way_is_told_by_its_polarity(self):
        recording = recorded()
        turned = identify(record_of(recording, distance=-recording.distance.distance)).calibration
        assert turned.certificate["polarity"] == -1
        assert identified().certificate["polarity"] == 1
        np.testing.assert_allclose(
            turned.dynamics.denominator, identified().dynamics.denominator, rtol=1e-6
        )

    def test_gaps_of_the_encoder_do_no_harm(self):
        recording = recorded()
        z = recording.axes.z.copy()
        z[1000:1030] = np.nan
        z[3000:3300] = np.nan
        calibration = identify(record_of(recording, z=z)).calibration
        assert str(calibration.certificate["verdict"]).startswith("accepted")
        assert calibration.certificate["samples"]["missing_axis"] == 330
        _, phase = errors(calibration, TRUTH, np.array([1.0]))
        assert abs(np.degrees(phase[0])) < 2e-3

    @pytest.mark.parametrize("start", [505, 530, 560])
    def test_a_record_that_starts_while_a_light_mode_rings_identifies_as_well(self, start):
        """The first edge is at 500: the axis is at rest or nearly so, the mode is not."""
        truth, frequency = resonance(60.0, 0.02), np.array([1.0, 15.0, 40.0])
        recording = recorded(plant=Plant(truth))
        seen = np.where(recording.distance.ok, recording.distance.distance, np.nan)
        late = MotionRecord.from_arrays(1e-3, recording.axes.z[start:], seen[start:])
        calibration = identify(late).calibration
        assert str(calibration.certificate["verdict"]).startswith("accepted")
        band = response_band(calibration.dynamics, calibration.covariance, frequency)
        gain, phase = errors(calibration, truth, frequency)
        assert np.all(np.abs(gain) < 3 * band.gain)
        assert np.all(np.abs(phase) < 3 * band.phase)
        # To know no more than the whole record is fair, to know much less is not.
        whole = identify(record_of(recording)).calibration
        whole_band = response_band(whole.dynamics, whole.covariance, frequency)
        assert np.all(band.phase < 1.5 * whole_band.phase)

    def test_half_the_range_lost_still_identifies(self):
        recording = recorded()
        lost = np.abs(recording.distance.distance) > 30e-6
        distance = np.where(lost, np.nan, recording.distance.distance)
        calibration = identify(record_of(recording, distance=distance)).calibration
        _, phase = errors(calibration, TRUTH, np.array([1.0]))
        assert abs(np.degrees(phase[0])) < 4e-3


class TestRefusals:
    def arrays(self):
        return recorded().axes.z, recorded().distance.distance

    def refuse(self, error, match, z, distance, **options):
        with pytest.raises(error, match=match):
            identify(MotionRecord.from_arrays(1e-3, z, distance), **options)

    def test_two_samples(self):
        z, distance = self.arrays()
        self.refuse(StepTestError, "too few", z[:2], distance[:2])

    def test_an_axis_at_rest(self):
        z, distance = self.arrays()
        self.refuse(StepTestError, "no steps", z[:450], distance[:450])

    def test_constant_data(self):
        self.refuse(StepTestError, "no steps", np.zeros(5000), np.zeros(5000))

    def test_nothing_but_nan(self):
        z, _ = self.arrays()
        self.refuse(StepTestError, "0 of 10500 samples are usable", z, np.full(len(z), np.nan))
        self.refuse(StepTestError, "0 of 10500 samples are usable", np.full(len(z), np.nan), z)

    def test_micrometres_for_metres(self):
        z, distance = self.arrays()
        self.refuse(StepTestError, "metres", z * 1e6, distance * 1e6)
        self.refuse(IdentificationError, "metres", z, distance * 1e6)
        self.refuse(StepTestError, "metres", z * 1e6, distance)

    def test_a_probe_that_does_not_follow(self):
        z, _ = self.arrays()
        still = np.random.default_rng(1).normal(0, 1e-8, len(z))
        self.refuse(IdentificationError, "expected about 1", z, still)
        self.refuse(IdentificationError, "expected about 1", z, np.zeros(len(z)))

    @pytest.mark.parametrize("limit", [20e-6, 40e-6, 46e-6])
    def test_a_clipped_probe(self, limit):
        z, distance = self.arrays()
        self.refuse(IdentificationError, "clipped", z, np.clip(distance, -limit, limit))

    def test_an_unknown_input(self):
        z, distance = self.arrays()
        self.refuse(ConfigurationError, "expected 'encoder'", z, distance, input="capacitive")

    def test_an_absent_reference(self):
        z, distance = self.arrays()
        self.refuse(DataError, "no reading of a reference", z, distance, input="reference")
