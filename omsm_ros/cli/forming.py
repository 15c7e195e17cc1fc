"""Commands around the shape of a part: form, surface."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from omsm_ros import quantities
from omsm_ros.cli.command import Command, Facts, table
from omsm_ros.core.surface.freedoms import parsed_freedoms
from omsm_ros.core.surface.placement import Aperture
from omsm_ros.errors import ConfigurationError
from omsm_ros.jobs.judge_form import FORM, cloud_in, form_facts, judge_form
from omsm_ros.storage.files import save_json
from omsm_ros.storage.result_folder import result_folder
from omsm_ros.storage.surface_file import load_surface
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

# ---------------------------------------------------------------------------------- form


def freedoms(text: str) -> tuple[str, ...]:
    """Argument type: 'auto', or freedoms of a pose."""
    try:
        return parsed_freedoms(text)
    except ConfigurationError as err:
        raise argparse.ArgumentTypeError(str(err)) from err


def aperture(text: str) -> Aperture:
    """Argument type: R or R,X,Y [m]."""
    try:
        parts = [
            quantities.LENGTH.checked(float(part), ConfigurationError, name)
            for part, name in zip(text.split(","), ("radius", "x", "y"), strict=False)
        ]
        if len(parts) != len(text.split(",")) or len(parts) == 2 or parts[0] <= 0:
            raise ValueError
        return Aperture(*parts)
    except ConfigurationError as err:
        raise argparse.ArgumentTypeError(str(err)) from err
    except ValueError as err:
        raise argparse.ArgumentTypeError(
            f"aperture is {quantities.shown(text)}, expected R or R,X,Y in metres"
        ) from err


def declare_fit(sub: argparse.ArgumentParser, default: str | None) -> None:
    """Add the arguments of a registration."""
    sub.add_argument(
        "--fit",
        type=freedoms,
        default=default,
        metavar="FREEDOMS",
        help="'auto', or of piston,tip,tilt,x,y,clocking,power: what is taken out",
    )
    sub.add_argument(
        "--aperture",
        type=aperture,
        metavar="R[,X,Y]",
        help="disc of the part that counts [m]; without it all points do",
    )


def _declare_form(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("cloud", type=Path, help="cloud.ply, or the folder of a measurement")
    sub.add_argument("--nominal", type=Path, required=True, metavar="SURFACE.yaml")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    declare_fit(sub, "auto")


def _form(args: argparse.Namespace) -> Facts:
    surface, cloud = load_surface(args.nominal), cloud_in(args.cloud)
    asked = freedoms(args.fit) if isinstance(args.fit, str) else args.fit
    with result_folder(args.out, (FORM,)) as out:
        facts = form_facts(judge_form(cloud, surface, asked, args.aperture))
        save_json(out / FORM, facts)
    return facts


_UNITS = {"piston": (NANOMETRE_M, "nm"), "x": (MICROMETRE_M, "µm"), "y": (MICROMETRE_M, "µm"),
          "tip": (1e-6, "µrad"), "tilt": (1e-6, "µrad"), "clocking": (1e-6, "µrad"),
          "power": (1.0, "1/m")}  # fmt: skip


def form_rows(facts: Facts) -> list[tuple[str, str]]:
    """Return what people read of a form."""
    removed, points = facts["removed"], facts["points"]
    rows = [(name, _figure(facts["pose"][name], *_UNITS[name])) for name in removed["fitted"]]
    rows += [(f"{n} not fitted", why) for n, why in removed["not_determined"].items()]
    rows += [
        (name.replace("_", " "), _figure(figure, NANOMETRE_M, "nm"))
        for name, figure in facts["deviation"].items()
    ]
    others = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in points.items() if v and k != "read")
    rows += [("points", f"{points['read']} read: {others}")]
    rows += [("not evaluated", text) for text in removed["not_evaluated"]]
    return rows


def _figure(figure: dict[str, Any], unit: float, name: str) -> str:
    value, spread = figure["value"], figure["uncertainty"]
    if value is None:
        return "not evaluated"
    stated = "" if spread is None else f" ± {spread / unit:.3g}"
    return f"{value / unit:.5g}{stated} {name} (k = 1)" if stated else f"{value / unit:.5g} {name}"


COMMANDS = (
    Command(
        "form",
        "register a cloud to its nominal surface and judge its form",
        _declare_form,
        _form,
        lambda facts: table(form_rows(facts)),
    ),
)
