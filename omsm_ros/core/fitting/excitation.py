"""How many parameters of a linear model does an input excite?"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray

# Of the power of the strongest direction: what is weaker is rounding of a text with six digits.
_NOTHING = 1e-12


def excited_parameters(input: FloatArray, most: int) -> int:
    """Return how many parameters ``input`` (n,) can tell, at most ``most``.

    The order to which it is persistently exciting beside a constant (Ljung 1999, ch. 13): of all
    windows of ``most`` samples, how many are independent. Each sine gives two; noise, all.
    """
    windows = np.lib.stride_tricks.sliding_window_view(input, most)
    varied = windows - np.mean(windows, axis=0)
    power = np.linalg.eigvalsh(varied.T @ varied)
    return int(np.sum(power > _NOTHING * power[-1]))
