"""How many states stand out of the noise: the singular values of a block-Hankel matrix.

The future output is projected on the past along the future input (Verhaegen and Dewilde
1992, the instrument of the paper's refs. 35 and 36); noise alone gives singular values
below a limit that random matrix theory knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.samples.blocks import BoolArray, FloatArray

MAX_ORDER = 8
# Past and future of the Hankel matrix together span this time, within these numbers of rows.
_HANKEL_SPAN_S = 15e-3
_HANKEL_ROWS = (6, 24)
_MAX_HANKEL_COLUMNS = 20_000


@dataclass(frozen=True, eq=False)
class OrderEstimate:
    """What the singular values say; empty where the data were too few.

    singular_values: in units of the largest that noise alone would give
    order: how many exceed it;  poles: of that order [rad/s]
    """

    singular_values: FloatArray
    order: int
    poles: ComplexArray


def estimate_order(
    motion: FloatArray, deviation: FloatArray, used: BoolArray, period: float
) -> OrderEstimate:
    """States between the increments of ``motion`` and its ``deviation`` from static, all (n,).

    The deviation (G - 1) u vanishes for a motion at rest, so increments as input have
    the same poles as G, and neither level nor offset of either signal matters.
    """
    rows = int(np.clip(round(_HANKEL_SPAN_S / period / 2), *_HANKEL_ROWS))
    empty = OrderEstimate(np.empty(0), 0, np.empty(0, np.complex128))
    if len(motion) <= 2 * rows + 1:
        return empty
    steps = np.diff(motion, prepend=motion[0])
    whole = np.all(sliding_window_view(used, 2 * rows), axis=1)
    energy = np.convolve(steps**2, np.ones(2 * rows), "valid")
    # Columns in which nothing moves tell about noise only, and there are many of them.
    active = np.flatnonzero(whole & (energy > 1e-4 * np.max(energy)))
    if len(active) < 8 * rows:
        return empty
    active = active[:: -(-len(active) // _MAX_HANKEL_COLUMNS)]
    inputs = sliding_window_view(steps, 2 * rows)[active]
    outputs = sliding_window_view(np.where(used, deviation, 0.0), 2 * rows)[active]
    return _subspace(inputs, outputs, rows, period)


def _subspace(inputs: FloatArray, outputs: FloatArray, rows: int, period: float) -> OrderEstimate:
    stacked = np.concatenate(
        [inputs[:, rows:], inputs[:, :rows], outputs[:, :rows], outputs[:, rows:]], axis=1
    )
    lower = np.asarray(np.linalg.qr(stacked, mode="r")).T
    future, noise = lower[3 * rows :, rows : 3 * rows], lower[3 * rows :, 3 * rows :]
    left, values, _ = np.linalg.svd(future)
    sigma = np.linalg.norm(noise) / np.sqrt(rows * len(inputs))
    # Largest singular value of a rows × 2 rows matrix of noise (Marchenko and Pastur).
    limit = float(sigma * (np.sqrt(rows) + np.sqrt(2 * rows))) or np.finfo(np.float64).tiny
    order = min(int(np.sum(values > limit)), MAX_ORDER, rows - 1)
    observability = left[:, :order] * np.sqrt(values[:order])
    shift = np.linalg.lstsq(observability[:-1], observability[1:], rcond=None)[0]
    roots = np.linalg.eigvals(shift) if order else np.empty(0)
    with np.errstate(divide="ignore"):
        poles = np.log(roots.astype(np.complex128)) / period
    return OrderEstimate(values / limit, order, np.asarray(poles, np.complex128))
