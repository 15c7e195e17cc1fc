"""Stand-ins for launch and launch_ros, which wheels lack: what a launch file would start."""

import importlib.util
import logging
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent


@dataclass
class Node:
    package: str
    executable: str
    arguments: list
    namespace: str = ""
    parameters: list = field(default_factory=list)
    remappings: list = field(default_factory=list)
    additional_env: dict = field(default_factory=dict)
    respawn: bool = False
    respawn_delay: float = 0.0
    output: str = ""


class Argument:
    def __init__(self, name, default_value, description, choices):
        self.name, self.default = name, default_value
        assert description
        assert choices is None or default_value in choices


class Configuration:
    def __init__(self, name):
        self.name = name

    def perform(self, context):
        return context[self.name]


class Context(dict):
    """Configurations by name; ``argv`` are the arguments of the command line."""

    argv = ()


class Function:
    def __init__(self, function):
        self.function = function


MODULES = {
    "launch": {"LaunchContext": Context, "LaunchDescription": list},
    "launch.actions": {"DeclareLaunchArgument": Argument, "OpaqueFunction": Function},
    "launch.logging": {"get_logger": logging.getLogger},
    "launch.substitutions": {"LaunchConfiguration": Configuration},
    "launch_ros": {},
    "launch_ros.actions": {"Node": Node},
    "ament_index_python": {},
    "ament_index_python.packages": {"get_package_share_directory": lambda _: str(ROOT)},
}


def modules():
    """The stand-ins by their names, for ``sys.modules``."""
    made = {}
    for name, content in MODULES.items():
        made[name] = ModuleType(name)
        made[name].__dict__.update(content)
    return made


def nodes_of(file, argv=(), **given):
    """The nodes that a launch file starts, with arguments; its modules must be the stand-ins."""
    spec = importlib.util.spec_from_file_location("launched", ROOT / "launch" / file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    *arguments, opaque = module.generate_launch_description()
    unknown = set(given) - {argument.name for argument in arguments}
    assert not unknown, f"{file} has no arguments {sorted(unknown)}"
    context = Context({argument.name: argument.default for argument in arguments} | given)
    context.argv = [*argv, *(f"{name}:={value}" for name, value in given.items())]
    return opaque.function(context)
