"""Does the form look like an error of the machine that these scans cannot tell from the part?

A function of Z, where Z follows the part, is the same in all scans as in the part: nothing but its
shape speaks against it. Errors of form become smaller with their degree, in all directions alike,
or all rotationally symmetric ones; a form that follows one column of the machine is improbable.
Two models of the Zernike coefficients c are compared by their likelihood, each with its best A and
p: ``c ~ N(0, A n^-p + C)``, and with the columns S of a family of size w
``c ~ N(0, A n^-p + C + w² S Sᵀ)``. n is the degree, C the covariance by the adjustment, and A one
of symmetric terms and another of all others.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray

# Amplitudes of turned and of polished parts fall with about the 1.5th power of the degree.
_START_POWER = 3.0
# Over the plausible size; each is as probable.
_SIZES = 10.0 ** np.arange(-1.5, 1.1, 0.5)
# What the data determine of a logarithm of A, and of p, is 0.3; of a likelihood, 0.5 matters.
_TOLERANCE = {"xatol": 0.1, "fatol": 0.05}


@dataclass(frozen=True, eq=False)
class FormTerms:
    """Coefficients of Zernike terms of the form.

    values: (k,) [m];  covariance: (k, k) [m²];  degrees, symmetric: of the terms (k,)
    """

    values: FloatArray
    covariance: FloatArray
    degrees: IntArray
    symmetric: BoolArray

    def looks_like(self, columns: FloatArray, wide: float) -> tuple[float, FloatArray]:
        """Return twice the logarithm by which a family raises the likelihood, and its values.

        columns: change of the terms per unit of the family (k, size);  wide: its plausible size
        """
        alone = self._best(np.zeros((len(self.values), 1)))[0]
        gains, found = [], []
        for size in wide * _SIZES:
            likelihood, spread = self._best(columns * size)
            gains.append(2 * (likelihood - alone))
            found.append(size**2 * columns.T @ linalg.solve(spread, self.values, assume_a="pos"))
        weights = np.exp((np.array(gains) - max(gains)) / 2)
        gain = max(gains) + 2 * np.log(np.mean(weights))
        return float(gain), np.asarray(weights @ np.array(found) / np.sum(weights))

    def _best(self, columns: FloatArray) -> tuple[float, FloatArray]:
        """Return the largest log likelihood with ``columns`` of unit variance, and its spread."""
        known = self.covariance + columns @ columns.T
        start = np.log(np.mean(self.values**2 * self.degrees**_START_POWER) + 1e-30)

        def spread(law: FloatArray) -> FloatArray:
            amplitude = np.exp(np.where(self.symmetric, law[1], law[0]))
            return np.asarray(known + np.diag(amplitude * self.degrees ** -law[2]))

        def misfit(law: FloatArray) -> float:
            root = linalg.cholesky(spread(law), lower=True)
            white = linalg.solve_triangular(root, self.values, lower=True)
            return float(np.sum(np.log(np.diag(root))) + white @ white / 2)

        best = optimize.minimize(misfit, [start, start, _START_POWER], method="Nelder-Mead",
                                 options=_TOLERANCE)  # fmt: skip
        return -float(best.fun), spread(best.x)
