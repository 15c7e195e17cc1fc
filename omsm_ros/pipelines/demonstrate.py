"""Run the demonstration on the digital twin and compare its results with the true values."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.adjustment import Adjustment
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource
from omsm_ros.core.correction.surface_points import CLOUD_FIELDS
from omsm_ros.core.correction.systematic import EVALUATED
from omsm_ros.core.surface.deviation import level
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import OmsmError, printable
from omsm_ros.instruments.emulator_factory import emulated
from omsm_ros.io import bags
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_disturbances
from omsm_ros.io.files import (
    CLOUD,
    DEVIATION,
    FORM,
    REPORT,
    SUMMARY,
    SYSTEMATIC,
    save_json,
    save_text,
)
from omsm_ros.io.results import CloudFile
from omsm_ros.messages import text_from
from omsm_ros.pipelines.adjust import (
    ADJUSTED_CLOUD,
    ADJUSTMENT,
    adjust_bags,
    adjustment_facts,
    write_adjustment,
)
from omsm_ros.pipelines.form import RegistrationOptions
from omsm_ros.pipelines.measure import measure
from omsm_ros.pipelines.publish import publish_scan
from omsm_ros.pipelines.record_bags import NOMINAL, write_nominal
from omsm_ros.readable import now_text, quantity
from omsm_ros.report.verdict import headline
from omsm_ros.twin.cell import Probe, compare_with_truth
from omsm_ros.twin.disturbances import Disturbances, TrueResponse
from omsm_ros.twin.part import FigureError
from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of, spiral_of, verifying
from omsm_ros.units import PPM

# Range of TCP ports for emulated devices on this host.
_FIRST_PORT, _PORTS = 20_000, 10_000
# The paper's spiral at the speed of emulated links. RS-422 at 691 200 baud with nine bytes a
# sample allows 7.6 times real time; with two devices one may lag behind.
_LAPSE, _RADIUS_M = 20.0, 12.7e-3
_SLOW_LAPSE, _SMALL_RADIUS_M = 3.0, 3e-3
SCAN_REPORT = "scan_report.html"
# Form deviation that a mirror of this kind may have, peak to valley.
TOLERANCE_M = 250e-9
_MARK = "made_by_omsm_demo.txt"
# Sizes of errors that two scans do not show; the twin has none of them.
_EVALUATED = {
    "encoder_scale": 1e-6,
    "squareness": 1e-8,
    "parallelism": 1e-6,
    "clocking": 1e-6,
    "pitch": 1e-6,
    "straightness_x": 2e-9,
    "straightness_z": 2e-9,
    "positioning_x": 2e-9,
    "expansion": 1e-7,
    "probe_slope_square": 1e-8,
    "drift_walk": 0.2e-9,
}
_LENGTHS = {
    "pitch": {"arm": 1e-3},
    "straightness_x": {"correlation_length": 0.01},
    "straightness_z": {"correlation_length": 1e-3},
}
_RESULTS = (
    CLOUD, SYSTEMATIC, FORM, DEVIATION, SUMMARY, REPORT, SCAN_REPORT,
    ADJUSTMENT, ADJUSTED_CLOUD,
)  # fmt: skip


@dataclass
class Demonstration:
    """Folder of the results and settings of the twin.

    time_lapse: speed of the cell relative to real time [1];  start_radius: of the spiral [m];
        None = as fast, and as large, as the device's link allows
    device: model of the emulated probe
    disturbance_file: errors of the machine, None for none
    view: show the scan in a browser

    The calibrator node writes ``calibration_file``, the recorder node ``bag`` and ``second_bag``:
    the second scan is from beyond the centre at twice the speed; ``nominal_file`` has the surface.
    """

    out: Path
    seed: int = 1
    time_lapse: float | None = None
    start_radius: float | None = None
    device: str = "six_channel"
    disturbance_file: Path | None = None
    view: bool = False
    sample_period: float = field(default=1e-3, init=False)

    def __post_init__(self) -> None:
        self.calibration_file = self.out / "calibration.json"
        self.bag, self.second_bag = self.out / "scan.mcap", self.out / "scan_outward.mcap"
        self.nominal_file = self.out / NOMINAL

    @cached_property
    def scenario(self) -> Scenario:
        """Scenario of the emulated cell."""
        return Scenario(seed=self.seed, start_radius=self.radius, sample_period=self.sample_period)

    @property
    def lapse(self) -> float:
        """Speed of the cell relative to real time [1]."""
        return self.time_lapse or (_SLOW_LAPSE if emulated(self.device).baud_rate else _LAPSE)

    @property
    def radius(self) -> float:
        """Start radius of the spiral [m]."""
        slow = emulated(self.device).baud_rate > 0
        return self.start_radius or (_SMALL_RADIUS_M if slow else _RADIUS_M)

    @cached_property
    def disturbances(self) -> Disturbances:
        """Errors of the emulated machine."""
        return load_disturbances(self.disturbance_file)

    @property
    def link(self) -> str:
        """Address of the emulated port."""
        if emulated(self.device).tcp:
            return _tcp_link()
        return str((self.out / "cell").absolute())

    @property
    def companion_link(self) -> str:
        """Address of the second device's emulated port; empty without one."""
        if (second := emulated(self.device).second) is None:
            return ""
        return _tcp_link() if second.tcp else f"{self.link}_beside"

    def samples(self) -> tuple[int, int, int]:
        """Return the number of samples of the step test and of both scans."""
        test = len(planned_test_of(self.scenario, self.disturbances).axes)
        scans = (spiral_of(one).duration for one in (self.scenario, verifying(self.scenario)))
        return (test, *(round(seconds / self.sample_period) for seconds in scans))

    def emulator_parameters(self) -> dict[str, object]:
        """Return ROS parameters of the emulator."""
        return {
            "device": self.device,
            "link_beside": self.companion_link,
            "time_lapse": self.lapse,
            "seed": self.seed,
            "start_radius": self.radius,
            "sample_period": self.sample_period,
            "disturbances": str(self.disturbance_file.absolute()) if self.disturbance_file else "",
        }

    def driver_parameters(self) -> dict[str, object]:
        """Return ROS parameters of the driver."""
        fixed = {"device": self.device, "port": self.link, "sample_period": self.sample_period}
        return fixed | emulated(self.device).driver

    def companion_parameters(self) -> tuple[str, dict[str, object]] | None:
        """Return the node that reads the second device, and its ROS parameters; None without."""
        if (second := emulated(self.device).second) is None:
            return None
        fixed = {"port": self.companion_link, "sample_period": self.sample_period}
        return second.node, fixed | second.driver

    def settings(self) -> dict[str, object]:
        """Return the settings of the calibration."""
        return {
            "machine": "digital twin of the paper's cell",
            "fixture": "twin",
            "probe_rate_hz": 1 / self.sample_period,
            "time_lapse": self.lapse,
            "seed": self.seed,
        }

    def prepare(self) -> None:
        """Make the folder without earlier results; OmsmError if it is not of a demonstration."""
        _ = self.disturbances  # report an unreadable file before removing anything
        mark = self.out / _MARK
        # Scan and calibration of a real machine have the same file names.
        if self.out.is_dir() and any(self.out.iterdir()) and not mark.is_file():
            raise OmsmError(
                f"{str(self.out)!r} holds files that are not from a demonstration; give a folder "
                "that is empty or does not exist yet"
            )
        save_text(mark, "The next demonstration replaces the files in this folder.\n")
        results = (self.out / name for name in _RESULTS)
        for path in (self.calibration_file, self.bag, self.second_bag, *results):
            if path.is_dir():
                raise OmsmError(f"{str(path)!r} is a folder and stands in the way; remove it")
            path.unlink(missing_ok=True)
        write_nominal(self.nominal_file)
        for log in (self.out / "log").glob("*.log"):
            log.unlink()


def _tcp_link() -> str:
    return f"tcp://127.0.0.1:{_FIRST_PORT + os.getpid() % _PORTS}"


RESPONSE_FREQUENCIES_HZ = (0.5, 1.0, 1.5, 15.0)
TITLE = "Paraboloid mirror measured on the emulated cell"
_REGISTERING = RegistrationOptions(("piston", "tip", "tilt"))


def finish_demonstration(plan: Demonstration) -> dict[str, Any]:
    """Correct the first scan offline, adjust both, compare with the truth, write all results."""
    calibration = load_calibration(plan.calibration_file)
    summary = measure(
        plan.bag, calibration, plan.out, nominal=PAPER_MIRROR, register=_REGISTERING, report=False
    )
    cloud = CloudFile(plan.out / CLOUD).read()
    if not len(cloud):
        raise OmsmError(
            f"no point could be corrected: {summary['samples']!r}; see {plan.out / 'log'}"
        )
    recording = scan_of(plan.scenario, plan.disturbances)
    step_test = planned_test_of(plan.scenario, plan.disturbances)
    summary["files"] |= {"scan_report": SCAN_REPORT}
    summary["files"] |= {"calibration": plan.calibration_file.name, "bag": plan.bag.name}
    # Replaces the estimated error by the true one.
    summary |= compare_with_truth(
        recording, cloud["sample"], cloud["height"], cloud["dynamic_error"].astype(np.float64)
    )
    probe, true = Probe(), step_test.truth.response
    floor = float(np.hypot(probe.noise, probe.resolution / np.sqrt(12)))
    summary["surface_deviation"]["probe_noise_and_resolution"] = floor
    summary["response"] = response_errors(calibration, true)
    live = live_points(plan.bag)
    summary["live_equals_offline"] = same_points(live, cloud)
    summary["live_points"] = len(live)
    publish_scan(plan.out, summary, calibration, PAPER_MIRROR, cloud, TITLE, true)
    (plan.out / REPORT).replace(plan.out / SCAN_REPORT)
    summary["adjustment"] = _adjusted(plan, calibration)
    summary["files"] |= {"report": REPORT, "adjustment": ADJUSTMENT, "adjusted": ADJUSTED_CLOUD}
    save_json(plan.out / SUMMARY, summary)
    return summary


def _adjusted(plan: Demonstration, calibration: Calibration) -> dict[str, Any]:
    """Adjust both scans together, and add the true form of the part to their page."""
    bags_of_part = [plan.bag, plan.second_bag]
    found, scans = adjust_bags(
        bags_of_part,
        calibration,
        nominal=PAPER_MIRROR,
        stated=twin_sources(),
        accuracy=TOLERANCE_M / 5,
    )
    facts = adjustment_facts(found, scans, calibration, TOLERANCE_M)
    facts["truth"] = form_truth(plan.scenario.part, found)
    write_adjustment(plan.out, facts, found, scans, TITLE)
    return {name: facts[name] for name in ("verdict", "figures", "conformity", "truth")}


def twin_sources() -> MachineSources:
    """Return the sources that two scans do not show; the twin is built without them."""
    why = {
        "how": EVALUATED,
        "reason": "the twin is built without this error",
        "evaluation": f"omsm demo, {now_text()}",
    }
    once = StatedSource(source="c_error", value=1e-6, **why, parameters={"per_turn": 1})
    known = _EVALUATED.items()
    return MachineSources((once, *(
        StatedSource(source=n, value=v, **why, parameters=_LENGTHS.get(n, {})) for n, v in known
    )))  # fmt: skip


def form_truth(part: FigureError, found: Adjustment) -> dict[str, float]:
    """Return the true PV and rms of the part, pose removed, and the error of the map (rms)."""
    form = found.form
    error = part.deviation(form.x, form.y)
    true, off = (
        level(form.x, form.y, values, tilt=True, weights=form.area)
        for values in (error, form.height - error)
    )
    return {
        "peak_to_valley": float(np.ptp(true)),
        "rms": float(np.sqrt(form.area @ true**2)),
        "map_error_rms": float(np.sqrt(form.area @ off**2)),
    }


def response_errors(calibration: Calibration, true: TrueResponse) -> list[dict[str, float]]:
    """Compare the identified with the true response: relative gain error [1], phase error [deg]."""
    frequency = np.array(RESPONSE_FREQUENCIES_HZ)
    ratio = calibration.dynamics.response(frequency) / true.response(frequency)
    gain, phase = np.abs(ratio) - 1, np.angle(ratio, deg=True)
    return [
        {"frequency": float(f), "gain_error": float(g), "phase_error_deg": float(p)}
        for f, g, p in zip(frequency, gain, phase, strict=True)
    ]


def live_points(bag: Path) -> NDArray[np.void]:
    """Return all points that the corrector node published into ``bag``, in order."""
    with bags.BagReader(bag) as reader:
        clouds = [points for _, points in reader.records(bags.POINTS_TOPIC)]
    return np.concatenate(clouds) if clouds else np.empty(0, np.dtype(list(CLOUD_FIELDS)))


def same_points(live: NDArray[np.void], stored: NDArray[np.void]) -> bool:
    """Return True if every field of every point is the same to the last bit."""
    return len(live) == len(stored) and all(
        live[name].tobytes() == stored[name].tobytes() for name, _ in CLOUD_FIELDS
    )


def table_of(plan: Demonstration, summary: dict[str, Any]) -> str:
    """Return the result as text for the terminal."""
    where = printable(os.path.relpath(plan.out))
    written = ", ".join(summary["files"].values())
    rows = [*sample_rows(summary), *_accuracy_rows(summary), ("written", f"{written} in {where}")]
    width = max(len(name) for name, _ in rows)
    body = "\n".join(f"  {name:<{width}}  {value}" for name, value in rows)
    return f"\n{TITLE}\n\n{body}\n"


def sample_rows(summary: dict[str, Any]) -> Iterable[tuple[str, str]]:
    """Yield rows of the account of the samples."""
    for stream, account in summary["samples"].items():
        reasons = "".join(f", {n} {reason}" for reason, n in account["counted"].items() if n)
        value = f"{account['received']} received, {account['corrected']} corrected{reasons}"
        yield f"samples of {stream}", value
    left_out = summary["samples"]["distance"]["corrected"] - summary["live_points"]
    late = (
        f": {left_out} points are missing live because this computer was too slow; give a "
        "smaller --time-lapse"
    )
    live = "to the last bit" if summary["live_equals_offline"] else "NO" + late * (left_out > 0)
    yield "live cloud equals offline", live


def _accuracy_rows(summary: dict[str, Any]) -> Iterable[tuple[str, str]]:
    spread = "{peak_to_valley:m} PV, {rms:m} rms (by area)"
    off = "rms {rms:m}, of which {probe_noise_and_resolution:m} from the probe's noise"
    yield from adjustment_rows(summary["adjustment"])
    yield "dynamic error before", text_from(spread, summary["dynamic_error_before"])
    yield "  after correction", text_from(spread, summary["dynamic_error_after"])
    yield "cloud minus true surface", text_from(off, summary["surface_deviation"])
    for row in summary["response"]:
        yield (
            f"error of G at {quantity(row['frequency'], 'Hz')}",
            f"{quantity(row['gain_error'] / PPM, 'ppm', signed=True)}, "
            f"{quantity(row['phase_error_deg'], '°', signed=True)}",
        )


def adjustment_rows(adjusted: dict[str, Any]) -> Iterable[tuple[str, str]]:
    """Yield names and texts of the verdict, and the truth of the twin."""
    yield "form of the part", headline(adjusted)
    yield "  verdict", adjusted["verdict"]["text"]
    for reason in adjusted["verdict"]["reasons"]:
        yield "", reason["text"]
    truth = "PV {peak_to_valley:m}; the map is off by {map_error_rms:m/2} rms"
    yield "  truth of the twin", text_from(truth, adjusted["truth"])
