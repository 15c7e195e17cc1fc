import numpy as np
import pytest

from omsm_ros.core.verification.trend import outliers, trend


def test_one_part_in_forty_that_is_off_stands_out():
    values = np.linspace(18e-9, 22e-9, 40)
    values[7] = 35e-9
    assert np.flatnonzero(outliers(values)).tolist() == [7]


def test_normal_values_seldom_stand_out():
    # Beyond 3.5 standard deviations lie 4.7e-4 of a normal distribution.
    values = np.random.default_rng(2).normal(size=20_000)
    assert np.mean(outliers(values)) == pytest.approx(4.7e-4, rel=0.6)


def test_of_four_nothing_is_said():
    assert not np.any(outliers(np.array([1.0, 1.0, 1.0, 100.0])))


def test_among_equal_values_the_other_one_stands_out():
    assert np.flatnonzero(outliers(np.array([2.0] * 30 + [3.0]))).tolist() == [30]
    assert not np.any(outliers(np.full(6, 2.0)))


def test_a_value_that_is_not_known_is_no_outlier():
    values = np.array([1.0, 1.1, np.nan, 0.9, 1.05, 9.0])
    assert np.flatnonzero(outliers(values)).tolist() == [5]


def test_drift_is_found_though_a_third_is_wrong():
    random = np.random.default_rng(3)
    times = np.linspace(0, 1e6, 60)
    values = 2e-15 * times + random.normal(0, 1e-10, 60)
    values[::4] += 50e-9
    found = trend(times, values)
    assert found.significant
    assert found.slope == pytest.approx(2e-15, rel=0.1)


def test_noise_alone_drifts_in_one_of_twenty():
    random = np.random.default_rng(4)
    times = np.arange(30.0)
    drifting = [trend(times, random.normal(size=30)).significant for _ in range(300)]
    assert 0.01 < np.mean(drifting) < 0.10


@pytest.mark.parametrize("times", [np.zeros(9), np.full(9, np.nan), np.arange(4.0)])
def test_where_time_does_not_tell_there_is_no_trend(times):
    assert trend(times, np.arange(float(len(times)))) is None


def test_of_very_many_points_some_tell_the_slope_of_all():
    """All 1.8 thousand million slopes between 60 000 would take 29 GB."""
    random = np.random.default_rng(5)
    times = np.linspace(0, 1e6, 60_000)
    values = 2e-15 * times + random.normal(0, 1e-10, 60_000)
    order = random.permutation(60_000)
    found = trend(times[order], values[order])
    # Of n points evenly in T with noise σ, a line's slope has σ √12 / (T √n), here of the 1000.
    assert found.slope == pytest.approx(2e-15, abs=4 * 1e-10 * np.sqrt(12 / 1000) / 1e6)
    assert found.low < 2e-15 < found.high
    assert found.high - found.low == pytest.approx(
        2 * 1.96 * 1e-10 * np.sqrt(12 / 1000) / 1e6, rel=0.15
    )
