"""Linear algebra of small problems: scaled least squares, and the threads of BLAS.

Columns may have any units: each is scaled to unit length first.
"""

import importlib.util
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.machinery import PathFinder
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
# Rows and values of a matrix held in memory at a time, where a long record is processed in blocks:
# half a megabyte a column, 32 MB in all.
BLOCK_ROWS, BLOCK_VALUES = 65_536, 4_000_000


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


def orthonormal(columns: FloatArray, tolerance: float) -> FloatArray:
    """Return a basis (n, r) of what ``columns`` (n, q) span.

    tolerance: directions weaker than this part of the strongest are left out
    """
    left, values, _ = np.linalg.svd(unit_columns(columns)[0], full_matrices=False)
    return np.asarray(left[:, values > tolerance * values[0]])


def triangle(*parts: FloatArray) -> FloatArray:
    """Return R (q, q) of the columns of all ``parts`` (n, …), side by side, without making Q.

    Block by block, so that a long record's columns are never in memory twice.
    """
    found = np.zeros((0, sum(part.shape[1] for part in parts)))
    for first in range(0, len(parts[0]), BLOCK_ROWS):
        block = np.column_stack([part[first : first + BLOCK_ROWS] for part in parts])
        found = np.asarray(np.linalg.qr(np.concatenate([found, block]), mode="r"))
    return found


class _OneThread:
    """The limit of BLAS to one thread, shared by all that ask for it at the same time."""

    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0
        self._limit: Any = None

    def enter(self) -> None:
        try:
            from threadpoolctl import threadpool_limits
        except ImportError:  # nodes and commands ask BLAS for one thread as they start
            threadpool_limits = None
        with self._lock:
            if self._users == 0 and threadpool_limits is not None:
                self._limit = threadpool_limits(1, user_api="blas")
            self._users += 1

    def leave(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._limit is not None:
                self._limit.restore_original_limits()


_one_thread = _OneThread()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS compute in one thread; also a decorator.

    The order of additions in a sum depends on the number of threads, so that a search would end at
    other bits, or at another model. Threads cost more than they gain in matrices of this size.
    """
    _one_thread.enter()
    try:
        yield
    finally:
        _one_thread.leave()


# Loading ``scipy.signal`` and ``scipy.linalg`` takes longer than correcting a scan, and one
# compiled function of each is needed. The module that holds it is loaded from its file, under its
# own name, so that a later import of the package finds it there. Where scipy has moved it, the
# public function is used: it gives the same numbers, half a second later.

ComplexArray = NDArray[np.complex128]


def sosfilt(
    sections: FloatArray, samples: FloatArray, state: FloatArray, out: FloatArray | None = None
) -> FloatArray:
    """Return the response (n,) to ``samples`` (n,); ``state`` (k, 2) is moved on in place.

    sections: second-order sections (k, 6) as in scipy, direct form II transposed
    out: where the response is written, (n,) without gaps; None makes room for it
    """
    response = np.empty(len(samples)) if out is None else out
    response[:] = samples
    _filter_loop()(sections, response[np.newaxis], state[np.newaxis])
    return response


def generalised_eigenvalues(a: FloatArray, b: FloatArray) -> ComplexArray:
    """Return λ (n,) with det(a - λ b) = 0, infinite ones as infinity or not a number."""
    return np.asarray(_pencil_solver()(a, b), np.complex128)


@lru_cache(maxsize=1)
def _filter_loop() -> Any:
    """Return ``f(sections, samples (m, n), state (m, k, 2))``, which works in place."""
    module = _loaded("scipy.signal._sosfilt")
    return getattr(module, "_sosfilt", _public_loop)


@lru_cache(maxsize=1)
def _pencil_solver() -> Any:
    module = _loaded("scipy.linalg._flapack")
    return _by_lapack if hasattr(module, "dggev") else _public_solver


def _loaded(name: str) -> ModuleType | None:
    """Return the compiled module, or None if it is not where it was in scipy 1.17."""
    if name in sys.modules:
        return sys.modules[name]
    scipy = importlib.util.find_spec("scipy")
    place = name.split(".")[1]
    folders = [f"{f}/{place}" for f in (scipy and scipy.submodule_search_locations) or ()]
    spec = PathFinder.find_spec(name, folders)
    if spec is None or spec.loader is None:
        return None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except ImportError:
        del sys.modules[name]
        return None
    return module


def _by_lapack(a: FloatArray, b: FloatArray) -> ComplexArray:
    lapack = sys.modules["scipy.linalg._flapack"]
    real, imaginary, scale, _, _, _, failed = lapack.dggev(a, b, compute_vl=0, compute_vr=0)
    if failed:
        return _public_solver(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((real + 1j * imaginary) / scale, np.complex128)


def _public_loop(sections: FloatArray, samples: FloatArray, state: FloatArray) -> None:
    from scipy import signal

    # Its state counts the sections first, the signals second.
    response, after = signal.sosfilt(sections, samples, zi=np.moveaxis(state, 0, 1))
    samples[:], state[:] = response, np.moveaxis(after, 0, 1)


def _public_solver(a: FloatArray, b: FloatArray) -> ComplexArray:
    from scipy import linalg

    return np.asarray(linalg.eigvals(a, b), np.complex128)
