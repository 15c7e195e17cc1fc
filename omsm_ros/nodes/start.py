"""Where the command of every node begins; without ROS it ends there, in one line with the remedy.

Nothing is imported here that takes time: a Ctrl-C while the rest loads is an end like any other.

``pip install`` puts the commands of the nodes beside ``omsm``, and ``ros2 run`` finds them in a
workspace whose messages were not built. ``python -m omsm_ros.nodes.start corrector …`` is the same.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
from pathlib import Path

from omsm_ros.errors import FEWEST_OPEN_FILES, MORE_FILES, open_files
from omsm_ros.loading import exit_on_signal_while_loading, one_thread_of_blas
from omsm_ros.nodes.memory import use_single_malloc_arena

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask a node to end."""

LAUNCHED_BY = "OMSM_LAUNCHED_BY"
"""Variable with the process number of the launch that started a node, and that it ends with."""

_PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
_PROFILES_OF_FOLDER = "DEFAULT_FASTRTPS_PROFILES.xml"  # is read too, where it exists
_TRANSPORTS_CHOSEN = (_PROFILES, "FASTDDS_BUILTIN_TRANSPORTS")
_MORE_FROM_PROFILE = "RMW_FASTRTPS_USE_QOS_FROM_XML"  # memory and mode, and not by the next
_PUBLICATION_MODE = "RMW_FASTRTPS_PUBLICATION_MODE"
_BAD_INPUT = 2
_PR_SET_PDEATHSIG = 1  # of <linux/prctl.h>
_OF_ITS_OWN = ("corrector", "calibrator", "vibration_monitor", "recorder", "player", "viewer",
               "cell_emulator", "cell_demo")  # fmt: skip
_DRIVERS = ("confocal_driver", "axis_driver", "reference_driver", "accelerometer_driver")
NODES = {
    **{name: f"{name}_node:main" for name in _OF_ITS_OWN},
    **{name: f"driver:{name}" for name in _DRIVERS},
    "replay": "player_node:main",
}
"""The commands, and the ``module:function`` that runs each."""
_NO_ROS = (
    "ROS 2 Jazzy is not in this Python: source /opt/ros/jazzy/setup.bash, or '. ./env.sh' after "
    "'make setup' in a checkout; the offline commands (omsm) need none"
)
_NO_MESSAGES = (
    "the messages of omsm_ros are not built, or not sourced: 'colcon build --base-paths src "
    "src/omsm_ros/msg_defs' and source install/setup.bash, or 'make setup' and '. ./env.sh'"
)
_NEEDED = {"rclpy": _NO_ROS, "omsm_msgs": _NO_MESSAGES}


def main() -> None:
    """Run the node that the command is named for."""
    name = Path(sys.argv[0]).stem
    if name not in NODES:
        sys.exit(f"no node {name!r}, expected one of {sorted(NODES)}")
    _check_open_files(name)
    with exit_on_signal_while_loading(ENDING):
        use_single_malloc_arena(ENDING)  # first, for the process may begin again
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
    """End where ROS could not begin: short of files, it hangs, or ends without a word."""
    if (most := open_files()) < FEWEST_OPEN_FILES:
        print(
            f"{name}: too few open files: a process may hold {most} here, and a node needs "
            f"{FEWEST_OPEN_FILES}; {MORE_FILES}",
            file=sys.stderr,
        )
        sys.exit(_BAD_INPUT)


def end_with_launch() -> None:
    """Let SIGTERM be sent to this process when the launch that started it ends, however it does.

    ``ros2 launch`` hands Ctrl-C on; a SIGTERM, as ``docker stop`` sends one, or a SIGKILL ends it
    alone, and its nodes would keep the device and the recording until somebody finds them.
    """
    launch = os.environ.pop(LAUNCHED_BY, "")
    if not launch or sys.platform != "linux":
        return
    child = launch == str(os.getppid())  # and not a child of a prefix, as a terminal or debugger
    if child:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if (child and launch != str(os.getppid())) or not os.path.exists(f"/proc/{launch}"):
        sys.exit(f"the launch that started this node ({launch}) has ended")


def set_up_fast_dds() -> None:
    """Let Fast DDS take what our profile (``fast_dds.xml``) says, unless the user has chosen.

    Messages come by UDP. A listener that stands still for a second or two has its queue in shared
    memory replaced, and what waited there keeps its places in the sender's memory, which soon has
    room in small pieces alone. What was missed is sent again in large ones: each fails without a
    word, again and again, until something else frees that memory.

    Its first word to the processes that are there is sent from a thread, too, which Fast DDS 2.14
    does only under a limit to the bytes of a second. Otherwise their answers come before it listens
    to them, are lost, and who was there is known only when he announces himself anew, up to three
    seconds later.

    The memory of a message is freed when all have it. In the pool that is the default, each place
    stays as large as the largest message that it ever held, and the longest wait adds places.
    """
    chosen = any(os.environ.get(name) for name in _TRANSPORTS_CHOSEN)
    if not chosen and not Path(_PROFILES_OF_FOLDER).exists():
        os.environ[_PROFILES] = str(Path(__file__).with_name("fast_dds.xml"))
        if not os.environ.get(_PUBLICATION_MODE):
            os.environ.setdefault(_MORE_FROM_PROFILE, "1")
    _send_from_own_thread()


def _send_from_own_thread() -> None:
    """Let Fast DDS send from a thread of its own: a listener that stands still stops nobody.

    Whoever publishes would wait for it, a second and more; after 0.1 s Fast DDS forgets to send the
    message at all, and what follows it reaches that listener only when the queue has run over.
    """
    os.environ.setdefault(_PUBLICATION_MODE, "ASYNCHRONOUS")


if __name__ == "__main__":
    del sys.argv[0]
    main()
