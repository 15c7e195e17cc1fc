"""The command doctor: check whether this computer can run a cell, with remedies."""

import argparse
import importlib.util
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from omsm_ros.cli.arguments import Arguments
from omsm_ros.cli.command import CliCommand, Facts, say
from omsm_ros.errors import FEWEST_OPEN_FILES, MORE_FILES, open_files
from omsm_ros.instruments.transport import serial_ports

FINE, DOUBTFUL, FAULTY = "fine", "doubtful", "faulty"

_PYTHONS = ((3, 10), (3, 13))  # the ones that have wheels of ROS 2 Jazzy
_PACKAGES = ("numpy", "scipy", "control", "rosbags", "pyserial", "PyYAML", "jsonschema")
_EXTRAS = {
    "SurfaceTopography": "other instruments' maps",
    "h5py": "HDF5 files",
    "nptdms": "TDMS files",
    "websockets": "the live page",
    "sqlalchemy": "the catalogue",
    "distributed": "campaigns on several computers",
    "shtab": "completion in the shell",
}
# The demonstration's bag of axes, probe and points has 95 bytes a sample: 0.34 GB an hour at 1 kHz.
_BYTES_PER_HOUR = 95 * 1000 * 3600
_ENOUGH_HOURS = 8.0
_DISCOVERY_TIMEOUT_S = 20.0


@dataclass(frozen=True, slots=True)
class HostCheck:
    """Result of one check.

    state: "fine", "doubtful" (works, with a risk) or "faulty"
    found: the state in words;  remedy: what to do, empty if nothing
    """

    name: str
    state: str
    found: str
    remedy: str = ""


def examine_host(folder: Path, port: str = "") -> list[HostCheck]:
    """Check everything that a cell on this computer depends on.

    folder: for recordings;  port: serial device that must exist, such as ``/dev/ttyUSB0``; empty
    to list those that exist
    """
    return [
        _python(),
        *_packages(),
        _open_files(),
        *_ros(os.environ),
        _serial(port),
        _clock(_kernel_clock_synchronised),
        _disk(folder),
    ]


def _python() -> HostCheck:
    name = f"{sys.version_info[0]}.{sys.version_info[1]}"
    low, high = (".".join(map(str, limit)) for limit in _PYTHONS)
    if _PYTHONS[0] <= sys.version_info[:2] <= _PYTHONS[1]:
        return HostCheck("Python", FINE, name)
    return HostCheck("Python", FAULTY, name, f"use Python {low} to {high}: make PYTHON=… setup")


def _packages() -> Iterator[HostCheck]:
    missing, found = [], []
    for package in _PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            missing.append(package)
    if missing:
        remedy = f"pip install {' '.join(missing)}"
        yield HostCheck("packages", FAULTY, f"missing: {', '.join(missing)}", remedy)
    else:
        yield HostCheck("packages", FINE, ", ".join(found))
    absent = {p: use for p, use in _EXTRAS.items() if importlib.util.find_spec(p) is None}
    if absent:
        use = ", ".join(f"{package} ({use})" for package, use in absent.items())
        yield HostCheck("optional packages", FINE, f"not installed: {use}")


def _open_files() -> HostCheck:
    """Check that a process may open as many files as nodes and commands need."""
    most = open_files()
    if most >= FEWEST_OPEN_FILES:
        return HostCheck("open files", FINE, f"{most} at most" if most < math.inf else "any number")
    found = f"a process may open {most} files, and may need {FEWEST_OPEN_FILES}"
    return HostCheck("open files", FAULTY, found, MORE_FILES)


def _ros(environment: os._Environ[str]) -> Iterator[HostCheck]:
    """Check that nodes can start and find each other."""
    if importlib.util.find_spec("rclpy") is None:
        yield HostCheck(
            "ROS 2", DOUBTFUL, "not found: the offline commands work, nodes do not",
            "'make setup' and '. ./env.sh', or source /opt/ros/jazzy/setup.bash",
        )  # fmt: skip
        return
    if importlib.util.find_spec("omsm_msgs") is None:
        yield HostCheck(
            "ROS 2", FAULTY, "rclpy without omsm_msgs", "build it: make setup; . ./env.sh"
        )
        return
    yield HostCheck("ROS 2", FINE, environment.get("ROS_DISTRO", "jazzy, from PyPI"))
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    domain = environment.get("ROS_DOMAIN_ID", "0")
    found = f"domain {domain}, range {reach}"
    if reach == "LOCALHOST":
        yield HostCheck("DDS settings", FINE, found)
    else:
        yield HostCheck(
            "DDS settings", DOUBTFUL, f"{found}: other computers can control these nodes",
            "export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, or a ROS_DOMAIN_ID of your own",
        )  # fmt: skip
    yield _discovery()


def _discovery() -> HostCheck:
    """Check that two ROS processes find each other and exchange a message."""
    if open_files() < FEWEST_OPEN_FILES:
        return HostCheck("DDS discovery", FAULTY, "not evaluated: too few open files", MORE_FILES)
    command = [sys.executable, "-m", "omsm_ros.nodes.discovery_check"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_DISCOVERY_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        found = f"no message within {_DISCOVERY_TIMEOUT_S:g} s"
    else:
        if done.returncode == 0:
            return HostCheck("DDS discovery", FINE, done.stdout.strip())
        found = (done.stderr.strip().splitlines() or ["no message"])[-1]
    remedy = "allow UDP multicast on the loopback interface, or set ROS_STATIC_PEERS=127.0.0.1"
    return HostCheck("DDS discovery", FAULTY, found, remedy)


def _serial(port: str) -> HostCheck:
    ports = serial_ports()
    if port and port not in ports and not Path(port).exists():
        there = f"; available: {', '.join(ports)}" if ports else "; none is available"
        return HostCheck(
            "serial port", FAULTY, f"no {port}{there}", "connect the device; give its port"
        )
    wanted = [port] if port else ports
    closed = [p for p in wanted if not os.access(p, os.R_OK | os.W_OK)]
    if closed:
        remedy = "sudo usermod -aG dialout $USER, then log in again"
        return HostCheck(
            "serial port", FAULTY, f"no permission to open {', '.join(closed)}", remedy
        )
    return HostCheck("serial port", FINE, ", ".join(wanted) or "none on this computer")


def _clock(synchronised: Callable[[], bool | None]) -> HostCheck:
    """Check that stamps of this computer can be compared with those of another."""
    remedy = "sudo timedatectl set-ntp true, if stamps of several computers are compared"
    by_hand = "check that chrony or another NTP client runs, if several computers are compared"
    states = {
        True: HostCheck("clock", FINE, "synchronised"),
        False: HostCheck("clock", DOUBTFUL, "not synchronised", remedy),
        None: HostCheck("clock", DOUBTFUL, "not evaluated: timedatectl is not available", by_hand),
    }
    return states[synchronised()]


def _kernel_clock_synchronised() -> bool | None:
    """Return whether systemd reports a synchronised clock; None if it reports nothing."""
    try:
        done = subprocess.run(
            ["timedatectl", "show", "--property=NTPSynchronized", "--value"],
            capture_output=True, text=True, timeout=5.0, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return {"yes": True, "no": False}.get(done.stdout.strip())


def _disk(folder: Path) -> HostCheck:
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    if not os.access(there, os.W_OK):
        return HostCheck(
            "disk", FAULTY, f"no permission to write in {there}", "choose another folder"
        )
    hours = shutil.disk_usage(there).free / _BYTES_PER_HOUR
    found = f"room for {hours:.0f} hours of recording at 1 kHz in {there}"
    if hours < _ENOUGH_HOURS:
        return HostCheck("disk", DOUBTFUL, found, "free some space, or record elsewhere")
    return HostCheck("disk", FINE, found)


_MARKS = {FINE: "ok", DOUBTFUL: "??", FAULTY: "NO"}


def _declare_doctor(add: Arguments) -> None:
    add("--port", str, "serial port that must exist", default="", metavar="PATH")
    add("--folder", "DIR", "folder for recordings", default=Path())


def _doctor(args: argparse.Namespace) -> Facts:
    return {"checks": [asdict(check) for check in examine_host(args.folder, args.port)]}


def _show_doctor(facts: Facts) -> None:
    for check in facts["checks"]:
        say(f"{_MARKS[check['state']]}  {check['name']:<18} {check['found']}")
        if check["remedy"]:
            say(f"    {'':<18} → {check['remedy']}")


def _faulty(facts: Facts) -> str:
    names = [check["name"] for check in facts["checks"] if check["state"] == FAULTY]
    return f"not ready: {', '.join(names)}; see the remedies above" if names else ""


COMMANDS = (CliCommand("doctor", _declare_doctor, _doctor, _show_doctor, _faulty),)
