"""Nodes as processes of their own: started together, ended together, their output kept."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from omsm_ros.errors import OmsmError

_END_TIMEOUT_S = 15.0


class NodeProcesses:
    """Starts nodes of this package; a context manager that leaves none behind.

    Each node's output goes to ``<folder>/<node>.log``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> NodeProcesses:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, node: str, **parameters: object) -> None:
        """Start ``node`` with ROS parameters."""
        self.start_as(node, node, (), **parameters)

    def start_as(
        self, label: str, node: str, arguments: Sequence[str], **parameters: object
    ) -> None:
        """Start ``node``, called ``label`` here, with arguments for ROS and parameters."""
        command = [sys.executable, "-m", "omsm_ros.nodes.start", node, "--ros-args", *arguments]
        for name, value in parameters.items():
            command += ["-p", f"{name}:={_parameter_text(value)}"]
        with (self._folder / f"{label}.log").open("ab") as log:
            self._running[label] = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    def pid(self, node: str) -> int:
        """Return the process number of a running node."""
        return self._running[node].pid

    def check(self) -> None:
        """Raise OmsmError with the last words of a node that ended by itself."""
        for name, process in self._running.items():
            if process.poll() is not None:
                lines = (self._folder / f"{name}.log").read_text(errors="replace").split("\n")
                said = next((line for line in reversed(lines) if line.strip()), "nothing")
                raise OmsmError(f"{name} ended with exit code {process.returncode}: {said}")

    def end(self, *nodes: str, how: signal.Signals = signal.SIGINT) -> None:
        """End ``nodes`` (all of them if none is named) and wait; OmsmError if one had failed."""
        names = nodes or tuple(self._running)
        for name in names:
            self._running[name].send_signal(how)
        codes = {name: self._wait(name) for name in names}
        wrong = {name: code for name, code in codes.items() if code not in (0, -how)}
        if wrong:
            raise OmsmError(f"nodes ended badly (exit codes {wrong!r}); see {self._folder}")

    def _wait(self, name: str) -> int:
        process = self._running.pop(name)
        try:
            return process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return -signal.SIGKILL

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for process in self._running.values():
            process.send_signal(signal.SIGINT)
        for name in tuple(self._running):
            self._wait(name)


def _parameter_text(value: object) -> str:
    # Parsed as YAML, of which JSON is a part; a float keeps its point there.
    return json.dumps(value)
