"""Commands for calibrations: verify, compare, calset."""

import argparse
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from omsm_ros.cli.arguments import TRIGGER, Arguments, cell_of, number, trigger_of
from omsm_ros.cli.command import CliCommand, Facts, Rows, kept, rejected, say, say_lines, written
from omsm_ros.core.calibration.calibration_set import calibration_set
from omsm_ros.core.calibration.repeatability import (
    CalibrationChange,
    Repeatability,
    Spread,
    compare_calibrations,
    repeatability,
)
from omsm_ros.errors import CalibrationError, ConfigurationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.pipelines.verify_calibration import established_offset, path_check_of
from omsm_ros.quantities import POSITION, TABLE_ANGLE, shown
from omsm_ros.readable import measured, p_value_text, plain, quantity
from omsm_ros.report.verdict import verdict_text
from omsm_ros.units import DEGREE_RAD, PPM


def _declare_verify(add: Arguments) -> None:
    add.bags("bag", help="bag of a free path (chirp) on a fixed target")
    add("--calibration", "CAL.json", required=True)
    add.shared(*TRIGGER)
    add("--find-offset", None, "determine the counter offset from the motion, for --counter-offset")


def _verify(args: argparse.Namespace) -> Facts:
    calibration, bag = load_calibration(args.calibration), cell_of(args.bag, args)
    trigger, established = trigger_of(args), None
    if args.find_offset:
        established = established_offset(bag, calibration)
        trigger = replace(trigger, counter_offset=established.samples)
    check = path_check_of(bag, calibration, trigger, args.by_stamps)
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


def _declare_compare(add: Arguments) -> None:
    add("old", "OLD.json")
    add("new", "NEW.json")
    add("more", "MORE.json", nargs="*", default=[])


def _compare(args: argparse.Namespace) -> Facts:
    calibrations = [load_calibration(path) for path in (args.old, args.new, *args.more)]
    if len(calibrations) > 2:
        found = repeatability(calibrations)
        arrays = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in asdict(found).items()
        }
        return arrays | {"text": repeatability_text(found)}
    change = compare_calibrations(*calibrations)
    return asdict(change) | {"text": change_text(change)}


def change_text(change: CalibrationChange) -> str:
    """Return in one line what changed between two calibrations."""
    return (
        f"{'changed' if change.changed else 'no significant change'}: "
        f"lag by {quantity(change.delay, 's', signed=True)} "
        f"({change.delay_sigmas:.1f} sigma), static gain by "
        f"{quantity(change.static_gain / PPM, 'ppm', signed=True)} "
        f"({change.static_gain_sigmas:.1f} sigma), {p_value_text(change.p_value)}"
    )


def repeatability_text(found: Repeatability) -> str:
    """Return in one line whether calibrations scatter more than they state."""
    verdict = "as repeatable as stated" if found.repeatable else "scatter more than they state"
    lag, gain = found.delay, found.static_gain
    return (
        f"{found.count} calibrations {verdict} ({p_value_text(found.p_value)}): "
        f"lag {measured(lag.mean, lag.deviation, 's')}{_of_stated(lag)}, "
        f"static gain {measured(gain.mean, gain.deviation, digits=6)}{_of_stated(gain)}"
    )


def _of_stated(spread: Spread) -> str:
    return f" ({plain(spread.ratio)} of stated)" if spread.stated else ""


_PLACED = re.compile(r"(?P<path>.+)@(?P<axis>[xzb])=(?P<position>[^@=]+)")


def _placed(text: str) -> tuple[Path, str, float]:
    """Parse CAL.json@x=0.01 into path, axis and position of a calibration."""
    found = _PLACED.fullmatch(text)
    if found is None:
        raise ConfigurationError(
            f"{shown(text)} states no position, expected such as CAL.json@x=0.01 (x, z or b)"
        )
    kind = TABLE_ANGLE if found["axis"] == "b" else POSITION
    return Path(found["path"]), found["axis"], number(kind)(found["position"])


def _declare_calset(add: Arguments) -> None:
    add("placed", _placed, nargs="+", metavar="CAL.json@x=POSITION")
    add("--out", "SET.json", required=True)


def _calset(args: argparse.Namespace) -> Facts:
    axes = sorted({axis for _, axis, _ in args.placed})
    if len(axes) > 1:
        raise CalibrationError(f"a set along {' and '.join(axes)}, expected one axis; make two")
    placed = [(position, load_calibration(path)) for path, _, position in args.placed]
    made = calibration_set(axes[0], placed)
    path = kept(args.out, made)
    return {
        "along": made.along,
        "positions": list(made.positions),
        "lags": [member.dynamics.low_frequency_delay for member in made.members],
        "valid_up_to": made.valid_up_to,
        "verdict": verdict_text(made),
        "reasons": [str(reason) for reason in made.certificate.reasons],
        "calibration": str(path),
    }


def _show_calset(facts: Facts) -> Rows:
    unit = "rad" if facts["along"] == "b" else "m"
    return [
        *(
            (f"at {facts['along']} = {quantity(place, unit)}", f"lag {quantity(lag, 's', 4)}")
            for place, lag in zip(facts["positions"], facts["lags"], strict=True)
        ),
        ("valid up to", quantity(facts["valid_up_to"], "Hz")),
        ("verdict", facts["verdict"] or "none"),
        written([facts["calibration"]]),
    ]


COMMANDS = (
    CliCommand("verify", _declare_verify, _verify, _show_verify),
    CliCommand("compare", _declare_compare, _compare, lambda facts: say_lines(facts["text"])),
    CliCommand("calset", _declare_calset, _calset, _show_calset, rejected),
)
