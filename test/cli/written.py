"""Write recordings as bags, and read the facts that a command prints."""

import json
from unittest import mock

from omsm_ros import cli
from omsm_ros.cli import command_line
from omsm_ros.cli.command import table
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.twin.cell import blocks_of

SPHERE_RADIUS_M = 0.05


def write(path, recording):
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks_of(recording, 1000):
            bag.write_block(axes)
            bag.write_block(distance)
    return path


def facts(capsys, *arguments):
    """Run a command; return its JSON. The findings are printed as text for people, too."""
    with mock.patch.object(command_line, "_tell", wraps=command_line._tell) as tell:
        assert cli.main([*map(str, arguments), "--json"]) == 0
    machine = json.loads(capsys.readouterr().out)
    args, found = tell.call_args.args
    table(args.run.show(found) or [])
    assert capsys.readouterr().out.strip()
    return machine
