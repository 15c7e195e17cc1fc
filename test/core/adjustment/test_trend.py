import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.calibration.repeatability import outliers, trend


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
    assert found.slope == pytest.approx(2e-15, rel=0.1, abs=0)


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
    # The slope of n points evenly over T with noise σ has the uncertainty σ √12 / (T √n).
    assert found.slope == pytest.approx(2e-15, abs=4 * 1e-10 * np.sqrt(12 / 1000) / 1e6)
    assert found.low < 2e-15 < found.high
    assert found.high - found.low == pytest.approx(
        2 * 1.96 * 1e-10 * np.sqrt(12 / 1000) / 1e6, rel=0.15, abs=0
    )


values = st.lists(st.floats(-1e3, 1e3), min_size=8, max_size=25).map(np.array)


@pytest.mark.parametrize("seed", range(8))
def test_a_trend_is_linear_in_its_values(seed):
    random = np.random.default_rng(seed)
    times, v = np.sort(random.uniform(0, 100, 5 + 3 * seed)), random.normal(size=5 + 3 * seed)
    plain, tilted = trend(times, v), trend(times, 5.0 - 2.0 * v + 0.3 * times)
    assert tilted.slope == pytest.approx(0.3 - 2.0 * plain.slope, rel=1e-9, abs=1e-9)
    # A factor below zero turns the interval over.
    assert tilted.low == pytest.approx(0.3 - 2.0 * plain.high, rel=1e-9, abs=1e-9)
    assert tilted.high == pytest.approx(0.3 - 2.0 * plain.low, rel=1e-9, abs=1e-9)


@settings(max_examples=30)
@given(v=values, seed=st.integers(0, 99))
def test_a_trend_knows_no_order_and_no_unit_of_time(v, seed):
    random = np.random.default_rng(seed)
    times = np.arange(float(len(v)))
    order = random.permutation(len(v))
    plain, mixed, fast = trend(times, v), trend(times[order], v[order]), trend(times / 60 + 1e3, v)
    assert mixed == plain
    assert fast.slope == pytest.approx(60 * plain.slope, rel=1e-6, abs=1e-9)


def test_the_slope_is_the_median_of_all_between_two():
    times, v = np.array([0.0, 1.0, 3.0, 4.0, 9.0]), np.array([1.0, 0.0, 4.0, 9.0, 2.0])
    all_slopes = [(v[j] - v[i]) / (times[j] - times[i]) for i in range(5) for j in range(i + 1, 5)]
    found = trend(times, v)
    assert found.slope == pytest.approx(np.median(all_slopes))
    assert found.low <= found.slope <= found.high


def test_what_is_not_known_of_either_counts_in_neither():
    times, v = np.arange(20.0), np.sin(np.arange(20.0))
    spoiled_t, spoiled_v = times.copy(), v.copy()
    spoiled_t[3], spoiled_v[11] = np.nan, np.inf
    kept = np.delete(np.arange(20), [3, 11])
    assert trend(spoiled_t, spoiled_v) == trend(times[kept], v[kept])
    assert trend(times[:4], v[:4]) is None
    assert trend(times[:5], v[:5]) is not None


@settings(max_examples=30)
@given(v=values, scale=st.floats(0.01, 100), shift=st.floats(-100, 100), seed=st.integers(0, 99))
def test_outliers_know_no_order_unit_or_zero(v, scale, shift, seed):
    v = np.round(v, 2)
    order = np.random.default_rng(seed).permutation(len(v))
    found = outliers(v)
    assert np.array_equal(outliers(v[order]), found[order])
    near = np.abs(v - np.median(v))
    spread = np.median(near) / 0.6745 or np.mean(near) * np.sqrt(np.pi / 2)
    # But for values that stand on the border to the last bit.
    sure = np.abs(near - 3.5 * spread) > 1e-6 * (spread + 1)
    assert np.array_equal(outliers(-scale * v + shift)[sure], found[sure])
