"""How far do residuals let parameters vary, if a whole ring of the part varies as one?

Points next to each other, and the same place in all scans, share texture, vibration and
spindle error; as independent points they would pass for more knowledge than they are.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.verification.eliminated_surface import Portion
from omsm_ros.core.verification.scan_agreement import AgreementSums
from omsm_ros.core.verification.scan_model import DYNAMIC, GAIN, ScanModel

# Enough for a covariance of the parameters, few enough to be turns apart.
_MOST_RINGS, _LEAST_RINGS = 60, 12


class RingScores:
    """Gathers residuals portion by portion, at the end of a fit.

    shares: the surface's terms in each column, from the normal equations
    square: sum of the squared residuals so far;  agreement: of the scans with each other
    """

    def __init__(self, model: ScanModel, shares: FloatArray) -> None:
        self._model, self._shares = model, shares
        rings = int(np.clip(min(model.turns), _LEAST_RINGS, _MOST_RINGS))
        self._scores = np.zeros((rings, model.size))
        self._second = np.zeros((DYNAMIC, DYNAMIC))
        self.square = 0.0
        basis = model.basis
        self.agreement = AgreementSums(model.number, basis.inner, basis.outer)

    def add(
        self,
        part: Portion,
        x: FloatArray,
        y: FloatArray,
        parameters: FloatArray,
        surface: FloatArray,
    ) -> None:
        """Take in a portion: its columns x (n, parameters) and heights y (n,), and the solution."""
        model, basis = self._model, self._model.basis
        terms, here = part.rows.matrix(), basis.terms(part.interval)
        residual = y - x @ parameters - terms @ surface[here]
        free = x - terms @ self._shares[here]
        radius, angle = model.radius(part), model.angle(part)
        depth = (radius - basis.inner) / (basis.outer - basis.inner)
        ring = np.clip(depth * len(self._scores), 0, len(self._scores) - 1).astype(np.int64)
        for number in np.unique(ring):
            mine = ring == number
            self._scores[number] += residual[mine] @ free[mine]
        four = x[:, :DYNAMIC].copy()
        four[:, GAIN] += terms @ surface[here]
        self._second += four.T @ four
        self.square += float(residual @ residual)
        scan = model.scan[part.points]
        for k in np.unique(scan):
            mine = scan == k
            self.agreement.add(int(k), radius[mine], angle[mine], residual[mine])

    def meat(self) -> FloatArray:
        """Return the scores' covariance, (parameters, parameters); a ring varies as a whole."""
        rings = len(self._scores)
        return np.asarray(self._scores.T @ self._scores * (rings / (rings - 1)))

    def followed(self, covariance: FloatArray) -> float:
        """Return the rms standard uncertainty of the heights by the four parameters [m]."""
        mean_square = float(np.sum(self._second * covariance)) / len(self._model)
        return float(np.sqrt(max(mean_square, 0.0)))
