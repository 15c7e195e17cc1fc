"""The command difference: compare two measurements of one part, also of another instrument."""

import argparse
from pathlib import Path

from omsm_ros.cli.arguments import Arguments, values_of
from omsm_ros.cli.command import CliCommand, Facts, Rows, written
from omsm_ros.core.comparison.matching import MATCHING_PARAMETERS, SEATED, ordered_dofs
from omsm_ros.core.registration.pose_parameters import parse_dofs
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.files import DIFFERENCE, REPORT, result_folder
from omsm_ros.messages import text_from
from omsm_ros.pipelines.difference import (
    MAP,
    ComparisonOptions,
    compare_measurements,
    write_difference,
)
from omsm_ros.quantities import SPACING, UNCERTAINTY
from omsm_ros.readable import figure


def _dof_argument(text: str) -> tuple[str, ...]:
    """Parse the degrees of freedom in which the second measurement is moved onto the first."""
    if text == "auto":
        return tuple(name for name in MATCHING_PARAMETERS if name != "power")
    return ordered_dofs(tuple(filter(None, text.split(","))))


def _declare_difference(add: Arguments) -> None:
    add("a", Path, "a result folder, a cloud or a map of any format")
    add("b", Path, "another of the same part, moved onto the first")
    add("--out", "DIR", required=True)
    add(
        "--fit",
        _dof_argument,
        f"pose parameters to fit, of {','.join(MATCHING_PARAMETERS)}; 'auto': all but power, "
        f"as far as the surface determines them; default {','.join(SEATED)}",
        default=SEATED,
        metavar="PARAMETERS",
    )
    add("--nominal", "SURFACE.yaml", "surface to subtract from both first")
    add("--register", parse_dofs, metavar="PARAMETERS")
    add("--uncertainty", UNCERTAINTY)
    add("--drift", UNCERTAINTY)
    add.shared("--unit")
    add("--spacing", SPACING, "spacing of the compared grid [m]")
    add("--correlation-length", SPACING)


def _difference(args: argparse.Namespace) -> Facts:
    if args.register and args.nominal is None:
        raise ConfigurationError("--register needs the surface; give --nominal SURFACE.yaml")
    options = ComparisonOptions(
        dofs=args.fit,
        units=args.unit,
        length=args.correlation_length,
        **values_of(args, "uncertainty", "drift", "spacing", "register"),
    )
    nominal = load_surface(args.nominal) if args.nominal else None
    found, facts = compare_measurements(args.a, args.b, options, nominal)
    with result_folder(args.out, (MAP, REPORT, DIFFERENCE)) as out:
        write_difference(out, found, facts)
    files = {"difference": DIFFERENCE, "map": MAP, "report": REPORT}
    return {**facts, "files": files, "out": str(args.out)}


_EXTENTS = "{peak_to_valley:m/4} PV, {robust_peak_to_valley:m/4} PV of 99.5 %, {rms:m/4} rms"
_GRID = (
    "{difference[places]:count} places, {resampling[spacing]:m/4} apart, on "
    "{difference[shared_area]:%/3} of the smaller area"
)


def _show_difference(facts: Facts) -> Rows:
    found = facts["difference"]
    rows = [("verdict", facts["verdict"])]
    rows += [("because", text) for text in facts["reasons"]]
    rows += [("but", text) for text in facts["reservations"]]
    rows += [
        ("difference", text_from(_EXTENTS, found)),
        ("uncertainty", "not evaluated" if found["uncertainty"] is None else
                        text_from("{uncertainty:m/4} rms (k = 1)", found)),
        ("grid", text_from(_GRID, facts)),
    ]  # fmt: skip
    for name, n in facts["e_n"].items():
        number = "not evaluated" if n["e_n"] is None else "{e_n:plain} (U {expanded:m/4})"
        text = text_from(f"{number}: {{a:m/4}} and {{b:m/4}}", n)
        rows.append((f"E_n of {figure(name)}", text))
    if facts["within"] is not None:
        rows.append(("points", text_from("|E_n| < 1 on {within:%/3} of the area", facts)))
    for name in ("a", "b"):
        rows += [(f"note on {name.upper()}", text) for text in facts[name]["notes"]]
    return [*rows, written(facts["files"].values(), facts["out"])]


COMMANDS = (CliCommand("difference", _declare_difference, _difference, _show_difference),)
