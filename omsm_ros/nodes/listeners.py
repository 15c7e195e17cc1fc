"""Who listens to what this node publishes, and how much of it have they taken?

Reliable delivery ends in the listener's queue, where the oldest gives way to the newest unnoticed,
and what the middleware has to send again may come seconds late. So the listeners themselves are
asked (``~/taken``, which every node of this package serves), again and again, and nobody is ever
sent more than fits into a small part of its queue.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future
from std_srvs.srv import Trigger

from omsm_ros.errors import DataError
from omsm_ros.nodes.topics import TAKEN
from omsm_ros.storage import strict_json

# A tenth of a queue; half of the shared memory that Fast DDS passes messages through by default,
# beyond which it drops them, and sends them again three seconds later.
_MOST_OPEN, _MOST_OPEN_BYTES = 200, 256 * 1024
# A service that has just been found may drop a request; a node may be computing.
_ASK_AGAIN_S = 2.0
# Who has not been asked with success for so long is not waited for; nor is what has not been
# taken for so long: the middleware sends again after three.
_PATIENCE_S = 10.0
_DISCOVERY_S = 3.0  # of the service of a node whose subscription is known
_LOOK_AROUND_S = 0.2


@dataclass
class _Listener:
    """before: what it had taken of each topic when it was met, less what had been published."""

    client: Client
    topics: set[str]
    met: float
    before: dict[str, int] = field(default_factory=dict)
    taken: dict[str, int] = field(default_factory=dict)
    asked: tuple[Future, float] | None = None
    last_progress: float = 0.0


class Listeners:
    """Keeps account of the messages that were published, and not yet taken by all who listen.

    lost: messages that a listener never took, by its name;  deaf: who cannot be asked
    """

    def __init__(self, node: Node, publishers: Sequence[Publisher], undo: ExitStack) -> None:
        self._node, self._publishers = node, publishers
        self._published: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()
        self._listeners: dict[str, _Listener] = {}
        self._looked = -_LOOK_AROUND_S
        self._seen: Counter[str] = Counter()
        self._present: dict[str, set[str]] = {}
        self._changed = time.monotonic()
        self.lost: Counter[str] = Counter()
        self.deaf: set[str] = set()
        undo.callback(self._forget_all)

    def published(self, topic: str, size: int) -> None:
        """Enter one more message of ``size`` bytes."""
        self._published[topic] += 1
        self._bytes[topic] += size

    @property
    def known(self) -> bool:
        """Whether all who listen were met, or cannot be.

        The middleware may know of one before the graph says who it is.
        """
        unseen = any(
            p.get_subscription_count() > self._seen[p.topic_name] for p in self._publishers
        )
        return not unseen and all(each.taken for each in self._listeners.values())

    @property
    def unchanged_s(self) -> float:
        """For how many seconds nobody has come or gone."""
        return time.monotonic() - self._changed

    @property
    def room(self) -> bool:
        """Whether one more message may be published."""
        return all(self._has_room(each) for each in self._listeners.values())

    @property
    def waited_for(self) -> list[str]:
        """Names of those who have not taken everything."""
        return sorted(n for n, each in self._listeners.items() if any(self._open(each).values()))

    def _open(self, listener: _Listener) -> dict[str, int]:
        """Return the messages by topic that it has not taken."""
        if not listener.taken:
            return {}
        return {
            topic: max(self._published[topic] - (listener.taken[topic] - listener.before[topic]), 0)
            for topic in listener.topics & listener.taken.keys()
        }

    def _has_room(self, listener: _Listener) -> bool:
        if not listener.taken and listener.client.service_is_ready():
            return False  # it came just now, and will tell
        waiting = self._open(listener)
        size = sum(n * self._bytes[t] / max(self._published[t], 1) for t, n in waiting.items())
        most = max(waiting.values(), default=0)
        return not most or (most < _MOST_OPEN and size < _MOST_OPEN_BYTES)

    def look(self) -> None:
        """Hear what they have answered, and ask again who had not taken everything."""
        now = time.monotonic()
        if now - self._looked >= _LOOK_AROUND_S:
            self._looked = now
            self._look_around(now)
        for name, each in list(self._listeners.items()):
            self._hear(name, each, now)
            waiting = any(self._open(each).values())
            if not waiting:
                each.last_progress = now
            if each.asked is None and (waiting or not each.taken or self.lost[name]):
                each.asked = each.client.call_async(Trigger.Request()), now
            patience = _PATIENCE_S if each.client.service_is_ready() else _DISCOVERY_S
            if not each.taken and now - each.met > patience:
                self._give_up(name)
            elif each.taken and now - each.last_progress > _PATIENCE_S:
                self._count_lost(name, each, now)

    def _look_around(self, now: float) -> None:
        before, seen = self._present, self._seen.copy()
        present = self._present = self._look_who_is_there()
        if present != before or self._seen != seen:
            self._changed = now
        for name in self._listeners.keys() - present.keys():
            self._node.destroy_client(self._listeners.pop(name).client)
        for name in present.keys() - self._listeners.keys() - self.deaf:
            client = self._node.create_client(Trigger, f"{name}/{TAKEN}")
            self._listeners[name] = _Listener(client, present[name], met=now)
        for name, each in self._listeners.items():
            each.topics = present[name]

    def _look_who_is_there(self) -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for publisher in self._publishers:
            topic = publisher.topic_name
            infos: Sequence[Any] = self._node.get_subscriptions_info_by_topic(topic)
            self._seen[topic] = len(infos)
            for info in infos:
                name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                found.setdefault(name, set()).add(topic)
        return found

    def _hear(self, name: str, listener: _Listener, now: float) -> None:
        if listener.asked is None:
            return
        future, since = listener.asked
        if future.done():
            listener.asked = None
            with suppress(DataError):
                self._enter(listener, _counts(future.result().message), now)
                self._find_again(name, listener)
        elif now - since > _ASK_AGAIN_S:
            listener.client.remove_pending_request(future)
            listener.asked = None

    def _enter(self, listener: _Listener, counts: Mapping[str, int], now: float) -> None:
        taken = {topic: counts.get(topic, 0) for topic in listener.topics | listener.taken.keys()}
        for topic, count in taken.items():
            # One that is new, or began anew, is not sent what was published before.
            if topic not in listener.taken or count < listener.taken[topic]:
                listener.before[topic] = count - self._published[topic]
        if taken != listener.taken:
            listener.last_progress = now
        listener.taken = taken

    def _find_again(self, name: str, listener: _Listener) -> None:
        """Take back as lost what came late after all: nobody takes more than was published."""
        for topic, count in listener.taken.items():
            surplus = count - listener.before[topic] - self._published[topic]
            if surplus > 0:
                listener.before[topic] += surplus
                self.lost[name] -= min(surplus, self.lost[name])

    def _give_up(self, name: str) -> None:
        self._node.destroy_client(self._listeners.pop(name).client)
        self.deaf.add(name)
        self._node.get_logger().warning(
            f"{name} listens but does not say what it has taken (service {TAKEN}): it is not "
            "waited for, and loses what its queue does not hold"
        )

    def _count_lost(self, name: str, listener: _Listener, now: float) -> None:
        waiting = self._open(listener)
        listener.last_progress = now
        self.lost[name] += (lost := sum(waiting.values()))
        for topic, count in waiting.items():
            listener.before[topic] -= count
        self._node.get_logger().error(f"{name} has lost {lost} messages on their way")

    def _forget_all(self) -> None:
        while self._listeners:
            self._node.destroy_client(self._listeners.popitem()[1].client)


def _counts(text: str) -> dict[str, int]:
    found = strict_json.object_of(text, DataError, "what a listener has taken")
    return {name: count for name, count in found.items() if type(count) is int}
