"""The table of what may come from outside."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros import quantities
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.quantities import Quantity

TABLE = [q for q in vars(quantities).values() if isinstance(q, Quantity)]
ANYTHING = st.one_of(
    st.floats(),
    st.integers(),
    st.booleans(),
    st.none(),
    st.text(),
    st.lists(st.floats()),
    st.just(10**400),
    st.just(10**5000),
    st.just(np.float64(1e-3)),
    st.just(np.int64(3)),
)


@given(st.sampled_from(TABLE), ANYTHING)
def test_a_value_is_in_its_range_or_refused_on_one_line(quantity: Quantity, value: object) -> None:
    try:
        number = quantity.checked(value, ConfigurationError, "thing")
    except ConfigurationError as err:
        text = str(err)
        assert text.startswith("thing is ")
        assert quantity.remedy in text
        assert len(text) < 300
        assert "\n" not in text
    else:
        assert number == value
        assert quantity.low <= (abs(number) if quantity.signed else number) <= quantity.high
        assert type(number) in ((int,) if quantity.whole else (float, np.float64))


@given(st.lists(st.floats(), min_size=1, max_size=50))
def test_what_is_not_plausible_is_lost_and_nothing_else(values: list[float]) -> None:
    given_ = np.array(values)
    with np.errstate(all="ignore"):
        kept = quantities.POSITION.nan_if_implausible(given_)
    for before, after in zip(values, kept.tolist(), strict=True):
        plausible = math.isfinite(before) and abs(before) <= 100
        assert after == before if plausible else math.isnan(after)


def test_the_first_wrong_value_of_an_array_is_named() -> None:
    z = np.array([1.0, -100.0, 100.0, 100.1, np.nan])
    with pytest.raises(DataError, match=r"^z\[3\] is 100.1 m, .*; give it in metres$"):
        quantities.POSITION.checked_all(z, name="z")
    assert quantities.POSITION.checked_all(z[:3]) is not None


def test_either_sign_may_stand_before_a_signed_quantity() -> None:
    assert quantities.RADIUS.checked(-0.1) == -0.1
    with pytest.raises(DataError, match=r"from ±1e-06 to ±1e\+10 m"):
        quantities.RADIUS.checked(0.0)


def test_every_row_says_what_it_is() -> None:
    assert all(q.name and q.remedy for q in TABLE)
    assert not [q.name for q in TABLE if not -math.inf < q.low < q.high < math.inf]
