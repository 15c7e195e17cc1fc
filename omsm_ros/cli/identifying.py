"""``omsm identify``: a calibration from a recording, or a model of any two sampled quantities."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import json_object, number
from omsm_ros.cli.command import Command, Facts, kept_at, progress_bar, rejected, table
from omsm_ros.core.dynamics.calibration import Calibration, verdict_of
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.sampled.identify_samples import HOLDS
from omsm_ros.core.sampled.model import BAND_LIMITED, SampledModel
from omsm_ros.errors import ConfigurationError
from omsm_ros.jobs.identify_bag import motion_of_bag
from omsm_ros.jobs.identify_table import model_of_motion, model_of_table
from omsm_ros.readable import percent, plain, quantity
from omsm_ros.storage.calibration_file import save_calibration
from omsm_ros.storage.model_file import save_model

TABLE_SUFFIX = ".csv"


def _declare(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "recording", type=Path, help="a bag of a motion on a fixed target, or a table RECORD.csv"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="CAL.json")
    sub.add_argument(
        "--order", type=number(quantities.ORDER), default=0, help="number of poles; 0 = choose"
    )
    sub.add_argument(
        "--input",
        default="encoder",
        help="'encoder' or 'reference' of a bag; of a table, the name of a column",
    )
    sub.add_argument("--output", help="of a table, the name of a column")
    sub.add_argument(
        "--period", type=number(quantities.SAMPLE_PERIOD), help="of a table, from line to line [s]"
    )
    sub.add_argument(
        "--hold",
        choices=HOLDS,
        default=BAND_LIMITED,
        help="what the input does between samples; 'band-limited' for what was measured, the "
        "others for a command, which give a model and no calibration",
    )
    sub.add_argument(
        "--max-delay",
        type=number(quantities.MAX_DELAY_SAMPLES),
        default=3,
        metavar="SAMPLES",
        help="of a held input, the longest delay tried",
    )
    sub.add_argument(
        "--duration", type=number(quantities.DURATION), default=0.0, help="[s] to use; 0 = all"
    )
    sub.add_argument(
        "--settings", type=json_object, default={}, metavar="JSON", help="what it belongs to"
    )
    sub.add_argument(
        "--report", type=Path, metavar="DIR", help="write the certificate: HTML, Markdown, plots"
    )


def _identify(args: argparse.Namespace) -> Facts:
    of_table = args.recording.suffix.lower() == TABLE_SUFFIX
    _check_arguments(args, of_table)
    if of_table:
        return _model_facts(_of_table(args), args.out)
    with progress_bar("reading", args.json) as progress:
        motion = motion_of_bag(
            args.recording,
            duration=args.duration,
            time_lapse=(args.settings or {}).get("time_lapse", 1.0),
            progress=progress,
        )
    if args.hold != BAND_LIMITED:
        model = model_of_motion(motion, hold=args.hold, order=args.order, max_delay=args.max_delay)
        return _model_facts(model, args.out)
    identified = identify(motion, order=args.order, input=args.input, settings=args.settings)
    facts = calibration_facts(identified.calibration)
    path = kept_at(args.out, facts["verdict"])
    save_calibration(path, identified.calibration)
    facts["calibration"] = str(path)
    if args.report is not None:
        # Drawing takes a second to import; most commands do without.
        from omsm_ros.jobs.certify import write_certificate

        page = write_certificate(args.report, identified, source=args.recording.name)
        facts["report"] = str(page)
    return facts


def _check_arguments(args: argparse.Namespace, of_table: bool) -> None:
    if of_table:
        missing = [n for n in ("output", "period") if getattr(args, n) is None]
        if missing:
            raise ConfigurationError(
                f"a table needs --{' and --'.join(missing)}: the name of the column that follows "
                "the input, and the seconds from line to line"
            )
    elif args.output is not None or args.period is not None:
        raise ConfigurationError(
            f"--output and --period are for a table; {str(args.recording)!r} is no {TABLE_SUFFIX} "
            "file, and a bag knows both"
        )
    if args.report is not None and (of_table or args.hold != BAND_LIMITED):
        raise ConfigurationError(
            "--report draws the certificate of a calibration; a model of a table, or of a held "
            "input, has its certificate in its file"
        )


def _of_table(args: argparse.Namespace) -> SampledModel:
    return model_of_table(
        args.recording,
        args.input,
        args.output,
        args.period,
        hold=args.hold,
        order=args.order,
        max_delay=args.max_delay,
        duration=args.duration,
    )


def _model_facts(model: SampledModel, out: Path) -> Facts:
    path = kept_at(out, str(model.certificate["verdict"]))
    save_model(path, model)
    return {
        **model.certificate,
        "hold": model.hold,
        "valid_from": model.valid_from,
        "valid_up_to": model.valid_up_to,
        "model": str(path),
    }


def calibration_facts(calibration: Calibration) -> Facts:
    """What a calibration says in a few words."""
    verdict, reasons = verdict_of(calibration)
    return {
        "id": calibration.id,
        "verdict": verdict,
        "reasons": reasons,
        "warnings": calibration.certificate.get("warnings", []),
        "order": len(calibration.dynamics.denominator) - 1,
        "low_frequency_delay": calibration.dynamics.low_frequency_delay,
        "static_gain": calibration.static_gain,
        "valid_up_to": calibration.valid_up_to,
    }


def _show(facts: Facts) -> None:
    rows = [("verdict", facts["verdict"]), ("order", str(facts["order"]))]
    if "model" in facts:
        rows += [
            ("hold", facts["hold"]),
            ("accounts for", f"{percent(facts['explained'], 4)} of what was fitted"),
            ("free runs", f"{percent(facts['predicted'], 4)} of what was hidden"),
            (
                "valid",
                " to ".join(quantity(facts[f"valid_{end}"], "Hz") for end in ("from", "up_to")),
            ),
        ]
    else:
        rows += [
            ("low-frequency delay", quantity(facts["low_frequency_delay"], "s", 5)),
            ("static gain", plain(facts["static_gain"], 6)),
            ("valid up to", quantity(facts["valid_up_to"], "Hz", 4)),
        ]
    for kind in ("reasons", "warnings"):
        rows += [(kind.removesuffix("s"), text) for text in facts[kind]]
    rows.append(("written to", facts.get("calibration") or facts["model"]))
    if "report" in facts:
        rows.append(("certificate", facts["report"]))
    table(rows)


COMMANDS = (
    Command("identify", "identify G_m from a recording", _declare, _identify, _show, rejected),
)
