"""Sources of the lines of scans that are written in plain numpy, so that the truth is known."""

import numpy as np
import pytest

from omsm_ros.core.ripple.accelerometer import acceleration_lines
from omsm_ros.core.ripple.ripple_guard import analyse_scans, name_lines
from omsm_ros.core.ripple.source_hypotheses import (
    ALIASED,
    ARTEFACT,
    PART,
    SYNCHRONOUS,
    UNDECIDED,
    VIBRATION,
)

NM = 1e-9


def accelerometer(lines, seconds=20.0, rate=4000.0, noise=6e-4):
    rng = np.random.default_rng(9)
    time = np.arange(int(seconds * rate)) / rate
    z = rng.normal(0, noise, len(time))
    for frequency, amplitude in lines:
        z = z + amplitude * (2 * np.pi * frequency) ** 2 * np.sin(2 * np.pi * frequency * time)
    return acceleration_lines(1 / rate, {"x": rng.normal(0, noise, len(time)), "z": z})


def named(*scans):
    """Return for each scan {frequency in time to 0.1 Hz or wavelength in µm: row}."""
    studied = analyse_scans([scan if isinstance(scan, tuple) else (scan, None) for scan in scans])
    return [
        {
            round(row.line.possible["time"], 1)
            if "time" in row.line.possible
            else f"{1e6 / row.line.frequency:.0f} µm": row
            for row in rows
        }
        for rows in name_lines(studied)
    ]


def kinds(rows):
    return {at: row.kind for at, row in rows.items()}


EVERY = [
    ("r", 1 / 15e-6, 8 * NM),  # 3.3 Hz and 4.0 Hz
    ("s", 1 / 110e-6, 6 * NM),
    ("t", 123.4, 4 * NM),
    ("c", 18, 4 * NM),
]


def test_two_scans_at_different_feeds_and_speeds(made):
    first, second = named(made("A", EVERY), made("B", EVERY, rpm=45, feed=0.8e-4, seed=2))
    assert kinds(first) == {3.3: PART, "110 µm": PART, 123.4: VIBRATION, 9.0: SYNCHRONOUS}
    assert kinds(second) == {4.0: PART, "110 µm": PART, 123.4: VIBRATION, 13.5: SYNCHRONOUS}
    assert first[3.3].wavelength == pytest.approx(15e-6, rel=1e-3)
    assert first[9.0].order == 18
    assert first[123.4].frequency is None
    assert "itself or the alias of 876.6" in str(first[123.4].evidence[1])


def test_one_scan_alone_is_undecided_and_says_what_it_needs(made):
    (only,) = named(made("A", EVERY))
    assert {row.kind for at, row in only.items() if at != "110 µm"} == {UNDECIDED}
    assert all("second scan" in str(only[at].needs) for at in (3.3, 123.4, 9.0))
    assert only["110 µm"].kind == PART  # its pace over the part changed


@pytest.mark.soak
def test_two_scans_of_one_speed_and_feed_tell_nothing(made):
    first, _ = named(made("A", EVERY), made("B", EVERY, seed=2))
    assert {row.kind for at, row in first.items() if at != "110 µm"} == {UNDECIDED}


def test_the_accelerometer_tells_a_folded_vibration_in_one_scan(made):
    scan = made("A", [("t", 680.0, 4 * NM), ("t", 999.7, 5 * NM), ("r", 1 / 15e-6, 8 * NM)])
    (rows,) = named((scan, accelerometer([(680.0, 4 * NM), (999.7, 5 * NM)])))
    assert kinds(rows) == {320.0: ALIASED, 0.3: ALIASED, 3.3: UNDECIDED}
    assert rows[320.0].frequency == pytest.approx(680.0, abs=1e-3)
    assert "73.0 mm/s²" in str(rows[320.0].evidence[0])  # 4 nm · (2π 680 Hz)²


def test_a_far_too_weak_acceleration_explains_nothing(made):
    scan = made("A", [("t", 320.0, 8 * NM)])
    (rows,) = named((scan, accelerometer([(680.0, 0.05 * NM)])))
    assert kinds(rows) == {320.0: UNDECIDED}


def test_a_second_rate_tells_a_folded_vibration(made):
    lines = [("t", 680.0, 4 * NM), ("t", 123.4, 4 * NM)]
    first, second = named(made("A", lines), made("B", lines, rate=900.0, rpm=45, seed=2))
    assert kinds(first) == {320.0: ALIASED, 123.4: VIBRATION}
    assert kinds(second) == {220.0: ALIASED, 123.4: VIBRATION}
    assert first[320.0].frequency == pytest.approx(680.0, abs=0.05)
    assert first[123.4].frequency == pytest.approx(123.4, abs=0.05)


def circles(made, lines, rpms=(0.14, 1.875, 15.0, 30.0)):
    return [
        made(f"F{k + 1}", lines, rpm=rpm, feed=0.0, radius=21.6e-3, seed=k)
        for k, rpm in enumerate(rpms)
    ]


def test_the_papers_four_scans(made):
    """15 µm marks at four speeds: resolved twice, aliased twice; and with them their harmonic."""
    rows = named(*circles(made, [("s", 1 / 15e-6, 15 * NM), ("s", 2 / 15e-6, 4 * NM)]))
    assert kinds(rows[0]) == {21.1: PART, 42.2: PART}
    assert kinds(rows[1]) == {282.7: PART, 434.5: ARTEFACT}
    assert set(kinds(rows[2]).values()) == {ARTEFACT}
    # At twice the speed the first wave is seen where the second was: no vibration for that.
    assert set(kinds(rows[3]).values()) == {ARTEFACT}


def test_harmonics_at_twice_the_speed_are_no_vibration(made):
    lines = [("r", n / 60e-6, 20 * NM / n**2) for n in (1, 2, 3, 4)]
    scans = made("A", lines, rpm=60), made("B", lines, rpm=120, feed=0.7e-4, seed=2)
    first, second = named(*scans)
    for rows in (first, second):
        assert set(kinds(rows).values()) == {PART}


def test_marks_that_coincide_with_a_vibration_in_one_scan(made):
    marks, shake = 1e-4 / 2 / 15e-6, 3 * NM  # 3.333 Hz at 30 rpm
    lines = [("r", 1 / 15e-6, 9 * NM), ("t", marks, shake)]
    first, second = named(made("A", lines), made("B", lines, rpm=50, feed=0.9e-4, seed=2))
    assert kinds(second) == {5.0: PART, 3.3: VIBRATION}
    assert kinds(first) == {3.3: PART}
    assert first[3.3].also == VIBRATION


def test_a_vibration_in_one_scan_only_is_not_said_to_be_on_the_part(made):
    first, _ = named(made("A", [("t", 50.3, 5 * NM)]), made("B", [], rpm=45, feed=0.8e-4))
    assert kinds(first) == {50.3: UNDECIDED}
    assert "not on the part: missing in B" in map(str, first[50.3].evidence)


def test_rings_and_spindle_at_the_same_feed_per_turn_stay_undecided(made):
    lines = [("c", 5, 4 * NM)]
    rows = named(made("A", lines, feed=0.75e-4), made("B", lines, rpm=45, feed=0.75e-4, seed=2))
    assert rows[0][2.5].kind in (UNDECIDED, SYNCHRONOUS)
    if rows[0][2.5].kind == UNDECIDED:
        assert "feed per turn" in str(rows[0][2.5].needs)


@pytest.mark.soak
def test_jitter_gaps_and_dropouts(made):
    rough = {"jitter": 2e-3, "lost": 0.1, "gap": (4.0, 6.0)}
    first, second = named(
        made("A", EVERY, **rough), made("B", EVERY, rpm=45, feed=0.8e-4, seed=2, **rough)
    )
    for rows in (first, second):
        assert sorted(row.kind for row in rows.values()) == [PART, PART, SYNCHRONOUS, VIBRATION]


def test_scans_of_different_rings_have_no_marks_in_common(made):
    """Missing on another part of the part is no evidence against being on it."""
    lines = [("r", 1 / 15e-6, 8 * NM)]
    first, _ = named(made("A", lines), made("B", [], rpm=45, radius=6e-3, feed=0.8e-4))
    assert kinds(first) == {3.3: UNDECIDED}
    assert not first[3.3].evidence
