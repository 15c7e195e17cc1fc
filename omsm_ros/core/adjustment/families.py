"""Which errors of the machine can the adjustment find, and what does each do to the heights?

One row of the table made by :func:`families_of` is one family: columns of the design matrix that
have one cause and one declared size. Names are those of the declared sources
(:mod:`omsm_ros.core.correction.source_kinds`); ``/n`` behind a name is the number per turn.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import legendre

from omsm_ros.core.adjustment.scan_data import ScanView
from omsm_ros.core.adjustment.sources import VIBRATION, Columns, Family, Source, base_name
from omsm_ros.core.correction.source_kinds import components, smooth
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.zernike_terms import terms_up_to, zernike_values
from omsm_ros.errors import ConfigurationError

# Scans that would show a family, codes for the messages; a new speed where there are two already.
OTHER_SPEED, NEW_SPEED = "other_speed", "new_speed"
OTHER_DIRECTION, RECLOCKED = "other_direction", "reclocked"
BEYOND_CENTRE, REPEATED_TRACK = "beyond_centre", "repeated_track"
OTHER_STAND_OFF, REFERENCE = "other_stand_off", "reference_artefact"


@dataclass(frozen=True, eq=False)
class Ranges:
    """Extent of all scans together, by which the columns are scaled.

    speed: mean magnitude, speeds: of each, with sign [rad/s];  duration: of all [s]
    motion, distance, radius: half ranges [m]
    slide, lift: least and greatest slide x and motion [m];  clampings: number of each scan's
    durations, feeds: of each scan [s], of slide x [m/s]
    lengths, periods: declared, by family [m]
    half_range: distance for which linearity errors are declared [m]; ``distance`` where none are
    """

    speed: float
    speeds: tuple[float, ...]
    duration: float
    motion: float
    distance: float
    half_range: float
    radius: float
    slide: tuple[float, float]
    lift: tuple[float, float]
    clampings: tuple[int, ...]
    durations: tuple[float, ...]
    feeds: tuple[float, ...]
    lengths: Mapping[str, float] = field(default_factory=dict)
    periods: Mapping[str, float] = field(default_factory=dict)


# A probe that is driven through less of its range shows no error of it: the plausible size of its
# linearity errors over this distance is a slope of a few per cent, as that of its scale.
_LEAST_DISTANCE_M = 10e-6


def ranges_of(
    views: Sequence[ScanView], priors: Sequence[Source], clampings: Sequence[int]
) -> Ranges:
    """Return the extent of ``views``.

    clampings: number of the clamping of each
    """

    def ends(name: str) -> tuple[float, float]:
        values = [getattr(v, name) for v in views]
        return float(min(map(np.min, values))), float(max(map(np.max, values)))

    lift, distance = ends("motion"), ends("distance")
    used = max(*map(abs, distance), _LEAST_DISTANCE_M)
    return Ranges(
        speeds=tuple(v.speed for v in views),
        speed=float(np.mean([abs(v.speed) for v in views])),
        duration=ends("time")[1] or 1.0,
        motion=(lift[1] - lift[0]) / 2 or 1.0,
        distance=used,
        half_range=next((p.half_range for p in priors if p.half_range is not None), used),
        radius=float(max(np.max(np.hypot(v.x, v.y)) for v in views)),
        slide=ends("slide_x"),
        lift=lift,
        clampings=tuple(clampings),
        durations=tuple(float(v.since[-1]) or 1.0 for v in views),
        feeds=tuple(float((v.slide_x[-1] - v.slide_x[0]) / (v.since[-1] or 1.0)) for v in views),
        lengths={p.name: p.correlation_length for p in priors if p.correlation_length is not None},
        periods={p.name: p.period for p in priors if p.period is not None},
    )


# Harmonics of the spindle that are looked for; above them little is left of a rolling bearing's
# synchronous motion, and a block of a turn's points begins to smooth.
SPINDLE_HARMONICS = tuple(range(1, 13))
# Rolling elements and belts come round every second or third turn (ISO 230-7, asynchronous).
SUB_HARMONICS = (1 / 2, 3 / 2, 5 / 2, 1 / 3, 2 / 3, 4 / 3, 5 / 3)
_TILT_HARMONICS, _RADIAL_HARMONICS, _C_HARMONICS = (2, 3, 4), (1, 2, 3), (1, 2)


# Declared sources without columns of their own: scales of noise and drift, lines that are looked
# for in the residuals, and what one scan alone cannot have.
_ELSEWHERE = ("drift_walk", "noise", VIBRATION, "tilt", "part_shift", "part_turn", "lag_speed",
              "lag_direction", "probe_periodic", "encoder_interpolation")  # fmt: skip


def order_name(name: str, per_turn: float) -> str:
    """Return ``name/per_turn``, thirds as 0.333."""
    return f"{name}/{per_turn:.3g}"


def families_of(ranges: Ranges, priors: Sequence[Source]) -> tuple[Family, ...]:
    """Return every family that scans within ``ranges`` may have, declared or not.

    Raises ConfigurationError for a declared source that is no family.
    """
    found = [*_dynamic(ranges), *_geometric(ranges), *_of_the_probe(ranges),
             *_of_the_spindle(priors), *_of_each_scan(ranges)]  # fmt: skip
    names = {base_name(f.name) for f in found} | set(_ELSEWHERE)
    for prior in priors:
        if prior.name not in names:
            raise ConfigurationError(
                f"source {prior.name!r} has no family in the adjustment, expected one of "
                f"{sorted(names)!r}"
            )
    return tuple(found)


def _one(
    name: str, unit: str, column: Columns, wide: float, shown_by: str, default: float | None = None
) -> Family:
    return Family(name, unit, 1, lambda v: column(v)[np.newaxis], wide, shown_by, default)


# Share of the mean speed; a spindle holds its speed better than this.
_SAME_SPEED = 0.01


def _speed_to_add(r: Ranges) -> str:
    return NEW_SPEED if np.ptp(np.abs(r.speeds)) > _SAME_SPEED * r.speed else OTHER_SPEED


def _dynamic(r: Ranges) -> list[Family]:
    """Lag since the step test and what may change it, latency, asymmetry and backlash."""
    far = max(abs(r.slide[0]), abs(r.slide[1]))
    middle, fast, speed = sum(r.lift) / 2, r.motion * r.speed, _speed_to_add(r)
    found = [
        # A step test leaves less than 0.1 ms of lag unknown; the default covers its change.
        _one("lag_change", "s", lambda v: v.motion_rate, 3e-4, speed, 1e-4),
        _one("probe_latency", "s", lambda v: v.lateral_error(v.x_rate, v.y_rate), 3e-4,
             OTHER_STAND_OFF),
        # Readings that come later than in the step test: by place and by Z, which nearly cancel.
        _one("latency_change", "s", lambda v: v.motion_rate + v.lateral_error(v.x_rate, v.y_rate),
             3e-4, speed),
        _one("lag_asymmetry", "s", lambda v: np.abs(v.motion_rate), 1e-4, speed),
        _one("motion_error", "m", lambda v: v.motion_play, 1e-7, OTHER_DIRECTION),
        _one("lag_motion", "s", lambda v: v.motion_rate * (v.motion - middle) / r.motion, 1e-4,
             speed),
        _one("lag_x", "s", lambda v: v.motion_rate * (v.slide_x / far - 0.5), 1e-4, speed),
        # From the first scan on, and from the beginning of each.
        Family("lag_time", "s", 2, lambda v: v.motion_rate * np.stack(
            [v.time / r.duration, v.since / r.durations[v.index]]), 1e-4, speed),
        _one("lag_rate", "s", lambda v: v.motion_rate * np.abs(v.motion_rate) / fast, 1e-4,
             speed),
        Family("lag_c", "s", 2, lambda v: v.motion_rate * np.stack(_waves(v.c, 1)), 1e-4,
               RECLOCKED),
        _one("lag_curvature", "s²", lambda v: -v.motion_acceleration, 1e-5, speed),
        Family("creep", "1", 2, lambda v: v.motion_fading.T, 1e-3, speed),
    ]  # fmt: skip
    # With one speed, or one direction, the column is that of the lag itself.
    if speed == NEW_SPEED:
        found.append(_one("lag_speed", "s", lambda v: v.motion_rate * (abs(v.speed) / r.speed - 1),
                          5e-5, speed))  # fmt: skip
        found += [
            _one("part_bow_speed", "m", lambda v: (v.x**2 + v.y**2) * (v.speed / r.speed / r.radius)
                 ** 2, 1e-7, speed),
            Family("unbalance", "m", 2, lambda v: (v.speed / r.speed) ** 2 * np.stack(
                _waves(v.c, 1)), 1e-7, speed),
        ]  # fmt: skip
    if min(r.speeds) < 0 < max(r.speeds):
        found.append(_one("lag_direction", "s", lambda v: v.motion_rate * np.sign(v.speed), 5e-5,
                          speed))  # fmt: skip
    return found


def _of_each_direction(r: Ranges) -> list[Family]:
    """Return errors of the X slide that differ between scans inwards and outwards."""
    if not min(r.feeds) < 0 < max(r.feeds):
        return []
    way = np.sign(r.feeds)
    return [
        _one("x_late", "s", lambda v: v.across(r.feeds[v.index], 0.0), 5e-2, OTHER_DIRECTION),
        _one("x_backlash", "m", lambda v: v.across(way[v.index], 0.0), 1e-5, OTHER_DIRECTION),
        _curve("straightness_hysteresis", "m", r.slide, r,
               lambda v, w: way[v.index] * w(v.slide_x), 1e-7, OTHER_DIRECTION),
    ]  # fmt: skip


# Least way of X on the other side of the spindle axis, as a share of the longer way.
_BOTH_SIDES = 0.1


def _geometric(r: Ranges) -> list[Family]:
    """Centre, squareness, straightness, pitch and scale of the slides."""
    # Only an artefact shows the errors that a scan beyond the centre leaves open.
    both_sides = min(-r.slide[0], r.slide[1]) > _BOTH_SIDES * max(-r.slide[0], r.slide[1])
    beyond = REFERENCE if both_sides else BEYOND_CENTRE
    return [
        *_of_each_direction(r),
        # Scales of glass and good screws; what scans to the centre leave open is not tested.
        _one("expansion", "1", lambda v: v.lateral_error(v.x, v.y), 3e-5, REFERENCE, 5e-6),
        _curve("positioning_x", "m", r.slide, r, lambda v, w: np.stack(
            [v.across(*way) for bow in w(v.slide_x) for way in ((bow, 0.0), (0.0, bow))]),
            1e-6, beyond, 2, 5e-8),
        _curve(_WAVES, "m", r.slide, r, lambda v, w: np.stack(
            [v.across(_SHARE * wave, 0.0) for wave in w(v.slide_x)]), 1e-5 / _SHARE, beyond, 1,
            5e-8),
        _one("centre_x", "m", lambda v: v.across(1.0, 0.0), 2e-5, beyond),
        _one("centre_y", "m", lambda v: v.across(0.0, 1.0), 2e-5, beyond),
        Family("parallelism", "rad", 2, lambda v: np.stack(
            [v.across(v.motion, 0.0), v.across(0.0, v.motion)]), 1e-3, beyond),
        _one("squareness", "rad", lambda v: v.slide_x, 3e-5, beyond),
        _one("encoder_scale", "1", lambda v: v.motion, 1e-4, REFERENCE),
        # A bow that is even in x is power of the part beyond the centre, too.
        _curve("straightness_x", "m", r.slide, r, lambda v, w: w(v.slide_x), 3e-7, REFERENCE),
        _curve("straightness_z", "m", r.lift, r, lambda v, w: np.stack(
            [v.across(*way) for bow in w(v.motion) for way in ((bow, 0.0), (0.0, bow))]),
            1e-6, beyond, 2),
        _curve("pitch", "m", r.lift, r, lambda v, w: w(v.motion), 3e-7, REFERENCE),
    ]  # fmt: skip


_OVER = (("straightness_x", "positioning_x", "straightness_hysteresis"),
         ("straightness_z", "pitch"))  # fmt: skip
# A screw makes waves along X, over a part of 25 mm as short as this relative to the way if its lead
# is 2 mm. They are a small share of the position by a good scale, with which they are declared.
_WAVES, _SHORT, _SHARE = "positioning_x@waves", 0.08, 0.25


def _curve(
    name: str,
    unit: str,
    ends: tuple[float, float],
    r: Ranges,
    columns: Callable[[ScanView, Callable[[FloatArray], FloatArray]], FloatArray],
    wide: float,
    shown_by: str,
    ways: int = 1,
    default: float | None = None,
) -> Family:
    """Return a family of an unknown curve between ``ends``: components of unit variance.

    ways: directions in which each component acts
    """
    # Curves over one axis are resolved alike, so that none explains what another cannot.
    same = next(names for names in _OVER if base_name(name) in names)
    nodes = np.linspace(*ends, 129) if ends[1] > ends[0] else np.array([ends[0], ends[0] + 1.0])
    lengths = [length for n, length in r.lengths.items() if n in same]
    way = nodes[-1] - nodes[0]
    length = _SHORT * way if name == _WAVES else min(lengths, default=way / 2**0.5)
    parts = components(smooth(length), nodes)
    place = np.linspace(-1.0, 1.0, len(nodes))
    # Their mean is the place of the spindle axis; the line of a position is the scale of its axis,
    # and an angle of the part: sources of their own. Waves are what bends more than a cubic.
    others = {"positioning_x": 1, "straightness_z": 0, _WAVES: 3}
    if name in others:
        known = legendre.legvander(place, others[name])
        parts = parts - (known @ np.linalg.lstsq(known, parts.T, rcond=None)[0]).T

    def over(position: FloatArray) -> FloatArray:
        return np.stack([np.interp(position, nodes, part) for part in parts])

    bends = legendre.legvander(place, 3)[:, ways:]
    shapes = np.kron(np.linalg.lstsq(parts.T, bends, rcond=1e-6)[0], np.eye(ways))
    return Family(name, unit, ways * len(parts), lambda v: columns(v, over), wide, shown_by,
                  default, smooth=shapes)  # fmt: skip


def _of_the_probe(r: Ranges) -> list[Family]:
    """Scale, linearity, slope and periodic errors of probe and encoder of Z, and the beam."""
    fast, end = r.motion * r.speed, r.half_range
    places = {"encoder_interpolation": "motion", "probe_periodic": "distance"}
    return [
        *(Family(name, "m", 2, periodic(places[name], period), 1e-7, OTHER_STAND_OFF)
          for name, period in r.periods.items() if name in places),
        Family("probe_slope", "m/rad", 2, lambda v: np.stack(
            [v.across(-1.0, 0.0), v.across(0.0, -1.0)]), 2e-7, REFERENCE),
        _one("probe_slope_fourth", "m", lambda v: (v.slope_x**2 + v.slope_y**2) ** 2, 1e-5,
             REFERENCE),
        _one("probe_slope_moving", "m", lambda v: np.hypot(v.slope_x, v.slope_y)
             * np.abs(v.motion_rate) / fast, 1e-7, _speed_to_add(r)),
        _one("static_gain", "1", lambda v: -v.distance, 1e-2, OTHER_STAND_OFF),
        _one("probe_square", "m", lambda v: (v.distance / end) ** 2,
             1e-7 * (end / r.distance) ** 2, OTHER_STAND_OFF),
        _one("probe_linearity", "m", lambda v: (v.distance / end) ** 3,
             1e-7 * (end / r.distance) ** 3, OTHER_STAND_OFF),
        _one("probe_slope_square", "m/rad", lambda v: v.slope_x**2 + v.slope_y**2, 1e-5,
             REFERENCE),
        Family("beam", "1", 2, lambda v: np.stack(
            [v.across(v.distance, 0.0), v.across(0.0, v.distance)]), 1e-2, OTHER_STAND_OFF),
    ]  # fmt: skip


def periodic(place: str, period: float) -> Columns:
    """Return the waves of ``period`` of a field of the points; period: in its unit."""
    return lambda v: np.stack(_waves(getattr(v, place), 2 * np.pi / period))


def _waves(angle: FloatArray, per_turn: float) -> tuple[FloatArray, FloatArray]:
    return np.cos(per_turn * angle), np.sin(per_turn * angle)


def _radial(n: float) -> Columns:
    return lambda v: np.stack(
        [v.across(*way) for wave in _waves(v.c, n) for way in ((wave, 0.0), (0.0, wave))]
    )


def _angular(n: float) -> Columns:
    # C in error by ε turns the reported place by −ε about the spindle.
    return lambda v: v.across(0.0, -v.slide_x) * np.stack(_waves(v.c, n))


def _of_the_spindle(priors: Sequence[Source]) -> list[Family]:
    """Axial, tilt and radial motion, and errors of C, by their number per turn."""
    stated = {p.name for p in priors}

    def orders(name: str, usual: Sequence[float]) -> list[float]:
        more = [float(s.split("/")[1]) for s in stated if s.startswith(f"{name}/")]
        known = {order_name(name, n) for n in usual}
        return [*usual, *(n for n in more if order_name(name, n) not in known)]

    table: tuple[tuple[str, str, int, Sequence[float], Callable[[float], Columns], float], ...] = (
        ("spindle_axial", "m", 2, (*SPINDLE_HARMONICS, *SUB_HARMONICS),
         lambda n: lambda v: np.stack(_waves(v.c, n)), 1e-7),
        ("spindle_tilt", "rad", 2, _TILT_HARMONICS,
         lambda n: lambda v: v.slide_x * np.stack(_waves(v.c, n)), 1e-5),
        ("spindle_radial", "m", 4, _RADIAL_HARMONICS, _radial, 1e-6),
        ("c_error", "rad", 2, _C_HARMONICS, _angular, 1e-4),
    )  # fmt: skip
    # Every scale of C has errors of a few arc seconds; a ring of 50 mm may be off by 2.5 µm.
    tested = any(p.name == "clocking" and p.evaluated for p in priors)
    defaults = {"c_error/1": 1e-5 if tested else 1e-4, "c_error/2": 1e-5,
                # Looks like a decentred part: only its size tells.
                "spindle_radial/1": 5e-8}  # fmt: skip
    return [
        Family(order_name(name, n), unit, size, columns(n), wide, RECLOCKED,
               defaults.get(order_name(name, n)))
        for name, unit, size, usual, columns, wide in table
        for n in orders(name, usual)
    ]  # fmt: skip


# Movement of a clamped part by a warming chuck, as in self_calibration.
_SHIFT_M, _CLOCKING_RAD = 1e-6, 5e-7
# A part clamped again by hand against a stop.
_SHIFT_AGAIN_M, _CLOCKING_AGAIN_RAD = 3e-5, 1e-3
# Where no drift is declared: 60 nm a minute.
_RATE_M_S = 1e-9
# Free: every scan shows its tilt against the others.
_TILT_RAD = 1e-4
# Two, three and four jaws.
_CLAMPED = tuple(t for t in terms_up_to(4, 2) if t.n == abs(t.m))
# Terms of the form that a scan may show differently from the others.
DIFFERENT_TERMS = terms_up_to(4, 2)


def _of_each_scan(r: Ranges) -> list[Family]:
    """Drift of all scans and of each, pose of the part, and what differs from scan to scan.

    ``decentre`` and ``clocking`` are the pose of the part against its nominal surface, which looks
    like form; ``part_shift`` and ``part_turn`` are the pose of a scan against the first.
    Warming continues from scan to scan: all scans share one rate, and the rest is a random walk.
    """
    found = [
        _drift(r),
        # A part that creeps about the axis, or counts of C that are lost one by one.
        Family("c_drift", "rad", len(r.clampings), _of_each(r, lambda v: (
            v.lateral_error(-v.y, v.x) * v.since / r.durations[v.index])[np.newaxis]),
            5e-5, REPEATED_TRACK),
        _fading("tilt_drift", "rad", r, lambda v: np.stack([v.x, v.y]), 2, 1e-6),
        _fading("part_settling", "m", r, lambda v: zernike_values(
            v.x / r.radius, v.y / r.radius, _CLAMPED), len(_CLAMPED), 1e-7),
        _one("drift_rate", "m/s", lambda v: v.time, 1e-8, REPEATED_TRACK, _RATE_M_S),
        Family("decentre", "m", 2, lambda v: np.stack(
            [v.lateral_error(1.0, 0.0), v.lateral_error(0.0, 1.0)]), 3e-5, REFERENCE, named=False),
        Family("clocking", "rad", 1, lambda v: v.lateral_error(-v.y, v.x)[np.newaxis], 1e-3,
               REFERENCE, named=False),
    ]  # fmt: skip
    for k in range(len(r.clampings)):
        if k:
            again = r.clampings[k] != r.clampings[0]
            shift, turn = (
                (_SHIFT_AGAIN_M, _CLOCKING_AGAIN_RAD) if again else (_SHIFT_M, _CLOCKING_RAD)
            )
            found += [
                _of_scan(k, "tilt", "rad", 2, lambda v: np.stack([-v.x, v.y]), 1e-3, _TILT_RAD),
                _of_scan(k, "part_shift", "m", 2, lambda v: np.stack(
                    [v.lateral_error(1.0, 0.0), v.lateral_error(0.0, 1.0)]), 3e-5, shift),
                _of_scan(k, "part_turn", "rad", 1, lambda v: v.lateral_error(-v.y, v.x)[np.newaxis],
                         1e-3, turn),
                _of_scan(k, "expansion", "1", 1, lambda v: v.lateral_error(v.x, v.y)[np.newaxis],
                         3e-5),
                _of_scan(k, "centre_moved", "m", 2, lambda v: np.stack(
                    [v.across(1.0, 0.0), v.across(0.0, 1.0)]), 2e-5),
            ]  # fmt: skip
        if len(r.clampings) > 1:
            found.append(_different(k, r.radius))
    return found


def _of_scan(
    k: int, name: str, unit: str, size: int, columns: Columns, wide: float,
    default: float | None = None,
) -> Family:  # fmt: skip
    return Family(f"{name}@{k}", unit, size, only(k, size, columns), wide, REPEATED_TRACK, default)


def only(k: int, size: int, columns: Columns) -> Columns:
    """Return ``columns`` of scan ``k``, zero in the others."""
    return lambda v: columns(v) if v.index == k else np.zeros((size, len(v)))


# Time constants as shares of the duration of all scans: a clamp relaxes within a few turns, a
# body warms within minutes.
_FADING = (1 / 64, 1 / 16, 1 / 4)


def _drift(r: Ranges) -> Family:
    """Return drifts of each scan of its own: fading within parts of the measurement, and steady."""
    times = r.duration * np.array(_FADING)[:, np.newaxis]
    own = len(_FADING) + 1

    def columns(v: ScanView) -> FloatArray:
        return np.concatenate([np.exp(-v.since / times), [v.since / r.duration]])

    return Family("drift", "m", own * len(r.clampings), _of_each(r, columns), 1e-7, REPEATED_TRACK)


def _of_each(r: Ranges, columns: Columns) -> Columns:
    """Return ``columns`` for each scan of its own."""
    mine = np.eye(len(r.clampings))
    return lambda v: np.asarray(np.kron(mine[:, [v.index]], columns(v)), np.float64)


def _fading(name: str, unit: str, r: Ranges, shapes: Columns, number: int, wide: float) -> Family:
    """Return ``number`` shapes of a part that gives way in its clamping, and settles.

    The form is that of the settled part, so that the slowest course leaves it uncertain.
    """
    times = r.duration * np.array([*_FADING, 1.0])

    def columns(v: ScanView) -> FloatArray:
        return np.concatenate([np.exp(-v.time / time) * shapes(v) for time in times])

    return Family(name, unit, number * len(times), columns, wide, REPEATED_TRACK)


DIFFERS = "scan_differs"
"""Name of the family of one scan whose form differs from that of the others."""


def _different(k: int, radius: float) -> Family:
    """Return low orders of form of scan ``k`` alone, which show a difference without its cause."""

    def columns(v: ScanView) -> FloatArray:
        return zernike_values(v.x / radius, v.y / radius, DIFFERENT_TERMS)

    size = len(DIFFERENT_TERMS)
    return Family(f"{DIFFERS}@{k}", "m", size, only(k, size, columns), 1e-7, REPEATED_TRACK,
                  named=False)  # fmt: skip
