"""The compiled loop of :func:`scipy.signal.sosfilt` without the package around it.

Loading ``scipy.signal`` takes longer than correcting a scan, and one function of it is needed.
The module that holds the loop is loaded by its file, under its own name, so that whoever
imports ``scipy.signal`` later finds it there; where it is not found, the public function serves.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from functools import lru_cache
from importlib.machinery import PathFinder
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_LOOP = "scipy.signal._sosfilt"


def sosfilt(sections: FloatArray, samples: FloatArray, state: FloatArray) -> FloatArray:
    """Return the response (n,) to ``samples`` (n,); ``state`` (k, 2) is moved on in place.

    sections: second-order sections (k, 6) as in scipy, direct form II transposed
    """
    response = np.array(samples, np.float64, order="C")
    _loop()(sections, response[np.newaxis], state[np.newaxis])
    return response


@lru_cache(maxsize=1)
def _loop() -> Callable[[FloatArray, FloatArray, FloatArray], None]:
    """Return ``f(sections, samples (m, n), state (m, k, 2))``, which works in place."""
    try:
        return _loaded()._sosfilt  # type: ignore[no-any-return]
    except (ImportError, AttributeError):
        return _public


def _loaded() -> Any:
    if _LOOP in sys.modules:
        return sys.modules[_LOOP]
    package = importlib.util.find_spec("scipy")
    folders = [f"{f}/signal" for f in (package and package.submodule_search_locations) or ()]
    spec = PathFinder.find_spec(_LOOP, folders)
    if spec is None or spec.loader is None:
        raise ImportError(f"{_LOOP} is not where it was in scipy 1.17")
    module = importlib.util.module_from_spec(spec)
    sys.modules[_LOOP] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[_LOOP]
        raise
    return module


def _public(sections: FloatArray, samples: FloatArray, state: FloatArray) -> None:
    from scipy import signal

    # Its state counts the sections first, the signals second.
    response, after = signal.sosfilt(sections, samples, zi=np.moveaxis(state, 0, 1))
    samples[:], state[:] = response, np.moveaxis(after, 0, 1)
