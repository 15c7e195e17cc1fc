"""What do scans of one part, at different speeds or directions, say of the dynamics?

The surface is common to all scans and eliminated (:mod:`eliminated_surface`); what grows with
the speed, or turns with the direction, remains (:mod:`scan_model`). Gauss-Newton on latency
and clocking; all else is linear. The covariance comes from the residuals of whole rings of
the part, all scans together, so that texture, vibration and spindle error, which are the same
at the same place or last for turns, do not pass for knowledge.
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

# Do scans of one part agree, once all is fitted in which they may differ?
#
# What remains in each scan is averaged over rings and harmonics of the angle. Noise leaves of
# it what its number of points predicts; a part that moved, or dynamics that are not those of
# the model, leave more.

# Coarser than the surface's own terms, and as far as dynamics of slow axes reach.
RINGS, HARMONICS = 12, 8
# Twice what noise predicts: clean scans of the twin give 0.5 to 1.1, for the fit takes its part.
_GREATEST_RATIO = 2.0
# What is smaller than this does not matter to any accuracy asked of the method.
_LEAST_DISAGREEMENT_M = 2e-9


@dataclass(frozen=True)
class ScanConsistency:
    """How far the scans differ where they should not.

    ratio: mean square of what is left in rings and harmonics over what noise predicts [1]
    disagreement: rms over the part of what is left beyond noise [m]
    noise: of a reading, from one to the next [m]
    """

    ratio: float
    disagreement: float
    noise: float

    @property
    def holds(self) -> bool:
        """False if the scans contradict each other by more than noise, and visibly."""
        return self.ratio < _GREATEST_RATIO or self.disagreement < _LEAST_DISAGREEMENT_M


class ScanConsistencySums:
    """Gathers residuals of ``scans`` scans between the radii ``inner`` and ``outer`` [m]."""

    def __init__(self, scans: int, inner: float, outer: float) -> None:
        self._inner, self._width = inner, (outer - inner) / RINGS
        self._sums = np.zeros((scans, RINGS, HARMONICS), np.complex128)
        self._counts = np.zeros((scans, RINGS))
        self._jumps, self._jump_count = 0.0, 0

    def add(self, scan: int, radius: FloatArray, angle: FloatArray, residual: FloatArray) -> None:
        """Take in points (n,) of one scan, in the order of time."""
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
        """Weigh all that came."""
        variance = self._jumps / max(2 * self._jump_count, 1)
        seen = self._counts > 0
        count = self._counts[seen][:, np.newaxis]
        power = abs(self._sums[seen]) ** 2
        # The sum of n values of white noise times cos and sin has the variance n in all.
        ratio = float(np.mean(power / (count * variance))) if variance > 0 else 0.0
        excess = np.maximum(2 * (power - count * variance) / count**2, 0.0)
        mean_square = np.average(np.sum(excess, axis=1), weights=count[:, 0])
        return ScanConsistency(ratio, float(np.sqrt(mean_square)), float(np.sqrt(variance)))


# How far do residuals let parameters vary, if a whole ring of the part varies as one?
#
# Points next to each other, and the same place in all scans, share texture, vibration and
# spindle error; as independent points they would pass for more knowledge than they are.

# Enough for a covariance of the parameters, few enough to be turns apart.
_MOST_RINGS, _LEAST_RINGS = 60, 12


class RingScores:
    """Gathers residuals portion by portion, at the end of a fit.

    shares: the surface's terms in each column, from the normal equations
    square: sum of the squared residuals so far;  agreement: of the scans with each other
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
        """Take in a portion: its columns x (n, parameters) and heights y (n,), and the solution."""
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


# The paper's off-axis mirror has 2 nm in the sixth harmonic, and 4 pm in the eighth.
DEFAULT_HARMONICS = 12
# A tenth of a second of arc: what the index of a good rotary encoder repeats to.
DEFAULT_CLOCKING_RAD = 5e-7
# A part that stays on the chuck moves by warming alone; on an off-axis paraboloid a shift and
# a tilt together look like clocking, so what is allowed here limits what can be determined.
DEFAULT_SHIFT_M, DEFAULT_TILT_RAD = 1e-6, 2e-6
# A prior as wide as this is none, yet the matrix stays regular.
_FREE = 1e6
# Where the noise is looked for; the residuals tell it after one step.
_NOISE_M = 10e-9
# Of the prior's standard deviation. Two scans of one speed, or of opposite ones, hardly tell lag
# from surface: they move it by a few ns, more than they should and less than anybody could see.
_HARMLESS = 0.03
# Keep what is exactly known from dividing by zero: picometres and picoradians; ns, as². Far below
# any effect.
_LEAST_STATED = 1e-12
_FLOOR = np.array([1e-9, 1e-13, 1e-9, 1e-9])
# No encoder repeats as badly; who states so means a part mounted by hand.
_REMOUNTED_RAD = 1e-4
_NONE: BoolArray = np.zeros(DYNAMIC, np.bool_)
# Without them the rest is still worth having; the one that costs least goes first.
_MAY_REMAIN_UNDETERMINED = (LATENCY, CURVATURE)
# Each step squares the error that is left; 10 ns are 0.02 nm on the paper's scan.
_ITERATIONS = 6
_CONVERGED_S = 1e-8
# They tell a lag to a microsecond, and what a step leaves is of second order in that.
_ENOUGH_POINTS = 40_000
# What the scans narrow to less than this part of what was assumed is known from them.
_KNOWN = 0.01
# Worse than this, 40 nm on the paper's scan, it rests on terms that are not modelled.
_USEFUL_S = 20e-6
# A lag known no better than this is no knowledge: longer than any that is looked for.
_LONGEST_LAG_S = 10e-3


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before: covariance of lag [s], curvature [s²], gain [1], latency [s], (4, 4).

    clocking, shift, tilt: of the part from scan to scan, standard uncertainties [rad], [m], [rad];
        10 for a clocking that nobody knows, because the part was mounted anew
    """

    covariance: FloatArray
    clocking: float = DEFAULT_CLOCKING_RAD
    shift: float = DEFAULT_SHIFT_M
    tilt: float = DEFAULT_TILT_RAD


UNINFORMATIVE_S = _LONGEST_LAG_S
# A mode at 2.5 Hz with a thousandth of the motion has 4e-6 s².
UNINFORMATIVE_CURVATURE_S2 = 1e-4
# The paper's probe is 0.8 % off.
UNINFORMATIVE_GAIN = 1e-2


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """What the scans determine, in the names of :mod:`scan_model`.

    values, covariance: of lag, curvature, gain, latency, with the prior, (4,) and (4, 4); the
        gain stays as it was, and its uncertainty counts
    known: which of them the scans or the prior determine, (4,);  speeds: of the scans [rad/s]
    residual: rms [m];  followed: standard uncertainty that the four leave on the heights of
        this surface, rms [m];  agreement: of the scans with each other
    prior_conflict: χ² of lag and curvature against the prior, 2 degrees of freedom
    own, own_uncertainty: clocking [rad], shift [m] and tilt [rad] of each scan but the first
    amplitudes: rms over the part of each harmonic of the surface, from 1 [m]
    points: fitted
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
        """Lag less latency, as far as the correction had it wrong, and its uncertainty [s]."""
        direction = np.zeros(DYNAMIC)
        direction[LAG], direction[LATENCY] = 1.0, -1.0
        variance = float(direction @ self.covariance @ direction)
        return float(direction @ self.values), float(np.sqrt(variance))


def self_calibrate(
    scans: Sequence[ScanColumns], prior: Prior, harmonics: int = DEFAULT_HARMONICS
) -> SelfCalibration:
    """Return what two or more scans of one part say of the dynamics.

    Raises DataError where they say nothing: one speed and direction, a surface
    without slope along the path, a part that was re-mounted, or no noise at all.
    """
    model = ScanModel(scans, harmonics)
    fit = _Fit(model, prior)
    if not fit.tells:
        raise DataError(_undetermined(model, prior))
    for index in _MAY_REMAIN_UNDETERMINED:
        if fit.unknown[index]:
            fit = fit.without(index)
    return fit.result()


def _undetermined(model: ScanModel, prior: Prior) -> str:
    speeds = ", ".join(f"{s * 30 / np.pi:.1f}" for s in model.speeds)
    if prior.clocking > _REMOUNTED_RAD:
        return (
            "a part that was mounted anew is turned by an unknown angle, which looks as a lag "
            "does; scan it at both speeds without taking it off, or state how well it was clocked"
        )
    if np.ptp(model.speeds) < _KNOWN * max(map(abs, model.speeds)):
        return (
            f"the scans all run at {speeds} rpm, so a lag is the same in each and passes for the "
            "surface; scan at another speed, or in the other direction"
        )
    return (
        f"the scans at {speeds} rpm do not show a lag: the surface does not change along the path; "
        "scan one that is not symmetric about the spindle"
    )


class _Fit:
    """Gauss-Newton with a prior; linear but for latency and clocking."""

    def __init__(self, model: ScanModel, prior: Prior, omitted: BoolArray = _NONE) -> None:
        self._model, self._prior, self._omitted = model, prior, omitted
        self._precision = _precision(
            model, replace(prior, covariance=_with_fixed(prior.covariance, GAIN))
        )
        self._place = ScanPlacement(0.0, np.zeros(model.number))
        self._surface: FloatArray | None = None
        self._variance = _NOISE_M**2
        self._iterate()

    def without(self, index: int) -> _Fit:
        """Return the same fit with one of the four held, which the scans do not determine."""
        covariance = _with_fixed(self._prior.covariance, index)
        omitted = self._omitted | (np.arange(DYNAMIC) == index)
        return _Fit(self._model, replace(self._prior, covariance=covariance), omitted)

    @property
    def tells(self) -> bool:
        """False if the scans leave lag less latency as open as it was."""
        inverse, two = _inverse(self._matrix), [LAG, LATENCY]
        (lag, mixed), (_, latency) = inverse[np.ix_(two, two)]
        return bool(lag - 2 * mixed + latency < _USEFUL_S**2)

    @property
    def unknown(self) -> BoolArray:
        """Which of the four neither the prior nor the scans determine, (4,)."""
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
            # Without a step test latency shows in third order of the following error alone.
            limit[LATENCY] = _USEFUL_S**2
        return np.asarray(self._omitted | (uninformative & (posterior > limit)))

    def _iterate(self) -> None:
        """Converge on some of the points; for that is only to know where to linearise."""
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
            raise DataError(
                "the scans show one surface to the last digit, without any noise, so nothing "
                "tells how sure a lag is; check that the probe was connected and saw the part"
            )
        self._surface = equations.surface_of(parameters)
        self._equations, self._parameters = equations, parameters
        clocking = [parameters[model.own(k).start + CLOCKING] for k in range(1, model.number)]
        self._place = ScanPlacement(float(parameters[LATENCY]), np.array([0.0, *clocking]))

    def result(self) -> SelfCalibration:
        """Return the residuals, covariance by rings, and what is said of the scans."""
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
        """Return what an uncertain gain adds to the covariance, (parameters, parameters).

        It is not estimated: on a surface that Z follows it shows in third order of the following
        error only, where other terms that are not modelled show too.
        """
        column = self._matrix[:, GAIN].copy()
        column[GAIN] = 0.0
        change = -inverse @ column
        change[GAIN] = 1.0
        return np.asarray(np.outer(change, change) * self._prior.covariance[GAIN, GAIN])


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a positive matrix whose rows have different units.

    A direction that is lost in rounding is as little known as rounding lets one say.
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
    """Return the same with one quantity at its value."""
    held = covariance.copy()
    held[index], held[:, index] = 0.0, 0.0
    return held


def _prior_conflict(
    values: FloatArray, prior: FloatArray, inverse: FloatArray, covariance: FloatArray
) -> float:
    """Return χ² of lag and curvature against what was known before, harmless moves set aside.

    values: (2,);  prior: (2, 2);  inverse, covariance: of the normal matrix with the prior in it,
        and by rings, (2, 2)
    With P the inverse of the normal matrix and Λ the precision of the prior the values move by
    ``P (H x + noise)``, x spread as the prior says: variance ``Λ⁻¹ - 2 P + covariance``.
    """
    known = prior + np.diag(_FLOOR[:GAIN] ** 2)
    unit = np.sqrt(np.diag(known))
    expected = (known - 2 * inverse + covariance) / (unit * unit[:, np.newaxis])
    spread, directions = np.linalg.eigh(expected)
    moved = directions.T @ (values / unit)
    # Scans that tell next to nothing move nothing, or by less than a step test would notice.
    return float(np.sum(moved**2 / (np.maximum(spread, 0.0) + _HARMLESS**2)))
