"""Typesetting of a page changes numbers only."""

from __future__ import annotations

import pytest

from omsm_ros.report.page_parts import picture, typeset


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("339.7 µs ± 1.1 µs", "339.7_µs ± 1.1_µs"),
        ("-2.50 µm", "−2.50_µm"),
        ("254 000 samples", "254_000 samples"),
        ("0.12 %", "0.12_%"),
        ("-7.9 · 10⁶", "−7.9_·_10⁶"),
        ("15 nm (k = 2)", "15_nm (k_=_2)"),
        ("drift of 3 nm/s", "drift of 3_nm/s"),
    ],
)
def test_a_number_stays_with_its_unit(text, printed):
    assert typeset(text).replace("\N{NARROW NO-BREAK SPACE}", "_") == printed


@pytest.mark.parametrize(
    "text",
    ["2026-11-21 18:09 UTC", "1e-9", "steps-2.mcap", "3 metres", "--dwell 5", "10 steps up", ""],
)
def test_what_is_no_number_with_a_unit_stays(text):
    assert typeset(text) == text


def test_a_picture_is_left_alone():
    assert picture(b"\x89PNG") == "iVBORw=="
