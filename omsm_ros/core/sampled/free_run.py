"""What does a sampled model make of an input alone?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.recursion import Recursion
from omsm_ros.core.sampled.model import Discrete, SampledModel
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.errors import IdentificationError
from omsm_ros.least_squares import least_squares

# The least that shows more than an initial state of 20 poles and an offset.
_LEAST_SAMPLES = 50
# The square of a smaller change, over a noise that is smaller still, is no float.
_LEAST_CHANGE = 1e-50


@dataclass(frozen=True, eq=False)
class FreeRun:
    """output, residual: (n,), in the units of the record; the residual NaN where nothing counts
    explained: part of the variance of what was measured [1];  rms: of the residual
    """

    output: FloatArray
    residual: FloatArray
    explained: float
    rms: float


def free_run(
    model: SampledModel, input: FloatArray, output: FloatArray, used: BoolArray | None = None
) -> FreeRun:
    """Return the output that ``model`` makes of ``input`` (n,) beside the measured ``output`` (n,).

    used: True where the output counts, None where it is finite

    Nothing of the model is fitted again; only the state that it starts in, and a constant, are
    taken from the output. Samples are a ``sample_period`` of the model apart.

    Raises IdentificationError for a record that is too short, that does not change, or of whose
    input something is missing.
    """
    counted = np.isfinite(output) if used is None else used & np.isfinite(output)
    if np.sum(counted) < _LEAST_SAMPLES or len(input) != len(output):
        raise IdentificationError(
            f"input of {len(input)!r} samples, output of {int(np.sum(counted))!r} that count; "
            f"at least {_LEAST_SAMPLES} of both are needed; record longer"
        )
    check_input(input)
    check_changes(output[counted], "output")
    driven, free = _responses(model, input - model.working_point[0])
    columns = np.column_stack([*free, np.ones(len(input))])
    unknown = least_squares(columns[counted], (output - driven)[counted])
    run = driven + columns @ unknown
    residual = np.where(counted, output - run, np.nan)
    rms = float(np.sqrt(np.mean(residual[counted] ** 2)))
    variance = float(np.var(output[counted]))
    return FreeRun(np.asarray(run), residual, 1 - rms**2 / variance, rms)


def check_input(input: FloatArray) -> None:
    """Raise IdentificationError for an input that does not change, or of which a value is missing.

    What follows a missing value would be as unknown as it is.
    """
    missing = int(np.count_nonzero(~np.isfinite(input)))
    if missing:
        raise IdentificationError(
            f"the input has {missing!r} values that are not finite; cut the record there, or fill "
            "them in"
        )
    check_changes(input, "input")


def check_changes(values: FloatArray, name: str) -> None:
    """Raise IdentificationError for a column that does not change; what is finite of it counts."""
    values = values[np.isfinite(values)]
    change = float(np.ptp(values)) if len(values) else 0.0
    if change <= _LEAST_CHANGE:
        raise IdentificationError(
            f"the {name} changes by {change:g} in all, which tells nothing; excite it while "
            "recording, or give it in a larger unit"
        )


def resting_output(
    discrete: Discrete, input: FloatArray, output: FloatArray, used: BoolArray
) -> float:
    """Return the output at which ``discrete`` rests where ``input`` (n,) has its mean."""
    driven, free = _held_responses(discrete, input - np.mean(input))
    columns = np.column_stack([*free, np.ones(len(input))])
    return float(least_squares(columns[used], (output - driven)[used])[-1])


def _responses(model: SampledModel, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return response (n,) to ``motion``, and (k, n) to each state that the model may start in."""
    if model.discrete is not None:
        return _held_responses(model.discrete, motion)
    assert model.continuous is not None  # a band-limited model has nothing else
    recursion = Recursion(discretise(model.continuous, model.sample_period))
    recursion.start(motion[:1])
    poles = np.exp(model.continuous.poles() * model.sample_period)
    return recursion.run(motion), _decays(np.real(np.poly(poles)), len(poles), len(motion))


def _held_responses(discrete: Discrete, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
    late = np.roll(motion, discrete.delay)
    late[: discrete.delay] = 0.0
    driven = signal.lfilter(discrete.numerator, discrete.denominator, late)
    states = max(len(discrete.denominator) - 1 + discrete.delay, 1)
    return np.asarray(driven), _decays(discrete.denominator, states, len(motion))


def _decays(denominator: FloatArray, states: int, samples: int) -> FloatArray:
    """Return the responses (states, n) to a pulse at each of the first samples."""
    return np.asarray(signal.lfilter([1.0], denominator, np.eye(states, samples), axis=1))
