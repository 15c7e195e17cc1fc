"""Lines in noise of known size: bounds in closed form, and signals that are no line."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal as scipy_signal

from omsm_ros.core.ripple.density import significance
from omsm_ros.core.ripple.lines import LEAST_SIGMA, MOST_TOGETHER, find_lines, further_lines
from omsm_ros.core.ripple.scan_signal import PATH, TIME, TURN, ScanSignal
from omsm_ros.core.ripple.spectral_line import SpectralLine, sum_of

NM = 1e-9
COUNT, RATE = 6000, 1000.0
SECONDS = np.arange(COUNT) / RATE


def still(sample=None):
    sample = np.arange(COUNT) if sample is None else sample
    zero = np.zeros(len(sample))
    return ScanSignal(
        name="A", period=1 / RATE, sample=sample, height=zero, path=zero, radius=zero, turn=zero
    )


def circle(turns_a_second=2.0, radius=5e-3):
    turn = turns_a_second * SECONDS
    at = np.full(COUNT, radius)
    return replace(still(), path=2 * np.pi * radius * turn, radius=at, turn=turn)


def noise(size=1 * NM, seed=1, count=COUNT):
    return np.random.default_rng(seed).normal(0, size, count)


def sine(frequency, amplitude, phase=0.7, over=SECONDS):
    return amplitude * np.sin(2 * np.pi * frequency * over + phase)


class TestBounds:
    @pytest.fixture(scope="class")
    @staticmethod
    def found():
        values = noise() + sum(sine(f, a * NM) for f, a in ((50.3, 4), (222.2, 1), (400.1, 0.3)))
        return find_lines(still(), values), values

    def test_the_strongest_comes_first_each_at_its_place_and_of_its_size(self, found):
        lines = found[0].lines
        assert [round(line.frequency, 1) for line in lines] == [50.3, 222.2, 400.1]
        for line, size in zip(lines, (4 * NM, 1 * NM, 0.3 * NM), strict=True):
            assert abs(line.amplitude - size) < 4 * line.amplitude_uncertainty
            assert line.possible == {TIME: line.frequency}

    def test_uncertainties_are_the_bounds_of_cramer_and_rao(self, found):
        assert found[0].lines
        for line in found[0].lines:
            sigma = 1 * NM * np.sqrt(2 / COUNT)
            assert line.amplitude_uncertainty == pytest.approx(sigma, rel=0.15, abs=0)
            bound = np.sqrt(6 / COUNT) * 1 * NM / line.amplitude / np.pi / SECONDS[-1]
            assert line.frequency_uncertainty == pytest.approx(bound, rel=0.15)

    def test_significance_is_that_of_the_power_over_the_noise_among_all_frequencies(self, found):
        assert found[0].lines
        for line in found[0].lines:
            ratio = line.amplitude**2 / (2 * line.amplitude_uncertainty**2)
            expected = float(significance(np.array(ratio), COUNT / 2))
            assert line.significance == pytest.approx(expected, rel=0.01)
            assert line.significance > LEAST_SIGMA

    def test_lines_and_what_is_left_are_all_there_was(self, found):
        spectrum, values = found
        lines = sum_of(spectrum.lines, spectrum.coordinates, COUNT)
        np.testing.assert_allclose(lines + spectrum.residual, values, atol=1e-6 * NM)
        assert spectrum.noise == pytest.approx(1 * NM, rel=0.05)
        expected = 1 * NM * np.sqrt(2 / COUNT)
        assert spectrum.sigma_at(300.0) == pytest.approx(expected, rel=0.2, abs=0)

    def test_a_periodogram_of_what_is_left_has_no_line(self, found):
        _, power = scipy_signal.periodogram(found[0].residual, RATE)
        assert np.max(power) < 20 * np.mean(power)

    def test_units_make_no_difference(self, found):
        spectrum, values = found
        other = find_lines(still(), 1e9 * values)
        assert spectrum.lines
        for one, same in zip(spectrum.lines, other.lines, strict=True):
            assert same.frequency == pytest.approx(one.frequency, rel=1e-9)
            assert same.amplitude == pytest.approx(1e9 * one.amplitude, rel=1e-6)
            assert same.significance == pytest.approx(one.significance, rel=1e-6)


class TestWhatIsNone:
    def test_noise_alone_has_hardly_ever_one(self):
        found = [len(find_lines(still(), noise(seed=seed)).lines) for seed in range(12)]
        assert sum(found) <= 1

    def test_what_has_fewer_than_five_waves_is_form_or_drift(self):
        for frequency, there in ((4.2 / 6, 0), (7.3 / 6, 1)):
            found = find_lines(still(), noise() + sine(frequency, 5 * NM)).lines
            assert sum(abs(line.frequency - frequency) < 0.05 for line in found) == there

    def test_waves_a_turn_that_belong_to_the_form_are_no_lines(self):
        values = noise() + sine(6.0, 9 * NM) + sine(61.0, 4 * NM)
        # Leakage of a strong order beyond that width would be found as lines.
        taken = find_lines(circle(), values, reserved_orders=[(3.0, 1.6)]).lines
        assert [round(line.frequency) for line in taken] == [61]
        free = find_lines(circle(), values).lines
        assert sorted(round(line.frequency) for line in free) == [6, 61]

    def test_of_many_lines_none_is_missing_and_none_is_found_twice(self):
        """Sixty lines, more than are fitted together, each with its own amplitude and phase."""
        frequencies = 7.9 * np.arange(1, 61)
        sizes = np.random.default_rng(5).permutation(np.linspace(1, 7, 60)) * NM
        values = noise(0.1 * NM) + sum(map(sine, frequencies, sizes, frequencies))
        first = find_lines(still(), values)
        assert len(first.lines) == MOST_TOGETHER
        found = further_lines(still(), first).lines
        assert len(found) == 60
        for line, (frequency, size) in zip(
            sorted(found, key=lambda one: one.frequency), zip(frequencies, sizes, strict=True),
            strict=True,
        ):  # fmt: skip
            assert abs(line.frequency - frequency) < 0.02
            assert line.amplitude == pytest.approx(size, rel=0.03, abs=0)


class TestKnown:
    def test_a_line_that_was_known_is_found_no_second_time(self):
        values = noise() + sine(123.4, 3 * NM)
        known = [SpectralLine(coordinate=TIME, frequency=123.37, cosine=0.0, sine=0.0)]
        (line,) = find_lines(still(), values, known).lines
        assert line.frequency == pytest.approx(123.4, abs=4 * line.frequency_uncertainty)

    def test_an_absent_one_is_not_reported(self):
        known = [SpectralLine(coordinate=TIME, frequency=200.0, cosine=9 * NM, sine=0.0)]
        assert find_lines(still(), noise(), known).lines == ()

    def test_missing_samples_cost_their_share(self):
        kept = np.flatnonzero(np.random.default_rng(3).uniform(size=COUNT) > 0.4)
        kept = np.r_[0, kept[kept > 0]]
        values = (noise() + sine(123.4, 3 * NM))[kept]
        (line,) = find_lines(still(kept), values).lines
        assert line.amplitude == pytest.approx(3 * NM, abs=4 * line.amplitude_uncertainty)
        expected = 1 * NM * np.sqrt(2 / len(kept))
        assert line.amplitude_uncertainty == pytest.approx(expected, rel=0.15, abs=0)


class TestWhere:
    def test_at_an_even_pace_it_may_be_in_any_coordinate_at_their_paces(self):
        (line,) = find_lines(circle(), noise() + sine(61.0, 4 * NM)).lines
        assert set(line.possible) == {TIME, PATH, TURN}
        assert line.possible[TURN] == pytest.approx(30.5, rel=1e-3)
        assert line.possible[PATH] == pytest.approx(30.5 / (np.pi * 10e-3), rel=1e-3)

    def test_a_wave_of_a_spindle_that_changes_its_speed_is_distinguished_from_one_in_time(self):
        turn = 2.0 * SECONDS + 0.05 * SECONDS**2
        signal = replace(circle(), turn=turn, path=2 * np.pi * 5e-3 * turn)
        values = noise() + sine(20.0, 4 * NM, over=turn) + sine(170.0, 3 * NM)
        spindle, shaking = find_lines(signal, values).lines
        assert TIME not in spindle.possible
        assert spindle.possible[TURN] == pytest.approx(20.0, rel=1e-3)
        assert set(shaking.possible) == {TIME}
