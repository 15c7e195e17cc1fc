"""Does work that takes seconds in a thread, while the node continues to take samples."""

import multiprocessing
import queue
import resource
import threading
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.task import Future

from omsm_ros.errors import OmsmError
from omsm_ros.nodes.memory import return_free_memory
from omsm_ros.nodes.running import offer, refusing

T = TypeVar("T")

# Requests that may wait; a further one is refused at once.
_MOST_WAITING = 8
# Reading a bag from outside takes at most this time [s] and memory [bytes].
_BAG_S, _BAG_BYTES = 300.0, 8 << 30
# Idle time after which free memory is returned to the system [s].
_IDLE_S = 1.0


def in_child(work: Callable[[], T], seconds: float = _BAG_S, most_bytes: int = _BAG_BYTES) -> T:
    """Return what ``work`` returns in a process of its own, or raise what it raises.

    A bag from outside may be made to take memory or time without end. ``work`` and its result are
    pickled. Raises OmsmError if it takes longer, or more memory.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_child, args=(sender, work, most_bytes), daemon=True)
    child.start()
    sender.close()
    try:
        if not receiver.poll(seconds):
            raise OmsmError(f"the bag was not read in {seconds:g} s; check it with omsm inspect")
        failed, result = receiver.recv()
    except EOFError as err:
        raise OmsmError(
            f"the process that read the bag ended; it may have needed more than "
            f"{most_bytes / 2**30:.3g} GB: check the bag with omsm inspect"
        ) from err
    finally:
        child.kill()
        child.join()
        receiver.close()
    if failed:
        raise result
    return result  # type: ignore[no-any-return]


def _child(sender: Connection, work: Callable[[], Any], most_bytes: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    try:
        answer = (False, work())
    except MemoryError:
        return  # the parent sees that this process ended
    except OmsmError as err:
        answer = (True, OmsmError(str(err)))
    sender.send(answer)


class BackgroundWorker:
    """A thread for the work of a node, and services that await it without stopping the node."""

    def __init__(self, node: Node, undo: ExitStack) -> None:
        self._node = node
        self._work: queue.SimpleQueue[tuple[Callable[[], Any], Future] | None] = queue.SimpleQueue()
        self.waiting = 0
        threading.Thread(target=self._run, daemon=True).start()
        undo.callback(self._work.put, None)

    async def do(self, work: Callable[[], T]) -> T:
        """Return what ``work`` returns, or raise what it raises.

        Raises OmsmError if too many requests wait.
        """
        if self.waiting >= _MOST_WAITING:
            raise OmsmError(f"busy: {self.waiting} requests are being worked on; ask again later")
        self.waiting += 1
        done = Future()
        self._work.put((work, done))
        try:
            return await done  # type: ignore[no-any-return]
        finally:
            self.waiting -= 1

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
        try:
            done.set_result(work())
        except Exception as err:  # raised by ``do``
            done.set_exception(err)
        # Without waking it, the executor continues the waiting service only at its next event.
        if (executor := self._node.executor) is not None:
            executor.wake()
