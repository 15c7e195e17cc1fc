"""Linear algebra of small problems: scaled least squares, filters, and the threads of BLAS.

Columns may have any units: each is scaled to unit length first.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
# Rows and values of a matrix held in memory at a time, where a long record is processed in blocks:
# half a megabyte a column, 32 MB in all.
BLOCK_ROWS, BLOCK_VALUES = 65_536, 4_000_000
# Directions of products of columns weaker than this part of the strongest are rounding.
ROUNDING = 1e-13


def unit_columns(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``columns`` (n, q) over their lengths, and the lengths (q,); 1 for a zero column."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    return columns / scale, scale


def least_squares(
    columns: FloatArray, values: FloatArray, tolerance: float | None = None
) -> FloatArray:
    """Return the coefficients (q,) with which ``columns`` (n, q) come nearest to ``values`` (n,).

    tolerance: singular values below this part of the largest count as zero; None for rounding
    """
    unit, scale = unit_columns(columns)
    return np.asarray(np.linalg.lstsq(unit, values, rcond=tolerance)[0] / scale)


def basis_and_inverse(columns: FloatArray, tolerance: float) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis (n, r) of what ``columns`` (n, q) span, and parameters (q, r).

    The basis is ``columns`` times the parameters.
    tolerance: directions weaker than this part of the strongest are left out

    Triangles of blocks of rows, which stay in the cache, are factorised together (Demmel et al.
    2012): six times as fast as a decomposition of all rows.
    """
    unit, scale = unit_columns(columns)
    blocks = (unit[i : i + BLOCK_ROWS // 8] for i in range(0, len(unit), BLOCK_ROWS // 8))
    triangles = [np.linalg.qr(block, mode="r") for block in blocks]
    _, values, right = np.linalg.svd(np.concatenate(triangles), full_matrices=False)
    kept = values > tolerance * values[0]
    inverse = right[kept].T / values[kept]
    # In the memory order of the columns.
    return (inverse.T @ unit.T).T, inverse / scale[:, np.newaxis]


def inverse_gram(gram: FloatArray, tolerance: float = ROUNDING) -> FloatArray:
    """Return the pseudoinverse of products of columns (q, q), without what is rounding."""
    root = inverse_root(gram, tolerance)
    return np.asarray(root @ root.T)


def inverse_root(
    gram: FloatArray, tolerance: float = ROUNDING, *, keep: bool = False
) -> FloatArray:
    """Return R (q, r) with R Rᵀ the pseudoinverse of products of columns (q, q).

    tolerance: scaled directions weaker than this part of the strongest are lost in rounding
    keep: those count as the weakest that is not, instead of being left out
    """
    scale = np.sqrt(np.maximum(gram.diagonal(), 0.0))  # rounding may leave less than nothing
    scale[scale == 0] = 1.0
    values, directions = np.linalg.eigh(gram / np.multiply.outer(scale, scale))
    least = tolerance * np.max(values, initial=0.0)
    kept = (values > least) | keep
    values = np.maximum(values[kept], least)
    return np.asarray(directions[:, kept] / np.sqrt(values) / scale[:, np.newaxis])


def without_copy(places: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """Return rising ``places`` (k,) as a slice where none between them is missing."""
    whole = len(places) > 0 and places[-1] - places[0] < len(places)
    return slice(int(places[0]), int(places[-1]) + 1) if whole else places


# The limit of BLAS to one thread, shared by all that ask for it at the same time.
_lock, _users, _limit = threading.Lock(), 0, None


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS compute in one thread; also a decorator.

    The order of additions in a sum depends on the number of threads, so that a search would end at
    other bits, or at another model. Threads cost more than they gain in matrices of this size.
    """
    global _users, _limit
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:  # nodes and commands ask BLAS for one thread as they start
        threadpool_limits = None
    with _lock:
        if _users == 0 and threadpool_limits is not None:
            _limit = threadpool_limits(1, user_api="blas")
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0 and _limit is not None:
                _limit.restore_original_limits()


@cache  # made when it is needed: every command loads this module, and scipy.signal takes longer
def _sosfilt() -> Callable[[Any, Any, Any], None]:
    try:
        from scipy.signal._sosfilt import _sosfilt as loop
    except ImportError:  # a private name; the public function is slower with short blocks
        from scipy.signal import sosfilt as public

        def loop(sections: Any, samples: Any, state: Any) -> None:
            samples[0], state[0] = public(sections, samples[0], zi=state[0])

    return loop  # type: ignore[no-any-return]


def sosfilt(
    sections: FloatArray, samples: FloatArray, state: FloatArray, out: FloatArray | None = None
) -> FloatArray:
    """Return the response (n,) to ``samples`` (n,); ``state`` (k, 2) is moved on in place.

    sections: second-order sections (k, 6) as in scipy, direct form II transposed
    out: where the response is written, (n,) without gaps; None makes room for it

    The compiled loop of :func:`scipy.signal.sosfilt`, whose checks take longer than a short block.
    """
    response = np.empty(len(samples)) if out is None else out
    response[:] = samples
    _sosfilt()(sections, response[np.newaxis], state[np.newaxis])
    return response
