"""``cell``: runs the nodes of a cell in one process.

All share one thread, so one that computes delays the others: for rates beyond some kHz start each
node as a process, as the launch file does.
"""

import argparse
import importlib
import os
import sys
from pathlib import Path

import rclpy.utilities

from omsm_ros.errors import ConfigurationError, one_line
from omsm_ros.loading import exit_on_signal_while_loading
from omsm_ros.nodes.managed import ARGUMENTS
from omsm_ros.nodes.running import run
from omsm_ros.nodes.start import ENDING, NODES

_CELL = "confocal_driver calibrator corrector"
_OTHERS = ("replay", "player", "cell", "cell_demo")
_BAD_INPUT, _ROS = 2, "--ros-args"


def main() -> None:
    """Run ``ros2 run omsm_ros cell``."""
    parser = argparse.ArgumentParser(prog="cell", description="run a cell in one process")
    parser.add_argument("--nodes", default=_CELL, help=f"with spaces between; default: {_CELL}")
    parser.add_argument("--params", type=Path, help="folder of a YAML file for each node")
    try:
        args = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
        names = args.nodes.split()
        given = sys.argv[sys.argv.index(_ROS) :] if _ROS in sys.argv else []
        for name in names:
            if name not in NODES or name in _OTHERS:
                known = sorted(NODES.keys() - set(_OTHERS))
                raise ConfigurationError(f"--nodes {name!r}, expected of {known}")
            file = (args.params or shipped()) / f"{name}.yaml"
            if not file.is_file():
                raise ConfigurationError(f"no parameters for {name} at {str(file)!r}; see --params")
            # Those of the user come after the file, and so prevail.
            ARGUMENTS[name] = ["--ros-args", "--params-file", str(file), *given]
    except (ConfigurationError, RuntimeError) as err:  # RuntimeError of invalid arguments for ROS
        print(f"cell: {one_line(err).split(', at ')[0]}", file=sys.stderr)
        sys.exit(_BAD_INPUT)
    with exit_on_signal_while_loading(ENDING):
        makers = [_maker(name) for name in names]
    run(*makers)


def shipped() -> Path:
    """Return the folder of the shipped parameters."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if (folder := Path(prefix) / "share" / "omsm_ros" / "config").is_dir():
            return folder
    return Path(__file__).resolve().parents[2] / "config"


def _maker(name: str):  # type: ignore[no-untyped-def]
    """Return the class of a node, which its module runs by ``partial(run, class)``."""
    module, _, function = NODES[name].partition(":")
    return getattr(importlib.import_module(f"omsm_ros.nodes.{module}"), function).args[0]
