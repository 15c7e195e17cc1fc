"""Levels of the vibration monitor are read from a bag."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.cli import main
from omsm_ros.cli.recordings import inspect_bag
from omsm_ros.core.ripple.accelerometer import MonitorOptions, RunningSpectrum
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.errors import BagError
from omsm_ros.io import bags, json_and_yaml
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.message_mapping import typestore, vibration_levels
from omsm_ros.io.topics import VIBRATION_TOPIC

SIZE, FREQUENCY = 50e-9, 680.0


def levels():
    """Acceleration of a probe that vibrates by 50 nm at 680 Hz."""
    time = np.arange(8000) / 4000.0
    z = SIZE * (2 * np.pi * FREQUENCY) ** 2 * np.sin(2 * np.pi * FREQUENCY * time)
    running = RunningSpectrum(MonitorOptions())
    running.push(AccelerationBlock(stamp_ns=0, first_sample=0, sample_period=2.5e-4,
                                   x=0 * z, y=0.1 * z, z=z))  # fmt: skip
    return running.levels()


def reported(found=None, **changes):
    return {**(found or levels()).entry(), "alarm": True, "limit": 2e-8, **changes}


def record(path, *states):
    text = typestore().types["std_msgs/msg/String"]
    with BagWriter(path, (bags.AXES_TOPIC, VIBRATION_TOPIC)) as bag:
        for k, state in enumerate(states):
            bag.write(VIBRATION_TOPIC, 10**9 * k, text(data=json_and_yaml.text_of(state)))
    return path


def test_levels_go_through_a_bag_and_are_reported(tmp_path, capsys):
    quiet = replace(levels(), height=None, height_total=None)
    states = [reported(), reported(quiet, alarm=False)]
    path = record(tmp_path / "a.mcap", *states)
    with bags.BagReader(path) as bag:
        assert bag.vibration() == json.loads(json.dumps(states))
    found = inspect_bag(path)["vibration"]
    assert found["height_total"] == pytest.approx(SIZE / 2**0.5, rel=0.03)
    band = [low <= FREQUENCY < high for low, high in found["bands"]].index(True)
    assert found["height"][band] == pytest.approx(SIZE / 2**0.5, rel=0.03)
    assert found["rms"]["y"][band] == pytest.approx(0.1 * found["rms"]["z"][band], rel=1e-6)
    assert (found["spectra"], found["alarms"]) == (2, 1)
    assert main(["inspect", str(path)]) == 0
    said = capsys.readouterr().out
    assert "on a height at most 35" in said
    assert "alarm in 1 of 2 spectra" in said
    assert "500 to 2000 Hz" in said


def test_an_effect_that_nobody_knows_is_said_to_be_none(tmp_path, capsys):
    quiet = replace(levels(), height=None, height_total=None)
    path = record(tmp_path / "a.mcap", reported(quiet))
    assert inspect_bag(path)["vibration"]["height"] is None
    main(["inspect", str(path)])
    assert "not evaluated: no calibration" in capsys.readouterr().out


def test_a_bag_without_levels_has_none(tmp_path, capsys):
    path = record(tmp_path / "a.mcap")
    assert inspect_bag(path)["vibration"] is None
    assert main(["inspect", str(path)]) == 0
    assert "alarm in" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({}, "bands is required"),
        (reported(alarm="yes"), "alarm is 'yes'"),
        (reported(height=[1e-9]), "levels, expected one of each"),
        (reported(rms={"x": [-1.0], "y": [1.0], "z": [1.0]}), "rms"),
        (reported(extra=1), "'extra' is unknown"),
    ],
)
def test_what_is_no_level_is_refused_in_one_line(tmp_path, capsys, state, said):
    with pytest.raises(BagError, match=said):
        vibration_levels(SimpleNamespace(data=json_and_yaml.text_of(state)))
    path = record(tmp_path / "a.mcap", state)
    assert main(["inspect", str(path)]) == 2
    assert said in capsys.readouterr().err
