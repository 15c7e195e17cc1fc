"""The command that finds out how the probe sits: align."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import add_bags, cell_of, number
from omsm_ros.cli.command import CliCommand, Facts, progress_bar, table, written
from omsm_ros.cli.correct import CALIBRATION, geometry_of
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import save_geometry
from omsm_ros.pipelines.study_scans import alignment_of
from omsm_ros.readable import measured, quantity

_NO_SPHERE = (
    "most of the residual is no noise: this is no sphere of that radius, or its form or the "
    "probe's error on slopes is as large; the centre may be worse than stated"
)
# Beyond it nine tenths of the mean square are something else than noise.
_NOT_NOISE = 3.0


def _declare_align(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "bag", help="a scan of a reference sphere")
    sub.add_argument("--calibration", **CALIBRATION)
    sub.add_argument(
        "--radius", type=number(quantities.RADIUS), required=True, help="[m], negative if convex"
    )
    sub.add_argument("--geometry", type=Path, metavar="GEOMETRY.yaml", help="what is known")
    sub.add_argument("--out", type=Path, required=True, metavar="GEOMETRY.yaml")


def _align(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    known = geometry_of(args.geometry)
    with progress_bar("correcting", args.json) as progress:
        scan = cell_of(args.bag, args)
        found, account = alignment_of(scan, calibration, args.radius, known, progress)
    save_geometry(args.out, found.geometry)
    names = ("centre_x", "centre_y", "beam_x", "beam_y")
    # JSON has no infinity: a lean that the scan cannot show has no uncertainty to state.
    spread = found.uncertainty if found.beam_found else (*found.uncertainty[:2], None, None)
    return {
        "geometry": asdict(found.geometry),
        "uncertainty": dict(zip(names, spread, strict=True)),
        "residual": found.residual,
        "scatter": found.scatter,
        "warnings": [_NO_SPHERE] * (found.residual > _NOT_NOISE * found.scatter),
        "beam_found": found.beam_found,
        "used": found.used,
        "samples": account.as_dict(),
        "file": str(args.out),
    }


def _show_align(facts: Facts) -> None:
    rows = []
    for name, spread in facts["uncertainty"].items():
        value, length = facts["geometry"][name], name.startswith("centre")
        stated = measured(value, spread, "m" if length else "rad")
        rows.append(
            (name, stated if spread is not None else f"{stated}, not identifiable in this scan")
        )
    residual, scatter = (quantity(facts[name], "m") for name in ("residual", "scatter"))
    rows.append(("residual", f"{residual} rms, of which noise {scatter}"))
    rows += [("warning", warning) for warning in facts["warnings"]]
    corrected = facts["samples"]["axes"]["corrected"]
    rows.append(("points", f"{corrected} corrected, {facts['used']} of them fitted"))
    table([*rows, written([facts["file"]])])


COMMANDS = (CliCommand("align", _declare_align, _align, _show_align),)
