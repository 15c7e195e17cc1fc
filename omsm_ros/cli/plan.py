"""The command that plans a step test, or scans of a part: plan."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from omsm_ros.cli.arguments import Arguments, values_of
from omsm_ros.cli.command import CliCommand, Facts, Rows, say, written
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.limits import KnownOfMachine, choose_motion, harmonic_orders, margins
from omsm_ros.core.kinematics.trajectories import (
    PLANNED_COUNT,
    PLANNED_DWELL_S,
    SECOND_SHARE,
    plan_csv,
    plan_multisine,
    plan_steps,
)
from omsm_ros.core.lti.modes import known_modes
from omsm_ros.core.surface.aperture import BoundedSurface
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import MULTISINE_SCHEMA, load_limits, load_sources, load_surface
from omsm_ros.io.files import save_json, save_text
from omsm_ros.io.gcode_file import DIALECTS, steps_gcode
from omsm_ros.quantities import (
    ACCELERATION_LIMIT,
    COUNT,
    DWELL,
    FREQUENCY,
    LENGTH,
    RATE,
    RISE,
    SAMPLE_PERIOD,
    SPACING,
    SPEED,
    STEP,
    UNCERTAINTY,
)
from omsm_ros.readable import count, quantity


def _declare_plan(add: Arguments) -> None:
    add("what", str, choices=tuple(_PLANS))
    add("--out", "DIR", required=True)
    add("--dialect", str, "controller that reads the G-code", choices=DIALECTS, default="linuxcnc")
    steps = add.group("steps")
    steps("--sample-period", SAMPLE_PERIOD, "sample period of the probe [s]", default=1e-3)
    steps("--step", STEP, "height of a step [m]", default=9.8e-6)
    steps("--second-step", STEP, "height of every other step [m]; 3/9.8 of --step by default")
    steps("--count", COUNT, default=PLANNED_COUNT)
    steps("--dwell", DWELL, default=PLANNED_DWELL_S)
    steps("--rise", RISE, "rise time of an edge [s]", default=20e-3)
    steps("--sharp", None)
    steps("--half-range", STEP, "half the measuring range of the probe [m]", default=50e-6)
    scans = add.group("scans and motion")
    scans("--nominal", "SURFACE.yaml", "surface of the part")
    scans("--sources", "SOURCES.yaml", "declared sources of the machine")
    scans("--limits", "LIMITS.yaml", "of machine and probe")
    scans("--accuracy", UNCERTAINTY, "expanded uncertainty asked for, k = 2 [m]", default=20e-9)
    scans("--radius", LENGTH, "radius of the scan [m]; that of the surface's aperture, or 0.0127")
    scans("--feed", LENGTH, "radial feed of a turn [m]", default=1e-4)
    scans("--rpm", SPEED, "spindle speed of the first scan [1/min]", default=30.0)
    scans("--path-error", UNCERTAINTY, "bound on Z of the executed path [m]", default=1e-7)
    scans("--servo-period", SAMPLE_PERIOD, "cycle of the controller's planner [s]", default=1e-3)
    multisine = add.group("multisine")
    multisine("--resolution", FREQUENCY, "distance of its lines [Hz]", default=0.5)
    multisine("--up-to", FREQUENCY, "highest line [Hz]", default=60.0)
    multisine("--periods", COUNT, "periods that are evaluated of each realisation", default=3)
    multisine("--realisations", COUNT, "number of sets of random phases", default=6)
    multisine("--speed", RATE, "largest speed of Z [m/s]", default=5e-3)
    multisine("--acceleration", ACCELERATION_LIMIT, "largest acceleration of Z [m/s²]", default=1.0)
    multisine("--seed", COUNT, "of the random phases", default=1)
    motion = add.group("motion")
    motion("--calibration", "CAL.json", "whose modes are to be avoided")
    motion("--mode", FREQUENCY, "further modes of the machine [Hz]", nargs="+", default=[])
    motion("--line", FREQUENCY, "known vibrations [Hz]", nargs="+", default=[])
    motion("--marks", SPACING, "pitch of the rings that the tool left [m]", nargs="+", default=[])
    motion("--rate", FREQUENCY, nargs="+", default=[1000.0])


def _plan_multisine(args: argparse.Namespace) -> Facts:
    names = ("sample_period", "resolution", "up_to", "periods", "realisations", "half_range",
             "speed", "acceleration", "seed")  # fmt: skip
    plan = plan_multisine(**values_of(args, *names))
    csv, description = args.out / "multisine.csv", args.out / "multisine.json"
    save_text(csv, plan_csv(plan, args.sample_period))
    save_json(description, {"schema": MULTISINE_SCHEMA, **asdict(plan)})
    return {
        "lines": len(plan.lines),
        "duration": plan.duration,
        "travel": float(np.ptp(plan.z(plan.times))),
        "files": {"csv": str(csv), "json": str(description)},
    }


def _plan_steps(args: argparse.Namespace) -> Facts:
    plan = plan_steps(
        second_step=args.second_step or SECOND_SHARE * args.step,
        **values_of(args, "sample_period", "step", "count", "dwell", "rise", "sharp", "half_range"),
    )
    csv, gcode = args.out / "steps.csv", args.out / "steps.nc"
    save_text(csv, plan_csv(plan, args.sample_period))
    save_text(gcode, steps_gcode(plan, args.dialect))
    return {
        "edges": len(plan.starts),
        "heights": sorted(set(map(abs, plan.heights)), reverse=True),
        "travel": plan.travel,
        "duration": plan.duration,
        "rise": plan.rise,
        "files": {"csv": str(csv), "gcode": str(gcode)},
    }


def _lengths(lengths: Sequence[float]) -> str:
    return " and ".join(quantity(length, "m") for length in lengths)


def _show_plan(facts: Facts) -> Rows:
    if "sets" in facts or "motion" in facts:
        return _show_scans(facts) if "sets" in facts else _show_motion(facts)
    if "lines" in facts:
        rows = [("travel", _lengths([facts["travel"]])), ("duration", f"{facts['duration']:.0f} s")]
        return [("lines", str(facts["lines"])), *rows, written(facts["files"].values())]
    return [
        ("edges", f"{facts['edges']} of {_lengths(facts['heights'])}"),
        ("travel", _lengths([facts["travel"]])),
        ("duration", quantity(facts["duration"], "s")),
        ("rise", f"{quantity(facts['rise'], 's')}, dithered within the sample period"),
        written(facts["files"].values()),
    ]


def _radius(args: argparse.Namespace, nominal: Surface) -> float:
    """Return the radius of the scan [m]: as asked, or to the rim of the nominal's aperture."""
    if args.radius is None and isinstance(nominal, BoundedSurface):
        return float(np.max(np.hypot(*nominal.aperture.rim())))
    return 12.7e-3 if args.radius is None else float(args.radius)


def _plan_scans(args: argparse.Namespace) -> Facts:
    # Here, because a step test needs nothing of what adjusts scans.
    from omsm_ros.core.adjustment import ScanDesign
    from omsm_ros.pipelines.plan_scans import planned_set

    nominal = _nominal(args)
    first = ScanDesign(rpm=args.rpm, start=_radius(args, nominal), end=0.0, pitch=args.feed)
    stated, limits = load_sources(args.sources), load_limits(args.limits)
    designs, facts = planned_set(first, nominal, stated, args.accuracy, limits)
    return {**facts, **_programs(args, designs, nominal)}


def _programs(args: argparse.Namespace, designs: Sequence[Any], nominal: Surface) -> Facts:
    from omsm_ros.pipelines.plan_scans import write_scans

    how = args.path_error, args.servo_period, args.dialect
    return write_scans(designs, nominal, args.out, *how)


def _plan_motion(args: argparse.Namespace) -> Facts:
    from omsm_ros.core.adjustment import ScanDesign
    from omsm_ros.pipelines.plan_scans import refuse_beyond

    nominal = _nominal(args)
    modes = [(frequency, 0.0) for frequency in args.mode]
    if args.calibration:
        cal = load_calibration(args.calibration)
        found = known_modes(cal.dynamics, cal.covariance)
        modes += [(m.frequency, m.damping) for m in found if m.residue is not None]
    known = KnownOfMachine(modes=modes, lines=args.line, marks=args.marks)
    orders = harmonic_orders(nominal, abs(_radius(args, nominal)))
    asked = margins(args.rpm, args.feed, args.rate[0], orders, known)
    best = choose_motion(args.rpm, args.feed, args.rate, orders, known)
    design = ScanDesign(
        rpm=best.rpm, start=_radius(args, nominal), end=0.0, pitch=best.feed, rate=best.rate
    )
    refuse_beyond(design, nominal, load_limits(args.limits), args.accuracy)
    rows = [{**asdict(one), "score": one.score} for one in (asked, best)]
    return {
        "motion": [{k: v if np.isfinite(v) else None for k, v in row.items()} for row in rows],
        "modes": modes,
        "orders": orders.tolist(),
        "duration": design.duration,
        **_programs(args, [design], nominal),
    }


def _show_motion(facts: Facts) -> Rows:
    names = {
        "harmonic": "harmonic of Z to a mode: {:.3g} half-widths",
        "image": "alias of a vibration to a mode: {:.3g} half-widths",
        "phase": "vibration from turn to turn: {:.2f} of a wave",
        "pitch": "marks from turn to turn: {:.2f} of a pitch",
    }
    asked, proposed = facts["motion"]
    if all(asked[name] is None for name in names):
        say("no mode, line or marks are known: nothing has to be avoided")
    for title, one in zip(("as asked", "proposed"), (asked, proposed), strict=True):
        say(f"{title}: {one['rpm']:.5g} rpm, feed {quantity(one['feed'], 'm', 4)}, "
            f"rate {quantity(one['rate'], 'Hz')}")  # fmt: skip
        for name, text in names.items():
            if one[name] is not None:
                say("  " + text.format(one[name]))
    if proposed["score"] < 1:
        say("no speed or feed within 20 % keeps all apart; give another --rate, --rpm or --feed")
    (path,) = facts["paths"]
    return [
        ("duration", quantity(facts["duration"], "s")),
        ("scan_1.nc", _path_text(path, facts["path_error"])),
        written(facts["files"]),
    ]


def _nominal(args: argparse.Namespace) -> Surface:
    if args.nominal is None:
        raise ConfigurationError("the surface of the part is missing; give --nominal SURFACE.yaml")
    return load_surface(args.nominal)


def _scan_text(scan: Mapping[str, Any]) -> str:
    outward = abs(scan["end"]) > abs(scan["start"])
    turned = f" turned by {np.degrees(scan['clocking']):.0f}°" if scan["clocking"] else ""
    beyond = " from beyond the centre" if scan["start"] * scan["end"] < 0 else ""
    return f"{abs(scan['rpm']):g} rpm {'outward' if outward else 'inward'}{beyond}{turned}"


def _path_text(path: Mapping[str, float], bound: float) -> str:
    kept = "" if path["error"] <= bound else f", MORE than {quantity(bound, 'm')}"
    error, allowed = quantity(path["error"], "m"), np.degrees(path["c_acceleration"])
    segment = f"{path['segment'] * 1e3:g} ms"
    points = f"; {count(path['points'])} points on the part" if "points" in path else ""
    return f"Z within {error}{kept}; segments of {segment}; allow C {allowed:.0f} °/s²{points}"


def _show_scans(facts: Facts) -> Rows:
    rows = []
    for one in facts["sets"]:
        scans = ", ".join(map(_scan_text, one["scans"]))
        verified = "" if len(one["scans"]) > 1 else "; nothing verifies it"
        rows.append(
            (
                one["name"],
                f"U = {quantity(one['expanded_uncertainty'], 'm', 2)} (PV, k = 2) in "
                f"{one['duration'] / 60:.1f} min: {scans}{verified}",
            )
        )
    bound = facts["path_error"]
    reached = "reaches" if facts["reaches"] else "does not reach"
    return [
        *rows,
        *((f"scan_{k + 1}.nc", _path_text(path, bound)) for k, path in enumerate(facts["paths"])),
        ("chosen", f"{facts['set']}, which {reached} {quantity(facts['accuracy'], 'm', 2)}"),
        *([("", facts["largest"])] if facts["largest"] else ()),
        written(facts["files"]),
    ]


_PLANS = {
    "steps": _plan_steps,
    "multisine": _plan_multisine,
    "scans": _plan_scans,
    "motion": _plan_motion,
}
COMMANDS = (CliCommand("plan", _declare_plan, lambda args: _PLANS[args.what](args), _show_plan),)
