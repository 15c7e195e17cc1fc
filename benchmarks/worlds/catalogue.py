"""List what can be wrong with a machine, a part or a recording: `KINDS`, each in three sizes.

Each kind is one error beside a machine that is as declared. ``group`` says how it escapes:

- ``undeclared``: nothing that was declared is untrue, this one was left out or is one of many;
- ``other_machine``: the machine that scans is not the one of the step test;
- ``broken``: a declared value is exceeded by far;
- ``recording``: the files are at fault, or step test and scan alike;
- ``benign``: nothing is wrong, a tool should cope.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.worlds import effects as e
from benchmarks.worlds.dynamics import LinearSystem
from benchmarks.worlds.machine import Machine, Moment
from benchmarks.worlds.sources import LATENCY_S, NOISE_M, Build, Site, x_of, z_of

GROUPS = ("undeclared", "other_machine", "broken", "recording", "benign")
SCOPES = ("scan", "test", "both")
HALF_TRAVEL_M = 5e-4
"""Typical half stroke of Z on the paper's mirror, by which amplitudes over Z are stated."""


@dataclass(frozen=True)
class Kind:
    """One kind of error: its three sizes and how it changes a machine."""

    name: str
    group: str
    sizes: tuple[float, float, float]
    unit: str
    source: str
    """The declared source that it exceeds or belongs to; empty if there is none."""
    build: Build
    scope: str = "scan"
    """In which recordings it acts: scan, test or both."""


def _loop(make: Callable) -> Build:
    return lambda m, v, s: m.plus("loop", make(v, s))


def _place(make: Callable) -> Build:
    return lambda m, v, s: m.plus("place", make(v, s))


def _structure(make: Callable) -> Build:
    return lambda m, v, s: m.plus("structure", make(v, s))


def _probe(make: Callable) -> Build:
    return lambda m, v, s: m.plus("probe", make(v, s))


def _record(make: Callable) -> Build:
    return lambda m, v, s: m.plus("record", make(v, s))


def _set(name: str, base: float = 0.0) -> Build:
    return lambda m, v, s: replace(m, **{name: base + v})


def _lag(of: Callable[[Moment, Site], np.ndarray]) -> Build:
    """Delay the probe by size × a quantity without unit."""
    return _structure(lambda v, s: e.lagging(lambda now: v * of(now, s)))


def _z_norm(now: Moment) -> np.ndarray:
    return now.z / HALF_TRAVEL_M


def _axial(per_turn: float) -> Build:
    return _loop(lambda v, s: e.axial(per_turn, v, s.phase()))


def _tilting(per_turn: float) -> Build:
    return _loop(lambda v, s: e.tilting(per_turn, v, s.phase()))


def _wave_of_c(per_turn: float, phase: float) -> Callable[[Moment], np.ndarray]:
    return lambda now: np.cos(per_turn * now.c + phase)


def _radial(per_turn: float, along: str) -> Build:
    return _place(lambda v, s: e.offset_beam_by(_wave_of_c(per_turn, s.phase()), **{along: v}))


def _c_error(per_turn: float) -> Build:
    def build(m: Machine, v: float, s: Site) -> Machine:
        wave = _wave_of_c(per_turn, s.phase())
        return m.plus("angle", lambda now: v * wave(now))

    return build


def _backlash_of_x(m: Machine, v: float, s: Site) -> Machine:
    return m.plus("place", e.offset_beam_by(lambda now: 1.0 if now.path.outward else -1.0, v / 2))


def _up(now: Moment, site: Site) -> np.ndarray:
    return (now.rate > 0) - 0.5


def _sizes(*three: float) -> tuple[float, float, float]:
    return three[0], three[1], three[2]


NM, UM, US = 1e-9, 1e-6, 1e-6
N10 = _sizes(10 * NM, 20 * NM, 60 * NM)
N20 = _sizes(20 * NM, 50 * NM, 150 * NM)
N50 = _sizes(50 * NM, 150 * NM, 500 * NM)
U3 = _sizes(3 * UM, 10 * UM, 30 * UM)
U1 = _sizes(0.3 * UM, 1 * UM, 3 * UM)
T20 = _sizes(20 * US, 70 * US, 200 * US)
R01 = _sizes(0.5e-6, 2e-6, 8e-6)
PPM = _sizes(2e-5, 1e-4, 5e-4)


def _of(group: str, *rows: tuple) -> list[Kind]:
    """Return kinds of one group; a row is name, sizes, unit, source, build and perhaps scope."""
    return [Kind(r[0], group, r[1], r[2], r[3], *r[4:]) for r in rows]


UNDECLARED = _of(
    "undeclared",
    ("centre_y", U3, "m", "centre_y", _place(lambda v, s: e.offset_beam(dy=v))),
    ("z_bow_y", U1, "m", "straightness_z",
     _place(lambda v, s: e.offset_beam_by(lambda n: _z_norm(n) ** 2, dy=v))),
    ("z_bow_x", U1, "m", "straightness_z",
     _place(lambda v, s: e.offset_beam_by(lambda n: _z_norm(n) ** 2, dx=v))),
    ("spindle_axial_1", N20, "m", "spindle_axial", _axial(1)),
    ("spindle_axial_5", N10, "m", "spindle_axial", _axial(5)),
    ("spindle_axial_6", N10, "m", "spindle_axial", _axial(6)),
    ("spindle_axial_11", N10, "m", "spindle_axial", _axial(11)),
    ("spindle_half", N10, "m", "spindle_axial", _axial(1 / 2)),
    ("spindle_third", N10, "m", "spindle_axial", _axial(1 / 3)),
    ("spindle_tilt_1", R01, "rad", "spindle_tilt", _tilting(1)),
    ("spindle_tilt_3", R01, "rad", "spindle_tilt", _tilting(3)),
    ("spindle_radial_1_y", U1, "m", "spindle_radial", _radial(1, "dy")),
    ("spindle_radial_3_x", U1, "m", "spindle_radial", _radial(3, "dx")),
    ("spindle_asynchronous", N10, "m", "spindle_axial",
     _loop(lambda v, s: e.asynchronous(v, 4.37))),
    ("half_turns", N10, "m", "spindle_axial", _loop(lambda v, s: e.half_turns(v))),
    ("spindle_growth_by_speed", N50, "m", "drift", _loop(lambda v, s: e.growing(v, 90.0))),
    ("part_bows_by_speed", N20, "m", "", _loop(lambda v, s: e.spun(v, s.radius))),
    ("c_eccentric", _sizes(2e-5, 1e-4, 5e-4), "rad", "clocking", _c_error(1)),
    ("c_scale_2", _sizes(2e-5, 1e-4, 5e-4), "rad", "clocking", _c_error(2)),
    ("c_lost_counts", _sizes(1e-4, 5e-4, 2e-3), "rad", "clocking",
     _record(lambda v, s: e.lost_counts("c", v, s.rng.uniform(0.3, 0.7)))),
    ("c_slips", _sizes(1e-6, 1e-5, 5e-5), "rad/s", "clocking",
     _record(lambda v, s: e.ramped_column("c", v))),
    ("c_late", T20, "s", "clocking", _set("c_late")),
    ("x_late", _sizes(5e-3, 2e-2, 1e-1), "s", "centre_x", _set("x_late")),
    ("x_scale", _sizes(1e-4, 4e-4, 1.5e-3), "1", "",
     _record(lambda v, s: e.scaled_column("x", v))),
    ("x_lost_counts", U3, "m", "centre_x",
     _record(lambda v, s: e.lost_counts("x", v, s.rng.uniform(0.3, 0.7)))),
    ("x_screw", U1, "m", "centre_x",
     _record(lambda v, s: e.waving_column("x", v, 2e-3, s.phase()))),
    ("x_backlash", U3, "m", "centre_x", _backlash_of_x),
    ("exposure_long", _sizes(0.5e-3, 1e-3, 3e-3), "s", "probe_latency", _set("exposure")),
    ("exposure_on_slope", N20, "m", "probe_slope",
     _probe(lambda v, s: e.reading(lambda n, d: v * np.hypot(*n.slope) * np.abs(n.rate) / 1e-4))),
    ("slope_odd_x", N50, "m/rad", "probe_slope",
     _probe(lambda v, s: e.reading(lambda n, d: v * n.slope[0]))),
    ("slope_odd_y", N50, "m/rad", "probe_slope",
     _probe(lambda v, s: e.reading(lambda n, d: v * n.slope[1]))),
    ("slope_fourth", _sizes(1e-6, 1e-5, 5e-5), "m/rad⁴", "probe_slope_square",
     _probe(lambda v, s: e.reading(lambda n, d: v * np.hypot(*n.slope) ** 4))),
    ("clamp_relaxes", N50, "m", "drift", _loop(lambda v, s: e.relaxing(v, 60.0))),
    ("clamp_relaxes_slowly", N50, "m", "drift", _loop(lambda v, s: e.relaxing(v, 400.0))),
    ("clamp_tilts", R01, "rad", "tilt", _loop(lambda v, s: e.relaxing(0.0, 60.0, v))),
    ("knock", N20, "m", "drift", _loop(lambda v, s: e.height_step(v, s.rng.uniform(0.3, 0.7)))),
    ("knock_tilts", R01, "rad", "tilt",
     _loop(lambda v, s: e.height_step(0.0, s.rng.uniform(0.3, 0.7), v))),
    ("air_conditioning", N10, "m", "drift", _loop(lambda v, s: e.swinging(v, 47.0, s.phase()))),
    ("straightness_hysteresis", N20, "m", "straightness_x",
     _loop(lambda v, s: e.over(lambda n: (n.x / s.radius) * (1 if n.path.outward else -1), v, 2))),
    ("unbalance", N20, "m", "spindle_axial",
     _loop(lambda v, s: lambda n: v * (n.path.rpm / 60) ** 2 * np.cos(n.c))),
    ("dust", _sizes(1e-4, 1e-3, 5e-3), "1", "", _probe(lambda v, s: e.outliers(v, 1e-6))),
    ("heated_by_motion", N20, "m", "drift",
     _loop(lambda v, s: lambda n: v * np.cumsum(np.abs(n.rate)) * n.period / 0.1)),
)  # fmt: skip

OTHER_MACHINE = _of(
    "other_machine",
    ("lag_longer", T20, "s", "lag_change", _lag(lambda n, s: 1.0)),
    ("lag_shorter", T20, "s", "lag_change", _lag(lambda n, s: -1.0)),
    ("z_late", _sizes(30 * US, 100 * US, 300 * US), "s", "lag_change", _set("z_late")),
    ("probe_later", T20, "s", "probe_latency", _set("latency", LATENCY_S)),
    ("lag_by_x", T20, "s", "lag_change", _lag(lambda n, s: n.x / s.radius - 0.5)),
    ("lag_by_z", T20, "s", "lag_change", _lag(lambda n, s: _z_norm(n))),
    ("lag_over_time", T20, "s", "lag_change",
     _lag(lambda n, s: np.clip(n.t / n.path.duration, 0, 1))),
    ("lag_by_rate", T20, "s", "lag_change", _lag(lambda n, s: np.abs(n.rate) / 2e-3)),
    ("lag_by_c", T20, "s", "lag_change", _lag(lambda n, s: np.cos(n.c))),
    ("lag_up_down_in_scan", T20, "s", "lag_change", _lag(_up)),
    ("static_gain_of_g", PPM, "1", "encoder_scale",
     _structure(lambda v, s: e.bending(z_of, v))),
    ("mode_lower", _sizes(0.03, 0.1, 0.3), "1", "lag_change",
     lambda m, v, s: replace(m, structure=m.structure.scaled(1 - v))),
    ("side_mode", _sizes(1e-4, 1e-3, 5e-3), "1", "lag_change",
     _structure(lambda v, s: e.through(LinearSystem.side_mode(8.0, 0.03, v)))),
    ("creep", _sizes(1e-4, 3e-4, 1e-3), "1", "lag_change",
     _structure(lambda v, s: e.through(LinearSystem.creep(v, 5.0)))),
    ("creep_slow", _sizes(1e-4, 3e-4, 1e-3), "1", "lag_change",
     _structure(lambda v, s: e.through(LinearSystem.creep(v, 60.0)))),
    ("backlash", _sizes(15 * NM, 40 * NM, 120 * NM), "m", "motion_error",
     _structure(lambda v, s: e.playing(v))),
    ("friction", N10, "m", "motion_error", _structure(lambda v, s: e.rubbing(v, 2e-6))),
    ("friction_long", N20, "m", "motion_error", _structure(lambda v, s: e.rubbing(v, 1e-4))),
    ("drag", N10, "m", "motion_error",
     _structure(lambda v, s: e.bending(lambda n: -n.rate / 2e-3, v, 2, odd=True))),
    ("cable", N10, "m", "motion_error",
     _structure(lambda v, s: e.bending(lambda n: np.sign(n.rate), -v / 2))),
    ("stiffening", N20, "m", "encoder_scale", _structure(lambda v, s: e.bending(_z_norm, v, 3))),
    ("softening", N20, "m", "encoder_scale", _structure(lambda v, s: e.bending(_z_norm, v, 2))),
    ("probe_scale_changed", _sizes(1e-3, 5e-3, 2e-2), "1", "static_gain",
     _probe(lambda v, s: e.reading(lambda n, d: v * d))),
    ("wrong_gain_printed", _sizes(0.002, 0.004, 0.0079), "1", "encoder_scale",
     _structure(lambda v, s: e.bending(z_of, -v))),
)  # fmt: skip

BROKEN = _of(
    "broken",
    ("centre_x", U3, "m", "centre_x", _place(lambda v, s: e.offset_beam(dx=v))),
    ("centre_xy", U3, "m", "centre_x", _place(lambda v, s: e.offset_beam(v, s.sign() * v))),
    ("beam_x", _sizes(2e-3, 1e-2, 3e-2), "1", "beam",
     lambda m, v, s: replace(m, beam=(m.beam[0] + v, m.beam[1]))),
    ("beam_y", _sizes(2e-3, 1e-2, 3e-2), "1", "beam",
     lambda m, v, s: replace(m, beam=(m.beam[0], m.beam[1] + v))),
    ("parallelism_y", _sizes(1e-4, 1e-3, 4e-3), "rad", "parallelism",
     _place(lambda v, s: e.offset_beam_by(z_of, dy=v))),
    ("squareness", _sizes(5e-6, 2e-5, 1e-4), "rad", "squareness",
     _loop(lambda v, s: e.over(x_of, v))),
    ("straightness_bow", N20, "m", "straightness_x",
     _loop(lambda v, s: e.over(lambda n: n.x / s.radius, v, 2))),
    ("straightness_wave", N10, "m", "straightness_x",
     _loop(lambda v, s: e.waving(x_of, v, 2e-3, s.phase()))),
    ("pitch_z", N20, "m", "pitch", _loop(lambda v, s: e.over(_z_norm, v, 2))),
    ("pitch_z_wave", N10, "m", "pitch", _loop(lambda v, s: e.waving(z_of, v, 2e-4, s.phase()))),
    ("z_scale", PPM, "1", "encoder_scale", _record(lambda v, s: e.scaled_column("z", v))),
    ("z_interpolation", _sizes(5 * NM, 15 * NM, 50 * NM), "m", "encoder_interpolation",
     _record(lambda v, s: e.waving_column("z", v, 0.5 * UM, s.phase()))),
    ("z_interpolation_long", N10, "m", "encoder_interpolation",
     _record(lambda v, s: e.waving_column("z", v, 20 * UM, s.phase()))),
    ("z_resolution", _sizes(5 * NM, 20 * NM, 100 * NM), "m", "encoder_resolution",
     _set("z_resolution")),
    ("c_resolution", _sizes(2e-4, 1e-3, 3e-3), "rad", "clocking", _set("c_resolution")),
    ("spindle_axial_3", N10, "m", "spindle_axial", _axial(3)),
    ("spindle_axial_2", N20, "m", "spindle_axial", _axial(2)),
    ("spindle_tilt_2", R01, "rad", "spindle_tilt", _tilting(2)),
    ("spindle_radial_2", U1, "m", "spindle_radial", _radial(2, "dy")),
    ("spindle_grows", _sizes(50 * NM, 300 * NM, 1000 * NM), "m", "drift",
     _loop(lambda v, s: lambda n: v * (1 - np.exp(-n.t / 80.0)))),
    ("part_settles", N50, "m", "drift", _loop(lambda v, s: e.relaxing(v, 120.0))),
    ("drift_walk", _sizes(3 * NM, 10 * NM, 30 * NM), "m/√s", "drift_walk",
     _loop(lambda v, s: e.walk(v)), "both"),
    ("drift_rate", _sizes(0.5 * NM, 2 * NM, 8 * NM), "m/s", "drift_rate",
     _loop(lambda v, s: e.ramp(v)), "both"),
    ("latency", _sizes(50 * US, 200 * US, 400 * US), "s", "probe_latency",
     _set("latency", LATENCY_S), "both"),
    ("air", N10, "m", "vibration", _loop(lambda v, s: e.air(v))),
    ("floor_2_hz", N10, "m", "vibration", _loop(lambda v, s: e.floor(2.0, v))),
    ("floor_11_hz", N10, "m", "vibration", _loop(lambda v, s: e.floor(11.0, v))),
    ("hum_50_hz", N10, "m", "vibration", _loop(lambda v, s: e.line(50.0, v, s.exposure))),
    ("hum_locked", N10, "m", "vibration",
     _loop(lambda v, s: lambda n: v * np.sin(2 * np.pi * 2.0 * n.t))),
    ("vibration_680_hz", N20, "m", "vibration", _loop(lambda v, s: e.line(680.0, v, s.exposure))),
    ("probe_cubic", N20, "m", "probe_linearity",
     _probe(lambda v, s: e.reading(lambda n, d: v * (d / 1e-5) ** 3))),
    ("probe_periodic", N10, "m", "probe_periodic",
     _probe(lambda v, s: e.reading(lambda n, d: v * np.sin(2 * np.pi * d / 3e-6)))),
    ("slope_square", _sizes(0.5e-6, 2e-6, 1e-5), "m/rad²", "probe_slope_square",
     _probe(lambda v, s: e.reading(lambda n, d: v * np.hypot(*n.slope) ** 2))),
    ("noise", _sizes(2 * NOISE_M, 4 * NOISE_M, 10 * NOISE_M), "m", "probe_noise",
     _probe(lambda v, s: e.noisier(v))),
    ("noise_on_slope", _sizes(200 * NM, 500 * NM, 2000 * NM), "m/rad", "probe_noise",
     _probe(lambda v, s: e.noisier(lambda n: v * np.hypot(*n.slope)))),
    ("trigger_jitter", _sizes(5 * US, 20 * US, 100 * US), "s", "", _set("trigger_jitter")),
)  # fmt: skip

RECORDING = _of(
    "recording",
    ("wrong_sign_of_test", _sizes(1, 1, 1), "1", "",
     _record(lambda v, s: e.scaled_column("distance", -2.0)), "test"),
    ("wrong_sign_of_scan", _sizes(1, 1, 1), "1", "",
     _record(lambda v, s: e.scaled_column("distance", -2.0))),
    ("wrong_sign_of_c", _sizes(1, 1, 1), "1", "",
     _record(lambda v, s: e.scaled_column("c", -2.0))),
    ("probe_one_row_late", _sizes(1, 2, 5), "1", "probe_latency",
     _record(lambda v, s: e.shifted_distance(int(v)))),
    ("probe_slips_rows", _sizes(1, 2, 5), "1", "probe_latency",
     _record(lambda v, s: e.shifted_distance(int(v), s.rng.uniform(0.3, 0.7)))),
    ("lag_up_down", _sizes(20 * US, 40 * US, 100 * US), "s", "lag_change", _lag(_up), "both"),
    ("backlash_in_both", _sizes(15 * NM, 40 * NM, 120 * NM), "m", "motion_error",
     _structure(lambda v, s: e.playing(v)), "both"),
    ("creep_in_both", _sizes(1e-4, 3e-4, 1e-3), "1", "",
     _structure(lambda v, s: e.through(LinearSystem.creep(v, 20.0))), "both"),
    ("side_mode_in_both", _sizes(1e-4, 1e-3, 5e-3), "1", "",
     _structure(lambda v, s: e.through(LinearSystem.side_mode(12.0, 0.05, v))), "both"),
)  # fmt: skip

BENIGN = _of(
    "benign",
    ("none", _sizes(0, 0, 0), "1", "", lambda m, v, s: m, "both"),
    ("z_jitter_of_count", _sizes(0.1, 0.4, 1.0), "count", "",
     lambda m, v, s: replace(m, z_resolution=1e-8, z_jitter=v * 1e-8), "both"),
    ("rows_missing", _sizes(1e-3, 1e-2, 5e-2), "1", "", _record(lambda v, s: e.missing_rows(v))),
    ("no_reading", _sizes(1e-3, 1e-2, 5e-2), "1", "", _record(lambda v, s: e.no_reading(v))),
    ("soft_servo", _sizes(100.0, 50.0, 25.0), "Hz", "",
     lambda m, v, s: replace(m, servo=LinearSystem.second_order(v, 0.7))),
    ("half_rate", _sizes(500.0, 400.0, 2000.0), "Hz", "", _set("sampling")),
    ("other_structure", _sizes(90.0, 180.0, 400.0), "Hz", "",
     lambda m, v, s: replace(m, structure=LinearSystem.second_order(v, 0.3)), "both"),
)  # fmt: skip

KINDS: dict[str, Kind] = {
    kind.name: kind for kind in (*UNDECLARED, *OTHER_MACHINE, *BROKEN, *RECORDING, *BENIGN)
}
