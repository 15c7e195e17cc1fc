"""Commands around the shape of a part: form, surface."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import number
from omsm_ros.cli.command import Command, Facts, progress_bar, table
from omsm_ros.cli.exporting import UNIT
from omsm_ros.cli.fit_option import declare_fit, form_rows
from omsm_ros.core.surface.freedoms import AUTO
from omsm_ros.jobs.judge_form import judge_form
from omsm_ros.jobs.measure import measure
from omsm_ros.jobs.measured_portions import open_measurement
from omsm_ros.storage.calibration_file import load_calibration
from omsm_ros.storage.files import CLOUD, CURVES, DEVIATION, FORM, SUMMARY, SYSTEMATIC
from omsm_ros.storage.result_folder import result_folder
from omsm_ros.storage.surface_file import load_surface

# ---------------------------------------------------------------------------------- form


def _declare_form(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "measured", type=Path, help="result folder, cloud or map; a scan with its --calibration"
    )
    sub.add_argument("--nominal", type=Path, required=True, metavar="SURFACE.yaml")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument("--calibration", type=Path, metavar="CAL.json", help="of a scan")
    sub.add_argument("--unit", **UNIT)
    declare_fit(sub, (AUTO,))
    for name, what in (("s", "shorter"), ("l", "longer")):
        sub.add_argument(
            f"--{name}-filter",
            type=number(quantities.SPACING),
            metavar="WAVELENGTH",
            help=f"texture without what is {what} [m] (ISO 25178)",
        )


def _form(args: argparse.Namespace) -> Facts:
    surface, filters = load_surface(args.nominal), (args.s_filter, args.l_filter)
    with result_folder(args.out, (CLOUD, SYSTEMATIC, SUMMARY, DEVIATION, CURVES, FORM)) as out:
        source = args.measured
        if args.calibration:
            calibration = load_calibration(args.calibration)
            with progress_bar("correcting", args.json) as progress:
                measure(source, calibration, out, nominal=surface, report=False, progress=progress)
            source = out
        points = open_measurement(source, args.unit)
        return judge_form(points, surface, out, args.fit, args.aperture, filters)


COMMANDS = (
    Command(
        "form",
        "register a cloud to its nominal surface and judge its form",
        _declare_form,
        _form,
        lambda facts: table(form_rows(facts)),
    ),
)
