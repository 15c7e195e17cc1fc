"""Real nodes as processes, real DDS, a pseudo-terminal; on this machine and a domain of its own."""

import os
import time

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

    def __init__(self, folder, processes):
        from omsm_ros.nodes.cell_demo_node import DemoNode

        self.folder, self.link = folder, str(folder / "port")
        self.processes = processes
        self.operator = DemoNode(processes)

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
        return self.operator.ask(kind, f"/omsm/{name}", kind.Request(**fields))

    def caller(self, kind, name):
        """A function that calls a service of a node that runs on, by a client that stays."""
        client = self.operator.create_client(kind, f"/omsm/{name}")
        self.wait(name, client.service_is_ready)
        time.sleep(0.3)  # a server that has not found the client yet drops its answer

        def call(**fields):
            future = client.call_async(kind.Request(**fields))
            self.wait(f"an answer of {name}", future.done)
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
        """Wait until a count has stood still for a while and return it."""
        last, since = -1, time.monotonic()
        while time.monotonic() - since < 2.5:
            rclpy.spin_once(self.operator, timeout_sec=0.1)
            if (now := self.operator.value(node, key)) != last:
                last, since = now, time.monotonic()
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


@pytest.fixture
def cell(tmp_path, monkeypatch):
    """All that is started ends with the test; it is started in the test's folder."""
    monkeypatch.chdir(tmp_path)
    from omsm_ros.nodes.cell_demo_node import NodeProcesses

    with NodeProcesses(tmp_path / "log") as processes:
        made = Cell(tmp_path, processes)
        yield made
        made.operator.destroy_node()
