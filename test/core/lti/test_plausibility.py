"""Calibrations that no machine has, each with one thing changed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import Certificate, to_json
from omsm_ros.core.calibration.latency import unresolved_latency
from omsm_ros.core.calibration.plausibility import MAX_TIME_CONSTANT_SAMPLES
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import CalibrationError
from omsm_ros.readable import plain

GOOD = Calibration(
    dynamics=TransferFunction([1.0, 1e-4], [1.0, 1e-3, 1e-6], 2e-4),
    static_gain=1.0,
    sample_period=1e-3,
    valid_up_to=100.0,
    covariance=np.diag([0.0, 1e-14, 1e-14, 1e-20, 1e-14]),
    certificate=Certificate(verdict="accepted"),
)


def changed(**parts: Any) -> Calibration:
    """Return the calibration read from a good one with changed ``parts``."""
    dynamics = parts.pop("dynamics", GOOD.dynamics)
    content = GOOD.content() | {
        "numerator": dynamics.numerator.tolist(),
        "denominator": dynamics.denominator.tolist(),
        "delay": dynamics.delay,
    }
    if "covariance" in parts:
        parts["covariance"] = np.asarray(parts["covariance"]).ravel().tolist()
    return Calibration.from_content(content | parts)


def test_what_is_good_comes_through() -> None:
    assert changed().id == GOOD.id


@pytest.mark.parametrize(
    ("numerator", "denominator", "delay", "named"),
    [
        ([5.0, 1e-4], [1.0, 1e-3, 1e-6], 0.0, r"G_m\(0\).* is 5.0, expected 1"),
        ([-1.0, 1e-4], [1.0, 1e-3, 1e-6], 0.0, r"G_m\(0\)"),
        ([0.0, 1e-4], [1.0, 1e-3, 1e-6], 0.0, r"G_m\(0\)"),
        ([1.0, 1e-4], [1.0, 1e-3, 1e-6], 1000.0, "delay is 1000.0 s"),
        ([1.0, 1e-4], [1.0, 1e5, 1.0], 0.0, r"time constant of G_m is 99999\.9"),
        ([1.0, 1e-4], [1.0, 500.0, 1e-6], 0.0, "slowest decay of G_m is 500.0 s: 5.00 · 10⁵"),
        ([1.0, 1e-4], [1.0, 1e-3, 1e-300], 0.0, "G_m"),
        ([1.0, 1e-4], [1.0, 1e-3, 1e300], 0.0, "G_m"),
        ([1.0, 1e300], [1.0, 1e-3, 1e-6], 0.0, "time constant of G_m"),
        ([1.0, 1e-4], [1.0, -1e-3, 1e-6], 0.0, "unstable"),
        ([1.0, 1e-4], [1.0, 0.0, 1e-6], 0.0, "slowest decay of G_m is inf s"),
    ],
)
def test_dynamics_of_no_machine_are_refused_by_name(
    numerator: list[float], denominator: list[float], delay: float, named: str
) -> None:
    with pytest.raises(CalibrationError, match=named):
        changed(dynamics=TransferFunction(numerator, denominator, delay))  # type: ignore[arg-type]


@pytest.mark.parametrize("coefficient", [3e-14, -3e-16, 1e-30])
def test_a_zero_that_is_as_good_as_infinite_is_taken(coefficient: float) -> None:
    denominator = [1.0, 1e-3, 1e-6]
    known = changed(dynamics=TransferFunction([1.0, coefficient], denominator))  # type: ignore[arg-type]
    without = TransferFunction([1.0], denominator)  # type: ignore[arg-type]
    lines = np.geomspace(0.1, 400.0, 20)
    digital, plain = (discretise(g, GOOD.sample_period) for g in (known.dynamics, without))
    np.testing.assert_allclose(digital.response(lines), plain.response(lines), rtol=1e-9)


def test_a_delay_of_many_samples_is_refused_for_its_filter() -> None:
    late = TransferFunction([1.0], [1.0], 0.5)
    none = np.zeros((2, 2))
    assert changed(dynamics=late, covariance=none).dynamics.delay == 0.5
    with pytest.raises(CalibrationError, match=r"delay of G_m is 500.0 ms: 2.50 · 10⁴ samples"):
        changed(dynamics=late, covariance=none, sample_period=2e-5)


def test_the_slowest_decay_that_is_taken_fits_into_memory() -> None:
    slow = 0.99 * MAX_TIME_CONSTANT_SAMPLES * GOOD.sample_period
    known = changed(
        dynamics=TransferFunction([1.0], [1.0, slow]),  # type: ignore[arg-type]
        covariance=np.zeros((3, 3)),
    )
    settling = discretise(known.dynamics, known.sample_period).settling_samples(1e-9)
    assert settling * 5 * 8 < 300e6  # bytes of five channels


def _with(place: tuple[int, int], value: float) -> np.ndarray:  # type: ignore[type-arg]
    covariance = GOOD.covariance.copy()
    covariance[place] = covariance[place[::-1]] = value
    return covariance


@pytest.mark.parametrize(
    ("covariance", "named"),
    [
        (np.zeros((4, 4)), "shape"),
        (_with((1, 1), np.nan), "finite"),
        (_with((1, 1), -1e-14), "negative variance"),
        (GOOD.covariance + 1e-15 * np.eye(5, k=1), "symmetric"),
        (_with((1, 2), 2e-14), "negative eigenvalue"),  # a correlation of 2
        (_with((0, 1), 1e-14), "negative eigenvalue"),  # with what has no variance
        (_with((4, 4), 1e300), "uncertain by a factor"),
    ],
)
def test_what_is_no_covariance_is_refused_by_name(covariance: object, named: str) -> None:
    with pytest.raises(CalibrationError, match=named):
        changed(covariance=covariance)  # type: ignore[arg-type]


@pytest.mark.parametrize("correlation", [-1.0, -0.5, 0.0, 1.0])
def test_any_correlation_is_a_covariance(correlation: float) -> None:
    assert changed(covariance=_with((1, 2), correlation * 1e-14)) is not None


@pytest.mark.parametrize("verdict", [1, True, ["accepted"], {}, "perhaps"])
def test_a_verdict_that_is_no_text_is_refused(verdict: object) -> None:
    with pytest.raises(CalibrationError, match="verdict is"):
        changed(certificate={"verdict": verdict})


@pytest.mark.parametrize("texts", ["bad", [1], {"a": 1}])
def test_reasons_that_are_no_texts_are_refused(texts: object) -> None:
    with pytest.raises(CalibrationError, match="reasons"):
        changed(certificate={"reasons": texts})


GOOD_LATENCY = to_json(unresolved_latency(1e-4)) | {"uncertainty_s": 1e-5}


@pytest.mark.parametrize(
    ("entry", "named"),
    [
        ("late", "latency is 'late', expected an object"),
        ({"delay_s": 1e-4}, "latency.source is missing"),
        (GOOD_LATENCY | {"delay_s": -1e-3}, "latency is -0.001 s"),
        (
            GOOD_LATENCY | {"uncertainty_s": "none"},
            "latency.uncertainty_s is 'none', expected a finite number",
        ),
        (
            GOOD_LATENCY | {"unshared_s": None},
            "latency.unshared_s is None, expected a finite number",
        ),
        (GOOD_LATENCY | {"source": "hearsay"}, "latency by 'hearsay'"),
        (GOOD_LATENCY | {"source": "declared", "reason": " "}, "needs a reason"),
        (GOOD_LATENCY | {"share": "half"}, "latency.share is 'half', expected a finite number"),
    ],
)
def test_a_latency_that_no_probe_has_is_refused(entry: object, named: str) -> None:
    with pytest.raises(CalibrationError, match=named):
        changed(certificate={"latency": entry})


def test_a_latency_comes_back_as_it_was() -> None:
    found = changed(certificate={"latency": GOOD_LATENCY}).latency
    assert to_json(found) == GOOD_LATENCY


@pytest.mark.parametrize(("place", "power"), [(1, 1), (2, 1), (3, 2), (4, 1)])
@pytest.mark.parametrize("trusted", [20.0, 100.0])
def test_the_effect_of_a_coefficient_uncertainty_on_the_response_is_reported(
    place: int, power: int, trusted: float
) -> None:
    """A coefficient of s^k that is uncertain by u leaves u ω^k at the end of the trusted band."""
    deviation = 1e12
    covariance = np.zeros((5, 5))
    covariance[place, place] = deviation**2
    factor = deviation * (2 * np.pi * trusted) ** power
    with pytest.raises(CalibrationError, match="uncertain by a factor of") as refused:
        changed(covariance=covariance, valid_up_to=trusted)
    assert f"a factor of {plain(factor, 2)};" in str(refused.value)


@pytest.mark.parametrize("samples", [9_999, 10_000])
def test_the_longest_delay_is_one_of_samples(samples: int) -> None:
    for period in (1e-5, 5e-5):
        late = TransferFunction(
            GOOD.dynamics.numerator, GOOD.dynamics.denominator, samples * period
        )
        assert changed(dynamics=late, sample_period=period).dynamics.delay == samples * period
        later = TransferFunction(late.numerator, late.denominator, 1.01 * 10_000 * period)
        with pytest.raises(CalibrationError, match=r"1\.01 · 10⁴ samples of .* at most 10000"):
            changed(dynamics=later, sample_period=period)
