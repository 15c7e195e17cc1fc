"""Play a recording to a corrector; end when all of it is corrected (needs the full ROS 2).

ros2 launch omsm_ros replay.launch.py bag:=scan.mcap calibration:=cal.json [rate:=0]
"""

from __future__ import annotations

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from omsm_ros.nodes.start import LAUNCHED_BY

ARGUMENTS = {
    "bag": (None, "the .mcap file or rosbag2 folder to play"),
    "calibration": ("", "calibration file; empty takes the one that the bag holds"),
    "rate": ("1.0", "seconds of the bag a second; 0 = no faster than the corrector takes it"),
    "cell": ("", "namespace of the cell in the bag; empty = the only one"),
    # Fast DDS may announce an existing node to a new one only after three seconds; then they
    # exchange what they subscribe to.
    "delay": ("3.5", "seconds to wait until all subscribers are known; 0 = begin at once"),
    "namespace": ("/replay", "namespace of the player, separate from a live cell"),
}


def _text(name: str) -> ParameterValue:
    return ParameterValue(LaunchConfiguration(name), value_type=str)


def generate_launch_description() -> LaunchDescription:
    """Return player and corrector in a separate namespace; the end of one ends both."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=described)
        for name, (default, described) in ARGUMENTS.items()
    ]
    namespace = LaunchConfiguration("namespace")
    launched = {LAUNCHED_BY: str(os.getpid())}
    corrector = Node(
        package="omsm_ros",
        executable="corrector",
        namespace=namespace,
        additional_env=launched,
        parameters=[{"calibration": _text("calibration")}],
        output="screen",
    )
    player = Node(
        package="omsm_ros",
        executable="replay",
        namespace=namespace,
        additional_env=launched,
        parameters=[
            {
                "bag": _text("bag"),
                "cell": _text("cell"),
                "wait_for": "corrector",
                # Any type is passed on: the player reports a wrong one.
                "rate": ParameterValue(LaunchConfiguration("rate")),
                "delay": ParameterValue(LaunchConfiguration("delay")),
            }
        ],
        output="screen",
    )
    ends = [
        RegisterEventHandler(OnProcessExit(target_action=each, on_exit=ended))
        for each in (corrector, player)
    ]
    return LaunchDescription([*declared, corrector, player, *ends])


def ended(event: ProcessExited, context: LaunchContext) -> list[Shutdown]:
    """End the launch when one node ends; raise RuntimeError if it failed."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(
            f"not all was played: {event.process_name} ended with exit code {event.returncode}; "
            "its last line gives the reason"
        )
    return [Shutdown(reason=f"{event.process_name} ended")]
