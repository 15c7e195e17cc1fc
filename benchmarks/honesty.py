"""Compare the stated uncertainty of the dynamics with the scatter of repeated step tests.

Each test is of the same machine with other noise. Each calibration corrects the same motion without
noise, so that the whole error is that of the dynamics. ``dynamics`` of the budget is its stated
scatter; ``undetected_error`` bounds model errors that no test of this machine shows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from benchmarks.correction import blocks_of, fast_path, identified_calibration
from benchmarks.row import Row, at_most, between, shown
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant
from omsm_ros.units import NANOMETRE_M

# A fifth of the paper's turns, whose motions differ in amplitude only.
FEED_M = 5e-4
# Number of samples in which the filter's start decays.
_SETTLED = 200


@dataclass(frozen=True, eq=False)
class KnownMotion:
    """z of the encoder and the true motion of the probe, each (n,) [m]."""

    z: FloatArray
    seen: FloatArray


@dataclass(frozen=True)
class Found:
    """Error of one calibration on a motion, rms [m], and its stated uncertainties."""

    error: float
    dynamics: float
    undetected_error: float


def rows(full: bool) -> Iterator[Row]:
    """Yield the rms of error over stated uncertainty of the corrected motion, over all tests."""
    runs = 100 if full else 10
    calibrations = [identified_calibration(seed) for seed in range(1, runs + 1)]
    # Relative standard deviation of the rms of as many normal errors.
    chance = 1 / np.sqrt(2 * runs)
    for name, motion, barred in (("paper's scan", _scan(), True), ("6 and 31 Hz", _fast(), False)):
        found = [_judged(each, motion) for each in calibrations]
        ratio = np.array([each.error / each.dynamics for each in found])
        held = [each.error / np.hypot(each.dynamics, each.undetected_error) for each in found]
        stated = float(np.sqrt(np.mean([each.dynamics**2 for each in found]))) / NANOMETRE_M
        label, rms = f"step tests, {name}: error / stated", float(np.sqrt(np.mean(ratio**2)))
        if barred:
            bars = round(0.95 - chance, 2), round(1.05 + chance, 2)
            yield between(f"{label}, rms", rms, "1", *bars, peer=stated, runs=runs)
        else:
            yield shown(f"{label}, rms", rms, "1", stated, runs)
        yield at_most(f"{label} with undetected error: worst", max(held), "1", 3.0, runs=runs)


def _scan() -> KnownMotion:
    spiral = Spiral(PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, FEED_M, 30.0)
    made = record(replace(Cell(encoder_noise=0.0), seed=1), spiral, PAPER_MIRROR)
    return KnownMotion(made.axes.z, made.probe_motion)


def _fast() -> KnownMotion:
    z = fast_path(1200)[0]
    return KnownMotion(z, signal.sosfilt(discretise(Plant().dynamics, 1e-3).sections, z))


def _judged(calibration: Calibration, motion: KnownMotion) -> Found:
    corrector = Corrector(calibration, CorrectionOptions(sources=ErrorSources()))
    axes, distance = blocks_of(motion.z, np.zeros(len(motion.z)))
    corrector.push_axes(axes)
    corrector.push_distance(distance)
    points = join_points([corrector.finish()])
    used = points.sample >= _SETTLED
    error = (motion.z - motion.seen)[points.sample] - points.dynamic_error
    budget = corrector.budget
    return Found(
        float(np.sqrt(np.mean(error[used] ** 2))),
        budget["dynamics"],
        budget["undetected_model_error"],
    )
