"""The emulator's buttons: a motion is started, refused while another runs, and stopped."""

import pytest
from omsm_msgs.msg import AxisBlock
from std_srvs.srv import Trigger

from omsm_ros.nodes.topics import SAMPLES_QOS


def test_stop_ends_a_motion_and_another_may_start(cell):
    cell.start_emulator(time_lapse=1.0)
    started = cell.call(Trigger, "cell_emulator/scan")
    assert started.success
    assert started.message == "20000 samples"
    cell.wait("some of it", lambda: cell.operator.value("cell_emulator", "samples_played") > 500)
    refused = cell.call(Trigger, "cell_emulator/step_test")
    assert not refused.success
    assert "wait until it has ended" in refused.message

    stopped = cell.call(Trigger, "cell_emulator/stop")
    assert stopped.success
    played = int(stopped.message.removesuffix(" samples played"))
    assert 500 < played < 20_000
    cell.wait("rest", lambda: cell.operator.text("cell_emulator", "message") == "waiting")
    assert cell.settle("cell_emulator", "samples_played") == played

    again = cell.call(Trigger, "cell_emulator/step_test")
    assert again.success, again.message
    cell.wait("the next", lambda: "playing" in cell.operator.text("cell_emulator", "message"))


def test_stop_without_a_motion_does_no_harm(cell):
    cell.start_emulator()
    answer = cell.call(Trigger, "cell_emulator/stop")
    assert answer.success
    assert answer.message == "0 samples played"
    cell.processes.check()


@pytest.mark.soak
def test_the_file_of_disturbances_is_played(cell):
    """An encoder that reads one per cent too long, seen at the driver's end of the wire."""
    file = cell.folder / "disturbances.yaml"
    file.write_text("encoder: {scale_ppm: 10000}\n")
    cell.start_emulator(disturbances=str(file))
    cell.start_driver()
    blocks = []
    cell.operator.create_subscription(AxisBlock, "/omsm/axes", blocks.append, SAMPLES_QOS)
    cell.wait("the driver", lambda: cell.operator.value("confocal_driver", "connections") >= 1)
    cell.wait("us", lambda: cell.operator.value("confocal_driver", "axes_subscribers") >= 1)
    assert cell.call(Trigger, "cell_emulator/step_test").success
    cell.wait("all of it", lambda: sum(len(block.z) for block in blocks) >= 29_000)
    travel = max(max(block.z) for block in blocks) - min(min(block.z) for block in blocks)
    assert travel == pytest.approx(89.6e-6 * 1.01, abs=0.05e-6)


def test_a_file_of_disturbances_that_cannot_be_is_one_line(refused, tmp_path):
    file = tmp_path / "disturbances.yaml"
    file.write_text("probe: {latency: 1e-3}\n")
    line = refused("cell_emulator", "-p", f"disturbances:={file}")
    assert "disturbances.yaml" in line
    assert "'latency' is unknown" in line


def test_a_dark_reference_is_taken_where_the_probe_can(cell):
    from omsm_ros.instruments.emulator_factory import emulated

    cell.start_emulator(device="chrocodile")
    cell.start_driver(**({"device": "chrocodile"} | emulated("chrocodile").driver))
    cell.wait("the driver", lambda: cell.operator.value("confocal_driver", "connections") >= 1)
    answer = cell.call(Trigger, "confocal_driver/dark_reference")
    assert answer.success, answer.message
    assert "identify again" in answer.message
    assert cell.operator.value("confocal_driver", "connections") == 1


def test_a_probe_without_that_command_says_so(cell):
    cell.start_emulator()
    cell.start_driver()
    cell.wait("the driver", lambda: cell.operator.value("confocal_driver", "connections") >= 1)
    answer = cell.call(Trigger, "confocal_driver/dark_reference")
    assert not answer.success
    assert "takes no dark reference" in answer.message
