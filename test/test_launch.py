"""Check what the launch file starts, with substitutes for launch and launch_ros."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from launch_stand_in import modules, nodes_of

import omsm_ros
from omsm_ros.nodes.start import LAUNCHED_BY

ROOT = Path(omsm_ros.__file__).resolve().parent.parent


@pytest.fixture
def launch(monkeypatch):
    """Call with arguments; the nodes by their names."""
    for name, module in modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    return lambda **given: {n.executable: n for n in nodes_of("cell.launch.py", **given)}


def test_a_real_cell_is_what_its_yaml_says(launch):
    nodes = launch()
    assert set(nodes) == {"confocal_driver", "calibrator", "corrector"}
    for name, node in nodes.items():
        assert node.parameters == [str(ROOT / "config" / f"{name}.yaml")]
        assert node.namespace == "omsm"
        assert not node.respawn


@pytest.mark.parametrize("device", ["six_channel", "chrocodile", "chrocodile_packet"])
def test_an_emulated_cell_reads_what_is_played(launch, device, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    nodes = launch(emulated="true", device=device, namespace="cell2")
    _, emulator = nodes["cell_emulator"].parameters
    _, driver = nodes["confocal_driver"].parameters
    assert emulator["link"] == driver["port"]
    assert emulator["device"] == driver["device"] == device
    assert driver["z.counts_per_unit"] > 0
    assert {node.namespace for node in nodes.values()} == {"cell2"}


def test_two_emulated_cells_have_ports_of_their_own(launch, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    for device in ("six_channel", "chrocodile_packet"):
        links = {
            launch(emulated="true", device=device, namespace=name)["cell_emulator"].parameters[1][
                "link"
            ]
            for name in ("omsm", "cell2")
        }
        assert len(links) == 2


def test_arguments_reach_the_nodes(launch):
    nodes = launch(record="scan.mcap", rviz="true", log_level="debug", respawn="true")
    assert nodes["recorder"].parameters[1] == {"path": "scan.mcap", "numbered": True}
    assert nodes["corrector"].respawn
    assert nodes["corrector"].arguments == ["--ros-args", "--log-level", "debug"]
    assert Path(nodes["rviz2"].arguments[1]).is_file()


def test_nodes_end_with_a_launch_that_cannot_tell_them(launch):
    """It is killed, or was before they had begun to listen for that."""
    reported = {made.additional_env[LAUNCHED_BY] for made in launch(record="x").values()}
    assert reported == {str(os.getpid())}
    node = (
        "from omsm_ros.nodes.start import end_with_launch; end_with_launch(); import time;"
        "print('begins', flush=True); time.sleep(10); print('left alone')"
    )
    start = (
        "import os, subprocess, sys;"
        f"told = os.environ | {{{LAUNCHED_BY!r}: str(os.getpid())}};"
        f"subprocess.run([sys.executable, '-c', {node!r}], env=told)"
    )
    with subprocess.Popen([sys.executable, "-c", start], stdout=subprocess.PIPE, cwd=ROOT) as made:
        assert made.stdout.readline() == b"begins\n"
        made.kill()
        assert made.stdout.read() == b""
    reported = os.environ | {LAUNCHED_BY: str(made.pid)}
    late = subprocess.run([sys.executable, "-c", node], env=reported, cwd=ROOT, capture_output=True)
    assert late.returncode == 1
    assert b"has ended" in late.stderr


@pytest.mark.parametrize(
    ("argument", "hint"),
    [("recrod:=scan.mcap", "did you mean record:=?"), ("xyz:=1", "--show-args lists them")],
)
def test_an_unknown_argument_is_reported(launch, caplog, argument, hint):
    """A misspelt argument would leave a scan unrecorded, or start a real device."""
    launch(argv=[argument])
    (said,) = caplog.messages
    assert f"no argument {argument.split(':=')[0]!r}; {hint}" in said
    caplog.clear()
    launch(record="scan.mcap")
    assert not caplog.messages


def test_a_folder_without_the_yaml_is_an_error(launch, tmp_path):
    with pytest.raises(FileNotFoundError, match="confocal_driver"):
        launch(params=str(tmp_path))


def test_what_has_no_emulator_is_named(launch):
    with pytest.raises(ValueError, match="'analog' has no emulator"):
        launch(emulated="true", device="analog")


def test_a_recording_into_no_folder_is_an_error(launch, tmp_path):
    with pytest.raises(FileNotFoundError, match="its folder does not exist"):
        launch(record=str(tmp_path / "nowhere" / "scan.mcap"))


@pytest.mark.parametrize(
    ("given", "prefix"),
    [
        ({"namespace": "omsm"}, None),
        ({"namespace": "/cell2/"}, "cell2/"),
        ({"namespace": "cell2", "frame_prefix": "left_"}, "left_"),
    ],
)
def test_each_further_cell_has_frames_of_its_own(launch, given, prefix):
    nodes = launch(**given)
    for name in ("confocal_driver", "corrector"):
        more = [p for p in nodes[name].parameters if isinstance(p, dict)]
        assert more == ([{"frame_prefix": prefix}] if prefix else [])
