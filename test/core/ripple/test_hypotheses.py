"""Where a line would be in another scan: places by folding written out, and what would show it."""

import numpy as np
import pytest
from even_scans import NM, aliased, line, scan
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.ripple.scan_signal import PATH, RADIUS, TIME, TURN
from omsm_ros.core.ripple.source_hypotheses import (
    HIGHEST_SYNCHRONOUS,
    PART,
    SYNCHRONOUS,
    VIBRATION,
    ExpectedLine,
    SourceHypothesis,
    apart,
    chance_probability,
    hypotheses_of,
    is_detected,
    lines_at,
    place_in,
    spread_of,
    whole_order,
)


class TestWhatALineMayBe:
    def test_a_line_over_time_is_any_vibration_that_folds_to_it(self):
        found = list(hypotheses_of(scan(), line(320.0)))
        assert {h.kind for h in found} == {VIBRATION}
        assert sorted(h.frequency for h in found)[:4] == [320.0, 680.0, 1320.0, 1680.0]
        assert len(found) == len({h.frequency for h in found}) == 11
        for h in found:
            assert aliased(h.frequency, 1000.0) == pytest.approx(320.0)
            assert h.alias_count == round(h.frequency / 1000.0)
            # Aliases are as uncertain as the line itself.
            assert h.uncertainty == found[0].uncertainty

    def test_in_each_coordinate_of_the_part_and_as_a_whole_order_it_is_one_more(self):
        found = list(hypotheses_of(scan(), line(9.0, path=225.0, radius=18e4, turn=18.0)))
        named = {(h.kind, h.coordinate, h.frequency) for h in found if h.kind != VIBRATION}
        assert named == {
            (PART, PATH, 225.0), (PART, RADIUS, 18e4), (SYNCHRONOUS, TURN, 18.0),
        }  # fmt: skip

    def test_what_is_sharp_along_the_path_alone_is_on_the_part(self):
        (only,) = hypotheses_of(scan(), line(225.0, coordinate=PATH))
        assert (only.kind, only.coordinate, only.alias_count) == (PART, PATH, 0)

    def test_its_uncertainty_grows_with_the_lines_own_and_with_its_frequency(self):
        sure, unsure = line(100.0), line(100.0, uncertainty=1e-2)
        extra = spread_of(scan(), unsure, TIME) - spread_of(scan(), sure, TIME)
        assert extra == pytest.approx(4 * (1e-2 - 1e-4))
        high = spread_of(scan(), line(400.0), TIME) - spread_of(scan(), sure, TIME)
        # Mains keep their frequency to 2e-4.
        assert high == pytest.approx(300 * 2e-4)
        longer = spread_of(scan(seconds=2000.0), line(100.0, uncertainty=0.0), TIME)
        assert longer == pytest.approx(0.02, rel=0.01)


class TestWholeOrders:
    @pytest.mark.parametrize(
        ("per_turn", "order"), [(7.0, 7), (7.02, 7), (7.2, None), (0.02, None)]
    )
    def test_near_a_whole_number_it_is_one(self, per_turn, order):
        assert whole_order(scan(), line(per_turn / 2, turn=per_turn)) == order

    def test_with_few_turns_everything_would_be_near_one(self):
        assert whole_order(scan(seconds=7.9), line(3.5, turn=7.0)) is None
        assert whole_order(scan(seconds=8.0), line(3.5, turn=7.0)) == 7

    def test_more_waves_than_a_spindle_makes_are_texture(self):
        most = float(HIGHEST_SYNCHRONOUS)
        assert whole_order(scan(rate=4000.0), line(most / 2, turn=most)) == HIGHEST_SYNCHRONOUS
        assert whole_order(scan(rate=4000.0), line(most / 2, turn=most + 1)) is None

    def test_over_time_alone_there_is_none(self):
        assert whole_order(scan(), line(3.5)) is None


class TestPlaces:
    @settings(max_examples=50)
    @given(st.floats(1.0, 1e5), st.floats(0.001, 0.2), st.floats(200.0, 5000.0))
    def test_a_texture_of_an_even_scan_is_where_its_frequency_folds(self, waves, pace, rate):
        place = place_in(scan(rate, pace), SourceHypothesis(PART, PATH, waves, 0.0))
        assert place.coordinate == TIME
        assert place.frequency == pytest.approx(aliased(waves * pace, rate), abs=1e-6 * rate)
        assert place.aliased == (waves * pace > rate / 2)
        assert 0 <= place.frequency <= (0.5 + 1e-9) * rate

    @pytest.mark.parametrize(
        ("kind", "coordinate", "frequency", "seen"),
        [
            (VIBRATION, TIME, 680.0, 320.0),
            (SYNCHRONOUS, TURN, 7.0, 3.5),
            (PART, RADIUS, 2e4, 1.0),
            (VIBRATION, TIME, 1003.0, 3.0),
        ],
    )
    def test_vibration_order_and_rings_too(self, kind, coordinate, frequency, seen):
        place = place_in(scan(), SourceHypothesis(kind, coordinate, frequency, 0.0))
        assert place.frequency == pytest.approx(seen)
        assert place.aliased == (frequency > 500.0 and coordinate == TIME)

    def test_where_the_pace_changes_it_stays_in_its_coordinate(self):
        curved = scan(path_like=PATH)
        place = place_in(curved, SourceHypothesis(PART, PATH, 3000.0, 2.0))
        assert (place.coordinate, place.frequency, place.aliased) == (PATH, 3000.0, False)
        assert place.tolerance == pytest.approx(2.0 + 0.3 / 0.8)
        assert place_in(curved, SourceHypothesis(PART, PATH, 13_000.0, 2.0)).aliased

    def test_what_is_uncertain_on_the_part_is_so_in_time(self):
        sure, unsure = (
            place_in(scan(), SourceHypothesis(PART, PATH, 3000.0, spread)) for spread in (0.0, 10.0)
        )
        assert unsure.tolerance - sure.tolerance == pytest.approx(10.0 * 0.04)
        assert sure.tolerance == pytest.approx(0.3 / 20.0)

    def test_a_scan_that_does_not_move_there_shows_nothing(self):
        still = scan()
        del still.coordinates[RADIUS]
        assert place_in(still, SourceHypothesis(PART, RADIUS, 1e4, 0.0)) is None
        assert is_detected(still, SourceHypothesis(PART, RADIUS, 1e4, 0.0), NM) is None

    def test_two_places_are_apart_beyond_what_both_leave_open(self):
        one = ExpectedLine(TIME, 100.0, 0.2, False)
        assert not apart(one, ExpectedLine(TIME, 100.49, 0.3, True))
        assert apart(one, ExpectedLine(TIME, 100.51, 0.3, False))
        assert apart(one, ExpectedLine(PATH, 100.0, 0.3, False))
        assert apart(one, None)
        assert apart(None, one)


class TestWhatIsThere:
    def test_of_several_lines_at_a_place_the_strongest(self):
        weak, strong = line(100.0, 1 * NM), line(100.01, 9 * NM)
        there = scan(lines=[weak, strong, line(140.0, 50 * NM)])
        assert lines_at(there, ExpectedLine(TIME, 100.0, 0.02, False)) is strong
        assert lines_at(there, ExpectedLine(TIME, 120.0, 0.02, False)) is None
        assert lines_at(there, ExpectedLine(PATH, 100.0, 0.02, False)) is None

    def test_a_line_of_uncertain_frequency_is_there_within_four_of_it(self):
        there = scan(lines=[line(100.0, uncertainty=0.01)])
        assert lines_at(there, ExpectedLine(TIME, 100.059, 0.02, False)) is not None
        assert lines_at(there, ExpectedLine(TIME, 100.061, 0.02, False)) is None

    def test_chance_is_the_share_of_the_band_that_the_places_of_all_lines_cover(self):
        there = scan(lines=[line(100.0), line(200.0), line(3000.0, coordinate=PATH)])
        assert chance_probability(there, ExpectedLine(TIME, 5.0, 0.25, False)) == pytest.approx(
            2 * 0.5 / 500
        )

    HUM = SourceHypothesis(VIBRATION, TIME, 100.0, 0.0)
    MARKS = SourceHypothesis(PART, PATH, 2500.0, 0.0)  # 100 Hz at 40 mm/s

    def test_the_same_line_may_be_a_few_times_as_strong_and_else_nothing_is_known(self):
        there = scan(lines=[line(100.0, 5 * NM)])
        assert is_detected(there, self.MARKS, 5 * NM) is True
        assert is_detected(there, self.MARKS, 2 * NM) is True
        assert is_detected(there, self.MARKS, 1 * NM) is None
        assert is_detected(there, self.MARKS, 50 * NM) is None
        assert is_detected(there, self.HUM, 50 * NM) is True

    def test_an_absent_line_is_absent_only_where_it_would_be_seen(self):
        assert is_detected(scan(), self.MARKS, 5 * NM) is False
        assert is_detected(scan(sigma=1 * NM), self.MARKS, 5 * NM) is None
        assert (
            is_detected(scan(), SourceHypothesis(PART, PATH, 2.5, 0.0), 5 * NM) is None
        )  # 2 waves: form
        at_an_order = SourceHypothesis(PART, PATH, 3.5 / 0.04, 0.0)  # 7 waves a turn
        assert is_detected(scan(), at_an_order, 5 * NM) is None

    def test_a_vibration_is_never_absent_for_a_machine_may_stand_still(self):
        assert is_detected(scan(), self.HUM, 5 * NM) is False

    def test_a_fine_texture_is_averaged_away_over_a_sample(self):
        """At a wave a sample nothing of it is left, so that nothing is no evidence."""
        fine = SourceHypothesis(PART, PATH, 1000.0 / 0.04 * 1.13, 0.0)
        share = abs(np.sinc(1.13))
        assert is_detected(scan(sigma=share * 5 * NM / 8.9), fine, 5 * NM) is None
        assert is_detected(scan(sigma=share * 5 * NM / 9.1), fine, 5 * NM) is False
        weak = scan(lines=[line(130.0, share * 1.5 * NM)])
        assert is_detected(weak, fine, 5 * NM) is True

    def test_an_expected_line_as_broad_as_the_band_gives_no_evidence(self):
        broad = SourceHypothesis(PART, PATH, 2500.0, 1000.0)
        assert is_detected(scan(lines=[line(300.0)]), broad, 5 * NM) is None

    def test_where_the_pace_changes_a_texture_is_missed_by_the_noise_of_all_samples(self):
        curved = scan(path_like=PATH)
        sigma = 5 * NM * np.sqrt(2 / 20_000)
        assert is_detected(curved, self.MARKS, 8.9 * sigma) is None
        # Averaged over a sample a tenth of its wave goes by: 1.6 % less is left.
        assert is_detected(curved, self.MARKS, 9.3 * sigma) is False
        assert is_detected(curved, SourceHypothesis(PART, PATH, 13_000.0, 0.0), 9.0) is None
