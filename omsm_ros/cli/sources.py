"""The command sources: evaluate error sources of a machine from recordings made for it."""

import argparse
from pathlib import Path
from typing import Any

from omsm_ros.cli.arguments import Arguments, cell_of
from omsm_ros.cli.command import CliCommand, Facts, Rows, written
from omsm_ros.core.adjustment.source_evaluation import (
    KINDS,
    SPHERE,
    FoundSource,
    evaluate_sources,
    sources_of_alignment,
)
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import MachineSources, with_assumed
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import add_sources, load_geometry, load_sources, load_surface
from omsm_ros.messages.verdict import source_name
from omsm_ros.pipelines.adjust import read_scan
from omsm_ros.pipelines.study_scans import alignment_of
from omsm_ros.quantities import RADIUS
from omsm_ros.readable import date_text_of_stamp, now_text, standard

_HOW = """\
still: probe before a fixed place for a minute: noise, drift
passes: X over the same line ten times, spindle stopped: drift
turned: spiral over a turned flat, or a turned part (--nominal): spindle
stand_offs: one ring, Z further by some micrometres in each turn: gain and linearity of the probe
sphere: spiral over a sphere (--radius) mounted a millimetre off the axis: centre, beam
"""


def _declare(add: Arguments) -> None:
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


def _show(facts: Facts) -> Rows:
    rows = []
    for entry in facts["sources"]:
        order = f"/{entry['per_turn']:g}" if "per_turn" in entry else ""
        unit = "" if entry["unit"] == "1" else entry["unit"]
        text = standard(entry["found"], entry["uncertainty"], unit)
        rows.append((source_name(entry["source"] + order), text))
    rows += [(source_name(name), "not shown by this recording") for name in facts["not_shown"]]
    return [*rows, written([facts["file"]])]


COMMANDS = (CliCommand("sources", _declare, _sources, _show),)
