"""The emulator's buttons: a motion is started, refused while another runs, and stopped."""

import pytest
from std_srvs.srv import Trigger

pytestmark = pytest.mark.timeout(120)


def test_stop_ends_a_motion_and_another_may_start(cell):
    cell.start_emulator(time_lapse=1.0)
    started = cell.call(Trigger, "cell_emulator/scan")
    assert started.success
    assert started.message == "20000 samples"
    cell.wait("some of it", lambda: cell.operator.value("cell_emulator", "samples_played") > 500)
    refused = cell.call(Trigger, "cell_emulator/step_test")
    assert not refused.success
    assert "stop it first" in refused.message

    stopped = cell.call(Trigger, "cell_emulator/stop")
    assert stopped.success
    played = int(stopped.message.removesuffix(" samples played"))
    assert 500 < played < 20_000
    cell.wait("rest", lambda: cell.operator.text("cell_emulator", "message") == "waiting")
    assert cell.settle("cell_emulator", "samples_played") == played

    again = cell.call(Trigger, "cell_emulator/step_test")
    assert again.success, again.message
    cell.wait("the next", lambda: cell.operator.text("cell_emulator", "message") == "playing")


def test_stop_without_a_motion_does_no_harm(cell):
    cell.start_emulator()
    answer = cell.call(Trigger, "cell_emulator/stop")
    assert answer.success
    assert answer.message == "0 samples played"
    cell.processes.check()
