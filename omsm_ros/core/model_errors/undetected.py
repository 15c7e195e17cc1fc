"""Bounds of model errors that the tests of a residual cannot detect, and their effect on G.

A slow relaxation of size ε leaves G(0) = 1 and scales everything faster by 1 - ε, with a small lag.
That changes the whole numerator and the delay; below ``valid_from`` the gain is one again. An
omitted mode or stiffness shifts the fitted coefficients, whose columns are nearly collinear with
its own.

Steps at regular intervals excite a comb of frequencies. A lightly damped mode between its lines
shows at the neighbouring lines only, so that several frequencies and dampings explain the residual
about equally well. The covariance of one of them does not include the others: their spread,
weighted by likelihood, is added.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial
from scipy import stats

from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse
from omsm_ros.core.estimation.model_order import MAX_POLES, fit
from omsm_ros.core.estimation.model_structure import Fit, ScaledStructure
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.lti.frequency_response import relative_response_jacobian, response_band
from omsm_ros.core.lti.transfer_function import ComplexArray, Structure, TransferFunction
from omsm_ros.core.model_errors.families import (
    CREEP,
    FASTEST_CREEP_S,
    MODE,
    STIFFENING,
    ModelErrorTerm,
)
from omsm_ros.core.model_errors.residual_diagnostics import (
    FALSE_ALARM,
    ResidualDiagnostics,
    ScoreTest,
)
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.linear_algebra import least_squares

# A term 1.645 σ above the limit of a test is missed with a probability of 5 %.
_POWER = 1.645
# The families whose omission bends the response itself.
_BENDING = (MODE, STIFFENING)
UNDETECTED = (CREEP, *_BENDING)
"""Families that may stay undetected in a test; priors are named by them."""

# Decades of time between a structure's slowest motion and the length of a record.
_DECADES = 3.0
# Slowest relaxation [s], and in durations of the record. A joint or a piezo creeps for about a
# minute; slower creep moves less during a scan, and beyond ten records not even its start is
# measurable. A drift of 100 nm a minute may be a relaxation of 50 s and 0.17 %; with 100 s it would
# be twice that, and a warm machine could not be calibrated.
_SLOWEST_CREEP_S, _MOST_RECORDS = 50.0, 10.0
# p-value below which the uncertainty includes a mode that is not significant.
_HINT = 0.05
# Column of the background for the linear drift, which every fit has.
_STEADY_DRIFT = slice(1, 2)


@dataclass(frozen=True, eq=False)
class UndetectedTerm:
    """A model error that the tests may not have detected.

    size, uncertainty: of the most significant term of the family, in its unit
    missed: size that the test would miss with 5 % probability; infinite where it detects none
    shift: (p,) of the coefficients per unit, if the term is omitted
    gain, late: (p,) change of the coefficients that scales the response by one, and that delays it
        by a second
    above: relative error of the gain at all frequencies above ``valid_from``, per unit
    lag: delay of the same effect on a scan [s], per unit
    effect: rms error on the intended scan per unit [m]
    """

    family: str
    parameter: float
    size: float
    uncertainty: float
    missed: float
    shift: FloatArray
    gain: FloatArray
    late: FloatArray
    above: float
    lag: float
    effect: float

    @property
    def carried(self) -> float:
        """Standard uncertainty of the omitted size."""
        return float(np.hypot(self.size, self.uncertainty))

    def covariance(self, carried: float) -> FloatArray:
        """Return the coefficients' covariance (p, p) for a size known to ``carried``."""
        rows = carried * np.stack([self.shift, self.above * self.gain, self.lag * self.late])
        return np.asarray(rows.T @ rows)


def undetected_terms(
    diagnostics: ResidualDiagnostics, drift: Sequence[slice] = (), use: IntendedUse = PAPER_USE
) -> list[UndetectedTerm]:
    """Return the undetected model errors: the worst relaxation, then the families that shift G.

    drift: columns of the background that model a drift;  use: the scans to be corrected
    """
    # Only the relaxations are tested again, up to slower ones.
    slow = replace(diagnostics, only=(CREEP,))
    slow = with_slow_creep(slow.thinned or slow)
    relaxations = [_undetected_terms(slow, judged, use) for judged in slow.creep]
    steady = [_STEADY_DRIFT]
    for gone in [steady, drift, [*steady, *drift]] if drift else [steady]:
        # The size that the test would miss stays that of the fit, whose drift is free.
        space = with_drift_as_noise(slow, gone).space
        for i, (term, test) in enumerate(zip(relaxations, slow.creep, strict=True)):
            score = space.score(test.term.columns[:, :1], CREEP)
            size, uncertainty = float(score.size[0]), score.uncertainty
            if np.hypot(size, uncertainty) < term.carried:
                relaxations[i] = replace(term, size=size, uncertainty=uncertainty)
    known = [term for term in relaxations if np.isfinite(term.uncertainty)]
    found = (
        _worst_relaxation(known, fitted_relaxation(diagnostics.fitted.dynamics), use)
        if known
        else []
    )
    for name in _BENDING:
        judged = diagnostics.best.get(name)
        if judged is None or not np.isfinite(judged.score.uncertainty):
            continue
        # Steps hardly excite a mode slower than their interval.
        sluggish = judged.term.family == MODE and judged.term.parameter * diagnostics.plateau < 1
        if not sluggish or _hinted_by_data(judged):
            found.append(_undetected_terms(diagnostics, judged, use))
    return found


def with_slow_creep(diagnostics: ResidualDiagnostics) -> ResidualDiagnostics:
    """Return ``diagnostics`` with relaxations up to _SLOWEST_CREEP_S, or the record if longer."""
    slower = min(_MOST_RECORDS, _SLOWEST_CREEP_S / diagnostics.model_errors.duration)
    return replace(diagnostics, slower=max(slower, 1.0))


def with_drift_as_noise(
    diagnostics: ResidualDiagnostics, drift: Sequence[slice]
) -> ResidualDiagnostics:
    """Return ``diagnostics`` with the modelled drift treated as noise of the readings.

    As free columns, a drift of a micrometre could cancel a relaxation of as much. A drift of
    nanometres cannot, and as noise it has the size that was fitted. A slow relaxation looks like a
    linear drift: where there is none, there is no relaxation.
    """
    fitted, problem = diagnostics.fitted, diagnostics.problem
    gone = np.zeros(problem.background.shape[1], np.bool_)
    for columns in drift:
        gone[columns] = True
    drifted = problem.background[:, gone] @ fitted.background[gone]
    noisy = fitted.residual + drifted[problem.used]
    return ResidualDiagnostics(
        replace(problem, background=problem.background[:, ~gone]),
        replace(fitted, background=fitted.background[~gone], residual=noisy),
        diagnostics.steps,
        slower=diagnostics.slower,
    )


def _worst_relaxation(
    relaxations: list[UndetectedTerm], found: float, use: IntendedUse
) -> list[UndetectedTerm]:
    """Return the relaxation of the largest effect, and the lag of another one if that is larger.

    found: size of the relaxation in the model. Creep of joints and piezos is about even in the
        logarithm of time: that in the other decades of the record is at most a few times the fitted
        one, and bounds are limited to that.
    """
    limit = _DECADES * found
    if found > 0:
        relaxations = [
            replace(term, size=min(term.size, limit), uncertainty=min(term.uncertainty, limit))
            for term in relaxations
        ]
    worst = max(relaxations, key=lambda term: term.effect * term.carried)
    # Creep goes on beyond the record, by none to as much in each of three decades: a uniform
    # distribution, whose standard deviation is 1/√3 of its limit.
    slower = limit / 3**0.5
    # Many relaxations lag, and noise would mask a part of each: it counts what exceeds the noise.
    lags = [
        replace(
            term,
            size=float(np.sqrt(max(term.size**2 - term.uncertainty**2, 0.0))),
            uncertainty=0.0,
            above=0.0,
            effect=term.lag * use.speed_m_s,
        )
        for term in relaxations
    ]
    latest = max(lags, key=lambda term: term.lag * term.size)
    other = [latest] if latest.lag * latest.size > worst.lag * worst.carried else []
    if worst.above > 0 and worst.carried * worst.above < slower:
        worst = replace(worst, size=0.0, uncertainty=slower / worst.above)
    return [worst, *other]


def fitted_relaxation(dynamics: TransferFunction) -> float:
    """Return the share of G(0) [1] of slow real poles; one of more than half is a slow probe."""
    poles, bottom = dynamics.poles(), dynamics.denominator
    slow = poles[(poles.imag == 0) & (-poles.real * FASTEST_CREEP_S < 1)].real
    slopes = slow * polynomial.polyval(slow, polynomial.polyder(bottom))
    shares = np.abs(polynomial.polyval(slow, dynamics.numerator) / slopes)
    return float(np.sum(shares[shares <= 0.5]))


def _hinted_by_data(judged: ScoreTest) -> bool:
    return judged.term.family == MODE and judged.log_p < np.log(_HINT)


def _undetected_terms(
    diagnostics: ResidualDiagnostics, judged: ScoreTest, use: IntendedUse
) -> UndetectedTerm:
    fitted, term, score = diagnostics.fitted, judged.term, judged.score
    shift = omission_shift(diagnostics, term.columns[:, 0])
    frequency, rms = use.frequencies_hz, use.rms_m
    real, imaginary = relative_response_jacobian(fitted.dynamics, frequency) @ shift
    collinear = real + 1j * imaginary
    remaining = collinear - _response_error(term.family, term.parameter, term.damping, frequency)
    # Fitted coefficients cannot follow the resonance of a lightly damped mode.
    whole = term.family == CREEP or _hinted_by_data(judged)
    gain = np.concatenate([fitted.dynamics.numerator, np.zeros(len(fitted.dynamics.denominator))])
    lag = float(np.linalg.norm(remaining.imag * rms)) / use.speed_m_s
    limit = np.sqrt(stats.chi2.isf(FALSE_ALARM / term.trials, max(score.degrees, 1)))
    return UndetectedTerm(
        term.family,
        term.parameter,
        float(score.size[0]),
        score.uncertainty,
        float(limit + _POWER) * score.uncertainty,
        np.zeros_like(shift) if whole else shift,
        gain,
        np.eye(len(gain))[-1],
        float(np.max(np.abs(remaining if term.family == MODE else remaining.real))) * whole,
        lag * whole,
        float(np.sqrt(np.sum((np.abs(remaining) * rms) ** 2))),
    )


def _response_error(
    family: str, parameter: float, damping: float, frequency: FloatArray
) -> FloatArray:
    """Return the complex relative error of G at ``frequency`` (k,) [Hz], per unit, (k,)."""
    s = 2j * np.pi * frequency
    if family == CREEP:
        return np.asarray(-s * parameter / (1 + s * parameter))
    if family == MODE:
        s = s / (2 * np.pi * parameter)
        return np.asarray(1 / (1 + 2 * damping * s + s * s) - 1)
    return np.zeros(len(frequency), np.complex128)


def omission_shift(diagnostics: ResidualDiagnostics, column: FloatArray) -> FloatArray:
    """Return the shift (p,) of G's coefficients if a term that adds ``column`` (n,) is omitted."""
    fitted, solved = diagnostics.fitted, diagnostics.space.collinear_parameters(column)
    jacobian = fitted.scaled.coefficient_jacobian(fitted.nonlinear)
    return np.asarray(jacobian @ solved[: fitted.structure.size])


# Frequencies of other modes, as logarithm over that of the fitted one, and their damping ratios.
_FREQUENCIES = np.linspace(-0.4, 0.4, 33)
_DAMPINGS = (0.01, 0.02, 0.04, 0.08, 0.16)
# Modes less likely than this, relative to the best, are negligible.
_LEAST_LIKELY = 1e-3
# Frequencies at which responses are compared, a few per cent apart.
_LINES = 150
_LOWEST_HZ = 0.1
# Highest of them over that of the mode; far above it the responses agree.
_HIGHEST = 10.0
# Part of the largest variation below which variations count alike.
_LITTLE = 0.02
# Directions of the coefficients weaker than this part of the strongest are left out.
_DIRECTIONS = 1e-6


def alternative_mode_covariance(
    before: ResidualDiagnostics, term: ModelErrorTerm, fitted: Fit
) -> FloatArray:
    """Return the covariance (p, p) of G over other lightly damped modes than ``term``.

    before: diagnostics of the fit without the mode;  term: the mode as ``fitted`` has it
    """
    highest = 0.25 / before.problem.period
    tried: list[tuple[float, float]] = [(term.parameter, term.damping)]
    tried += [
        (term.parameter * float(np.exp(off)), damping)
        for damping in _DAMPINGS
        for off in _FREQUENCIES
        if term.parameter * np.exp(off) < highest
    ]
    before = before.thinned or before
    modes = before.model_errors.modes(tried)
    screening_scores = before.screening_scores(modes)
    likely = np.exp(0.5 * (screening_scores - np.max(screening_scores)))
    kept = np.flatnonzero(likely > _LEAST_LIKELY)
    lines = np.geomspace(_LOWEST_HZ, _HIGHEST * term.parameter, _LINES)
    lines = np.sort(np.append(lines, [frequency for frequency, _ in tried]))
    own = _change(before, modes.term(0), lines)
    rows = [
        np.sqrt(likely[i] / np.sum(likely[kept])) * (_change(before, modes.term(i), lines) - own)
        for i in kept.tolist()
    ]
    return _collinear_covariance(fitted, lines, np.asarray(rows))


def _collinear_covariance(fitted: Fit, lines: FloatArray, rows: ComplexArray) -> FloatArray:
    """Return the covariance (p, p) with which G varies at ``lines`` (k,) as by ``rows`` (m, k).

    Coefficients cannot follow every variation: where ``rows`` are large, the covariance is scaled
    to include them.
    """
    wanted = np.linalg.norm(rows, axis=0)
    # Where variation is small, its weight is limited.
    weight = 1 / np.maximum(wanted, _LITTLE * np.max(wanted)) if np.any(wanted) else wanted
    jacobian = np.concatenate(
        weight[:, np.newaxis] * relative_response_jacobian(fitted.dynamics, lines)
    )
    shifts = np.column_stack(
        [
            least_squares(jacobian, np.concatenate([r.real, r.imag]), _DIRECTIONS)
            for r in weight * rows
        ]
    )
    covariance = np.asarray(shifts @ shifts.T)
    band = response_band(fitted.dynamics, covariance, lines)
    held = np.hypot(band.gain, band.phase)
    large = (wanted > 0.5 * np.max(wanted)) & (held > 0)
    factor = max(1.0, float(np.max(wanted[large] / held[large], initial=1.0)))
    return np.asarray(factor**2 * covariance)


def _change(before: ResidualDiagnostics, term: ModelErrorTerm, lines: FloatArray) -> ComplexArray:
    """Return the relative change (k,) of G at ``lines`` [Hz] by a mode in its best size."""
    size = before.space.score(term.columns).size
    ratio = 1j * lines / term.parameter
    mode = 1 / (1 + 2 * term.damping * ratio + ratio**2)
    real, imaginary = relative_response_jacobian(before.fitted.dynamics, lines) @ omission_shift(
        before, term.columns @ size
    )
    return np.asarray(size[0] * (mode - 1) + size[1] * ratio * mode - real - 1j * imaginary)


def poles_of(term: ModelErrorTerm) -> ComplexArray:
    """Return the poles [rad/s] of a relaxation, (1,), or of a mode, (2,)."""
    if term.family == CREEP:
        return np.array([-1 / term.parameter], np.complex128)
    omega = 2 * np.pi * term.parameter
    upper = omega * (-term.damping + 1j * np.sqrt(1 - term.damping**2))
    return np.array([upper, np.conj(upper)], np.complex128)


def at_fitted_pole(term: ModelErrorTerm, fitted: Fit) -> ModelErrorTerm:
    """Return ``term`` with the time constant [s] or frequency [Hz] of its fitted pole."""
    poles = fitted.dynamics.poles()
    near = np.abs(np.log(poles / poles_of(term)[0]))
    pole = poles[int(np.argmin(near))]
    parameter = 1 / abs(pole) if term.family == CREEP else abs(pole) / (2 * np.pi)
    return replace(term, parameter=float(parameter), damping=float(-pole.real / abs(pole)))


def fit_with_added_poles(
    problem: Problem,
    base: Fit,
    new: ComplexArray,
    starts: Sequence[float],
    budget: EvaluationBudget | None = None,
) -> Fit | None:
    """Return the fit of ``base`` and ``new`` poles [rad/s], started at multiples of them.

    starts: factors on ``new``
    Return None where the poles would be more than can be fitted.
    """
    zeros, delay = base.structure.zeros + len(new), base.structure.delay
    larger = Structure(base.structure.poles + len(new), zeros, delay)
    if larger.poles > MAX_POLES:
        return None
    scaled = ScaledStructure(larger, problem.rate)
    late = float(base.nonlinear[-1]) if delay else 0.0
    own = base.dynamics.poles()

    def started(faster: float) -> FloatArray:
        poles = np.concatenate([own, faster * new]) / problem.rate
        return scaled.nonlinear_of(np.asarray(poles, np.complex128), late)

    return fit(problem, larger, [started(faster) for faster in starts], budget=budget)
