"""How large is an error source of this machine? Evaluated from one recording made for it.

The heights of the recording, less their nominal height, are the columns of the sources
(:mod:`families`) and of what the recording cannot tell from them, plus white noise and a random
walk. The walk is estimated by restricted likelihood, all else by generalised least squares with
its covariance. A jackknife over parts of the recording shows what that model leaves out; the
larger of both uncertainties counts.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.adjustment.families import families_of, ranges_of
from omsm_ros.core.adjustment.scan_data import ScanData, ScanView, view_of, zero_of
from omsm_ros.core.kinematics.kinematics import Geometry, Surface
from omsm_ros.core.registration.probe_alignment import Alignment
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.statistics import white_noise
from omsm_ros.core.surface.zernike_terms import terms_up_to, zernike_values
from omsm_ros.errors import DataError

STILL, TURNED, PASSES, STAND_OFFS = "still", "turned", "passes", "stand_offs"
SPHERE = "sphere"
# Sources of each kind of recording; noise, rate and walk follow from each.
_SOURCES: dict[str, tuple[str, ...]] = {
    STILL: (),
    PASSES: (),
    TURNED: (*(f"spindle_axial/{n}" for n in (2, 3, 4, 5, 6, 8)), "spindle_tilt/2",
             "spindle_tilt/3", "spindle_tilt/4"),
    STAND_OFFS: ("static_gain", "probe_square", "probe_linearity"),
}  # fmt: skip
KINDS = tuple(_SOURCES)
# Means of consecutive points: enough for twelve waves a turn, few enough for dense algebra.
_BLOCKS, _BLOCKS_PER_TURN, _MOST_BLOCKS = 600, 32, 1600
_GROUPS = 8
# Highest harmonic of a ring and Zernike degree of a disc that the form of a turned part may have.
_RING_HARMONICS, _ZERNIKE_DEGREE = 12, 10
_HATS = 24
# A source is shown if its uncertainty is below half of what a machine in need of repair has.
_SHOWN_SHARE = 0.5
# An uncertainty that a dial gauge at the spindle reaches as well.
_SHOWN_CENTRE_M = 1e-5
# Limits of the ratio: variance of the walk in a second over the variance of a block's noise.
_LEAST_RATIO, _LARGEST_RATIO = 1e-8, 1e6


@dataclass(frozen=True)
class FoundSource:
    """One source as a recording shows it.

    name, unit: of the source;  per_turn: of a spindle's motion, None of others
    found: rms of its components;  uncertainty: standard uncertainty of each component [unit]
    half_range: over which a linearity was found [m]
    """

    name: str
    unit: str
    found: float
    uncertainty: float
    per_turn: float | None = None
    half_range: float | None = None

    @property
    def value(self) -> float:
        """Standard uncertainty to state where nothing is corrected: both together [unit]."""
        return float(np.hypot(self.found, self.uncertainty))


def evaluate_sources(
    kind: str, scan: ScanData, nominal: Surface
) -> tuple[tuple[FoundSource, ...], tuple[str, ...]]:
    """Return the sources that the recording shows, and the names of those it does not.

    kind: STILL, a probe held before a fixed place; PASSES, the same line passed repeatedly;
    TURNED, a spiral over a turned part; STAND_OFFS, one ring at several distances of the probe
    nominal: surface of the part

    Raises DataError for another kind, and for a recording that does not move as its kind does.
    """
    if kind not in KINDS:
        raise DataError("adjustment.recording_kind", kind=kind, known=KINDS)
    view = view_of(scan, 0, zero_of([scan], nominal), nominal)
    ranges = ranges_of([view], (), [0])
    families = [f for f in families_of(ranges, ()) if f.name in _SOURCES[kind]]
    size = max(
        1, len(view) // min(max(_BLOCKS, round(scan.turns * _BLOCKS_PER_TURN)), _MOST_BLOCKS)
    )
    whole = len(view) // size * size

    def averaged(values: FloatArray) -> FloatArray:
        return np.asarray(values[:whole].reshape(-1, size).mean(axis=1), np.float64)

    columns = [np.atleast_2d(f.columns(view)) for f in families]
    hidden = _inseparable(kind, view, scan.turns)
    model = _Model(
        time=averaged(view.since),
        columns=np.stack([averaged(row) for block in (*columns, hidden) for row in block]),
        heights=averaged(view.deviation),
    )
    found, missing, first = [], [], 0
    ratio, walk = model.walk()
    values, spread = model.fitted(ratio)
    for family in families:
        here = slice(first, first + family.size)
        first += family.size
        name, _, order = family.name.partition("/")
        rms, unsure = (float(np.sqrt(np.mean(v[here] ** 2))) for v in (values, spread))
        linear = name in ("probe_linearity", "probe_square")
        one = FoundSource(name, family.unit, rms, unsure, float(order) if order else None,
                          ranges.half_range if linear else None)  # fmt: skip
        if one.uncertainty < _SHOWN_SHARE * family.wide:
            found.append(one)
        else:
            missing.append(family.name)
    found = _one_linearity(found)
    if kind in (STILL, PASSES):
        rate = first  # The first hidden column is the time.
        found += [
            FoundSource("drift_rate", "m/s", abs(float(values[rate])), float(spread[rate])),
            FoundSource("drift_walk", "m/√s", *walk),
        ]
    noise = white_noise(view.deviation)
    if kind == STILL:
        found.insert(0, FoundSource("probe_noise", "m", noise, noise / np.sqrt(2 * len(view))))
    return tuple(found), tuple(missing)


def sources_of_alignment(
    aligned: Alignment, known: Geometry, scan: ScanData, drift: tuple[float, float]
) -> tuple[tuple[FoundSource, ...], tuple[str, ...]]:
    """Return centre and beam that a scan of a sphere shows beyond the ``known`` geometry.

    scan: of the sphere;  drift: standard uncertainties of rate [m/s] and walk [m/√s] meanwhile
    Also return the names of those that it does not show.

    On a sphere of radius R an offset e along X changes the heights by ``e x / R``. X moves at a
    constant rate v, so this is a drift of ``e v / R``.
    """
    names = ("centre_x", "centre_y", "beam_x", "beam_y")
    off = np.array([getattr(aligned.geometry, n) - getattr(known, n) for n in names])
    spread = np.array(aligned.uncertainty)
    # The best line through a walk of duration T has a slope of variance 6/(5 T).
    rate = np.hypot(drift[0], drift[1] * np.sqrt(1.2 / scan.duration))
    feed = float(np.ptp(np.hypot(scan.x, scan.y))) / scan.duration
    spread[0] = np.hypot(spread[0], rate * abs(aligned.sphere[3]) / feed)
    found = [
        FoundSource(name, "m", abs(float(off[k])), float(spread[k]))
        for k, name in enumerate(names[:2])
        if spread[k] < _SHOWN_CENTRE_M
    ]
    if aligned.beam_found:
        beam, u = (float(np.sqrt(np.mean(v[2:] ** 2))) for v in (off, spread))
        found.append(FoundSource("beam", "1", beam, u))
    shown = {one.name for one in found}
    return tuple(found), tuple(n for n in (*names[:2], "beam") if n not in shown)


def _one_linearity(found: list[FoundSource]) -> list[FoundSource]:
    """Return ``found`` with square and cube of the distance as one source, the linearity."""
    both = [one for one in found if one.half_range is not None]
    if not both:
        return found
    sizes = np.array([[one.found, one.uncertainty] for one in both])
    size, spread = (float(v) for v in np.sqrt(np.sum(sizes**2, axis=0)))
    joined = replace(both[-1], name="probe_linearity", found=size, uncertainty=spread)
    return [*(one for one in found if one not in both), joined]


def _inseparable(kind: str, view: ScanView, turns: float) -> FloatArray:
    """Return columns of the part and of drift, (k, n); the time is the first of STILL and PASSES.

    Raises DataError for a recording that does not move as its kind does.
    """
    one, time = np.ones(len(view)), view.since
    radius = np.hypot(view.x, view.y)
    still = np.ptp(view.x) < 1e-5 and np.ptp(view.y) < 1e-5
    if kind == STILL and still and turns < 1e-3:
        return np.stack([time, one])
    if kind == PASSES and not still and turns < 1e-3:
        place = np.where(np.ptp(view.slide_x) > 0, view.slide_x, radius)
        nodes = np.linspace(place.min(), place.max(), _HATS)
        return np.stack([time, *(np.interp(place, nodes, hat) for hat in np.eye(_HATS))])
    if kind == STAND_OFFS and turns > 2 and np.ptp(view.distance) > 1e-6:
        waves = [f(n * view.c) for n in range(1, _RING_HARMONICS + 1) for f in (np.cos, np.sin)]
        return np.stack([time, one, *waves])
    if kind == TURNED and turns > 2 and np.ptp(radius) > 0.5 * radius.max():
        terms = terms_up_to(_ZERNIKE_DEGREE)
        return zernike_values(view.x / radius.max(), view.y / radius.max(), terms)
    raise DataError("adjustment.other_motion", kind=kind)


@dataclass(frozen=True, eq=False)
class _Model:
    """Heights of blocks (n,) [m] by ``columns`` (k, n), noise and a walk over ``time`` (n,) [s]."""

    time: FloatArray
    columns: FloatArray
    heights: FloatArray

    def _root(self, ratio: float) -> FloatArray:
        walk = np.minimum.outer(self.time, self.time)
        return np.asarray(np.linalg.cholesky(np.eye(len(self.time)) + ratio * walk), np.float64)

    def _likelihood(self, log_ratio: float) -> tuple[float, float]:
        """Return minus twice the restricted log likelihood, and the variance of a block [m²]."""
        root = self._root(float(np.exp(log_ratio)))
        columns, heights = self._whitened(root)
        q, r = np.linalg.qr(columns)
        rest = heights - q @ (q.T @ heights)
        free = len(heights) - columns.shape[1]
        variance = float(rest @ rest) / free
        logs = np.log(np.abs(np.diag(root))).sum() + np.log(np.abs(np.diag(r)) + 1e-300).sum()
        return 2 * float(logs) + free * float(np.log(variance)), variance

    def _whitened(self, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        scale = np.sqrt(np.sum(self.columns**2, axis=1))
        both = np.column_stack([(self.columns / scale[:, np.newaxis]).T, self.heights])
        made = scipy.linalg.solve_triangular(root, both, lower=True)
        return made[:, :-1], made[:, -1]

    def walk(self) -> tuple[float, tuple[float, float]]:
        """Return the ratio of the variances of walk and noise, and the walk with u [m/√s]."""
        ends = np.log([_LEAST_RATIO, _LARGEST_RATIO])
        grid = np.linspace(ends[0], ends[1], 16)
        start = grid[int(np.argmin([self._likelihood(p)[0] for p in grid]))]
        step = float(grid[1] - grid[0])
        bounds = (max(start - step, ends[0]), min(start + step, ends[1]))
        best = scipy.optimize.minimize_scalar(
            lambda p: self._likelihood(p)[0], bounds=bounds, method="bounded",
            options={"xatol": 0.02},
        ).x  # fmt: skip
        middle, variance = self._likelihood(best)
        size = float(np.sqrt(np.exp(best) * variance))
        # The standard uncertainty of the logarithm of a size is half that of its square.
        sides = (self._likelihood(best + 0.5)[0] + self._likelihood(best - 0.5)[0]) / 2 - middle
        of_log = 0.5 * 0.5 / np.sqrt(max(sides, 1e-3))
        if best <= ends[0] + step:
            upper = next((p for p in grid if self._likelihood(p)[0] > middle + 1), grid[-1])
            return float(np.exp(best)), (0.0, float(np.sqrt(np.exp(upper) * variance)))
        return float(np.exp(best)), (size, float(size * min(of_log, 1.0)))

    def fitted(self, ratio: float) -> tuple[FloatArray, FloatArray]:
        """Return values and standard uncertainties of the columns (k,)."""
        scale = np.sqrt(np.sum(self.columns**2, axis=1))
        columns, heights = self._whitened(self._root(ratio))
        fit = np.linalg.pinv(columns, rcond=1e-9)
        values = fit @ heights
        rest = heights - columns @ values
        variance = float(rest @ rest) / max(len(heights) - columns.shape[1], 1)
        own = variance * np.sum(fit**2, axis=1)
        left_out = []
        for group in np.array_split(np.arange(len(heights)), _GROUPS):
            kept = np.ones(len(heights), bool)
            kept[group] = False
            left_out.append(np.linalg.lstsq(columns[kept], heights[kept], rcond=1e-9)[0])
        jackknife = (_GROUPS - 1) * np.var(np.array(left_out), axis=0)
        return values / scale, np.sqrt(np.maximum(own, jackknife)) / scale
