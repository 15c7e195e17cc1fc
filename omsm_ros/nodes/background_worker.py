"""Does work that takes seconds in a thread, while the node continues to take samples."""

import multiprocessing
import queue
import resource
import signal
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Any, TypeAlias, TypeVar, cast

from rclpy.action import ActionServer, CancelResponse
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future

from omsm_ros.errors import OmsmError
from omsm_ros.nodes.memory import return_free_memory
from omsm_ros.nodes.running import offer, refusing

T = TypeVar("T")
Attend: TypeAlias = Callable[..., None]

# Requests that may wait; a further one is refused at once.
_MOST_WAITING = 8
# Reading a bag from outside takes at most this time [s] and memory [bytes].
_BAG_S, _BAG_BYTES = 300.0, 8 << 30
# Idle time after which free memory is returned to the system [s].
_IDLE_S = 1.0
# Between two looks at a process, and two messages of feedback that say nothing new [s].
UNLIMITED = resource.RLIM_INFINITY
_LOOK_S, _FEEDBACK_S = 0.05, 0.5
_PROGRESS, _DONE, _FAILED = "progress", "done", "failed"


def silent(stage: str, **numbers: object) -> None:
    """State no progress."""


class Cancelled(OmsmError):
    """The client of an action, or the end of the node, has ended the work."""


def in_child(
    work: Callable[..., T],
    seconds: float = _BAG_S,
    most_bytes: int = _BAG_BYTES,
    attend: Attend | None = None,
) -> T:
    """Return what ``work`` returns in a process of its own, or raise what it raises.

    A bag from outside may be made to take memory or time without end. ``work`` and its result are
    pickled. Raises OmsmError if it takes longer, or more memory.

    attend: called with the fields of the progress that ``work(progress)`` states, and without
        fields meanwhile; what it raises ends the process
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    arguments = (sender, work, most_bytes, attend is not None)
    child = context.Process(target=_child, args=arguments, daemon=True)
    child.start()
    sender.close()
    until = time.monotonic() + seconds
    kind, content = _PROGRESS, cast("Any", {})
    try:
        while kind == _PROGRESS:
            if attend is not None:
                attend(**content)
            if time.monotonic() > until:
                raise OmsmError(
                    f"the bag was not read in {seconds:g} s; check it with omsm inspect"
                )
            kind, content = receiver.recv() if receiver.poll(_LOOK_S) else (_PROGRESS, {})
    except EOFError as err:
        raise OmsmError(
            f"the process that read the bag ended; it may have needed more than "
            f"{most_bytes / 2**30:.3g} GB: check the bag with omsm inspect"
        ) from err
    finally:
        child.kill()
        child.join()
        receiver.close()
    if kind == _FAILED:
        raise content
    return content  # type: ignore[no-any-return]


def _child(sender: Connection, work: Callable[..., Any], most_bytes: int, tells: bool) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the node ends this process
    resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    stated: tuple[object, float] = (None, 0.0)

    def progress(stage: str, **numbers: object) -> None:
        nonlocal stated
        about, now = (stage, numbers.get("order")), time.monotonic()
        if about != stated[0] or now - stated[1] > _FEEDBACK_S:
            stated = about, now
            sender.send((_PROGRESS, {"stage": stage, **numbers}))

    try:
        answer = (_DONE, work(progress) if tells else work())
    except MemoryError:
        return  # the parent sees that this process ended
    except OmsmError as err:
        answer = (_FAILED, OmsmError(str(err)))
    sender.send(answer)


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

    server = ActionServer(
        node, kind, name, execute, cancel_callback=lambda _: CancelResponse.ACCEPT
    )
    undo.callback(server.destroy)
    undo.callback(ended.set)


class BackgroundWorker:
    """A thread for the work of a node, and services that await it without stopping the node."""

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
        timer = self._watched(done, goal) if goal else None
        try:
            return await done  # type: ignore[no-any-return]
        finally:
            self.waiting -= 1
            if timer is not None:
                self._node.destroy_timer(timer)

    def _watched(self, done: Future, goal: Goal) -> Any:
        """Return a timer that ends the wait of a goal for its turn, too."""

        def look() -> None:
            try:
                goal.attend()
            except Cancelled as err:
                done.set_exception(err)

        return self._node.create_timer(
            _FEEDBACK_S, look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def serve(
        self, undo: ExitStack, kind: Any, name: str, answer: Callable[[Any, Any], Awaitable[None]]
    ) -> None:
        """Offer the service ``name``, as ``running.serve``, with an asynchronous ``answer``."""

        async def callback(request: Any, response: Any) -> Any:
            with refusing(self._node, response):
                await answer(request, response)
            return response

        offer(self._node, undo, kind, name, callback)

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
            done.set_exception(err)
        # Without waking it, the executor continues the waiting service only at its next event.
        if (executor := self._node.executor) is not None:
            executor.wake()
