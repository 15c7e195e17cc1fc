"""Nodes that are stopped for seconds and continued, as a busy machine or a debugger does it."""

import itertools
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import rclpy
from std_srvs.srv import Trigger
from system.test_soak import longest_delay_s

# As every command of a node begins; "hear" or "send".
PROCESS = """
import sys
from omsm_ros.nodes import memory, start
memory.use_single_malloc_arena()
start.set_up_fast_dds()
import rclpy
from omsm_ros.nodes.topics import SAMPLES_QOS
from rclpy.duration import Duration
from std_msgs.msg import String
from system.test_soak import held_bytes

rclpy.init()
node = rclpy.create_node(sys.argv[1])
if sys.argv[1] == "hear":
    node.create_subscription(String, "much", lambda message: None, SAMPLES_QOS)
    rclpy.spin(node)
publisher = node.create_publisher(String, "much", SAMPLES_QOS)
while not publisher.get_subscription_count():
    rclpy.spin_once(node, timeout_sec=0.1)
print("heard", flush=True)
for line in sys.stdin:
    for _ in range(int(line)):
        publisher.publish(String(data="x" * 12_000))
    print("published", flush=True)
    sys.stdin.readline()
    assert publisher.wait_for_all_acked(Duration(seconds=20))
    memory.return_free_memory()
    print(held_bytes("self"), flush=True)
"""

STOPS, STOP_S, PAUSE_S = 60, 2.0, 3.0
WORK_S = 2.0  # what a node needs on a busy computer, to take two seconds of messages and its own


def queues_in_shared_memory(pid):
    """Numbers of the queues in shared memory that a process has locked for itself, to hear by."""
    found = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        try:
            found |= set(re.findall(r"fastrtps_port(\d+)_el$", os.readlink(entry)))
        except OSError:  # closed meanwhile
            continue
    return found


def test_nodes_do_not_hear_through_shared_memory_unless_requested(cell, monkeypatch):
    assert queues_in_shared_memory(os.getpid())  # as a process does that is none of ours
    cell.start_emulator()
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "DEFAULT")
    cell.start_driver()
    for node in ("cell_emulator", "confocal_driver"):
        cell.wait(node, lambda n=node: cell.operator.text(n, "lifecycle") == "active")
    assert not queues_in_shared_memory(cell.processes.pid("cell_emulator"))
    assert queues_in_shared_memory(cell.processes.pid("confocal_driver"))


def test_what_waited_for_a_stopped_listener_is_freed(monkeypatch):
    for name in ("RMW_FASTRTPS_PUBLICATION_MODE", "RMW_FASTRTPS_USE_QOS_FROM_XML"):
        monkeypatch.delenv(name, raising=False)
    with ExitStack() as undo:
        hearing, sending = (undo.enter_context(_process(role)) for role in ("hear", "send"))

        def held_after(messages):
            os.kill(hearing.pid, signal.SIGSTOP)
            print(messages, file=sending.stdin, flush=True)
            assert sending.stdout.readline() == "published\n"
            os.kill(hearing.pid, signal.SIGCONT)
            print(file=sending.stdin, flush=True)
            return int(sending.stdout.readline())

        assert sending.stdout.readline() == "heard\n"
        usual = held_after(10)
        assert held_after(300) - usual < 1e6  # they are 3.6 MB


@contextmanager
def _process(role):
    command = [sys.executable, "-c", PROCESS, role]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(command, **pipes, env=os.environ | {"PYTHONPATH": path}) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def busy():
    """A loop for each processor."""
    loops = [multiprocessing.Process(target=_turn, daemon=True) for _ in range(os.cpu_count())]
    for loop in loops:
        loop.start()
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.join()


def _turn():
    while True:
        pass


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_clouds_come_as_late_as_a_node_was_stopped(cell, true_calibration):
    radius = 9e-3
    minutes = STOPS * (STOP_S + PAUSE_S) / 60
    cell.start_correcting(
        true_calibration,
        time_lapse=1.0,
        start_radius=radius,
        feed_per_turn=radius / (30 * (minutes + 1)),
    )
    bag = cell.folder / "scan.mcap"
    cell.processes.start("recorder", path=str(bag))
    cell.wait("the recorder", lambda: cell.operator.text("recorder", "lifecycle") == "active")
    assert cell.call(Trigger, "cell_emulator/scan").success
    nodes = itertools.cycle(("recorder", "corrector", "recorder", "confocal_driver"))
    with busy():
        for node in itertools.islice(nodes, STOPS):
            let_pass(cell, PAUSE_S)
            os.kill(cell.processes.pid(node), signal.SIGSTOP)
            let_pass(cell, STOP_S)
            os.kill(cell.processes.pid(node), signal.SIGCONT)
        let_pass(cell, PAUSE_S)
    cell.processes.end("recorder")
    delay = longest_delay_s(bag)
    print(f"{STOPS} stops of {STOP_S} s: clouds came after at most {delay:.1f} s")
    assert delay < STOP_S + WORK_S


def let_pass(cell, seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(cell.operator, timeout_sec=0.1)
    cell.processes.check()
