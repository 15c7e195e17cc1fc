"""Starts nodes, serves requests, and ends nodes in order.

No message, request or parameter ends a node: an invalid one is refused with the reason, and an
internal error is logged and counted in the diagnostics.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from omsm_ros import quantities
from omsm_ros.errors import (
    DEBUG,
    ConfigurationError,
    OmsmError,
    defect,
    one_line,
    too_many_open_files,
)
from omsm_ros.io import json_and_yaml
from omsm_ros.loading import exit_on_signal_while_loading
from omsm_ros.nodes.diagnostics import log_internal_error
from omsm_ros.nodes.managed import LifecycleStage, ManagedNode
from omsm_ros.nodes.memory import freeze_garbage_collector
from omsm_ros.nodes.start import ENDING
from omsm_ros.nodes.topics import REQUESTS_QOS, every

_BAD_INPUT, _DEFECT = 2, 70  # exit codes, as of the commands
# After this time since the first signal, the next one ends the process at once [s].
_PATIENCE_S = 5.0
# For what a node sent last, a log message or the answer to its shutdown, to be received [s].
_LAST_SENT_S = 1.0
# Between two requests of one service, so that the queue of a slow client does not overflow [s].
_PACE_S = 0.01


def run(*make_nodes: Callable[[], ManagedNode]) -> None:
    """Build nodes, start and spin them until SIGINT, SIGTERM, SIGHUP or a requested shutdown.

    Exits with one line on stderr if one cannot start or continue: 2 for bad input, 70 for an
    internal error.
    """
    node: ManagedNode | None = None
    nodes: list[ManagedNode] = []
    try:
        with exit_on_signal_while_loading(ENDING):
            _init()
        ending = _SignalEnd()  # after rclpy, which resets the handlers
        for make in make_nodes:
            node = None
            nodes.append(node := make())
            node.start()
        freeze_garbage_collector()
    except Exception as err:
        for each in nodes:
            each.close()
        _give_up(node, err)
    try:
        _spin(nodes, ending)
    finally:
        for each in sorted(nodes, key=lambda node: node.closes_last):
            each.close()
            each.destroy_node()
        rclpy.try_shutdown()
        _ignore_signals()
    if any(each.fatal is not None for each in nodes):
        sys.exit(_BAD_INPUT)


def _init() -> None:
    domain = os.environ.get("ROS_DOMAIN_ID", "").strip()
    if domain.isdecimal():  # Fast DDS ends the process if there are no ports for it
        quantities.DOMAIN.checked(int(domain[:20]), ConfigurationError, "ROS_DOMAIN_ID")
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as err:  # a parameter file that is missing or no YAML, an invalid argument
        raise ConfigurationError(str(err).split(", at ")[0]) from err
    for flag, name in pairwise(sys.argv):
        if flag == "--params-file":
            _check_parameter_file(Path(name))


def _check_parameter_file(path: Path) -> None:
    """Refuse a text that rcl ignores: a single value, or none."""
    # A pipe has been read by now.
    if path.is_file() and not json_and_yaml.begins_as_mapping(path.read_bytes()):
        raise ConfigurationError(
            f"{str(path)!r} is no file of parameters: it must begin with the name of a node, or "
            "/**, and has ros__parameters below"
        )


def _give_up(node: ManagedNode | None, err: Exception) -> None:
    short = too_many_open_files(err)
    known = isinstance(err, OmsmError) or bool(short)
    if os.environ.get(DEBUG) and not known:
        raise err
    if node is None:
        text = f"{type(err).__name__}: {one_line(err)}" if known else defect(err)
        print(short or text, file=sys.stderr)
    else:  # the line is in the log already
        time.sleep(_LAST_SENT_S if node.count_subscribers("/rosout") else 0.0)
    rclpy.try_shutdown()
    _ignore_signals()
    sys.exit(_BAD_INPUT if known else _DEFECT)


class _SignalEnd:
    """Receives the signals to end, without interrupting the node.

    A launch sends SIGINT twice; a handler that raises an exception during the orderly end would
    leave it incomplete.
    """

    def __init__(self) -> None:
        self.asked = threading.Event()
        self._wake: Callable[[], object] = lambda: None
        self._heard, woken = os.pipe()
        os.set_blocking(woken, False)
        # Set first, so that no signal is lost before the handlers are set.
        signal.set_wakeup_fd(woken)
        for number in ENDING:
            # nohup lets it be ignored.
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda *_: None)
        threading.Thread(target=self._wait, daemon=True).start()

    def wakes(self, wake: Callable[[], object]) -> None:
        """Call ``wake`` when the signal comes."""
        self._wake = wake
        if self.asked.is_set():
            wake()

    def _wait(self) -> None:
        asked = 0.0
        while True:
            (number,) = os.read(self._heard, 1)
            if number not in ENDING:
                continue
            if not asked:
                asked = time.monotonic()
                self.asked.set()
                self._wake()
            elif time.monotonic() - asked > _PATIENCE_S:
                os._exit(128 + number)


def _ignore_signals() -> None:
    """Ignore further signals, which would change the exit code once Python has no handlers."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def _spin(nodes: Sequence[ManagedNode], ending: _SignalEnd) -> None:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    ending.wakes(lambda: executor.create_task(lambda: None))

    def over() -> bool:
        return any(n.fatal or n.stage is LifecycleStage.FINALIZED for n in nodes)

    while not (ending.asked.is_set() or over()):
        try:
            executor.spin_once()
        except Exception as err:
            log_internal_error(nodes[0], err)
    ending.asked.wait(_LAST_SENT_S)


def settings_of(text: str) -> dict[str, object]:
    """Return settings from a JSON object, or an empty text; else ConfigurationError."""
    return json_and_yaml.object_of(text or "{}", ConfigurationError, "parameter 'settings'")


class PacedService(ReentrantCallbackGroup):  # type: ignore[misc]
    """Lets a service take one request after the other, with a short pause.

    Requests wait in the node's queue, which is deep. A client's queue has ten answers by default;
    of hundreds at once it would lose most, and wait for them without end.
    """

    def __init__(self, node: Node, undo: ExitStack) -> None:
        super().__init__()
        self._ready = True
        self._pause = every(node, undo, _PACE_S, self._go_on)
        self._pause.cancel()

    def can_execute(self, entity: Any) -> bool:
        """Return whether the next request may be taken; called by the executor."""
        return self._ready

    def beginning_execution(self, entity: Any) -> bool:
        """Begin the pause."""
        if not self._ready:
            return False
        self._ready = False
        self._pause.reset()
        return True

    def _go_on(self) -> None:
        self._pause.cancel()
        self._ready = True


def serve(
    node: Node, undo: ExitStack, kind: Any, name: str,
    answer: Callable[[Any, Any], Awaitable[None] | None],
) -> None:  # fmt: skip
    """Offer the service ``name`` until ``undo``; its requests are taken at a pace.

    answer: fills in the response, at once or asynchronously; an exception of it is answered as not
        successful (or not safe), with the reason
    """

    async def callback(request: Any, response: Any) -> Any:
        with refusing(node, response):
            if (work := answer(request, response)) is not None:
                await work
        return response

    group = PacedService(node, undo)
    made = node.create_service(kind, name, callback, qos_profile=REQUESTS_QOS, callback_group=group)
    undo.callback(node.destroy_service, made)


@contextmanager
def refusing(node: Node, response: Any) -> Iterator[None]:
    """Answer an exception as not successful, with the reason."""
    try:
        yield
    except OmsmError as err:
        refuse(response, str(err))
    except Exception as err:
        refuse(response, log_internal_error(node, err))


def refuse(response: Any, reason: str) -> None:
    """Fill in a refusal with its reason."""
    for name in ("success", "safe"):
        if hasattr(response, name):
            setattr(response, name, False)
    response.message = one_line(reason)
