"""What is recorded of a robot: the topics chosen, their streams, and how many messages were lost.

All ways to a ROS 2 robot share this; each only finds topics and brings messages.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amberbox.blackbox.sources.ros2_transports import names
from amberbox.blackbox.sources.ros2_transports.definitions import Definitions
from amberbox.blackbox.sources.ros2_transports.options import Ros2Options
from amberbox.core.errors import did_you_mean
from amberbox.core.source import Sink
from amberbox.core.types import Schema, Topic

PARAMETER_EVENTS = "/parameter_events"
MOST_TOPICS = 10_000  # recorded at once; a robot that offers more is out of order or hostile
UNKNOWN_AFTER_S = 10.0
MOST_NAMES = 10  # of other topics in one event
_MOST_PUBLISHERS = 10_000  # whose last sequence number is remembered
_LONGEST_HOLE = 10_000_000  # more missing numbers are no count of messages
_LATCHED_DIGESTS = 16  # remembered of each latched topic: it may have several publishers
_LONGEST_TEXT = 500


@dataclass(frozen=True, slots=True)
class OfferedTopic:
    """A topic as the robot offers it; ``schema`` is None where the robot sends no definition.

    ``type_hash`` is that of REP 2016, empty where the robot gives none.
    """

    name: str
    type_name: str
    type_hash: str = ""
    latched: bool = False
    encoding: str = "cdr"
    schema: Schema | None = None


class RecordedTopics:
    """Chooses among the topics of a robot and gives each its stream. Safe from any thread."""

    def __init__(self, options: Ros2Options, sink: Sink) -> None:
        self._options = options
        self._sink = sink
        self._selection = options.selection()
        folders = [Path(folder).expanduser() for folder in options.definitions]
        self._definitions = Definitions(folders, options.distribution)
        self._streams: dict[OfferedTopic, int] = {}
        self._known_latched: dict[str, list[str]] = _texts(sink.state().get("latched"))
        self._reported: set[tuple[str, ...]] = set()
        self._offered: set[str] = set()
        self._missing_since_s: float | None = None
        self._lock = threading.RLock()

    def chooses(self, name: str, type_name: str) -> bool:
        """Return whether a topic that is offered is recorded: listed, or found and not hidden."""
        if len(self._offered) < MOST_TOPICS:
            self._offered.add(name[: names.MOST_CHARACTERS])
        if name in self._selection.named:
            return True
        if name == PARAMETER_EVENTS and self._options.parameters and self._options.via != "bridge":
            return True
        if len(name) > names.MOST_CHARACTERS or not name.isprintable():
            return False
        if names.is_service_event(name):
            is_shown = self._options.services
        elif names.is_action_topic(name):
            is_shown = self._options.actions
        else:
            is_shown = not names.is_hidden(name)
        return is_shown and self._selection.chooses(name, type_name)

    def knows(self, type_name: str, type_hash: str) -> bool:
        """Return whether the definition with this hash is known without asking the robot."""
        return bool(type_hash) and bool(self._definitions.find(type_name, type_hash).schema.data)

    def expect(self, offer: OfferedTopic) -> None:
        """Look for a definition before the first message, which then need not wait for it."""
        if offer.schema is None:
            self._definitions.find(offer.type_name, offer.type_hash)

    def report_missing(self) -> None:
        """Report listed topics that nobody has offered for a while; for each look at the robot."""
        now_s = time.monotonic()
        if self._missing_since_s is None:
            self._missing_since_s = now_s
        if now_s - self._missing_since_s < UNKNOWN_AFTER_S:
            return
        self._missing_since_s = now_s
        known = sorted(self._offered)
        more = f" and {len(known) - MOST_NAMES} more" if len(known) > MOST_NAMES else ""
        listing = ", ".join(known[:MOST_NAMES]) + more if known else "no topics"
        for name in self._selection.named.keys() - self._offered:
            text = f"no publisher of {name}{did_you_mean(name, known)}; the robot has {listing}"
            self.report_once(("missing", name), "ros2_no_publisher", text, topic=name)

    def stream(self, offer: OfferedTopic, sample: bytes) -> int:
        """Return the stream of a topic, -1 for one too many; ``sample`` is a message of it."""
        number = self._streams.get(offer)
        if number is not None:
            return number
        with self._lock:
            if offer not in self._streams:
                self._streams[offer] = self._new_stream(offer, sample)
            return self._streams[offer]

    def _new_stream(self, offer: OfferedTopic, sample: bytes) -> int:
        if len(self._streams) >= MOST_TOPICS:
            text = f"more than {MOST_TOPICS} topics and types; further ones are not recorded"
            self.report_once(("many",), "ros2_too_many_topics", text)
            return -1
        wanted = self._selection.options(offer.name)
        if wanted is not None and wanted.type and wanted.type != offer.type_name:
            text = f"{offer.name} is {offer.type_name}, not {wanted.type} as configured"
            self.report_once(("type", offer.name), "ros2_type_differs", text, topic=offer.name)
        schema = offer.schema
        if schema is None:
            found = self._definitions.find(offer.type_name, offer.type_hash, sample)
            schema = found.schema
            if found.problem:
                kept = "" if schema.data else "; bytes are kept"
                text = f"{offer.name}: {offer.type_name}: {found.problem}{kept}"
                key = ("definition", offer.name, offer.type_name, offer.type_hash)
                self.report_once(key, "ros2_no_definition", text, topic=offer.name)
        return self._sink.topic(Topic(offer.name, offer.encoding, schema, offer.latched))

    def is_repeat(self, topic: str, peer: str, data: bytes) -> bool:
        """Return whether the first message of a publisher after connecting is recorded already.

        A latched topic delivers its last message to each new subscriber.
        """
        digest = _digest(data)
        last = self._sink.last_latched(topic)
        with self._lock:
            known = digest in self._known_latched.get(topic, ())
        if not known and (last is None or _digest(last) != digest):
            return False
        text = f"{topic}: {peer} delivered its latched message again; recorded once"
        self.report_once(("repeat", topic, peer), "ros2_latched_repeat", text, topic=topic)
        return True

    def latched(self, topic: str, data: bytes) -> None:
        """Remember a latched message, also for the next run."""
        digest = _digest(data)
        with self._lock:
            known = self._known_latched.setdefault(topic, [])
            if digest in known:
                return
            known.append(digest)
            del known[:-_LATCHED_DIGESTS]
            state = {**self._sink.state(), "latched": self._known_latched}
        self._sink.save_state(state)

    def report_not_offered(self, topic: str, quality: str) -> None:
        """Report that a publisher lacks what ``qos`` asks for; it is read without."""
        text = f"{topic}: a publisher does not offer {quality}; it is read without"
        self.report_once(("qos", quality, topic), "ros2_qos_not_offered", text, topic=topic)

    def report(self, kind: str, text: str, **details: Any) -> None:
        """Emit an event; text from the robot is reduced to one line."""
        self._sink.event(kind, " ".join(text.split())[:_LONGEST_TEXT], **details)

    def report_once(self, key: tuple[str, ...], kind: str, text: str, **details: Any) -> None:
        """Emit an event unless ``key`` has been reported and not been cleared."""
        with self._lock:
            if key in self._reported or len(self._reported) >= MOST_TOPICS:
                return
            self._reported.add(key)
        self.report(kind, text, **details)

    def clear(self, *key: str) -> bool:
        """Allow what begins with ``key`` to be reported again; return whether any of it was."""
        with self._lock:
            old = {reported for reported in self._reported if reported[: len(key)] == key}
            self._reported -= old
        return bool(old)


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def _texts(saved: Any) -> dict[str, list[str]]:
    if not isinstance(saved, dict):
        return {}
    return {str(topic): [str(text) for text in texts] for topic, texts in saved.items()}


class SequenceBook:
    """Counts missing messages of publishers by the numbers that their messages carry."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        # publisher (its id on the wire) and topic to its last number and when it was received
        self._last: OrderedDict[tuple[bytes, str], tuple[int, int]] = OrderedDict()

    def take(
        self, topic: str, publisher: bytes, peer: Callable[[], str], number: int, received_ns: int
    ) -> bool:
        """Report what is missing before a message; return False for one delivered before.

        ``peer`` returns the publisher's name for a gap. No publisher of ROS 2 counts back: a new
        one has another id.
        """
        key = (publisher, topic)
        last = self._last.get(key)
        if last is not None and number <= last[0]:
            return False
        self._last[key] = (number, received_ns)
        if last is None:
            if len(self._last) > _MOST_PUBLISHERS:
                self._last.popitem(last=False)
            return True
        missing = number - last[0] - 1
        if 0 < missing <= _LONGEST_HOLE:
            reason = "lost before the box: holes in the sequence numbers"
            self._sink.lost(topic, peer(), last[1], received_ns, missing, reason)
        return True
