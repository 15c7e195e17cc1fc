"""``cell_demo``: calibrate and measure a whole (emulated) cell with the real nodes.

It starts emulator, driver, calibrator, corrector and recorder as processes, runs the step test,
identifies and scans the paper's mirror. Then it corrects the recorded bag offline and compares
all results with the truth of the twin.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from omsm_msgs.srv import Identify
from rclpy.node import Node
from std_srvs.srv import Trigger
from tqdm import tqdm

from omsm_ros.errors import (
    DEBUG,
    DeviceTimeoutError,
    OmsmError,
    defect,
    one_line,
    too_many_open_files,
)
from omsm_ros.instruments.emulator_factory import EMULATED
from omsm_ros.pipelines.demonstrate import Demonstration, finish_demonstration, table_of
from omsm_ros.pipelines.progress import refresh_in_thread, tick
from omsm_ros.report.verdict import headline, next_steps

_END_TIMEOUT_S = 15.0


class NodeProcesses:
    """Starts nodes of this package as processes; a context manager that ends all of them.

    The output of a node goes to ``<folder>/<node>.log``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> NodeProcesses:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, node: str, *arguments: str, label: object = "", **parameters: object) -> None:
        """Start ``node``, called ``label`` here, with arguments for ROS and parameters."""
        name = str(label or node)
        command = [sys.executable, "-m", "omsm_ros.nodes.start", node, "--ros-args", *arguments]
        # ROS parses it as YAML, which includes JSON; a float keeps its point.
        given = (f"{parameter}:={json.dumps(value)}" for parameter, value in parameters.items())
        command += [word for text in given for word in ("-p", text)]
        with (self._folder / f"{name}.log").open("ab") as log:
            self._running[name] = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    @property
    def running(self) -> tuple[str, ...]:
        """Return the names of the nodes that were not ended."""
        return tuple(self._running)

    def pid(self, node: str) -> int:
        """Return the process number of a running node."""
        return self._running[node].pid

    def check(self) -> None:
        """Raise OmsmError with the last line of a node that ended by itself."""
        for name, process in self._running.items():
            if process.poll() is not None:
                lines = (self._folder / f"{name}.log").read_text(errors="replace").split("\n")
                said = next((line for line in reversed(lines) if line.strip()), "nothing")
                raise OmsmError(f"{name} ended with exit code {process.returncode}: {said}")

    def end(self, *nodes: str, how: signal.Signals = signal.SIGINT) -> None:
        """End ``nodes``, or all, and wait; OmsmError if one had failed."""
        names = nodes or tuple(self._running)
        for name in names:
            self._running[name].send_signal(how)
        codes = {name: self._wait(name) for name in names}
        wrong = {name: code for name, code in codes.items() if code not in (0, -how)}
        if wrong:
            raise OmsmError(f"nodes ended badly (exit codes {wrong!r}); see {self._folder}")

    def _wait(self, name: str) -> int:
        process = self._running.pop(name)
        try:
            return process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return -signal.SIGKILL

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            process.send_signal(signal.SIGINT)
        for name in tuple(self._running):
            self._wait(name)


_DISCOVERY_S = 0.3
_DRAWING_S = 2.0
_SERVICE_TIMEOUT_S = 60.0
_STALL_TIMEOUT_S = 60.0
_PREFIX = "/omsm/"


class DemoNode(Node):
    """Reads diagnostics, calls services, and waits for their effects."""

    def __init__(self, processes: NodeProcesses) -> None:
        super().__init__("cell_demo", namespace="omsm")
        self._processes = processes
        self._status: dict[str, dict[str, str]] = {}
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._status[status.name.removeprefix(_PREFIX)] = values | {
                "message": status.message,
                "level": str(status.level[0]),
            }

    def show(self, message: str, verdict: Mapping[str, Any] | None = None) -> None:
        """Publish that the measurement has ended, and its verdict, for the live page."""
        values = {"measurement_ended": "yes"}
        if verdict is not None:
            values |= {"verdict": verdict["code"], "verdict_text": verdict["text"]}
            values["verdict_next"] = "; ".join(next_steps(verdict))
        shown = [KeyValue(key=key, value=value) for key, value in values.items()]
        status = DiagnosticStatus(name="/omsm/cell_demo", message=message, values=shown)
        self._publisher.publish(DiagnosticArray(status=[status]))

    def forget(self, node: str) -> None:
        """Drop what the diagnostics of ``node`` said, as before it is started again."""
        self._status.pop(node, None)

    def value(self, node: str, key: str) -> int:
        """Return a count from a node's diagnostics; 0 before the first one."""
        return int(self._status.get(node, {}).get(key, 0))

    def text(self, node: str, key: str) -> str:
        """Return a text from a node's diagnostics; empty before the first one."""
        return self._status.get(node, {}).get(key, "")

    def wait_until(
        self, what: str, done: Callable[[], bool], watch: Callable[[], object] = lambda: None
    ) -> None:
        """Spin until ``done``; DeviceTimeoutError if ``watch`` does not change for long."""
        last, deadline = watch(), time.monotonic() + _STALL_TIMEOUT_S
        while not done():
            rclpy.spin_once(self, timeout_sec=0.1)
            self._processes.check()
            if (now := watch()) != last:
                last, deadline = now, time.monotonic() + _STALL_TIMEOUT_S
            if time.monotonic() > deadline:
                raise DeviceTimeoutError(
                    f"{what} did not happen in time; see the logs in the folder of the results"
                )

    def ask(self, kind: Any, name: str, request: Any, patience: float = _SERVICE_TIMEOUT_S) -> Any:
        """Call a service and return its answer; DeviceTimeoutError if there is none."""
        client = self.create_client(kind, name)
        try:
            if not client.wait_for_service(patience):
                raise DeviceTimeoutError(f"service {name!r} did not appear; see the logs")
            # A server that has not discovered the client yet drops its answer.
            rclpy.spin_once(self, timeout_sec=_DISCOVERY_S)
            time.sleep(_DISCOVERY_S)
            future = client.call_async(request)
            rclpy.spin_until_future_complete(self, future, timeout_sec=patience)
            if (answer := future.result()) is None:
                raise DeviceTimeoutError(f"service {name!r} did not answer; see the logs")
            return answer
        finally:
            self.destroy_client(client)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service and return its answer; OmsmError if it did not succeed."""
        answer = self.ask(kind, name, request)
        if not answer.success:
            raise OmsmError(f"{name}: {answer.message}")
        return answer


@contextmanager
def demo_stage(title: str, total: int = 0, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """Show the progress of a stage: a bar on a terminal, a line elsewhere, nothing if ``quiet``."""
    plain = not sys.stderr.isatty()
    if plain and not quiet:
        print(f"· {title}", file=sys.stderr, flush=True)
    layout = (
        "{desc:<44} {percentage:3.0f}% |{bar:24}| {remaining} left" if total else "{desc} {elapsed}"
    )
    with (
        tqdm(desc=title, total=total or None, disable=quiet or plain, bar_format=layout) as bar,
        refresh_in_thread(partial(tick, bar.refresh)),
    ):
        yield lambda done: bar.update(done - bar.n)  # type: ignore[misc]
        bar.update((total or bar.n) - bar.n)


def perform(
    node: DemoNode, processes: NodeProcesses, plan: Demonstration, stage: Callable[..., Any]
) -> None:
    """Run the cell: step test, identification, scan, recording."""
    with stage("starting the cell and its nodes"):
        _start(node, processes, plan)
    if plan.view:
        with stage("look at http://127.0.0.1:8080/ while it scans"):
            pass
    steps, first, second = plan.samples()
    with stage(f"step test: {steps} samples on a fixed mirror", steps) as progress:
        node.call(Trigger, "/omsm/cell_emulator/step_test", Trigger.Request())
        _follow(node, "calibrator", {"axes_held": 0, "distance_held": 0}, steps, progress)
    with stage("identifying the transfer function from encoder to probe"):
        answer = node.call(Identify, "/omsm/calibrator/identify", Identify.Request())
        node.wait_until(
            "the corrector to take the calibration",
            lambda: node.text("corrector", "calibration") == answer.calibration.id,
        )
    with stage("starting the recorder"):
        _record(node, processes, plan, plan.bag)
    with stage(f"scanning the mirror: {first} points", first) as progress:
        _scan(node, plan, "scan", first, progress)
    with stage("starting the recorder of the second scan"):
        processes.end("recorder")
        _record(node, processes, plan, plan.second_bag)
    with stage(f"at twice the speed from beyond the centre: {second} points", second) as progress:
        _scan(node, plan, "verifying_scan", second, progress)
    if plan.view:
        node.show("both scans are recorded and are being adjusted together")
    with stage("ending the nodes"):
        processes.end(*(name for name in processes.running if name != "viewer"))


def _record(node: DemoNode, processes: NodeProcesses, plan: Demonstration, bag: Path) -> None:
    node.forget("recorder")
    processes.start("recorder", path=str(bag))
    node.wait_until(
        "the recorder to be heard",
        lambda: (
            node.value(_axes_of(plan), "axes_subscribers") >= 3
            and node.value("confocal_driver", "confocal_subscribers") >= 3
            and node.value("corrector", "points_subscribers") >= 1 + plan.view
            and bool(node.text("recorder", "message"))
        ),
    )


def _start(node: DemoNode, processes: NodeProcesses, plan: Demonstration) -> None:
    processes.start("cell_emulator", link=plan.link, **plan.emulator_parameters())
    processes.start("confocal_driver", **plan.driver_parameters())
    if (companion := plan.companion_parameters()) is not None:
        processes.start(companion[0], **companion[1])
    processes.start(
        "calibrator", output=str(plan.calibration_file), settings=json.dumps(plan.settings())
    )
    processes.start("corrector")
    if plan.view:
        processes.start("viewer", nominal=str(plan.nominal_file))
    node.wait_until(
        "the driver, calibrator and corrector to find each other",
        lambda: (
            node.value("confocal_driver", "connections") >= 1
            and (companion is None or node.value(companion[0], "connections") >= 1)
            and node.value(_axes_of(plan), "axes_subscribers") >= 2
            and node.value("confocal_driver", "confocal_subscribers") >= 2
        ),
    )


def _axes_of(plan: Demonstration) -> str:
    companion = plan.companion_parameters()
    return "axis_driver" if companion and companion[0] == "axis_driver" else "confocal_driver"


def _scan(
    node: DemoNode, plan: Demonstration, motion: str, samples: int, progress: Callable[[int], None]
) -> None:
    drivers = {"/omsm/axes": _axes_of(plan), "/omsm/confocal": "confocal_driver"}
    earlier = {topic: node.value(driver, "blocks") for topic, driver in drivers.items()}
    received = ("axes_received", "distance_received")
    before = {name: node.value("corrector", name) for name in received}
    clouds = node.value("corrector", "clouds_published")
    node.call(Trigger, f"/omsm/cell_emulator/{motion}", Trigger.Request())
    _follow(node, "corrector", before, samples, progress)
    node.wait_until(
        "the last clouds to be recorded",
        lambda: (
            node.value("corrector", "pairs_held") == 0
            and node.value("recorder", "/omsm/points")
            == node.value("corrector", "clouds_published") - clouds
            and all(
                node.value("recorder", topic) == node.value(driver, "blocks") - earlier[topic]
                for topic, driver in drivers.items()
            )
        ),
    )


def _follow(
    node: DemoNode, who: str, before: Mapping[str, int], total: int, progress: Callable[[int], None]
) -> None:
    """Wait until each of the counts has grown by ``total`` from what it was ``before``."""

    def seen() -> int:
        least = min(node.value(who, name) - count for name, count in before.items())
        progress(least)
        return least

    node.wait_until(f"{total} samples at the {who}", lambda: seen() >= total, seen)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="cell_demo", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    parser.add_argument("--time-lapse", type=float)
    parser.add_argument("--device", choices=sorted(EMULATED), default="six_channel")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start-radius", type=float, help="[m]")
    parser.add_argument("--disturbances", type=Path, dest="disturbance_file",
                        metavar="DISTURBANCES", help="errors of the simulated machine")  # fmt: skip
    parser.add_argument("--view", action="store_true", help="show the scan in a browser")
    parser.add_argument("--json", action="store_true")
    # With `ros2 run`, the arguments after --ros-args are for rclpy.
    return parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])


def main() -> None:
    """Run ``ros2 run omsm_ros cell_demo``."""
    options = vars(_arguments())
    as_json: bool = options.pop("json")
    # A demonstration is isolated from other nodes on the network.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    plan = Demonstration(**options)
    stage = partial(demo_stage, quiet=as_json)
    try:
        rclpy.init()
        plan.prepare()
        with NodeProcesses(plan.out / "log") as processes:
            node = DemoNode(processes)
            perform(node, processes, plan, stage)
            with stage("correcting the bag offline, comparing with the truth"):
                summary = finish_demonstration(plan)
            if plan.view:
                node.show(headline(summary["adjustment"]), summary["adjustment"]["verdict"])
                if sys.stdin.isatty() and sys.stderr.isatty():
                    text = "the live page stays until you press Enter "
                    print(text, end="", file=sys.stderr, flush=True)
                    sys.stdin.readline()
                else:
                    time.sleep(_DRAWING_S)  # until the page is drawn
    except OmsmError as err:
        print(f"omsm demo: {one_line(err)}", file=sys.stderr)
        sys.exit(2)
    except Exception as err:
        short = too_many_open_files(err)
        if os.environ.get(DEBUG) and not short:
            raise
        print(f"omsm demo: {short or defect(err)}", file=sys.stderr)
        sys.exit(2 if short else 70)
    except KeyboardInterrupt:
        print("omsm demo: interrupted", file=sys.stderr)
        sys.exit(130)
    finally:
        rclpy.try_shutdown()
    print(json.dumps(summary) if as_json else table_of(plan, summary))
