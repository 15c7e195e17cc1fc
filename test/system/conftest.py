"""Real nodes as processes, real DDS, a pseudo-terminal; on this machine and a domain of its own."""

import os
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from own_domain import own_domain

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed")


@pytest.fixture(scope="session", autouse=True)
def ros():
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with own_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        rclpy.init()
        yield
        rclpy.try_shutdown()


class Cell:
    """Starts nodes, looks at their diagnostics, calls their services."""

    def __init__(self, folder, processes, operator):
        self.folder, self.link = folder, str(folder / "port")
        self.processes, self.operator = processes, operator
        self._callers = {}

    def start_emulator(self, **parameters):
        given = {"link": self.link, "time_lapse": 20.0, "start_radius": 1e-3, "seed": 3}
        self.processes.start("cell_emulator", **(given | parameters))

    def start_driver(self, **parameters):
        from omsm_ros.instruments.emulator_factory import emulated

        given = {"port": self.link} | emulated("six_channel").driver
        self.processes.start("confocal_driver", **(given | parameters))

    def start_correcting(self, calibration, driver=None, **emulator):
        """Emulator, driver and corrector, all connected."""
        from omsm_ros.io.calibration_file import save_calibration

        path = self.folder / "cal.json"
        save_calibration(path, calibration)
        self.start_emulator(**emulator)
        self.start_driver(**(driver or {}))
        self.processes.start("corrector", calibration=str(path))
        value = self.operator.value
        self.wait(
            "the nodes",
            lambda: (
                value("confocal_driver", "axes_subscribers") >= 1
                and value("confocal_driver", "confocal_subscribers") >= 1
                and value("confocal_driver", "connections") >= 1
            ),
        )

    def call(self, kind, name, **fields):
        """The answer of a service, by a client that stays for further calls."""
        if name not in self._callers:
            self._callers[name] = self.caller(kind, name)
        return self._callers[name](**fields)

    def caller(self, kind, name):
        """A function that calls a service of a node that runs on, by a client that stays."""
        client, known = self.operator.create_client(kind, f"/omsm/{name}"), False

        def call(**fields):
            nonlocal known
            if not (known and client.service_is_ready()):
                self.wait(name, client.service_is_ready)
                time.sleep(0.3)  # a server that has not found the client yet drops its answer
                known = True
            future = client.call_async(kind.Request(**fields))
            # An hour of samples takes a minute to make where others compute, too.
            work = partial(work_done, self.processes, name.split("/")[0])
            self.operator.wait_until(f"an answer of {name}", future.done, work)
            return future.result()

        return call

    def wait(self, what, done):
        self.operator.wait_until(what, done)

    def publisher(self, topic, message, listeners=1):
        """A publisher of samples that ``listeners`` nodes have found."""
        from omsm_ros.nodes.topics import SAMPLES_QOS

        made = self.operator.create_publisher(message, f"/omsm/{topic}", SAMPLES_QOS)
        self.wait(f"who hears {topic}", lambda: made.get_subscription_count() >= listeners)
        return made

    def clouds(self):
        """A list that fills with what appears on /omsm/points while the operator spins."""
        from sensor_msgs.msg import PointCloud2

        from omsm_ros.nodes.topics import SAMPLES_QOS

        seen = []
        self.operator.create_subscription(PointCloud2, "/omsm/points", seen.append, SAMPLES_QOS)
        return seen

    def settle(self, node, key):
        """Wait until a count has stood still for some reports of the node, and return it."""
        last, since, first = None, 0.0, 0

        def still():
            nonlocal last, since, first
            count, reports = self.operator.value(node, key), self.operator.reports[node]
            if count != last:
                last, since, first = count, time.monotonic(), reports
            return time.monotonic() - since > 0.8 and reports - first > 2

        self.wait(f"{key} to stand still", still)
        return last

    def closed_account(self, stream):
        """Samples that the corrector received of ``stream``, each of which it has counted."""
        status, prefix = self.operator._status["corrector"], f"{stream}_"
        counts = {
            key.removeprefix(prefix): int(value)
            for key, value in status.items()
            if key.startswith(prefix)
        }
        uncalibrated, refused = counts.pop("uncalibrated"), counts.pop("refused")
        received = counts.pop("received")
        assert uncalibrated == refused == 0
        assert sum(counts.values()) == received
        return received


def work_done(processes, node):
    """Processor time of a node in steps of 2 s, which an idle one does not use in a minute."""
    fields = Path(f"/proc/{processes.pid(node)}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) // (2 * os.sysconf("SC_CLK_TCK"))


@pytest.fixture(scope="session")
def node_server(ros):
    from system.forked_nodes import NodeServer

    with NodeServer() as server:
        yield server


@pytest.fixture
def refused(node_server, tmp_path):
    """A function that starts a node with what cannot be meant, and returns its last line."""

    def line(node, *arguments):
        log = tmp_path / f"{node}.log"
        ended = node_server.start([node, "--ros-args", *arguments], log).wait(60)
        said = log.read_text()
        assert ended == 2, said
        assert "Traceback" not in said
        return said.strip().splitlines()[-1]

    return line


@pytest.fixture
def cell(tmp_path, monkeypatch, request):
    """All that is started ends with the test; it is started in the test's folder.

    The nodes are forks of one process, in soak tests processes of their own, as users start them.
    """
    monkeypatch.chdir(tmp_path)
    from system.forked_nodes import ForkedNodes

    if request.node.get_closest_marker("soak"):
        yield from cell_of_commands(tmp_path)
        return
    with ForkedNodes(tmp_path / "log", request.getfixturevalue("node_server")) as processes:
        yield from cell_of(processes, tmp_path)


def cell_of_commands(folder):
    from omsm_ros.nodes.cell_demo_node import NodeProcesses

    with NodeProcesses(folder / "log") as processes:
        yield from cell_of(processes, folder)


def cell_of(processes, folder):
    operator = operator_of(processes)
    yield Cell(folder, processes, operator)
    operator.destroy_node()


def operator_of(processes):
    """A node that looks at diagnostics, and counts the reports of each node."""
    from omsm_ros.nodes.cell_demo_node import DemoNode

    class Operator(DemoNode):
        def __init__(self):
            self.reports, self._forgotten_ns = Counter(), 0
            super().__init__(processes)

        def forget(self, node):
            """Forget what a node that has ended said, and what of it is still on the way."""
            self._status.pop(node, None)
            self._forgotten_ns = time.time_ns()

        def _on_diagnostics(self, message):
            stamp = message.header.stamp
            if stamp.sec * 10**9 + stamp.nanosec < self._forgotten_ns:
                return
            super()._on_diagnostics(message)
            self.reports.update(status.name.removeprefix("/omsm/") for status in message.status)

    return Operator()
