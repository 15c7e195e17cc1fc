"""Do scans of one part agree, once all is fitted in which they may differ?

What remains in each scan is averaged over rings and harmonics of the angle. Noise leaves of
it what its number of points predicts; a part that moved, or dynamics that are not those of
the model, leave more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray, IntArray

# Coarser than the surface's own terms, and as far as dynamics of slow axes reach.
RINGS, HARMONICS = 12, 8
# Twice what noise predicts: clean scans of the twin give 0.5 to 1.1, for the fit takes its part.
_GREATEST_RATIO = 2.0
# What is smaller than this does not matter to any accuracy asked of the method.
_LEAST_DISAGREEMENT_M = 2e-9


@dataclass(frozen=True)
class Agreement:
    """How far the scans differ where they should not.

    ratio: mean square of what is left in rings and harmonics over what noise predicts [1]
    disagreement: rms over the part of what is left beyond noise [m]
    noise: of a reading, from one to the next [m]
    """

    ratio: float
    disagreement: float
    noise: float

    @property
    def holds(self) -> bool:
        """False if the scans contradict each other by more than noise, and visibly."""
        return self.ratio < _GREATEST_RATIO or self.disagreement < _LEAST_DISAGREEMENT_M


class AgreementSums:
    """Gathers residuals of ``scans`` scans between the radii ``inner`` and ``outer`` [m]."""

    def __init__(self, scans: int, inner: float, outer: float) -> None:
        self._inner, self._width = inner, (outer - inner) / RINGS
        self._sums = np.zeros((scans, RINGS, HARMONICS), np.complex128)
        self._counts = np.zeros((scans, RINGS))
        self._jumps, self._jump_count = 0.0, 0

    def add(self, scan: int, radius: FloatArray, angle: FloatArray, residual: FloatArray) -> None:
        """Take in points (n,) of one scan, in the order of time."""
        ring: IntArray = np.clip((radius - self._inner) // self._width, 0, RINGS - 1).astype(int)
        wave = np.exp(-1j * angle)
        turned = residual.astype(np.complex128)
        for m in range(HARMONICS):
            turned = turned * wave
            real, imaginary = (np.bincount(ring, v, RINGS) for v in (turned.real, turned.imag))
            self._sums[scan, :, m] += real + 1j * imaginary
        self._counts[scan] += np.bincount(ring, minlength=RINGS)
        self._jumps += float(np.sum(np.diff(residual) ** 2))
        self._jump_count += max(len(residual) - 1, 0)

    def result(self) -> Agreement:
        """Weigh all that came."""
        variance = self._jumps / max(2 * self._jump_count, 1)
        seen = self._counts > 0
        count = self._counts[seen][:, np.newaxis]
        power = abs(self._sums[seen]) ** 2
        # The sum of n values of white noise times cos and sin has the variance n in all.
        ratio = float(np.mean(power / (count * variance))) if variance > 0 else 0.0
        excess = np.maximum(2 * (power - count * variance) / count**2, 0.0)
        mean_square = np.average(np.sum(excess, axis=1), weights=count[:, 0])
        return Agreement(ratio, float(np.sqrt(mean_square)), float(np.sqrt(variance)))
