"""Sampled model of an output from one or more inputs: its file, and free runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from omsm_ros.core.calibration.plausibility import MAX_DELAY_SAMPLES as LONGEST_DELAY_SAMPLES
from omsm_ros.core.estimation.parallel_sections import BAND_LIMITED, ParallelSections
from omsm_ros.core.estimation.steps import LEAST_SAMPLES
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import CalibrationError, IdentificationError
from omsm_ros.linear_algebra import least_squares
from omsm_ros.quantities import FREQUENCY, SAMPLE_PERIOD, SIGNAL

SCHEMA = "omsm-model/2"
# Most poles whose polynomials are stated, too: beyond, their coefficients lose too many digits.
_POLYNOMIAL_POLES = 12
# Largest d1, d2 and numerators per power of the sample period: 1e9 samples.
_SLOWEST_SAMPLES = 1e9


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledModel:
    """A model of samples of an output from samples of its inputs, in the units of the record.

    sections: the responses, with covariance
    working_point: means of the inputs and the steady output there; the model is of deviations
    valid: [Hz] for each input, between which it is known within the limits; equal if nowhere
    certificate: JSON values
    """

    sections: ParallelSections
    valid: Sequence[tuple[float, float]]
    working_point: Sequence[float]
    certificate: Mapping[str, object] = field(default_factory=dict)

    @property
    def hold(self) -> str:
        """Return the behaviour of the inputs between samples."""
        return self.sections.hold

    @property
    def sample_period(self) -> float:
        """Return the sample period [s]."""
        return self.sections.period

    @property
    def continuous(self) -> TransferFunction | None:
        """Return G(s) of the first input as polynomials; None if there is none, or many poles."""
        found = self.sections.equivalent()
        if found is None or found.order > _POLYNOMIAL_POLES:
            return None
        return found.transfer_function()

    def content(self) -> dict[str, object]:
        """Return the model as JSON values."""
        sections, covariance = self.sections, self.sections.covariance
        return {
            "schema": SCHEMA,
            "hold": sections.hold,
            "sample_period": sections.period,
            "denominators": sections.denominators.tolist(),
            "numerators": sections.numerators.tolist(),
            "direct": sections.direct.tolist(),
            "delays": sections.delays.tolist(),
            "covariance": None if covariance is None else np.ravel(covariance).tolist(),
            "working_point": list(self.working_point),
            "valid": [list(range) for range in self.valid],
            "certificate": dict(self.certificate),
        }

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> SampledModel:
        """Return the inverse of :meth:`content`, for values of the right types.

        Raises CalibrationError for an inconsistent model, or one that cannot be computed.
        """
        period = SAMPLE_PERIOD.checked(content["sample_period"], CalibrationError)
        sections = _sections_of(content, period)
        valid = [
            (FREQUENCY.checked(a, CalibrationError), FREQUENCY.checked(b, CalibrationError))
            for a, b in content["valid"]
        ]
        point = [SIGNAL.checked(value, CalibrationError) for value in content["working_point"]]
        if len(valid) != sections.inputs or len(point) != sections.inputs + 1:
            raise CalibrationError("estimation.model_sizes", inputs=sections.inputs)
        return cls(
            sections=sections,
            valid=valid,
            working_point=point,
            certificate=content["certificate"],
        )


def _sections_of(content: Mapping[str, Any], period: float) -> ParallelSections:
    try:
        down, up, direct, delays = (
            SIGNAL.checked_all(np.asarray(content[name], np.float64), CalibrationError, name)
            for name in ("denominators", "numerators", "direct", "delays")
        )
    except ValueError as err:
        raise CalibrationError("estimation.model_sizes", inputs=len(content["direct"])) from err
    inputs, count = len(direct), len(content["denominators"])
    fits = up.size == 2 * inputs * count and down.size == 2 * count and len(delays) == inputs
    if not (inputs and fits):
        raise CalibrationError("estimation.model_sizes", inputs=inputs)
    sections = ParallelSections(
        hold=content["hold"],
        period=period,
        denominators=down.reshape(count, 2),
        numerators=up.reshape(inputs, count, 2),
        direct=direct,
        delays=delays,
    )
    _check_runs(sections)
    if content["covariance"] is None:
        return sections
    size = inputs * (2 + 2 * count) + 2 * count
    return ParallelSections(
        **{**vars(sections), "covariance": _square(content["covariance"], size)}
    )


def _check_runs(sections: ParallelSections) -> None:
    """Raise CalibrationError for sections that are unstable, too slow or too late."""
    slowest = _SLOWEST_SAMPLES * sections.period
    slow = np.any(sections.denominators > [slowest, slowest**2])
    if not sections.is_stable or slow:
        raise CalibrationError("estimation.unstable", sections=sections.denominators.tolist())
    samples = sections.delays / sections.period
    whole = sections.hold == BAND_LIMITED or np.all(abs(samples - np.round(samples)) < 1e-6)
    if np.any(samples < 0) or np.any(samples > LONGEST_DELAY_SAMPLES) or not whole:
        raise CalibrationError(
            "estimation.long_delay",
            delay=sections.delays.tolist(),
            most=LONGEST_DELAY_SAMPLES,
            period=sections.period,
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
    model: SampledModel, inputs: FloatArray, output: FloatArray, used: BoolArray | None = None
) -> FreeRun:
    """Simulate ``model`` for ``inputs`` (n, m), or (n,), and compare with the ``output`` (n,).

    used: True where the output counts, None where it is finite

    Only the initial state and a constant are fitted to the output. Samples are a ``sample_period``
    of the model apart.

    Raises IdentificationError for a record that is too short or constant, for gaps of an input, or
    another number of inputs.
    """
    counted = np.isfinite(output) if used is None else used & np.isfinite(output)
    inputs = inputs[:, np.newaxis] if inputs.ndim == 1 else inputs
    if np.sum(counted) < LEAST_SAMPLES or len(inputs) != len(output):
        raise IdentificationError(
            "estimation.short_columns",
            input=len(inputs),
            output=int(np.sum(counted)),
            least=LEAST_SAMPLES,
        )
    if inputs.shape[1] != model.sections.inputs:
        raise IdentificationError(
            "estimation.input_count", given=inputs.shape[1], expected=model.sections.inputs
        )
    check_inputs(inputs)
    check_varies(output[counted], "output")
    run = _run(model.sections, inputs - model.working_point[:-1], output, counted)
    residual = np.where(counted, output - run, np.nan)
    rms = float(np.sqrt(np.mean(residual[counted] ** 2)))
    variance = float(np.var(output[counted]))
    return FreeRun(run, residual, 1 - rms**2 / variance, rms)


def _run(
    sections: ParallelSections, inputs: FloatArray, output: FloatArray, used: BoolArray
) -> FloatArray:
    driven = sections.driven(inputs)
    columns = np.column_stack([*sections.decays(len(inputs)), np.ones(len(inputs))])
    # A column that has decayed where nothing is counted has no size.
    known = np.linalg.norm(columns[used], axis=0) > 0
    state = least_squares(columns[used][:, known], (output - driven)[used], 1e-13)
    return np.asarray(driven + columns[:, known] @ state)


def stationary_output(
    sections: ParallelSections, inputs: FloatArray, output: FloatArray, used: BoolArray
) -> float:
    """Return the steady output at the means of ``inputs`` (n, m)."""
    centred = inputs - np.mean(inputs, axis=0)
    driven = sections.driven(centred)
    columns = np.column_stack([*sections.decays(len(inputs)), np.ones(len(inputs))])
    known = np.linalg.norm(columns[used], axis=0) > 0
    return float(least_squares(columns[used][:, known], (output - driven)[used], 1e-13)[-1])


def check_inputs(inputs: FloatArray) -> None:
    """Raise IdentificationError for a constant input, or one with a missing value.

    After a missing value the output would be unknown.
    """
    missing = int(np.count_nonzero(~np.isfinite(inputs)))
    if missing:
        raise IdentificationError("estimation.input_gaps", missing=missing)
    for column in inputs.T:
        check_varies(column, "input")


def check_varies(values: FloatArray, name: str) -> None:
    """Raise IdentificationError for a column whose finite values are constant."""
    values = values[np.isfinite(values)]
    change = float(np.ptp(values)) if len(values) else 0.0
    if change <= _LEAST_CHANGE:
        raise IdentificationError("estimation.constant_column", name=name, change=change)
