"""Needed measurements and reported figures of lines, against values computed by hand."""

import pytest
from even_scans import NM, line, scan, seen_by

from omsm_ros.core.ripple.ripple_guard import name_lines
from omsm_ros.core.ripple.scan_signal import PATH, TURN
from omsm_ros.core.ripple.source_hypotheses import PART, SYNCHRONOUS, UNDECIDED, VIBRATION


def test_a_line_sharp_in_one_coordinate_is_reported_in_its_unit():
    one = scan(path_like=PATH)
    one.lines = (line(2500.0, coordinate=PATH), line(123.4), line(7.0, coordinate=TURN))
    ((mark, shake, order),) = name_lines([one])
    assert (mark.kind, mark.wavelength) == (PART, pytest.approx(400e-6))
    assert (order.kind, order.order) == (SYNCHRONOUS, 7)
    assert (shake.kind, shake.frequency) == (VIBRATION, None)
    assert "7 waves a turn" in str(order.evidence[0])
    assert "itself or the alias of 876.600 Hz, 1.12340 kHz" in str(shake.evidence[1])


def test_rings_and_spindle_at_one_feed_a_turn_need_another_feed():
    """31 waves a turn are rings of 2.42 µm in both: 75 µm a turn."""
    scans = [
        scan(name="A", turning=0.5, feed=0.75e-4),
        scan(name="B", turning=0.83, pace=0.067, feed=0.75e-4),
    ]
    for one in scans:
        one.lines = (seen_by(one, "c", 31, 4 * NM),)
    (first,), (second,) = name_lines(scans)
    for row in (first, second):
        assert (row.kind, str(row.needs)) == (UNDECIDED, "needs a scan with another feed per turn")


def test_with_another_feed_the_spindle_is_known():
    scans = [
        scan(name="A", turning=0.5, feed=0.75e-4),
        scan(name="B", turning=0.83, pace=0.067, feed=0.9e-4),
    ]
    for one in scans:
        one.lines = (seen_by(one, "c", 31, 4 * NM),)
    (first,), (second,) = name_lines(scans)
    for row in (first, second):
        assert (row.kind, row.order, row.needs) == (SYNCHRONOUS, 31, None)
