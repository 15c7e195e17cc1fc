"""Lines in time, steps from turn to turn, and heights that follow what the correction removed.

They are looked for in the residuals of a first fit. Each finding becomes a family of
columns, and is tested as all others are.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.adjustment.families import REPEATED_TRACK, only, periodic
from omsm_ros.core.adjustment.network import Solution
from omsm_ros.core.adjustment.scan_data import ScanView
from omsm_ros.core.adjustment.sources import VIBRATION, Family
from omsm_ros.core.registration.form_model import outlier_limit
from omsm_ros.core.registration.isolated_points import ISOLATED, FarPoints
from omsm_ros.core.registration.placement import Placed
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.streams.statistics import spread_about_median

# Over its neighbours a bin of white noise is beyond 30 once in 10 000 scans of 250 000 points.
_LINE_OVER_NOISE, _MOST_LINES = 30.0, 3
# Share of the larger amplitude that the smaller half of a scan must reach.
_LASTING = 0.5
# The part's own waves: whole multiples of the turn, and what changes from turn to turn around them.
_PART_HARMONICS, _SIDE_BAND = 30, 0.12
# Neighbours of a line, whose median is the noise.
_BINS = 400
# The largest of 1500 differences between turns of clean scans was below 5.
_STEP_LIMIT = 7.0
# Share of the deviation that the removed error explains where its sign is wrong, and how near to
# once or twice the removed error it then is.
_FOLLOWS, _NEAR_WHOLE = 0.95, 0.1
# Jumps of height and of angle as machines in need of repair make them.
_HEIGHT_STEP_M, _C_LOST_RAD = 1e-7, 1e-3


def _left(solution: Solution, view: ScanView) -> FloatArray:
    """Return what ``solution`` leaves of the deviation of one scan, (n,) [m]."""
    net = solution.network
    mine = net.blocks.scan == view.index
    cells = net.cells_of(solution.scales, solution.residual)[net.part.cell[mine]]
    fitted = (solution.y - solution.residual)[mine] + cells
    return np.asarray(view.deviation - np.interp(view.since, net.blocks.since[mine], fitted))


def dust_of(solution: Solution, views: Sequence[ScanView]) -> list[tuple[IntArray, FloatArray]]:
    """Return by scan which points are dust, as a registration finds it, and how high [m].

    A point that the tracks of one scan do not confirm is narrower than they are apart. The map does
    not resolve it, so that far points of another scan at the same place are left out, too.
    """
    found, dust, reach = [], [np.empty((0, 2))], 0.0
    for view in views:
        left = _left(solution, view)
        collected, nothing = FarPoints(outlier_limit(left)), np.empty((0, len(left)))
        points = Placed(view.x, view.y, left, nothing, nothing, nothing)
        far = np.flatnonzero(collected.add(points, left, np.ones(len(left), np.bool_)))
        places = np.stack([view.x, view.y], axis=1)
        found.append((far, left[far], places[far]))
        dust.append(places[collected.dust(ISOLATED)[0]])
        reach = max(reach, collected.space().reach)
    known = scipy.spatial.cKDTree(np.concatenate(dust))
    near = [known.query(places)[0] < reach for *_, places in found]
    return [(far[n], height[n]) for (far, height, _), n in zip(found, near, strict=True)]


def lines_of(solution: Solution, view: ScanView) -> list[Family]:
    """Return waves in time that stand out of the noise of one scan, both phases of each."""
    left = _left(solution, view)
    period = float(np.median(np.diff(view.since)))
    series = np.zeros(round(float(view.since[-1]) / period) + 1)
    series[np.round(view.since / period).astype(np.int64)] = left
    frequency: FloatArray = np.asarray(np.fft.rfftfreq(len(series), period), np.float64)
    multiple = frequency / (abs(view.speed) / (2 * np.pi))
    nearest = np.round(multiple)
    part = (np.abs(multiple - nearest) < _SIDE_BAND) & (nearest <= _PART_HARMONICS)
    part |= multiple < 0.9
    found: list[Family] = []
    while len(found) < _MOST_LINES:
        power = np.abs(np.fft.rfft(series * np.hanning(len(series)))) ** 2
        ratio = np.where(part, 0.0, power / np.maximum(_floor(power), 1e-300))
        peak = _summit(power, int(np.argmax(ratio)))
        if np.max(ratio) < _LINE_OVER_NOISE or part[peak] or not 0 < peak < len(power) - 1:
            break
        # By a parabola through the logarithms.
        here = np.log(power[peak - 1 : peak + 2])
        bend = here[0] - 2 * here[1] + here[2]
        shift = 0.5 * (here[0] - here[2]) / bend if bend < 0 else 0.0
        refined = float(frequency[peak] + shift * frequency[1])
        if not _lasting(series, 2 * np.pi * refined * period):
            break
        _, series = _without(series, 2 * np.pi * refined * period)
        name = f"{VIBRATION}/{refined:.4g}@{view.index}"
        wave = only(view.index, 2, periodic("since", 1 / refined))
        found.append(Family(name, "m", 2, wave, 1e-7, REPEATED_TRACK))
    return found


def _lasting(series: FloatArray, step: float) -> bool:
    """Return whether a wave of ``step`` [rad] a sample is as large in both halves of ``series``.

    A line lasts; what the texture of the part makes at one radius does not.
    """
    half = len(series) // 2
    sizes = [_without(part, step)[0] for part in (series[:half], series[half:])]
    return min(sizes) > _LASTING * max(sizes)


def _summit(power: FloatArray, peak: int) -> int:
    """Return the local maximum next to ``peak``, uphill from it."""
    while True:
        low, high = max(peak - 1, 0), min(peak + 2, len(power))
        top = low + int(np.argmax(power[low:high]))
        if top == peak:
            return peak
        peak = top


def _without(series: FloatArray, step: float) -> tuple[float, FloatArray]:
    """Return the amplitude of a wave of ``step`` [rad] a sample, and ``series`` without it."""
    angle = step * np.arange(len(series))
    wave = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    size = np.linalg.lstsq(wave, series, rcond=None)[0]
    return float(np.hypot(*size)), series - wave @ size


def _floor(power: FloatArray) -> FloatArray:
    """Return the mean power around each bin by medians of groups, as of white noise."""
    groups = max(len(power) // _BINS, 1)
    edges = np.linspace(0, len(power), groups + 1).astype(np.int64)
    level = [float(np.median(power[a:b])) for a, b in pairwise(edges)]
    middle = (edges[:-1] + edges[1:]) / 2
    return np.asarray(np.interp(np.arange(len(power)), middle, level) / np.log(2.0))


def steps_of(solution: Solution, scan: int) -> list[Family]:
    """Return the largest step of the height and of the angle, where they stand out.

    The angle is compared from turn to turn, so a scan within one turn shows no step of it.
    """
    found = {"height_step": _height_step(solution, scan)}
    if np.any(solution.network.blocks.turn[solution.network.blocks.scan == scan]):
        found["c_lost"] = _angle_step(solution, scan)
    return [_after(time, kind, scan) for kind, (time, deviate) in found.items()
            if deviate > _STEP_LIMIT]  # fmt: skip


def _height_step(solution: Solution, scan: int) -> tuple[float, float]:
    """Return the time [s] and the deviate of the largest change from one turn to the next."""
    net = solution.network
    here, width = net.knots[scan], net.steps[scan]
    moves = np.diff(solution.values[here])
    size = np.abs(moves) / max(spread_about_median(moves), 1e-15)
    knot = int(np.argmax(size))
    mine = net.blocks.scan == scan
    since = net.blocks.since[mine]
    left = (solution.residual + net.of_drift(solution.values))[mine]
    window = (since > (knot - 1) * width) & (since < (knot + 2) * width)
    return _break(since[window], left[window]), float(size[knot])


def _break(time: FloatArray, values: FloatArray) -> float:
    """Return the time between the two parts of ``values`` whose means differ most."""
    number = np.arange(1, len(values))
    below = np.cumsum(values)[:-1]
    above = float(np.sum(values)) - below
    between = below**2 / number + above**2 / (len(values) - number)
    best = int(np.argmax(between))
    return float((time[best] + time[best + 1]) / 2)


def _angle_step(solution: Solution, scan: int) -> tuple[float, float]:
    net = solution.network
    mine = net.blocks.scan == scan
    turn, left = net.blocks.turn[mine], solution.residual[mine]
    column = net.blocks.turning[mine]
    turns = int(turn[-1]) + 1

    def mean(values: FloatArray) -> FloatArray:
        count = np.maximum(np.bincount(turn, minlength=turns), 1)
        return np.asarray(np.bincount(turn, values, turns) / count)

    centred = column - mean(column)[turn]
    power = np.bincount(turn, centred**2, turns)
    angle = np.bincount(turn, centred * left, turns) / np.maximum(power, 1e-300)
    # Weighted as they are known: near the axis an angle moves no height.
    known = np.sqrt(np.minimum(power[1:], power[:-1]))
    moves = np.diff(angle) * known
    size = np.abs(moves) / max(spread_about_median(moves), 1e-15)
    best = int(np.argmax(size))
    since = net.blocks.since[mine]
    # Within the turn where it happens part of it is seen on either side.
    begin = float(since[np.argmax(turn >= best)])
    end = float(since[min(len(since) - 1, int(np.sum(turn <= best + 1)))])
    window = (since >= begin) & (since <= end)
    # From there on the column is found in what is left with another coefficient.
    time = _break(since[window], left[window] * np.sign(centred[window]))
    return time, float(size[best])


def _after(time: float, kind: str, scan: int) -> Family:
    """Return what a step of height or angle does from its ``time`` [s] on."""

    def columns(v: ScanView) -> FloatArray:
        after = (v.since > time).astype(np.float64)
        shape = after if kind == "height_step" else after * v.lateral_error(-v.y, v.x)
        return np.asarray(shape[np.newaxis])

    unit, size = ("m", _HEIGHT_STEP_M) if kind == "height_step" else ("rad", _C_LOST_RAD)
    return Family(f"{kind}@{scan}", unit, 1, only(scan, 1, columns), size, REPEATED_TRACK)


def follows_removed(view: ScanView) -> float | None:
    """Return the share of the removed error that the deviation follows; None where it does not.

    Regression on piston, both tilts and what the correction removed: a correction of the wrong sign
    leaves the removed error once or twice in the heights, of either sign. A distance of the wrong
    sign leaves the distance itself twice, with the error of the servo in it.
    """
    distance = view.distance + view.deviation
    twice = _followed(view, distance)
    return _followed(view, view.removed) or (twice if twice is not None and twice > 1.5 else None)


def _followed(view: ScanView, removed: FloatArray) -> float | None:
    """Return the share of ``removed`` (n,) [m] in the deviation, if it is one or two and most."""
    columns = np.stack([np.ones(len(view)), view.x, view.y, removed], axis=1)
    scale = np.maximum(np.max(np.abs(columns), axis=0), 1e-300)
    if scale[3] <= 1e-12:
        return None
    pose = columns[:, :3] / scale[:3]
    values = np.stack([removed, view.deviation], axis=1)
    free = values - pose @ np.linalg.lstsq(pose, values, rcond=None)[0]
    power, mixed, total = free[:, 0] @ free[:, 0], free[:, 0] @ free[:, 1], free[:, 1] @ free[:, 1]
    if power <= 0 or total <= 0:
        return None
    share, explained = mixed / power, mixed**2 / (power * total)
    whole = min(max(round(abs(share)), 1), 2)
    wrong = explained > _FOLLOWS and abs(abs(share) - whole) < _NEAR_WHOLE
    return float(share) if wrong else None
