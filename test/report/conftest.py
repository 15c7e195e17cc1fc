"""A cloud with a known deviation, and calibrations, as a report gets them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.calibration.latency import declared_latency
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.report.measurement.surface_map import CloudView
from omsm_ros.twin.part import FigureError

POINTS = 40_000
TURNS = 64


@pytest.fixture(scope="session")
def mirror():
    return FigureError(PAPER_MIRROR, PAPER_MIRROR_RADIUS_M)


@pytest.fixture(scope="session")
def cloud(mirror):
    """Return a spiral over a mirror with a form error; the dynamic error is 0.6 µm of ρ² sin 2θ."""
    share = np.arange(POINTS) / POINTS
    radius, angle = PAPER_MIRROR_RADIUS_M * (1 - share), 2 * np.pi * TURNS * share
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    height = mirror.height(x, y)
    error = 0.6e-6 * (radius / PAPER_MIRROR_RADIUS_M) ** 2 * np.sin(2 * angle)
    return CloudView(
        time=1e-3 * np.arange(POINTS),
        x=x,
        y=y,
        height=height,
        dynamic_error=error,
        uncertainty=np.full(POINTS, 11e-9),
    )


@pytest.fixture(scope="session")
def certified(true_calibration):
    """Return an accepted calibration with a covariance that makes the band visible."""
    variance = (0.01 * np.r_[true_calibration.dynamics.numerator[1:], 0.0]) ** 2
    size = len(true_calibration.covariance)
    covariance = np.zeros((size, size))
    for index in range(1, len(true_calibration.dynamics.numerator)):
        covariance[index, index] = variance[index - 1]
    certificate = {"verdict": "accepted up to 100 Hz", "chi_square": 1.01, "edges": 20}
    latency = declared_latency(3.4e-4, 0.0, 1e-6, "the twin's probe is prompt")
    return replace(
        true_calibration,
        covariance=covariance,
        certificate=replace(certified_by(certificate), latency=latency),
        valid_up_to=100.0,
    )


@pytest.fixture
def summary():
    """Return a complete content of ``summary.json``."""
    stream = {"received": 40_040, "corrected": 40_000, "pending": 0, "counted": {"settling": 40}}
    form = {
        "peak_to_valley": 179e-9,
        "rms": 17.5e-9,
        "rms_area_weighted": 20.9e-9,
        "points": 40_000,
    }
    return {
        "samples": {"axes": dict(stream), "distance": dict(stream)},
        "dynamic_error_before": {"peak_to_valley": 1.23e-6, "rms": 246e-9},
        "dynamic_error_after": {"peak_to_valley": 8.7e-9, "rms": 1.2e-9},
        "deviation": {"raw": {**form, "rms": 184e-9}, "corrected": form},
        "uncertainty": {"median": 11e-9, "largest": 12.5e-9},
        "figures": {
            "peak_to_valley": {"value": 175e-9, "standard_uncertainty": 22e-9},
            "rms": {"value": 20.9e-9, "standard_uncertainty": 3e-9},
            "removed": ["piston", "tip", "tilt"],
        },
        "verdict": {
            "code": "not_verified",
            "text": "not verified",
            "reasons": [{"code": "not_redundant", "text": "one speed cannot show a lag"}],
            "add": {"code": "other_speed", "text": "scan again faster", "reached": 4e-9},
        },
        "settings": {"probe": "exposure 1 ms", "spindle_speed": 30},
        "versions": {"omsm_ros": "0.1.0"},
    }
