"""Driver, calibrator and corrector of a real cell (needs the full ROS 2 distribution).

ros2 launch omsm_ros cell.launch.py config:=/path/to/folder
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node

NODES = ("confocal_driver", "calibrator", "corrector")


def generate_launch_description() -> LaunchDescription:
    """Each node with its YAML of the folder ``config``."""
    shipped = str(Path(get_package_share_directory("omsm_ros")) / "config")
    folder = LaunchConfiguration("config")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "config", default_value=shipped, description="folder of the nodes' YAML files"
            ),
            *(
                Node(
                    package="omsm_ros",
                    executable=name,
                    parameters=[PathJoinSubstitution([folder, f"{name}.yaml"])],
                    output="screen",
                )
                for name in NODES
            ),
        ]
    )
