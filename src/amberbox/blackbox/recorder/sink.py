"""What a source sees of the recorder: topics become items, messages go into the queue."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from amberbox.blackbox.follow import read
from amberbox.blackbox.recorder.pipeline import Pipeline
from amberbox.blackbox.recorder.streams import Stream, tell_unused
from amberbox.blackbox.unroll.notes import notes_of
from amberbox.core.files import replace_file
from amberbox.core.source import Power, TopicOptions
from amberbox.core.types import Topic

INFERRED = ("json", "msgpack")


class BlockSink:
    """The sink of one configured block."""

    def __init__(
        self, pipeline: Pipeline, name: str, topics: Sequence[TopicOptions], *, lossless: bool
    ) -> None:
        self._pipeline = pipeline
        self._name = name
        self._options = {options.name: options for options in topics}
        self._streams: list[Stream] = []
        self._numbers: dict[Topic, int] = {}
        self._links: set[tuple[str, str]] = set()
        self._lock = threading.Lock()
        self._waits = lossless
        self._put = pipeline.intake.put_waiting if lossless else pipeline.intake.put
        self.now_ns = pipeline.clock.now_ns

    def expect_topics(self) -> None:
        """Make each configured topic an item and open its gap, as nothing of it is heard yet.

        Files have no gaps of this kind.
        """
        for options in self._options.values():
            item = self._pipeline.item(self._name, options.name, options)
            if options.keep != "none" and not self._waits:
                self._pipeline.gaps.expect(item.name)

    def topic(self, topic: Topic) -> int:
        with self._lock:
            if topic not in self._numbers:
                self._streams.append(self._new_stream(topic))
                self._numbers[topic] = len(self._streams) - 1
            return self._numbers[topic]

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        self._put(self._streams[stream], data, received_ns)

    def longest_message(self) -> int:
        return self._pipeline.intake.longest_bytes

    def has_heard(self) -> bool:
        """Tell whether any message has come so far."""
        return any(stream.counters.received for stream in self._streams)

    def lose_links(self, reason: str) -> None:
        """Open the gaps of all peers: the source has failed without saying so."""
        for topic, peer in list(self._links):
            self.link_down(topic, peer, reason)

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        self._links.add((topic, peer))
        self._pipeline.gaps.up(self._item(topic), peer, self.now_ns(), since_ns)

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        self._links.discard((topic, peer))
        at_ns = self.now_ns() if since_ns is None else since_ns
        self._pipeline.gaps.down(self._item(topic), peer, at_ns, reason)

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        item = self._pipeline.items[self._item(topic)]
        self._pipeline.intake.count_lost(item, count)
        self._pipeline.gaps.lost(item.name, peer, from_ns, to_ns, reason, count)

    def event(self, kind: str, text: str, **details: Any) -> None:
        self._pipeline.event(kind, text, self._name, **details)

    def power(self, state: Power, text: str) -> None:
        self._pipeline.power = state  # before the event, which wakes those who act on it
        self._pipeline.event(f"power_{state}", text, self._name)

    def last_latched(self, topic: str) -> bytes | None:
        item = self._pipeline.items.get(self._item(topic))
        if item is None:
            return None
        if item.last_latched is None:
            item.last_latched = read.last_message(self._pipeline.store.path, item.name)
        return item.last_latched

    def state(self) -> dict[str, Any]:
        try:
            values = json.loads(self._state_file().read_text())
        except (OSError, ValueError):  # none yet; or torn, then the source finds out anew
            return {}
        return values if isinstance(values, dict) else {}

    def save_state(self, state: Mapping[str, Any]) -> None:
        path = self._state_file()
        try:
            path.parent.mkdir(exist_ok=True)
            replace_file(path, json.dumps(state))
        except OSError as error:  # the source shall go on listening
            self.event("disk", f"the state of {self._name} is not kept: {error.strerror}")

    def _state_file(self) -> Path:
        return self._pipeline.store.path / "state" / f"{self._name}.json"

    def _item(self, topic: str) -> str:
        options = self._options.get(topic) or TopicOptions(name=topic)
        return self._pipeline.item(self._name, topic, options).name

    def _new_stream(self, topic: Topic) -> Stream:
        item = self._pipeline.items[self._item(topic.name)]
        item.waits = self._waits
        infers = topic.message_encoding in INFERRED
        told = notes_of(topic.schema) if infers else {}
        if infers:  # what is really sent counts, not what was declared
            topic = replace(topic, schema=None)
        stream = Stream(item, topic, infers=infers, told=told, letters=self._pipeline.names.letters)
        known = [s for s in self._streams if s.item is item]
        if known and not stream.infers:
            self._tell_of_change(known[-1].topic, topic, item.name)
        if topic.latched and not stream.infers:
            self._pipeline.latched(stream)
        wrong = "" if stream.infers else stream.compile()
        if wrong:
            self.event(
                "undecodable", f"{item.name}: {wrong}; raw messages are kept", item=item.name
            )
        tell_unused(stream, self._pipeline.event)
        return stream

    def _tell_of_change(self, old: Topic, new: Topic, item: str) -> None:
        if (old.message_encoding, old.schema) == (new.message_encoding, new.schema):
            return  # one publisher latches, another does not
        before = old.schema.name if old.schema else old.message_encoding
        after = new.schema.name if new.schema else new.message_encoding
        text = f"{item}: the definition changed from {before} to {after}"
        if before == after:
            text = f"{item}: the definition of {after} changed"
        self.event("type_changed", text, item=item, before=before, after=after)
