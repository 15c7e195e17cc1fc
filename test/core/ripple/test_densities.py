"""Densities and levels against scipy's periodogram and Welch's average; units and limits."""

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.ripple.accelerometer import SLIDE, MonitorOptions, RunningSpectrum
from omsm_ros.core.ripple.density import Density, density, evenly, smoothed
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.errors import ConfigurationError


def noise(count, seed=1):
    return np.random.default_rng(seed).normal(size=count)


class TestDensity:
    @pytest.mark.parametrize("count", [16, 17, 1000, 1001])
    def test_it_is_scipys_periodogram(self, count):
        values = noise(count)
        found = density(values, 0.25)
        frequency, power = signal.periodogram(
            values, 4.0, window="blackmanharris", detrend=False, scaling="density"
        )
        np.testing.assert_allclose(found.frequency, frequency)
        np.testing.assert_allclose(found.density, power, rtol=1e-9, atol=1e-12)
        assert found.step == pytest.approx(frequency[1])

    def test_lengths_and_times_have_their_units(self):
        values = noise(300)
        plain, other = density(values, 1.0), density(1e-9 * values, 1e-3)
        np.testing.assert_allclose(other.frequency, 1e3 * plain.frequency)
        np.testing.assert_allclose(other.density, 1e-18 / 1e3 * plain.density)
        assert other.power(0, 600) == pytest.approx(1e-18 * plain.power(0, 0.6), rel=1e-6, abs=0)

    def test_a_band_holds_both_its_edges_and_bands_add_up(self):
        spectrum = Density(np.arange(5.0), np.array([1.0, 2.0, 4.0, 8.0, 16.0]), 0.5)
        assert spectrum.power(1.0, 3.0) == pytest.approx(7.0)
        assert spectrum.power(1.1, 2.9) == pytest.approx(2.0)
        assert spectrum.power(0, 1.5) + spectrum.power(1.5, 4) == pytest.approx(15.5)
        assert spectrum.power(4.1, 9.0) == 0.0


class TestForDrawing:
    def spectrum(self, count=2000):
        return density(noise(count), 1e-3)

    def test_bands_as_fine_as_the_lines_change_nothing(self):
        spectrum = self.spectrum(64)
        frequency, level = smoothed(spectrum, 100_000)
        np.testing.assert_allclose(frequency, spectrum.frequency[1:])
        np.testing.assert_allclose(level, spectrum.density[1:])

    @pytest.mark.parametrize("bins", [1, 7, 200])
    def test_bands_are_means_of_all_lines_but_zero(self, bins):
        spectrum = self.spectrum()
        frequency, level = smoothed(spectrum, bins)
        assert len(frequency) == len(level) <= bins
        assert np.all(np.diff(frequency) > 0)
        assert frequency[0] >= spectrum.frequency[1]
        assert frequency[-1] <= spectrum.frequency[-1]
        assert np.min(spectrum.density) <= np.min(level)
        if bins == 1:
            assert level[0] == pytest.approx(np.mean(spectrum.density[1:]))
            assert frequency[0] == pytest.approx(np.mean(spectrum.frequency[1:]))

    def test_an_even_level_stays(self):
        frequency = np.arange(400.0)
        _, level = smoothed(Density(frequency, np.full(400, 3.0), 1.0), 20)
        np.testing.assert_allclose(level, 3.0)

    def test_values_are_laid_evenly_on_straight_lines_between_the_first_and_the_last(self):
        place = np.array([2.0, 2.5, 4.0, 7.0])
        found = evenly(place, 3 * place - 1, 0.4)
        np.testing.assert_allclose(found, 3 * (2 + 0.4 * np.arange(13)) - 1)


RATE = 2000.0


def pushed(running, columns, first=0, period=1 / RATE, cut=500):
    for low in range(0, columns.shape[1], cut):
        x, y, z = columns[:, low : low + cut]
        running.push(
            AccelerationBlock(
                stamp_ns=0, first_sample=first + low, sample_period=period, x=x, y=y, z=z
            )
        )
    return running


class TestLevels:
    def running(self, columns, **options):
        wanted = {"edges": (20.0, 100.0, 400.0), "window": 0.5} | options
        return pushed(RunningSpectrum(MonitorOptions(**wanted)), columns)

    def test_of_few_windows_they_are_welchs(self):
        """Half overlapping windows without their means, averaged evenly as long as they are few."""
        columns = np.random.default_rng(2).normal(9.81, 1e-2, (3, 2500))
        levels = self.running(columns).levels()
        assert levels.windows == 4
        for name, values in zip("xyz", columns, strict=True):
            frequency, power = signal.welch(
                values, RATE, "blackmanharris", 1000, 500, detrend="constant"
            )
            for (low, high), found in zip(levels.bands, levels.rms[name], strict=True):
                inside = (frequency >= low) & (frequency < high)
                if high == levels.bands[-1][1]:
                    inside |= frequency == high
                expected = np.sqrt(np.sum(power[inside]) * frequency[1])
                assert found == pytest.approx(expected, rel=1e-9)

    def test_of_many_windows_the_last_count_most(self):
        quiet, loud = np.zeros((3, 4000)), np.zeros((3, 4000))
        time = np.arange(4000) / RATE
        loud[2] = np.sin(2 * np.pi * 200 * time)
        ending = self.running(np.hstack([loud, quiet])).levels().rms["z"][1]
        starting = self.running(np.hstack([quiet, loud])).levels().rms["z"][1]
        assert ending**2 < 0.5 * (3 / 4) ** 6
        # Eight windows at a quarter each, of which the first is half of it.
        assert starting**2 == pytest.approx(0.5 * (1 - 0.75**7), rel=0.02)

    def test_the_strongest_line_is_that_of_any_axis(self):
        time = np.arange(4000) / RATE
        columns = np.array([0.3 * np.cos(2 * np.pi * 334 * time), 0 * time, 0.1 * time])
        axis, frequency, amplitude = self.running(columns).levels().line
        assert (axis, frequency) == ("x", 334.0)
        assert amplitude == pytest.approx(0.3, rel=1e-3)

    def test_a_height_along_another_axis_follows_that_axis(self):
        time = np.arange(4000) / RATE
        moved = 1e-6 * np.sin(2 * np.pi * 50 * time) * (2 * np.pi * 50) ** 2
        columns = np.array([moved, 0 * time, 0 * time])
        along = self.running(columns, axis="x").levels()
        assert along.height_total == pytest.approx(1e-6 / 2**0.5, rel=0.01)
        assert along.height_line == (pytest.approx(50.0), pytest.approx(1e-6, rel=0.01))
        assert self.running(columns).levels().height_total < 1e-12
        total = np.sqrt(np.sum(np.square(along.height)))
        assert along.height_total == pytest.approx(total)

    def test_what_lies_below_the_first_band_is_in_none(self):
        time = np.arange(6000) / RATE
        columns = np.array([0 * time, 0 * time, np.sin(2 * np.pi * 4 * time)])
        levels = self.running(columns).levels()
        assert max(levels.rms["z"]) < 1e-3

    def test_another_period_begins_anew_and_a_gap_does_not(self):
        columns = np.random.default_rng(3).normal(size=(3, 2000))
        running = self.running(columns)
        before = running.levels()
        pushed(running, columns, first=9000)
        assert (running.restarts, running.received) == (1, 4000)
        assert running.levels().windows == before.windows + 3
        pushed(running, columns[:, :400], first=11_000, period=1e-3)
        assert running.restarts == 2
        assert running.levels() is None

    def test_a_lost_sample_costs_the_windows_that_hold_it(self):
        columns = np.random.default_rng(4).normal(size=(3, 3000))
        whole = self.running(columns).levels().windows
        columns[1, 1200] = np.nan
        columns[2, 1200] = np.nan
        running = self.running(columns)
        assert running.lost == 1
        assert running.levels().windows == whole - 2


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        ({"edges": (50.0, 20.0)}, "rising"),
        ({"edges": (0.0, 50.0)}, "above zero"),
        ({"edges": (50.0, 50.0)}, "rising"),
        ({"edges": (20.0, 30.0), "window": 0.1}, "first 160 Hz or more wide"),
        ({"mount": "ceiling"}, f"'ceiling'.*expected .*'{SLIDE}'"),
    ],
)
def test_options_that_cannot_be_are_refused(options, reported):
    with pytest.raises(ConfigurationError, match=reported):
        MonitorOptions(**options)
