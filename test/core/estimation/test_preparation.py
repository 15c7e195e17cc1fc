"""Test the preparation of a record: compared samples, spikes, gain and clipping."""

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.parallel_sections import close_period
from omsm_ros.core.estimation.preparation import faded_to_stationary, input_bandwidth, prepare
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.errors import IdentificationError, StepTestError

TIME = np.arange(round(StepTest().duration / 1e-3)) * 1e-3
STEPS = StepTest().positions(TIME).z


def record_of(extra=0.0, gain=1.0, lost=None, seed=1):
    rng = np.random.default_rng(seed)
    distance = 3e-6 - gain * STEPS + rng.normal(0, 1e-8, len(STEPS)) + extra
    if lost is not None:
        distance[lost] = np.nan
    return record_from_arrays(1e-3, STEPS + rng.normal(0, 4e-10, len(STEPS)), distance)


def test_single_spikes_are_taken_out_and_counted():
    spikes = np.zeros(len(STEPS))
    spikes[[700, 1300, 5222]] = [1e-6, -5e-7, 2e-6]
    prepared = prepare(record_of(spikes), "encoder")
    assert prepared.spikes == 3
    assert not np.any(prepared.problem.used[[700, 1300, 5222]])


def test_edges_are_no_spikes():
    assert prepare(record_of(), "encoder").spikes == 0


@pytest.mark.parametrize("off", [1e-6, -40e-6, 5e-3])
def test_single_positions_that_stand_apart_are_bridged(off):
    """Spikes on a plateau, in an edge and next to one; the true position is known."""
    record = record_of()
    edge = prepare(record, "encoder").steps.edges[3]
    places = [700, (edge.start + edge.stop) // 2, edge.start - 3, 9000]
    wrong = record.z.copy()
    wrong[places] += off
    found = prepare(record_from_arrays(1e-3, wrong, record.distance), "encoder")
    assert found.axis_spikes == len(places)
    whole = prepare(record, "encoder")
    assert whole.axis_spikes == 0
    assert [(e.start, e.stop) for e in found.steps.edges] == [
        (e.start, e.stop) for e in whole.steps.edges
    ]
    np.testing.assert_allclose(found.problem.input, whole.problem.input, rtol=0, atol=3e-8)


def test_a_motion_of_nothing_but_pulses_is_left_as_it_is():
    z = np.zeros(5000)
    z[500::500] = 1e-5
    with pytest.raises(IdentificationError, match=r"per travel of the axis|does not change"):
        prepare(record_from_arrays(1e-3, z, -1e-3 * z + 1e-9 * np.sin(TIME[:5000])), "encoder")


def test_lost_samples_are_not_used():
    prepared = prepare(record_of(lost=slice(2000, 2100)), "encoder")
    assert not np.any(prepared.problem.used[2000:2100])
    assert np.sum(prepared.problem.used) > 10_000


def test_after_a_gap_of_the_encoder_the_response_settles_first():
    z = STEPS.copy()
    z[1000:1030] = np.nan  # the second edge
    prepared = prepare(record_from_arrays(1e-3, z, -STEPS + 1e-9 * np.sin(TIME)), "encoder")
    assert not np.any(prepared.problem.used[1000:1080])
    assert prepared.problem.used[1090]
    assert len(prepared.steps.edges) == 19


def test_only_offset_and_drift_are_fitted_before_any_model():
    curved = prepare(record_of(1e-7 * (TIME / TIME[-1]) ** 2), "encoder")
    assert curved.problem.background.shape[1] == 2


@pytest.mark.parametrize(("share", "expected"), [(0.03, 20.0), (0.003, 2.0)])
def test_content_is_counted_by_the_energy_of_the_velocity(share, expected):
    """Two sines, of which the faster one has this share of the energy."""
    time = np.arange(10_000) * 1e-3
    slow, fast = (np.sin(2 * np.pi * f * time) / f for f in (2.0, 20.0))
    motion = slow + np.sqrt(share / (1 - share)) * fast
    assert input_bandwidth(motion, 1e-3) == pytest.approx(expected, abs=0.3)


def test_a_record_beyond_a_gigabyte_is_refused_before_it_is_fitted():
    z = np.zeros(800_001)
    with pytest.raises(StepTestError, match=r"800001 samples .* 800000; record a shorter test"):
        prepare(record_from_arrays(1e-3, z, z), "encoder")


def test_the_probes_gain_must_be_plausible():
    prepare(record_of(gain=-0.9), "encoder")
    with pytest.raises(IdentificationError, match="expected about 1"):
        prepare(record_of(gain=0.3), "encoder")


def test_a_quantised_probe_is_not_taken_for_a_clipped_one():
    coarse = record_from_arrays(1e-3, STEPS, np.round(-STEPS / 1e-7) * 1e-7)
    assert prepare(coarse, "encoder").problem.used.any()


def test_the_bandwidth_is_that_of_the_motion():
    time = np.arange(10_000) * 1e-3
    assert input_bandwidth(np.sin(2 * np.pi * 7 * time), 1e-3) == pytest.approx(7.0, abs=0.3)
    assert input_bandwidth(STEPS, 1e-3) > 30


def test_a_motion_that_breaks_off_ends_at_rest_and_without_new_content():
    frequency, period, samples = 10.3, 1e-3, 20_000
    z = 20e-6 * np.sin(2 * np.pi * frequency * period * np.arange(samples) + 0.3)
    distance = np.random.default_rng(1).normal(-z, 1e-8)
    problem = prepare(record_from_arrays(period, z, distance), "encoder").problem
    assert not np.any(problem.used[:499])
    assert not np.any(problem.used[-499:])
    assert np.mean(problem.used) > 0.94

    def beyond(motion):
        closed = close_period(motion, period)
        spectrum = np.abs(np.fft.rfft(closed))
        lines = np.fft.rfftfreq(len(closed), period) > frequency + 10.0
        return np.max(spectrum[lines]) / np.max(spectrum)

    assert beyond(problem.input) < 1e-5
    assert beyond(z) > 1e-4


def test_what_rests_at_both_ends_is_left_as_it_is():
    recorded = record_of()
    problem = prepare(recorded, "encoder").problem
    np.testing.assert_allclose(np.diff(problem.input), np.diff(recorded.z), atol=1e-18)
    assert problem.used[60]
    assert problem.used[-10]


@pytest.mark.parametrize(("samples", "period"), [(4, 1e-3), (50, 10.0)])
def test_a_fade_shorter_than_a_sample_changes_nothing(samples: int, period: float) -> None:
    motion = np.arange(samples, dtype=np.float64)
    moving = np.ones(samples, np.bool_)
    assert np.array_equal(faded_to_stationary(motion, moving, period), motion)


def test_a_motion_too_small_to_square_has_the_lowest_content() -> None:
    motion = 1e-300 * np.arange(100.0)
    assert input_bandwidth(motion, 1e-3) == pytest.approx(1 / (100 * 1e-3))


def test_a_distance_that_stands_still_next_to_a_sweep_is_refused():
    z = Chirp().positions(np.arange(8000) * 1e-3).z
    with pytest.raises(IdentificationError, match=r"does not change .* probe is connected"):
        prepare(record_from_arrays(1e-3, z, np.full(8000, 3e-6)), "encoder")
