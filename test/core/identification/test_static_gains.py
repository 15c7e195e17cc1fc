"""Static gains from plateaus show whether the probe or the encoder is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.identification.identify import static_gains
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.errors import StepTestError


def stepped(probe_gain, reference_gain=None, drift=0.0, noise=1e-8, seed=1, count=10, walk=0.0):
    rng = np.random.default_rng(seed)
    motion = StepTest(count=count)
    time = np.arange(round(motion.duration / 1e-3)) * 1e-3
    z = motion.positions(time).z
    distance = 1e-5 - probe_gain * z + drift * time + rng.normal(0, noise, len(z))
    distance += walk * np.cumsum(rng.normal(0, np.sqrt(1e-3), len(z)))
    reference = (
        None if reference_gain is None else reference_gain * z + rng.normal(0, noise, len(z))
    )
    return record_from_arrays(1e-3, z + rng.normal(0, 4e-10, len(z)), distance, reference=reference)


def test_gain_is_found_within_its_uncertainty_under_drift():
    gain = static_gains(stepped(0.9921, drift=2e-9)).probe_per_encoder
    assert abs(gain.value - 0.9921) < 4 * gain.uncertainty
    assert 1e-6 < gain.uncertainty < 2e-5


def test_uncertainty_is_the_scatter_of_repeated_tests():
    gains = [static_gains(stepped(1.0, seed=s)).probe_per_encoder for s in range(40)]
    scatter = np.std([g.value for g in gains])
    assert np.mean([g.uncertainty for g in gains]) == pytest.approx(scatter, rel=0.4)


def test_uncertainty_is_the_scatter_where_the_machine_drifts_by_chance():
    """A random walk of 1.2 nm/√s, of which the means of plateaus have more than of noise."""
    gains = [static_gains(stepped(1.0, seed=s, walk=1.2e-9)).probe_per_encoder for s in range(60)]
    scatter = np.std([g.value for g in gains])
    stated = np.sqrt(np.mean([g.uncertainty**2 for g in gains]))
    assert stated == pytest.approx(scatter, rel=0.25)


def test_uncertainty_is_the_scatter_where_another_axis_moves_too():
    """Its motion reaches the probe: in other steps, at other times."""
    own = StepTest(count=4, dwell=0.9)
    found = []
    for seed in range(40):
        record = stepped(1.0, seed=seed)
        x = np.resize(own.positions(np.arange(round(own.duration / 1e-3)) * 1e-3).z, len(record))
        moved = replace(record, distance=record.distance + 0.01 * x, further={"x": x})
        found.append(static_gains(moved).probe_per_encoder)
    off = np.array([gain.value - 1 for gain in found])
    stated = np.sqrt(np.mean([gain.uncertainty**2 for gain in found]))
    assert np.sqrt(np.mean(off**2)) == pytest.approx(stated, rel=0.3)
    assert stated < 1e-4


def test_a_reference_tells_probe_from_encoder():
    gains = static_gains(stepped(0.99, reference_gain=1.0))
    assert gains.reference_per_encoder.value == pytest.approx(1.0, abs=3e-5)
    assert gains.probe_per_reference.value == pytest.approx(0.99, abs=3e-5)
    wrong_encoder = static_gains(stepped(0.99, reference_gain=0.99))
    assert wrong_encoder.probe_per_reference.value == pytest.approx(1.0, abs=3e-5)
    assert wrong_encoder.reference_per_encoder.value == pytest.approx(0.99, abs=3e-5)


def test_without_a_reference_there_is_one_gain():
    gains = static_gains(stepped(1.0))
    assert gains.probe_per_reference is None
    assert gains.reference_per_encoder is None


def test_a_path_without_plateaus_has_no_static_gain():
    time = np.arange(10_000) * 1e-3
    z = Chirp().positions(time).z
    with pytest.raises(StepTestError, match="plateaus"):
        static_gains(record_from_arrays(1e-3, z, -z))
