"""Publishes a message on a ROS 1 topic: once, or at a rate for some time and then one to stop."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.sources.ros1.deadline import Deadline, RosStoppedError
from amberbox.blackbox.sources.ros1.master import RosError, global_name
from amberbox.blackbox.sources.ros1.message_type import is_standard, message_type
from amberbox.blackbox.sources.ros1.node import RosNode
from amberbox.blackbox.sources.ros1.topic_server import OfferedTopic
from amberbox.core.config import Finding
from amberbox.core.contracts import ActionContext
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.options import option
from amberbox.experiments.actions import _placeholders
from amberbox.experiments.actions._ros1 import (
    RosPeerOptions,
    connecting,
    node_settings,
    not_started,
    simulate,
    unfit_message,
    unfit_name,
)

SAMPLE = """\
drive_forward:
  description: Drive straight ahead for some seconds
  kind: ros1_publish
  topic: /cmd_vel
  type: geometry_msgs/Twist
  message: {linear: {x: "{speed_m_s}"}}
  rate: 10
  duration: "{seconds}"
  safe_stop: {message: {}}
  parameters:
    speed_m_s: {unit: m/s, min: -0.3, max: 0.3}
    seconds: {unit: s, min: 0, max: 10, default: 2}
  risk: moves
  timeout: 20 s
"""

OTHERS_S = 0.5  # longest wait for subscribers beyond those that are needed
TAKEN_S = 1.0  # longest wait for messages to be sent
STOPPED_S = 0.25  # the same for the stop of a run that must end
_LONGEST_S = 3600.0


@dataclass(frozen=True)
class PublishedStop:
    """The message that stops the robot."""

    message: Mapping[str, Any] = option({}, "its fields; those left out are zero")
    topic: str = option("", "its topic, if it is another one")
    type: str = option("", "its type, if the topic is another one")
    definition: str = option("", "its definition, if its type is not a standard one")


@dataclass(frozen=True, kw_only=True)
class Config(RosPeerOptions):
    """What is published, and how often."""

    topic: str = option(doc="topic to publish on")
    type: str = option(doc="message type, as in `geometry_msgs/Twist`")
    message: Mapping[str, Any] = option({}, 'its fields; "{name}" is the value of a parameter')
    definition: str = option("", "text of the type, if it is neither standard nor known to peers")
    rate: float = option(10.0, "messages per second for the duration; 0: one message", unit="Hz")
    duration: Any = option(0.0, "how long to publish, in seconds; 0: one message")
    latch: bool = option(False, "subscribers that connect later get the last message as well")
    queue: int = option(10, "messages that wait for a slow subscriber; then the oldest are dropped")
    subscribers: int = option(1, "subscribers that have to be connected before it begins")
    safe_stop: PublishedStop | None = option(None, "message that stops the robot, also at the end")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with the values."""
        yield from super().check()
        yield from unfit_name("topic", self.topic, "topic")
        if not 0 <= self.rate <= 1000:
            yield "rate", "must be from 0 to 1000 Hz"
        for key, low, high in (("queue", 1, 1000), ("subscribers", 0, 60)):
            if not low <= getattr(self, key) <= high:
                yield key, f"must be from {low} to {high}"
        if not isinstance(self.duration, str) and _seconds(self.duration) is None:
            yield "duration", f"must be a number of seconds up to {_LONGEST_S:g}"
        if self.safe_stop is not None and self.safe_stop.topic:
            yield from unfit_name("safe_stop", self.safe_stop.topic, "topic")
            if not self.safe_stop.type:
                yield "safe_stop", "needs the type of its own topic"
        if self.definition or is_standard(self.type):
            try:
                message_type(self.type, self.definition)
            except UsageError as error:
                yield "type", error.what


def _seconds(value: Any) -> float | None:
    """Return a duration; None if it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if 0 <= value <= _LONGEST_S else None


def problems(config: Config, parameters: Collection[str]) -> Iterator[Finding]:
    """Yield placeholders without a parameter, parameters without an effect, and unfit messages."""
    templates: dict[str, Any] = {"message": config.message, "duration": config.duration}
    templates["simulated"] = config.simulated
    if config.safe_stop is not None:
        templates["safe_stop"] = config.safe_stop.message
    yield from _placeholders.problems(templates, parameters, "message", "duration")
    if isinstance(config.duration, str) and not config.duration.startswith("{"):
        yield "duration", f"'{config.duration}' is no number of seconds"
    for topic in _topics(config)[:1]:
        yield from unfit_message("message", topic.kind, config.message)
    stop = _stop_topic(config)
    if stop is not None and config.safe_stop is not None:
        yield from unfit_message("safe_stop", stop.kind, config.safe_stop.message)


def run(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Publish for the duration, then the message to stop; return how often and to whom."""
    try:
        with not_started():
            duration_s = _seconds(_placeholders.filled(config.duration, context.parameters))
            if duration_s is None:
                raise UsageError("the duration is no number of seconds, or longer than an hour")
            topics = _topics(config)
            node = RosNode(node_settings(config, config.topic), connecting(config, context))
    except RosStoppedError:
        return None
    with node:
        try:
            with not_started():
                for topic in topics:
                    _connect(node, topic, config, context)
                data = _encoded(topics[0], config.message, context)
        except RosStoppedError:
            return None
        taken = _publish(node, config, context, topics, duration_s, data)
    return None if context.stopped() else taken


def safe_stop(config: Config, context: ActionContext) -> None:
    """Publish the message to stop, with a node that replaces that of the run."""
    stop = _stop_topic(config)
    if stop is None or config.safe_stop is None:
        raise AmberboxError("no message to stop is declared")
    stop.is_latched = True  # subscribers that connect late get it as well
    deadline = connecting(config, context)
    with RosNode(node_settings(config, config.topic), deadline) as node:
        if stop.kind is None:
            node.learn(stop, deadline)
        node.advertise(stop, deadline)
        node.wait_for(stop.name, set(), 1, deadline)
        node.publish(stop.name, _encoded(stop, config.safe_stop.message, context))
        listed = node.subscribers(stop.name, deadline)
        others = Deadline.within(OTHERS_S, context.stopped)
        connected = node.wait_for(stop.name, listed, 1, others)
        late = node.flush(stop.name, Deadline.within(TAKEN_S, context.stopped))
        if connected and connected <= late:
            raise RosError(f"no subscriber of {stop.name} has taken the message to stop")


def simulated(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Publish nothing."""
    return simulate(config, context)


def _topics(config: Config) -> list[OfferedTopic]:
    """Return the topic of the message, and that of the stop if it is another one."""
    topic = _offered(config.topic, config.type, config.definition, config)
    stop = _stop_topic(config)
    return [topic] if stop is None or stop.name == topic.name else [topic, stop]


def _stop_topic(config: Config) -> OfferedTopic | None:
    stop = config.safe_stop
    if stop is None:
        return None
    if not stop.topic:
        return _offered(config.topic, config.type, config.definition, config)
    return _offered(stop.topic, stop.type, stop.definition, config)


def _offered(topic: str, type_name: str, definition: str, config: Config) -> OfferedTopic:
    is_known = definition or is_standard(type_name)
    kind = message_type(type_name, definition) if is_known else None
    return OfferedTopic(global_name(topic), type_name, kind, config.latch, config.queue)


def _connect(node: RosNode, topic: OfferedTopic, config: Config, context: ActionContext) -> None:
    """Register a topic and wait for its subscribers; a stop that nobody takes is no stop."""
    deadline = connecting(config, context)
    if topic.kind is None:
        node.learn(topic, deadline)
    node.advertise(topic, deadline)
    listed = node.subscribers(topic.name, deadline)
    stop = _stop_topic(config)
    takes_stop = stop is not None and stop.name == topic.name
    is_message = topic.name == global_name(config.topic)
    needed = max(int(takes_stop), config.subscribers if is_message else 0)
    node.wait_for(topic.name, set(), needed, deadline)
    node.wait_for(topic.name, listed, 0, Deadline.within(OTHERS_S, context.stopped))


def _encoded(topic: OfferedTopic, message: Mapping[str, Any], context: ActionContext) -> bytes:
    if topic.kind is None:
        hint = "give its text under 'definition:'"
        raise UsageError(f"{topic.type} is not known, and no node has told its definition", hint)
    return topic.kind.encode(_placeholders.filled(message, context.parameters), time.time_ns())


def _publish(
    node: RosNode,
    config: Config,
    context: ActionContext,
    topics: list[OfferedTopic],
    duration_s: float,
    data: bytes,
) -> dict[str, Any]:
    """Publish for the duration; the message to stop follows unless a single message was wanted."""
    topic, published = topics[0].name, 0
    is_complete = False
    began_s = time.monotonic()
    try:
        for due_s in _due_times(config.rate, duration_s):
            if context.stopped():
                break
            if node.publish(topic, data) < min(1, config.subscribers):
                raise RosError(f"no subscriber of {topic} is left")
            published += 1
            if context.wait(max(0.0, began_s + due_s - time.monotonic())):
                break
            data = _encoded(topics[0], config.message, context)  # times that are now
        connected = node.connected(topic)
        late = node.flush(topic, Deadline.within(TAKEN_S, context.stopped))
        if connected and connected <= late and not context.stopped():
            raise RosError(f"no subscriber of {topic} takes messages")
        is_complete = not duration_s and not context.stopped()
    finally:
        if config.safe_stop is not None and not is_complete:
            _stop_run(node, topics[-1], config.safe_stop, context)
    return {"published": published, "subscribers": sorted(connected)}


def _due_times(rate_hz: float, duration_s: float) -> Iterator[float]:
    """Yield for each message when the next one is due, or the end, in seconds from the first."""
    count = math.ceil(rate_hz * duration_s - 1e-9) if rate_hz else 1
    for number in range(1, max(1, count) + 1):
        yield min(number / rate_hz, duration_s) if rate_hz else duration_s


def _stop_run(
    node: RosNode, topic: OfferedTopic, stop: PublishedStop, context: ActionContext
) -> None:
    """Publish the message to stop at the end of a run, on the connections that are open."""
    node.publish(topic.name, _encoded(topic, stop.message, context))
    limit_s = STOPPED_S if context.stopped() else TAKEN_S
    connected = node.connected(topic.name)
    late = node.flush(topic.name, Deadline.within(limit_s))
    if not connected or connected <= late:
        raise RosError(f"no subscriber of {topic.name} has taken the message to stop")
