"""Coordinates of a scan, spectra over them by plain sums, and which line is one in another."""

import numpy as np
import pytest

from omsm_ros.core.ripple.coordinates import (
    OVERSAMPLING,
    Coordinate,
    coordinates_of,
    power_over,
    same_line,
)
from omsm_ros.core.ripple.density import noise_floor
from omsm_ros.core.ripple.scan_signal import PATH, RADIUS, TIME, TURN, ScanSignal

COUNT, PERIOD = 3000, 1e-3


def scan(sample=None, path=None, radius=None, turn=None):
    sample = np.arange(COUNT) if sample is None else sample
    still = np.zeros(len(sample))
    given = {"path": path, "radius": radius, "turn": turn}
    columns = {name: still if v is None else v for name, v in given.items()}
    return ScanSignal(name="A", period=PERIOD, sample=sample, height=still, **columns)


TIMES = np.arange(COUNT) * PERIOD


def spiral(rpm=60.0, feed=1e-4, radius=5e-3):
    turn = rpm / 60 * TIMES
    r = radius - feed * turn
    path = np.concatenate([[0.0], np.cumsum(np.pi * (r[1:] + r[:-1]) * np.diff(turn))])
    return scan(path=path, radius=r, turn=turn)


class TestWhichThereAre:
    def test_a_probe_at_rest_has_time_alone(self):
        assert list(coordinates_of(scan())) == [TIME]

    def test_a_circle_has_path_and_turns_as_even_as_time_and_no_radius(self):
        found = coordinates_of(spiral(feed=0.0))
        assert set(found) == {TIME, PATH, TURN}
        assert all(c.like == TIME and c.proportional_to_time for c in found.values())

    def test_on_a_spiral_rings_go_with_turns_and_the_path_for_itself(self):
        found = coordinates_of(spiral(feed=5e-4))
        assert {name: c.like for name, c in found.items()} == {
            TIME: TIME, PATH: PATH, TURN: TIME, RADIUS: TIME,
        }  # fmt: skip
        assert not found[PATH].proportional_to_time

    def test_a_raster_at_an_even_pace_has_its_path(self):
        found = coordinates_of(scan(path=0.01 * TIMES))
        assert set(found) == {TIME, PATH}
        assert found[PATH].like == TIME

    def test_a_spindle_that_wanders_has_turns_of_its_own(self):
        turn = TIMES + 0.05 * np.sin(2 * np.pi * 0.7 * TIMES)
        found = coordinates_of(scan(path=0.03 * turn, turn=turn))
        assert found[TURN].like == PATH
        assert found[PATH].like == PATH

    def test_paces_resolutions_and_half_the_rate(self):
        found = coordinates_of(spiral(rpm=90.0))
        assert found[TURN].pace == pytest.approx(1.5)
        assert found[RADIUS].pace == pytest.approx(1.5e-4)
        assert found[TIME].resolution == pytest.approx(1 / TIMES[-1])
        assert found[TURN].resolution == pytest.approx(1 / (1.5 * TIMES[-1]))
        assert found[TIME].highest == pytest.approx(500.0)
        # 1.5 µm of rings a millisecond: no finer than half of their inverse.
        assert found[RADIUS].highest == pytest.approx(0.5 / 1.5e-7, rel=1e-3)

    def test_a_gap_of_the_trigger_is_no_change_of_pace(self):
        sample = np.r_[np.arange(1000), np.arange(2000, 4000)]
        found = coordinates_of(scan(sample=sample, path=0.01 * PERIOD * sample))
        assert found[PATH].like == TIME
        assert found[PATH].highest == pytest.approx(0.5 / (0.01 * PERIOD))

    def test_a_circle_turned_backwards_is_as_good(self):
        signal = spiral(feed=0.0)
        back = scan(path=signal.path, radius=signal.radius, turn=-signal.turn)
        found = coordinates_of(back)
        assert found[TURN].pace == pytest.approx(1.0)
        assert found[TURN].like == TIME


def plain(place, values, frequency):
    """Squared amplitude by the sum itself."""
    return abs(2 / len(values) * np.sum(values * np.exp(-2j * np.pi * frequency * place))) ** 2


class TestPower:
    def test_a_line_has_the_square_of_its_amplitude(self):
        signal = scan()
        values = 3e-9 * np.sin(2 * np.pi * 40.0 * TIMES + 1)
        power, spacing = power_over(signal, values, coordinates_of(signal)[TIME])
        assert power[round(40.0 / spacing)] == pytest.approx(9e-18, rel=1e-9, abs=0)

    def test_over_time_it_is_the_sum_over_the_samples_there_are(self):
        rng = np.random.default_rng(1)
        kept = np.flatnonzero(rng.uniform(size=COUNT) > 0.3)
        kept[0] = 0
        signal = scan(sample=kept)
        values = rng.normal(size=len(kept))
        power, spacing = power_over(signal, values, coordinates_of(signal)[TIME])
        for k in (1, 2, 77, 900, len(power) - 1):
            assert power[k] == pytest.approx(plain(signal.time, values, k * spacing), rel=1e-6)

    @pytest.mark.parametrize("name", [PATH, TURN, RADIUS])
    def test_over_another_coordinate_it_is_the_sum_too(self, name):
        signal = spiral(feed=5e-4)
        rng = np.random.default_rng(2)
        values = rng.normal(size=COUNT)
        coordinate = coordinates_of(signal)[name]
        power, spacing = power_over(signal, values, coordinate)
        assert spacing == pytest.approx(coordinate.resolution / 2)
        for k in (1, 3, 40, len(power) - 1):
            expected = plain(coordinate.values, values, k * spacing)
            assert power[k] == pytest.approx(expected, rel=1e-3, abs=1e-8)
        assert (len(power) - 1) * spacing <= coordinate.highest

    def test_the_floor_of_white_noise_is_four_variances_over_its_samples(self):
        signal = scan()
        values = np.random.default_rng(3).normal(0, 2.0, COUNT)
        power, _ = power_over(signal, values, coordinates_of(signal)[TIME])
        floor = noise_floor(power, OVERSAMPLING)
        assert np.mean(floor) == pytest.approx(4 * 4.0 / COUNT, rel=0.05)


class TestSameLine:
    def coordinate(self, name, values, like=None):
        return Coordinate(name, values, 1.0, like or name, 1.0)

    def test_in_proportion_the_whole_line_is_one(self):
        one, other = self.coordinate(TIME, TIMES), self.coordinate(PATH, 0.02 * TIMES + 7.0)
        share, frequency = same_line(one, 100.0, other)
        assert share == pytest.approx(1.0, abs=1e-9)
        assert frequency == pytest.approx(5000.0, rel=1e-9)

    def test_turned_backwards_it_is_the_same(self):
        one, other = self.coordinate(TIME, TIMES), self.coordinate(TURN, -0.5 * TIMES)
        share, frequency = same_line(one, 100.0, other)
        assert (share, frequency) == (pytest.approx(1.0), pytest.approx(200.0))

    @pytest.mark.parametrize("bend", [0.002, 0.01, 0.05])
    def test_the_power_a_curved_coordinate_explains_is_the_best_of_plain_sums(self, bend):
        other = self.coordinate(PATH, TIMES + bend * TIMES**2)
        share, frequency = same_line(self.coordinate(TIME, TIMES), 30.0, other)

        def taken(f):
            # A line of the other coordinate: how much of the first one's wave its sum takes.
            return abs(np.mean(np.exp(2j * np.pi * (30.0 * TIMES - f * other.values)))) ** 2

        tried = np.linspace(20.0, 32.0, 401)
        best = [taken(f) for f in tried]
        assert share == pytest.approx(max(best), abs=0.06 * max(best))
        assert taken(frequency) == pytest.approx(share, abs=1e-6)
        assert share < 1 - 1e-4

    def test_the_more_waves_the_less_is_one(self):
        one, curved = self.coordinate(TIME, TIMES), self.coordinate(PATH, TIMES + 0.003 * TIMES**2)
        shares = [same_line(one, frequency, curved)[0] for frequency in (5.0, 50.0, 200.0, 450.0)]
        assert shares == sorted(shares, reverse=True)
        assert shares[0] > 0.98
        assert shares[-1] < 0.6

    def test_a_long_scan_is_judged_by_some_of_its_samples_as_by_all(self):
        time = np.arange(40_000) * PERIOD
        curved = time + 1e-4 * time**2
        many = same_line(self.coordinate(TIME, time), 3.0, self.coordinate(PATH, curved))
        few = same_line(self.coordinate(TIME, time[::13]), 3.0, self.coordinate(PATH, curved[::13]))
        assert many == pytest.approx(few, rel=2e-2)
