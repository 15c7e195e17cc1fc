"""Path, turns and sampling of a scan."""

import numpy as np
import pytest

from omsm_ros.core.ripple.scan_signal import sampling_over, scan_signal, track, unwrapped_angle
from omsm_ros.errors import DataError


@pytest.mark.parametrize(
    ("rpm", "micrometres"), [(0.140, 0.314), (1.875, 4.241), (15.0, 33.93), (30.0, 67.861)]
)
def test_sampling_distance_of_the_papers_table(made, rpm, micrometres):
    """Table 1 (F2's digits in order), on a circle of 21.6 mm."""
    (place,) = sampling_over(made("F", [], rpm=rpm, feed=0.0, radius=21.6e-3, seconds=4.0))
    assert place["distance"] * 1e6 == pytest.approx(micrometres, rel=0.01)
    assert place["shortest_wavelength"] == pytest.approx(2 * place["distance"])


def test_a_spiral_is_sampled_finer_further_in(made):
    places = sampling_over(made("A", [], rpm=60.0, feed=5e-4, seconds=20.0))
    assert [p["radius"] for p in places] == sorted((p["radius"] for p in places), reverse=True)
    for place in places:
        assert place["distance"] == pytest.approx(2 * np.pi * place["radius"] / 1000, rel=1e-3)


@pytest.mark.parametrize("noise", [0.0, 20e-9])
def test_the_path_of_a_spiral_is_its_arc_length_and_noise_does_not_add_up(noise):
    turn = np.linspace(0, 20, 20_001)
    rng = np.random.default_rng(1)
    radius = 5e-3 - 2e-4 * turn
    # Archimedes' spiral, arc length in closed form.
    b = 2e-4 / (2 * np.pi)

    def arc(r):
        return (r * np.sqrt(r * r + b * b) + b * b * np.arcsinh(r / b)) / (2 * b)

    noisy = radius + rng.normal(0, noise, len(turn))
    found = track(noisy, rng.normal(0, noise, len(turn)), turn)
    assert found[-1] == pytest.approx(arc(radius[0]) - arc(radius[-1]), rel=2e-6)


def test_the_path_of_a_raster_does_not_grow_by_noise():
    x = np.linspace(0, 1e-3, 50_001)  # 20 nm a step under 20 nm of noise
    noisy = x + np.random.default_rng(2).normal(0, 20e-9, len(x))
    found = track(noisy, np.zeros_like(x), np.zeros_like(x))
    assert found[-1] == pytest.approx(1e-3, rel=1e-3)


def test_an_encoder_that_starts_anew_each_turn_is_counted_on_over_gaps():
    count = np.arange(30_000)
    true = 2 * np.pi * 0.5e-3 * count
    kept = (count < 9_000) | (count >= 16_100)
    wrapped = np.remainder(true[kept], 2 * np.pi)
    np.testing.assert_allclose(unwrapped_angle(count[kept], wrapped), true[kept], atol=1e-9)
    np.testing.assert_array_equal(unwrapped_angle(count[kept], true[kept]), true[kept])


def test_the_longest_run_of_the_trigger_is_taken():
    sample = np.r_[np.arange(300), np.arange(1000)]
    still = np.zeros(1300)
    signal = scan_signal("A", 1e-3, (sample, np.arange(1300.0)), (sample, still, still, still))
    assert len(signal) == 1000
    assert signal.height[0] == 300


def test_too_short_a_scan_is_refused():
    few = np.arange(100)
    still = np.zeros(100)
    with pytest.raises(DataError, match=r"100 readings.*expected 256"):
        scan_signal("A", 1e-3, (few, still), (few, still, still, still))


def test_readings_and_positions_of_other_triggers_are_refused():
    still = np.zeros(1000)
    early, late = np.arange(1000), np.arange(1000) + 900
    with pytest.raises(DataError, match=r"100 readings between the trigger numbers.*expected 256"):
        scan_signal("A", 1e-3, (early, still), (late, still, still, still))
