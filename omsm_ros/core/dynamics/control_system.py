"""Hand-over of an identified G(s) to python-control, for its plots, margins and designs."""

from __future__ import annotations

import control
import numpy as np

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.errors import ConfigurationError


def to_control(dynamics: TransferFunction, delay_order: int = 3) -> control.TransferFunction:
    """Return ``dynamics`` as a ``control.TransferFunction`` in rad/s.

    A delay becomes a Padé approximant of ``delay_order``, good up to about
    ``delay_order / delay`` rad/s: python-control has no delay of its own.
    Raises ConfigurationError for a delay_order that is not positive.
    """
    if delay_order < 1:
        raise ConfigurationError(f"delay_order {delay_order!r}, expected 1 or more")
    rational = control.TransferFunction(dynamics.numerator[::-1], dynamics.denominator[::-1])
    if dynamics.delay == 0:
        return rational
    numerator, denominator = control.pade(dynamics.delay, delay_order)
    return rational * control.TransferFunction(np.asarray(numerator), np.asarray(denominator))
