"""Start a cell: driver, calibrator and corrector, real or emulated, recorded, shown in RViz.

ros2 launch omsm_ros cell.launch.py params:=/path/to/my_cell
ros2 launch omsm_ros cell.launch.py emulated:=true namespace:=cell2 record:=scan.mcap
"""

import os
from difflib import get_close_matches
from pathlib import Path
from zlib import crc32

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from omsm_ros.instruments.emulator_factory import EMULATED, emulated
from omsm_ros.io.files import runtime_folder
from omsm_ros.nodes.start import LAUNCHED_BY

Parameters = dict[str, object]
SHARE = Path(get_package_share_directory("omsm_ros"))
ARGUMENTS = {
    "namespace": ("omsm", "namespace of all nodes and topics; a different one for each cell", None),
    "device": ("", "connected device; empty = as in the YAML", None),
    "emulated": ("false", "start the digital twin and read it", ["true", "false"]),
    "record": ("", ".mcap file to record into; empty = none", None),
    "frame_prefix": ("", "before each frame; empty = NAMESPACE/ unless it is omsm", None),
    "foxglove": ("false", "start foxglove_bridge, if it is installed", ["true", "false"]),
    "view": ("false", "show the scan in a browser", ["true", "false"]),
    "rviz": ("false", "show the points in RViz", ["true", "false"]),
    "params": (str(SHARE / "config"), "folder of the nodes' YAML files", None),
    "log_level": ("info", "log level of every node", ["debug", "info", "warn", "error", "fatal"]),
    "respawn": ("false", "restart a node that has ended by itself", ["true", "false"]),
}


def generate_launch_description() -> LaunchDescription:
    """Return the nodes to start, once the arguments are known."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, (default, text, choices) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=cell)])


def cell(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for."""
    warn_of_others(context.argv)
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    where = given["namespace"].strip("/")
    prefix = given["frame_prefix"] or ("" if where == "omsm" else f"{where}/")
    framed: Parameters = {"frame_prefix": prefix} if prefix else {}
    driver: Parameters = {"device": given["device"]} if given["device"] else {}
    if given["record"] and not Path(given["record"]).absolute().parent.is_dir():
        # The recorder would end alone, and the cell go on without a recording.
        raise FileNotFoundError(f"record:={given['record']}: its folder does not exist")
    nodes = []
    if given["emulated"] == "true":
        played, driver, companion = twin(given["namespace"], given["device"] or "six_channel")
        nodes.append(node(given, "cell_emulator", played))
        nodes += [node(given, name, given_by | framed) for name, given_by in companion.items()]
    nodes += [
        node(given, "confocal_driver", driver | framed),
        node(given, "calibrator", {}),
        node(given, "corrector", framed),
    ]
    if given["record"]:
        # A restarted recorder continues in a further file.
        goes_on = given["respawn"] == "true"
        nodes.append(node(given, "recorder", {"path": given["record"], "numbered": goes_on}))
    if given["foxglove"] == "true":
        nodes.append(foxglove_bridge())
    if given["view"] == "true":
        nodes.append(node(given, "viewer", {}))
    if given["rviz"] == "true":
        nodes.append(rviz(given["namespace"]))
    return nodes


def warn_of_others(arguments: list[str]) -> None:
    """Warn of unknown arguments, which launch ignores silently."""
    for name in (text.split(":=")[0] for text in arguments):
        if name not in ARGUMENTS:
            near = get_close_matches(name, ARGUMENTS, 1)
            hint = f"did you mean {near[0]}:=?" if near else "--show-args lists them"
            get_logger("omsm_ros").warning(f"cell.launch.py has no argument {name!r}; {hint}")


def node(given: dict[str, str], name: str, parameters: dict[str, object]) -> Node:
    """Return a node with its YAML file, overridden by ``parameters``."""
    file = Path(given["params"]) / f"{name}.yaml"
    if not file.is_file():
        # launch would continue with the defaults.
        raise FileNotFoundError(f"no parameters for {name} at {str(file)!r}; check params:=")
    return Node(
        package="omsm_ros",
        executable=name,
        namespace=given["namespace"],
        parameters=[str(file), *([parameters] if parameters else [])],
        arguments=["--ros-args", "--log-level", given["log_level"]],
        additional_env={LAUNCHED_BY: str(os.getpid())},
        respawn=given["respawn"] == "true",
        respawn_delay=1.0,
        output="screen",
    )


def twin(namespace: str, device: str) -> tuple[Parameters, Parameters, dict[str, Parameters]]:
    """Return the parameters of the emulator, of its driver, and of a second driver, if any."""
    if device not in EMULATED:
        raise ValueError(f"device {device!r} has no emulator, expected one of {sorted(EMULATED)}")
    known = emulated(device)
    serial = str(runtime_folder(namespace) / "cell")
    # A different port for each cell, else a second driver would read the device of the first cell.
    tcp = f"tcp://127.0.0.1:{7000 + crc32(namespace.strip('/').encode()) % 1000}"
    port = tcp if known.tcp else serial
    played = {"device": device, "link": port}
    driver = {"device": device, "port": port, **known.driver}
    if known.second is None:
        return played, driver, {}
    second = tcp if known.second.tcp else f"{serial}_beside"
    played["link_beside"] = second
    return played, driver, {known.second.node: {"port": second, **known.second.driver}}


def foxglove_bridge() -> Node:
    """Return the bridge of Foxglove, on this computer only."""
    get_package_share_directory("foxglove_bridge")  # raises an error that names the package
    return Node(
        package="foxglove_bridge",
        executable="foxglove_bridge",
        parameters=[{"address": "127.0.0.1"}],
        output="screen",
    )


def rviz(namespace: str) -> Node:
    """Return RViz with the shipped layout."""
    return Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(SHARE / "config" / "cell.rviz")],
        remappings=[("/omsm/points", f"/{namespace.strip('/')}/points")],
    )
