"""Identify a model between any two sampled quantities, in any units.

The method is that of :mod:`omsm_ros.core.identification.identify`, without the checks of a probe on
a machine (gain, stationary noise, steps). ``hold`` is the behaviour of the input between samples:

| hold | the input | the model |
|---|---|---|
| band-limited | smooth, as a measured quantity | G(s) with a delay |
| zero-order | constant from sample to sample, as a command | H(z), and its equivalent G(s) |
| first-order | linear from sample to sample | the same H(z), another G(s) |

A band-limited record is identified as a motion is. The durations of that method (fading, bridging,
settling) are those of a machine sampled every millisecond, so time is scaled to that period, and
the result is scaled back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.core.estimation.covariance import noise_spectrum, parameter_covariance
from omsm_ros.core.estimation.model_order import held_out_rms
from omsm_ros.core.estimation.output_error import Fit, Problem
from omsm_ros.core.estimation.preparation import Prepared, faded_to_stationary, input_bandwidth
from omsm_ros.core.estimation.sampled_choice import (
    SampledCandidate,
    SampledChoice,
    choose_sampled_long,
)
from omsm_ros.core.estimation.sampled_fit import (
    FIRST_ORDER,
    ZERO_ORDER,
    coefficients,
    zero_order_hold_equivalent,
)
from omsm_ros.core.estimation.sampled_model import (
    BAND_LIMITED,
    Discrete,
    SampledModel,
    check_input,
    check_varies,
    stationary_output,
)
from omsm_ros.core.estimation.steps import LEAST_SAMPLES, Steps, held_out, sample_noise
from omsm_ros.core.identification.model_choice import model_from_start
from omsm_ros.core.identification.residual_tests import independence, whiteness
from omsm_ros.core.identification.response_uncertainty import (
    inflate_to_free_choice,
    response_uncertainty,
)
from omsm_ros.core.lti.frequency_response import (
    COVERAGE_FACTOR,
    Band,
    ResponseLimits,
    is_detectable,
    response_band,
    widening,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import ConfigurationError, IdentificationError, Notice
from omsm_ros.linear_algebra import one_blas_thread

# Limits of the band, a tenth of gain and of a radian: for a process, not a measuring machine.
SAMPLED_LIMITS = ResponseLimits(gain=0.1, phase=0.1)
# Least share of the variance of held-out parts that free runs predict.
_LEAST_PREDICTED = 0.5
# Least p-value of a residual that is independent of the input.
_LEAST_INDEPENDENCE_P = 1e-4


def widest_valid_range(
    band: Band, limits: ResponseLimits, shown: BoolArray | None = None
) -> tuple[float, float]:
    """Return the widest range [Hz], in octaves, in which the 95 % band keeps within ``limits``.

    shown: True where the data would show a response beyond the limits, (k,) at the frequencies of
        the band; None for everywhere
    Both ends are the lowest frequency of the band if there is no such range.
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
    entries: with "predicted", the share of the variance of held-out parts that free runs explain
    """
    predicted = entries["predicted"]
    assert isinstance(predicted, float)
    reasons = _reasons(predicted, valid, limits)
    accepted = Notice("estimation.accepted", low=valid[0], high=valid[1])
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
        "verdict": REJECTED if reasons else str(accepted),
    }


def _reasons(predicted: float, valid: tuple[float, float], limits: ResponseLimits) -> list[str]:
    reasons = []
    if not predicted >= _LEAST_PREDICTED:
        reasons.append(
            Notice("estimation.poor_prediction", predicted=predicted, least=_LEAST_PREDICTED)
        )
    if not valid[1] > valid[0]:
        reasons.append(Notice("estimation.unknown_response", gain=limits.gain, phase=limits.phase))
    return [str(reason) for reason in reasons]


def _warnings(independent: object, order: int, free_order: int, widened: float) -> list[str]:
    warnings = []
    if isinstance(independent, float) and independent < _LEAST_INDEPENDENCE_P:
        warnings.append(Notice("estimation.residual_follows_input", p=independent))
    if order != free_order:
        warnings.append(
            Notice("estimation.order_differs", order=order, free=free_order, factor=widened)
        )
    return [str(warning) for warning in warnings]


# Sampling period of a machine, to which time is scaled.
_NOMINAL_PERIOD_S = 1e-3


def band_limited(
    input: FloatArray,
    output: FloatArray,
    used: BoolArray,
    period: float,
    order: int,
    limits: ResponseLimits,
) -> SampledModel:
    """Return the model of a record whose input is smooth between samples.

    Arguments as of :func:`~omsm_ros.core.identification.sampled_identification.identify_samples`.
    """
    prepared, model = model_from_start(_prepared(input, output, used), order=order)
    known = response_uncertainty(prepared, model, limits)
    free = model.free or model
    if model.free is not None:
        known = inflate_to_free_choice(known, prepared, model, free, limits)
    best, problem, slower = model.chosen.fit, prepared.problem, period / _NOMINAL_PERIOD_S
    lines = np.geomspace(1e-3, 1.0, _FREQUENCIES) * 0.5 / problem.period
    low, high = widest_valid_range(response_band(best.dynamics, known.covariance, lines), limits)
    high = max(min(high, known.excited_up_to), low)
    dynamics, covariance = _slower(best.dynamics, known.covariance, best.gain, slower)
    valid = (low / slower, high / slower)
    return SampledModel(
        hold=BAND_LIMITED,
        sample_period=period,
        discrete=None,
        continuous=dynamics,
        covariance=covariance,
        valid_from=valid[0],
        valid_up_to=valid[1],
        working_point=(float(np.mean(input)), float(np.mean(output[used]))),
        certificate=sampled_certificate(
            order=best.structure.poles,
            free_order=free.chosen.fit.structure.poles,
            widened=known.widened,
            valid=valid,
            limits=limits,
            entries=_entries_of_band_limited(prepared, best, output[used]),
        ),
    )


def _entries_of_band_limited(
    prepared: Prepared, best: Fit, output: FloatArray
) -> dict[str, object]:
    problem, variance = prepared.problem, float(np.var(output)) or 1.0
    validation_rms = held_out_rms(problem, best, held_out(prepared.steps, len(problem.input)))
    return {
        "residual_rms": best.rms,
        "explained": 1 - best.rms**2 / variance,
        "predicted": 1 - validation_rms**2 / variance,
        "whiteness_p": whiteness(best.residual),
        "independence_p": independence(best.residual, np.gradient(problem.input)[problem.used]),
        "samples": {"received": len(problem.input), "compared": best.samples},
    }


def _prepared(input: FloatArray, output: FloatArray, used: BoolArray) -> Prepared:
    if int(np.sum(used)) < 2 * LEAST_SAMPLES or not np.all(np.isfinite(input)):
        raise IdentificationError(
            "estimation.short_record", samples=int(np.sum(used)), least=2 * LEAST_SAMPLES
        )
    samples = len(input)
    moving = np.ones(samples, np.bool_)
    faded = faded_to_stationary(input, moving, _NOMINAL_PERIOD_S)
    used = used & (faded == input)
    problem = Problem(
        input=faded - np.mean(input),
        output=np.where(used, output, 0.0) - np.mean(output[used]),
        used=used,
        period=_NOMINAL_PERIOD_S,
        background=np.column_stack([np.ones(samples), np.linspace(-1.0, 1.0, samples)]),
        rate=2 * np.pi * input_bandwidth(input, _NOMINAL_PERIOD_S),
    )
    steps = Steps((), moving, sample_noise(input), float(np.ptp(input)))
    return Prepared(problem, steps, 0)


def _slower(
    dynamics: TransferFunction, covariance: FloatArray, gain: float, factor: float
) -> tuple[TransferFunction, FloatArray]:
    """Return the dynamics with ``gain``, in a time that runs ``factor`` times slower."""
    up = factor ** np.arange(len(dynamics.numerator), dtype=np.float64)
    down = factor ** np.arange(len(dynamics.denominator), dtype=np.float64)
    slower = replace(
        dynamics,
        numerator=gain * dynamics.numerator * up,
        denominator=dynamics.denominator * down,
        delay=dynamics.delay * factor,
    )
    scale = np.concatenate([gain * up, down[1:], [factor]])
    return slower, covariance * np.outer(scale, scale)


HOLDS = (BAND_LIMITED, ZERO_ORDER, FIRST_ORDER)
# Frequencies over three decades: neighbours are 2 % apart.
_FREQUENCIES = 400


@dataclass(frozen=True, eq=False)
class _Known:
    """The model of one candidate, on a grid of frequencies."""

    discrete: Discrete
    frequency: FloatArray
    band: Band

    @classmethod
    def of(cls, candidate: SampledCandidate, delay: int, period: float) -> _Known:
        problem = candidate.problem
        numerator, denominator, jacobian = coefficients(candidate.fit)
        every = parameter_covariance(
            problem, problem.columns(candidate.fit), problem.residual(candidate.fit)
        )
        size = len(jacobian)
        covariance = jacobian @ every[:size, :size] @ jacobian.T
        discrete = Discrete(
            numerator=numerator,
            denominator=denominator,
            delay=delay,
            covariance=np.asarray(0.5 * (covariance + covariance.T)),
        )
        frequency = np.geomspace(1e-3, 1.0, _FREQUENCIES) * 0.5 / period
        return cls(discrete, frequency, discrete.band(frequency, period))


@one_blas_thread()
def identify_samples(
    input: FloatArray,
    output: FloatArray,
    period: float,
    *,
    hold: str = ZERO_ORDER,
    order: int = 0,
    max_delay: int = 3,
    used: BoolArray | None = None,
) -> SampledModel:
    """Return the model by which ``output`` (n,) follows ``input`` (n,), sampled evenly.

    period: from sample to sample [s]
    hold: behaviour of the input between samples, one of HOLDS
    order: number of poles, 0 to choose it
    max_delay: of a held input, whole samples to try; of a band-limited one the delay is free
    used: True where the output counts, None where it is finite

    Raises IdentificationError for a record that determines no model, ConfigurationError for another
    hold.
    """
    if hold not in HOLDS:
        raise ConfigurationError("estimation.unknown_hold", hold=hold, known=HOLDS)
    used = np.isfinite(output) if used is None else used & np.isfinite(output)
    check_input(input)
    check_varies(output[used], "output")
    if hold == BAND_LIMITED:
        return band_limited(input, output, used, period, order, SAMPLED_LIMITS)
    return _held_input(input, output, used, period, hold, order, max_delay)


def _held_input(
    input: FloatArray,
    output: FloatArray,
    used: BoolArray,
    period: float,
    hold: str,
    order: int,
    max_delay: int,
) -> SampledModel:
    """Return the model of a record whose input is held between samples."""
    choice = choose_sampled_long(input, output, used, period, order=order, max_delay=max_delay)
    known = _Known.of(choice.chosen, choice.delay, period)
    known, factor = _inflate_to_free_choice(known, choice, period)
    low, high = widest_valid_range(known.band, SAMPLED_LIMITS, _shown(known, choice.chosen))
    return SampledModel(
        hold=hold,
        sample_period=period,
        discrete=known.discrete,
        continuous=_continuous(known.discrete, period, hold),
        covariance=None,
        valid_from=low,
        valid_up_to=high,
        working_point=(
            float(np.mean(input)),
            stationary_output(known.discrete, input, output, used),
        ),
        certificate=sampled_certificate(
            order=choice.chosen.order,
            free_order=choice.free.order,
            widened=factor,
            valid=(low, high),
            limits=SAMPLED_LIMITS,
            entries=_entries(choice, output[used]),
        ),
    )


def _shown(known: _Known, candidate: SampledCandidate) -> BoolArray:
    """Return True between the frequencies at which an error of the response would show, (k,)."""
    problem, samples = candidate.problem, len(candidate.problem.used)
    discrete, taper = known.discrete, signal.windows.hann(samples)
    driven = signal.lfilter(discrete.numerator, discrete.denominator, problem.input)
    answer = np.asarray(np.fft.rfft(taper * driven), np.complex128)
    share = float(np.mean(problem.used))
    noise = noise_spectrum(problem.residual(candidate.fit), samples) * float(taper @ taper) / share
    lines = np.asarray(np.fft.rfftfreq(samples, problem.period), np.float64)
    found = is_detectable(known.frequency, lines, answer, noise, SAMPLED_LIMITS)
    return np.asarray(np.logical_or.accumulate(found) & np.logical_or.accumulate(found[::-1])[::-1])


def _inflate_to_free_choice(
    known: _Known, choice: SampledChoice, period: float
) -> tuple[_Known, float]:
    """Return ``known`` with uncertainties that include the free choice, and their factor."""
    if choice.chosen.order == choice.free.order:
        return known, 1.0
    free = _Known.of(choice.free, choice.delay, period)
    ratio = free.discrete.response(known.frequency, period) / known.discrete.response(
        known.frequency, period
    )
    low, high = widest_valid_range(known.band, SAMPLED_LIMITS)
    trusted = (known.frequency >= low) & (known.frequency <= high)
    cut = [
        Band(b.frequency[trusted], b.gain[trusted], b.phase[trusted])
        for b in (known.band, free.band)
    ]
    with np.errstate(divide="ignore"):
        factor = widening(cut[0], cut[1], np.log(ratio[trusted]))
    wider = replace(known.discrete, covariance=factor**2 * known.discrete.covariance)
    return replace(known, discrete=wider, band=wider.band(known.frequency, period)), factor


def _continuous(discrete: Discrete, period: float, hold: str) -> TransferFunction | None:
    found = zero_order_hold_equivalent(discrete.numerator, discrete.denominator, period, hold)
    return None if found is None else replace(found, delay=discrete.delay * period)


def _entries(choice: SampledChoice, output: FloatArray) -> dict[str, object]:
    chosen, problem = choice.chosen, choice.chosen.problem
    residual, variance = problem.residual(chosen.fit), float(np.var(output)) or 1.0
    drive = np.gradient(problem.input)[problem.used]
    return {
        "delay_samples": choice.delay,
        "whitened": chosen.whitened,
        "residual_rms": float(np.sqrt(np.mean(residual**2))),
        "explained": 1 - float(np.mean(residual**2)) / variance,
        "predicted": 1 - float(np.mean(chosen.held_out)) / variance,
        "last_part_by_order": [_finite(1 - float(e) / variance) for e in choice.by_order],
        "whiteness_p": whiteness(residual),
        "independence_p": independence(residual, drive),
        "samples": {"received": len(problem.used), "compared": int(np.sum(problem.used))},
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
