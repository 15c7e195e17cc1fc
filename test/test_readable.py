"""Values and uncertainties are rounded to the same place and keep their units."""

from __future__ import annotations

import math
import re
import sys
from datetime import datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.readable import (
    NOTHING,
    column,
    count,
    date_text,
    expanded,
    figure,
    measured,
    number,
    p_value_text,
    percent,
    plain,
    probability,
    quantity,
    rounded_down,
    rounded_up,
    superscript,
)

FACTORS = {"n": 1e-9, "µ": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3, "M": 1e6}


@pytest.mark.parametrize(
    ("value", "uncertainty", "unit", "expected"),
    [
        (339.7344e-6, 1.128e-6, "s", "339.7 µs ± 1.1 µs"),
        (0.9921261096, 3.43e-6, "", "0.9921261 ± 0.0000034"),
        (246.4, 412.3, "Hz", "250 Hz ± 410 Hz"),
        (568e-9, 563e-9, "rad", "570 nrad ± 560 nrad"),
        (916.5, 1303.0, "Hz", "0.9 kHz ± 1.3 kHz"),
        (999.96e-6, 0.2e-6, "s", "999.96 µs ± 0.20 µs"),
        (-7873.9, 3.44, "", "-7873.9 ± 3.4"),
        (5.0, 0.996, "", "5.0 ± 1.0"),
        (2.2e-6, 100e-6, "s", "0 µs ± 100 µs"),
        (339.7344e-6, None, "s", "339.7 µs"),
        (339.7344e-6, 0.0, "s", "339.7 µs"),
        (0.992126, None, "", "0.9921"),
        (0.0, None, "s", "0 s"),
        (None, 1.0, "s", "–"),
        (math.nan, 1.0, "s", "–"),
        ("12", 1.0, "s", "–"),
        (True, 1.0, "s", "–"),
    ],
)
def test_reads_as_it_should(value, uncertainty, unit, expected):
    assert measured(value, uncertainty, unit) == expected


@pytest.mark.parametrize(
    ("value", "uncertainty", "signed", "expected"),
    [
        (10.9e-9, 2.23e-9, False, "10.9 nm ± 4.5 nm (k = 2)"),
        (1.0e-9, 8.4e-9, False, "at most 17.8 nm (k = 2)"),
        (-0.1e-9, 8.4e-9, False, "at most 16.8 nm (k = 2)"),
        (-0.1e-9, 8.4e-9, True, "0 nm ± 17 nm (k = 2)"),
        (10.9e-9, None, False, "10.9 nm"),
        (None, 1e-9, False, "–"),
    ],
)
def test_a_bound_is_reported_for_non_negative_quantities(value, uncertainty, signed, expected):
    assert expanded(value, uncertainty, "m", signed) == expected


def test_a_figure_has_one_name():
    assert figure("robust_peak_to_valley") == "PV of 99.5 %"
    assert figure("peak_to_valley_without_second_order") == "PV without second order"
    assert figure("iso10110_RMSi") == "ISO 10110 RMSi"


@given(
    st.floats(1e-8, 1e6) | st.floats(-1e6, -1e-8),
    st.floats(1e-8, 1e5),
    st.sampled_from(["s", "Hz", "m"]),
)
def test_what_is_read_back_is_what_was_written_within_the_uncertainty(value, uncertainty, unit):
    """Read as a reader does: number, prefix, unit."""
    text = measured(value, uncertainty, unit)
    found = re.fullmatch(rf"(-?[\d.]+) (\D?){unit} ± ([\d.]+) (\D?){unit}", text)
    assert found, text
    assert found[2] == found[4]
    scale = FACTORS[found[2]]
    # Nine decimals of the unit at most.
    rounding = 0.5e-9 * scale
    assert abs(float(found[1]) * scale - value) <= 0.0501 * uncertainty + rounding
    assert abs(float(found[3]) * scale / uncertainty - 1) <= 0.0501 + rounding / uncertainty


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [
        (1.012, 3, "1.01"),
        (1.0, 3, "1.00"),
        (0, 3, "0"),
        (123.4, 3, "123"),
        (27354.8, 3, "2.74 · 10⁴"),
        (-1858632.4, 4, "-1.859 · 10⁶"),
        (7.4834616e-4, 9, "7.48346160 · 10⁻⁴"),
        (None, 3, "–"),
        (math.inf, 3, "–"),
    ],
)
def test_plain_numbers(value, digits, expected):
    assert plain(value, digits) == expected


def test_probabilities():
    assert [probability(p) for p in (0.6677, 1.0, 3e-9, 0.0, None)] == [
        "0.668", "1", "< 0.0001", "< 0.0001", "–",
    ]  # fmt: skip


def test_only_finite_numbers_are_numbers():
    assert [number(v) for v in (1, 2.5, True, "3", None, math.nan, math.inf, [])] == [
        1.0, 2.5, None, None, None, None, None, None,
    ]  # fmt: skip


def test_powers_are_raised():
    assert superscript(-12) == "⁻¹²"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (83.14e-9, "83.1 nm"),
        (8.949e-6, "8.95 µm"),
        (178.9e-9, "179 nm"),
        (999.96e-9, "1.00 µm"),
        (-2.5e-6, "-2.50 µm"),
        (0.314e-9, "0.314 nm"),
        (12.7e-3, "12.7 mm"),
        (1.0, "1.00 m"),
        (0.0, "0 nm"),
        (3, "3.00 m"),
    ],
)
def test_a_length_has_three_digits_and_its_prefix(value, text):
    assert quantity(value, "m") == text


@pytest.mark.parametrize("value", [None, float("nan"), float("inf"), "5", True])
def test_what_is_no_number_is_a_dash(value):
    assert quantity(value, "m") == NOTHING
    assert count(value) == NOTHING


@given(st.floats(1e-4, 1e8) | st.floats(-1e8, -1e-4))
def test_a_quantity_reads_back(value):
    number, unit = quantity(value, "Hz").split(" ")
    assert float(number) * FACTORS[unit.removesuffix("Hz")] == pytest.approx(value, rel=5.1e-3)
    assert len(number.strip("-").replace(".", "").lstrip("0")) == 3


def test_a_count_has_its_thousands_apart():
    assert count(254000) == "254 000"
    assert count(0) == "0"


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (1500.0, "kg", "1500 kg"),
        (0.25, "kg", "0.250 kg"),
        (-1850.4, "ppm", "-1850 ppm"),
        (0.5, "", "0.500"),
        (0.0, "°", "0 °"),
        (0.0154, "Hz", "0.0154 Hz"),
    ],
)
def test_what_takes_no_prefix(value, unit, text):
    assert quantity(value, unit) == text


def test_a_change_has_its_sign():
    assert quantity(2.5e-6, "s", signed=True) == "+2.50 µs"
    assert quantity(-2.5e-6, "s", signed=True) == "-2.50 µs"
    assert quantity(0.0, "s", signed=True) == "0 s"


@pytest.mark.parametrize(
    ("share", "digits", "text"),
    [(0.0012, 2, "0.12 %"), (1.5, 2, "150 %"), (0.99996, 4, "100.0 %"), (None, 2, "–")],
)
def test_a_share_in_per_cent(share, digits, text):
    assert percent(share, digits) == text


def test_a_chance_in_a_sentence():
    assert p_value_text(0.234567) == "p = 0.235"
    assert p_value_text(1e-300) == "p < 0.0001"


def test_a_moment_is_given_in_utc():
    summer = timezone(timedelta(hours=2))
    assert date_text(datetime(2026, 7, 1, 1, 30, tzinfo=summer)) == "2026-06-30 23:30 UTC"


def test_the_largest_of_all_numbers_is_shown_and_not_rounded_up_to_infinity():
    largest = sys.float_info.max
    for text in (quantity(largest, "m"), measured(1.0, largest, "m"), percent(largest)):
        assert "inf" not in text


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (3.19e-13, "m", "0.000319 nm"),
        (-2.49e-14, "m", "> -0.0001 nm"),
        (5.5e-14, "%", "< 0.0001 %"),
        (3.1e-20, "rad", "< 0.0001 nrad"),
    ],
)
def test_no_row_of_zeros_has_to_be_counted(value, unit, expected):
    assert quantity(value, unit) == expected


def test_a_column_has_one_unit_and_the_decimals_of_its_largest():
    rows = column([11.54e-9, 2.72e-9, 1.95e-11, 0.0, None], "m")
    assert rows == ["11.5 nm", "2.7 nm", "< 0.1 nm", "none", "–"]
    assert column([1.2e-6, 3e-9], "m") == ["1.20 µm", "< 0.01 µm"]
    assert column([0.0, None], "m") == ["none", "–"]


def test_a_small_number_without_prefix_has_the_power_of_its_uncertainty():
    assert measured(6.43e-6, 7.7e-6) == "6.4 · 10⁻⁶ ± 7.7 · 10⁻⁶"
    assert measured(1.49e-8, 1.1e-9, "s²") == "1.49 · 10⁻⁸ s² ± 0.11 · 10⁻⁸ s²"


@pytest.mark.parametrize(
    ("value", "digits", "down", "up"),
    [(1.028, 2, 1.0, 1.1), (1.0, 2, 1.0, 1.0), (0.4417, 3, 0.441, 0.442), (99.99, 2, 99, 100)],
)
def test_advice_is_rounded_to_the_safe_side(value, digits, down, up):
    assert rounded_down(value, digits) == pytest.approx(down)
    assert rounded_up(value, digits) == pytest.approx(up)
