"""The corrector node alone in its process, fed over DDS at the rates of real probes."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.offline import save_paper_calibration
from benchmarks.row import Row, at_least, at_most
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.io import message_mapping

# One turn of the spindle at 30 rpm: the blocks of a turn are published over and over.
TURN_S = 2.0


def _turn(rate: float, size: int) -> list[tuple[AxisBlock, DistanceBlock]]:
    """Blocks of one turn: astigmatic motion of half a millimetre, a microscopic distance."""
    random = np.random.default_rng(0)
    blocks = []
    for first in range(0, round(TURN_S * rate), size):
        angle = 2 * np.pi * np.arange(first, first + size) / (TURN_S * rate)
        common = {"stamp_ns": 0, "first_sample": first, "sample_period": 1 / rate}
        zero = np.zeros(size)
        axes = AxisBlock(
            **common, x=zero + 0.01, y=zero, z=0.5e-3 * np.cos(2 * angle), b=zero, c=angle
        )
        distance = random.normal(0.0, 1e-8, size)
        blocks.append((axes, DistanceBlock(**common, distance=distance)))
    return blocks


def feed(rate: float, size: int, duration: float) -> dict[str, float]:
    """Feed the corrector for ``duration`` [s] and return what its diagnostics say at the end."""
    import rclpy
    from omsm_msgs import msg

    from omsm_ros.nodes.cell_demo_node import DemoNode, NodeProcesses
    from omsm_ros.nodes.topics import SAMPLES_QOS

    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    folder = Path(tempfile.mkdtemp())
    save_paper_calibration(folder / "cal.json", rate)
    messages = message_mapping.ros_messages()
    turn = [
        (message_mapping.block_message(messages, a), message_mapping.block_message(messages, d))
        for a, d in _turn(rate, size)
    ]
    rclpy.init()
    with NodeProcesses(folder) as processes:
        node = DemoNode(processes)
        publishers = (
            node.create_publisher(msg.AxisBlock, "axes", SAMPLES_QOS),
            node.create_publisher(msg.DistanceBlock, "confocal", SAMPLES_QOS),
        )
        processes.start("corrector", calibration=str(folder / "cal.json"))
        node.wait_until(
            "the corrector", lambda: all(p.get_subscription_count() for p in publishers)
        )
        used = _processor_time(processes.pid("corrector"))
        start = time.monotonic()
        sent = _publish(node, publishers, turn, rate, round(duration * rate / size))
        spent = time.monotonic() - start
        node.wait_until("the last block", lambda: _received(node) >= sent, lambda: _received(node))
        used = _processor_time(processes.pid("corrector")) - used
        found = _account(node, sent)
        node.destroy_node()
    rclpy.try_shutdown()
    return found | {"cpu": used / spent, "late": spent - duration}


def _publish(node: Any, publishers: Any, turn: list[Any], rate: float, blocks: int) -> int:
    """Publish pairs of blocks on time; return the number of samples."""
    import rclpy

    size, start = len(turn[0][0].z), time.monotonic()
    for number in range(blocks):
        due = start + number * size / rate
        while (wait := due - time.monotonic()) > 0:
            time.sleep(wait)
        stamp = node.get_clock().now().to_msg()
        for publisher, message in zip(publishers, turn[number % len(turn)], strict=True):
            message.header.stamp = stamp
            message.first_sample = number * size
            publisher.publish(message)
        if number % 20 == 0:
            rclpy.spin_once(node, timeout_sec=0)
    return blocks * size


def _received(node: Any) -> float:
    """Return how many samples have come of both streams; of either the other may be on its way."""
    return min(node.value("corrector", f"{s}_received") for s in ("axes", "distance"))


def _account(node: Any, sent: int) -> dict[str, float]:
    """Return the corrector's diagnostics after ``sent`` samples."""
    corrected = node.value("corrector", "distance_corrected")
    settling = node.value("corrector", "distance_settling")
    latencies = {key: float(node.text("corrector", key)) for key in ("latency_p99_ms",)}
    return latencies | {"lost": sent - _received(node), "uncorrected": sent - corrected - settling}


def _processor_time(pid: int) -> float:
    """User and system time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rows(full: bool) -> Iterator[Row]:
    """Yield figures at 1 kHz, 70 kHz and the highest rate without loss; shorter unless ``full``."""
    slow_s, fast_s, each_s = (60.0, 300.0, 10.0) if full else (15.0, 60.0, 5.0)
    slow = feed(1e3, 100, slow_s)
    lost = slow["lost"] + slow["uncorrected"]
    yield at_most(f"corrector, 1 kHz for {slow_s:g} s: share of a core", slow["cpu"], "1", 0.10)
    yield at_most(f"corrector, 1 kHz for {slow_s:g} s: samples lost", lost, "1", 0)
    fast = feed(70e3, 700, fast_s)
    lost = fast["lost"] + fast["uncorrected"]
    yield at_most(f"corrector, 70 kHz for {fast_s:g} s: samples lost", lost, "1", 0)
    yield at_most("corrector, 70 kHz: latency p99", fast["latency_p99_ms"], "ms", 20.0)
    yield at_most("corrector, 70 kHz: share of a core", fast["cpu"], "1", 1.0)
    highest = _highest(each_s, _RATES if full else _RATES[2::2])
    yield at_least("corrector: highest rate without loss", highest, "Hz", 70e3)


_RATES = (100e3, 200e3, 300e3, 400e3, 500e3, 600e3, 800e3)


def _highest(duration: float, rates: Sequence[float]) -> float:
    best = 0.0
    for rate in rates:
        seen = feed(rate, round(rate / 100), duration)
        behind = seen["late"] > 0.5 or seen["latency_p99_ms"] > 100
        if seen["lost"] or seen["uncorrected"] or behind:
            break
        best = rate
    return best
