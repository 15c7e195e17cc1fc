"""What every command of a node sets before ROS is loaded."""

import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

from omsm_ros.nodes import start


def test_fast_dds_sends_from_a_thread_of_its_own_unless_told(monkeypatch):
    name = "RMW_FASTRTPS_PUBLICATION_MODE"
    monkeypatch.setenv(name, "")  # to be put back as it was
    monkeypatch.delenv(name)
    start.send_aside()
    assert os.environ[name] == "ASYNCHRONOUS"
    monkeypatch.setenv(name, "SYNCHRONOUS")
    start.send_aside()
    assert os.environ[name] == "SYNCHRONOUS"


@pytest.fixture
def nothing_chosen(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in (PROFILES, "FASTDDS_BUILTIN_TRANSPORTS"):
        monkeypatch.setenv(name, "")  # to be put back as it was
        monkeypatch.delenv(name)


PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"


def test_fast_dds_is_told_to_hear_by_udp(nothing_chosen):
    start.hear_by_udp()
    heard_by = ElementTree.parse(os.environ[PROFILES]).findall(
        ".//{*}participant[@is_default_profile='true']//{*}defaultUnicastLocatorList/{*}locator/*"
    )
    assert [each.tag.rpartition("}")[2] for each in heard_by] == ["udpv4"]


def test_transports_that_the_user_has_chosen_stay(nothing_chosen, monkeypatch):
    for name in (PROFILES, "FASTDDS_BUILTIN_TRANSPORTS"):
        with monkeypatch.context() as chosen:
            chosen.setenv(name, "mine")
            start.hear_by_udp()
            assert os.environ[name] == "mine"
            assert os.environ.get(PROFILES) in (None, "mine")
    Path("DEFAULT_FASTRTPS_PROFILES.xml").touch()
    start.hear_by_udp()
    assert PROFILES not in os.environ
