"""Figures of maps whose true figures are known."""

import numpy as np
import pytest

from omsm_ros.core.form.figures import (
    DeviationMap,
    noise_of,
    peak_to_valley,
    robust_peak_to_valley,
    root_mean_square,
    weighted_quantiles,
)


def map_of(deviation, noise=0.0, effects=None, area=None):
    n = len(deviation)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1e-2, 1e-2, (2, n))
    return DeviationMap(
        x=x, y=y, deviation=deviation, area=np.ones(n) if area is None else area,
        effects=np.empty((0, n)) if effects is None else effects, noise=noise,
    )  # fmt: skip


def noisy(true, noise, seed):
    return map_of(true + np.random.default_rng(seed).normal(0, noise, len(true)), noise)


FORM = 40e-9 * np.sin(np.linspace(0, 40, 30_000))
TRUE_PV, TRUE_RMS = np.ptp(FORM), np.sqrt(np.mean(FORM**2))


@pytest.mark.parametrize("noise", [1e-9, 1e-8, 3e-8])
def test_the_truth_lies_within_two_uncertainties_whatever_the_noise(noise):
    for seed in range(5):
        map_ = noisy(FORM, noise, seed)
        extent = peak_to_valley(map_, float(np.ptp(map_.deviation)))
        assert abs(extent.value - TRUE_PV) < 2 * extent.uncertainty
        robust = robust_peak_to_valley(map_)
        low, high = np.quantile(FORM, [0.0025, 0.9975])
        assert abs(robust.value - (high - low)) < 2 * robust.uncertainty + 1e-10
        rms, clean = root_mean_square(map_)
        assert abs(rms.value - TRUE_RMS) < 2 * rms.uncertainty
        assert abs(clean.value - TRUE_RMS) < 3 * clean.uncertainty
        assert clean.uncertainty < rms.uncertainty or noise < 2e-9


def test_a_perfect_part_under_noise_is_not_said_to_have_a_form():
    map_ = noisy(0 * FORM, 1e-8, 1)
    extent = peak_to_valley(map_, float(np.ptp(map_.deviation)))
    assert extent.value - 2 * extent.uncertainty < 0
    _, clean = root_mean_square(map_)
    assert clean.value < 2e-9
    assert clean.value - 2 * clean.uncertainty <= 0


def test_the_rms_is_by_area():
    area = np.where(np.arange(30_000) < 10_000, 2.5, 0.25)
    values = np.where(np.arange(30_000) < 10_000, 2e-8, 0.0)
    rms, _ = root_mean_square(map_of(values, area=area))
    assert rms.value == pytest.approx(2e-8 * np.sqrt(2.5 / 3), rel=1e-12)


def test_an_effect_is_propagated_through_the_figure():
    """10 % more of the form itself is 10 % more of every figure."""
    map_ = map_of(FORM, effects=0.1 * FORM[np.newaxis])
    for figure in (peak_to_valley(map_, TRUE_PV), robust_peak_to_valley(map_)):
        assert figure.uncertainty == pytest.approx(0.1 * figure.value, rel=1e-6)
    rms, clean = root_mean_square(map_)
    assert rms.uncertainty == pytest.approx(0.1 * TRUE_RMS, rel=1e-6)
    assert clean.uncertainty == pytest.approx(0.1 * TRUE_RMS, rel=1e-6)


def test_noise_is_told_from_form_and_drift():
    slow = np.cumsum(np.random.default_rng(1).normal(0, 1e-10, 30_000))
    noise = np.random.default_rng(2).normal(0, 1e-8, 30_000)
    assert noise_of(FORM + slow + noise) == pytest.approx(1e-8, rel=0.03)
    assert noise_of(np.zeros(2)) == 0


def test_quantiles_are_by_weight():
    values, weights = np.array([3.0, 1.0, 2.0]), np.array([1.0, 2.0, 1.0])
    assert weighted_quantiles(values, weights, (0.25, 0.625)) == (1.0, 2.0)
