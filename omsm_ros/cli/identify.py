"""``omsm identify``: a calibration from a recording, or a model of any two sampled quantities."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from omsm_ros import __version__, quantities
from omsm_ros.cli.arguments import (
    TABLE_SUFFIX,
    add_bags,
    add_by_stamps,
    add_trigger,
    cell_of,
    json_object,
    number,
    refuse_cell,
    trigger_of,
)
from omsm_ros.cli.command import (
    CliCommand,
    Facts,
    declare_catalogue,
    output_path_for,
    progress_bar,
    rejected,
    table,
    written,
)
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import Origin
from omsm_ros.core.calibration.typed_json import from_json
from omsm_ros.core.estimation.sampled_model import BAND_LIMITED, SampledModel
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.identification.sampled_identification import HOLDS
from omsm_ros.core.streams.trigger_slips import TWO_DRIVERS_S
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.io.files import atomic_file
from omsm_ros.io.model_file import load_model, save_model
from omsm_ros.pipelines.history import record_in_catalogue
from omsm_ros.pipelines.identify import (
    SampledRecord,
    intended_use_of,
    model_of,
    motion_of_bag,
    record_of_motion,
    record_of_table,
    recorded_ns_of_bag,
    run_of,
    settings_of_bag,
    text_of_run,
)
from omsm_ros.quantities import shown
from omsm_ros.readable import count, measured, percent, plain, quantity
from omsm_ros.report.verdict import verdict_text

ENCODER = "encoder"
_MAX_DELAY = 3


def _declare(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "recording", help="a bag of a motion on a fixed target, or a table RECORD.csv")
    sub.add_argument("--out", type=Path, required=True, metavar="CAL.json")
    sub.add_argument(
        "--order", type=number(quantities.ORDER), default=0, help="number of poles; 0 = choose"
    )
    sub.add_argument(
        "--input",
        default=ENCODER,
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
        metavar="SAMPLES",
        help=f"of a held input, the longest delay tried; {_MAX_DELAY} if left out",
    )
    sub.add_argument(
        "--duration", type=number(quantities.DURATION), default=0.0, help="[s] to use; 0 = all"
    )
    sub.add_argument(
        "--settings", type=json_object, default={}, metavar="JSON", help="what it belongs to"
    )
    _declare_use(sub)
    add_trigger(sub)
    add_by_stamps(sub)
    sub.add_argument(
        "--report", type=Path, metavar="DIR", help="write the certificate, or the model's page"
    )
    declare_catalogue(sub)


def _declare_use(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--for",
        dest="scan",
        type=Path,
        metavar="SCAN",
        help="the scan that will be corrected, a bag or a plan as CSV time_s,z_m, from which the "
        "limits of the verdict follow; default: the paper's, 30 rpm over its mirror",
    )
    sub.add_argument(
        "--accuracy",
        type=number(quantities.UNCERTAINTY),
        help="of a height of that scan, k = 2, asked for [m]",
    )
    sub.add_argument(
        "--origin",
        type=json_object,
        default={},
        metavar="JSON",
        help="for the certificate: machine, probe, probe_serial_number, target, temperature_c, "
        "operator, laboratory, method",
    )


def _identify(args: argparse.Namespace) -> Facts:
    of_table = args.recording.suffix.lower() == TABLE_SUFFIX
    _check_arguments(args, of_table)
    if of_table:
        refuse_cell(args.recording, args)
        record = record_of_table(
            args.recording, args.input, args.output, args.period, args.duration
        )
        return _model_facts(record, args)
    with progress_bar("reading", args.json) as progress:
        motion = motion_of_bag(
            cell_of(args.recording, args),
            duration=args.duration,
            time_lapse=(args.settings or {}).get("time_lapse", 1.0),
            trigger=trigger_of(args),
            by_stamps=args.by_stamps,
            progress=progress,
        )
    if args.hold != BAND_LIMITED:
        return _model_facts(record_of_motion(motion), args)
    bag = cell_of(args.recording, args)
    identified = identify(
        motion,
        order=args.order,
        input=args.input,
        settings=settings_of_bag(bag, args.settings or {}),
        use=intended_use_of(args.scan, args.accuracy),
        origin=replace(
            from_json(Origin, args.origin, "origin"),
            recorded_ns=recorded_ns_of_bag(bag),
            software=f"omsm_ros {__version__}",
        ),
    )
    facts = calibration_facts(identified.calibration)
    path = output_path_for(args.out, facts["verdict"])
    save_calibration(path, identified.calibration)
    facts["calibration"] = str(path)
    facts["warnings"] = [
        *facts["warnings"],
        *_record_identification(args, identified.calibration, path),
    ]
    if args.report is not None:
        # Drawing takes a second to import; most commands do without.
        from omsm_ros.pipelines.identify import write_certificate

        page = write_certificate(args.report, identified, source=args.recording.name)
        facts["report"] = str(page)
    return facts


def _record_identification(
    args: argparse.Namespace, calibration: Calibration, path: Path
) -> list[str]:
    def keep() -> bool:
        from omsm_ros.pipelines.history import keep_calibration

        return keep_calibration(args.catalogue, calibration, path, args.recording)

    return record_in_catalogue(args.catalogue, keep)


def _check_arguments(args: argparse.Namespace, of_table: bool) -> None:
    if of_table:
        missing = [n for n in ("output", "period") if getattr(args, n) is None]
        if missing:
            raise ConfigurationError(
                f"a table needs --{' and --'.join(missing)}: the name of the column that follows "
                "the input, and the seconds from line to line"
            )
        _check_for_bags(args)
    elif args.output is not None or args.period is not None:
        raise ConfigurationError(
            f"--output and --period are for a table; {str(args.recording)!r} is no {TABLE_SUFFIX} "
            "file, and a bag knows both: leave them out"
        )

    if args.max_delay is not None and args.hold == BAND_LIMITED:
        raise ConfigurationError(
            "--max-delay is of a held input; give --hold zero-order or first-order, or leave it out"
        )
    if not of_table and args.hold != BAND_LIMITED and args.input != ENCODER:
        raise ConfigurationError(
            f"--hold takes the encoder of a bag as its input, not {shown(args.input)}; leave out "
            "--input, or --hold"
        )


def _check_for_bags(args: argparse.Namespace) -> None:
    """Raise ConfigurationError for what a table has not, and would be passed over."""
    stated = {
        "--by-stamps": args.by_stamps,
        "--counter-offset": args.counter_offset != 0,
        "--stamp-tolerance": args.stamp_tolerance != TWO_DRIVERS_S,
        "--settings": bool(args.settings),
        "--for": args.scan is not None,
        "--accuracy": args.accuracy is not None,
        "--origin": bool(args.origin),
    }
    if passed_over := [name for name, given in stated.items() if given]:
        raise ConfigurationError(
            f"{' and '.join(passed_over)} is for a bag; a table has no counters, stamps or "
            "settings: leave it out"
        )


def _model_facts(record: SampledRecord, args: argparse.Namespace) -> Facts:
    longest = _MAX_DELAY if args.max_delay is None else args.max_delay
    model = model_of(record, hold=args.hold, order=args.order, max_delay=longest)
    path = output_path_for(args.out, str(model.certificate["verdict"]))
    save_model(path, model)
    facts = {
        **model.certificate,
        "hold": model.hold,
        "valid_from": model.valid_from,
        "valid_up_to": model.valid_up_to,
        "model": str(path),
    }
    if args.report is not None:
        facts["report"] = _drawn(args.report, model, record, args.recording)
    return facts


def _drawn(out: Path, model: SampledModel, record: SampledRecord, source: Path) -> str:
    # Drawing takes a second to import; most commands do without.
    from omsm_ros.pipelines.identify import write_model_page

    run = run_of(model, record)
    return str(write_model_page(out, model, record, run, source=source.name))


def calibration_facts(calibration: Calibration) -> Facts:
    """Return what a calibration says in a few words."""
    certificate = calibration.certificate
    return {
        "id": calibration.id,
        "verdict": verdict_text(calibration),
        "reasons": [str(reason) for reason in certificate.reasons],
        "reservations": [str(reservation) for reservation in certificate.reservations],
        "warnings": [str(warning) for warning in certificate.warnings],
        "order": len(calibration.dynamics.denominator) - 1,
        "low_frequency_delay": calibration.dynamics.low_frequency_delay,
        "low_frequency_delay_uncertainty": calibration.low_frequency_delay_uncertainty,
        "static_gain": calibration.static_gain,
        "static_gain_uncertainty": certificate.static_gain.uncertainty,
        "valid_up_to": calibration.valid_up_to,
        "polarity": certificate.static_gain.polarity,
    }


_RISES = (
    "rises when Z rises: turn its sign where recordings come from (map, driver) and identify "
    "again, or correct with --polarity -1"
)


def _stated(facts: Facts, name: str, unit: str) -> str:
    spread = facts[f"{name}_uncertainty"]
    text = measured(facts[name], spread, unit, 6)
    return f"{text} ± unknown" if spread is None else f"{text} (k = 1)"


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
            ("lag of Z", _stated(facts, "low_frequency_delay", "s")),
            ("static gain", _stated(facts, "static_gain", "")),
            ("valid up to", quantity(facts["valid_up_to"], "Hz")),
        ]
        if facts["polarity"] == -1:
            rows.append(("distance", _RISES))
    for kind in ("reasons", "reservations", "warnings"):
        rows += [(kind.removesuffix("s"), text) for text in facts.get(kind, [])]
    rows.append(written([facts.get("calibration") or facts["model"]]))
    if "report" in facts:
        rows.append(("certificate", facts["report"]))
    table(rows)


def _declare_validate(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("model", type=Path, metavar="MODEL.json")
    sub.add_argument(
        "record", type=Path, metavar="RECORD.csv", help="another one, sampled as the model is"
    )
    sub.add_argument("--input", required=True, help="name of a column")
    sub.add_argument("--output", required=True, help="name of a column")
    sub.add_argument("--out", type=Path, metavar="RUN.csv", help="write what the model makes of it")
    sub.add_argument("--report", type=Path, metavar="DIR", help="write a page")


def _validate(args: argparse.Namespace) -> Facts:
    model = load_model(args.model)
    record = record_of_table(args.record, args.input, args.output, model.sample_period)
    run = run_of(model, record)
    facts: Facts = {
        "model_verdict": str(model.certificate.get("verdict", "")),
        "explained": run.explained,
        "residual_rms": run.rms,
        "samples": len(record.input),
    }
    with ExitStack() as both:  # neither stands where the other cannot be written
        if args.out is not None:
            stream = both.enter_context(atomic_file(args.out, "w"))
            stream.write(text_of_run(record, run))
            facts["run"] = str(args.out)
        if args.report is not None:
            facts["report"] = _drawn(args.report, model, record, args.record)
    return facts


def _show_validate(facts: Facts) -> None:
    rows = [
        ("model", facts["model_verdict"] or "not judged"),
        ("free run accounts for", f"{percent(facts['explained'], 4)} of the output"),
        ("residual, rms", f"{plain(facts['residual_rms'], 4)} in the units of the output"),
        ("samples", count(facts["samples"])),
    ]
    table([*rows, *((name, facts[name]) for name in ("run", "report") if name in facts)])


COMMANDS = (
    CliCommand("identify", _declare, _identify, _show, rejected),
    CliCommand("validate", _declare_validate, _validate, _show_validate),
)
