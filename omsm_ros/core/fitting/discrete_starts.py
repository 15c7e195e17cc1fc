"""Where the fit of a sampled model starts: poles by ARX, instrumental variables, and subspace.

Each finds what the others miss. Least squares of an ARX model finds a well-damped response in
little noise; instrumental variables find it in coloured noise too; a subspace method finds all
modes of a high order at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.fitting.held_problem import inside_unit_circle
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.least_squares import least_squares

# Steiglitz and McBride (1965): it has converged, or will not.
_ITERATIONS = 8
# Rows of past and of future beyond the highest order.
_SPARE_ROWS = 5
# Thirty times its rows at the highest order; more only cost time.
_MAX_COLUMNS = 5000
# Logarithm of the time constant of a pole too fast to be seen, but not to have a gradient.
_FAST = float(np.log(0.1))


@dataclass(frozen=True, eq=False)
class DiscreteStarts:
    """Proposes poles in z for a record ``input``, ``output`` (n,), compared where ``used`` (n,).

    order: the highest that will be asked for
    """

    input: FloatArray
    output: FloatArray
    used: BoolArray
    order: int

    def poles(self, order: int) -> list[ComplexArray]:
        """Return proposals of ``order`` poles each, conjugates included."""
        found = [self.arx(order), *self._iterated(order)]
        subspace = self._subspace(order)
        return found if subspace is None else [*found, subspace]

    @cached_property
    def _filled(self) -> FloatArray:
        index = np.arange(len(self.used))
        return np.asarray(np.interp(index, index[self.used], self.output[self.used]))

    def _rows(self, order: int) -> BoolArray:
        """Return True where the sample and ``order`` before it are all used, shape (n - order,)."""
        return np.asarray(np.all(sliding_window_view(self.used, order + 1), axis=1))

    def _regressors(
        self, u: FloatArray, y: FloatArray, order: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return columns -y[k-1] … -y[k-n], u[k] … u[k-n], 1 and target y[k], if all are used."""
        rows = self._rows(order)
        past = sliding_window_view(y, order + 1)[rows][:, ::-1]
        drive = sliding_window_view(u, order + 1)[rows][:, ::-1]
        return np.column_stack([-past[:, 1:], drive, np.ones(len(drive))]), past[:, 0]

    def arx(self, order: int) -> ComplexArray:
        """Return the poles in z (``order``,) of the equation-error fit, ARX."""
        columns, target = self._regressors(self.input, self._filled, order)
        return _poles(least_squares(columns, target)[:order])

    def _iterated(self, order: int) -> list[ComplexArray]:
        """Return poles by instrumental variables, then by Steiglitz and McBride's iteration."""
        columns, target = self._regressors(self.input, self._filled, order)
        found = least_squares(columns, target)
        try:
            simulated = signal.lfilter(
                found[order:-1], np.poly(inside_unit_circle(_poles(found[:order]))).real, self.input
            )
            instruments, _ = self._regressors(self.input, simulated, order)
            by_instruments = np.asarray(
                np.linalg.solve(instruments.T @ columns, instruments.T @ target), np.float64
            )
        except np.linalg.LinAlgError:
            return []
        poles = _poles(by_instruments[:order])
        return [p for p in (poles, self._prefiltered(order, poles)) if len(p) == order]

    def _prefiltered(self, order: int, poles: ComplexArray) -> ComplexArray:
        for _ in range(_ITERATIONS):
            denominator = np.poly(inside_unit_circle(poles)).real
            u, y = (
                signal.lfilter([1.0], denominator, values) for values in (self.input, self._filled)
            )
            columns, target = self._regressors(u, y, order)
            if not np.all(np.isfinite(columns)):
                break
            poles = _poles(least_squares(columns, target)[:order])
        return poles

    @cached_property
    def _observability(self) -> tuple[FloatArray, FloatArray] | None:
        """Singular vectors and values of the future output, past as instrument (PO-MOESP)."""
        rows = self.order + _SPARE_ROWS
        if len(self.used) < 4 * rows:
            return None
        places = np.flatnonzero(np.all(sliding_window_view(self.used, 2 * rows), axis=1))
        if len(places) < 6 * rows:
            return None
        places = places[:: -(-len(places) // _MAX_COLUMNS)]
        u, y = (sliding_window_view(v, 2 * rows)[places] for v in (self.input, self._filled))
        stacked = np.concatenate([u[:, rows:], u[:, :rows], y[:, :rows], y[:, rows:]], axis=1)
        lower = np.asarray(np.linalg.qr(stacked - np.mean(stacked, axis=0), mode="r")).T
        left, values, _ = np.linalg.svd(lower[3 * rows :, rows : 3 * rows])
        return left, values

    def _subspace(self, order: int) -> ComplexArray | None:
        found = self._observability
        if found is None:
            return None
        basis = found[0][:, :order] * np.sqrt(found[1][:order])
        return np.asarray(np.linalg.eigvals(np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0]))


def _poles(coefficients: FloatArray) -> ComplexArray:
    """Return the poles in z of 1 + a1 q + … + an q^n."""
    if not np.all(np.isfinite(coefficients)):
        return np.empty(0, np.complex128)
    return np.asarray(np.roots(np.concatenate([[1.0], coefficients])), np.complex128)


def grown(smaller: Sequence[FloatArray], samples: int) -> list[FloatArray]:
    """Return the starts for one pole more than the last of ``smaller``.

    A pole too fast to matter, so that a larger model never fits worse; and two as slow as the
    record is long: descent alone does not reach a pair of integrators from other starts.
    """
    slow = np.log(samples / 2)
    fast = [with_fast_pole(smaller[-1])]
    return fast + [_with_pole(_with_pole(found, slow), slow) for found in smaller[-2:-1]]


def with_fast_pole(nonlinear: FloatArray) -> FloatArray:
    """Return ψ (n+1,) of ``nonlinear`` (n,) with a pole too fast to matter."""
    return _with_pole(nonlinear, _FAST)


def _with_pole(nonlinear: FloatArray, log_time: float) -> FloatArray:
    """Return ψ (n+1,) of the denominator of ``nonlinear`` (n,) times 1 + e^log_time w."""
    pairs, odd = divmod(len(nonlinear), 2)
    first, second = nonlinear[:pairs], nonlinear[pairs + odd :]
    if not odd:
        return np.concatenate([first, [log_time], second])
    merged = np.logaddexp(nonlinear[pairs], log_time)
    return np.concatenate([first, [merged], second, [nonlinear[pairs] + log_time]])
