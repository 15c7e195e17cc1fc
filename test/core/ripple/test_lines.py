"""Amplitude, frequency and significance of lines, close ones, in the coordinate they belong to."""

import numpy as np
import pytest

from omsm_ros.core.ripple.density import noise_floor, ratio_at, significance
from omsm_ros.core.ripple.form_removal import FormFit
from omsm_ros.core.ripple.lines import find_lines

NM = 1e-9


def without_form(signal):
    return FormFit(signal).without()


def lines_of(signal):
    return find_lines(signal, without_form(signal).residual).lines


@pytest.mark.soak
def test_amplitude_and_frequency_within_their_uncertainties(made):
    pulls = []
    for seed in range(8):
        signal = made("A", [("t", 123.4, 1 * NM), ("t", 77.7, 2 * NM)], seed=seed)
        found = {round(line.frequency): line for line in lines_of(signal)}
        for frequency, amplitude in ((123.4, 1 * NM), (77.7, 2 * NM)):
            line = found[round(frequency)]
            pulls.append((line.amplitude - amplitude) / line.amplitude_uncertainty)
            pulls.append((line.frequency - frequency) / line.frequency_uncertainty)
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.3)


def test_lines_a_resolution_and_a_half_apart_are_two(made):
    signal = made("A", [("t", 200.0, 5 * NM), ("t", 200.075, 4 * NM)])
    found = sorted(line.frequency for line in lines_of(signal))
    np.testing.assert_allclose(found, [200.0, 200.075], atol=0.01)


def test_noise_has_no_line():
    """Three σ over the whole spectrum: one record in 740 has one by chance."""
    rng = np.random.default_rng(5)
    power = rng.exponential(1.0, (300, 4000))
    floors = [np.mean(noise_floor(p)) for p in power[:40]]
    assert np.mean(floors) == pytest.approx(1.0, abs=0.02)
    above = np.mean([np.max(p) > ratio_at(2.0, 4000) for p in power])
    assert above == pytest.approx(0.0228, abs=0.025)


def test_significance_is_the_inverse_of_its_ratio():
    for tried in (1, 1e3, 1e6):
        for sigma in (1.0, 3.0, 8.0):
            found = significance(np.array(ratio_at(sigma, tried)), tried)
            assert float(found) == pytest.approx(sigma, abs=0.2)


def test_a_weak_line_next_to_a_strong_one_and_none_else(made):
    signal = made("A", [("t", 100.0, 500 * NM), ("t", 103.0, 1 * NM)])
    assert sorted(round(line.frequency) for line in lines_of(signal)) == [100, 103]


def test_the_floor_follows_coloured_noise(made):
    from dataclasses import replace

    signal = made("A", [("t", 150.0, 1 * NM)])
    walk = np.cumsum(np.random.default_rng(1).normal(0, 3 * NM, len(signal)))
    found = lines_of(replace(signal, height=signal.height + walk))
    assert [round(line.frequency) for line in found] == [150]


def test_dropouts_and_gaps_cost_only_their_points(made):
    lines = [("t", 123.4, 2 * NM), ("s", 1 / 120e-6, 3 * NM)]
    found = lines_of(made("A", lines, lost=0.3, gap=(5.0, 9.0)))
    assert {line.coordinate for line in found} == {"time", "path"}
    sizes = sorted(line.amplitude for line in found)
    np.testing.assert_allclose(sizes, [2 * NM, 3 * NM], rtol=0.1)


def test_a_changing_pace_tells_time_from_path(made):
    lines = [("t", 60.0, 3 * NM), ("s", 1 / 100e-6, 3 * NM)]
    time, path = sorted(lines_of(made("A", lines)), key=lambda line: line.coordinate == "path")
    assert time.coordinate == "time"
    assert "path" not in time.possible
    assert set(path.possible) == {"path"}
    assert 1 / path.frequency == pytest.approx(100e-6, rel=1e-4)


def test_a_steady_circle_cannot_tell(made):
    (line,) = lines_of(made("A", [("s", 1 / 200e-6, 3 * NM)], feed=0.0))
    assert set(line.possible) == {"time", "path", "turn"}
    assert line.possible["path"] == pytest.approx(1 / 200e-6, rel=1e-5)


def test_a_spindle_that_wanders_tells_turns_from_time(made):
    lines = [("t", 60.0, 3 * NM), ("c", 40, 3 * NM)]
    found = lines_of(made("A", lines, jitter=5e-2, feed=0.0))
    assert sorted(line.coordinate for line in found) != ["time", "time"]
    (turning,) = [line for line in found if "time" not in line.possible]
    assert turning.possible["turn"] == pytest.approx(40, abs=0.01)
