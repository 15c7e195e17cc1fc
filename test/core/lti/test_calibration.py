"""A calibration: its identity, its two covariances, and what it refuses to be."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.adjustment.resolved_calibration import after_step_test
from omsm_ros.core.calibration.calibration import (
    Calibration,
    age_at,
    content_id,
    settings_with,
    with_latency,
)
from omsm_ros.core.calibration.calibration_set import calibration_set
from omsm_ros.core.calibration.certificate import Certificate, from_json, to_json
from omsm_ros.core.calibration.latency import Latency, declared_latency, unresolved_latency
from omsm_ros.core.calibration.repeatability import compare_calibrations
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import CalibrationError, ConfigurationError

LAG_U = 2e-6
WHOLE = np.diag([0.0, LAG_U**2, 0.0])


def made(**parts: object) -> Calibration:
    stated: dict[str, object] = {
        "dynamics": TransferFunction(np.ones(1), np.array([1.0, 3e-4])),
        "static_gain": 0.99,
        "sample_period": 1e-3,
        "valid_up_to": 60.0,
        "covariance": WHOLE,
        "settings": {"probe.rate": 1000, "fixture": "A"},
        "certificate": certified_by({"verdict": "accepted"}),
    }
    return Calibration(**(stated | parts))  # type: ignore[arg-type]


def certified(**entries: object) -> Calibration:
    return made(certificate=certified_by({"verdict": "accepted", **entries}))


def flat(matrix: FloatArray) -> list[float]:
    return [float(value) for value in matrix.ravel()]


def test_content_goes_out_and_comes_back_as_json() -> None:
    calibration = made()
    again = Calibration.from_content(json.loads(json.dumps(calibration.content())))
    assert again.id == calibration.id
    assert again.content() == calibration.content()


def test_the_id_is_that_of_the_canonical_text() -> None:
    content = {"b": [1.0, 0.1], "a": {"y": 2, "x": "µ"}}
    text = r'{"a":{"x":"\u00b5","y":2},"b":[1.0,0.1]}'
    assert content_id(content) == hashlib.sha256(text.encode()).hexdigest()
    assert content_id(dict(reversed(content.items()))) == content_id(content)


def test_every_part_is_in_the_id() -> None:
    other = TransferFunction(np.ones(1), np.array([1.0, 3.0000001e-4]))
    changed = [
        made(dynamics=other),
        made(dynamics=TransferFunction(np.ones(1), np.array([1.0, 3e-4]), 1e-9)),
        made(static_gain=0.9900000001),
        made(sample_period=1.0000001e-3),
        made(valid_up_to=60.1),
        made(covariance=WHOLE * 1.000001),
        made(settings={"fixture": "B"}),
        certified(reasons=["none"]),
    ]
    assert len({made().id, *(c.id for c in changed)}) == 1 + len(changed)


def test_order_of_settings_is_not_in_the_id() -> None:
    assert made(settings={"fixture": "A", "probe.rate": 1000}).id == made().id


@pytest.mark.parametrize(
    ("part", "value", "said"),
    [
        ("static_gain", 0.0, "static_gain is 0.0"),
        ("sample_period", -1e-3, "sample_period is -0.001"),
        ("valid_up_to", float("nan"), "valid_up_to is nan"),
        ("covariance", np.zeros((2, 2)), r"covariance of shape \(2, 2\), expected \(3, 3\)"),
        ("covariance", np.full((3, 3), np.inf), r"expected \(3, 3\) finite"),
        ("dynamics", TransferFunction(np.ones(1), np.array([1.0, -3e-4])), "G_m is unstable"),
    ],
)
def test_a_part_that_cannot_be_is_named(part: str, value: object, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        made(**{part: value})


def test_without_a_word_all_of_the_covariance_is_noise() -> None:
    calibration = made()
    assert np.array_equal(calibration.noise_covariance, WHOLE)
    assert not np.any(calibration.undetected_error_covariance)
    assert calibration.low_frequency_delay_noise == pytest.approx(LAG_U)
    assert calibration.low_frequency_delay_uncertainty == pytest.approx(LAG_U)


@pytest.mark.parametrize(
    "stated",
    ["0 0 0", ["0"] * 9, [True] * 9, [[0.0] * 3] * 3],
    ids=["text", "texts", "truths", "nested"],
)
def test_noise_that_is_none_is_refused(stated: object) -> None:
    with pytest.raises(CalibrationError, match="noise_covariance"):
        certified(noise_covariance=stated)


def test_noise_of_another_size_is_not_used() -> None:
    assert np.array_equal(certified(noise_covariance=[0.0] * 8).noise_covariance, WHOLE)


def test_noise_and_undetected_error_make_the_whole() -> None:
    noise = np.diag([0.0, (0.6 * LAG_U) ** 2, 0.0])
    calibration = certified(noise_covariance=flat(noise))
    assert np.array_equal(calibration.noise_covariance, noise)
    assert np.allclose(calibration.undetected_error_covariance + noise, WHOLE, rtol=1e-12, atol=0)
    assert calibration.low_frequency_delay_noise == pytest.approx(0.6 * LAG_U)
    # Repeated tests scatter by their noise, but a scan pays for both.
    assert calibration.low_frequency_delay_uncertainty == pytest.approx(LAG_U)


def test_a_difference_of_covariances_that_is_none_masks_nothing() -> None:
    """Correlated more than the whole: along one direction less than nothing would be left."""
    whole = np.zeros((4, 4))
    whole[1:3, 1:3] = [[1e-12, 0.0], [0.0, 1e-6]]
    noise = np.zeros((4, 4))
    noise[1:3, 1:3] = [[0.9e-12, 0.5e-9], [0.5e-9, 0.9e-6]]
    two = TransferFunction(np.ones(1), np.array([1.0, 3e-4, 2e-8]))
    stated = {"noise_covariance": flat(noise)}
    calibration = made(dynamics=two, covariance=whole, certificate=certified_by(stated))
    assert np.array_equal(calibration.noise_covariance, noise)
    assert not np.any(calibration.undetected_error_covariance)


@pytest.mark.parametrize(
    ("recorded", "moment", "age"),
    [
        (1_000_000_000, 4_500_000_000, 3.5),
        (4_500_000_000, 1_000_000_000, -3.5),
        (None, 1, None),
        (1, None, None),
    ],
)
def test_age_is_known_where_both_moments_are(
    recorded: object, moment: int | None, age: float | None
) -> None:
    assert age_at(certified(recorded_ns=recorded), moment) == age
    assert age_at(made(), moment) is None


def test_a_verdict_is_read_with_its_reasons() -> None:
    found = certified(reasons=["too short", "too quiet"]).certificate
    assert found.verdict == "accepted"
    assert list(map(str, found.reasons)) == ["too short", "too quiet"]
    assert made(certificate=Certificate()).certificate.verdict is None
    with pytest.raises(CalibrationError, match="reasons is 'too short'"):
        certified(reasons="too short")


def test_settings_as_stated_come_with_those_of_the_probe() -> None:
    stated = {"fixture": "A", "probe.rate": 1000}
    merged = settings_with(stated, [{"probe.rate": 1000, "probe.lamp": 40}, {"probe.lamp": 40}])
    assert merged == {"fixture": "A", "probe.rate": 1000, "probe.lamp": 40}
    assert stated == {"fixture": "A", "probe.rate": 1000}
    assert settings_with(stated, []) == stated


@pytest.mark.parametrize(
    ("stated", "probe"),
    [
        ({"probe.lamp": 40}, [{"probe.lamp": 60}]),
        ({}, [{"probe.lamp": 40}, {"probe.rate": 1}, {"probe.lamp": 60}]),
    ],
)
def test_settings_that_changed_meanwhile_are_refused(
    stated: dict[str, object], probe: list[dict[str, object]]
) -> None:
    with pytest.raises(CalibrationError, match=r"setting probe\.lamp is 40, then 60"):
        settings_with(stated, probe)


def test_static_gain_is_as_uncertain_as_stated() -> None:
    assert made().static_gain_uncertainty == 0.0
    assert certified(static_gain_uncertainty=3e-5).static_gain_uncertainty == 3e-5


USES: dict[str, Callable[[Calibration], object]] = {
    "correction": ErrorSources.of,
    "comparison": lambda c: compare_calibrations(made(), c),
    "self-calibration": after_step_test,
    "set": lambda c: calibration_set("x", [(0.0, c), (1e-3, c)]),
}


@pytest.mark.parametrize(
    ("use", "stated"),
    [*((use, -1e-5) for use in USES), *(("set", v) for v in ("1e-5", float("nan"), [1e-5], True))],
)
def test_an_uncertainty_that_is_none_is_named_by_all(use: str, stated: object) -> None:
    with pytest.raises(CalibrationError, match=r"static_gain[._]uncertainty is"):
        USES[use](certified(static_gain_uncertainty=stated))


@settings(max_examples=30)
@given(
    lag=st.floats(1e-6, 1e-2),
    share=st.floats(0.0, 1.0, allow_subnormal=False),
    u=st.floats(0.0, 1e-3),
)
def test_a_declared_latency_is_read_back_as_it_was_stated(
    lag: float, share: float, u: float
) -> None:
    stated = declared_latency(lag, share * lag, u, "data sheet")
    found = with_latency(made(), stated).latency
    assert found == stated == from_json(Latency, json.loads(json.dumps(to_json(stated))), "latency")
    assert found.share == pytest.approx(share, rel=1e-6, abs=0)
    assert found.unshared_s == found.uncertainty_s == u


def test_declaring_a_latency_leaves_all_else() -> None:
    before = certified(reasons=["none"])
    after = with_latency(before, declared_latency(3e-4, 1e-4, 1e-6, "data sheet"))
    assert replace(after.certificate, latency=None) == before.certificate
    assert replace(after, certificate=before.certificate).id == before.id
    assert before.certificate.latency is None


def test_a_lead_leaves_as_much_open_as_a_lag() -> None:
    assert unresolved_latency(-3e-4).unshared_s == unresolved_latency(3e-4).unshared_s
    assert declared_latency(0.0, 1e-4, 1e-6, "data sheet").share is None


ENTRY = to_json(declared_latency(3e-4, 1e-4, 1e-6, "data sheet"))


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ([1], "latency is .1., expected an object"),
        ({k: v for k, v in ENTRY.items() if k != "source"}, "latency.source is missing"),
        (ENTRY | {"colour": "red"}, "latency.colour is not known"),
        (ENTRY | {"source": "guess"}, "latency by 'guess', expected one of unresolved"),
        (ENTRY | {"delay_s": -1.0}, "latency is -1.0 s"),
        (ENTRY | {"delay_s": "1"}, "latency.delay_s is '1'"),
        (ENTRY | {"share": "half"}, "latency.share is 'half'"),
        (ENTRY | {"reason": 5}, "latency.reason is 5, expected a text"),
        (ENTRY | {"reason": " "}, "needs a reason"),
        (ENTRY | {"uncertainty_s": -1.0}, "latency is -1.0 s"),
        (ENTRY | {"unshared_s": None}, "latency.unshared_s is None"),
    ],
)
def test_an_entry_that_is_no_latency_is_named(entry: object, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        _ = certified(latency=entry).latency


def test_a_latency_that_is_typed_is_the_callers_to_correct() -> None:
    with pytest.raises(ConfigurationError, match="share of the latency"):
        Latency(
            delay_s=1e-4, uncertainty_s=None, unshared_s=0.0, share=float("nan"),
            source="declared", reason="typed",
        )  # fmt: skip
