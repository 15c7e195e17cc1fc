"""Sampled model of any two quantities: coefficients with uncertainty, its file, and free runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import signal

from omsm_ros.core.calibration.plausibility import MAX_DELAY_SAMPLES as LONGEST_DELAY_SAMPLES
from omsm_ros.core.calibration.plausibility import checked_roots
from omsm_ros.core.estimation.steps import LEAST_SAMPLES
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.frequency_response import Band
from omsm_ros.core.lti.recursion import Recursion
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import CalibrationError, IdentificationError, OmsmError
from omsm_ros.linear_algebra import least_squares
from omsm_ros.quantities import FREQUENCY, MAX_DELAY_SAMPLES, SAMPLE_PERIOD, SIGNAL

SCHEMA = "omsm-model/1"
BAND_LIMITED = "band-limited"
_ENDS = ("from", "up_to")


@dataclass(frozen=True, eq=False, kw_only=True)
class Discrete:
    """``H = (b0 + b1 z⁻¹ + …)/(1 + a1 z⁻¹ + …) · z^-delay``.

    numerator: (m+1,);  denominator: (n+1,), its first is 1;  delay: whole samples
    covariance: (m + 1 + n,) squared, order numerator, denominator[1:]
    """

    numerator: FloatArray
    denominator: FloatArray
    delay: int
    covariance: FloatArray

    def response(self, frequency: FloatArray, period: float) -> ComplexArray:
        """Return H at ``frequency`` (k,) [Hz], for samples every ``period`` [s]."""
        q = np.exp(-2j * np.pi * np.asarray(frequency) * period)
        up, down = (np.polynomial.polynomial.polyval(q, c) for c in self._both)
        return np.asarray(up / down * q**self.delay, np.complex128)

    def band(self, frequency: FloatArray, period: float) -> Band:
        """Return the standard uncertainty of relative gain and of phase at ``frequency`` [Hz]."""
        q = np.exp(-2j * np.pi * np.asarray(frequency) * period)[:, np.newaxis]
        up, down = (np.polynomial.polynomial.polyval(q, c) for c in self._both)
        jacobian = np.concatenate(
            [
                q ** np.arange(len(self.numerator)) / up,
                -(q ** np.arange(1, len(self.denominator))) / down,
            ],
            axis=1,
        )
        variance = [
            np.einsum("kp,pq,kq->k", part, self.covariance, part)
            for part in (jacobian.real, jacobian.imag)
        ]
        gain, phase = np.sqrt(np.maximum(variance, 0.0))
        return Band(np.asarray(frequency, np.float64), gain, phase)

    @property
    def _both(self) -> tuple[FloatArray, FloatArray]:
        return self.numerator, self.denominator


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledModel:
    """A model of samples of ``output`` from samples of ``input``, in the units of the record.

    hold: of the input between samples: "band-limited", "zero-order" or "first-order"
    working_point: input and its steady output; the model is of deviations from both
    discrete: the model of a held input, None of a band-limited one
    continuous: G(s) with its gain; of a held input the one equivalent to ``discrete``, or None
    covariance: (p, p) of ``continuous``, order numerator, denominator[1:], delay; None of a held
        input, whose covariance is in ``discrete``
    valid_from, valid_up_to: [Hz] between which the 95 % band is within the limits; equal if it is
        nowhere
    certificate: JSON values
    """

    hold: str
    sample_period: float
    discrete: Discrete | None
    continuous: TransferFunction | None
    covariance: FloatArray | None
    valid_from: float
    valid_up_to: float
    working_point: tuple[float, float]
    certificate: Mapping[str, object] = field(default_factory=dict)

    def content(self) -> dict[str, object]:
        """Return the model as JSON values."""
        return {
            "schema": SCHEMA,
            "hold": self.hold,
            "sample_period": self.sample_period,
            "discrete": None if self.discrete is None else _discrete_content(self.discrete),
            "continuous": None if self.continuous is None else self._continuous_content(),
            "working_point": list(self.working_point),
            "valid_from": self.valid_from,
            "valid_up_to": self.valid_up_to,
            "certificate": dict(self.certificate),
        }

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> SampledModel:
        """Return the inverse of :meth:`content`, for values of the right types.

        Raises CalibrationError for an inconsistent model, or one that cannot be computed.
        """
        period = SAMPLE_PERIOD.checked(content["sample_period"], CalibrationError)
        continuous, covariance = _continuous_of(content["continuous"], period)
        discrete = None if content["discrete"] is None else _discrete_of(content["discrete"])
        lacks = covariance if content["hold"] == BAND_LIMITED else discrete
        if lacks is None:
            raise CalibrationError("estimation.missing_part", hold=content["hold"])
        if content["hold"] == BAND_LIMITED and continuous is not None:
            _check_runs(continuous)
        valid = [FREQUENCY.checked(content[f"valid_{end}"], CalibrationError) for end in _ENDS]
        point = [SIGNAL.checked(value, CalibrationError) for value in content["working_point"]]
        return cls(
            hold=content["hold"],
            sample_period=period,
            discrete=discrete,
            continuous=continuous,
            covariance=covariance,
            valid_from=valid[0],
            valid_up_to=valid[1],
            working_point=(point[0], point[1]),
            certificate=content["certificate"],
        )

    def _continuous_content(self) -> dict[str, object]:
        assert self.continuous is not None
        return {
            "numerator": self.continuous.numerator.tolist(),
            "denominator": self.continuous.denominator.tolist(),
            "delay": self.continuous.delay,
            "covariance": None if self.covariance is None else self.covariance.ravel().tolist(),
        }


def _continuous_of(
    content: Mapping[str, Any] | None, period: float
) -> tuple[TransferFunction | None, FloatArray | None]:
    if content is None:
        return None, None
    if content["delay"] > LONGEST_DELAY_SAMPLES * period:
        raise CalibrationError(
            "estimation.long_delay",
            delay=content["delay"],
            most=LONGEST_DELAY_SAMPLES,
            period=period,
        )
    try:
        dynamics = TransferFunction(
            np.asarray(content["numerator"], np.float64),
            np.asarray(content["denominator"], np.float64),
            content["delay"],
        )
    except OmsmError as err:
        raise CalibrationError(err.code, **err.values) from err
    for kind in ("poles", "zeros"):
        checked_roots(dynamics, kind)
    if content["covariance"] is None:
        return dynamics, None
    size = len(dynamics.numerator) + len(dynamics.denominator)
    return dynamics, _square(content["covariance"], size)


def _check_runs(dynamics: TransferFunction) -> None:
    """Raise CalibrationError for a response that is unstable or zero."""
    if not dynamics.is_stable or not np.any(dynamics.numerator):
        raise CalibrationError(
            "estimation.unstable",
            numerator=dynamics.numerator.tolist(),
            denominator=dynamics.denominator.tolist(),
        )


def _discrete_of(content: Mapping[str, Any]) -> Discrete:
    numerator, denominator = (
        SIGNAL.checked_all(np.asarray(content[name], np.float64), CalibrationError, name)
        for name in ("numerator", "denominator")
    )
    if denominator[0] != 1 or np.any(abs(np.roots(denominator)) >= 1):
        raise CalibrationError("estimation.unstable_discrete", denominator=denominator.tolist())
    return Discrete(
        numerator=numerator,
        denominator=denominator,
        delay=MAX_DELAY_SAMPLES.checked(content["delay_samples"], CalibrationError),
        covariance=_square(content["covariance"], len(numerator) + len(denominator) - 1),
    )


def _square(values: Sequence[float], size: int) -> FloatArray:
    """Return a covariance (size, size) from its rows in sequence."""
    if len(values) != size**2:
        raise CalibrationError("estimation.covariance_size", count=len(values), expected=size**2)
    covariance = SIGNAL.checked_all(np.asarray(values, np.float64), CalibrationError)
    square = np.reshape(covariance, (size, size))
    if np.any(np.diag(square) < 0) or not np.allclose(square, square.T, rtol=1e-6):
        raise CalibrationError("estimation.no_covariance")
    return square


def _discrete_content(discrete: Discrete) -> dict[str, object]:
    return {
        "numerator": discrete.numerator.tolist(),
        "denominator": discrete.denominator.tolist(),
        "delay_samples": discrete.delay,
        "covariance": discrete.covariance.ravel().tolist(),
    }


# The square of a smaller change underflows.
_LEAST_CHANGE = 1e-50


@dataclass(frozen=True, eq=False)
class FreeRun:
    """The simulated output and its residual.

    output, residual: (n,), in the units of the record; the residual is NaN where none is counted
    explained: part of the variance of the measured output [1];  rms: of the residual
    """

    output: FloatArray
    residual: FloatArray
    explained: float
    rms: float


def free_run(
    model: SampledModel, input: FloatArray, output: FloatArray, used: BoolArray | None = None
) -> FreeRun:
    """Simulate ``model`` for ``input`` (n,) and compare it with the measured ``output`` (n,).

    used: True where the output counts, None where it is finite

    Only the initial state and a constant are fitted to the output. Samples are a ``sample_period``
    of the model apart.

    Raises IdentificationError for a record that is too short or constant, or for gaps of the input.
    """
    counted = np.isfinite(output) if used is None else used & np.isfinite(output)
    if np.sum(counted) < LEAST_SAMPLES or len(input) != len(output):
        raise IdentificationError(
            "estimation.short_columns",
            input=len(input),
            output=int(np.sum(counted)),
            least=LEAST_SAMPLES,
        )
    check_input(input)
    check_varies(output[counted], "output")
    driven, free = _responses(model, input - model.working_point[0])
    columns = np.column_stack([*free, np.ones(len(input))])
    unknown = least_squares(columns[counted], (output - driven)[counted])
    run = driven + columns @ unknown
    residual = np.where(counted, output - run, np.nan)
    rms = float(np.sqrt(np.mean(residual[counted] ** 2)))
    variance = float(np.var(output[counted]))
    return FreeRun(np.asarray(run), residual, 1 - rms**2 / variance, rms)


def check_input(input: FloatArray) -> None:
    """Raise IdentificationError for a constant input, or one with a missing value.

    After a missing value the output would be unknown.
    """
    missing = int(np.count_nonzero(~np.isfinite(input)))
    if missing:
        raise IdentificationError("estimation.input_gaps", missing=missing)
    check_varies(input, "input")


def check_varies(values: FloatArray, name: str) -> None:
    """Raise IdentificationError for a column whose finite values are constant."""
    values = values[np.isfinite(values)]
    change = float(np.ptp(values)) if len(values) else 0.0
    if change <= _LEAST_CHANGE:
        raise IdentificationError("estimation.constant_column", name=name, change=change)


def stationary_output(
    discrete: Discrete, input: FloatArray, output: FloatArray, used: BoolArray
) -> float:
    """Return the steady output of ``discrete`` at the mean of ``input`` (n,)."""
    driven, free = _zero_order_hold_responses(discrete, input - np.mean(input))
    columns = np.column_stack([*free, np.ones(len(input))])
    return float(least_squares(columns[used], (output - driven)[used])[-1])


def _responses(model: SampledModel, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the response (n,) to ``motion``, and those (k, n) to each initial state."""
    if model.discrete is not None:
        return _zero_order_hold_responses(model.discrete, motion)
    assert model.continuous is not None  # a band-limited model has no other response
    recursion = Recursion(discretise(model.continuous, model.sample_period))
    recursion.start(motion[:1])
    poles = np.exp(model.continuous.poles() * model.sample_period)
    return recursion.run(motion), _decays(np.real(np.poly(poles)), len(poles), len(motion))


def _zero_order_hold_responses(
    discrete: Discrete, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    late = np.roll(motion, discrete.delay)
    late[: discrete.delay] = 0.0
    driven = signal.lfilter(discrete.numerator, discrete.denominator, late)
    states = max(len(discrete.denominator) - 1 + discrete.delay, 1)
    return np.asarray(driven), _decays(discrete.denominator, states, len(motion))


def _decays(denominator: FloatArray, states: int, samples: int) -> FloatArray:
    """Return the responses (states, n) to a pulse at each of the first samples."""
    return np.asarray(signal.lfilter([1.0], denominator, np.eye(states, samples), axis=1))
