"""What every command of a node sets before ROS is loaded."""

import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

from omsm_ros.nodes import start

PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
MORE = "RMW_FASTRTPS_USE_QOS_FROM_XML"
MODE = "RMW_FASTRTPS_PUBLICATION_MODE"


@pytest.fixture(autouse=True)
def nothing_chosen(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in (PROFILES, MORE, MODE, "FASTDDS_BUILTIN_TRANSPORTS"):
        monkeypatch.setenv(name, "")  # to be put back as it was
        monkeypatch.delenv(name)


def test_fast_dds_sends_from_a_thread_of_its_own_unless_told(monkeypatch):
    start.set_up_fast_dds()
    assert os.environ[MODE] == "ASYNCHRONOUS"
    assert os.environ[MORE] == "1"
    monkeypatch.setenv(MODE, "SYNCHRONOUS")
    for name in (PROFILES, MORE):
        monkeypatch.delenv(name)
    start.set_up_fast_dds()
    assert os.environ[MODE] == "SYNCHRONOUS"
    assert MORE not in os.environ  # it would have the mode of the profile
    assert PROFILES in os.environ


def test_fast_dds_is_told_what_to_hear_by_and_to_free():
    start.set_up_fast_dds()
    profile = ElementTree.parse(os.environ[PROFILES])

    def said(entity, path):
        return profile.findall(f".//{{*}}{entity}[@is_default_profile='true']//{path}")

    heard_by = said("participant", "{*}defaultUnicastLocatorList/{*}locator/*")
    assert [each.tag.rpartition("}")[2] for each in heard_by] == ["udpv4"]
    # Its first word is sent aside only under a limit, whose period is also that of an idle thread.
    limit = {
        e.tag.rpartition("}")[2]: int(e.text)
        for e in said("participant", "{*}throughputController/*")
    }
    assert limit["bytesPerPeriod"] / limit["periodMillisecs"] > 1e6  # a gigabyte a second
    assert limit["periodMillisecs"] >= 1000
    for entity in ("data_writer", "data_reader"):
        assert [each.text for each in said(entity, "{*}historyMemoryPolicy")] == ["DYNAMIC"]
        assert [each.text for each in said(entity, "{*}data_sharing/{*}kind")] == ["OFF"]
    # The other place where the mode stands must say the same.
    mode = [each.text for each in said("data_writer", "{*}publishMode/{*}kind")]
    assert mode == [os.environ[MODE]]


def test_transports_that_the_user_has_chosen_stay(monkeypatch):
    for name in (PROFILES, "FASTDDS_BUILTIN_TRANSPORTS"):
        with monkeypatch.context() as chosen:
            chosen.setenv(name, "mine")
            start.set_up_fast_dds()
            assert os.environ[name] == "mine"
            assert os.environ.get(PROFILES) in (None, "mine")
            assert MORE not in os.environ
    Path("DEFAULT_FASTRTPS_PROFILES.xml").touch()
    start.set_up_fast_dds()
    assert PROFILES not in os.environ
