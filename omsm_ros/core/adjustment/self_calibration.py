"""Estimate the dynamics from scans of one part at different speeds or directions.

A case of the adjustment: the surface is common to all scans, the parameters are those of the
dynamics and the place of the part in each scan. Gauss-Newton on the latency, all else is linear.
The covariance follows from the residuals of whole rings of the part, because texture, vibration
and spindle error are correlated within a ring and between scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from omsm_ros.core.adjustment.blocks import SECTORS, Blocks, blocks_of
from omsm_ros.core.adjustment.families import REPEATED_TRACK, only
from omsm_ros.core.adjustment.network import Network, Scales, Solution, solve
from omsm_ros.core.adjustment.part_terms import part_model
from omsm_ros.core.adjustment.refutation import settled, start_scales
from omsm_ros.core.adjustment.scan_data import (
    ScanData,
    ScanView,
    delayed,
    fitted_surface,
    view_of,
    zero_of,
)
from omsm_ros.core.adjustment.sources import Columns, Family
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.errors import DataError
from omsm_ros.linear_algebra import one_blas_thread
from omsm_ros.units import RPM_RAD_S

# Parameters of the dynamics, and of the part in each scan.
LAG, CURVATURE, GAIN, LATENCY = range(4)
DYNAMIC = 4
OWN = ("clocking", "shift_x", "shift_y", "tilt_x", "tilt_y")
_DYNAMICS, _OWN, _SPINDLE = "dynamics", "own", "spindle_axial"
# Waves of the spindle come with C in all scans alike: more than any spindle has.
_SPINDLE_M = 1e-6
# Drift of each scan but the first: a free polynomial over its time; the rest is a random walk.
_DRIFT, _DRIFT_M = 3, 1e-3
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
# Degrees of the surface's terms for each harmonic.
_DEGREES = 2
# A tenth of a second of arc, the repeatability of the index of a good rotary encoder.
DEFAULT_CLOCKING_RAD = 5e-7
# Motion of a part that stays on the chuck, by warming. On an off-axis paraboloid shift and tilt
# together look like clocking, so these limit the result.
DEFAULT_SHIFT_M, DEFAULT_TILT_RAD = 1e-6, 2e-6
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
# Estimates of drift and noise at each latency, at most.
_STEPS = 10
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
    noise: of a reading, from differences of neighbours [m]
    """

    ratio: float
    disagreement: float
    noise: float

    @property
    def holds(self) -> bool:
        """False if the scans differ significantly and by more than 2 nm."""
        return self.ratio < _GREATEST_RATIO or self.disagreement < _LEAST_DISAGREEMENT_M


def consistency_of(blocks: Blocks, residual: FloatArray) -> ScanConsistency:
    """Return the agreement of the scans by the ``residual`` of each block (b,) [m]."""
    radius, wave = np.hypot(blocks.x, blocks.y), np.exp(-1j * np.arctan2(blocks.y, blocks.x))
    ring = _rings(radius, RINGS)
    place = blocks.scan * RINGS + ring
    size = blocks.scans * RINGS
    # The power of values of white noise at a harmonic is the sum of their variances.
    predicted, count = (
        np.bincount(place, v, size) for v in (blocks.count**2 * blocks.variance, blocks.count)
    )
    power = np.empty((HARMONICS, size))
    turned = (blocks.count * residual).astype(np.complex128)
    for m in range(HARMONICS):
        turned = turned * wave
        power[m] = sum(np.bincount(place, v, size) ** 2 for v in (turned.real, turned.imag))
    seen = count > 0
    power, predicted, count = power[:, seen], predicted[seen], count[seen]
    excess = np.maximum(2 * (power - predicted) / count**2, 0.0)
    mean_square = np.average(np.sum(excess, axis=0), weights=count)
    noise = float(np.sqrt(np.mean(blocks.noise**2)))
    return ScanConsistency(float(np.mean(power / predicted)), float(np.sqrt(mean_square)), noise)


def _rings(radius: FloatArray, number: int) -> IntArray:
    """Return in which of ``number`` rings of equal width each ``radius`` (n,) lies, (n,)."""
    inner, outer = float(np.min(radius)), float(np.max(radius))
    place = (radius - inner) / (outer - inner) * number
    return np.clip(place.astype(np.int64), 0, number - 1)


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
    residual: rms of the readings [m];  agreement: of the scans with each other
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
    scans: Sequence[ScanData], prior: Prior, harmonics: int = DEFAULT_HARMONICS
) -> SelfCalibration:
    """Return the estimate of the dynamics from two or more scans of one part.

    Raises DataError where they determine nothing: one speed and direction, a surface without slope
    along the path, a part that was mounted again, or data without noise.
    """
    _check_scans(scans)
    fit = _DynamicsFit(scans, prior, harmonics)
    if not fit.determined:
        raise _undetermined(scans, prior)
    for index in _MAY_REMAIN_UNDETERMINED:
        if fit.unknown[index]:
            fit = fit.without(index)
    return fit.result()


def _check_scans(scans: Sequence[ScanData]) -> None:
    if len(scans) < 2:
        raise DataError("adjustment.one_scan", scans=len(scans))
    radii = [np.hypot(scan.x, scan.y) for scan in scans]
    inner, outer = max(float(np.min(r)) for r in radii), min(float(np.max(r)) for r in radii)
    if not inner < outer:
        raise DataError("adjustment.no_common_ring", inner=inner, outer=outer)


def _undetermined(scans: Sequence[ScanData], prior: Prior) -> DataError:
    if prior.clocking > _REMOUNTED_RAD:
        return DataError("adjustment.remounted_part")
    each = [scan.speed for scan in scans]
    speeds = [f"{speed / RPM_RAD_S:.1f}" for speed in each]
    if np.ptp(each) < _KNOWN * max(map(abs, each)):
        return DataError("adjustment.equal_speeds", speeds=speeds)
    return DataError("adjustment.symmetric_surface", speeds=speeds)


def _families(durations: Sequence[float]) -> list[Family]:
    """Return the columns of the dynamics, and of the part in each scan except the first.

    durations: of the scans [s]
    """

    def dynamics(v: ScanView) -> FloatArray:
        late = v.lateral_error(v.x_rate, v.y_rate)
        return np.stack([v.motion_rate, -v.motion_acceleration, v.distance, late])

    def own(v: ScanView) -> FloatArray:
        moved = [v.lateral_error(-v.y, v.x), v.lateral_error(1.0, 0.0), v.lateral_error(0.0, 1.0)]
        return np.stack([*moved, v.x, v.y])

    def drift(v: ScanView) -> FloatArray:
        course = 2 * v.since / durations[v.index] - 1
        return np.asarray(legendre.legvander(course, _DRIFT)[:, 1:].T)

    def spindle(v: ScanView) -> FloatArray:
        turned = np.exp(1j * np.arange(1, HARMONICS + 1)[:, np.newaxis] * v.c)
        return np.concatenate([turned.real, turned.imag])

    columns: dict[str, tuple[int, Columns]] = {
        _DYNAMICS: (DYNAMIC, dynamics),
        _SPINDLE: (2 * HARMONICS, spindle),
    }
    for k in range(1, len(durations)):
        columns[f"{_OWN}@{k}"] = len(OWN), only(k, len(OWN), own)
        columns[f"drift@{k}"] = _DRIFT, only(k, _DRIFT, drift)
    return [Family(n, "", size, c, 1.0, REPEATED_TRACK) for n, (size, c) in columns.items()]


class _DynamicsFit:
    """Adjustment of dynamics and place of the part; nonlinear in the latency only."""

    def __init__(
        self, scans: Sequence[ScanData], prior: Prior, harmonics: int, omitted: BoolArray = _NONE
    ) -> None:
        self._scans, self._prior, self._harmonics = scans, prior, harmonics
        self._omitted = omitted
        stated = [prior.clocking, prior.shift, prior.shift, prior.tilt, prior.tilt]
        own = np.maximum(stated, _LEAST_STATED)
        held = _with_fixed(prior.covariance, GAIN) + np.diag(_FLOOR**2)
        self._sizes: dict[str, float | FloatArray] = {_DYNAMICS: held, _SPINDLE: _SPINDLE_M}
        for k in range(1, len(scans)):
            self._sizes |= {f"{_OWN}@{k}": own, f"drift@{k}": _DRIFT_M}
        latency, scales = 0.0, None
        for _ in range(_ITERATIONS):
            before = latency
            solution = self._solved(before, scales)
            latency, scales = float(solution.values[LATENCY]), solution.scales
            if abs(latency - before) < _CONVERGED_S:
                break
        self._solution = solution

    def _solved(self, latency: float, scales: Scales | None) -> Solution:
        """Return the solution that is linear about ``latency`` [s]."""
        scans = [delayed(scan, latency) for scan in self._scans]
        self._nominal = fitted_surface(scans[0])
        zero = zero_of(scans, self._nominal)
        views = [view_of(s, k, zero, self._nominal) for k, s in enumerate(scans)]
        families = _families([scan.duration for scan in scans])
        blocks = blocks_of(views, [1.0] * len(scans), families)
        if not np.all(blocks.noise > 0):
            raise DataError("adjustment.no_noise")
        # Sectors resolve half as many waves.
        highest = min(_DEGREES * self._harmonics, SECTORS // 2)
        part = part_model(blocks, min(s.turns for s in scans), highest)
        # Texture counts with the residuals of its ring, not as cells of the part.
        part = replace(part, cell=np.zeros(len(blocks), np.int64), cells=1)
        network = Network(blocks, tuple(families), part)
        # The values are linearised at ``latency``; this offset makes them absolute.
        y = blocks.deviation + blocks.columns[:, LATENCY] * latency
        first = solve(network, y, scales or start_scales(network, None), self._sizes)
        return settled(first, _STEPS)

    def without(self, index: int) -> _DynamicsFit:
        """Return the fit with one of the four dynamic parameters held at its prior."""
        held = replace(self._prior, covariance=_with_fixed(self._prior.covariance, index))
        omitted = self._omitted | (np.arange(DYNAMIC) == index)
        return _DynamicsFit(self._scans, held, self._harmonics, omitted)

    @property
    def determined(self) -> bool:
        """True if the scans determine lag less latency."""
        two = [LAG, LATENCY]
        (lag, mixed), (_, latency) = self._solution.covariance[np.ix_(two, two)]
        return bool(lag - 2 * mixed + latency < _USEFUL_S**2)

    @property
    def unknown(self) -> BoolArray:
        """Which of the four parameters neither the prior nor the scans determine, (4,)."""
        posterior = np.diag(self._solution.covariance + self._by_gain())[:DYNAMIC]
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

    def result(self) -> SelfCalibration:
        """Return the result with the covariance by rings."""
        solution, blocks = self._solution, self._solution.network.blocks
        net, scales = solution.network, solution.scales
        inverse, left = solution.covariance, solution.residual
        pulled = net.pulled(scales, left)
        rings = int(np.clip(min(s.turns for s in self._scans), _LEAST_RINGS, _MOST_RINGS))
        ring = _rings(np.hypot(blocks.x, blocks.y), rings)
        scores = net.sums_by_column(
            pulled[:, np.newaxis] * (ring[:, np.newaxis] == np.arange(rings))
        )
        moved = inverse @ scores[solution.active]
        prior = np.zeros_like(inverse)
        net.add_prior(prior, solution.active, scales, self._sizes)
        by_rings = moved @ moved.T * (rings / (rings - 1)) + inverse @ prior @ inverse
        covariance = by_rings + self._by_gain()
        two, four = slice(GAIN), slice(DYNAMIC)
        deviation = np.sqrt(np.diag(covariance))
        own = np.array([np.r_[net.place[f"{_OWN}@{k}"]] for k in range(1, len(self._scans))])
        weighted = blocks.columns[:, four] * np.sqrt(blocks.count)[:, np.newaxis]
        mean_square = np.sum(weighted.T @ weighted * covariance[four, four]) / np.sum(blocks.count)
        left -= net.cells_of(scales, left)[net.part.cell]
        return SelfCalibration(
            values=solution.values[four],
            covariance=covariance[four, four],
            known=~self.unknown,
            speeds=tuple(s.speed for s in self._scans),
            residual=float(np.sqrt(np.mean(blocks.noise**2 * scales.noise))),
            followed=float(np.sqrt(max(mean_square, 0.0))),
            agreement=consistency_of(blocks, left),
            prior_conflict=_prior_conflict(
                solution.values[two],
                self._prior.covariance[two, two],
                inverse[two, two],
                by_rings[two, two],
            ),
            own=solution.values[own],
            own_uncertainty=deviation[own],
            amplitudes=_amplitudes(solution, self._nominal, self._harmonics),
            points=int(np.sum(blocks.count)),
        )

    def _by_gain(self) -> FloatArray:
        """Return the effect of the uncertain gain on the covariance, (parameters, parameters).

        The gain is not estimated: on a surface that Z follows its effect is of third order in the
        following error, like other terms that are not modelled.
        """
        solution = self._solution
        column = solution.matrix[solution.active, GAIN].copy()
        column[GAIN] = 0.0
        change = -solution.covariance @ column
        change[GAIN] = 1.0
        return np.asarray(np.outer(change, change) * self._prior.covariance[GAIN, GAIN])


# Radii and angles at which the harmonics of the surface are looked at.
_RADII, _ANGLES = 60, 256


def _amplitudes(solution: Solution, nominal: Surface, harmonics: int) -> FloatArray:
    """Return the rms over radius of each harmonic's amplitude, from 1, (harmonics,) [m]."""
    net = solution.network
    radius = np.linspace(net.part.inner, net.part.outer, _RADII)
    turn = np.exp(2j * np.pi * np.arange(_ANGLES) / _ANGLES)
    x, y = (np.outer(radius, part).ravel() for part in (turn.real, turn.imag))
    height = nominal.height(x, y) + solution.smooth_form(x, y)
    waves = np.abs(np.fft.rfft(height.reshape(_RADII, _ANGLES), axis=1)) * 2 / _ANGLES
    return np.asarray(np.sqrt(np.mean(waves[:, 1 : harmonics + 1] ** 2, axis=0)))


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
