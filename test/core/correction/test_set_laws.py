"""Several calibrations as one: weights that add up, the worst of everything, in any order."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from certified import certified_by
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.calibration.calibration import Calibration, with_latency
from omsm_ros.core.calibration.calibration_set import (
    MOST_MEMBERS,
    CalibrationSet,
    calibration_set,
    set_from_content,
)
from omsm_ros.core.calibration.latency import declared_latency, unresolved_latency
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import CalibrationError


def member(lag: float = 3e-4, **other: object) -> Calibration:
    parts: dict[str, object] = {
        "static_gain": 0.99,
        "valid_up_to": 80.0,
        "settings": {"probe.rate": 1000},
        "certificate": certified_by({"verdict": "accepted"}),
    }
    return Calibration(
        dynamics=TransferFunction(np.array([1.0, 1e-3 - lag]), np.array([1.0, 1e-3])),
        sample_period=1e-3,
        covariance=np.zeros((4, 4)),
        **(parts | other),  # type: ignore[arg-type]
    )


def certified(**entries: object) -> Calibration:
    return member(certificate=certified_by({"verdict": "accepted", **entries}))


def together(*members: Calibration, along: str = "x") -> CalibrationSet:
    return calibration_set(along, [(0.01 * k, each) for k, each in enumerate(members)])


places = st.lists(st.integers(-500, 500), min_size=2, max_size=7, unique=True).map(
    lambda found: [1e-3 * place for place in found]
)


@settings(max_examples=40)
@given(positions=places, seed=st.integers(0, 99))
def test_weights_add_up_to_one_everywhere(positions: list[float], seed: int) -> None:
    made = calibration_set("x", [(place, member()) for place in positions])
    where = np.random.default_rng(seed).uniform(-0.6, 0.6, 200)
    weights = made.weights(where)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-12)
    assert np.all(weights >= 0)
    # Only the two nearest have a say, and between them the place itself is the mean.
    assert np.all(np.count_nonzero(weights, axis=0) <= 2)
    inside = (where > made.positions[0]) & (where < made.positions[-1])
    mean = np.array(made.positions) @ weights
    np.testing.assert_allclose(mean[inside], where[inside], atol=1e-12)
    np.testing.assert_allclose(made.weights(np.array(made.positions)), np.eye(len(positions)))


def test_a_little_beyond_the_ends_is_covered_and_more_is_not() -> None:
    made = calibration_set("z", [(0.1, member()), (0.3, member())])
    where = np.array([0.0, 0.0985, 0.1, 0.2, 0.3, 0.3015, 0.31, np.nan])
    assert made.covered(where).tolist() == [False, True, True, True, True, True, False, False]


def test_the_order_in_which_they_are_given_does_not_matter() -> None:
    three = [(0.0, member(1e-4)), (0.02, member(2e-4)), (0.05, member(4e-4))]
    sets = [calibration_set("b", list(order)) for order in permutations(three)]
    assert len({made.id for made in sets}) == 1
    assert sets[-1].positions == (0.0, 0.02, 0.05)
    # One response is that of the member nearest to the middle.
    assert sets[-1].dynamics.low_frequency_delay == pytest.approx(2e-4)


def test_a_set_is_trusted_as_far_as_its_least_member() -> None:
    made = together(member(valid_up_to=80.0), member(valid_up_to=30.0), member(valid_up_to=50.0))
    assert made.valid_up_to == 30.0


def test_gains_that_differ_are_uncertain_by_a_uniform_distribution() -> None:
    own = {"verdict": "accepted", "static_gain_uncertainty": 3e-4}
    made = together(
        member(static_gain=0.98, certificate=certified_by(own)),
        member(static_gain=1.0),
        member(static_gain=0.99),
    )
    assert made.static_gain == pytest.approx(0.99)
    expected = np.hypot(3e-4, 0.02 / np.sqrt(12))
    assert made.static_gain_uncertainty == pytest.approx(expected)


def test_the_largest_of_what_each_states_is_stated() -> None:
    made = together(
        certified(noise_m=1e-8, motion_error_m=5e-9),
        certified(noise_m=3e-8),
        certified(valid_from=0.2),
    )
    stated = made.certificate
    assert stated.residual.noise_m == 3e-8
    assert stated.model_errors.motion_error_m == 5e-9
    assert stated.validity.from_hz == 0.2
    assert together(member(), member()).certificate.residual.noise_m is None


@pytest.mark.parametrize(
    ("verdicts", "expected"),
    [
        (["accepted", "accepted"], "accepted"),
        (["accepted", "rejected", "accepted"], "rejected"),
        (["accepted with reservations"] * 2, "accepted with reservations"),
        (["accepted", None], None),
        (["rejected", None], "rejected"),
    ],
)
def test_one_that_may_not_be_used_spoils_the_set(
    verdicts: list[str | None], expected: str | None
) -> None:
    each = [member(certificate=certified_by({"verdict": v} if v else {})) for v in verdicts]
    assert together(*each).certificate.verdict == expected


def test_each_reason_is_reported_once() -> None:
    made = together(certified(reasons=["a", "b"]), certified(reasons=["b", "c"]), certified())
    assert list(map(str, made.certificate.reasons)) == ["a", "b", "c"]


@pytest.mark.parametrize("lags", [(3e-4, 1e-4), (1e-4, -3e-4), (-1e-4, -3e-4)])
def test_an_open_latency_may_be_any_part_of_the_largest_lag(lags: tuple[float, float]) -> None:
    """A lead counts too: the distance of the probe from the slides matters."""
    latency = together(*map(member, lags)).latency
    assert not latency.resolved
    assert latency.unshared_s == pytest.approx(unresolved_latency(3e-4).unshared_s)


def test_one_open_latency_leaves_that_of_the_set_open() -> None:
    known = with_latency(member(), declared_latency(3e-4, 1e-4, 1e-6, "maker"))
    assert together(known, known).latency.resolved
    assert not together(known, member()).latency.resolved


def test_latencies_that_differ_are_uncertain_by_as_much() -> None:
    delays, own = (1.0e-4, 1.3e-4, 1.1e-4), (1e-6, 4e-6, 2e-6)
    made = together(
        *(
            with_latency(member(), declared_latency(3e-4, delay, u, f"test {k % 2}"))
            for k, (delay, u) in enumerate(zip(delays, own, strict=True))
        )
    )
    found = made.latency
    assert found.delay_s == pytest.approx(np.mean(delays))
    assert found.uncertainty_s == pytest.approx(np.hypot(4e-6, 0.3e-4 / np.sqrt(12)))
    assert found.unshared_s == found.uncertainty_s
    assert found.share == pytest.approx(np.mean(delays) / 3e-4)
    assert found.reason == "test 0; test 1"


def test_a_set_comes_back_from_its_content() -> None:
    made = together(member(1e-4), member(2e-4), along="b")
    again = set_from_content(made.content(), made.members)
    assert again.id == made.id
    assert (again.along, again.positions) == (made.along, made.positions)
    assert again.certificate == made.certificate


def test_a_certificate_that_is_given_is_kept() -> None:
    given = certified_by({"verdict": "rejected", "reasons": ["by hand"]})
    assert calibration_set("x", [(0.0, member()), (0.1, member())], given).certificate == given


@pytest.mark.parametrize(
    ("one", "said"),
    [
        ({"settings": {"probe.rate": 2000}}, "settings of the members of a set is"),
        (
            {"certificate": certified_by({"verdict": "accepted", "polarity": 1})},
            "polarity of the members of a set",
        ),
    ],
)
def test_members_that_were_not_made_alike_are_refused(one: dict[str, object], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        together(member(), replace(member(), **one))  # type: ignore[arg-type]


def test_a_set_has_as_many_members_as_can_run() -> None:
    most = [(1e-3 * k, member()) for k in range(MOST_MEMBERS)]
    assert len(calibration_set("x", most).members) == MOST_MEMBERS
    with pytest.raises(CalibrationError, match=rf"expected 2 to {MOST_MEMBERS}"):
        calibration_set("x", [*most, (1.0, member())])
