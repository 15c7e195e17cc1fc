"""Write recordings as bags, and read the facts that a command prints."""

import json

from omsm_ros import cli
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
    assert cli.main([*map(str, arguments), "--json"]) == 0
    machine = json.loads(capsys.readouterr().out)
    assert cli.main([*map(str, arguments)]) == 0
    assert capsys.readouterr().out.strip()
    return machine
