"""What every command of a node sets before ROS is loaded."""

import os

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
