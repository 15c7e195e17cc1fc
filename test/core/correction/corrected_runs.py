"""Scans of the twin, cut and corrected, for several tests of the correction."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.streams.blocks import Account, Block, StreamAccount
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

PERIOD = 1e-3
SPIRAL = Spiral(PAPER_MIRROR, start_radius=12.7e-3, feed_per_turn=2e-3, spindle_speed=30.0)
NOISE = ErrorSources(probe_noise=10e-9, probe_resolution=10e-9, encoder_noise=0.4e-9)


def calibration(**changes: object) -> Calibration:
    """True dynamics of the paper's plant, with a plausible covariance."""
    g = Plant().dynamics
    values = np.concatenate([g.numerator, g.denominator[1:], [0.0]])
    deviations = 1e-3 * abs(values)
    deviations[0] = 0.0
    parts: dict[str, object] = {
        "dynamics": g,
        "static_gain": PAPER_STATIC_GAIN,
        "sample_period": PERIOD,
        "valid_up_to": 100.0,
        "covariance": np.diag(deviations**2),
    }
    return Calibration(**(parts | changes))  # type: ignore[arg-type]


CALIBRATION = calibration()


def part(block: Block, start: int, stop: int) -> Block:
    """Samples ``start`` to ``stop`` of a block, stamped as a driver would."""
    arrays = {
        f.name: getattr(block, f.name)[start:stop].copy()
        for f in fields(block)
        if isinstance(getattr(block, f.name), np.ndarray)
    }
    return replace(
        block,
        first_sample=block.first_sample + start,
        stamp_ns=block.stamp_ns + round(start * PERIOD * 1e9),
        **arrays,
    )


def cut(block: Block, edges: Sequence[int]) -> list[Block]:
    inner = sorted({e for e in edges if 0 < e < len(block)})  # type: ignore[arg-type]
    bounds = [0, *inner, len(block)]  # type: ignore[arg-type]
    return [part(block, a, b) for a, b in itertools.pairwise(bounds)]


def run(
    axes: Sequence[Block],
    distance: Sequence[Block],
    options: CorrectionOptions | None = None,
    known: Calibration = CALIBRATION,
) -> tuple[SurfacePoints, Account]:
    corrector = Corrector(known, options or CorrectionOptions())
    for block in axes:
        corrector.push_axes(block)  # type: ignore[arg-type]
    for block in distance:
        corrector.push_distance(block)  # type: ignore[arg-type]
    points = join_points([corrector.finish()])
    return points, corrector.account


def same_points(one: SurfacePoints, other: SurfacePoints) -> bool:
    return all(
        np.array_equal(getattr(one, f.name), getattr(other, f.name), equal_nan=True)
        for f in fields(SurfacePoints)
    )


def balanced(account: StreamAccount) -> bool:
    return account.received == (account.corrected + account.pending + sum(account.counted.values()))


def shifted(block: Block, count: int, seconds: float) -> Block:
    return replace(
        block,
        first_sample=block.first_sample + count,
        stamp_ns=block.stamp_ns + round(seconds * 1e9),
    )
