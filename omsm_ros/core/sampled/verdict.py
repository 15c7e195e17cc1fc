"""May a sampled model be used, and between which frequencies?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from omsm_ros.core.dynamics.calibration import REJECTED
from omsm_ros.core.dynamics.response_band import COVERAGE_FACTOR, Band, ResponseLimits
from omsm_ros.core.samples.blocks import BoolArray
from omsm_ros.readable import chance, percent, plain, quantity

# A tenth of the gain, and as much of a radian: a model of a process, not of a measuring machine.
SAMPLED_LIMITS = ResponseLimits(gain=0.1, phase=0.1)
# Half of the variance of what the model has not seen: with less it is no model to run freely.
_LEAST_PREDICTED = 0.5
# A residual that follows the input by chance once in ten thousand records.
_LEAST_INDEPENDENCE_P = 1e-4


def longest_range(
    band: Band, limits: ResponseLimits, shown: BoolArray | None = None
) -> tuple[float, float]:
    """Return the widest range [Hz], in octaves, in which the 95 % band keeps within ``limits``.

    shown: where the data would show a response beyond them, (k,) at the frequencies of the band;
        None for everywhere
    Both ends are the lowest frequency of the band where there is none.
    """
    inside = (COVERAGE_FACTOR * band.gain <= limits.gain) & (
        COVERAGE_FACTOR * band.phase <= limits.phase
    )
    inside = inside if shown is None else inside & shown
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    if not len(edges):
        return float(band.frequency[0]), float(band.frequency[0])
    starts, stops = edges[::2], edges[1::2] - 1
    octaves = np.log2(band.frequency[stops] / band.frequency[starts])
    widest = int(np.argmax(octaves))
    return float(band.frequency[starts[widest]]), float(band.frequency[stops[widest]])


def sampled_certificate(
    *,
    order: int,
    free_order: int,
    widened: float,
    valid: tuple[float, float],
    limits: ResponseLimits,
    entries: Mapping[str, object],
) -> dict[str, object]:
    """Return JSON values, ending with ``reasons``, ``warnings`` and ``verdict``.

    order, free_order: number of poles of the model, and of the free choice
    widened: factor on its uncertainties, for an order that was asked for
    valid: range [Hz] within ``limits``
    entries: with "predicted", the share of the variance of the hidden parts that free runs explain
    """
    predicted = entries["predicted"]
    assert isinstance(predicted, float)
    reasons = _reasons(predicted, valid, limits)
    low, high = (quantity(end, "Hz") for end in valid)
    return {
        "order": order,
        "free_order": free_order,
        **entries,
        "limits": {
            "gain": limits.gain,
            "phase_rad": limits.phase,
            "predicted_least": _LEAST_PREDICTED,
        },
        "warnings": _warnings(entries.get("independence_p"), order, free_order, widened),
        "reasons": reasons,
        "verdict": REJECTED if reasons else f"accepted from {low} to {high}",
    }


def _reasons(predicted: float, valid: tuple[float, float], limits: ResponseLimits) -> list[str]:
    reasons = []
    if not predicted >= _LEAST_PREDICTED:
        reasons.append(
            "free runs over parts of the record that were hidden account for "
            f"{percent(predicted, 3)} of the variance there, less than "
            f"{percent(_LEAST_PREDICTED)}: it describes what was fitted only; record longer, or "
            "look for a further input or a drift"
        )
    if not valid[1] > valid[0]:
        reasons.append(
            f"the response is known nowhere to {percent(limits.gain, 1)} of gain and "
            f"{quantity(limits.phase, 'rad', 2)}; record longer, or excite more"
        )
    return reasons


def _warnings(independent: object, order: int, free_order: int, widened: float) -> list[str]:
    warnings = []
    if isinstance(independent, float) and independent < _LEAST_INDEPENDENCE_P:
        warnings.append(
            f"the residual follows the input ({chance(independent)}): more poles, a longer delay, "
            "or something that is not linear"
        )
    if order != free_order:
        warnings.append(
            f"order {order} was asked for, {free_order} would have been chosen: "
            f"its uncertainties are taken {plain(widened, 2)} times as large"
        )
    return warnings
