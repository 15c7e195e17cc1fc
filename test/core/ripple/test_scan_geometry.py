"""Path, turns and sampling of motions whose length is known in closed form."""

import numpy as np
import pytest

from omsm_ros.core.ripple.accelerometer import AccelerationLine, acceleration_lines
from omsm_ros.core.ripple.density import band_stop
from omsm_ros.core.ripple.lines import find_lines
from omsm_ros.core.ripple.scan_signal import (
    ScanSignal,
    sampling_over,
    scan_signal,
    track,
    unwrapped_angle,
)
from omsm_ros.errors import DataError

COUNT = 4000
STILL = np.zeros(COUNT)
EVERY = np.arange(COUNT)


class TestTrack:
    @pytest.mark.parametrize("turns", [0.5, 3.0, -7.0])
    def test_a_circle_is_its_circumference_times_its_turns_whichever_way(self, turns):
        found = track(np.full(COUNT, 4e-3), np.full(COUNT, 3e-3), np.linspace(0, turns, COUNT))
        assert found[-1] == pytest.approx(abs(turns) * 2 * np.pi * 5e-3, rel=1e-12)
        assert np.all(np.diff(found) > 0)

    def test_a_slide_at_an_angle_is_its_diagonal(self):
        found = track(3e-3 * EVERY / 3999, -4e-3 * EVERY / 3999, STILL)
        np.testing.assert_allclose(found, 5e-3 * EVERY / 3999, rtol=1e-9, atol=1e-15)

    def test_there_and_back_is_twice_the_way(self):
        x = 1e-3 * (1 - abs(np.linspace(-1, 1, 100_001)))
        still = np.zeros_like(x)
        # About the turning point the direction is found over a stretch.
        assert track(x, still, still)[-1] == pytest.approx(2e-3, rel=0.02)

    def test_a_slide_at_rest_stays_where_it_is(self):
        assert not track(np.full(COUNT, 2e-3), STILL, STILL).any()

    def test_only_a_hundredth_of_a_turn_is_a_slide_seen_from_the_part(self):
        turn = np.linspace(0, 0.009, COUNT)
        radius = np.full(COUNT, 10e-3)
        expected = 2 * np.pi * 0.009 * 10e-3
        assert track(radius, STILL, turn)[-1] == pytest.approx(expected, rel=1e-3)

    def test_a_part_that_turns_under_a_slide_that_goes_out_is_an_archimedean_spiral(self):
        turn = np.linspace(0, 10, COUNT)
        radius = 1e-3 + 3e-4 * turn
        fine = np.linspace(0, 10, 1_000_001)
        speed = np.hypot(2 * np.pi * (1e-3 + 3e-4 * fine), 3e-4)
        expected = np.trapezoid(speed, fine)
        assert track(radius, STILL, turn)[-1] == pytest.approx(expected, rel=1e-6)


class TestTurns:
    @pytest.mark.parametrize("pace", [0.02, -0.03, 1.9])
    def test_an_encoder_that_starts_anew_is_counted_on_whichever_way(self, pace):
        angle = pace * EVERY
        wrapped = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
        found = unwrapped_angle(EVERY, wrapped)
        np.testing.assert_allclose(found - found[0], angle - angle[0], atol=1e-8)

    def test_less_than_a_turn_and_noise_are_left_alone(self):
        angle = 1.0 + 1e-5 * np.random.default_rng(1).normal(size=COUNT)
        assert unwrapped_angle(EVERY, angle) is angle

    def test_over_a_gap_it_has_kept_its_pace(self):
        count = np.r_[np.arange(2000), np.arange(9000, 11_000)]
        found = unwrapped_angle(count, np.remainder(0.011 * count, 2 * np.pi))
        np.testing.assert_allclose(found, 0.011 * count, atol=1e-8)


class TestSampling:
    def signal(self, sample, path, radius):
        return ScanSignal(
            name="A", period=2e-3, sample=sample, height=np.zeros(len(sample)), path=path,
            radius=radius, turn=path,
        )  # fmt: skip

    def test_a_gap_of_the_trigger_is_no_wider_sampling(self):
        sample = np.r_[np.arange(500), np.arange(3000, 3500)]
        (only,) = sampling_over(self.signal(sample, 3e-6 * sample, np.full(1000, 5e-3)))
        assert (only["radius"], only["distance"]) == (pytest.approx(5e-3), pytest.approx(3e-6))
        assert only["shortest_wavelength"] == pytest.approx(6e-6)

    @pytest.mark.parametrize("places", [1, 3, 8])
    def test_rings_go_from_the_outermost_to_the_innermost(self, places):
        radius = np.linspace(10e-3, 2e-3, 1000)
        found = sampling_over(self.signal(np.arange(1000), np.cumsum(radius), radius), places)
        assert len(found) == places
        width = 8e-3 / places
        expected = 10e-3 - width * (0.5 + np.arange(places))
        assert [one["radius"] for one in found] == pytest.approx(list(expected), rel=1e-2)
        assert [one["distance"] for one in found] == pytest.approx(list(expected), rel=1e-2)

    def test_its_times_are_those_of_the_trigger(self):
        sample = np.array([0, 1, 2, 5, 9])
        signal = self.signal(sample, 0.5 * sample, np.ones(5))
        np.testing.assert_allclose(signal.time, 2e-3 * sample)
        assert (len(signal), signal.rate) == (5, 500.0)
        assert signal.duration == pytest.approx(20e-3)
        assert signal.turns == pytest.approx(4.5)


class TestScan:
    def scan(self, sample, count, x):
        still = np.zeros(len(count))
        readings = sample, np.arange(len(sample), dtype=float)
        return scan_signal("A", 1e-3, readings, (count, x, still, still))

    def test_positions_are_interpolated_where_some_are_lost(self):
        x = 5e-3 + 1e-6 * EVERY
        x[100:140] = np.nan
        found = self.scan(EVERY, EVERY, x)
        np.testing.assert_allclose(found.radius, 5e-3 + 1e-6 * EVERY, rtol=1e-9)
        np.testing.assert_allclose(found.path, 1e-6 * EVERY, rtol=1e-6, atol=1e-12)

    @pytest.mark.parametrize("every", [2, 5])
    def test_read_at_every_other_trigger_it_is_a_scan_at_half_the_rate(self, every):
        """Also where some of those readings are lost, and the spindle starts anew each turn."""
        count = np.arange(0, 5 * COUNT, every)
        count = np.delete(count, [7, 300, 301, 302])
        angle = 2 * np.pi * 0.35 * count * 1e-3
        still = np.zeros(len(count))
        slow = scan_signal(
            "A",
            1e-3,
            (count, np.sin(count)),
            (count, 5e-3 + still, still, np.remainder(angle, 2 * np.pi)),
        )
        assert slow.rate == pytest.approx(1000.0 / every)
        np.testing.assert_array_equal(slow.sample, count // every)
        np.testing.assert_allclose(slow.time, count * 1e-3)
        np.testing.assert_allclose(slow.turn, angle / 2 / np.pi, atol=1e-9)
        np.testing.assert_allclose(slow.path, 5e-3 * angle, rtol=1e-9, atol=1e-12)

    def test_a_line_of_such_a_scan_is_one_line(self):
        count = np.arange(0, 2 * COUNT, 2)
        height = 5e-9 * np.sin(2 * np.pi * 60.0 * 1e-3 * count)
        height = height + np.random.default_rng(1).normal(0, 1e-9, COUNT)
        signal = scan_signal("A", 1e-3, (count, height), (count, STILL, STILL, STILL))
        (line,) = find_lines(signal, signal.height).lines
        assert line.frequency == pytest.approx(60.0, abs=1e-3)
        assert line.amplitude == pytest.approx(5e-9, rel=0.02)

    def test_readings_before_and_after_the_positions_are_left_out(self):
        found = self.scan(EVERY, EVERY[500:3001], 5e-3 + 1e-6 * EVERY[500:3001])
        assert len(found) == 2501
        assert (found.sample[0], found.height[0], found.height[-1]) == (0, 500.0, 3000.0)

    def test_positions_that_are_all_lost_are_refused_by_their_number(self):
        with pytest.raises(DataError, match=r"'A' has 4000 readings and 0 positions"):
            self.scan(EVERY, EVERY, np.full(COUNT, np.nan))


class TestBandStop:
    def test_what_is_removed_is_linear_and_nothing_of_an_offset(self):
        rng = np.random.default_rng(1)
        one, other = rng.normal(size=(2, COUNT))
        bands = [(40.0, 60.0), (150.0, 170.0)]
        parts = [band_stop(EVERY, v, 1e-3, bands).removed for v in (one, other, one - 3 * other)]
        np.testing.assert_allclose(parts[2], parts[0] - 3 * parts[1], atol=1e-9)
        assert np.max(abs(band_stop(EVERY, np.full(COUNT, 7.0), 1e-3, bands).removed)) < 1e-9

    def test_without_a_band_all_stays(self):
        values = np.random.default_rng(2).normal(size=COUNT)
        found = band_stop(EVERY, values, 1e-3, [])
        assert not found.removed.any()
        assert (found.settling, found.rms_removed) == (0.0, 0.0)
        assert found.rms_before == found.rms_after == pytest.approx(np.std(values))
        np.testing.assert_array_equal(found.response, 1.0)

    def test_at_the_edges_a_quarter_of_the_power_is_left_twice_and_far_off_all(self):
        found = band_stop(EVERY, STILL, 1e-3, [(100.0, 120.0)])

        def at(frequency):
            return np.interp(frequency, found.frequency, found.response)

        assert (at(100.0), at(120.0)) == (pytest.approx(0.5, rel=0.03),) * 2
        assert at(110.0) < 1e-6
        assert (at(40.0), at(300.0)) == (pytest.approx(1.0, abs=1e-3),) * 2
        assert (found.frequency[0], found.frequency[-1]) == (0.0, 500.0)

    def test_two_bands_are_one_after_the_other(self):
        one, other, both = (
            band_stop(EVERY, STILL, 1e-3, bands)
            for bands in ([(50.0, 70.0)], [(200.0, 210.0)], [(200.0, 210.0), (50.0, 70.0)])
        )
        np.testing.assert_allclose(both.response, one.response * other.response)
        assert both.settling == max(one.settling, other.settling) == other.settling

    def test_beyond_its_settling_a_pulse_has_rung_out(self):
        pulse = STILL.copy()
        pulse[0] = 1.0
        found = band_stop(np.arange(COUNT), pulse, 1e-3, [(50.0, 70.0)])
        far = round(found.settling / 1e-3)
        assert 10 < far < COUNT / 4
        assert np.max(abs(found.removed[far:])) < 1e-3 * np.max(abs(found.removed))

    def test_it_reads_backwards_as_forwards(self):
        values = np.random.default_rng(3).normal(size=COUNT)
        found = band_stop(EVERY, values, 1e-3, [(50.0, 70.0)]).removed
        back = band_stop(EVERY, values[::-1], 1e-3, [(50.0, 70.0)]).removed[::-1]
        np.testing.assert_allclose(found[600:-600], back[600:-600], atol=1e-6)


class TestAccelerometerLines:
    RATE = 2000.0
    TIME = np.arange(8000) / RATE

    def shaken(self, *lines, seed=1, noise=1e-4):
        values = np.random.default_rng(seed).normal(0, noise, len(self.TIME))
        return values + sum(a * np.sin(2 * np.pi * f * self.TIME + 1) for f, a in lines)

    def test_an_acceleration_is_a_motion_twice_differentiated(self):
        line = AccelerationLine(
            axis="z", frequency=50.0, frequency_uncertainty=0.0, acceleration=0.0, significance=9.0
        )
        assert line.displacement == 0.0
        motion = 3e-9 * np.sin(2 * np.pi * 120.0 * self.TIME)
        acceleration = np.gradient(np.gradient(motion, 1 / self.RATE), 1 / self.RATE)
        (found,) = acceleration_lines(
            1 / self.RATE, {"z": acceleration + 1e-6 * self.shaken()}
        ).lines
        # Differences of neighbours are the less the fewer a wave: sinc² of 120 Hz over 2 kHz,
        # twice for they are central.
        assert found.displacement == pytest.approx(3e-9 * np.sinc(0.12) ** 2, rel=1e-3)

    def test_a_line_on_several_axes_is_reported_of_the_one_where_it_is_strongest(self):
        axes = {
            "x": self.shaken((120.0, 1e-2), (300.0, 5e-2)),
            "y": self.shaken((120.05, 3e-2), seed=2),
        }
        found = acceleration_lines(1 / self.RATE, axes)
        assert [(one.axis, round(one.frequency)) for one in found.lines] == [("x", 300), ("y", 120)]
        assert (found.highest, found.duration) == (1000.0, pytest.approx(4.0))

    def test_lost_samples_and_axes_without_a_signal_cost_no_line(self):
        x = self.shaken((120.0, 1e-2))
        x[::7] = np.nan
        axes = {"x": x, "y": np.zeros(8000), "z": np.full(8000, np.nan)}
        (found,) = acceleration_lines(1 / self.RATE, axes).lines
        assert found.axis == "x"
        assert found.acceleration == pytest.approx(1e-2, rel=0.02)
        assert found.frequency == pytest.approx(120.0, abs=5 * found.frequency_uncertainty)
        assert found.significance > 20

    def test_gravity_is_no_line(self):
        assert acceleration_lines(1 / self.RATE, {"z": 9.81 + self.shaken()}).lines == ()
