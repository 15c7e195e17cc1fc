"""What the steps of a probe's readings leave open where noise does not carry it across them.

With noise of half a step and more the error of rounding is noise too. With less it is the same
at each reading of a plateau, up to half a step, and no number of readings averages it.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.fitting.steps import Steps
from omsm_ros.core.samples.blocks import BoolArray, FloatArray, IntArray

# Readings of a probe with steps share their values; of one without, hardly any two do.
_LEAST_READINGS_A_LEVEL = 3.0
# Of a step squared: this much is lost in any noise.
_NOTHING = 1e-4
# Of the error of rounding, that are added up: without noise all but 0.6 % of q²/12.
_HARMONICS = 100
# Gaps between levels are whole steps, but for the rounding of decimals.
_WHOLE = 0.05


def reading_step(readings: FloatArray) -> float:
    """Return the step of ``readings`` (k,) [m], finite; 0 where they show none."""
    levels = np.unique(readings)
    if len(levels) < 3 or len(readings) < _LEAST_READINGS_A_LEVEL * len(levels):
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * float(np.max(np.abs(levels)))]
    step = float(np.min(gaps))
    return step if np.all(np.abs(gaps / step - np.round(gaps / step)) < _WHOLE) else 0.0


def plateaus(steps: Steps, used: BoolArray) -> IntArray:
    """Return the number of the plateau that a sample belongs to, (n,); -1 where the axis moves."""
    if not steps.edges:
        return np.full(len(used), -1)
    begun = np.diff(steps.moving.astype(np.int8), prepend=1) == -1
    return np.asarray(np.where(steps.moving, -1, np.cumsum(begun) - 1), np.int64)


def plateau_variance(readings: FloatArray, plateau: IntArray, step: float) -> float:
    """Return the variance [m²] of the error of rounding that all readings of a plateau share.

    The error is periodic in the position; noise σ weakens its harmonic k, q/πk, as
    exp(-2π²k²σ²/q²) (Widrow and Kollár 2008, ch. 19); without noise their sum is q²/12.
    readings: (k,), plateau: (k,)
    """
    resting = plateau >= 0
    if step == 0 or not np.any(resting):
        return 0.0
    count = np.bincount(plateau[resting])
    mean = np.bincount(plateau[resting], readings[resting]) / np.maximum(count, 1)
    spread = float(np.mean((readings - mean[plateau])[resting] ** 2))
    # Of a reading that never changes all noise may be hidden; of others rounding adds its own.
    noise = max(spread - step**2 / 12, 0.0)
    harmonic = np.arange(1, _HARMONICS + 1)
    weakened = np.exp(-4 * np.pi**2 * harmonic**2 * noise / step**2) / harmonic**2
    shared = step**2 / (2 * np.pi**2) * float(np.sum(weakened))
    return shared if shared > _NOTHING * step**2 else 0.0
