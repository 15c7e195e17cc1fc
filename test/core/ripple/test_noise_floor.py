"""The floor of known noises, and the chance of a line against its formula in exact arithmetic."""

from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from omsm_ros.core.ripple.density import noise_floor, ratio_at, significance


def exactly(ratio, tried):
    """σ of ``1 - (1 - exp(-ratio))^tried``, with 130 digits."""
    getcontext().prec = 130
    chance = 1 - (1 - (-Decimal(ratio)).exp()) ** Decimal(tried)
    return float(stats.norm.isf(float(chance)))


class TestSignificance:
    @pytest.mark.parametrize("tried", [1, 2, 24, 4000, 10**7])
    def test_it_is_the_sigma_of_the_chance_that_any_of_them_is_so_strong(self, tried):
        for over in (0.3, 1.0, 2.0, 5.0, 20.0, 200.0):
            ratio = np.log(tried) + over
            found = float(significance(np.array(ratio), tried))
            assert found == pytest.approx(exactly(ratio, tried), abs=1e-6)

    @settings(max_examples=40)
    @given(st.floats(0.05, 600.0), st.floats(1e-3, 5.0), st.floats(1.0, 1e6))
    def test_a_stronger_line_is_more_significant_and_one_of_more_less(self, ratio, more, tried):
        here, there = significance(np.array([ratio, ratio + more]), tried)
        assert there >= here
        assert significance(np.array([ratio]), 2 * tried)[0] <= here

    def test_no_power_is_no_line_and_one_beyond_all_range_has_a_number(self):
        assert significance(np.array([0.0]), 100)[0] < 0
        # ½σ² is the ratio where it is large.
        assert significance(np.array([1e6]), 100)[0] == pytest.approx(np.sqrt(2e6), rel=1e-3)

    def test_it_has_the_shape_of_its_ratios(self):
        assert significance(np.ones((2, 3)), 5).shape == (2, 3)

    @pytest.mark.parametrize("tried", [1.0, 30.0, 1e6])
    @pytest.mark.parametrize("sigma", [-1.0, 0.0, 1.0, 3.0, 8.0, 50.0])
    def test_the_ratio_is_its_inverse(self, sigma, tried):
        found = significance(np.array(ratio_at(sigma, tried)), tried)
        assert float(found) == pytest.approx(sigma, abs=1e-6)

    def test_one_frequency_is_an_exponential(self):
        """In noise alone 2.3 % of single powers exceed two σ."""
        assert ratio_at(2.0, 1.0) == pytest.approx(-np.log(stats.norm.sf(2.0)))


class TestFloor:
    def exponential(self, count, seed=1):
        return np.random.default_rng(seed).exponential(1.0, count)

    @pytest.mark.parametrize("count", [1, 2, 16, 300, 5001])
    def test_an_even_spectrum_has_itself_over_the_median_of_an_exponential(self, count):
        floor = noise_floor(np.full(count, 3.0))
        np.testing.assert_allclose(floor, 3.0 / np.log(2))

    def test_lines_do_not_lift_it(self):
        power = self.exponential(4000)
        loud = power.copy()
        loud[::40] = 1e6
        np.testing.assert_allclose(noise_floor(loud)[50:], noise_floor(power)[50:], rtol=0.3)

    def test_it_scales_with_the_power(self):
        power = self.exponential(1000)
        np.testing.assert_allclose(noise_floor(1e-20 * power), 1e-20 * noise_floor(power))

    @pytest.mark.parametrize("slope", [-2.0, -1.0, 1.0])
    def test_it_follows_noise_that_rises_or_falls(self, slope):
        place = np.arange(1, 20_001)
        level = (place / 2000.0) ** slope
        ratio = noise_floor(level * self.exponential(20_000)) / level
        assert np.median(ratio) == pytest.approx(1.0, rel=0.1)
        assert np.all((ratio[100:] > 0.6) & (ratio[100:] < 1.7))

    def test_a_step_of_the_noise_is_found_within_its_width(self):
        level = np.where(np.arange(10_000) < 5000, 1.0, 100.0)
        floor = noise_floor(level * self.exponential(10_000))
        assert np.median(floor[:4000]) == pytest.approx(1.0, rel=0.1)
        assert np.median(floor[6000:]) == pytest.approx(100.0, rel=0.1)

    def test_a_finer_grid_of_the_same_spectrum_has_the_same_floor(self):
        """Twice as many frequencies of one noise: neighbours are alike, their level is not."""
        values = np.random.default_rng(3).normal(size=4000)
        coarse = abs(np.fft.rfft(values)) ** 2 / 4000
        fine = abs(np.fft.rfft(values, 8000)) ** 2 / 4000
        here, there = noise_floor(coarse), noise_floor(fine, 2)[::2]
        np.testing.assert_allclose(there[100:], here[100:], rtol=0.25)
        assert np.mean(there) == pytest.approx(np.mean(here), rel=0.03)

    def test_nothing_at_all_has_a_floor_above_nothing(self):
        floor = noise_floor(np.zeros(100))
        assert np.all(floor > 0)
        assert np.all(floor < 1e-300)
