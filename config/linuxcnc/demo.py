"""Measure the twin's mirror on LinuxCNC: home, step test, two scans from G-code, adjustment, truth.

    python demo.py OUT [RADIUS_M]

LinuxCNC's planner moves, in real time; servo, structure, encoder, probe and part are the twin's.
"""

import json
import socket
import sys
from pathlib import Path

from behind import behind, judge
from start import missing, running

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.trajectories import (
    PLANNED_COUNT,
    PLANNED_DWELL_S,
    PLANNED_STEP_M,
    SECOND_SHARE,
    plan_steps,
)
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.io.files import save_text
from omsm_ros.io.gcode_file import steps_gcode
from omsm_ros.pipelines import demonstrate, plan_scans
from omsm_ros.pipelines.adjust import adjust_bags, adjustment_facts, write_adjustment
from omsm_ros.pipelines.record_bags import NOMINAL, record_device, write_nominal
from omsm_ros.readable import quantity
from omsm_ros.twin.cell import Cell
from omsm_ros.twin.scenario import Scenario

TITLE = "Paraboloid mirror measured on LinuxCNC"
CYCLE_S, FEED_M, RPM = 1e-3, 2e-4, 30.0
START_S = 20.0


def run(program, out, cycle=CYCLE_S):
    """Run a program; write the commanded axes of each servo cycle into the bag ``out``."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with running(Path(program).read_text(), port, cycle) as process:

        def ended(samples, silent):
            over = process.poll() is not None or not samples
            return over and silent > (1.0 if samples else START_S)

        given = {"device": "linuxcnc", "port": f"tcp://127.0.0.1:{port}", "sample_period": cycle}
        return record_device(given, Path(out), ended)


def steps(out, seed):
    """Run the step test; return calibration, recording and counts of the driver."""
    plan = plan_steps(
        sample_period=CYCLE_S,
        second_step=SECOND_SHARE * PLANNED_STEP_M,
        count=PLANNED_COUNT,
        dwell=PLANNED_DWELL_S,
    )
    save_text(out / "steps.nc", steps_gcode(plan))
    print(f"step test, {plan.duration:.0f} s", flush=True)
    counts = run(out / "steps.nc", out / "steps_command.mcap")
    recording = behind(out / "steps_command.mcap", out / "steps.mcap", Cell(seed=seed), Flat())
    settings = {"machine": "LinuxCNC, digital twin behind it", "probe_rate_hz": 1 / CYCLE_S}
    calibration = identify(recording.motion_record(), settings=settings).calibration
    save_calibration(out / "calibration.json", calibration)
    return calibration, recording, counts


def demo(out, radius, seed=1):
    """Return the facts of the whole demonstration."""
    part = Scenario(seed=seed).part
    calibration, recording, counts = steps(out, seed)
    write_nominal(out / NOMINAL)
    designs = (
        ScanDesign(rpm=RPM, start=radius, end=0.0, pitch=FEED_M),
        ScanDesign(rpm=2 * RPM, start=0.0, end=radius, pitch=FEED_M),
    )
    paths = plan_scans.write_scans(designs, PAPER_MIRROR, out, plan_scans.PATH_ERROR_M, CYCLE_S)
    driver, judged = [counts], []
    for k, (design, path) in enumerate(zip(designs, paths, strict=True)):
        print(f"scan {k + 1} at {design.rpm:g} rpm, {path.time[-1]:.0f} s", flush=True)
        name = out / f"scan_{k + 1}"
        command = out / f"scan_{k + 1}_command.mcap"
        driver.append(run(name.with_suffix(".nc"), command))
        behind(command, name.with_suffix(".mcap"), Cell(seed=seed + 1 + k), part, 0.0)
        judged.append(judge(name.with_suffix(".csv"), command, path.error))
    found, read = adjust_bags(
        [out / "scan_1.mcap", out / "scan_2.mcap"],
        calibration,
        nominal=PAPER_MIRROR,
        stated=demonstrate.twin_sources(),
        accuracy=demonstrate.TOLERANCE_M / 5,
    )
    facts = adjustment_facts(found, read, calibration, demonstrate.TOLERANCE_M)
    facts["truth"] = demonstrate.form_truth(part, found)
    write_adjustment(out, facts, found, read, TITLE)
    return {
        "driver": driver,
        "lag": calibration.dynamics.low_frequency_delay,
        "true_lag": recording.truth.response.plant_dynamics.low_frequency_delay,
        "paths": judged,
        "adjustment": {n: facts[n] for n in ("verdict", "figures", "conformity", "truth")},
    }


def rows(facts):
    """Return names and texts of the results."""
    cycles, lost = (sum(d.get(n, 0) for d in facts["driver"]) for n in ("samples", "lost"))
    yield "servo cycles", f"{cycles} recorded, {lost} lost"
    true = quantity(facts["true_lag"], "s")
    yield "lag of Z", f"{quantity(facts['lag'], 's')}, true {true}"
    for k, path in enumerate(facts["paths"]):
        kept = "kept" if path["within"] else "EXCEEDED"
        yield (
            f"path of scan {k + 1}",
            f"Z {quantity(path['error'], 'm')} off the plan, bound {kept}",
        )
    yield from demonstrate.adjustment_rows(facts["adjustment"])


def main(out, radius="0.0127"):
    """Run and print the demonstration."""
    if reason := missing():
        sys.exit(f"{reason}\nAs root it then runs as the user nobody; nothing else is needed.")
    folder = Path(out)
    if folder.is_dir() and any(folder.iterdir()):
        sys.exit(f"{out!r} holds files; remove them, or give a folder that does not exist yet")
    facts = demo(folder, float(radius))
    (folder / "summary.json").write_text(json.dumps(facts, indent=1))
    for name, value in rows(facts):
        print(f"{name:<20}  {value}")
    print(f"{'written':<20}  report.html in {out}")


if __name__ == "__main__":
    main(*sys.argv[1:])
