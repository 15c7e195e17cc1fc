"""A band-limited record of any two quantities, identified as a motion is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omsm_ros.core.dynamics.response_band import ResponseLimits, response_band
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.order_choice import held_out_rms
from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.core.fitting.preparation import Prepared, from_rest_to_rest, input_bandwidth
from omsm_ros.core.fitting.steps import LEAST_SAMPLES, Steps, held_out, sample_noise
from omsm_ros.core.identification.model_choice import model_from_start
from omsm_ros.core.identification.residual_tests import independence, whiteness
from omsm_ros.core.identification.response_uncertainty import no_surer, response_uncertainty
from omsm_ros.core.sampled.model import BAND_LIMITED, SampledModel
from omsm_ros.core.sampled.verdict import longest_range, sampled_certificate
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.errors import IdentificationError

# The engine's durations (fading, bridging, settling) are those of a machine read every
# millisecond. Time is scaled so that this record is one, and scaled back in the result.
_NOMINAL_PERIOD_S = 1e-3
# Over three decades: 1.7 % apart.
_FREQUENCIES = 400


def band_limited(
    input: FloatArray,
    output: FloatArray,
    used: BoolArray,
    period: float,
    order: int,
    limits: ResponseLimits,
) -> SampledModel:
    """Return the model of a record whose input moves smoothly between samples.

    Arguments as of :func:`~omsm_ros.core.sampled.identify_samples.identify_samples`.
    """
    prepared, model = model_from_start(_prepared(input, output, used), order)
    known = response_uncertainty(prepared, model, limits)
    free = model.free or model
    if model.free is not None:
        known = no_surer(known, prepared, model, free, limits)
    best, problem, slower = model.chosen.fit, prepared.problem, period / _NOMINAL_PERIOD_S
    lines = np.geomspace(1e-3, 1.0, _FREQUENCIES) * 0.5 / problem.period
    low, high = longest_range(response_band(best.dynamics, known.covariance, lines), limits)
    high = max(min(high, known.shown_up_to), low)
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
            entries=_entries(prepared, best, output[used]),
        ),
    )


def _entries(prepared: Prepared, best: Fit, output: FloatArray) -> dict[str, object]:
    problem, variance = prepared.problem, float(np.var(output)) or 1.0
    hidden = held_out_rms(problem, best, held_out(prepared.steps, len(problem.input)))
    return {
        "residual_rms": best.rms,
        "explained": 1 - best.rms**2 / variance,
        "predicted": 1 - hidden**2 / variance,
        "whiteness_p": whiteness(best.residual),
        "independence_p": independence(best.residual, np.gradient(problem.input)[problem.used]),
        "samples": {"received": len(problem.input), "compared": best.samples},
    }


def _prepared(input: FloatArray, output: FloatArray, used: BoolArray) -> Prepared:
    if int(np.sum(used)) < 2 * LEAST_SAMPLES or not np.all(np.isfinite(input)):
        raise IdentificationError(
            f"{int(np.sum(used))!r} samples are used, at least {2 * LEAST_SAMPLES} are needed, "
            "and a finite input everywhere; record more"
        )
    samples = len(input)
    moving = np.ones(samples, np.bool_)
    # In units of its own spread, as a machine's motion is of its travel.
    faded = from_rest_to_rest(input, moving, _NOMINAL_PERIOD_S)
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
