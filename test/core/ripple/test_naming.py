"""Sources of lines, for scans with lines placed by the truth instead of by a fit of heights."""

import re

import numpy as np
import pytest
from even_scans import NM, aliased, line, scan, seen_by

from omsm_ros.core.ripple.accelerometer import AccelerationLine, AccelerationLines
from omsm_ros.core.ripple.ripple_guard import name_lines
from omsm_ros.core.ripple.scan_signal import PATH, TIME, TURN
from omsm_ros.core.ripple.source_hypotheses import (
    ALIASED,
    ARTEFACT,
    PART,
    SYNCHRONOUS,
    UNDECIDED,
    VIBRATION,
)


def machine(*scans, waves):
    """Give each of ``scans`` the lines of ``waves`` (over, frequency, amplitude) that it shows."""
    for one in scans:
        one.lines = tuple(seen_by(one, *wave) for wave in waves)
    return scans


def kinds(*scans):
    return [[row.kind for row in rows] for rows in name_lines(scans)]


def two(**options):
    return scan(name="A"), scan(name="B", pace=0.067, turning=0.83, feed=0.7e-4, **options)


ONE_OF_EACH = [("t", 123.4, 4 * NM), ("s", 1500.0, 6 * NM), ("r", 9e4, 5 * NM), ("c", 31, 4 * NM)]


class TestOfTwoScans:
    def test_marks_rings_vibration_and_spindle_are_distinguished(self):
        truth = [VIBRATION, PART, PART, SYNCHRONOUS]
        first, second = name_lines(machine(*two(), waves=ONE_OF_EACH))
        for rows in (first, second):
            assert [row.kind for row in rows] == truth
            assert rows[1].wavelength == pytest.approx(1 / 1500.0)
            assert rows[2].wavelength == pytest.approx(1 / 9e4)
            assert "along the path" in str(rows[1].evidence[0])
            assert "from ring to ring" in str(rows[2].evidence[0])
            assert rows[3].order == 31
            assert rows[0].frequency is None

    def test_the_order_of_the_scans_and_of_their_lines_makes_no_difference(self):
        a, b = machine(*two(), waves=ONE_OF_EACH)
        expected = dict(zip([one.frequency for one in a.lines], kinds(a, b)[0], strict=True))
        a.lines, b.lines = a.lines[::-1], b.lines[2:] + b.lines[:2]
        found = kinds(b, a)[1]
        assert dict(zip([one.frequency for one in a.lines], found, strict=True)) == expected

    @pytest.mark.parametrize("rate", [1000.0, 900.0])
    def test_none_of_many_drawn_machines_is_named_wrongly(self, rate):
        """Five waves each, none nearer to another than 0.3 Hz in either scan."""
        rng = np.random.default_rng(11)
        right = named = 0
        for _ in range(18):
            waves = [
                ("t", rng.uniform(20, 450), 5 * NM),
                ("t", rng.uniform(20, 450), 5 * NM),
                ("s", rng.uniform(300, 6000), 5 * NM),
                ("r", rng.uniform(5e4, 4e5), 5 * NM),
                ("c", int(rng.integers(21, 300)), 5 * NM),
            ]
            scans = machine(*two(rate=rate), waves=waves)
            places = [sorted(one.frequency for one in s.lines) for s in scans]
            if min(np.min(np.diff(p)) for p in places) < 0.3:
                continue
            truth = [VIBRATION, VIBRATION, PART, PART, SYNCHRONOUS]
            for found in kinds(*scans):
                named += len(truth)
                right += sum(f == t for f, t in zip(found, truth, strict=True))
                assert all(f in (t, UNDECIDED) for f, t in zip(found, truth, strict=True))
        assert named > 100
        assert right > 0.9 * named

    def test_another_rate_tells_a_vibration_from_its_images(self):
        scans = machine(*two(rate=900.0), waves=[("t", 680.0, 4 * NM), ("t", 77.7, 4 * NM)])
        for one, rows in zip(scans, name_lines(scans), strict=True):
            assert [row.kind for row in rows] == [ALIASED, VIBRATION]
            assert rows[0].frequency == pytest.approx(680.0, abs=0.1)
            assert rows[1].frequency == pytest.approx(77.7, abs=0.1)
            assert rows[0].line.frequency == pytest.approx(aliased(680.0, one.signal.rate))

    def test_a_third_scan_tells_the_first_two_which_image_it_is(self):
        third = scan(name="C", rate=1300.0, pace=0.02, turning=0.31)
        scans = machine(*two(), third, waves=[("t", 680.0, 4 * NM)])
        (first,), (second,), (last,) = name_lines(scans)
        for row in (first, second, last):
            assert row.kind == ALIASED
            assert row.frequency == pytest.approx(680.0, abs=0.1)

    def test_a_texture_that_the_slow_scan_resolves_is_an_artefact_in_the_fast_one(self):
        slow, fast = scan(name="S", pace=0.004, turning=0.03), scan(name="F", pace=0.0567)
        wave = ("s", 10_700.0, 20 * NM)
        (resolved,), (image,) = name_lines(machine(slow, fast, waves=[wave]))
        assert resolved.kind == PART
        assert image.kind == ARTEFACT
        assert image.wavelength == pytest.approx(1 / 10_700.0)
        assert "S resolves a texture of 93.46 µm" in str(image.evidence[0])
        assert image.line.frequency == pytest.approx(aliased(10_700 * 0.0567, 1000.0))

    def test_on_one_circle_the_spindle_is_named_with_what_looks_the_same(self):
        """Waves of the path come as often a turn there, so they are no other explanation."""
        around = 2 * np.pi * 21.6e-3
        scans = [
            scan(name=name, turning=turning, pace=around * turning, feed=0.0, on_circle=True)
            for name, turning in (("A", 0.5), ("B", 0.83))
        ]
        (first,), (second,) = name_lines(machine(*scans, waves=[("c", 31, 4 * NM)]))
        for row in (first, second):
            assert (row.kind, row.order) == (SYNCHRONOUS, 31)
            assert "on one circle a form error of the part of that order" in str(row.evidence[1])

    def test_harmonics_at_twice_the_speed_are_no_vibration(self):
        """The second wave of the slow scan is where the first of the fast one is."""
        scans = scan(name="A"), scan(name="B", pace=0.08, turning=0.83, feed=0.7e-4)
        waves = [("s", 1500.0 * n, 20 * NM / n**2) for n in (1, 2, 3, 4)]
        first, second = name_lines(machine(*scans, waves=waves))
        for rows in (first, second):
            assert [row.kind for row in rows] == [PART] * 4
            assert [row.wavelength for row in rows] == pytest.approx(
                [1 / 1500 / n for n in (1, 2, 3, 4)]
            )

    def test_a_vibration_where_marks_of_another_size_are_in_the_other_scan(self):
        scans = scan(name="A"), scan(name="B", pace=0.08, turning=0.83, feed=0.7e-4)
        waves = [("s", 1500.0, 30 * NM), ("t", 240.0, 4 * NM), ("t", 333.3, 4 * NM)]
        assert kinds(*machine(*scans, waves=waves)) == [[PART, VIBRATION, VIBRATION]] * 2

    @pytest.mark.parametrize("frequency", [620.0, 1210.0, 137.0])
    def test_of_the_images_of_a_vibration_it_is_the_one_that_most_scans_have(self, frequency):
        paces = ((1000.0, 0.04, 0.5), (900.0, 0.067, 0.83), (1300.0, 0.021, 0.31))
        scans = [
            scan(name=str(k), rate=rate, pace=pace, turning=turning)
            for k, (rate, pace, turning) in enumerate(paces)
        ]
        for one, (row,) in zip(
            scans, name_lines(machine(*scans, waves=[("t", frequency, 4 * NM)])), strict=True
        ):
            assert row.frequency == pytest.approx(frequency, abs=0.1)
            assert row.kind == (ALIASED if frequency > one.signal.rate / 2 else VIBRATION)

    @pytest.mark.parametrize(
        ("rings", "missed"), [((4e-3, 1e-3), True), ((7e-3, 5.05e-3), False), ((5e-3, 4e-3), True)]
    )
    def test_marks_can_be_missing_only_on_rings_that_both_scans_have(self, rings, missed):
        a = scan(name="A", rings=(4.9e-3, 2e-3))
        b = scan(name="B", pace=0.067, turning=0.83, feed=0.7e-4, rings=rings)
        machine(a, b, waves=[("s", 1500.0, 6 * NM)])
        b.lines = ()
        ((row,), ()) = name_lines([a, b])
        assert ("not on the part: missing in B" in map(str, row.evidence)) == missed


class TestOfOneScan:
    def test_it_tells_nothing_and_says_what_would(self):
        (rows,) = name_lines(machine(scan(), waves=ONE_OF_EACH))
        assert len(rows) == len(ONE_OF_EACH)
        for row in rows:
            assert row.kind == UNDECIDED
            assert str(row.needs).startswith(
                "needs a second scan of the part at another speed or feed"
            )

    def test_twice_the_same_tells_no_more(self):
        found = kinds(*machine(scan(), scan(name="B"), waves=ONE_OF_EACH))
        assert found == [[UNDECIDED] * len(ONE_OF_EACH)] * 2

    def test_what_is_sharp_in_one_coordinate_alone_is_known_by_that(self):
        one = scan(path_like=PATH)
        one.lines = (line(2500.0, coordinate=PATH), line(123.4), line(7.0, coordinate=TURN))
        assert kinds(one)[0] == [PART, VIBRATION, SYNCHRONOUS]

    def test_a_line_that_another_scan_would_have_to_show_is_not_on_the_part(self):
        a, b = machine(*two(), waves=[("s", 1500.0, 6 * NM)])
        b.lines = ()
        (row,), () = name_lines((a, b))
        assert row.kind == UNDECIDED
        assert "not on the part: missing in B" in map(str, row.evidence)


class TestCoincidences:
    @pytest.mark.parametrize(("mark", "shake"), [(9.0, 3.6), (7.0, 4.0), (4.0, 7.0), (3.6, 9.0)])
    def test_two_sources_of_one_line_are_named_after_the_stronger_and_both_reported(
        self, mark, shake
    ):
        """By how strong each is in the scan that shows it alone."""
        marks, hum = 1500.0, 1500.0 * 0.04
        a, b = machine(*two(), waves=[("s", marks, mark * NM), ("t", hum, shake * NM)])
        a.lines = (seen_by(a, "s", marks, 12 * NM),)
        (both,), (on_part, vibration) = name_lines((a, b))
        assert (on_part.kind, vibration.kind) == (PART, VIBRATION)
        assert not on_part.also
        expected = (PART, VIBRATION) if mark > shake else (VIBRATION, PART)
        assert (both.kind, both.also) == expected
        assert f"a line that is {expected[1]}" in str(both.evidence[-1])
        sizes = re.findall(r"has ([\d.]+) nm, the other ([\d.]+) nm", str(both.evidence[-1]))
        # Averaging over a sample attenuates the marks by 1.6 %.
        assert [float(size) for size in sizes[0]] == pytest.approx(
            [max(mark, shake), min(mark, shake)], rel=0.02
        )

    def test_a_line_of_its_partners_size_is_explained_by_it_and_by_nothing_besides(self):
        """In the slow scan the vibration is at the second wave of the marks; there it is alone."""
        a, b = two()
        waves = [("s", 1500.0, 9 * NM), ("s", 3000.0, 9 * NM)]
        machine(a, b, waves=waves)
        first, second = name_lines((a, b))
        for rows in (first, second):
            assert [(row.kind, row.also) for row in rows] == [(PART, "")] * 2


def feels(*lines, rate=4000.0):
    """Return the lines of an accelerometer for (frequency, motion [m]) along z."""
    return AccelerationLines(
        lines=tuple(
            AccelerationLine(
                axis="z", frequency=f, frequency_uncertainty=1e-4,
                acceleration=a * (2 * np.pi * f) ** 2, significance=20.0,
            )
            for f, a in lines
        ),
        highest=rate / 2,
        duration=20.0,
    )  # fmt: skip


class TestAccelerometerLines:
    @pytest.mark.parametrize(("frequency", "kind"), [(123.4, VIBRATION), (680.0, ALIASED)])
    def test_what_the_accelerometer_feels_is_known_from_one_scan(self, frequency, kind):
        one = scan(acceleration_lines=feels((frequency, 4 * NM)))
        ((row,),) = name_lines(machine(one, waves=[("t", frequency, 4 * NM)]))
        assert (row.kind, row.frequency) == (kind, frequency)
        assert "along z" in str(row.evidence[0])
        assert "4.00 nm of motion" in str(row.evidence[0])
        assert len(row.evidence) == (2 if kind == ALIASED else 1)

    @pytest.mark.parametrize("moved", [0.03 * NM, 400 * NM])
    def test_a_motion_of_quite_another_size_explains_nothing(self, moved):
        one = scan(acceleration_lines=feels((123.4, moved)))
        assert kinds(*machine(one, waves=[("t", 123.4, 4 * NM)])) == [[UNDECIDED]]

    def test_of_two_that_would_be_seen_there_it_is_the_one_of_its_size(self):
        one = scan(acceleration_lines=feels((320.0, 30 * NM), (680.0, 4 * NM)))
        ((row,),) = name_lines(machine(one, waves=[("t", 680.0, 4 * NM)]))
        assert (row.kind, row.frequency) == (ALIASED, 680.0)

    def test_one_that_is_off_by_more_than_a_resolution_is_another(self):
        for off, kind in ((0.04, VIBRATION), (0.06, UNDECIDED)):
            one = scan(acceleration_lines=feels((123.4 + off, 4 * NM)))
            assert kinds(*machine(one, waves=[("t", 123.4, 4 * NM)])) == [[kind]]

    def test_many_acceleration_lines_must_agree_four_times_as_well(self):
        """With 600 lines over 500 Hz one lies within a resolution of any frequency by chance."""
        many = [(2.0 + 0.8 * k, 4 * NM) for k in range(600)]
        for off, kind in ((0.012, VIBRATION), (0.03, UNDECIDED)):
            near = [f for f in many if abs(aliased(f[0], 1000.0) - 123.4) > 1.0]
            one = scan(acceleration_lines=feels(*near, (123.4 + off, 4 * NM)))
            assert kinds(*machine(one, waves=[("t", 123.4, 4 * NM)])) == [[kind]]

    def test_marks_that_a_weak_vibration_coincides_with_stay_marks(self):
        a, b = machine(*two(), waves=[("s", 1500.0, 9 * NM)])
        a.acceleration_lines = feels((1500.0 * 0.04, 1 * NM))
        (mark,), (other,) = name_lines((a, b))
        assert (mark.kind, mark.also) == (PART, VIBRATION)
        assert other.kind == PART
        a.acceleration_lines = feels((1500.0 * 0.04, 30 * NM))
        (shaken,), _ = name_lines((a, b))
        assert (shaken.kind, shaken.also) == (VIBRATION, PART)


def test_without_lines_nothing_is_said():
    assert name_lines([scan(), scan(name="B")]) == [[], []]
    assert name_lines([]) == []


def test_time_alone_is_a_coordinate_of_a_probe_at_rest():
    """Nothing moves, so nothing says that it is not on the part."""
    still = scan()
    still.coordinates = {TIME: still.coordinates[TIME]}
    still.lines = (line(50.0),)
    ((row,),) = name_lines([still])
    assert row.kind == UNDECIDED
