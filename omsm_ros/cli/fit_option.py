"""Options of a registration and rows of its result, for form, correct and difference."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from omsm_ros.cli.arguments import Arguments
from omsm_ros.cli.command import Facts
from omsm_ros.core.registration.isolated_points import DustRule
from omsm_ros.core.registration.pose_parameters import parse_dofs
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import COUNTER, TOLERANCE, shown
from omsm_ros.readable import NOTHING, count

if TYPE_CHECKING:
    from omsm_ros.pipelines.form import RegistrationOptions


def dust_rule(text: str) -> DustRule:
    """Parse 'none', 'isolated' or a number of points."""
    if text in ("none", "isolated"):
        return text  # type: ignore[return-value]
    try:
        return int(COUNTER.checked(int(text), ConfigurationError, "dust"))
    except ValueError as err:
        raise ConfigurationError(
            f"dust is {shown(text)}, expected none, isolated or a number of points"
        ) from err


def placement(text: str) -> dict[str, float]:
    """Parse the uncertainty of x and y [m], and that of clocking [rad] if a second one follows."""
    try:
        lateral, *angles = [float(part) for part in text.split(",")]
        known = dict(zip(("x", "y", "clocking"), (lateral, lateral, *angles), strict=False))
        if len(angles) > 1 or not all(0 <= size < 1 for size in known.values()):
            raise ValueError
    except ValueError as err:
        raise ConfigurationError(
            f"placement is {shown(text)}, expected M or M,RAD: standard uncertainties"
        ) from err
    return {name: max(size, _LEAST_PLACEMENT) for name, size in known.items()}


def declare_fit(add: Arguments, default: tuple[str, ...] | None) -> None:
    """Add the options of a registration."""
    add("--fit", parse_dofs, default=default, metavar="PARAMETERS")
    add("--aperture", Aperture.parse, metavar="APERTURE")
    add("--placement", placement, metavar="M[,RAD]")


def declare_tolerance(add: Arguments) -> None:
    """Add the tolerance of a registered part, and the rule for dust."""
    add("--dust", dust_rule, metavar="none|isolated|N")
    add("--tolerance", TOLERANCE, "tolerance of the peak to valley of the part [m]; needs --fit")


def registration_of(args: argparse.Namespace) -> RegistrationOptions:
    """Return the options of a registration, with None for those that a command does not have."""
    # Here, because most corrections do not register.
    from omsm_ros.pipelines.form import RegistrationOptions

    given = {name: getattr(args, name, None) for name in _OTHERS}
    filters = getattr(args, "s_filter", None), getattr(args, "l_filter", None)
    return RegistrationOptions(args.fit, filters=filters, **given)


_OTHERS = ("aperture", "tolerance", "dust", "placement", "drawing")
# A smaller standard uncertainty of a placement [m], [rad] counts as zero.
_LEAST_PLACEMENT = 1e-12


def form_rows(facts: Facts, adjusted: object = None) -> list[tuple[str, str]]:
    """Return the rows that show a form.

    adjusted: figures of the adjusted scan, which stand for PV and rms, if there are any
    """
    # Here, because the page loads what draws, which a correction does without.
    from omsm_ros.report.measurement.page import figure_rows, removed_table

    removed, points = facts["removed"], facts["points"]
    rows = [row for row in figure_rows(facts, adjusted) if row[1] != NOTHING]
    others = ", ".join(
        f"{count(v)} {k.replace('_', ' ')}" for k, v in points.items() if v and k != "read"
    )
    rows += [("points", f"{count(points['read'])} read: {others}")]
    rows += [
        (name, f"{value} ± {spread} (k = 1)" if value != NOTHING else reason[0])
        for name, value, spread, *reason in removed_table(facts).rows
    ]
    rows += [("note", text) for text in removed["notes"]]
    return rows + [("not evaluated", text) for text in removed["not_evaluated"]]
