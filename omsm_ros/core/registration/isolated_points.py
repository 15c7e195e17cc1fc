"""Tell dust from form: points far from the smooth form that no neighbouring track confirms.

Successive far points of one track are one event. Events of neighbouring tracks, or of repeated
scans, with the same sign and a similar size confirm each other, as do events farther apart, along a
scratch oblique to the tracks, whose size is nearly the same. Dust lies at random, so clusters of it
occur by chance; a cluster is form if one of its size is improbable at the density of single events,
or if an event is longer along its track than a round grain that the neighbouring tracks miss.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.registration.placement import Placed
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray

DustRule = Literal["none", "isolated"] | int
ISOLATED: DustRule = "isolated"
NO_DUST: DustRule = "none"
# Neighbouring places are at most this many spacings of the tracks apart.
_REACH = 1.5
# Far points of a track with one point between them belong to one event.
_GAP = 2
# Points of an event that is longer along its track than the reach, and no grain of dust.
_LONG = 3
# Events of one defect differ in size by less than this factor, unless there is little dust that may
# meet by chance; reaches between them, with the factor for events that are farther apart.
_SIMILAR = 2.0
_SCALES = ((1.0, _SIMILAR), (1.0, np.inf), (3.0, 1.2), (6.0, 1.2))
# Most similar events that one has about it by chance, where those farther apart are compared.
_MOST_MEETING = 0.25
# A point of a defect is dust beyond this multiple of the usual size of this number of neighbours.
_DENSE, _AROUND = 1.5, 16
# A point little beyond the limit is form if this share of the points around is half as far; noise
# alone is as far at one in 160.
_SHARE_AROUND = 0.05
# Far points that are compared with their surroundings at a time.
_AT_A_TIME = 4096
# Least number of such points where larger ones are judged by it.
_FEW = 2.0
# Expected number of clusters by chance that are mistaken for form, in a whole measurement.
_BY_CHANCE = 0.01
# Standard deviations of a number that chance does not exceed.
_CHANCE = 3.0
# A step longer than this multiple of the usual one is a jump to another line.
_JUMP = 10.0
# Mean step of a path in spacings; points in random order have larger ones.
_MOST_ALONG = 4.0
# Points narrower than this share of their length lie on a line.
_LINE = 1e-3


@dataclass(eq=False)
class FarPoints:
    """Collects the points beyond the outlier limit, and the length of the path of all points.

    limit: of the residual, beyond which a point is far [m]
    rows, near: index in the order of reading, x, y, residual, step to the next point, and whether a
        line ends there, of the far points, and of those beyond half the limit, portions of (6, k)
    read, points: number of points so far, and of those with a deviation;  path: [m]
    ends: number of points where a line begins or ends
    """

    limit: float
    rows: list[FloatArray] = field(default_factory=lambda: [np.empty((6, 0))])
    near: list[FloatArray] = field(default_factory=lambda: [np.empty((6, 0))])
    read: int = 0
    points: int = 0
    path: float = 0.0
    ends: int = 0
    low: FloatArray = field(default_factory=lambda: np.full(2, np.inf))
    high: FloatArray = field(default_factory=lambda: np.full(2, -np.inf))

    def add(self, points: Placed, residual: FloatArray, good: BoolArray) -> BoolArray:
        """Take the ``good`` (n,) of the next points; return which of them (m,) are far."""
        size = np.abs(residual)
        far = size > self.limit
        steps = np.hypot(np.diff(points.x), np.diff(points.y))
        index = self.read + np.flatnonzero(good)
        self.read += len(good)
        if not len(steps):
            return np.zeros(len(far), bool)
        # The step to another line is longer than those before and after it.
        turn = np.zeros(len(steps) + 2, bool)
        turn[2:-2] = steps[1:-1] > _REACH * np.maximum(steps[:-2], steps[2:])
        turn[[0, -1]] = True
        end = turn[1:] | turn[:-1]
        self.ends += int(end.sum())
        columns = (index, points.x, points.y, residual, np.append(steps, steps[-1]), end)
        for kept, at in ((self.rows, far), (self.near, ~far & (size > self.limit / 2))):
            kept.append(np.stack([values[at] for values in columns]))
        self.points += len(residual)
        self.path += float(np.sum(np.minimum(steps, _JUMP * np.median(steps))))
        self.low = np.minimum(self.low, [points.x.min(), points.y.min()])
        self.high = np.maximum(self.high, [points.x.max(), points.y.max()])
        return far

    def dust(self, rule: DustRule) -> tuple[IntArray, BoolArray]:
        """Return the indices of dust by ``rule``, rising, and which far points (k,) are form.

        rule: "none", "isolated", or the most points that a cluster of dust has
        """
        rows = np.concatenate(self.rows, axis=1)
        index = rows[0].astype(np.int64)
        form = np.ones(len(index), bool)
        if rule != NO_DUST and len(index):
            space = self.space()
            event = grain = np.arange(len(index))
            if self.path < _MOST_ALONG * space.spacing * self.points and not space.line:
                event, grain = (_events(rows, space.reach, k) for k in (_SIMILAR, np.inf))
            if rule == ISOLATED:
                form = _confirmed(event, grain, rows, space, self.points)
                for begin in range(0, len(form), _AT_A_TIME):
                    open_ = begin + np.flatnonzero(~form[begin : begin + _AT_A_TIME])
                    form[open_] |= self._like_surroundings(open_, event, rows, space)
                form = self._without_spikes(form | self._at_ends(form, event, rows), rows, space)
            else:
                cluster, _ = _clusters(event, rows, space.reach, _SIMILAR)
                form = np.bincount(cluster)[cluster] > int(rule)
        return index[~form], form

    def _at_ends(self, form: BoolArray, event: IntArray, rows: FloatArray) -> BoolArray:
        """Return which far points (k,) are of events at ends of lines, more than dust has there.

        The form rolls off between the last points of lines, which no other point confirms.
        """
        single = np.unique(event[~form])
        at_end = np.intersect1d(single, event[rows[5] > 0])
        chance = scipy.special.bdtrc(len(at_end) - 1.0, len(single), self.ends / self.points)
        return np.isin(event, at_end) & bool(chance < _BY_CHANCE)

    def _like_surroundings(
        self, at: IntArray, event: IntArray, rows: FloatArray, space: _Space
    ) -> BoolArray:
        """Return which far points ``at`` (m,) are like a good share of the points around.

        A slope of the form crosses the limit between two points, and a pip in the centre of a
        spiral is crossed by few turns. Points of the same event do not count.
        """
        if not len(at):
            return np.zeros(0, bool)
        others = np.concatenate([rows, *self.near], axis=1)
        events = np.append(event, np.full(others.shape[1] - len(event), -1))
        pairs = scipy.spatial.cKDTree(rows[1:3, at].T).sparse_distance_matrix(
            scipy.spatial.cKDTree(others[1:3].T), space.reach, output_type="coo_matrix"
        )
        ratio = others[3][pairs.col] / rows[3][at][pairs.row]
        like = (ratio > 1 / _SIMILAR) & (events[pairs.col] != event[at][pairs.row])
        count = np.bincount(pairs.row[like], None, len(at))
        # Where few points are around, dust too has company; only clusters tell.
        around = space.around(rows[4][at])
        decided = (np.abs(rows[3][at]) <= 2 * self.limit) | (around >= _FEW / _SHARE_AROUND)
        enough = count >= np.maximum(_SHARE_AROUND * around, 1.0 if space.line else _FEW)
        return np.asarray(decided & enough)

    def _without_spikes(self, form: BoolArray, rows: FloatArray, space: _Space) -> BoolArray:
        """Return which far points (k,) are ``form`` or lie about it, and are no dust on it.

        Those that stand out from all around are dust. Where few points are around, no more of them
        are than the dust elsewhere lets expect, the highest: others are form as narrow as tracks.
        """
        if space.line or not np.any(form):
            return form
        others = np.concatenate([rows, *self.near], axis=1)
        away, nearest = scipy.spatial.cKDTree(rows[1:3, form].T).query(rows[1:3].T)
        about = (away <= space.reach) & (rows[3] * rows[3, form][nearest] > 0)
        # A Poisson number of the points about the form are dust.
        around = float(np.sum(about) + others.shape[1] - len(form))
        expected = float(np.sum(~about)) * around / self.points
        most, rare = int(expected + _CHANCE * np.sqrt(expected)), _BY_CHANCE / max(expected, 1.0)
        steep, size = np.where(form, 0.0, np.abs(rows[3])), others[3]
        tree = scipy.spatial.cKDTree(others[1:3].T)
        open_, track = np.flatnonzero(form), np.zeros(self.read + 2)
        while True:
            track[others[0].astype(np.int64)] = size
            for begin in range(0, len(open_), _AT_A_TIME):
                part = open_[begin : begin + _AT_A_TIME]
                places = rows[1:3, part].T
                away, near = tree.query(places, _AROUND + 1, distance_upper_bound=space.reach)
                there = np.isfinite(away[:, 1:])
                same = np.where(there, np.append(size, 0.0)[near[:, 1:]], 0.0)
                ranked = np.sort(same * np.sign(rows[3, part])[:, np.newaxis], axis=1)
                # As many of those around as chance puts next to one are grains too, but not most.
                mean = space.around(rows[4, part]) * expected / around
                company = np.ceil(scipy.special.pdtrik(1 - rare, mean))
                company = np.clip(company, 0, np.maximum(there.sum(axis=1) // 2 - 1, 0))
                level = ranked[np.arange(len(part)), -1 - company.astype(np.int64)]
                full, height = there[:, -1], np.abs(rows[3, part])
                level = np.where(full, ranked[:, -_AROUND // 4], _SIMILAR / _DENSE * level)
                alone = (height - level > self.limit) & (height > _DENSE * level)
                # A grain has no foot of several points: what goes on as its track rises is form.
                at = rows[0, part].astype(np.int64) + np.array([[2], [-2], [1], [-1]])
                foot = np.maximum(track[at] * np.sign(rows[3, part]), 1e-30).reshape(2, 2, -1)
                rise = foot[1] * np.minimum(foot[1] / foot[0], _SIMILAR)
                alone &= height - np.max(rise, axis=0) > self.limit
                steep[part] = np.where(alone, height - level, 0.0)
                about[part[alone & full]] = False
            steep[~about] = 0.0
            # The highest first; those near them are judged without them.
            highest = np.argsort(-steep)[:most]
            highest = highest[steep[highest] > np.max(steep) / _SIMILAR]
            if not len(highest):
                break
            about[highest], size[highest], most = False, 0.0, most - len(highest)
            away, _ = scipy.spatial.cKDTree(rows[1:3, highest].T).query(rows[1:3].T)
            open_ = np.flatnonzero(form & about & (away <= space.reach))
        return np.asarray(about)

    def space(self) -> _Space:
        """Return how far apart neighbouring tracks are."""
        spans = np.sort(self.high - self.low)
        if spans[0] < _LINE * spans[1]:
            reach = _REACH * float(spans[1]) / self.points
            return _Space(reach, 2 * reach / float(spans[1]), True, reach / _REACH)
        area = float(np.prod(spans))
        spacing = max(float(np.sqrt(area / self.points)), area / (self.path or np.inf))
        reach = _REACH * spacing
        return _Space(reach, np.pi * reach**2 / area, False, spacing)


@dataclass(slots=True)
class _Space:
    """Distance of neighbours [m], its share of the whole, and whether the points are on a line.

    spacing: of the tracks, or of the points on a line [m]
    """

    reach: float
    share: float
    line: bool
    spacing: float

    def around(self, step: FloatArray) -> FloatArray:
        """Return the number of points within the reach where the track has steps (k,) [m]."""
        along = 2 * self.reach / np.maximum(step, 1e-3 * self.spacing)
        return np.asarray(along if self.line else along * 2 * self.reach / self.spacing)


def _events(rows: FloatArray, reach: float, similar: float) -> IntArray:
    """Return the event (k,) of each far point: successive ones that are ``similar``.

    rows: index, x, y, residual, step and end of line of the far points (6, k)
    """
    # Steps along a track may be longer than the distance of the tracks.
    apart = np.hypot(*np.diff(rows[1:3])) > np.maximum(reach, _REACH * rows[4, :-1])
    apart |= rows[5, :-1] * rows[5, 1:] > 0
    ratio = rows[3, 1:] / rows[3, :-1]
    new = (np.diff(rows[0]) > _GAP) | apart | (ratio < 1 / similar) | (ratio > similar)
    return np.concatenate([[0], np.cumsum(new)])


def _clusters(
    event: IntArray, rows: FloatArray, reach: float, similar: float
) -> tuple[IntArray, float]:
    """Return the cluster (k,) of each far point, and the share of pairs that are similar.

    similar: factor by which the sizes of neighbours differ at most
    """
    x, y, residual = rows[1:4]
    # One point for each half reach along an event, the farthest from the form, is enough.
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    first = np.concatenate([[0], np.flatnonzero(np.diff(event)) + 1])
    part = np.floor((way - way[first][event]) / (reach / 2)).astype(np.int64)
    order = np.lexsort((-np.abs(residual), part, event))
    ahead = np.ones(len(order), bool)
    ahead[1:] = (np.diff(event[order]) != 0) | (np.diff(part[order]) != 0)
    some = order[ahead]
    tree = scipy.spatial.cKDTree(np.column_stack([x, y])[some])
    pairs = tree.query_pairs(reach, output_type="ndarray")
    one, other = some[pairs[:, 0]], some[pairs[:, 1]]
    ratio = residual[one] / residual[other]
    linked = (ratio > 1 / similar) & (ratio < similar)
    links = np.ones(int(linked.sum())), (event[one[linked]], event[other[linked]])
    count = int(event[-1]) + 1
    graph = scipy.sparse.coo_array(links, (count, count))
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    # One more pair that is similar, because of few none may be by chance.
    sizes = np.sort(np.abs(residual[some]))
    near = np.searchsorted(sizes, similar * sizes) - np.arange(1, len(sizes) + 1)
    return group[event], float((np.sum(near) + 1) / (len(sizes) * (len(sizes) - 1) / 2 + 1))


def _confirmed(
    event: IntArray, grain: IntArray, rows: FloatArray, space: _Space, points: int
) -> BoolArray:
    """Return which far points (k,) are form: those of long events, and of large clusters.

    grain: event (k,) where successive points may differ in size, as those of one grain do
    """
    form = np.zeros(len(event), bool)
    for factor, similar in _SCALES:
        larger = factor if space.line else factor**2
        farther = replace(space, reach=factor * space.reach, share=larger * space.share)
        widest = factor == _SCALES[-1][0]
        one = grain if widest or similar == np.inf else event
        begins = np.concatenate([[0], np.flatnonzero(np.diff(one)) + 1])
        cluster, alike = _clusters(one, rows, farther.reach, similar)
        # Dust that often meets by chance makes clusters, and no single event shows its density.
        open_ = np.count_nonzero(~form[begins])
        if factor > 1 and open_ * farther.share * alike > _MOST_MEETING:
            continue
        form |= _no_chance(cluster[begins], rows[:, begins], farther, points, alike)[cluster]
    # A point of the smooth form between far points shows that they are several grains.
    parted = (np.diff(event) != 0) | (np.diff(rows[0]) > 1)
    run = np.concatenate([[0], np.cumsum(parted)])
    count = np.bincount(run)
    lengths = np.bincount(run[1:], np.where(parted, 0, np.hypot(*np.diff(rows[1:3]))), len(count))
    # Grains cover no more than two points; several that touch are as frequent as chance makes them.
    one, two = np.bincount(count[run[~form]], minlength=_LONG)[1:_LONG] / (1, 2)
    by_chance = two * ((one + two) * alike / points) ** ((count - 1) // 2)
    long = (count >= _LONG) & (by_chance < _BY_CHANCE)
    long = long[run] & (lengths[run] > np.maximum(space.reach, rows[4]))
    return np.asarray(form | np.isin(event, event[long]))


def _no_chance(
    cluster: IntArray, rows: FloatArray, space: _Space, points: int, similar: float
) -> BoolArray:
    """Return which clusters (c,) dust does not make by chance.

    Where each event has μ neighbours on average, clusters of k have Borel's distribution at most,
    e^(−μk) (μk)^(k−1) / k!, because links that meet again add none (M. Penrose, Random Geometric
    Graphs, 2003).
    The expected number of similar events around one follows from the single events, and from the
    points around: a spiral has more of them, and so more dust, about its centre.

    cluster: of each event (m,);  rows: of its first point (6, m)
    similar: share of pairs of events that are similar by chance
    """
    sizes = np.bincount(cluster)
    total = float(np.sum(sizes == 1))
    dense = total * np.maximum(space.around(rows[4]) / points, space.share)
    chance = np.bincount(cluster, dense) / sizes
    # An event of dust is single with the probability e^(−μ).
    chance = chance * similar * np.exp(np.minimum(chance * similar, 1.0))
    chance = np.clip(chance, np.finfo(np.float64).tiny, 1.0)
    among = chance * sizes
    rest = among + scipy.special.gammaln(sizes + 1.0)
    expected = total * np.exp(chance + (sizes - 1) * np.log(among) - rest)
    return np.asarray((expected < _BY_CHANCE) & (sizes > 1))
