"""Estimate the dynamics from scans of one part at different speeds or directions.

The surface is common to all scans and is eliminated; effects that depend on speed or direction
remain, see :mod:`omsm_ros.core.adjustment.scan_model`. Gauss-Newton on latency and clocking; all
other parameters are linear. The covariance follows from the residuals of whole rings of the part,
because texture, vibration and spindle error are correlated within a ring and between scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.adjustment.scan_model import (
    CLOCKING,
    CURVATURE,
    DYNAMIC,
    GAIN,
    LAG,
    LATENCY,
    IntervalRows,
    ScanModel,
    ScanPlacement,
    normal_equations,
)
from omsm_ros.core.adjustment.scan_reader import ScanColumns
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.errors import DataError
from omsm_ros.linear_algebra import one_blas_thread
from omsm_ros.units import RPM_RAD_S

# Rings and harmonics of the residuals, coarser than the terms of the surface.
RINGS, HARMONICS = 12, 8
# Twice the power that noise predicts; clean scans of the twin give 0.5 to 1.1.
_GREATEST_RATIO = 2.0
# A smaller disagreement is below the accuracy of the method.
_LEAST_DISAGREEMENT_M = 2e-9
# Rings for the covariance of the parameters, at least a turn wide.
_MOST_RINGS, _LEAST_RINGS = 60, 12
# The off-axis mirror of the paper has 2 nm in the sixth harmonic, and 4 pm in the eighth.
DEFAULT_HARMONICS = 12
# A tenth of a second of arc, the repeatability of the index of a good rotary encoder.
DEFAULT_CLOCKING_RAD = 5e-7
# Motion of a part that stays on the chuck, by warming. On an off-axis paraboloid shift and tilt
# together look like clocking, so these limit the result.
DEFAULT_SHIFT_M, DEFAULT_TILT_RAD = 1e-6, 2e-6
# Standard deviation of a prior without information that keeps the matrix regular.
_FREE = 1e6
# Start value of the noise, replaced after the first step.
_NOISE_M = 10e-9
# Change over the standard deviation of the prior that counts as harmless: some nanoseconds, below
# what a step test resolves.
_HARMLESS = 0.03
# Lower bounds of stated uncertainties, far below any effect: picometres and picoradians; and for
# lag [s], curvature [s²], gain and latency [s].
_LEAST_STATED = 1e-12
_FLOOR = np.array([1e-9, 1e-13, 1e-9, 1e-9])
# A clocking uncertainty above this means a part that was mounted again.
_REMOUNTED_RAD = 1e-4
# Parameters without which the others are still determined; the least important first.
_MAY_REMAIN_UNDETERMINED = (LATENCY, CURVATURE)
# Convergence is quadratic; 10 ns are 0.02 nm on a scan with 2 mm/s.
_ITERATIONS = 6
_CONVERGED_S = 1e-8
# Points of the iteration; they give a lag to a microsecond.
_ENOUGH_POINTS = 40_000
# A parameter is determined by the scans if they narrow its prior to this share.
_KNOWN = 0.01
# A larger uncertainty of the lag rests on terms that are not modelled.
_USEFUL_S = 20e-6
# Standard uncertainties without a step test: a lag longer than any that is searched; the curvature
# of a mode at 2.5 Hz with a thousandth of the motion has 4e-6 s²; the gain of a probe to 1 %.
UNINFORMATIVE_S = 10e-3
UNINFORMATIVE_CURVATURE_S2 = 1e-4
UNINFORMATIVE_GAIN = 1e-2


@dataclass(frozen=True)
class ScanConsistency:
    """Agreement of the scans after the fit.

    ratio: mean square of the residuals in rings and harmonics over the prediction from noise [1]
    disagreement: rms of the residuals in excess of noise [m]
    noise: of a reading, from successive differences [m]
    """

    ratio: float
    disagreement: float
    noise: float

    @property
    def holds(self) -> bool:
        """False if the scans differ significantly and by more than 2 nm."""
        return self.ratio < _GREATEST_RATIO or self.disagreement < _LEAST_DISAGREEMENT_M


class ScanConsistencySums:
    """Collects residuals of ``scans`` scans between the radii ``inner`` and ``outer`` [m]."""

    def __init__(self, scans: int, inner: float, outer: float) -> None:
        self._inner, self._width = inner, (outer - inner) / RINGS
        self._sums = np.zeros((scans, RINGS, HARMONICS), np.complex128)
        self._counts = np.zeros((scans, RINGS))
        self._jumps, self._jump_count = 0.0, 0

    def add(self, scan: int, radius: FloatArray, angle: FloatArray, residual: FloatArray) -> None:
        """Add points (n,) of one scan, in the order of time."""
        ring: IntArray = np.clip((radius - self._inner) // self._width, 0, RINGS - 1).astype(int)
        wave = np.exp(-1j * angle)
        turned = residual.astype(np.complex128)
        for m in range(HARMONICS):
            turned = turned * wave
            real, imaginary = (np.bincount(ring, v, RINGS) for v in (turned.real, turned.imag))
            self._sums[scan, :, m] += real + 1j * imaginary
        self._counts[scan] += np.bincount(ring, minlength=RINGS)
        self._jumps += float(np.sum(np.diff(residual) ** 2))
        self._jump_count += max(len(residual) - 1, 0)

    def result(self) -> ScanConsistency:
        """Return the agreement of all residuals."""
        variance = self._jumps / max(2 * self._jump_count, 1)
        seen = self._counts > 0
        count = self._counts[seen][:, np.newaxis]
        power = abs(self._sums[seen]) ** 2
        # The power of n values of white noise at a harmonic is n times their variance.
        ratio = float(np.mean(power / (count * variance))) if variance > 0 else 0.0
        excess = np.maximum(2 * (power - count * variance) / count**2, 0.0)
        mean_square = np.average(np.sum(excess, axis=1), weights=count[:, 0])
        return ScanConsistency(ratio, float(np.sqrt(mean_square)), float(np.sqrt(variance)))


class RingScores:
    """Collects scores of residuals by ring, for a covariance that is robust to correlation.

    shares: of the terms of the surface in each column, from the normal equations
    square: sum of squared residuals so far;  agreement: of the scans
    """

    def __init__(self, model: ScanModel, shares: FloatArray) -> None:
        self._model, self._shares = model, shares
        rings = int(np.clip(min(model.turns), _LEAST_RINGS, _MOST_RINGS))
        self._scores = np.zeros((rings, model.size))
        self._second = np.zeros((DYNAMIC, DYNAMIC))
        self.square = 0.0
        basis = model.basis
        self.agreement = ScanConsistencySums(model.number, basis.inner, basis.outer)

    def add(
        self,
        part: IntervalRows,
        x: FloatArray,
        y: FloatArray,
        parameters: FloatArray,
        surface: FloatArray,
    ) -> None:
        """Add a portion with columns x (n, parameters), heights y (n,), and the solution."""
        model, basis = self._model, self._model.basis
        terms, here = part.rows.matrix(), basis.terms(part.interval)
        residual = y - x @ parameters - terms @ surface[here]
        free = x - terms @ self._shares[here]
        radius, angle = model.radius(part), model.angle(part)
        depth = (radius - basis.inner) / (basis.outer - basis.inner)
        ring = np.clip(depth * len(self._scores), 0, len(self._scores) - 1).astype(np.int64)
        for number in np.unique(ring):
            mine = ring == number
            self._scores[number] += residual[mine] @ free[mine]
        four = x[:, :DYNAMIC].copy()
        four[:, GAIN] += terms @ surface[here]
        self._second += four.T @ four
        self.square += float(residual @ residual)
        scan = model.scan[part.points]
        for k in np.unique(scan):
            mine = scan == k
            self.agreement.add(int(k), radius[mine], angle[mine], residual[mine])

    def score_covariance(self) -> FloatArray:
        """Return the scores' covariance, (parameters, parameters); a ring varies as a whole."""
        rings = len(self._scores)
        return np.asarray(self._scores.T @ self._scores * (rings / (rings - 1)))

    def followed(self, covariance: FloatArray) -> float:
        """Return the rms standard uncertainty of the heights by the four parameters [m]."""
        mean_square = float(np.sum(self._second * covariance)) / len(self._model)
        return float(np.sqrt(max(mean_square, 0.0)))


_NONE: BoolArray = np.zeros(DYNAMIC, np.bool_)


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior covariance of lag [s], curvature [s²], gain [1] and latency [s], (4, 4).

    clocking, shift, tilt: standard uncertainties of the part from scan to scan [rad], [m], [rad];
        a clocking of 10 rad for a part that was mounted again
    """

    covariance: FloatArray
    clocking: float = DEFAULT_CLOCKING_RAD
    shift: float = DEFAULT_SHIFT_M
    tilt: float = DEFAULT_TILT_RAD


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """Result of self-calibration.

    values, covariance: of lag, curvature, gain, latency, with the prior, (4,) and (4, 4); the
        gain keeps its prior value and uncertainty
    known: which of them the scans or the prior determine, (4,);  speeds: of the scans [rad/s]
    residual: rms [m];  agreement: of the scans with each other
    followed: rms standard uncertainty of the heights of this surface from the four parameters [m]
    prior_conflict: χ² of lag and curvature against the prior, χ²(2) without a conflict
    own, own_uncertainty: clocking [rad], shift [m] and tilt [rad] of each scan except the first
    amplitudes: rms over the part of each harmonic of the surface, from 1 [m]
    points: number of fitted points
    """

    values: FloatArray
    covariance: FloatArray
    known: BoolArray
    speeds: tuple[float, ...]
    residual: float
    followed: float
    agreement: ScanConsistency
    prior_conflict: float
    own: FloatArray
    own_uncertainty: FloatArray
    amplitudes: FloatArray
    points: int

    @property
    def structure(self) -> tuple[float, float]:
        """Error of lag less latency in the correction, and its uncertainty [s]."""
        direction = np.zeros(DYNAMIC)
        direction[LAG], direction[LATENCY] = 1.0, -1.0
        variance = float(direction @ self.covariance @ direction)
        return float(direction @ self.values), float(np.sqrt(variance))


@one_blas_thread()
def self_calibrate(
    scans: Sequence[ScanColumns], prior: Prior, harmonics: int = DEFAULT_HARMONICS
) -> SelfCalibration:
    """Return the estimate of the dynamics from two or more scans of one part.

    Raises DataError where they determine nothing: one speed and direction, a surface without slope
    along the path, a part that was mounted again, or data without noise.
    """
    model = ScanModel(scans, harmonics)
    fit = _DynamicsFit(model, prior)
    if not fit.determined:
        raise _undetermined(model, prior)
    for index in _MAY_REMAIN_UNDETERMINED:
        if fit.unknown[index]:
            fit = fit.without(index)
    return fit.result()


def _undetermined(model: ScanModel, prior: Prior) -> DataError:
    if prior.clocking > _REMOUNTED_RAD:
        return DataError("adjustment.remounted_part")
    speeds = [f"{speed / RPM_RAD_S:.1f}" for speed in model.speeds]
    if np.ptp(model.speeds) < _KNOWN * max(map(abs, model.speeds)):
        return DataError("adjustment.equal_speeds", speeds=speeds)
    return DataError("adjustment.symmetric_surface", speeds=speeds)


class _DynamicsFit:
    """Gauss-Newton fit with a prior; nonlinear in latency and clocking only."""

    def __init__(self, model: ScanModel, prior: Prior, omitted: BoolArray = _NONE) -> None:
        self._model, self._prior, self._omitted = model, prior, omitted
        self._precision = _precision(
            model, replace(prior, covariance=_with_fixed(prior.covariance, GAIN))
        )
        self._place = ScanPlacement(0.0, np.zeros(model.number))
        self._surface: FloatArray | None = None
        self._variance = _NOISE_M**2
        self._iterate()

    def without(self, index: int) -> _DynamicsFit:
        """Return the fit with one of the four dynamic parameters held at its prior."""
        covariance = _with_fixed(self._prior.covariance, index)
        omitted = self._omitted | (np.arange(DYNAMIC) == index)
        return _DynamicsFit(self._model, replace(self._prior, covariance=covariance), omitted)

    @property
    def determined(self) -> bool:
        """True if the scans determine lag less latency."""
        inverse, two = _inverse(self._matrix), [LAG, LATENCY]
        (lag, mixed), (_, latency) = inverse[np.ix_(two, two)]
        return bool(lag - 2 * mixed + latency < _USEFUL_S**2)

    @property
    def unknown(self) -> BoolArray:
        """Which of the four parameters neither the prior nor the scans determine, (4,)."""
        inverse = _inverse(self._matrix)
        posterior = np.diag(inverse + self._by_gain(inverse))[:DYNAMIC]
        assumed = np.diag(self._prior.covariance)
        uninformative = (
            assumed
            >= np.array([UNINFORMATIVE_S, UNINFORMATIVE_CURVATURE_S2, np.inf, UNINFORMATIVE_S]) ** 2
            / 4
        )
        limit = _KNOWN**2 * assumed
        if uninformative[LAG]:
            # Without a step test latency has a third-order effect of the following error only.
            limit[LATENCY] = _USEFUL_S**2
        return np.asarray(self._omitted | (uninformative & (posterior > limit)))

    def _iterate(self) -> None:
        """Converge on a selection of the points, to find the point of linearisation."""
        every = max(len(self._model) // _ENOUGH_POINTS, 1)
        for _ in range(_ITERATIONS):
            before, started = self._place.latency, self._surface is not None
            self._step(every)
            if started and abs(self._place.latency - before) < _CONVERGED_S:
                return

    def _step(self, every: int) -> None:
        model, place, surface = self._model, self._place, self._surface
        equations = normal_equations(
            model.basis,
            model.portions(place, every),
            lambda part: model.columns(part, place, surface),
        )
        self._matrix = every * equations.matrix / self._variance + self._precision
        parameters = _inverse(self._matrix) @ equations.right * (every / self._variance)
        self._variance = every * equations.misfit(parameters) / len(model)
        if not self._variance > 0:
            raise DataError("adjustment.no_noise")
        self._surface = equations.surface_of(parameters)
        self._equations, self._parameters = equations, parameters
        clocking = [parameters[model.own(k).start + CLOCKING] for k in range(1, model.number)]
        self._place = ScanPlacement(float(parameters[LATENCY]), np.array([0.0, *clocking]))

    def result(self) -> SelfCalibration:
        """Return the result from all points, with the covariance by rings."""
        self._step(every=1)
        model, parameters = self._model, self._parameters
        seen = RingScores(model, self._equations.shares)
        assert self._surface is not None
        for part in model.portions(self._place, 1):
            seen.add(
                part, *model.columns(part, self._place, self._surface), parameters, self._surface
            )
        inverse = _inverse(self._matrix)
        score_covariance = seen.score_covariance() / self._variance**2 + self._precision
        by_rings = inverse @ score_covariance @ inverse
        covariance = by_rings + self._by_gain(inverse)
        two, four = slice(GAIN), slice(DYNAMIC)
        own = np.array([model.own(k) for k in range(1, model.number)], object)
        deviation = np.sqrt(np.diag(covariance))
        return SelfCalibration(
            values=parameters[four],
            covariance=covariance[four, four],
            known=~self.unknown,
            speeds=tuple(model.speeds),
            residual=float(np.sqrt(seen.square / len(model))),
            followed=seen.followed(covariance[four, four]),
            agreement=seen.agreement.result(),
            prior_conflict=_prior_conflict(
                parameters[two],
                self._prior.covariance[two, two],
                inverse[two, two],
                by_rings[two, two],
            ),
            own=np.array([parameters[o] for o in own]),
            own_uncertainty=np.array([deviation[o] for o in own]),
            amplitudes=model.basis.amplitudes(self._surface),
            points=len(model),
        )

    def _by_gain(self, inverse: FloatArray) -> FloatArray:
        """Return the effect of the uncertain gain on the covariance, (parameters, parameters).

        The gain is not estimated: on a surface that Z follows its effect is of third order in the
        following error, like other terms that are not modelled.
        """
        column = self._matrix[:, GAIN].copy()
        column[GAIN] = 0.0
        change = -inverse @ column
        change[GAIN] = 1.0
        return np.asarray(np.outer(change, change) * self._prior.covariance[GAIN, GAIN])


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a positive matrix whose rows have different units.

    Eigenvalues are bounded from below by rounding.
    """
    scale = 1 / np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix * scale * scale[:, np.newaxis])
    known = np.maximum(values, len(values) * np.finfo(np.float64).eps * values[-1])
    return np.asarray(scale[:, np.newaxis] * ((vectors / known) @ vectors.T) * scale)


def _precision(model: ScanModel, prior: Prior) -> FloatArray:
    """Return the inverse of the prior's covariance, (parameters, parameters)."""
    precision = np.eye(model.size) / _FREE**2
    four = slice(DYNAMIC)
    precision[four, four] = _inverse(prior.covariance + np.diag(_FLOOR**2))
    stated = np.array([prior.clocking, prior.shift, prior.shift, prior.tilt, prior.tilt])
    stated = np.maximum(stated, _LEAST_STATED)
    for k in range(1, model.number):
        own = model.own(k)
        precision[own, own] = np.diag(stated**-2.0)
    return precision


def _with_fixed(covariance: FloatArray, index: int) -> FloatArray:
    """Return the covariance with zero uncertainty of one parameter."""
    held = covariance.copy()
    held[index], held[:, index] = 0.0, 0.0
    return held


def _prior_conflict(
    values: FloatArray, prior: FloatArray, inverse: FloatArray, covariance: FloatArray
) -> float:
    """Return χ² of lag and curvature against the prior, insensitive to harmless changes.

    values: (2,);  prior: (2, 2);  inverse: of the normal matrix including the prior (2, 2)
    covariance: by rings (2, 2)

    P is the inverse of the normal matrix, Λ the precision of the prior. The values change by
    ``P (H x + noise)`` with x distributed as the prior: variance ``Λ⁻¹ - 2 P + covariance``.
    """
    known = prior + np.diag(_FLOOR[:GAIN] ** 2)
    unit = np.sqrt(np.diag(known))
    expected = (known - 2 * inverse + covariance) / (unit * unit[:, np.newaxis])
    spread, directions = np.linalg.eigh(expected)
    moved = directions.T @ (values / unit)
    # The floor keeps χ² small where scans with little information change the values slightly.
    return float(np.sum(moved**2 / (np.maximum(spread, 0.0) + _HARMLESS**2)))
