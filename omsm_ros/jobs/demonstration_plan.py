"""The demonstration: where its results go, how the twin is set, what each node is told."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from omsm_ros.emulators.players import emulated
from omsm_ros.errors import OmsmError
from omsm_ros.jobs.record_twin import NOMINAL, write_nominal
from omsm_ros.storage.disturbance_file import load_disturbances
from omsm_ros.storage.files import (
    CLOUD,
    DEVIATION,
    FORM,
    REPORT,
    SUMMARY,
    SYSTEMATIC,
    save_text,
)
from omsm_ros.twin.disturbances import NOTHING, Disturbances
from omsm_ros.twin.scenario import Scenario, planned_test_of, spiral_of

# Where an emulated device has to be on TCP: one of these ports of this machine.
_FIRST_PORT, _PORTS = 20_000, 10_000
# The paper's spiral, as fast as emulated lines carry it; nine bytes a sample over RS-422 at
# 691 200 baud are 7.6 times faster than real at most, and of two devices one may lag behind.
_LAPSE, _RADIUS_M = 20.0, 12.7e-3
_SLOW_LAPSE, _SMALL_RADIUS_M = 3.0, 3e-3
OVERVIEW = "overview.png"
_MARK = "made_by_omsm_demo.txt"
_RESULTS = (CLOUD, SYSTEMATIC, FORM, DEVIATION, SUMMARY, REPORT, OVERVIEW)


@dataclass(frozen=True)
class Demonstration:
    """Where the results go, and how the twin is set.

    time_lapse: how much faster than real time the cell plays [1];  start_radius: [m]
        None = as fast, and as large, as the device's line allows
    device: what the emulated probe speaks
    disturbance_file: what is wrong with the machine, None for nothing
    view: whether a browser may look on
    """

    out: Path
    seed: int = 1
    time_lapse: float | None = None
    start_radius: float | None = None
    device: str = "six_channel"
    disturbance_file: Path | None = None
    view: bool = False
    sample_period: float = field(default=1e-3, init=False)

    @cached_property
    def scenario(self) -> Scenario:
        """What the emulated cell does."""
        return Scenario(seed=self.seed, start_radius=self.radius, sample_period=self.sample_period)

    @property
    def lapse(self) -> float:
        """How much faster than real time the cell plays [1]."""
        slow = emulated(self.device).baud_rate > 0
        return self.time_lapse or (_SLOW_LAPSE if slow else _LAPSE)

    @property
    def radius(self) -> float:
        """Of the start of the spiral [m]."""
        slow = emulated(self.device).baud_rate > 0
        return self.start_radius or (_SMALL_RADIUS_M if slow else _RADIUS_M)

    @cached_property
    def disturbances(self) -> Disturbances:
        """What is wrong with the machine."""
        return load_disturbances(self.disturbance_file) if self.disturbance_file else NOTHING

    @property
    def calibration_file(self) -> Path:
        """Written by the calibrator node."""
        return self.out / "calibration.json"

    @property
    def bag(self) -> Path:
        """Written by the recorder node."""
        return self.out / "scan.mcap"

    @property
    def link(self) -> str:
        """The emulated port."""
        if emulated(self.device).tcp:
            return _tcp_link()
        return str((self.out / "cell").absolute())

    @property
    def link_beside(self) -> str:
        """The emulated port of the second device; empty without one."""
        if (beside := emulated(self.device).beside) is None:
            return ""
        return _tcp_link() if beside.tcp else f"{self.link}_beside"

    @property
    def step_test_samples(self) -> int:
        """Samples of the step test."""
        return len(planned_test_of(self.scenario, self.disturbances).axes)

    @property
    def scan_samples(self) -> int:
        """Samples of the scan."""
        return round(spiral_of(self.scenario).duration / self.sample_period)

    def emulator_parameters(self) -> dict[str, object]:
        """Return ROS parameters of the emulator."""
        return {
            "device": self.device,
            "link_beside": self.link_beside,
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

    def beside_parameters(self) -> tuple[str, dict[str, object]] | None:
        """Return the node that reads the second device, and its ROS parameters; None without."""
        if (beside := emulated(self.device).beside) is None:
            return None
        fixed = {"port": self.link_beside, "sample_period": self.sample_period}
        return beside.node, fixed | beside.driver

    def settings(self) -> dict[str, object]:
        """Return what the calibration will belong to."""
        return {
            "machine": "digital twin of the paper's cell",
            "fixture": "twin",
            "probe_rate_hz": 1 / self.sample_period,
            "time_lapse": self.lapse,
            "seed": self.seed,
        }

    @property
    def nominal_file(self) -> Path:
        """What the mirror should be."""
        return self.out / NOMINAL

    def prepare(self) -> None:
        """Make the folder and clear it of an earlier run's results.

        OmsmError if it holds anything, and is not the folder of a demonstration.
        """
        _ = self.disturbances  # a file that cannot be read is reported before anything is cleared
        mark = self.out / _MARK
        # A scan and a calibration of a real machine have the same names.
        if self.out.is_dir() and any(self.out.iterdir()) and not mark.is_file():
            raise OmsmError(
                f"{str(self.out)!r} holds files that no demonstration made; give a folder that is "
                "empty or does not exist yet"
            )
        save_text(mark, "Whatever is in this folder, the next demonstration replaces.\n")
        stale = (self.calibration_file, self.bag, *(self.out / name for name in _RESULTS))
        for path in stale:
            if path.is_dir():
                raise OmsmError(f"{str(path)!r} is a folder and stands in the way; remove it")
            path.unlink(missing_ok=True)
        write_nominal(self.nominal_file)
        for log in (self.out / "log").glob("*.log"):
            log.unlink()


def _tcp_link() -> str:
    return f"tcp://127.0.0.1:{_FIRST_PORT + os.getpid() % _PORTS}"
