"""Lines fitted at once, against linear least squares at the true frequencies and scipy's search."""

import numpy as np
import pytest
from scipy import optimize

from omsm_ros.core.ripple.coordinates import Coordinate
from omsm_ros.core.ripple.scan_signal import PATH, TIME, TURN, ScanSignal
from omsm_ros.core.ripple.spectral_line import (
    CLOSEST,
    SpectralLine,
    fitted,
    start,
    sum_of,
    texture,
    waves_of,
)

NM = 1e-9
COUNT, PERIOD = 4000, 1e-3
SECONDS = np.arange(COUNT) * PERIOD
# A pace that doubles over the scan.
METRES = 0.02 * (SECONDS + 0.125 * SECONDS**2)
COORDINATES = {
    TIME: Coordinate(TIME, SECONDS, 1.0, TIME, 500.0),
    PATH: Coordinate(PATH, METRES, 0.03, PATH, 20e3),
}
RESOLUTION = COORDINATES[TIME].resolution


def wave(over, frequency, cosine, sine):
    phase = 2 * np.pi * frequency * over
    return cosine * np.cos(phase) + sine * np.sin(phase)


def line(coordinate, frequency, cosine=0.0, sine=0.0):
    return SpectralLine(coordinate=coordinate, frequency=frequency, cosine=cosine, sine=sine)


def at_start(lines, values):
    return [start(COORDINATES[name], frequency, values) for name, frequency in lines]


class TestStart:
    def test_of_whole_waves_it_is_the_line_itself(self):
        values = wave(SECONDS, 12.0, 3 * NM, -4 * NM)
        found = start(COORDINATES[TIME], 12.0, values)
        assert (found.coordinate, found.frequency) == (TIME, 12.0)
        assert (found.cosine, found.sine) == (pytest.approx(3 * NM), pytest.approx(-4 * NM))
        assert found.amplitude == pytest.approx(5 * NM)

    def test_another_whole_number_of_waves_is_not_in_it(self):
        values = wave(SECONDS, 12.0, 3 * NM, -4 * NM)
        assert start(COORDINATES[TIME], 12.5, values).amplitude < 1e-6 * NM


class TestFit:
    @pytest.mark.parametrize("coordinate", [TIME, PATH])
    @pytest.mark.parametrize("off", [-0.25, 0.1, 0.25])
    def test_a_line_alone_is_found_from_a_quarter_of_a_resolution_off(self, coordinate, off):
        own = COORDINATES[coordinate]
        frequency = 37.3 / np.ptp(own.values)
        values = wave(own.values, frequency, 3 * NM, -4 * NM)
        begin = at_start([(coordinate, frequency + off * own.resolution)], values)
        (found,) = fitted(begin, COORDINATES, values)
        assert found.frequency == pytest.approx(frequency, abs=1e-6 * own.resolution)
        assert found.cosine == pytest.approx(3 * NM, rel=1e-5)
        assert found.sine == pytest.approx(-4 * NM, rel=1e-5)

    def test_lines_of_several_coordinates_are_fitted_jointly(self):
        true = [
            (TIME, 40.1, 5 * NM, 1 * NM),
            (TIME, 40.1 + 1.2 * RESOLUTION, -2 * NM, 3 * NM),
            (PATH, 1500.0, 4 * NM, 0.0),
        ]
        values = sum(wave(COORDINATES[name].values, f, a, b) for name, f, a, b in true)
        off = {TIME: 0.15 * RESOLUTION, PATH: 0.15 * COORDINATES[PATH].resolution}
        begin = at_start([(name, f + off[name]) for name, f, _, _ in true], values)
        found = sorted(fitted(begin, COORDINATES, values), key=lambda one: one.frequency)
        for one, (name, frequency, cosine, sine) in zip(found, true, strict=True):
            assert one.coordinate == name
            assert one.frequency == pytest.approx(
                frequency, abs=1e-3 * COORDINATES[name].resolution
            )
            assert one.cosine == pytest.approx(cosine, abs=0.02 * NM)
            assert one.sine == pytest.approx(sine, abs=0.02 * NM)
        left = values - sum_of(found, COORDINATES, COUNT)
        assert np.std(left) < 1e-2 * NM

    def test_in_noise_it_is_the_least_squares_of_scipys_search(self):
        rng = np.random.default_rng(4)
        values = wave(SECONDS, 77.7, 2 * NM, 1 * NM) + rng.normal(0, 3 * NM, COUNT)
        (found,) = fitted(at_start([(TIME, 77.75)], values), COORDINATES, values)

        def left(p):
            return (wave(SECONDS, 77.7 + p[0] * RESOLUTION, p[1], p[2]) * NM - values) / NM

        best = optimize.least_squares(left, [0.0, 1.0, 1.0], xtol=1e-14, ftol=1e-14).x
        assert found.frequency == pytest.approx(77.7 + best[0] * RESOLUTION, abs=2e-4 * RESOLUTION)
        assert (found.cosine / NM, found.sine / NM) == pytest.approx((best[1], best[2]), abs=2e-3)

    def test_at_fixed_frequencies_amplitudes_are_linear_least_squares(self):
        """The last step moves no frequency: cosines and sines are then those of lstsq."""
        rng = np.random.default_rng(5)
        values = rng.normal(0, NM, COUNT) + wave(SECONDS, 20.0, 5 * NM, 0.0)
        found = fitted(at_start([(TIME, 20.02), (TIME, 61.0)], values), COORDINATES, values)
        assert len(found) == 2
        columns = waves_of(found, COORDINATES)(np.arange(COUNT))
        expected = np.linalg.lstsq(columns, values, rcond=None)[0].reshape(-1, 2)
        for one, (cosine, sine) in zip(found, expected, strict=True):
            assert one.cosine == pytest.approx(cosine, abs=1e-6 * NM)
            assert one.sine == pytest.approx(sine, abs=1e-6 * NM)

    @pytest.mark.parametrize("scale", [1e-12, 1e3])
    def test_the_unit_of_the_heights_makes_no_difference(self, scale):
        rng = np.random.default_rng(6)
        values = wave(SECONDS, 33.0, 1.0, 2.0) + rng.normal(size=COUNT)
        (one,) = fitted(at_start([(TIME, 33.05)], values), COORDINATES, values)
        (other,) = fitted(at_start([(TIME, 33.05)], scale * values), COORDINATES, scale * values)
        assert other.frequency == pytest.approx(one.frequency, rel=1e-9)
        assert other.amplitude == pytest.approx(scale * one.amplitude, rel=1e-6, abs=0)

    def test_two_starts_for_one_line_become_one(self):
        values = wave(SECONDS, 50.0, 4 * NM, 0.0)
        begin = at_start([(TIME, 50.0), (TIME, 50.0 + 0.4 * RESOLUTION)], values)
        found = fitted(begin, COORDINATES, values)
        assert len(found) == 1
        assert found[0].amplitude == pytest.approx(4 * NM, rel=1e-3)

    def test_of_two_coordinates_lines_of_one_frequency_are_two(self):
        values = wave(SECONDS, 50.0, 4 * NM, 0.0) + wave(METRES, 50.0, 3 * NM, 0.0)
        found = fitted(at_start([(TIME, 50.0), (PATH, 50.0)], values), COORDINATES, values)
        assert [one.coordinate for one in found] == [TIME, PATH]
        assert CLOSEST < 1

    def test_a_long_scan_is_fitted_in_pieces_as_in_one(self):
        """Fit more samples than one portion holds."""
        count = 70_000
        time = np.arange(count) * PERIOD
        long = {TIME: Coordinate(TIME, time, 1.0, TIME, 500.0)}
        values = wave(time, 123.4567, 2 * NM, 1 * NM)
        begin = [start(long[TIME], 123.4567 + 0.2 / time[-1], values)]
        (found,) = fitted(begin, long, values)
        assert found.frequency == pytest.approx(123.4567, abs=1e-6 / time[-1])
        assert (found.cosine, found.sine) == (pytest.approx(2 * NM), pytest.approx(NM))


class TestSums:
    LINES = (line(TIME, 11.0, 2.0, -1.0), line(PATH, 900.0, 0.5, 3.0))

    def test_the_sum_is_that_of_its_lines(self):
        expected = wave(SECONDS, 11.0, 2.0, -1.0) + wave(METRES, 900.0, 0.5, 3.0)
        np.testing.assert_allclose(sum_of(self.LINES, COORDINATES, COUNT), expected, atol=1e-9)
        assert not sum_of([], COORDINATES, 7).any()

    def test_the_waves_at_some_samples_make_the_sum_there(self):
        chosen = np.array([0, 17, 900, 3999])
        columns = waves_of(self.LINES, COORDINATES)(chosen)
        expected = sum_of(self.LINES, COORDINATES, COUNT)[chosen]
        np.testing.assert_allclose(columns @ [2.0, -1.0, 0.5, 3.0], expected, atol=1e-9)


class TestTexture:
    def scan(self):
        still = np.zeros(COUNT)
        return ScanSignal(
            name="A", period=PERIOD, sample=np.arange(COUNT), height=still, path=METRES,
            radius=still, turn=still,
        )  # fmt: skip

    def test_a_wave_finer_than_the_samples_is_found_within_what_is_known_of_it(self):
        """On a path whose pace changes a fine wave has one place, and no image."""
        fine = 41_234.0
        own = COORDINATES[PATH].resolution
        values = wave(METRES, fine, 3 * NM, 2 * NM)
        values = values + np.random.default_rng(7).normal(0, 2 * NM, COUNT)
        found = texture(self.scan(), values, fine + 7.3 * own, 9 * own)
        assert found.coordinate == PATH
        assert found.frequency == pytest.approx(fine, abs=0.3 * own)

    def test_what_lies_beyond_is_not_looked_for(self):
        own = COORDINATES[PATH].resolution
        values = wave(METRES, 5000.0, 3 * NM, 2 * NM)
        found = texture(self.scan(), values, 5000.0 + 30 * own, 5 * own)
        assert abs(found.frequency - 5000.0 - 30 * own) <= 5.51 * own


def test_the_amplitude_is_half_of_peak_to_valley():
    one = line(TURN, 3.0, -3 * NM, 4 * NM)
    assert one.amplitude == pytest.approx(
        np.ptp(wave(np.linspace(0, 1, 10_001), 3.0, -3 * NM, 4 * NM)) / 2, rel=1e-5
    )
