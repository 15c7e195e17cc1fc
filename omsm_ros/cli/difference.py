"""The command that compares two measurements of one part: difference."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import UNIT, number
from omsm_ros.cli.command import CliCommand, Facts, table, written
from omsm_ros.cli.fit_option import dofs
from omsm_ros.core.comparison.matching import MATCHING_PARAMETERS, SEATED, ordered_dofs
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.files import DIFFERENCE, REPORT
from omsm_ros.io.folders import result_folder
from omsm_ros.pipelines.compare_measurements import (
    MAP,
    ComparisonOptions,
    compare_measurements,
    write_difference,
)
from omsm_ros.readable import count, figure, percent, plain, quantity


def _dof_argument(text: str) -> tuple[str, ...]:
    """Return the argument type: freedoms of the second measurement against the first."""
    if text == "auto":
        return tuple(name for name in MATCHING_PARAMETERS if name != "power")
    try:
        return ordered_dofs(tuple(filter(None, text.split(","))))
    except ConfigurationError as err:
        raise argparse.ArgumentTypeError(str(err)) from err


def _declare_difference(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("a", type=Path, help="a result folder, a cloud or a map of any format")
    sub.add_argument("b", type=Path, help="another of the same part, moved onto the first")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--fit",
        type=_dof_argument,
        default=SEATED,
        metavar="PARAMETERS",
        help=f"of {','.join(MATCHING_PARAMETERS)}; 'auto': all but power that the surface "
        f"determines; default {','.join(SEATED)}",
    )
    sub.add_argument("--nominal", type=Path, metavar="SURFACE.yaml", help="taken off both first")
    sub.add_argument(
        "--register",
        type=dofs,
        metavar="PARAMETERS",
        help="of each to the nominal surface first, as 'omsm form' has them: 'auto', or of "
        "piston,tip,tilt,x,y,clocking,power",
    )
    sub.add_argument(
        "--uncertainty",
        type=number(quantities.UNCERTAINTY),
        help="standard uncertainty of the heights of a file that carries none [m]",
    )
    sub.add_argument(
        "--drift",
        type=number(quantities.UNCERTAINTY),
        help="standard deviation of the drift at the end of a scan [m]; default: as its sources "
        "say, or estimated from the difference",
    )
    sub.add_argument("--unit", **UNIT)
    sub.add_argument(
        "--spacing", type=number(quantities.SPACING), help="of the places compared [m]"
    )
    sub.add_argument(
        "--correlation-length",
        type=number(quantities.SPACING),
        help="of errors of unknown form [m]; default: half the radius",
    )


def _difference(args: argparse.Namespace) -> Facts:
    if args.register and args.nominal is None:
        raise ConfigurationError("--register needs the surface; give --nominal SURFACE.yaml")
    options = ComparisonOptions(
        dofs=args.fit,
        uncertainty=args.uncertainty,
        drift=args.drift,
        units=args.unit,
        spacing=args.spacing,
        length=args.correlation_length,
        register=args.register,
    )
    nominal = load_surface(args.nominal) if args.nominal else None
    found, facts = compare_measurements(args.a, args.b, options, nominal)
    with result_folder(args.out, (MAP, REPORT, DIFFERENCE)) as out:
        write_difference(out, found, facts)
    files = {"difference": DIFFERENCE, "map": MAP, "report": REPORT}
    return {**facts, "files": files, "out": str(args.out)}


def _show_difference(facts: Facts) -> None:
    found = facts["difference"]
    rows = [("verdict", facts["verdict"])]
    rows += [("because", text) for text in facts["reasons"]]
    rows += [("but", text) for text in facts["reservations"]]
    rows += [
        ("difference", f"{_length(found['peak_to_valley'])} PV, "
                       f"{_length(found['robust_peak_to_valley'])} PV of 99.5 %, "
                       f"{_length(found['rms'])} rms"),
        ("uncertainty", "not evaluated" if found["uncertainty"] is None else
                        f"{_length(found['uncertainty'])} rms (k = 1)"),
        ("places", f"{count(found['places'])} of {_length(facts['resampling']['spacing'])}, "
                   f"{percent(found['shared_area'], 3)} of the smaller area"),
    ]  # fmt: skip
    for name, n in facts["e_n"].items():
        words = (
            "not evaluated"
            if n["e_n"] is None
            else f"{plain(n['e_n'])} (U {_length(n['expanded'])})"
        )
        label = f"E_n of {figure(name)}"
        rows.append((label, f"{words}: {_length(n['a'])} and {_length(n['b'])}"))
    if facts["within"] is not None:
        rows.append(("points", f"|E_n| < 1 on {percent(facts['within'], 3)} of the area"))
    for name in ("a", "b"):
        rows += [(f"note on {name.upper()}", text) for text in facts[name]["notes"]]
    table([*rows, written(facts["files"].values(), facts["out"])])


def _length(value: float) -> str:
    return quantity(value, "m", 4)


COMMANDS = (CliCommand("difference", _declare_difference, _difference, _show_difference),)
