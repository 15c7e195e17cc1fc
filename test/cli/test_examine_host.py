import os
import subprocess
import sys

import pytest

from omsm_ros.cli import doctor as host
from omsm_ros.cli.doctor import DOUBTFUL, FAULTY, FINE


@pytest.fixture
def no_ros(monkeypatch):
    """Hide ROS."""
    find = host.importlib.util.find_spec
    monkeypatch.setattr(
        host.importlib.util, "find_spec", lambda name: None if name == "rclpy" else find(name)
    )


def by_name(checks):
    return {check.name: check for check in checks}


def test_every_check_that_is_not_fine_has_a_remedy(tmp_path, no_ros):
    checks = host.examine_host(tmp_path)
    assert [c.name for c in checks if c.state != FINE and not c.remedy] == []


def test_this_python_and_its_packages_are_fine(tmp_path, no_ros):
    checks = by_name(host.examine_host(tmp_path))
    assert checks["Python"].state == checks["packages"].state == FINE
    assert "numpy" in checks["packages"].found


def test_a_python_without_wheels_is_named(monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 9, 2))
    check = host._python()
    assert (check.state, check.found) == (FAULTY, "3.9")
    assert "3.10 to 3.13" in check.remedy


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr(host, "_PACKAGES", ("numpy", "no-such-package"))
    check = next(host._packages())
    assert check.state == FAULTY
    assert check.remedy == "pip install no-such-package"


def test_without_ros_the_offline_commands_are_left(no_ros):
    (check,) = host._ros(os.environ)
    assert check.state == DOUBTFUL
    assert "offline commands work" in check.found


@pytest.mark.parametrize(("reach", "state"), [("LOCALHOST", FINE), ("SUBNET", DOUBTFUL)])
def test_nodes_that_other_computers_may_command_are_reported(monkeypatch, reach, state):
    pytest.importorskip("omsm_msgs")
    monkeypatch.setattr(host, "_discovery", lambda: host.HostCheck("DDS discovery", FINE, ""))
    checks = by_name(host._ros({"ROS_AUTOMATIC_DISCOVERY_RANGE": reach, "ROS_DOMAIN_ID": "7"}))
    assert checks["DDS settings"].state == state
    assert "domain 7" in checks["DDS settings"].found


def test_a_check_of_discovery_that_hangs_ends(monkeypatch):
    def hang(command, **_):
        raise subprocess.TimeoutExpired(command, 20.0)

    monkeypatch.setattr(host.subprocess, "run", hang)
    check = host._discovery()
    assert check.state == FAULTY
    assert "no message within 20 s" in check.found


def test_a_serial_port_that_is_absent_is_named_with_those_that_are_there(monkeypatch):
    monkeypatch.setattr(host, "serial_ports", lambda: ["/dev/ttyUSB0"])
    check = host._serial("/dev/ttyUSB7")
    assert check.state == FAULTY
    assert check.found == "no /dev/ttyUSB7; available: /dev/ttyUSB0"


def test_a_serial_port_without_permission_has_its_remedy(monkeypatch, tmp_path):
    port = tmp_path / "ttyUSB0"
    port.touch()
    monkeypatch.setattr(host.os, "access", lambda *_: False)
    check = host._serial(str(port))
    assert check.state == FAULTY
    assert "dialout" in check.remedy


@pytest.mark.parametrize(("answer", "state"), [(True, FINE), (False, DOUBTFUL), (None, DOUBTFUL)])
def test_a_clock_of_which_nothing_is_known_is_not_called_synchronised(answer, state):
    assert host._clock(lambda: answer).state == state


@pytest.mark.parametrize(("free", "state"), [(5e9, FINE), (1e9, DOUBTFUL)])
def test_room_on_the_disk_is_reported_in_hours(monkeypatch, tmp_path, free, state):
    usage = host.shutil.disk_usage(tmp_path)._replace(free=free)
    monkeypatch.setattr(host.shutil, "disk_usage", lambda path: usage)
    check = host._disk(tmp_path / "not" / "yet")
    assert check.state == state
    assert f"{free / 95 / 3.6e6:.0f} hours" in check.found
