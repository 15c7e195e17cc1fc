"""The demonstration: what came of it, beside the truth."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import NOTHING_STATED
from omsm_ros.core.correction.surface_points import CLOUD_FIELDS
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.recursion import Recursion, past_motion
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import OmsmError, printable
from omsm_ros.jobs import measure as measurement
from omsm_ros.jobs import publish as publication
from omsm_ros.jobs.correct_bag import correct_bag
from omsm_ros.jobs.demonstration_plan import OVERVIEW, Demonstration
from omsm_ros.jobs.judge_scan import Judgement, with_sources
from omsm_ros.readable import quantity
from omsm_ros.report.common import response_figures, style
from omsm_ros.report.measurement.cloud_view import CloudView
from omsm_ros.report.measurement.figures import overview_figure
from omsm_ros.report.measurement.gallery import levelled, surface_figures
from omsm_ros.storage import bags
from omsm_ros.storage.calibration_file import load_calibration
from omsm_ros.storage.cloud_file import CloudFile
from omsm_ros.storage.files import (
    CLOUD,
    REPORT,
    SUMMARY,
    save_json,
)
from omsm_ros.twin.cell import Probe, Recording
from omsm_ros.twin.scenario import planned_test_of, scan_of
from omsm_ros.twin.true_response import TrueResponse
from omsm_ros.twin.truth import TruthComparison, departure_from_truth
from omsm_ros.units import PPM

# The step test begins at rest.
_REST_SAMPLES = 100
RESPONSE_FREQUENCIES_HZ = (0.5, 1.0, 1.5, 15.0)
TITLE = "Paraboloid mirror measured on the emulated cell"
_REGISTERING = measurement.Registering(("piston", "tip", "tilt"))


def conclude(plan: Demonstration) -> dict[str, Any]:
    """Correct the recorded bag offline, compare with the truth, write all results."""
    calibration = load_calibration(plan.calibration_file)
    options = with_sources(CorrectionOptions(), calibration, NOTHING_STATED, PAPER_MIRROR)
    done = correct_bag(
        plan.bag, calibration, plan.out / CLOUD, options=options, nominal=PAPER_MIRROR
    )
    cloud = CloudFile(plan.out / CLOUD).read()
    view = publication.view_of(cloud, plan.sample_period)
    if view is None:
        raise OmsmError(f"no point could be corrected: {done.account!r}; see {plan.out / 'log'}")
    recording = scan_of(plan.scenario, plan.disturbances)
    step_test = planned_test_of(plan.scenario, plan.disturbances)
    judgement = Judgement(options, out=plan.out, fitted=_REGISTERING.freedoms)
    summary = measurement.summarise(plan.bag, done, calibration, judgement)
    measurement.add_form(plan.out, summary, PAPER_MIRROR, _REGISTERING)
    summary["files"] |= {"report": REPORT, "overview": OVERVIEW}
    summary["files"] |= {"calibration": plan.calibration_file.name, "bag": plan.bag.name}
    summary |= truth_entries(recording, cloud)  # replaces the estimate of the error before
    summary["response"] = response_errors(calibration, true_response(step_test))
    live = live_points(plan.bag)
    summary["live_equals_offline"] = same_points(live, cloud)
    summary["live_points"] = len(live)
    index = cloud["sample"].astype(np.int64)
    figures = surface_figures(
        view,
        PAPER_MIRROR,
        true_height=recording.surface_height[index],
        true_error_left=(recording.probe_motion - recording.axes.z)[index] + view.dynamic_error,
    )
    figures |= calibration_figures(calibration, step_test)
    (plan.out / OVERVIEW).write_bytes(overview(view, calibration, true_response(step_test)))
    save_json(plan.out / SUMMARY, summary)
    surface = publication.map_of(view, PAPER_MIRROR, plan.out)
    publication.publish(plan.out, TITLE, summary, calibration, figures, surface)
    return summary


def truth_entries(recording: Recording, cloud: NDArray[np.void]) -> dict[str, Any]:
    """Return the entries of the summary that only the twin's truth can give; lengths in metres."""
    truth: TruthComparison = departure_from_truth(
        recording, cloud["sample"], cloud["height"], cloud["dynamic_error"].astype(np.float64)
    )
    probe = Probe()
    floor = float(np.hypot(probe.noise, probe.resolution / np.sqrt(12)))
    entries = asdict(truth)
    entries["surface_deviation"]["probe_noise_and_resolution"] = floor
    return entries


def true_response(recording: Recording) -> TrueResponse:
    """Return what an identification should have found."""
    if recording.truth is None:
        raise OmsmError("this recording comes without the truth behind it; record it on the twin")
    return recording.truth.response


def response_errors(calibration: Calibration, true: TrueResponse) -> list[dict[str, float]]:
    """Compare the identified with the true response: relative gain error [1], phase error [deg]."""
    frequency = np.array(RESPONSE_FREQUENCIES_HZ)
    ratio = calibration.dynamics.response(frequency) / true.response(frequency)
    gain, phase = np.abs(ratio) - 1, np.angle(ratio, deg=True)
    return [
        {"frequency": float(f), "gain_error": float(g), "phase_error_deg": float(p)}
        for f, g, p in zip(frequency, gain, phase, strict=True)
    ]


def overview(view: CloudView, calibration: Calibration, true: TrueResponse) -> bytes:
    """Draw one wide picture: map before in µm, after in nm, identified and true response."""
    raw, corrected = (levelled(view, h, PAPER_MIRROR) for h in (view.raw_height, view.height))
    figure = overview_figure(view.x, view.y, raw, corrected, calibration, true)
    return style.png(figure, dpi=120)


def live_points(bag: Path) -> NDArray[np.void]:
    """Return all points the corrector node published while ``bag`` was recorded, in order."""
    with bags.BagReader(bag) as reader:
        clouds = [points for _, points in reader.records(bags.POINTS_TOPIC)]
    return np.concatenate(clouds) if clouds else np.empty(0, np.dtype(list(CLOUD_FIELDS)))


def same_points(live: NDArray[np.void], stored: NDArray[np.void]) -> bool:
    """Return True if every field of every point is the same to the last bit."""
    return len(live) == len(stored) and all(
        live[name].tobytes() == stored[name].tobytes() for name, _ in CLOUD_FIELDS
    )


def calibration_figures(calibration: Calibration, step: Recording) -> dict[str, bytes]:
    """Draw a Bode plot against the truth, and what the model makes of the step test."""
    axes, period = step.axes, calibration.sample_period
    recursion = Recursion(discretise(calibration.dynamics, period))
    recursion.start(past_motion(axes.z[:_REST_SAMPLES]))
    edges = response_figures.step_response(
        np.arange(len(axes)) * period,
        axes.z,
        -step.distance.distance / calibration.static_gain,
        recursion.run(axes.z),
    )
    bode = response_figures.bode(calibration, true_response(step), period)
    return {"bode": style.png(bode), "step_response": style.png(edges)}


def table_of(plan: Demonstration, summary: dict[str, Any]) -> str:
    """Return the result for the terminal."""
    where = printable(os.path.relpath(plan.out))
    written = ", ".join(summary["files"].values())
    rows = [*sample_rows(summary), *_accuracy_rows(summary), ("written", f"{written} in {where}")]
    width = max(len(name) for name, _ in rows)
    body = "\n".join(f"  {name:<{width}}  {value}" for name, value in rows)
    return f"\n{TITLE}\n\n{body}\n"


def sample_rows(summary: dict[str, Any]) -> Iterable[tuple[str, str]]:
    """Yield names and texts of where the samples went."""
    for stream, account in summary["samples"].items():
        reasons = "".join(f", {n} {reason}" for reason, n in account["counted"].items() if n)
        value = f"{account['received']} received, {account['corrected']} corrected{reasons}"
        yield f"samples of {stream}", value
    yield "live cloud equals offline", _live_text(summary)


def _live_text(summary: dict[str, Any]) -> str:
    """Say whether the corrector did live what was done offline, and what to do if it could not."""
    if summary["live_equals_offline"]:
        return "to the last bit"
    left_out = summary["samples"]["distance"]["corrected"] - summary["live_points"]
    if left_out <= 0:
        return "NO"
    return (
        f"NO: {left_out} points were not made live, for this computer was too busy at that speed; "
        "give a smaller --time-lapse"
    )


def _accuracy_rows(summary: dict[str, Any]) -> Iterable[tuple[str, str]]:
    before, after = summary["dynamic_error_before"], summary["dynamic_error_after"]
    yield "dynamic error before", _spread(before)
    yield "  after correction", _spread(after)
    surface = summary["surface_deviation"]
    floor = quantity(surface["probe_noise_and_resolution"], "m")
    yield (
        "cloud from true surface",
        f"rms {quantity(surface['rms'], 'm')}; the probe alone has {floor}",
    )
    for row in summary["response"]:
        yield (
            f"G at {quantity(row['frequency'], 'Hz')}, off by",
            f"{quantity(row['gain_error'] / PPM, 'ppm', signed=True)}, "
            f"{quantity(row['phase_error_deg'], '°', signed=True)}",
        )


def _spread(spread: dict[str, float]) -> str:
    pv, rms = quantity(spread["peak_to_valley"], "m"), quantity(spread["rms"], "m")
    return f"{pv} PV, {rms} rms (by area)"
