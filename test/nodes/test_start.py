"""Each command of a node sets its environment before ROS is loaded."""

import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

from omsm_ros.nodes import start

PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
LATER_PROFILES = "FASTDDS_DEFAULT_PROFILES_FILE"
MORE = "RMW_FASTRTPS_USE_QOS_FROM_XML"
MODE = "RMW_FASTRTPS_PUBLICATION_MODE"


@pytest.fixture(autouse=True)
def nothing_chosen(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    for name in (PROFILES, LATER_PROFILES, MORE, MODE, "FASTDDS_BUILTIN_TRANSPORTS"):
        monkeypatch.setenv(name, "")  # to be put back as it was
        monkeypatch.delenv(name)


def test_fast_dds_sends_from_a_thread_of_its_own_unless_requested(monkeypatch):
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


def test_fast_dds_is_configured_for_its_transports_and_to_release_memory():
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


@pytest.mark.parametrize("distribution", ["jazzy", "kilted"])
def test_each_release_of_fast_dds_has_a_profile_of_the_loopback_interface(
    monkeypatch, distribution
):
    """Fast DDS 3 reads another variable, and refuses a profile with the names of Fast DDS 2."""
    monkeypatch.setenv("ROS_DISTRO", distribution)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    start.set_up_fast_dds()
    (name,) = {PROFILES, LATER_PROFILES} & set(os.environ)
    assert name == (PROFILES if distribution == "jazzy" else LATER_PROFILES)
    profile = ElementTree.parse(os.environ[name])
    addresses = profile.findall(".//{*}interfaceWhiteList/{*}address")
    assert [each.text for each in addresses] == ["127.0.0.1"]
    limits = profile.findall(".//{*}throughputController")
    assert len(limits) == (distribution == "jazzy")


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


def test_a_node_with_too_few_open_files_ends_in_one_line_before_ros_loads(monkeypatch, capsys):
    monkeypatch.setattr(start, "open_files", lambda: 12)
    monkeypatch.setattr(start, "use_single_malloc_arena", None)
    monkeypatch.setattr(start.sys, "argv", ["/ws/install/lib/omsm_ros/corrector"])
    with pytest.raises(SystemExit) as ended:
        start.main()
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.startswith("corrector: ")
    assert said.count("\n") == 1
    assert "may hold 12" in said
    assert "ulimit -n" in said


@pytest.mark.parametrize("most", [start.FEWEST_OPEN_FILES, float("inf")])
def test_enough_open_files_are_passed_over(monkeypatch, most):
    monkeypatch.setattr(start, "open_files", lambda: most)
    start._check_open_files("corrector")


@pytest.mark.parametrize(("package", "remedy"), [("rclpy", "env.sh"), ("omsm_msgs", "colcon")])
def test_a_node_without_ros_or_messages_names_what_to_do(monkeypatch, capsys, package, remedy):
    def absent(name, *_):
        if name == package:
            raise ImportError(f"No module named {name!r}")

    for name in ("use_single_malloc_arena", "end_with_launch", "set_up_fast_dds"):
        monkeypatch.setattr(start, name, lambda *_: None)
    monkeypatch.setattr(start.importlib, "import_module", absent)
    monkeypatch.setattr(start.sys, "argv", ["calibrator"])
    with pytest.raises(SystemExit) as ended:
        start.main()
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.startswith(f"calibrator: No module named {package!r}: ")
    assert said.count("\n") == 1
    assert remedy in said


def test_the_launch_that_is_gone_takes_its_node_with_it(monkeypatch):
    gone = os.fork()
    if gone == 0:
        os._exit(0)
    os.waitpid(gone, 0)
    monkeypatch.setenv(start.LAUNCHED_BY, str(gone))
    with pytest.raises(SystemExit, match="has ended"):
        start.end_with_launch()
    assert start.LAUNCHED_BY not in os.environ  # not for the children of the node
    start.end_with_launch()  # of no launch


def test_a_launch_that_is_no_parent_is_left_to_itself(monkeypatch):
    monkeypatch.setenv(start.LAUNCHED_BY, str(os.getpid()))
    monkeypatch.setattr(start, "end_with_parent", None)
    start.end_with_launch()
