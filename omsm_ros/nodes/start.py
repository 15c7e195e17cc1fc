"""The commands of all nodes; without ROS they end with one line and the remedy.

The module has no slow imports, so that Ctrl-C while the others load is an orderly end too.
``python -m omsm_ros.nodes.start corrector …`` is the same as the command ``corrector``.
"""

import importlib
import os
import signal
import sys
from pathlib import Path

from omsm_ros.errors import FEWEST_OPEN_FILES, MORE_FILES, open_files
from omsm_ros.loading import end_with_parent, exit_on_signal_while_loading, one_thread_of_blas
from omsm_ros.nodes.memory import use_single_malloc_arena

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask a node to end."""

LAUNCHED_BY = "OMSM_LAUNCHED_BY"
"""Variable with the process number of the launch that started a node, which ends with it."""

# Fast DDS 3 (Kilted and later) and 2 have profiles of their own, and refuse the other's.
_PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
_PROFILES_OF_FOLDER = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")
_WITH_FAST_DDS_2 = ("", "jazzy")
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_TRANSPORTS_CHOSEN = (*_PROFILES, "FASTDDS_BUILTIN_TRANSPORTS")
_MORE_FROM_PROFILE = "RMW_FASTRTPS_USE_QOS_FROM_XML"  # also memory and publication mode
_PUBLICATION_MODE = "RMW_FASTRTPS_PUBLICATION_MODE"
_BAD_INPUT = 2
_OF_ITS_OWN = ("corrector", "calibrator", "vibration_monitor", "recorder", "player", "viewer",
               "cell_emulator", "cell_demo")  # fmt: skip
_DRIVERS = ("confocal_driver", "axis_driver", "reference_driver", "accelerometer_driver")
NODES = {
    **{name: f"{name}_node:main" for name in _OF_ITS_OWN},
    **{name: f"driver:{name}" for name in _DRIVERS},
    "replay": "player_node:main",
    "cell": "cell_node:main",
}
"""The commands, and the ``module:function`` that runs each."""
_NO_ROS = (
    "ROS 2 Jazzy is not in this Python: source /opt/ros/jazzy/setup.bash, or '. ./env.sh' after "
    "'make setup' in a checkout; the offline commands (omsm) need none"
)
_NO_MESSAGES = (
    "the messages of omsm_ros are not built, or not sourced: 'colcon build' in the workspace and "
    "source install/setup.bash, or 'make setup' and '. ./env.sh' in a checkout"
)
_NEEDED = {"rclpy": _NO_ROS, "omsm_msgs": _NO_MESSAGES}


def main() -> None:
    """Run the node that the command is named for."""
    name = Path(sys.argv[0]).stem
    if name not in NODES:
        sys.exit(f"no node {name!r}, expected one of {sorted(NODES)}")
    _check_open_files(name)
    with exit_on_signal_while_loading(ENDING):
        use_single_malloc_arena(ENDING)  # first, since the process may execute itself again
        one_thread_of_blas()
        end_with_launch()
        set_up_fast_dds()
        for package, remedy in _NEEDED.items():
            try:
                importlib.import_module(package)
            except ImportError as err:
                print(f"{name}: {err}: {remedy}", file=sys.stderr)
                sys.exit(_BAD_INPUT)
        module, _, function = NODES[name].partition(":")
        node = importlib.import_module(f"omsm_ros.nodes.{module}")
        messages = importlib.import_module("omsm_ros.messages")
    with messages.written_for(messages.NODE):
        getattr(node, function)()


def _check_open_files(name: str) -> None:
    """Exit if too few files may be opened: ROS would hang, or end silently."""
    if (most := open_files()) < FEWEST_OPEN_FILES:
        print(
            f"{name}: too few open files: a process may hold {most} here, and a node needs "
            f"{FEWEST_OPEN_FILES}; {MORE_FILES}",
            file=sys.stderr,
        )
        sys.exit(_BAD_INPUT)


def end_with_launch() -> None:
    """Let SIGTERM be sent to this process when the launch that started it ends.

    ``ros2 launch`` passes Ctrl-C on to its nodes; SIGTERM, as of ``docker stop``, or SIGKILL would
    end it alone, and its nodes would keep the device and the recording.
    """
    launch = os.environ.pop(LAUNCHED_BY, "")
    if not launch or sys.platform != "linux":
        return
    child = launch == str(os.getppid())  # not of a prefix, such as a terminal or debugger
    if child:
        end_with_parent(signal.SIGTERM)
    if (child and launch != str(os.getppid())) or not os.path.exists(f"/proc/{launch}"):
        sys.exit(f"the launch that started this node ({launch}) has ended")


def set_up_fast_dds() -> None:
    """Let Fast DDS use our profile (``fast_dds.xml``), unless the user has chosen another.

    With ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` it is ``fast_dds_local.xml``, which uses the
    loopback interface only: otherwise another computer reaches a node by ``ROS_STATIC_PEERS``.

    Messages use UDP. With shared memory, a subscriber that pauses for a second or two loses its
    queue, while its messages keep their places in the publisher's segment; once that is fragmented,
    sending again fails silently until the memory is freed.

    Discovery messages are also sent from a thread, which Fast DDS 2.14 does only with a limit on
    the bytes per second. Otherwise the answers arrive before the participant can receive them, and
    others are discovered only at their next announcement, up to three seconds later.

    The memory of a message is freed after delivery. In the default pool each place stays as large
    as its largest message, and each backlog adds places.
    """
    chosen = any(os.environ.get(name) for name in _TRANSPORTS_CHOSEN)
    if not chosen and not any(Path(name).exists() for name in _PROFILES_OF_FOLDER):
        second = os.environ.get("ROS_DISTRO", "") in _WITH_FAST_DDS_2
        local = os.environ.get(_RANGE, "").strip().upper() == "LOCALHOST"
        profile = f"fast_dds{'' if second else '_3'}{'_local' if local else ''}.xml"
        os.environ[_PROFILES[second]] = str(Path(__file__).with_name(profile))
        if not os.environ.get(_PUBLICATION_MODE):
            os.environ.setdefault(_MORE_FROM_PROFILE, "1")
    # From its own thread, so that a blocked subscriber blocks no publisher: it would wait for a
    # second or more; after 0.1 s Fast DDS drops the message, and later ones reach that subscriber
    # only when its queue has overflowed.
    os.environ.setdefault(_PUBLICATION_MODE, "ASYNCHRONOUS")


if __name__ == "__main__":
    del sys.argv[0]
    main()
