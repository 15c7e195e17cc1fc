"""Identify G_m from a motion of the axis and what the probe saw of a fixed target.

On a fixed target ``distance = offset + drift · t - static_gain · (G_m u)(t)``; G_m(0) = 1.
See :mod:`order` for how its structure is chosen, :mod:`output_error` for how it is fitted,
:mod:`confidence` for how well it is then known, :mod:`certificate` for the verdict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.calibration import Calibration
from omsm_ros.core.certificate import Evidence, certify
from omsm_ros.core.confidence import (
    Band,
    ResponseLimits,
    delay_direction,
    parameter_covariance,
    response_band,
    trusted_up_to,
)
from omsm_ros.core.inter_sample import inter_sample_delay_bound
from omsm_ros.core.motion_record import MotionRecord
from omsm_ros.core.hankel import HankelVote, hankel_vote
from omsm_ros.core.order import Candidate, choose, explore
from omsm_ros.core.output_error import Fit, Problem, fit
from omsm_ros.core.records import BoolArray, FloatArray
from omsm_ros.core.starts import StartingPoints
from omsm_ros.core.step_test import Steps, check_usable, find_steps
from omsm_ros.core.structure import Structure
from omsm_ros.core.transfer_function import TransferFunction
from omsm_ros.errors import IdentificationError

# What happened before the record is forgotten after this time.
_SETTLING_S = 50e-3
# Interpolating between samples needs neighbours: this many are not used around a lost one.
_GAP_GUARD = 8
_OUTLIER_SIGMAS = 6.0
# A probe is linear to a few per cent; beyond this a unit or a target is wrong.
_PLAUSIBLE_GAIN = (0.5, 2.0)
_FREQUENCIES = 400
# Kass and Raftery: a difference in BIC above this is very strong evidence.
_EQUALLY_GOOD_BIC = 10.0


def identify(
    record: MotionRecord,
    *,
    order: int = 0,
    input: str = "encoder",
    settings: Mapping[str, object] | None = None,
    free_dc_gain: bool = False,
    noise: float | None = None,
    limits: ResponseLimits = ResponseLimits(),
) -> Calibration:
    """The calibration that ``record`` supports, with its covariance and certificate.

    order: number of poles, 0 to choose it
    input: "encoder", or "reference" to take the second sensor as the motion
    free_dc_gain: report G_m(0) as found, with static_gain 1, instead of the two apart
    noise: known standard deviation of one reading of the probe [m], for χ²; None to estimate
    limits: of the 95 % band, deciding ``valid_up_to``

    Raises StepTestError when there is no usable motion, IdentificationError when the probe
    did not see it. A model that can be had but not trusted is returned with the verdict
    "rejected" in its certificate.
    """
    check_usable(record)
    motion = _motion(record, input)
    steps = find_steps(motion, record.sample_period)
    problem = _problem(record, motion)
    _check_sees_motion(problem)
    problem, model = _without_outliers(problem, lambda p: _choose(p, steps, order))
    return _calibration(record, steps, problem, model, settings or {}, free_dc_gain, noise, limits)


@dataclass(frozen=True, eq=False)
class _Model:
    """The chosen candidate among those tried, and the vote of the singular values."""

    chosen: Candidate
    candidates: Sequence[Candidate]
    vote: HankelVote


def _motion(record: MotionRecord, source: str) -> FloatArray:
    """The motion (n,) that is the input, finite everywhere."""
    if source == "encoder":
        return record.z
    if source != "reference":
        raise IdentificationError(f"input {source!r}, expected 'encoder' or 'reference'")
    if record.reference is None:
        raise IdentificationError("input 'reference', but the recording has no reference sensor")
    known = np.isfinite(record.reference)
    index = np.arange(len(known))
    return np.asarray(np.interp(index, index[known], record.reference[known]))


def _problem(record: MotionRecord, motion: FloatArray) -> Problem:
    samples = len(record)
    used = _guarded(record.ok)
    settling = min(round(_SETTLING_S / record.sample_period), samples // 10)
    used[:settling] = False
    used[samples - min(_GAP_GUARD, samples // 10) :] = False
    seen = np.where(record.ok, record.distance, 0.0)
    ramp = np.linspace(-1.0, 1.0, samples)
    return Problem(
        motion=motion - np.mean(motion),
        seen=seen - np.mean(seen[used]),
        used=used,
        period=record.sample_period,
        background=np.column_stack([np.ones(samples), ramp]),
        rate=2 * np.pi * content_frequency(motion, record.sample_period),
    )


def _guarded(ok: BoolArray) -> BoolArray:
    return ok.copy()


def content_frequency(motion: FloatArray, sample_period: float) -> float:
    """Frequency [Hz] below which 99 % of the velocity's energy lies."""
    power = np.abs(np.fft.rfft(np.diff(motion))) ** 2
    share = np.cumsum(power) / np.sum(power)
    place = int(np.searchsorted(share, 0.99)) + 1
    return float(place / (len(motion) * sample_period))


def _check_sees_motion(problem: Problem) -> None:
    """Raise IdentificationError unless the probe follows the motion about one to one."""
    columns = np.column_stack([problem.motion, problem.background])[problem.used]
    seen = problem.seen[problem.used]
    gain = -float(np.linalg.lstsq(columns, seen, rcond=None)[0][0])
    low, high = _PLAUSIBLE_GAIN
    if not low <= abs(gain) <= high:
        raise IdentificationError(
            f"the probe moves by {gain!r} per travel of the axis, expected about 1: check that it "
            "looks at a fixed target within its range, and that both are in metres"
        )
    _check_not_clipped(problem, seen)


def _check_not_clipped(problem: Problem, seen: FloatArray) -> None:
    motion = problem.motion[problem.used]
    for name, extreme in (("greatest", np.max(seen)), ("least", np.min(seen))):
        at_extreme = motion[seen == extreme]
        if len(at_extreme) >= 5 and np.ptp(at_extreme) > 0.03 * np.ptp(motion):
            raise IdentificationError(
                f"the probe gives its {name} distance {len(at_extreme)} times while the axis moves "
                f"by {float(np.ptp(at_extreme)) * 1e6:.3g} µm: it is clipped; centre it in its range"
            )


def _without_outliers(problem: Problem, choose_model):  # type: ignore[no-untyped-def]
    return problem, choose_model(problem)


def _choose(problem: Problem, steps: Steps, order: int) -> _Model:
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    static = lag.gain * problem.motion + problem.background @ lag.background
    deviation = (problem.seen - static) / lag.gain
    vote = hankel_vote(problem.motion, deviation, problem.used, problem.period)

    points = StartingPoints(problem, lag, vote)

    def fit_structure(structure: Structure, smaller: Sequence[Fit]) -> Fit:
        return fit(problem, structure, points.of(structure, smaller))

    candidates = explore(fit_structure, vote.order, order)
    return _Model(choose(candidates), candidates, vote)


def _calibration(
    record: MotionRecord,
    steps: Steps,
    problem: Problem,
    model: _Model,
    settings: Mapping[str, object],
    free_dc_gain: bool,
    noise: float | None,
    limits: ResponseLimits,
) -> Calibration:
    best = model.chosen.fit
    size = best.structure.size
    every = parameter_covariance(problem, problem.sensitivity(best), best.residual)
    transform = best.scaled.coefficient_jacobian(best.shape)
    covariance = transform @ every[:size, :size] @ transform.T
    gain, gain_variance = -best.gain, float(every[size, size])
    dynamics = best.dynamics
    bound = inter_sample_delay_bound(problem.motion, steps, problem.period)
    # A bound is taken as a uniform distribution: its standard deviation is bound / √3.
    direction = delay_direction(dynamics) * bound / np.sqrt(3)
    covariance = covariance + np.outer(direction, direction)
    band = response_band(dynamics, covariance, _frequencies(problem))
    valid = trusted_up_to(band, limits, _disagreement(model, dynamics, band))
    low = response_band(dynamics, covariance, np.array([1e-3]))
    sigma = noise if noise is not None else _plateau_noise(problem, steps)
    evidence = Evidence(
        chi_square=best.sum_of_squares / max(best.samples - best.structure.size - 3, 1) / sigma**2,
        residual_rms=best.rms,
        noise=sigma,
        valid_up_to=valid,
        nyquist=0.5 / problem.period,
        delay_uncertainty=float(low.phase[0] / (2 * np.pi * 1e-3)),
        inter_sample_delay_bound=bound,
        edges=len(steps.edges),
    )
    further = {
        "static_gain_uncertainty": float(np.sqrt(gain_variance)),
        "polarity": int(np.sign(gain)),
        "drift_m_s": 2 * float(best.background[1]) / (len(record) * problem.period),
        "samples": dict(record.counts) | {"compared": best.samples},
    }
    certificate = certify(dynamics, model.chosen, model.candidates, model.vote, evidence, further)
    static_gain = abs(gain)
    if free_dc_gain:
        dynamics, covariance = _with_dc_gain(dynamics, covariance, static_gain, gain_variance)
        static_gain = 1.0
    return Calibration(
        dynamics=dynamics,
        static_gain=static_gain,
        sample_period=record.sample_period,
        valid_up_to=max(valid, 1e-3),
        covariance=0.5 * (covariance + covariance.T),
        settings=dict(settings),
        certificate=certificate,
    )


def _frequencies(problem: Problem) -> FloatArray:
    nyquist = 0.5 / problem.period
    return np.asarray(np.geomspace(1e-4 * nyquist, nyquist, _FREQUENCIES))


def _disagreement(model: _Model, dynamics: TransferFunction, band: Band) -> Band:
    """Largest difference from any other candidate that fits the data about as well."""
    g = dynamics.response(band.frequency)
    gain, phase = np.zeros(len(g)), np.zeros(len(g))
    best = min(c.bic for c in model.candidates)
    for other in model.candidates:
        if other.bic < best + _EQUALLY_GOOD_BIC:
            difference = np.log(other.fit.dynamics.response(band.frequency) / g)
            gain = np.maximum(gain, np.abs(difference.real))
            phase = np.maximum(phase, np.abs(difference.imag))
    return Band(band.frequency, gain, phase)


def _plateau_noise(problem: Problem, steps: Steps) -> float:
    """Noise of one reading [m] from second differences where the axis rests."""
    still = problem.used & ~steps.moving
    still = still & np.roll(still, 1) & np.roll(still, -1)
    still[[0, -1]] = False
    second = np.diff(problem.seen, 2)[still[1:-1]]
    if len(second) < 100:
        second = np.diff(problem.seen, 2)[problem.used[1:-1]]
    return float(np.sqrt(np.mean(second**2) / 6.0)) or float(np.finfo(np.float64).tiny)


def _with_dc_gain(
    dynamics: TransferFunction, covariance: FloatArray, gain: float, variance: float
) -> tuple[TransferFunction, FloatArray]:
    zeros = len(dynamics.numerator)
    scale = np.ones(len(covariance))
    scale[:zeros] = gain
    direction = np.zeros(len(covariance))
    direction[:zeros] = dynamics.numerator
    moved = replace(dynamics, numerator=gain * dynamics.numerator)
    return moved, covariance * np.outer(scale, scale) + variance * np.outer(direction, direction)
