"""Does work that takes seconds in a thread, while the node continues to take samples."""

import queue
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from typing import Any, TypeVar

from rclpy.action import ActionServer, CancelResponse
from rclpy.node import Node
from rclpy.task import Future

from omsm_ros.errors import OmsmError
from omsm_ros.nodes.memory import return_free_memory
from omsm_ros.nodes.running import refusing
from omsm_ros.nodes.topics import REQUESTS_QOS, every

T = TypeVar("T")

# Requests that may wait; a further one is refused at once.
_MOST_WAITING = 8
# Idle time after which free memory is returned to the system [s].
_IDLE_S = 1.0
# Between two messages of feedback that say nothing new [s].
_FEEDBACK_S = 0.5


def silent(stage: str, **numbers: object) -> None:
    """State no progress."""


class Cancelled(OmsmError):
    """The client of an action, or the end of the node, has ended the work."""


class Goal:
    """A goal of an action that is being worked on.

    ended: set when the node stops serving the action
    """

    def __init__(self, handle: Any, kind: Any, ended: threading.Event) -> None:
        self._handle, self._feedback, self._ended = handle, kind.Feedback(), ended
        self._begun, self._stated = time.monotonic(), float("-inf")
        if hasattr(self._feedback, "stage"):
            self._feedback.stage = "waiting"

    @property
    def cancelled(self) -> bool:
        """Return whether it is to end."""
        return bool(self._ended.is_set() or self._handle.is_cancel_requested)

    def attend(self, **fields: object) -> None:
        """Publish feedback with ``fields``, without them twice a second; raise Cancelled."""
        if self.cancelled:
            raise Cancelled("cancelled")
        for name, value in fields.items():
            setattr(self._feedback, name, value)
        now = time.monotonic()
        if fields or now - self._stated > _FEEDBACK_S:
            self._stated, self._feedback.elapsed = now, now - self._begun
            self._handle.publish_feedback(self._feedback)


def serve_action(
    node: Node, undo: ExitStack, kind: Any, name: str, perform: Callable[..., Awaitable[None]]
) -> None:
    """Offer the action ``name``; ``perform(request, result, goal)`` fills in the result.

    A goal ends as cancelled if that was asked for and ``success`` is false, else as aborted if it
    is false.
    """
    ended = threading.Event()

    async def execute(handle: Any) -> Any:
        result, goal = kind.Result(), Goal(handle, kind, ended)
        with refusing(node, result):
            await perform(handle.request, result, goal)
        if ended.is_set():  # there is nobody to answer
            return result
        end = handle.canceled if goal.cancelled else handle.abort
        (handle.succeed if result.success else end)()
        return result

    queues = {f"{of}_service_qos_profile": REQUESTS_QOS for of in ("goal", "cancel", "result")}
    accept = {"cancel_callback": lambda _: CancelResponse.ACCEPT}
    server = ActionServer(node, kind, name, execute, **accept, **queues)
    undo.callback(server.destroy)
    undo.callback(ended.set)


class BackgroundWorker:
    """A thread for the work of a node; services await it without stopping the node."""

    def __init__(self, node: Node, undo: ExitStack) -> None:
        self._node = node
        self._work: queue.SimpleQueue[tuple[Callable[[], Any], Future] | None] = queue.SimpleQueue()
        self.waiting = 0
        threading.Thread(target=self._run, daemon=True).start()
        undo.callback(self._work.put, None)

    async def do(self, work: Callable[[], T], goal: Goal | None = None) -> T:
        """Return what ``work`` returns, or raise what it raises; Cancelled if ``goal`` is.

        Raises OmsmError if too many requests wait.
        """
        if self.waiting >= _MOST_WAITING:
            raise OmsmError(f"busy: {self.waiting} requests are being worked on; ask again later")
        self.waiting += 1
        done = Future()
        self._work.put((work, done))

        def look() -> None:
            """End the wait of a goal for its turn, too."""
            try:
                goal.attend()  # type: ignore[union-attr]
            except Cancelled as err:
                done.set_exception(err)

        with ExitStack() as undo:
            if goal is not None:
                every(self._node, undo, _FEEDBACK_S, look)
            try:
                return await done  # type: ignore[no-any-return]
            finally:
                self.waiting -= 1

    def _run(self) -> None:
        patience: float | None = None
        while True:
            try:
                task = self._work.get(timeout=patience)
            except queue.Empty:
                # The node would keep the memory of its largest request.
                return_free_memory()
                patience = None
                continue
            if task is None:
                return
            self._do(*task)
            del task  # with its result
            patience = _IDLE_S

    def _do(self, work: Callable[[], Any], done: Future) -> None:
        if done.done():  # cancelled while it waited
            return
        try:
            done.set_result(work())
        except Exception as err:  # raised by ``do``
            if not done.done():  # a goal cancelled meanwhile has its answer
                done.set_exception(err)
        # Without waking it, the executor continues the waiting service only at its next event.
        if (executor := self._node.executor) is not None:
            executor.wake()
