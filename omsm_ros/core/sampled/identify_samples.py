"""Identify how one sampled quantity follows another, whatever they are and in what units.

The engine is that of :mod:`omsm_ros.core.identification.identify`; what a probe on a machine must
be like (its gain, its noise at rest, its steps) is not asked here. ``hold`` says what the
input does between samples:

| hold | the input | the model |
|---|---|---|
| band-limited | moves smoothly, as what is measured does | G(s) with a delay |
| zero-order | stands still from sample to sample, as a command does | H(z), and the G(s) of it |
| first-order | runs straight from sample to sample | the same H(z), another G(s) |
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from omsm_ros.core.dynamics.held_equivalent import FIRST_ORDER, ZERO_ORDER, held_equivalent
from omsm_ros.core.dynamics.response_band import Band, widening, would_show
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.covariance import noise_spectrum, parameter_covariance
from omsm_ros.core.fitting.free_run_choice import SampledCandidate, SampledChoice
from omsm_ros.core.fitting.held_problem import coefficients
from omsm_ros.core.identification.residual_tests import independence, whiteness
from omsm_ros.core.sampled.band_limited import band_limited
from omsm_ros.core.sampled.free_run import check_changes, check_input, resting_output
from omsm_ros.core.sampled.long_record import choose_of_any_length
from omsm_ros.core.sampled.model import BAND_LIMITED, Discrete, SampledModel
from omsm_ros.core.sampled.verdict import (
    SAMPLED_LIMITS,
    longest_range,
    sampled_certificate,
)
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.errors import ConfigurationError

HOLDS = (BAND_LIMITED, ZERO_ORDER, FIRST_ORDER)
# On a logarithmic grid over three decades: neighbours 2 % apart.
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
    hold: what the input does between samples, one of HOLDS
    order: number of poles, 0 to choose it
    max_delay: of a held input, whole samples to try; of a band-limited one the delay is free
    used: True where the output counts, None where it is finite

    Raises IdentificationError for a useless record, ConfigurationError for another hold.
    """
    if hold not in HOLDS:
        raise ConfigurationError(f"hold {hold!r}, expected one of {HOLDS}")
    used = np.isfinite(output) if used is None else used & np.isfinite(output)
    check_input(input)
    check_changes(output[used], "output")
    if hold == BAND_LIMITED:
        return band_limited(input, output, used, period, order, SAMPLED_LIMITS)
    choice = choose_of_any_length(input, output, used, period, order=order, max_delay=max_delay)
    known = _Known.of(choice.chosen, choice.delay, period)
    known, factor = _no_surer(known, choice, period)
    low, high = longest_range(known.band, SAMPLED_LIMITS, _shown(known, choice.chosen))
    return SampledModel(
        hold=hold,
        sample_period=period,
        discrete=known.discrete,
        continuous=_continuous(known.discrete, period, hold),
        covariance=None,
        valid_from=low,
        valid_up_to=high,
        working_point=(float(np.mean(input)), resting_output(known.discrete, input, output, used)),
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
    """Return what lies between frequencies at which an error of the response would show, (k,)."""
    problem, samples = candidate.problem, len(candidate.problem.used)
    discrete, taper = known.discrete, signal.windows.hann(samples)
    driven = signal.lfilter(discrete.numerator, discrete.denominator, problem.input)
    answer = np.asarray(np.fft.rfft(taper * driven), np.complex128)
    share = float(np.mean(problem.used))
    noise = noise_spectrum(problem.residual(candidate.fit), samples) * float(taper @ taper) / share
    lines = np.asarray(np.fft.rfftfreq(samples, problem.period), np.float64)
    found = would_show(known.frequency, lines, answer, noise, SAMPLED_LIMITS)
    return np.asarray(np.logical_or.accumulate(found) & np.logical_or.accumulate(found[::-1])[::-1])


def _no_surer(known: _Known, choice: SampledChoice, period: float) -> tuple[_Known, float]:
    """Return ``known`` with uncertainties that hold those of the free choice, and their factor."""
    if choice.chosen.order == choice.free.order:
        return known, 1.0
    free = _Known.of(choice.free, choice.delay, period)
    ratio = free.discrete.response(known.frequency, period) / known.discrete.response(
        known.frequency, period
    )
    low, high = longest_range(known.band, SAMPLED_LIMITS)
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
    found = held_equivalent(discrete.numerator, discrete.denominator, period, hold)
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
        "predicted": 1 - float(np.mean(chosen.hidden)) / variance,
        "last_part_by_order": [_finite(1 - float(e) / variance) for e in choice.by_order],
        "whiteness_p": whiteness(residual),
        "independence_p": independence(residual, drive),
        "samples": {"received": len(problem.used), "compared": int(np.sum(problem.used))},
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
