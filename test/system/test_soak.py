"""Half an hour at 1 kHz in real time: nothing is lost, memory stays where it is."""

import os
from pathlib import Path

import pytest
from std_srvs.srv import Trigger

from omsm_ros.storage.calibration_file import save_calibration

pytestmark = [pytest.mark.soak, pytest.mark.timeout(0)]

# Slow feed: 900 turns at 30 rpm are half an hour.
MINUTES = float(os.environ.get("OMSM_SOAK_MINUTES", "30"))
START_RADIUS_M = 9e-3
FEED_PER_TURN_M = START_RADIUS_M / (30 * MINUTES)


def resident_bytes(pid):
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def test_half_an_hour(cell, true_calibration):
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.start_emulator(time_lapse=1.0, start_radius=START_RADIUS_M, feed_per_turn=FEED_PER_TURN_M)
    cell.start_driver()
    cell.processes.start("corrector", calibration=str(path))
    value = cell.operator.value
    cell.wait(
        "the nodes",
        lambda: (
            value("confocal_driver", "axes_subscribers") >= 1
            and value("confocal_driver", "confocal_subscribers") >= 1
        ),
    )
    assert cell.call(Trigger, "cell_emulator/scan").success
    samples = round(MINUTES * 60_000)
    watched = ("confocal_driver", "corrector")

    def follow(count):
        cell.operator.wait_until(
            f"{count} samples",
            lambda: value("corrector", "distance_received") >= count,
            lambda: value("corrector", "distance_received"),
        )

    follow(samples // 6)
    before = {name: resident_bytes(cell.processes.pid(name)) for name in watched}
    follow(samples)
    after = {name: resident_bytes(cell.processes.pid(name)) for name in watched}
    growth = {name: after[name] / before[name] - 1 for name in watched}
    print(f"memory growth {growth}, of {before}")
    assert value("confocal_driver", "lost") == 0
    for stream in ("axes", "distance"):
        received = value("corrector", f"{stream}_received")
        assert received == samples
        counted = value("corrector", f"{stream}_corrected") + value(
            "corrector", f"{stream}_settling"
        )
        assert counted == samples
    assert max(growth.values()) < 0.01, growth
