"""Nodes as forks of one process that has loaded them, which saves each a second of imports.

A fork runs what the command of the node runs. It reports its state five times a second, not once,
so that a test which waits for a report waits less. The process reads a request a line from stdin
and answers it with a line: start a node, or tell how one has ended.
"""

import atexit
import gc
import importlib
import inspect
import json
import os
import signal
import subprocess
import sys
import threading
import time
import traceback

from omsm_ros.nodes import start
from omsm_ros.nodes.cell_demo_node import NodeProcesses
from omsm_ros.nodes.memory import use_single_malloc_arena

REPORT_PERIOD_S = 0.2


class NodeServer:
    """The process that forks nodes, as seen by the tests; a context manager that ends it."""

    def __enter__(self):
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        return self

    def __exit__(self, *_):
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(10.0)

    def ask(self, **request):
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def start(self, command, log):
        """Fork a node with such words of a command, its environment and folder being ours."""
        surroundings = {"environment": dict(os.environ), "folder": os.getcwd(), "log": str(log)}
        return ForkedProcess(self, self.ask(command=command, **surroundings))


class ForkedProcess:
    """A fork, with the part of ``subprocess.Popen`` that is used here."""

    def __init__(self, server, pid):
        self._server, self.pid, self.returncode = server, pid, None

    def poll(self):
        if self.returncode is None:
            self.returncode = self._server.ask(pid=self.pid)
        return self.returncode

    def wait(self, timeout=None):
        until = time.monotonic() + timeout if timeout is not None else float("inf")
        while self.poll() is None:
            if time.monotonic() > until:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout)
            time.sleep(0.01)
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)


class ForkedNodes(NodeProcesses):
    """Starts nodes as forks."""

    def __init__(self, folder, server):
        super().__init__(folder)
        self._server = server

    def start(self, node, *arguments, label="", **parameters):
        label = label or node
        given = (w for n, v in parameters.items() for w in ("-p", f"{n}:={json.dumps(v)}"))
        command = [node, "--ros-args", *arguments, *given]
        self._running[label] = self._server.start(command, self._folder / f"{label}.log")


LATER = ("rcl_interfaces.msg._parameter_event", "rosidl_generator_py", "jsonschema",
         "omsm_ros.pipelines.verify_calibration", "omsm_ros.instruments.six_channel.device",
         "omsm_ros.instruments.six_channel.emulator")  # fmt: skip
"""What a node imports when it needs it."""


def load():
    """Import what every node imports, have what their first lines of log need; quicken reports."""
    start.one_thread_of_blas()
    for module in (
        *sorted({name.partition(":")[0] for name in start.NODES.values()}),
        "diagnostics",
    ):
        loaded = importlib.import_module(f"omsm_ros.nodes.{module}")
    loaded.PERIOD_S = REPORT_PERIOD_S
    for module in ("omsm_ros.messages", *LATER):
        importlib.import_module(module)
    inspect.getmodule(sys._getframe())  # it remembers the file of each module
    gc.collect()
    gc.freeze()


def become(command, environment, folder, log):
    """Have the surroundings of a new process that runs ``command``."""
    kept = {name: os.environ[name] for name in ("GLIBC_TUNABLES", "OMP_NUM_THREADS")}
    os.environ.clear()
    os.environ.update(environment | kept)
    os.chdir(folder)
    opened = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    for number, source in enumerate((os.open(os.devnull, os.O_RDONLY), opened, opened)):
        os.dup2(source, number)
    sys.argv = sys.orig_argv = command
    sys.modules["__main__"] = start  # which a process of its own imports anew
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup before the tests would ignore


def end_at_once(main):
    """Run ``main`` and end the process as Python does, but without freeing all its modules."""
    code = 0
    try:
        main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if code and not isinstance(end.code, int):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    threading._shutdown()  # waits for threads that are no daemons
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main():
    """Serve until stdin ends; in a fork, run its node."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of Ctrl-C in the tests' terminal
    use_single_malloc_arena()
    load()
    for line in sys.stdin:
        request = json.loads(line)
        if (pid := request.get("pid")) is not None:
            ended, status = os.waitpid(pid, os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if ended else None
        elif not (answer := os.fork()):
            become(**request)
            end_at_once(start.main)
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
