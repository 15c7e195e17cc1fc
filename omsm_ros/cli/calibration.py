"""Commands for calibrations: verify, compare, calset."""

from __future__ import annotations

import argparse
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from omsm_ros import quantities
from omsm_ros.cli.arguments import add_bags, add_by_stamps, add_trigger, cell_of, number, trigger_of
from omsm_ros.cli.command import (
    CliCommand,
    Facts,
    output_path_for,
    progress_bar,
    rejected,
    say,
    say_lines,
    table,
    written,
)
from omsm_ros.core.calibration.calibration_set import calibration_set
from omsm_ros.core.calibration.repeatability import (
    Repeatability,
    compare_calibrations,
    repeatability,
)
from omsm_ros.errors import CalibrationError
from omsm_ros.io.calibration_file import load_calibration, save_calibration
from omsm_ros.pipelines.verify_calibration import established_offset, path_check_of
from omsm_ros.readable import quantity
from omsm_ros.report.verdict import verdict_text
from omsm_ros.units import DEGREE_RAD


def _declare_verify(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "bag", help="bag of a free path (chirp) on a fixed target")
    sub.add_argument("--calibration", type=Path, required=True, metavar="CAL.json")
    add_trigger(sub)
    add_by_stamps(sub)
    sub.add_argument(
        "--find-offset",
        action="store_true",
        help="determine the counter offset from the motion, for --counter-offset",
    )


def _verify(args: argparse.Namespace) -> Facts:
    calibration, bag = load_calibration(args.calibration), cell_of(args.bag, args)
    trigger, established = trigger_of(args), None
    with progress_bar("reading", args.json) as progress:
        if args.find_offset:
            established = established_offset(bag, calibration, progress)
            trigger = replace(trigger, counter_offset=established.samples)
        check = path_check_of(bag, calibration, progress, trigger, args.by_stamps)
    bands = [
        {
            "from": low,
            "to": high,
            "error_before": _rms(check.error_before[inside]),
            "error_after": _rms(check.error_after[inside]),
            "lag_before": float(np.mean(check.lag_before[inside])),
            "lag_after": float(np.mean(check.lag_after[inside])),
        }
        for low, high in check.excited
        if np.any(inside := (check.frequency >= low) & (check.frequency < high))
    ]
    facts: Facts = {"rms_before": check.rms_before, "rms_after": check.rms_after, "bands": bands}
    return facts | ({"counter_offset": asdict(established)} if established else {})


def _rms(values: np.ndarray) -> float:  # type: ignore[type-arg]
    return float(np.sqrt(np.mean(values**2)))


def _show_verify(facts: Facts) -> None:
    if offset := facts.get("counter_offset"):
        say(
            f"counter offset {offset['samples']} samples; remaining fraction "
            f"{offset['fraction']:.3f} ± {offset['uncertainty']:.3f} (k = 1)"
        )
    say("     Hz", *(f"{w:>12}" for w in ("error before", "after", "lag before", "after")))
    for band in facts["bands"]:
        errors = (quantity(band[f"error_{w}"], "m") for w in ("before", "after"))
        lags = (quantity(band[f"lag_{w}"] / DEGREE_RAD, "°") for w in ("before", "after"))
        say(f"{band['from']:3.0f}-{band['to']:<3.0f}", *(f"{x:>12}" for x in (*errors, *lags)))
    say("rms    ", *(f"{quantity(facts[f'rms_{w}'], 'm'):>12}" for w in ("before", "after")))


def _declare_compare(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("old", type=Path, metavar="OLD.json")
    sub.add_argument("new", type=Path, metavar="NEW.json")
    sub.add_argument(
        "more",
        type=Path,
        nargs="*",
        metavar="MORE.json",
        help="three or more: test whether they repeat within their uncertainties",
    )


def _compare(args: argparse.Namespace) -> Facts:
    calibrations = [load_calibration(path) for path in (args.old, args.new, *args.more)]
    if len(calibrations) > 2:
        return _repeatability_facts(repeatability(calibrations))
    change = compare_calibrations(*calibrations)
    return asdict(change) | {"text": change.text()}


def _repeatability_facts(found: Repeatability) -> Facts:
    arrays = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in asdict(found).items()
    }
    return arrays | {"text": found.text()}


_PLACED = re.compile(r"(?P<path>.+)@(?P<axis>[xzb])=(?P<position>[^@=]+)")


def _placed(text: str) -> tuple[Path, str, float]:
    """Parse CAL.json@x=0.01 into path, axis and position of a calibration."""
    found = _PLACED.fullmatch(text)
    if found is None:
        raise argparse.ArgumentTypeError(
            f"{quantities.shown(text)} states no position, expected such as CAL.json@x=0.01 "
            "(x, z or b)"
        )
    kind = quantities.TABLE_ANGLE if found["axis"] == "b" else quantities.POSITION
    return Path(found["path"]), found["axis"], number(kind)(found["position"])


def _declare_calset(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "placed", type=_placed, nargs="+", metavar="CAL.json@x=POSITION",
        help="calibrations and their positions: x or z in metres, b in radians",
    )  # fmt: skip
    sub.add_argument("--out", type=Path, required=True, metavar="SET.json")


def _calset(args: argparse.Namespace) -> Facts:
    axes = sorted({axis for _, axis, _ in args.placed})
    if len(axes) > 1:
        raise CalibrationError(f"a set along {' and '.join(axes)}, expected one axis; make two")
    placed = [(position, load_calibration(path)) for path, _, position in args.placed]
    made = calibration_set(axes[0], placed)
    path = output_path_for(args.out, made.certificate.verdict or "")
    save_calibration(path, made)
    return {
        "along": made.along,
        "positions": list(made.positions),
        "lags": [member.dynamics.low_frequency_delay for member in made.members],
        "valid_up_to": made.valid_up_to,
        "verdict": verdict_text(made),
        "reasons": [str(reason) for reason in made.certificate.reasons],
        "calibration": str(path),
    }


def _show_calset(facts: Facts) -> None:
    unit = "rad" if facts["along"] == "b" else "m"
    table(
        [
            *(
                (f"at {facts['along']} = {quantity(place, unit)}", f"lag {quantity(lag, 's', 4)}")
                for place, lag in zip(facts["positions"], facts["lags"], strict=True)
            ),
            ("valid up to", quantity(facts["valid_up_to"], "Hz")),
            ("verdict", facts["verdict"] or "none"),
            written([facts["calibration"]]),
        ]
    )


COMMANDS = (
    CliCommand("verify", _declare_verify, _verify, _show_verify),
    CliCommand("compare", _declare_compare, _compare, lambda facts: say_lines(facts["text"])),
    CliCommand("calset", _declare_calset, _calset, _show_calset, rejected),
)
