"""Sampled model of an output from one or more inputs: its file, and free runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval

from omsm_ros.core.calibration.plausibility import MAX_DELAY_SAMPLES as LONGEST_DELAY_SAMPLES
from omsm_ros.core.estimation.parallel_sections import BAND_LIMITED, ParallelSections
from omsm_ros.core.estimation.steps import LEAST_SAMPLES
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction, ascending_roots
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import CalibrationError, IdentificationError
from omsm_ros.linear_algebra import least_squares, unit_columns
from omsm_ros.quantities import FREQUENCY, SAMPLE_PERIOD, SIGNAL

SCHEMA, SCHEMA_1 = "omsm-model/2", "omsm-model/1"
# Largest relative difference of the sections of a model of schema 1 from its polynomials.
_SAME_RESPONSE = 1e-6
# Part of the largest response below which a difference counts as of that part.
_FAINT = 1e-3
# Largest relative difference of its uncertainties, beyond which they are left out.
_SAME_BAND = 0.01
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
        """Return the inverse of :meth:`content`, for values of the right types; also of schema 1.

        Raises CalibrationError for an inconsistent model, or one that cannot be computed.
        """
        if content["schema"] == SCHEMA_1:
            content = _from_version_1(content)
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
            sections=sections, valid=valid, working_point=point, certificate=content["certificate"]
        )


def _sections_of(content: Mapping[str, Any], period: float) -> ParallelSections:
    names = ("denominators", "numerators", "direct", "delays")
    try:
        arrays = [np.ravel(np.asarray(content[name], np.float64)) for name in names]
    except ValueError as err:
        raise CalibrationError("estimation.model_sizes", inputs=len(content["direct"])) from err
    for name, array in zip(names, arrays, strict=True):
        SIGNAL.checked_all(array, CalibrationError, name)
    down, up, direct, delays = arrays
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


def _from_version_1(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a model of schema 1, a ratio of two polynomials, as sections.

    The polynomials are in s for a band-limited input, else in z⁻¹. The sections have the same
    poles; their numerators follow from the response at many w, the covariance from its derivatives.
    There is none where rounding would change the uncertainty of the response.
    """
    held = content["hold"] != BAND_LIMITED
    period = SAMPLE_PERIOD.checked(content["sample_period"], CalibrationError)
    old = content["discrete" if held else "continuous"]
    if old is None or old["covariance"] is None:
        raise CalibrationError("estimation.old_model_part", hold=content["hold"])
    up, down = (np.asarray(old[name], np.float64) for name in ("numerator", "denominator"))
    covariance = _square(old["covariance"], len(up) + len(down) - held)
    with np.errstate(all="ignore"):
        roots = _roots_in_w(up, down, period if held else 0.0)
        w = _grid(roots, period)
        variable = (2 - period * w) / (2 + period * w) if held else w
        powers = variable[:, np.newaxis] ** np.arange(max(len(up), len(down)))
        before = powers / polyval(variable, down)[:, np.newaxis]
        value = before[:, : len(up)] @ up
        by_pole = -before[:, 1 : len(down)] * value[:, np.newaxis]
        before = np.column_stack([before[:, : len(up)], by_pole])
        weight = 1 / np.maximum(np.abs(value), _FAINT * np.max(np.abs(value)))
        real = np.sort(roots[roots.imag == 0].real)
        pairs = [(p, np.conj(p)) for p in roots if p.imag > 0]
        # Two neighbours on the axis are one section.
        pairs += list(zip(real[0:-1:2], real[1::2], strict=True))
        both = [(-float(((p + q) / (p * q)).real), float((1 / (p * q)).real)) for p, q in pairs]
        single = [(-1 / p, 0.0) for p in real[len(real) - len(real) % 2 :]]
        sections = np.reshape(both + single, (-1, 2))
        basis, by_d = _section_columns(sections, w)
        found = _solved(basis, value[:, np.newaxis], weight)[:, 0]
        parts = (basis * found)[:, 1:].reshape(len(w), -1, 2).sum(axis=2)
        after = np.column_stack([basis, np.repeat(parts, 2, axis=1) * by_d])
        misfit = float(np.max(np.abs(basis @ found - value) * weight))
        if not misfit <= _SAME_RESPONSE:
            raise CalibrationError("estimation.old_model", misfit=misfit)
        jacobian = np.pad(_solved(after, before, weight), (0, 1))
        jacobian[-1, -1] = not held  # the delay of a held input is exact
        root = _root_of(covariance)
        moved = jacobian[:, : len(root)] @ root
        new, count = moved @ moved.T, before.shape[1]
        spread = np.linalg.norm(before @ root[:count], axis=1)
        kept = np.einsum("np,pq,nq->n", after, new[:-1, :-1], after.conj()).real
        apart = np.abs(np.sqrt(kept) - spread)
        same = np.all(apart <= _SAME_BAND * spread + _SAME_RESPONSE * np.abs(value))
    return {
        **content,
        "denominators": sections,
        "numerators": found[np.newaxis, 1:],
        "direct": found[:1],
        "delays": [old["delay_samples"] * period if held else old["delay"]],
        "covariance": new.ravel() if same else None,
        "valid": [(content["valid_from"], content["valid_up_to"])],
    }


def _grid(roots: ComplexArray, period: float) -> ComplexArray:
    """Return imaginary w over and beyond all poles, and near each."""
    size = np.abs(roots) if len(roots) else np.full(1, 1 / period)
    near = np.outer(np.linspace(-3, 3, 13), roots.real) + abs(roots.imag)
    grid = np.geomspace(1e-2 * size.min(), 1e2 * size.max(), 100 * (len(roots) + 1))
    return np.asarray(1j * np.concatenate([grid, near[near > 0]]))


def _roots_in_w(up: FloatArray, down: FloatArray, period: float) -> ComplexArray:
    """Return the poles in w; period: of a held input [s], 0 for polynomials in s.

    Raises CalibrationError for an unstable model.
    """
    if period:
        z = np.roots(np.pad(down, (0, max(len(up) - len(down), 0))))
        roots = np.asarray(2 / period * (z - 1) / (z + 1), np.complex128)
    else:
        try:
            roots = ascending_roots(down)
        except np.linalg.LinAlgError:
            roots = np.full(1, np.nan + 0j)
    if down[0] != 1 or not np.all(np.isfinite(roots) & (roots.real < 0)):
        raise CalibrationError("estimation.unstable", sections=[down.tolist()])
    return roots


def _section_columns(sections: FloatArray, w: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return d H/d(direct, b0, b1 …) (n, 1 + 2k), and what d1, d2 multiply a part by (n, 2k)."""
    w = w[:, np.newaxis]
    basis, second = 1 / (1 + sections[:, 0] * w + sections[:, 1] * w * w), sections[:, 1] > 0
    pairs = np.stack([basis, basis * w * second], axis=2).reshape(len(w), -1)
    moved = -np.stack([basis * w, basis * w * w * second], axis=2).reshape(len(w), -1)
    return np.column_stack([np.ones(len(w)), pairs]), moved


def _solved(columns: ComplexArray, values: Any, weight: FloatArray) -> FloatArray:
    """Return the real x (q, r) by which complex ``columns`` (n, q) come nearest to ``values``."""
    left, right = (weight[:, np.newaxis] * part for part in (columns, values))
    if not (np.all(np.isfinite(left)) and np.all(np.isfinite(right))):
        raise CalibrationError("estimation.old_model", misfit=np.inf)
    unit, scale = unit_columns(np.concatenate([left.real, left.imag]))
    found = np.linalg.lstsq(unit, np.concatenate([right.real, right.imag]), rcond=None)[0]
    return np.asarray(found / scale[:, np.newaxis])


def _root_of(covariance: FloatArray) -> FloatArray:
    """Return B with B Bᵀ = covariance, whose parts may have any units."""
    spread = np.sqrt(np.diag(covariance))
    spread[spread == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    return np.asarray(spread[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0)))


def _check_runs(sections: ParallelSections) -> None:
    """Raise CalibrationError for sections that are unstable, too slow or too late."""
    slowest = _SLOWEST_SAMPLES * sections.period
    down = sections.denominators
    # The signs of its coefficients show whether a section is stable.
    stable = np.all(down[:, 0] > 0) and np.all(down >= 0)
    if not stable or np.any(down > [slowest, slowest**2]):
        raise CalibrationError("estimation.unstable", sections=down.tolist())
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
    run, _ = simulated(model.sections, inputs - model.working_point[:-1], output, counted)
    residual = np.where(counted, output - run, np.nan)
    rms = float(np.sqrt(np.mean(residual[counted] ** 2)))
    variance = float(np.var(output[counted]))
    return FreeRun(run, residual, 1 - rms**2 / variance, rms)


def simulated(
    sections: ParallelSections, inputs: FloatArray, output: FloatArray, used: BoolArray
) -> tuple[FloatArray, float]:
    """Return the run whose initial state and constant fit ``output`` (n,), and the constant."""
    driven = sections.driven(inputs)
    columns = np.column_stack([*sections.decays(len(inputs)), np.ones(len(inputs))])
    # A column that has decayed where nothing is counted has no size.
    known = np.linalg.norm(columns[used], axis=0) > 0
    state = least_squares(columns[used][:, known], (output - driven)[used], 1e-13)
    return np.asarray(driven + columns[:, known] @ state), float(state[-1])


def stationary_output(
    sections: ParallelSections, inputs: FloatArray, output: FloatArray, used: BoolArray
) -> float:
    """Return the steady output at the means of ``inputs`` (n, m)."""
    return simulated(sections, inputs - np.mean(inputs, axis=0), output, used)[1]


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
