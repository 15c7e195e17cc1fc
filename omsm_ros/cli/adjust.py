"""Commands that estimate from scans: adjust, selfcal, reversal, latency, align, sources."""

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from omsm_ros.cli.arguments import Arguments, cell_of, json_object
from omsm_ros.cli.command import CliCommand, Facts, Rows, kept, rejected, written
from omsm_ros.core.adjustment.resolved_calibration import (
    after_step_test,
    from_scans_alone,
    resolved,
    reversal,
    undetermined,
    unit_calibration,
    without_step_test,
)
from omsm_ros.core.adjustment.self_calibration import (
    DEFAULT_CLOCKING_RAD,
    DEFAULT_HARMONICS,
    UNINFORMATIVE_GAIN,
    self_calibrate,
)
from omsm_ros.core.adjustment.source_evaluation import (
    KINDS,
    SPHERE,
    FoundSource,
    evaluate_sources,
    sources_of_alignment,
)
from omsm_ros.core.calibration.calibration import Calibration, excess_latency_text, with_latency
from omsm_ros.core.calibration.latency import declared_latency, latency_summary
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import MachineSources, with_assumed
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.registration.probe_alignment import (
    MOST_POINTS,
    Alignment,
    SphereScan,
    align_on_sphere,
)
from omsm_ros.core.streams.blocks import Account
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import (
    add_sources,
    load_geometry,
    load_sources,
    load_surface,
    save_geometry,
)
from omsm_ros.io.topics import AnyBag
from omsm_ros.messages.verdict import SOURCE_NAMES, source_name
from omsm_ros.pipelines.adjust import adjust_bags, adjustment_facts, read_scan, write_adjustment
from omsm_ros.pipelines.correct import Admission, CorrectedScan
from omsm_ros.pipelines.recording import Recording
from omsm_ros.quantities import (
    ANGLE,
    ANGLE_UNCERTAINTY,
    GAIN,
    GAIN_UNCERTAINTY,
    HARMONICS,
    LAG,
    RADIUS,
    TIME_UNCERTAINTY,
    UNCERTAINTY,
)
from omsm_ros.readable import date_text_of_stamp, measured, now_text, percent, quantity, standard
from omsm_ros.report.verdict import headline, next_steps, verdict_text
from omsm_ros.units import RPM_RAD_S


def _declare_adjust(add: Arguments) -> None:
    add.bags("scans", nargs="+", metavar="SCAN", help="scans of one part; two or more verify it")
    add("--calibration", "CAL.json", required=True)
    add("--out", "DIR", required=True)
    add("--nominal", "SURFACE.yaml")
    add("--geometry", "GEOMETRY.yaml", "from 'omsm align'")
    add("--sources", "SOURCES.yaml", "declared error sources, the priors of the fit")
    add("--clocking", ANGLE, nargs="+", default=[])
    add("--clamping", int, nargs="+", default=[])
    add("--accuracy", UNCERTAINTY, "largest expanded uncertainty of PV accepted, k = 2 [m]")
    add("--tolerance", UNCERTAINTY, "tolerance of the peak to valley [m]")
    add(
        "--accept",
        str,
        f"accept the found value of a source; names as in adjustment.json, such as "
        f"{next(iter(SOURCE_NAMES))}",
        nargs="+",
        default=[],
        metavar="SOURCE",
    )
    add.shared("--override")
    add("--no-report", None, "no page")
    add.shared("--origin", "--polarity")


def _adjust(args: argparse.Namespace) -> Facts:
    geometry, calibration = load_geometry(args.geometry), load_calibration(args.calibration)
    found, scans = adjust_bags(
        [cell_of(path, args) for path in args.scans],
        calibration,
        nominal=load_surface(args.nominal) if args.nominal else None,
        options=CorrectionOptions(polarity=args.polarity, geometry=geometry),
        stated=load_sources(args.sources),
        clockings=args.clocking,
        clampings=args.clamping,
        accuracy=args.accuracy,
        accepted=args.accept,
        admission=Admission(override=args.override),
    )
    facts = adjustment_facts(found, scans, calibration, args.tolerance)
    if args.origin:
        facts["origin"] = args.origin
    write_adjustment(args.out, facts, found, scans, report=not args.no_report)
    return {**facts, "out": str(args.out)}


def _show_adjust(facts: Facts) -> Rows:
    # Here, because the page's module loads what draws.
    from omsm_ros.report.adjustment import source_table, tested_text

    return [
        ("result", headline(facts)),
        ("verdict", facts["verdict"]["text"]),
        *(("", text) for text in next_steps(facts["verdict"])),
        *((name, f"{'' if declared.startswith('not') else 'declared '}{declared}, "
           f"{'' if found.startswith('not') else 'found '}{found}"
           + (f": {status}" if status else ""))
          for name, declared, found, _, status in source_table(facts).rows),
        ("", tested_text(facts)),
        written(facts["files"].values(), facts["out"]),
    ]  # fmt: skip


def _declare_selfcal(add: Arguments) -> None:
    add.bags("scans", nargs="+", metavar="SCAN", help="two or more scans of one part")
    add("--calibration", "STEP.json", "calibration from a step test")
    add("--out", "CAL.json", required=True)
    add("--harmonics", HARMONICS, default=DEFAULT_HARMONICS)
    add("--clocking", ANGLE_UNCERTAINTY, default=DEFAULT_CLOCKING_RAD)
    add.shared("--polarity")
    add("--static-gain", GAIN, "static gain of the probe, used without a step test", default=1.0)
    add("--gain-uncertainty", GAIN_UNCERTAINTY, default=UNINFORMATIVE_GAIN)
    add("--settings", json_object, default={}, metavar="JSON")


def _selfcal(args: argparse.Namespace) -> Facts:
    step_test = load_calibration(args.calibration) if args.calibration else None
    bags = [cell_of(path, args) for path in args.scans]
    with Recording(bags[0]) as first:
        period = first.sample_period()
    base = step_test or unit_calibration(period, args.static_gain)
    how = replace(UNCORRECTED_LAG, polarity=args.polarity)
    scans = [read_scan(bag, base, how) for bag in bags]
    prior = after_step_test(base) if step_test else without_step_test(args.gain_uncertainty)
    prior = replace(prior, clocking=args.clocking)
    found = self_calibrate([scan.data for scan in scans], prior, args.harmonics)
    made = (
        resolved(step_test, found)
        if step_test
        else from_scans_alone(found, period, args.static_gain, args.settings)
    )
    path = kept(args.out, made)
    return {
        **_resolved_facts(made),
        "residual": found.residual,
        "left_on_this_surface": found.followed,
        "disagreement": found.agreement.disagreement,
        "unidentifiable": [*map(str, undetermined(found))],
        "speeds_rpm": [speed / RPM_RAD_S for speed in found.speeds],
        "samples": [scan.account.as_dict() for scan in scans],
        "calibration": str(path),
    }


def _resolved_facts(calibration: Calibration) -> dict[str, Any]:
    certificate = calibration.certificate
    return {
        "id": calibration.id,
        "verdict": verdict_text(calibration),
        "reasons": [str(reason) for reason in certificate.reasons],
        "lag": calibration.dynamics.low_frequency_delay,
        "lag_uncertainty": certificate.response.low_frequency_delay_uncertainty_s,
        "latency": latency_summary(calibration.latency),
        "valid_up_to": calibration.valid_up_to,
    }


def _show_selfcal(facts: Facts) -> Rows:
    return [
        ("verdict", facts["verdict"]),
        *(("reason", text) for text in facts["reasons"]),
        ("scans", ", ".join(f"{speed:.1f} rpm" for speed in facts["speeds_rpm"])),
        ("lag of Z", standard(facts["lag"], facts["lag_uncertainty"], "s")),
        *_latency_rows(facts["latency"]),
        ("valid up to", quantity(facts["valid_up_to"], "Hz")),
        ("residual error", f"{quantity(facts['left_on_this_surface'], 'm')} rms on this "
                           "surface (k = 1)"),
        ("scans differ by", f"{quantity(facts['disagreement'], 'm')} rms beyond noise"),
        *(("not identifiable", text) for text in facts["unidentifiable"]),
        written([facts["calibration"]]),
    ]  # fmt: skip


def _latency_rows(latency: Facts) -> Rows:
    share = latency["share"]
    return [
        ("probe latency", standard(latency["delay_s"], latency["uncertainty_s"], "s")),
        ("share of the lag", "unknown" if share is None else percent(share, 3)),
        ("source", f"{latency['source']}: {latency['reason']}"),
    ]


def _declare_reversal(add: Arguments) -> None:
    add.bags("clockwise", "counterclockwise")
    add("--calibration", "CAL.json", required=True)
    add("--out", "CAL.json", "write the calibration with the latency")


def _reversal(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    paths = args.clockwise, args.counterclockwise
    scans = [read_scan(cell_of(path, args), calibration, UNCORRECTED_LAG) for path in paths]
    found = reversal([scan.data for scan in scans], calibration)
    facts = {
        name: getattr(found, name)
        for name in ("lag", "uncertainty", "lag_of_z", "residual", "used", "latency")
    }
    facts["points"] = sum(scan.account.axes.corrected for scan in scans)
    facts["samples"] = [scan.account.as_dict() for scan in scans]
    if args.out:
        facts["calibration"] = str(kept(args.out, found.calibration))
    return facts


_MEANINGS = {
    True: "the lag is latency of the probe: X and C must be delayed, too",
    False: "the lag is mechanical: it affects Z only",
    None: "undecided: the lag is neither zero nor that of Z",
}


def _show_reversal(facts: Facts) -> Rows:
    return [
        ("probe latency", standard(facts["lag"], facts["uncertainty"], "s")),
        ("lag of Z", quantity(facts["lag_of_z"], "s", 4)),
        ("meaning", _MEANINGS[facts["latency"]]),
        ("residual", f"{quantity(facts['residual'], 'm')} rms"),
        ("points", f"{facts['points']} corrected, {facts['used']} of them fitted"),
        written([facts.get("calibration", "nowhere; give --out to use it")]),
    ]


def _declare_latency(add: Arguments) -> None:
    add("calibration", "CAL.json")
    add("--delay", LAG, "latency of the probe [s]", required=True)
    add("--uncertainty", TIME_UNCERTAINTY, "its standard uncertainty, k = 1 [s]", required=True)
    add("--reason", str, "source of these figures", required=True)
    add("--out", "CAL.json", required=True)


def _latency(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    lag = calibration.dynamics.low_frequency_delay
    if (wrong := excess_latency_text(calibration, args.delay, args.uncertainty)) is not None:
        raise ConfigurationError(wrong.code, **wrong.values)
    latency = declared_latency(lag, args.delay, args.uncertainty, args.reason)
    made = with_latency(calibration, latency)
    path = kept(args.out, made)
    return {**_resolved_facts(made), "calibration": str(path)}


def _show_latency(facts: Facts) -> Rows:
    return [
        ("lag of Z", standard(facts["lag"], facts["lag_uncertainty"], "s")),
        *_latency_rows(facts["latency"]),
        written([facts["calibration"]]),
    ]


UNCORRECTED_LAG = CorrectionOptions(probe_latency=0.0)
"""Options of tasks that estimate the latency of the probe, which must not be corrected before."""


def alignment_of(
    path: AnyBag, calibration: Calibration, radius: float, geometry: Geometry
) -> tuple[Alignment, Account]:
    """Estimate spindle centre and beam direction from a scan of a sphere of ``radius`` [m].

    Also return the account of the samples of the scan.
    """
    with Recording(path) as recording:
        scan = CorrectedScan(recording, calibration, UNCORRECTED_LAG, most_traced=MOST_POINTS)
        for _ in scan.steps():
            pass
        scan.check_points()
        return align_on_sphere(
            SphereScan.of(scan.corrector.trace.points()), radius, geometry
        ), scan.account


_NO_SPHERE = (
    "the residual is several times the noise: the surface is not a sphere of that radius, or its "
    "form error or the probe's error on slopes is as large; the centre may be worse than stated"
)
# Beyond this ratio of residual to scatter, nine tenths of the mean square are not noise.
_RESIDUAL_RATIO = 3.0


def _declare_align(add: Arguments) -> None:
    add.bags("bag", help="a scan of a reference sphere")
    add("--calibration", "CAL.json", required=True)
    add("--radius", RADIUS, "radius of the sphere [m], negative if convex", required=True)
    add("--geometry", "GEOMETRY.yaml", "known values to start from")
    add("--out", "GEOMETRY.yaml", required=True)


def _align(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    known = load_geometry(args.geometry)
    found, account = alignment_of(cell_of(args.bag, args), calibration, args.radius, known)
    save_geometry(args.out, found.geometry)
    names = ("centre_x", "centre_y", "beam_x", "beam_y")
    # JSON has no infinity, so the uncertainty of an unidentifiable beam direction is null.
    spread = found.uncertainty if found.beam_found else (*found.uncertainty[:2], None, None)
    return {
        "geometry": asdict(found.geometry),
        "uncertainty": dict(zip(names, spread, strict=True)),
        "residual": found.residual,
        "scatter": found.scatter,
        "warnings": [_NO_SPHERE] * (found.residual > _RESIDUAL_RATIO * found.scatter),
        "beam_found": found.beam_found,
        "used": found.used,
        "samples": account.as_dict(),
        "file": str(args.out),
    }


def _show_align(facts: Facts) -> Rows:
    rows = []
    for name, spread in facts["uncertainty"].items():
        value, length = facts["geometry"][name], name.startswith("centre")
        stated = measured(value, spread, "m" if length else "rad")
        rows.append(
            (name, stated if spread is not None else f"{stated}, not identifiable in this scan")
        )
    residual, scatter = (quantity(facts[name], "m") for name in ("residual", "scatter"))
    rows.append(("residual", f"{residual} rms, of which {scatter} noise"))
    rows += [("warning", warning) for warning in facts["warnings"]]
    corrected = facts["samples"]["axes"]["corrected"]
    rows.append(("points", f"{corrected} corrected, {facts['used']} of them fitted"))
    return [*rows, written([facts["file"]])]


_HOW = """\
still: probe before a fixed place for a minute: noise, drift
passes: X over the same line ten times, spindle stopped: drift
turned: spiral over a turned flat, or a turned part (--nominal): spindle
stand_offs: one ring, Z further by some micrometres in each turn: gain and linearity of the probe
sphere: spiral over a sphere (--radius) mounted a millimetre off the axis: centre, beam
"""


def _declare_sources(add: Arguments) -> None:
    add("kind", str, "kind of the recording, as listed at the end", choices=(*KINDS, SPHERE))
    add.bags("bag")
    add("--calibration", "CAL.json", required=True)
    add("--out", "SOURCES.yaml", "file to which the sources are added", required=True)
    add("--nominal", "SURFACE.yaml", "surface of the turned part; default: a flat")
    add("--radius", RADIUS, "radius of the sphere [m], negative if convex")
    add("--geometry", "GEOMETRY.yaml", "from 'omsm align': the sources are what it leaves")
    add.shared("--polarity")
    add.epilog(_HOW)


def _sources(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    geometry = load_geometry(args.geometry)
    bag = cell_of(args.bag, args)
    options = CorrectionOptions(polarity=args.polarity, geometry=geometry)
    scan = read_scan(bag, calibration, options)
    if args.kind == SPHERE:
        if args.radius is None:
            raise ConfigurationError("a sphere needs its radius; give --radius")
        aligned, _ = alignment_of(bag, calibration, args.radius, geometry)
        drift = _drift(load_sources(args.out if args.out.exists() else None))
        found, missing = sources_of_alignment(aligned, geometry, scan.data, drift)
    else:
        nominal = load_surface(args.nominal) if args.nominal else Flat()
        found, missing = evaluate_sources(args.kind, scan.data, nominal)
    began = scan.began_ns
    date = date_text_of_stamp(began) if began else now_text()
    entries = [_entry(one, args.kind, args.bag, date) for one in found]
    add_sources(args.out, entries)
    return {"sources": entries, "not_shown": list(missing), "file": str(args.out)}


def _drift(stated: MachineSources) -> tuple[float, float]:
    """Return the standard uncertainties of rate and walk as stated before, or assumed."""
    known = with_assumed(stated)
    rate, walk = (
        max((s.standard_uncertainty for s in known.of(name)), default=0.0)
        for name in ("drift_rate", "drift_walk")
    )
    return rate, walk


def _entry(one: FoundSource, kind: str, bag: Path, date: str) -> dict[str, Any]:
    parameters = {"per_turn": one.per_turn, "half_range": one.half_range}
    return {
        "source": one.name,
        "value": float(f"{one.value:.3g}"),
        "unit": one.unit,
        **{name: size for name, size in parameters.items() if size is not None},
        "how": "evaluated",
        "reason": f"recording {bag.name} of {date}",
        "found": float(f"{one.found:.4g}"),
        "uncertainty": float(f"{one.uncertainty:.2g}"),
        "recording": str(bag),
        "date": date,
        "command": f"omsm sources {kind}",
    }


def _show_sources(facts: Facts) -> Rows:
    rows = []
    for entry in facts["sources"]:
        order = f"/{entry['per_turn']:g}" if "per_turn" in entry else ""
        unit = "" if entry["unit"] == "1" else entry["unit"]
        text = standard(entry["found"], entry["uncertainty"], unit)
        rows.append((source_name(entry["source"] + order), text))
    rows += [(source_name(name), "not shown by this recording") for name in facts["not_shown"]]
    return [*rows, written([facts["file"]])]


COMMANDS = (
    CliCommand("adjust", _declare_adjust, _adjust, _show_adjust),
    CliCommand("selfcal", _declare_selfcal, _selfcal, _show_selfcal, rejected),
    CliCommand("reversal", _declare_reversal, _reversal, _show_reversal),
    CliCommand("latency", _declare_latency, _latency, _show_latency, rejected),
    CliCommand("align", _declare_align, _align, _show_align),
    CliCommand("sources", _declare_sources, _sources, _show_sources),
)
