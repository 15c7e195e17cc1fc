"""Commands to identify a calibration or a sampled model, and to validate a model."""

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from omsm_ros import __version__
from omsm_ros.cli.arguments import (
    PART_ENTRIES,
    TABLE_SUFFIX,
    TRIGGER,
    Arguments,
    cell_of,
    json_object,
    refuse_cell,
    trigger_of,
)
from omsm_ros.cli.command import CliCommand, Facts, Rows, kept, output_path_for, rejected, written
from omsm_ros.core.calibration.calibration import FURTHER_AXES, Calibration
from omsm_ros.core.calibration.certificate import NOTE, Origin, from_json, of_severity
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse, use_of_motion
from omsm_ros.core.estimation.equivalent_time import fast_mode
from omsm_ros.core.estimation.parallel_sections import BAND_LIMITED, HOLDS
from omsm_ros.core.estimation.preparation import joined_recordings
from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.estimation.sampled_model import SampledModel, free_run
from omsm_ros.core.identification.best_linear import (
    best_linear_approximation,
    differing_lines,
    multisine_findings,
)
from omsm_ros.core.identification.identify import Identification, identify
from omsm_ros.core.identification.sampled_identification import identify_samples
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.core.streams.trigger_slips import TWO_DRIVERS_S
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.descriptions import load_multisine
from omsm_ros.io.files import atomic_file, result_folder, save_text
from omsm_ros.pipelines.history import keep_calibration, record_in_catalogue
from omsm_ros.pipelines.identify import load_model, record_of_table, save_model, write_certificate
from omsm_ros.pipelines.recording import Recording, scan_path_of
from omsm_ros.quantities import (
    DURATION,
    MAX_DELAY_SAMPLES,
    ORDER,
    SAMPLE_PERIOD,
    UNCERTAINTY,
    shown,
)
from omsm_ros.readable import count, now_text, percent, plain, quantity, standard
from omsm_ros.report.verdict import verdict_text

ENCODER, MODEL_PAGE = "encoder", "model.html"
_MAX_DELAY = 3


def _declare(add: Arguments) -> None:
    add.bags("recordings", nargs="+", metavar="RECORDING")
    add("--out", "CAL.json", required=True)
    add("--order", ORDER, "number of poles; 0 = choose", default=0)
    add("--input", str, default=ENCODER)
    add("--output", str, "of a table, the output column")
    add("--period", SAMPLE_PERIOD, "of a table, the sample period [s]")
    add("--hold", str, choices=HOLDS, default=BAND_LIMITED)
    add(
        "--max-delay",
        MAX_DELAY_SAMPLES,
        f"of a held input, the longest delay to try; default {_MAX_DELAY}",
        metavar="SAMPLES",
    )
    add("--duration", DURATION, "use the first seconds only [s]; 0 = all", default=0.0)
    add("--settings", json_object, default={}, metavar="JSON")
    add("--equivalent-time", None)
    add("--for", "SCAN", dest="scan")
    add("--accuracy", UNCERTAINTY)
    add.shared("--origin")
    add("--multisine", "BAG")
    add("--plan", "PLAN.json", "plan of the multisine, as 'omsm plan multisine' writes it")
    add.shared(*TRIGGER)
    add("--report", "DIR", "write the certificate, or the model's page")
    add.catalogue()


def _identify(args: argparse.Namespace) -> Facts:
    first = args.recordings[0]
    of_table = first.suffix.lower() == TABLE_SUFFIX
    _check_arguments(args, of_table)
    if of_table:
        return _of_tables(args)
    source, *further = args.input.split(",")
    stated = {name: value for name, value in args.origin.items() if name not in PART_ENTRIES}
    motions, settings, recorded = _motions(args, further)
    if args.hold != BAND_LIMITED:
        records = [
            SampledRecord(motion.z[:, np.newaxis], motion.distance, motion.ok) for motion in motions
        ]
        return _model_facts(records, motions[0].sample_period, args)
    identified = identify(
        joined_recordings(motions),
        order=args.order,
        input=source,
        settings=settings,
        use=_intended_use(args),
        origin=replace(
            from_json(Origin, stated, "origin"),
            recorded_ns=recorded,
            software=f"omsm_ros {__version__}",
        ),
    )
    facts = {}
    if args.multisine is not None:
        identified, facts = _with_multisine(identified, args)
    calibration = identified.calibration
    facts |= calibration_facts(calibration)
    path = kept(args.out, calibration)
    facts["calibration"] = str(path)
    if args.equivalent_time:
        mode = fast_mode(motions[0])
        facts["equivalent_time"] = {**asdict(mode), "finding": str(mode.finding)}
    facts["warnings"] = [
        *facts["warnings"],
        *record_in_catalogue(
            args.catalogue,
            lambda: keep_calibration(args.catalogue, calibration, path, first, recorded),
        ),
    ]
    if args.report is not None:
        page = write_certificate(args.report, identified, source=first.name)
        facts["report"] = str(page)
    return facts


def _intended_use(args: argparse.Namespace) -> IntendedUse:
    if args.scan is None:
        return replace(PAPER_USE, accuracy_m=args.accuracy)
    path = scan_path_of(args.scan)
    return use_of_motion(path.z, path.sample_period, args.accuracy)


def _with_multisine(
    identified: Identification, args: argparse.Namespace
) -> tuple[Identification, Facts]:
    """Return the identification with the findings of the multisine, and its lines."""
    plan = load_multisine(args.plan)
    with Recording(cell_of(args.multisine, args)) as recording:
        motion = recording.motion(trigger=trigger_of(args), by_stamps=args.by_stamps)
    found = best_linear_approximation(motion, plan)
    calibration = identified.calibration
    findings = multisine_findings(found, calibration, args.accuracy)
    judged = replace(calibration, certificate=calibration.certificate.judged(findings))
    differs, apart = differing_lines(found, calibration)
    facts = {
        "multisine": {
            "frequency": found.frequency.tolist(),
            "gain": np.abs(found.response).tolist(),
            "phase": np.angle(found.response).tolist(),
            "uncertainty": found.uncertainty.tolist(),
            "noise_m": found.noise.tolist(),
            "distortion_m": found.distortion.tolist(),
            "transient_m": found.transient.tolist(),
            "even_m": found.even[1].tolist(),
            "odd_m": found.odd[1].tolist(),
            "differs": differs.tolist(),
            "difference": apart.tolist(),
            "bands": found.bands(),
        }
    }
    return replace(identified, calibration=judged), facts


def _motions(
    args: argparse.Namespace, further: Sequence[str]
) -> tuple[list[MotionRecord], dict[str, object], int | None]:
    """Return the motion of each bag, the settings that they share, and when the last was recorded.

    further: axes besides Z
    """
    motions, stated, recorded = [], args.settings or {}, []
    for path in args.recordings:
        with Recording(cell_of(path, args)) as recording:
            motions.append(
                recording.motion(
                    duration=args.duration,
                    time_lapse=stated.get("time_lapse", 1.0),
                    trigger=trigger_of(args),
                    by_stamps=args.by_stamps,
                    further=further,
                )
            )
            if args.hold == BAND_LIMITED:
                stated = recording.settings(stated)
            recorded.append(recording.recorded_ns)
    known = [moment for moment in recorded if moment is not None]
    return motions, stated, max(known, default=None)


def _of_tables(args: argparse.Namespace) -> Facts:
    refuse_cell(args.recordings[0], args)
    inputs = args.input.split(",")
    records = [
        record_of_table(path, inputs, args.output, args.period, args.duration)
        for path in args.recordings
    ]
    return _model_facts(records, args.period, args)


def _check_arguments(args: argparse.Namespace, of_table: bool) -> None:
    if of_table:
        if args.output is None or args.period is None:
            raise ConfigurationError(
                "a table needs --output, its output column, and --period, its sample period in "
                "seconds; a log with time and units becomes a bag by 'omsm import'"
            )
        _check_for_bags(args)
    elif args.output is not None or args.period is not None:
        raise ConfigurationError(
            f"--output and --period are for a table; {str(args.recordings[0])!r} is not a "
            f"{TABLE_SUFFIX} file, and a bag states both: leave them out"
        )

    if (args.multisine is None) != (args.plan is None) or (
        args.plan is not None and (of_table or args.hold != BAND_LIMITED)
    ):
        raise ConfigurationError(
            "--multisine BAG and --plan PLAN.json go together, with a step test in a bag"
        )
    if args.max_delay is not None and args.hold == BAND_LIMITED:
        raise ConfigurationError(
            "--max-delay is for a held input; give --hold zero-order or first-order, or leave it "
            "out"
        )
    if of_table:
        return
    if args.hold != BAND_LIMITED and args.input != ENCODER:
        raise ConfigurationError(
            f"--hold takes the encoder of a bag as its input, not {shown(args.input)}; leave out "
            "--input, or --hold"
        )
    names = args.input.split(",")[1:]
    if len({*names}) < len(names) or not {*names} <= {*FURTHER_AXES}:
        raise ConfigurationError(
            f"--input names the axes {shown(','.join(names))} besides Z, expected each of "
            f"{', '.join(FURTHER_AXES)} once at most"
        )


def _check_for_bags(args: argparse.Namespace) -> None:
    """Raise ConfigurationError for options that have no effect on a table."""
    stated = {
        "--by-stamps": args.by_stamps,
        "--counter-offset": args.counter_offset != 0,
        "--stamp-tolerance": args.stamp_tolerance != TWO_DRIVERS_S,
        "--settings": bool(args.settings),
        "--for": args.scan is not None,
        "--accuracy": args.accuracy is not None,
        "--origin": bool(args.origin),
    }
    if unused := [name for name, given in stated.items() if given]:
        raise ConfigurationError(
            f"{' and '.join(unused)} is for a bag; a table has no counters, stamps or settings: "
            "leave it out"
        )


def _model_facts(
    records: Sequence[SampledRecord], period: float, args: argparse.Namespace
) -> Facts:
    longest = _MAX_DELAY if args.max_delay is None else args.max_delay
    model = identify_samples(records, period, hold=args.hold, order=args.order, max_delay=longest)
    path = output_path_for(args.out, str(model.certificate["verdict"]))
    save_model(path, model)
    facts = {
        **model.certificate,
        "hold": model.sections.hold,
        "valid": [list(range) for range in model.valid],
        "model": str(path),
    }
    if args.report is not None:
        facts["report"] = _drawn(args.report, model, records[0], args.recordings[0])
    return facts


def _drawn(out: Path, model: SampledModel, record: SampledRecord, source: Path) -> str:
    # Imported on demand, because loading the figures takes a second.
    from omsm_ros.report.certificate.figures import model_figures_of
    from omsm_ros.report.certificate.page import render_model
    from omsm_ros.report.page_parts import Issue

    run = free_run(model, record.inputs, record.output, record.used)
    figures = model_figures_of(model, record.inputs, record.output, run)
    issue = Issue(date=now_text(), source=source.name, version=__version__, figures=figures)
    with result_folder(out, (MODEL_PAGE,)) as folder:
        save_text(folder / MODEL_PAGE, render_model(model, run, issue))
    return str(out / MODEL_PAGE)


def calibration_facts(calibration: Calibration) -> Facts:
    """Return the main results of a calibration."""
    certificate = calibration.certificate
    return {
        "id": calibration.id,
        "verdict": verdict_text(calibration),
        "reasons": [str(reason) for reason in certificate.reasons],
        "reservations": [str(reservation) for reservation in certificate.reservations],
        "warnings": [str(warning) for warning in certificate.warnings],
        "notes": [str(note) for note in of_severity(certificate.findings, NOTE)],
        "order": len(calibration.dynamics.denominator) - 1,
        "low_frequency_delay": calibration.dynamics.low_frequency_delay,
        "low_frequency_delay_uncertainty": calibration.low_frequency_delay_uncertainty,
        "static_gain": calibration.static_gain,
        "static_gain_uncertainty": certificate.static_gain.uncertainty,
        "valid_up_to": calibration.valid_up_to,
        "further_axes": {
            name: {
                "gain": float(numerator[0]),
                "gain_uncertainty": calibration.further_gain_u(name),
            }
            for name, numerator in calibration.further.items()
        },
        "polarity": certificate.static_gain.polarity,
    }


_RISES = (
    "increases with Z: invert its sign in the map or driver and identify again, or correct with "
    "--polarity -1"
)


def _show(facts: Facts) -> Rows:
    rows = [("verdict", facts["verdict"]), ("order", str(facts["order"]))]
    if "model" in facts:
        rows += [
            ("hold", facts["hold"]),
            ("fit", f"{percent(facts['explained'], 4)} of the fitted samples"),
            ("validation", f"{percent(facts['predicted'], 4)} of held-out samples, simulated"),
            *(
                ("valid from", " to ".join(quantity(end, "Hz") for end in ends))
                for ends in facts["valid"]
            ),
        ]
    else:
        lag, gain = (
            standard(facts[name], facts[f"{name}_uncertainty"], unit, 6)
            for name, unit in (("low_frequency_delay", "s"), ("static_gain", ""))
        )
        rows += [
            ("lag of Z", lag),
            ("static gain", gain),
            ("valid up to", quantity(facts["valid_up_to"], "Hz")),
        ]
        for name, found in facts["further_axes"].items():
            text = standard(found["gain"], found["gain_uncertainty"], "", 6)
            rows.append((f"gain of {name.upper()}", text))
        if facts["polarity"] == -1:
            rows.append(("distance", _RISES))
    if "equivalent_time" in facts:
        rows.append(("edges", facts["equivalent_time"]["finding"]))
    for kind in ("reasons", "reservations", "warnings", "notes"):
        rows += [(kind.removesuffix("s"), text) for text in facts.get(kind, [])]
    rows.append(written([facts.get("calibration") or facts["model"]]))
    if "report" in facts:
        rows.append(("certificate", facts["report"]))
    return rows


def _declare_validate(add: Arguments) -> None:
    add("model", "MODEL.json")
    add("record", "RECORD.csv", "another record of the same sample period")
    add("--input", str, "input columns, A or A,B,C", required=True)
    add("--output", str, "output column", required=True)
    add("--out", "RUN.csv", "write the simulated output")
    add("--report", "DIR", "write a report")


def _validate(args: argparse.Namespace) -> Facts:
    model = load_model(args.model)
    inputs = args.input.split(",")
    record = record_of_table(args.record, inputs, args.output, model.sections.period)
    run = free_run(model, record.inputs, record.output, record.used)
    facts: Facts = {
        "model_verdict": str(model.certificate.get("verdict", "")),
        "explained": run.explained,
        "residual_rms": run.rms,
        "samples": len(record),
    }
    with ExitStack() as both:  # if one output cannot be written, neither is kept
        if args.out is not None:
            stream = both.enter_context(atomic_file(args.out, "w"))
            time = model.sections.period * np.arange(len(record))
            names = [f"input_{i}" for i in range(1, 1 + len(inputs))] if inputs[1:] else ["input"]
            head = ",".join(["time_s", *names, "output", "model"])
            rows = np.column_stack([time, record.inputs, record.output, run.output])
            np.savetxt(stream, rows, "%.12g", ",", header=head, comments="")
            facts["run"] = str(args.out)
        if args.report is not None:
            facts["report"] = _drawn(args.report, model, record, args.record)
    return facts


def _show_validate(facts: Facts) -> Rows:
    rows = [
        ("model", facts["model_verdict"] or "no verdict"),
        ("simulation fit", f"{percent(facts['explained'], 4)} of the output"),
        ("residual, rms", f"{plain(facts['residual_rms'], 4)} in units of the output"),
        ("samples", count(facts["samples"])),
    ]
    return [*rows, *((name, facts[name]) for name in ("run", "report") if name in facts)]


COMMANDS = (
    CliCommand("identify", _declare, _identify, _show, rejected),
    CliCommand("validate", _declare_validate, _validate, _show_validate),
)
