"""The main job in small, and what may go wrong on the wire."""

import json
import signal
from functools import partial

import numpy as np
import pytest
from omsm_msgs.srv import Identify, LoadCalibration, PredictError
from plain_method import plain_height
from soaked import soaked
from std_srvs.srv import Trigger

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.errors import DeviceTimeoutError
from omsm_ros.io import bags
from omsm_ros.io.calibration_file import load_calibration, save_calibration
from omsm_ros.nodes.cell_demo_node import demo_stage, perform
from omsm_ros.pipelines import demonstrate as demonstration
from omsm_ros.readable import quantity


def account(cell, stream):
    """Return the corrector's counts of a stream: received, corrected, pending, others."""
    status = cell.operator._status["corrector"]
    counts = {
        key.removeprefix(f"{stream}_"): int(value)
        for key, value in status.items()
        if key.startswith(f"{stream}_")
    }
    # These never reached a correction.
    for reason in ("uncalibrated", "refused"):
        counts.pop(reason)
    return counts


OTHERS = ("chrocodile", "chrocodile_packet", "confocaldt", "confocaldt_ethernet", "capancdt")


def assert_plain_method_agrees(plan):
    """The live cloud of the bag is that of the paper's method in plain numpy, to 0.1 nm rms."""
    live = demonstration.live_points(plan.bag)
    axes, distance = {}, {}
    with bags.BagReader(plan.bag) as bag:
        for topic, found in ((bags.AXES_TOPIC, axes), (bags.DISTANCE_TOPIC, distance)):
            for _, block in bag.records(topic):
                values = block.z if topic == bags.AXES_TOPIC else block.distance
                found.update(zip(range(block.first_sample, block.end), values, strict=True))
    count = sorted(axes)
    assert count == list(range(count[0], count[-1] + 1))
    z = np.array([axes[k] for k in count])
    d = np.array([distance.get(k, np.nan) for k in count])
    stored = json.loads(plan.calibration_file.read_text())
    height = plain_height(stored, plan.sample_period, z, d)
    off = height[live["sample"] - count[0]] - live["height"]
    assert len(off) > 19_900
    assert np.std(off) < 0.1e-9
    assert abs(np.mean(off)) < 1e-9


PROCESSES = pytest.param("six_channel", id="processes", marks=pytest.mark.soak)


@pytest.mark.parametrize("device", ["six_channel", PROCESSES, *soaked(*OTHERS)])
def test_calibrate_scan_correct_and_replay(cell, device):
    plan = demonstration.Demonstration(
        cell.folder / "demo",
        seed=2,
        time_lapse=3.0 if device == "confocaldt" else 20.0,
        start_radius=1e-3,
        device=device,
    )
    plan.prepare()
    perform(cell.operator, cell.processes, plan, partial(demo_stage, quiet=True))
    summary = demonstration.finish_demonstration(plan)

    for stream in ("axes", "distance"):
        samples = summary["samples"][stream]
        assert samples["received"] == 20_000
        assert samples["corrected"] + sum(samples["counted"].values()) == 20_000
        assert samples["corrected"] > 19_900
    assert summary["live_equals_offline"]
    assert_plain_method_agrees(plan)
    deviation = summary["surface_deviation"]
    assert deviation["rms"] <= 1.1 * deviation["probe_noise_and_resolution"]
    for row in summary["response"]:
        limit = 0.02 if row["frequency"] > 2 else 0.002
        assert abs(row["phase_error_deg"]) < limit
        if row["frequency"] < 2:
            assert abs(row["gain_error"]) < 20e-6
    page = (plan.out / "scan_report.html").read_text()
    assert page.count("data:image/png;base64,") >= 8
    adjusted = summary["adjustment"]
    figure, truth = adjusted["figures"]["peak_to_valley"], adjusted["truth"]["peak_to_valley"]
    assert abs(figure["value"] - truth) < 3 * figure["standard_uncertainty"] + 5e-9
    head = f"truth of the twin: PV {quantity(truth, 'm').split()[0]}"  # its space does not break
    assert head in (plan.out / "report.html").read_text().replace("\N{NO-BREAK SPACE}", " ")


def reconnected(cell):
    cell.wait("the port again", lambda: cell.operator.value("confocal_driver", "connections") >= 2)


def start_scan_of_new_emulator(cell):
    """A killed node's service lingers in discovery, and may swallow the request."""
    for _ in range(10):
        try:
            assert cell.operator.ask(
                Trigger, "/omsm/cell_emulator/scan", Trigger.Request(), patience=3.0
            ).success
        except DeviceTimeoutError:
            if not cell.operator.text("cell_emulator", "message").startswith("playing"):
                continue
        return
    pytest.fail("the new emulator never answered")


@pytest.mark.soak
def test_killed_and_restarted_emulator(cell, true_calibration):
    # Slow enough that the scan outlasts the kill on a busy computer.
    cell.start_correcting(true_calibration, time_lapse=3.0)
    assert cell.call(Trigger, "cell_emulator/scan").success
    cell.wait("half a scan", lambda: cell.operator.value("corrector", "axes_received") > 5000)
    cell.processes.end("cell_emulator", how=signal.SIGKILL)
    before = cell.settle("corrector", "axes_received")
    assert before < 20_000
    # It plays no longer, whatever it said last.
    cell.operator.forget("cell_emulator")

    cell.start_emulator()
    reconnected(cell)
    start_scan_of_new_emulator(cell)
    cell.wait(
        "the whole second scan",
        lambda: cell.operator.value("corrector", "axes_received") >= before + 20_000,
    )
    delivered = cell.settle("confocal_driver", "delivered")
    cell.processes.check()
    for stream in ("axes", "distance"):
        cell.wait(
            "all that was delivered",
            lambda stream=stream: (
                cell.operator.value("corrector", f"{stream}_received") == delivered
            ),
        )
        counts = account(cell, stream)
        assert counts.pop("received") == delivered == before + 20_000
        assert counts["corrected"] > delivered - 200
        assert sum(counts.values()) == delivered


@pytest.mark.soak
def test_noise_on_the_wire(cell, true_calibration):
    cell.start_correcting(true_calibration, fault_noise=0.01, fault_flip=0.01, fault_drop=0.01)
    assert cell.call(Trigger, "cell_emulator/scan").success
    cell.wait(
        "the noisy scan", lambda: cell.operator.value("cell_emulator", "samples_played") >= 20_000
    )
    delivered = cell.settle("confocal_driver", "delivered")
    lost = cell.operator.value("confocal_driver", "lost")
    cell.processes.check()
    # One frame in fifty was dropped or damaged; all others came through, none twice.
    assert delivered + lost == pytest.approx(20_000, abs=3)
    assert 200 < lost < 800
    for stream in ("axes", "distance"):
        cell.wait(
            "all that was delivered",
            lambda stream=stream: (
                cell.operator.value("corrector", f"{stream}_received") == delivered
            ),
        )
        counts = account(cell, stream)
        assert counts.pop("received") == delivered
        assert sum(counts.values()) == delivered


def test_corrector_without_calibration_counts_and_waits(cell, true_calibration):
    cell.start_emulator()
    cell.start_driver()
    cell.processes.start("corrector")
    cell.wait(
        "the driver",
        lambda: (
            cell.operator.value("confocal_driver", "axes_subscribers") >= 1
            and cell.operator.value("confocal_driver", "confocal_subscribers") >= 1
            # Samples before the driver has opened the port are lost.
            and cell.operator.value("confocal_driver", "connections") >= 1
        ),
    )
    assert cell.call(Trigger, "cell_emulator/step_test").success
    cell.wait("samples", lambda: cell.operator.value("corrector", "axes_uncalibrated") == 29_000)
    assert cell.operator.value("corrector", "clouds_published") == 0
    assert "no calibration" in cell.operator.text("corrector", "message")

    answer = cell.call(PredictError, "corrector/predict_error", z=[0.0, 1e-6], sample_period=1e-3)
    assert not answer.safe
    assert np.isnan([answer.peak_to_valley, answer.rms, answer.outside_band_fraction]).all()
    assert "no calibration" in answer.message

    text = cell.folder / "notes.txt"
    text.write_text("not a calibration")
    answer = cell.call(LoadCalibration, "corrector/load_calibration", path=str(text))
    assert not answer.success
    assert "notes.txt" in answer.message
    good = cell.folder / "good.json"
    save_calibration(good, true_calibration)
    answer = cell.call(LoadCalibration, "corrector/load_calibration", path=str(good))
    assert answer.success
    assert answer.id == true_calibration.id


def test_calibrator_answers_bad_requests_and_stays(cell):
    output = cell.folder / "cal.json"
    cell.processes.start("calibrator", output=str(output))
    answer = cell.call(Identify, "calibrator/identify")
    assert not answer.success
    assert answer.message
    answer = cell.call(Identify, "calibrator/identify", bag="/no/such/bag")
    assert not answer.success
    assert "/no/such/bag" in answer.message
    assert not output.exists()
    cell.processes.check()


@pytest.mark.soak
def test_calibrator_identifies_from_a_bag(cell, tmp_path, step_test):
    from omsm_ros.io import bags
    from omsm_ros.io.bag_writer import BagWriter
    from omsm_ros.twin.cell import blocks_of

    bag = tmp_path / "steps.mcap"
    with BagWriter(bag, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in blocks_of(step_test):
            writer.write_block(axes)
            writer.write_block(distance)
    output = tmp_path / "cal.json"
    cell.processes.start("calibrator", output=str(output))
    answer = cell.call(Identify, "calibrator/identify", bag=str(bag), order=2)
    assert answer.success, answer.message
    loaded = load_calibration(output)
    assert isinstance(loaded, Calibration)
    assert loaded.id == answer.calibration.id
    assert len(loaded.dynamics.denominator) == 3
