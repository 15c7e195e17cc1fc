"""Several nodes in one process, each with its own parameters."""

import signal
import sys
from functools import partial

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from omsm_ros.nodes import cell_node, managed, running
from omsm_ros.nodes.cell_emulator_node import CellEmulatorNode
from omsm_ros.nodes.driver import ConfocalDriverNode


def started(monkeypatch, *arguments):
    """The classes that are run, for these arguments."""
    run = []
    monkeypatch.setattr(managed, "ARGUMENTS", {})
    monkeypatch.setattr(cell_node, "ARGUMENTS", managed.ARGUMENTS)
    monkeypatch.setattr(cell_node, "run", lambda *makers: run.extend(makers))
    monkeypatch.setattr(sys, "argv", ["cell", *arguments])
    cell_node.main()
    return [maker.__name__ for maker in run]


def test_each_node_has_its_file_and_the_arguments_of_the_user_prevail(monkeypatch):
    ros = ("--ros-args", "-r", "__ns:=/cell2")
    nodes = started(monkeypatch, "--nodes", "corrector recorder", *ros)
    assert nodes == ["CorrectorNode", "RecorderNode"]
    given = managed.ARGUMENTS["corrector"]
    assert given[:2] == ["--ros-args", "--params-file"]
    assert given[2].endswith("config/corrector.yaml")
    assert tuple(given[3:]) == ros


def test_ctrl_c_while_the_nodes_load_is_an_orderly_end(monkeypatch):
    make, found, before = cell_node._maker, [], signal.getsignal(signal.SIGINT)

    def load(name):
        found.append(signal.getsignal(signal.SIGINT))
        return make(name)

    monkeypatch.setattr(cell_node, "_maker", load)
    started(monkeypatch, "--nodes", "corrector")
    assert found[0].__qualname__.startswith("exit_on_signal_while_loading")
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("name", ["corector", "cell", "replay"])
def test_a_node_that_is_none_is_refused_in_one_line(monkeypatch, capsys, name):
    with pytest.raises(SystemExit) as ended:
        started(monkeypatch, "--nodes", name)
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_folder_without_the_file_is_named(monkeypatch, capsys, tmp_path):
    with pytest.raises(SystemExit):
        started(monkeypatch, "--params", str(tmp_path))
    assert str(tmp_path) in capsys.readouterr().err


def test_the_emulator_closes_after_those_that_read_its_port(monkeypatch):
    closed = []

    class Node:
        fatal = None

        def __init__(self, kind):
            self.kind, self.closes_last = kind, kind.closes_last

        def start(self):
            pass

        def close(self):
            closed.append(self.kind)

        def destroy_node(self):
            pass

    for name in ("_init", "_SignalEnd", "_spin", "_ignore_signals", "freeze_garbage_collector"):
        monkeypatch.setattr(running, name, lambda *_: None)
    monkeypatch.setattr(running.rclpy, "try_shutdown", lambda: None)
    kinds = (CellEmulatorNode, ConfocalDriverNode)
    running.run(*(partial(Node, kind) for kind in kinds))
    assert closed == [ConfocalDriverNode, CellEmulatorNode]
