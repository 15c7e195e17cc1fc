"""``replay``: plays a bag to the nodes of a cell, in its own time or as fast as they process it.

Reliable delivery ends in a subscriber's queue, where the newest message silently replaces the
oldest, and messages that the middleware sends again may arrive seconds late. So the player asks the
subscribers how many messages they have processed (``~/taken``, a service of all nodes of this
package), and never sends more than a small part of a queue.
"""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.client import Client
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from omsm_ros import quantities
from omsm_ros.core.streams.monitoring import Playback
from omsm_ros.errors import BagError, ConfigurationError, DataError, OmsmError
from omsm_ros.io import json_and_yaml, topics
from omsm_ros.io.bags import BagReader
from omsm_ros.io.topics import CellBag, relative
from omsm_ros.nodes.diagnostics import ERROR, WARN, StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run, serve
from omsm_ros.nodes.topics import (
    LATCHED_QOS,
    PROCESSED,
    SAMPLES_QOS,
    every,
    publish_on,
    recorded_type,
)
from omsm_ros.quantities import Parameter
from omsm_ros.units import NANOSECONDS_PER_S

# A tenth of a queue; two thirds of the receive buffer of a socket on a usual Linux, which is twice
# net.core.rmem_max. Beyond it, the system drops messages, and they are sent again later.
_MOST_OPEN, _MOST_OPEN_BYTES = 200, 256 * 1024
# A service just discovered may drop a request, or its node is busy [s].
_RETRY_S = 2.0
# A subscriber without an answer, and messages not processed, for this time are not waited for; the
# middleware sends again after three seconds.
_PATIENCE_S = 10.0
_DISCOVERY_S = 3.0  # of the service of a node whose subscription is known
_PRESENCE_PERIOD_S = 0.2


@dataclass
class _Listener:
    """A subscribed node.

    before: messages of each topic it had processed when it was discovered, less those published
    """

    client: Client
    topics: set[str]
    met: float
    before: dict[str, int] = field(default_factory=dict)
    taken: dict[str, int] = field(default_factory=dict)
    asked: tuple[Future, float] | None = None
    last_progress: float = 0.0


class Listeners:
    """Counts the messages that were published and are not yet processed by all subscribers.

    lost: messages that a node never processed, by its name;  deaf: nodes without the service
    """

    def __init__(
        self, node: Node, publishers: Sequence[Publisher], undo: ExitStack, answered: Any = None
    ) -> None:
        """answered: called with each answer of a subscriber."""
        self._node, self._publishers, self._answered = node, publishers, answered
        self._published: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()
        self._listeners: dict[str, _Listener] = {}
        self._looked = -_PRESENCE_PERIOD_S
        self._seen: Counter[str] = Counter()
        self._present: dict[str, set[str]] = {}
        self._changed = time.monotonic()
        self.lost: Counter[str] = Counter()
        self.deaf: set[str] = set()
        undo.callback(self._forget_all)

    def published(self, topic: str, size: int) -> None:
        """Count a message of ``size`` bytes."""
        self._published[topic] += 1
        self._bytes[topic] += size

    @property
    def known(self) -> bool:
        """Return whether all subscribers have answered or cannot answer.

        The middleware may know a subscriber before the graph has its name.
        """
        unseen = any(
            p.get_subscription_count() > self._seen[p.topic_name] for p in self._publishers
        )
        return not unseen and all(each.taken for each in self._listeners.values())

    @property
    def seconds_since_change(self) -> float:
        """Return the time since a subscriber appeared or disappeared [s]."""
        return time.monotonic() - self._changed

    @property
    def room(self) -> bool:
        """Return whether one more message may be published."""
        return all(self._has_room(each) for each in self._listeners.values())

    @property
    def pending_listeners(self) -> list[str]:
        """Return the names of nodes that have not processed all messages."""
        return sorted(n for n, each in self._listeners.items() if any(self._open(each).values()))

    def _open(self, listener: _Listener) -> dict[str, int]:
        if not listener.taken:
            return {}
        return {
            topic: max(self._published[topic] - (listener.taken[topic] - listener.before[topic]), 0)
            for topic in listener.topics & listener.taken.keys()
        }

    def _has_room(self, listener: _Listener) -> bool:
        if not listener.taken and listener.client.service_is_ready():
            return False  # just discovered; it will answer
        waiting = self._open(listener)
        size = sum(n * self._bytes[t] / max(self._published[t], 1) for t, n in waiting.items())
        most = max(waiting.values(), default=0)
        return not most or (most < _MOST_OPEN and size < _MOST_OPEN_BYTES)

    def look(self) -> None:
        """Take the answers, and ask the nodes that have not processed all messages."""
        now = time.monotonic()
        if now - self._looked >= _PRESENCE_PERIOD_S:
            self._looked = now
            self._update_present(now)
        for name, each in list(self._listeners.items()):
            self._hear(name, each, now)
            waiting = any(self._open(each).values())
            if not waiting:
                each.last_progress = now
            if each.asked is None and (waiting or not each.taken or self.lost[name]):
                each.asked = each.client.call_async(Trigger.Request()), now
                if self._answered is not None:
                    each.asked[0].add_done_callback(self._answered)
            patience = _PATIENCE_S if each.client.service_is_ready() else _DISCOVERY_S
            if not each.taken and now - each.met > patience:
                self._give_up(name)
            elif each.taken and now - each.last_progress > _PATIENCE_S:
                self._count_lost(name, each, now)

    def _update_present(self, now: float) -> None:
        before, seen = self._present, self._seen.copy()
        present = self._present = self._present_listeners()
        if present != before or self._seen != seen:
            self._changed = now
        for name in self._listeners.keys() - present.keys():
            self._node.destroy_client(self._listeners.pop(name).client)
        for name in present.keys() - self._listeners.keys() - self.deaf:
            client = self._node.create_client(Trigger, f"{name}/{PROCESSED}")
            self._listeners[name] = _Listener(client, present[name], met=now)
        for name, each in self._listeners.items():
            each.topics = present[name]

    def _present_listeners(self) -> dict[str, set[str]]:
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
                for topic, count in listener.taken.items():
                    surplus = count - listener.before[topic] - self._published[topic]
                    if surplus > 0:
                        listener.before[topic] += surplus
                        self.lost[name] -= min(surplus, self.lost[name])
        elif now - since > _RETRY_S:
            listener.client.remove_pending_request(future)
            listener.asked = None

    def _enter(self, listener: _Listener, counts: Mapping[str, int], now: float) -> None:
        taken = {topic: counts.get(topic, 0) for topic in listener.topics | listener.taken.keys()}
        for topic, count in taken.items():
            # A new or restarted node does not get the messages published before.
            if topic not in listener.taken or count < listener.taken[topic]:
                listener.before[topic] = count - self._published[topic]
        if taken != listener.taken:
            listener.last_progress = now
        listener.taken = taken

    def _give_up(self, name: str) -> None:
        self._node.destroy_client(self._listeners.pop(name).client)
        self.deaf.add(name)
        self._node.get_logger().warning(
            f"{name} subscribes but does not report what it has processed (service {PROCESSED}): "
            "it is not waited for, and loses messages beyond its queue"
        )

    def _count_lost(self, name: str, listener: _Listener, now: float) -> None:
        waiting = self._open(listener)
        listener.last_progress = now
        self.lost[name] += (lost := sum(waiting.values()))
        for topic, count in waiting.items():
            listener.before[topic] -= count
        self._node.get_logger().error(f"{name} has lost {lost} messages")

    def _forget_all(self) -> None:
        while self._listeners:
            self._node.destroy_client(self._listeners.popitem()[1].client)


def _counts(text: str) -> dict[str, int]:
    found = json_and_yaml.object_of(text, DataError, "the counts of a subscriber")
    return {name: count for name, count in found.items() if type(count) is int}


PARAMETERS = (
    Parameter("bag", "", ".mcap file or rosbag2 folder to play", required=True),
    Parameter("cell", "", "namespace of the cell in the bag, e.g. /cell2; empty = the only one"),
    Parameter("topics", "", "topics to play, e.g. 'axes confocal'; empty = all but points"),
    Parameter("rate", 1.0, "seconds of the bag per second; 0 = as fast as all process it",
              quantities.PLAY_RATE),
    Parameter("start", 0.0, "seconds of the bag to skip", quantities.PLAY_TIME),
    Parameter("duration", 0.0, "seconds of the bag to play; 0 = to its end", quantities.PLAY_TIME),
    Parameter("loop", False, "begin again at the end"),
    Parameter("paused", False, "wait for ~/resume or ~/step"),
    Parameter("clock", False, "publish the time of the bag on /clock"),
    Parameter("listeners", 1, "number of nodes that must subscribe to axes and confocal first",
              quantities.LISTENERS),
    Parameter("wait_for", "", "nodes that must be among them, e.g. 'corrector viewer'"),
    Parameter("delay", 0.0, "seconds to wait after the last one appeared", quantities.PLAY_TIME),
)  # fmt: skip
RECORDED_POINTS = "recorded/points"
"""Topic of recorded points, apart from those that are corrected now."""

_NEEDED = (topics.AXES_TOPIC, topics.DISTANCE_TOPIC)
_SAMPLES = (*_NEEDED, topics.REFERENCE_TOPIC)
_PLAYED = (*_SAMPLES, topics.CALIBRATION_TOPIC, topics.POINTS_TOPIC, topics.PROBE_TOPIC)
_TICK_S = 0.005
_LATE_S = 1.0
# An answer may take this long on a busy computer; it is lost if the node ends before [s].
_ANSWER_S = 1.0


class PlayerNode(ManagedNode):
    """Publishes recorded messages unchanged; ends when all subscribers have processed the last."""

    name, parameters, hardware = "player", PARAMETERS, "bag"

    def configure(self, undo: ExitStack) -> None:
        """Open the bag, and offer its topics."""
        path = CellBag(Path(self.values["bag"]), self.values["cell"])
        self._bag = undo.enter_context(BagReader(path))
        self._topics = self._asked_for()
        begin = self._bag.start_ns + round(self.values["start"] * NANOSECONDS_PER_S)
        length = round(self.values["duration"] * NANOSECONDS_PER_S)
        self._span = begin, begin + length if length else None
        self._offers = {topic: self._publisher(undo, topic) for topic in self._topics}
        self._counts = dict.fromkeys(self._topics, 0)
        self._position_ns = begin
        self._obstacle = ""
        self._asked_at = float("-inf")

    def _asked_for(self) -> list[str]:
        held = [t.role for t in self._bag.topics() if t.role in _PLAYED and t.messages]
        names = self.values["topics"].split() or [
            relative(topic) for topic in held if topic != topics.POINTS_TOPIC
        ]
        found = [topic for topic in held if relative(topic) in names]
        unknown = sorted(set(names) - {relative(topic) for topic in found})
        if unknown or not found:
            there = [t.topic for t in self._bag.topics() if t.messages]
            raise ConfigurationError(
                f"nothing to play on {', '.join(unknown) or 'the topics of this cell'}; "
                f"{self.values['bag']!r} has {there!r}: see parameters topics and cell"
            )
        return found

    def _publisher(self, undo: ExitStack, topic: str) -> Publisher:
        name = RECORDED_POINTS if topic == topics.POINTS_TOPIC else relative(topic)
        kind = recorded_type(topic)
        if topic in topics.LATCHED_TOPICS:  # other nodes may publish it too
            return publish_on(self, undo, kind, name, LATCHED_QOS)
        return self.publish_on(undo, kind, name, SAMPLES_QOS)

    def activate(self, undo: ExitStack) -> None:
        """Play."""
        # Latched messages are not lost, and other nodes may publish them too.
        streams = [p for topic, p in self._offers.items() if topic not in topics.LATCHED_TOPICS]
        # An answer makes room at once; a tick later the subscribers would have waited.
        self._listeners = Listeners(self, streams, undo, lambda _: self._tick())
        self._time = (
            publish_on(self, undo, ClockMessage, "/clock") if self.values["clock"] else None
        )
        self._begin()
        self._begun, self._wanted, self._late = False, not self.values["paused"], 0.0
        for name, answer in (
            ("pause", self._on_pause), ("resume", self._on_resume), ("step", self._on_step)
        ):  # fmt: skip
            serve(self, undo, Trigger, f"~/{name}", answer)
        every(self, undo, _TICK_S, self._tick)

    def _begin(self) -> None:
        self._playback = Playback(self._span[0], self.values["rate"])
        self._recorded = self._in_order()
        self._next = next(self._recorded, None)

    def _in_order(self) -> Iterator[tuple[str, int, bytes]]:
        begin, end = self._span
        # Subscribers need the latched messages from before the start.
        latched = [topic for topic in self._topics if topic in topics.LATCHED_TOPICS]
        before = {
            topic: (topic, begin, cdr) for topic, _, cdr in self._bag.messages(latched, None, begin)
        }
        yield from before.values()
        whole = begin == self._bag.start_ns and end is None
        yield from self._bag.messages(self._topics, None if whole else begin, end)

    def _tick(self) -> None:
        try:
            self._play(time.monotonic())
        except BagError as err:
            self.fatal = err
            self.get_logger().error(f"{type(err).__name__}: {err}")

    def _play(self, now: float) -> None:
        self._listeners.look()
        if not self._begun:
            self._obstacle = self._reason_not_to_play()
            if self._obstacle:
                return
            self._begun = True
        if self._wanted:
            self._playback.resume(now)
        while self._next is not None and self._listeners.room:
            late = self._playback.late(self._next[1], now)
            if late is None:
                break
            self._late = late
            self._publish_next()
        self._listeners.look()
        self._tell_time(now)
        answered = now - self._asked_at >= _ANSWER_S
        if self._next is None and not self._listeners.pending_listeners and answered:
            self._on_end()

    def _reason_not_to_play(self) -> str:
        """Return why playing cannot begin yet; empty if it can."""
        for topic, publisher in self._offers.items():
            name = publisher.topic_name
            if topic in _SAMPLES and self.count_publishers(name) > 1:
                return (
                    f"another node publishes {name}, and a recording is never mixed with live "
                    "samples: end it, or play in another namespace (-r __ns:=/replay)"
                )
            if topic in _NEEDED and publisher.get_subscription_count() < self.values["listeners"]:
                return f"no node subscribes to {name} yet (parameter listeners)"
            there = {info.node_name for info in self.get_subscriptions_info_by_topic(name)}
            missing = [node for node in self.values["wait_for"].split() if node not in there]
            if topic in _NEEDED and missing:
                return (
                    f"{' and '.join(missing)} must subscribe to {name} first (parameter wait_for)"
                )
        if not self._listeners.known:
            return "a subscriber has not answered yet"
        if self._listeners.seconds_since_change < (delay := self.values["delay"]):
            return f"it begins {delay:g} s after the last subscriber appeared (parameter delay)"
        return ""

    def _publish_next(self) -> None:
        assert self._next is not None
        topic, self._position_ns, cdr = self._next
        self._offers[topic].publish(cdr)
        self._listeners.published(self._offers[topic].topic_name, len(cdr))
        self._counts[topic] += 1
        self._next = next(self._recorded, None)

    def _tell_time(self, now: float) -> None:
        if self._time is None:
            return
        # Never ahead of the published messages: time stands while a subscriber is waited for.
        ahead = self._next[1] if self._next is not None else self._position_ns
        due = self._playback.time_ns(now) if self.values["rate"] else self._position_ns
        sec, nanosec = divmod(max(min(due, ahead), self._position_ns), NANOSECONDS_PER_S)
        self._time.publish(ClockMessage(clock=Time(sec=sec, nanosec=nanosec)))

    def _on_end(self) -> None:
        if self.values["loop"]:
            self._begin()
            return
        lost = ", ".join(f"{name} lost {n}" for name, n in (+self._listeners.lost).items())
        self.get_logger().info(
            f"played {self._played()}; {lost or 'all subscribers processed them'}"
        )
        self.trigger_shutdown()

    def _played(self) -> str:
        return ", ".join(f"{n} {relative(topic)}" for topic, n in self._counts.items())

    def _on_pause(self, request: Trigger.Request, response: Trigger.Response) -> None:
        self._wanted = False
        self._playback.pause(time.monotonic())
        response.success, response.message = True, f"paused after {self._played()}"

    def _on_resume(self, request: Trigger.Request, response: Trigger.Response) -> None:
        self._wanted, self._asked_at = True, time.monotonic()
        response.success, response.message = True, "playing"

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> None:
        if self._obstacle or not self._begun:
            raise OmsmError(self._obstacle or "it has not begun yet; ask again")
        if self._wanted:
            raise OmsmError("it is playing; call pause before step")
        if self._next is None or not self._listeners.room:
            raise OmsmError(
                "there is no next message, or the last ones are not processed yet; ask again"
            )
        topic, stamp, _ = self._next
        self._asked_at = time.monotonic()
        self._publish_next()
        self._playback.go_to(stamp, time.monotonic())
        response.success, response.message = True, f"{relative(topic)} of {stamp} ns"

    def report(self) -> StateReport:
        """Return the position, and what the player waits for."""
        position = (self._position_ns - self._bag.start_ns) / NANOSECONDS_PER_S
        report = StateReport("playing", {relative(topic): n for topic, n in self._counts.items()})
        report.values["position_s"] = position
        if not self.active:
            return report
        report.values["paused"] = not self._wanted
        report.values["waited_for"] = " ".join(self._listeners.pending_listeners)
        if self._obstacle:
            report.add(ERROR, self._obstacle)
        for name, count in (+self._listeners.lost).items():
            report.add(WARN, f"{name} lost {count} messages")
        if self._late > _LATE_S:
            report.add(WARN, f"{self._late:.1f} s behind: a subscriber is too slow")
        return report


main = partial(run, PlayerNode)
