"""Two scans of one part with drift, from a program that does not number its points."""

import numpy as np
import pytest

from omsm_ros.core.surface.aspheres import Asphere
from omsm_ros.pipelines.difference import ComparisonOptions, compare_measurements
from omsm_ros.units import units_of

RADIUS, DRIFT = 8e-3, 10e-9


def scan(path, seed, rpm, feed, astigmatism=0.0):
    """Write a spiral scan at 30 Hz of a paraboloid with coma and rings; height drifts at random."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, RADIUS / feed * 60 / rpm, 1 / 30)
    r, angle = RADIUS - feed * rpm / 60 * t, 2 * np.pi * rpm / 60 * t
    x, y, share = r * np.cos(angle), r * np.sin(angle), r / RADIUS
    form = 30e-9 * (3 * share**3 - 2 * share) * np.sin(angle)
    form += 20e-9 * (6 * share**4 - 6 * share**2) + astigmatism / 2 * share**2 * np.cos(2 * angle)
    drift = np.cumsum(rng.standard_normal(len(t))) * DRIFT / np.sqrt(len(t))
    height = r**2 / 0.2 + form + drift + 5e-9 * rng.standard_normal(len(t))
    np.savetxt(path, np.column_stack([x, y, height]) * 1e3, fmt="%.12g")
    return path


@pytest.mark.parametrize(("astigmatism", "verdict"), [(0.0, "agree"), (20e-9, "differ")])
def test_the_drift_that_is_stated_counts_in_the_order_of_the_file(tmp_path, astigmatism, verdict):
    """Drift causes 15 nm of power, which is no difference of the part, but no astigmatism."""
    a = scan(tmp_path / "a.xyz", 2, 30, 1e-4)
    b = scan(tmp_path / "b.xyz", 102, 45, 8e-5, astigmatism)
    known = {"uncertainty": 1e-10, "units": units_of("mm")}
    stated = ComparisonOptions(drift=DRIFT, **known)
    _, facts = compare_measurements(a, b, stated, Asphere(0.1, -1.0))
    assert facts["verdict"] == verdict
    assert "order in the file is assumed to be the scan's" in facts["a"]["notes"][-1]
    assert facts["b"]["drift_from"] == "stated"


def test_that_a_drift_is_not_known_is_noted(tmp_path):
    paths = [scan(tmp_path / f"{seed}.xyz", seed, 30, 1e-4) for seed in (1, 2)]
    options = ComparisonOptions(uncertainty=1e-9, units=units_of("mm"))
    _, facts = compare_measurements(*paths, options, Asphere(0.1, -1.0))
    assert "--drift 20e-9" in facts["b"]["notes"][-1]
    assert facts["b"]["drift_from"] == "taken at once"
