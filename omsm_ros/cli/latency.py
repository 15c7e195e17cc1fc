"""Commands that split a lag into structural dynamics and latency: selfcal, reversal, latency."""

import argparse
from dataclasses import replace
from typing import Any

from omsm_ros.cli.arguments import Arguments, cell_of, json_object
from omsm_ros.cli.command import CliCommand, Facts, Rows, kept, rejected, written
from omsm_ros.core.adjustment.resolved_calibration import (
    after_step_test,
    from_scans_alone,
    resolved,
    reversal,
    undetermined,
    unit_calibration,
    without_step_test,
)
from omsm_ros.core.adjustment.self_calibration import (
    DEFAULT_CLOCKING_RAD,
    DEFAULT_HARMONICS,
    UNINFORMATIVE_GAIN,
    self_calibrate,
)
from omsm_ros.core.calibration.calibration import Calibration, excess_latency_text, with_latency
from omsm_ros.core.calibration.latency import declared_latency, latency_summary
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.pipelines.adjust import read_scan
from omsm_ros.pipelines.recording import Recording
from omsm_ros.pipelines.study_scans import UNCORRECTED_LAG
from omsm_ros.quantities import (
    ANGLE_UNCERTAINTY,
    GAIN,
    GAIN_UNCERTAINTY,
    HARMONICS,
    LAG,
    TIME_UNCERTAINTY,
)
from omsm_ros.readable import percent, quantity, standard
from omsm_ros.report.verdict import verdict_text
from omsm_ros.units import RPM_RAD_S


def _declare_selfcal(add: Arguments) -> None:
    add.bags("scans", nargs="+", metavar="SCAN", help="two or more scans of one part")
    add("--calibration", "STEP.json", "calibration from a step test")
    add("--out", "CAL.json", required=True)
    add("--harmonics", HARMONICS, default=DEFAULT_HARMONICS)
    add("--clocking", ANGLE_UNCERTAINTY, default=DEFAULT_CLOCKING_RAD)
    add.shared("--polarity")
    add("--static-gain", GAIN, "static gain of the probe, used without a step test", default=1.0)
    add("--gain-uncertainty", GAIN_UNCERTAINTY, default=UNINFORMATIVE_GAIN)
    add("--settings", json_object, default={}, metavar="JSON")


def _selfcal(args: argparse.Namespace) -> Facts:
    step_test = load_calibration(args.calibration) if args.calibration else None
    bags = [cell_of(path, args) for path in args.scans]
    with Recording(bags[0]) as first:
        period = first.sample_period()
    base = step_test or unit_calibration(period, args.static_gain)
    how = replace(UNCORRECTED_LAG, polarity=args.polarity)
    scans = [read_scan(bag, base, how) for bag in bags]
    prior = after_step_test(base) if step_test else without_step_test(args.gain_uncertainty)
    prior = replace(prior, clocking=args.clocking)
    found = self_calibrate([scan.data for scan in scans], prior, args.harmonics)
    made = (
        resolved(step_test, found)
        if step_test
        else from_scans_alone(found, period, args.static_gain, args.settings)
    )
    path = kept(args.out, made)
    return {
        **_resolved_facts(made),
        "residual": found.residual,
        "left_on_this_surface": found.followed,
        "disagreement": found.agreement.disagreement,
        "unidentifiable": [*map(str, undetermined(found))],
        "speeds_rpm": [speed / RPM_RAD_S for speed in found.speeds],
        "samples": [scan.account.as_dict() for scan in scans],
        "calibration": str(path),
    }


def _resolved_facts(calibration: Calibration) -> dict[str, Any]:
    certificate = calibration.certificate
    return {
        "id": calibration.id,
        "verdict": verdict_text(calibration),
        "reasons": [str(reason) for reason in certificate.reasons],
        "lag": calibration.dynamics.low_frequency_delay,
        "lag_uncertainty": certificate.response.low_frequency_delay_uncertainty_s,
        "latency": latency_summary(calibration.latency),
        "valid_up_to": calibration.valid_up_to,
    }


def _show_selfcal(facts: Facts) -> Rows:
    return [
        ("verdict", facts["verdict"]),
        *(("reason", text) for text in facts["reasons"]),
        ("scans", ", ".join(f"{speed:.1f} rpm" for speed in facts["speeds_rpm"])),
        ("lag of Z", standard(facts["lag"], facts["lag_uncertainty"], "s")),
        *_latency_rows(facts["latency"]),
        ("valid up to", quantity(facts["valid_up_to"], "Hz")),
        ("residual error", f"{quantity(facts['left_on_this_surface'], 'm')} rms on this "
                           "surface (k = 1)"),
        ("scans differ by", f"{quantity(facts['disagreement'], 'm')} rms beyond noise"),
        *(("not identifiable", text) for text in facts["unidentifiable"]),
        written([facts["calibration"]]),
    ]  # fmt: skip


def _latency_rows(latency: Facts) -> Rows:
    share = latency["share"]
    return [
        ("probe latency", standard(latency["delay_s"], latency["uncertainty_s"], "s")),
        ("share of the lag", "unknown" if share is None else percent(share, 3)),
        ("source", f"{latency['source']}: {latency['reason']}"),
    ]


def _declare_reversal(add: Arguments) -> None:
    add.bags("clockwise", "counterclockwise")
    add("--calibration", "CAL.json", required=True)
    add("--out", "CAL.json", "write the calibration with the latency")


def _reversal(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    paths = args.clockwise, args.counterclockwise
    scans = [read_scan(cell_of(path, args), calibration, UNCORRECTED_LAG) for path in paths]
    found = reversal([scan.data for scan in scans], calibration)
    facts = {
        name: getattr(found, name)
        for name in ("lag", "uncertainty", "lag_of_z", "residual", "used", "latency")
    }
    facts["points"] = sum(scan.account.axes.corrected for scan in scans)
    facts["samples"] = [scan.account.as_dict() for scan in scans]
    if args.out:
        facts["calibration"] = str(kept(args.out, found.calibration))
    return facts


_MEANINGS = {
    True: "the lag is latency of the probe: X and C must be delayed, too",
    False: "the lag is mechanical: it affects Z only",
    None: "undecided: the lag is neither zero nor that of Z",
}


def _show_reversal(facts: Facts) -> Rows:
    return [
        ("probe latency", standard(facts["lag"], facts["uncertainty"], "s")),
        ("lag of Z", quantity(facts["lag_of_z"], "s", 4)),
        ("meaning", _MEANINGS[facts["latency"]]),
        ("residual", f"{quantity(facts['residual'], 'm')} rms"),
        ("points", f"{facts['points']} corrected, {facts['used']} of them fitted"),
        written([facts.get("calibration", "nowhere; give --out to use it")]),
    ]


def _declare_latency(add: Arguments) -> None:
    add("calibration", "CAL.json")
    add("--delay", LAG, "latency of the probe [s]", required=True)
    add("--uncertainty", TIME_UNCERTAINTY, "its standard uncertainty, k = 1 [s]", required=True)
    add("--reason", str, "source of these figures", required=True)
    add("--out", "CAL.json", required=True)


def _latency(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    lag = calibration.dynamics.low_frequency_delay
    if (wrong := excess_latency_text(calibration, args.delay, args.uncertainty)) is not None:
        raise ConfigurationError(wrong.code, **wrong.values)
    latency = declared_latency(lag, args.delay, args.uncertainty, args.reason)
    made = with_latency(calibration, latency)
    path = kept(args.out, made)
    return {**_resolved_facts(made), "calibration": str(path)}


def _show_latency(facts: Facts) -> Rows:
    return [
        ("lag of Z", standard(facts["lag"], facts["lag_uncertainty"], "s")),
        *_latency_rows(facts["latency"]),
        written([facts["calibration"]]),
    ]


COMMANDS = (
    CliCommand("selfcal", _declare_selfcal, _selfcal, _show_selfcal, rejected),
    CliCommand("reversal", _declare_reversal, _reversal, _show_reversal),
    CliCommand("latency", _declare_latency, _latency, _show_latency, rejected),
)
