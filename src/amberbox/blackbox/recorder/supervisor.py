"""Run a source in a thread of its own, restart it with back-off, and provide its sink."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from amberbox.blackbox.columns.json_schema import notes_of
from amberbox.blackbox.filters.image import ImageFilter
from amberbox.blackbox.recorder.image_converter import LATE_NS, ImageConverter
from amberbox.blackbox.recorder.pipeline import Pipeline
from amberbox.blackbox.recorder.queue import TopicStream, report_unused_names
from amberbox.blackbox.recorder.source_process import (
    ProcessSink,
    SourceProcess,
    SourceProcessError,
    needs_process,
)
from amberbox.blackbox.robot_folder.black_box_yaml import SourceBlock
from amberbox.blackbox.robot_folder.folder import SOURCES
from amberbox.blackbox.store import journal_reader
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.files import replace_file
from amberbox.core.plugins import get
from amberbox.core.source import MOST_LATE_S, Power, TopicOptions
from amberbox.core.topic_selection import TopicSelection
from amberbox.core.types import Topic

INFERRED = ("json", "msgpack")


class BlockSink:
    """The sink of one configured block."""

    def __init__(
        self,
        pipeline: Pipeline,
        name: str,
        topics: Sequence[TopicOptions],
        *,
        lossless: bool,
        late_s: float = 0.0,
    ) -> None:
        self._pipeline = pipeline
        self._late = pipeline.late_source(round(late_s * NS)) if late_s else None
        self._name = name
        self._selection = TopicSelection(topics)
        self._streams: list[TopicStream] = []
        self._numbers: dict[Topic, int] = {}
        self._converters: dict[int, ImageConverter] = {}
        self._items: dict[str, str] = {}
        self._links: set[tuple[str, str]] = set()
        self._lock = threading.Lock()
        self._waits = lossless
        self._put = pipeline.queue.put_waiting if lossless else pipeline.queue.put
        self.now_ns = pipeline.clock.now_ns

    def expect_topics(self) -> None:
        """Create the item of each topic listed by name; open its gap until a publisher connects.

        Files have no gaps of this kind.
        """
        for options in self._selection.named.values():
            item = self._pipeline.item(self._name, options.name, options)
            if options.keep != "none" and not self._waits:
                self._pipeline.gaps.expect(item.name)

    def topic(self, topic: Topic) -> int:
        with self._lock:
            if topic not in self._numbers:
                number = len(self._streams)
                found = self._new_stream(topic)
                converter = self._image_converter(found)
                if converter is not None:
                    self._converters[number] = converter
                self._streams.append(found)
                self._numbers[topic] = number
            return self._numbers[topic]

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        converter = self._converters.get(stream)
        if converter is None:
            self._put(self._streams[stream], data, received_ns)
        else:
            converter.put(data, received_ns)

    def finish(self) -> None:
        """Pass on everything that was received: the source has ended."""
        for converter in list(self._converters.values()):
            converter.finish()

    def longest_message(self) -> int:
        return self._pipeline.queue.longest_bytes

    def complete(self, until_ns: int) -> None:
        if self._late is not None:
            self._late.complete_ns = until_ns

    def end_run(self) -> None:
        """Hold the watermark back no longer: the source does not run now."""
        if self._late is not None:
            self._late.complete_ns = None

    def dropped(self, stream: int, from_ns: int, to_ns: int, count: int) -> None:
        """Count messages for which the source's process had no room, as if the queue was full."""
        self._pipeline.queue.count_dropped(self._streams[stream], from_ns, to_ns, count)

    def has_received(self) -> bool:
        """Return whether any message was received so far."""
        return any(stream.counters.received for stream in self._streams)

    def lose_links(self, reason: str, since_ns: int | None = None) -> None:
        """Open the gaps of all peers after the source has failed."""
        for topic, peer in list(self._links):
            self.link_down(topic, peer, reason, since_ns)

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        self.link_up_at(topic, peer, self.now_ns(), since_ns)

    def link_up_at(self, topic: str, peer: str, at_ns: int, since_ns: int | None) -> None:
        """Report as ``link_up`` that messages arrive since ``at_ns``."""
        self._links.add((topic, peer))
        self._pipeline.gaps.up(self._item(topic), peer, at_ns, since_ns)

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        self._links.discard((topic, peer))
        at_ns = self.now_ns() if since_ns is None else since_ns
        self._pipeline.gaps.down(self._item(topic), peer, at_ns, reason)

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        item = self._pipeline.items[self._item(topic)]
        self._pipeline.queue.count_lost(item, count)
        self._pipeline.gaps.lost(item.name, peer, from_ns, to_ns, reason, count)

    def event(self, kind: str, text: str, **details: Any) -> None:
        self._pipeline.event(kind, text, self._name, **details)

    def power(self, state: Power, text: str) -> None:
        self._pipeline.power = state  # before the event, which wakes the threads that act on it
        self._pipeline.event(f"power_{state}", text, self._name)

    def last_latched(self, topic: str) -> bytes | None:
        item = self._pipeline.items.get(self._item(topic))
        if item is None:
            return None
        if item.last_latched is None:
            item.last_latched = journal_reader.last_message(self._pipeline.store.path, item.name)
        return item.last_latched

    def state(self) -> dict[str, Any]:
        try:
            values = json.loads(self._state_file().read_text())
        except (OSError, ValueError):  # none yet, or torn: the source starts without
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
        """Return the name of a topic's item; its options are looked up once."""
        if topic not in self._items:
            options = self._selection.options(topic) or TopicOptions(name=topic)
            self._items[topic] = self._pipeline.item(self._name, topic, options).name
        return self._items[topic]

    def _new_stream(self, topic: Topic) -> TopicStream:
        item = self._pipeline.items[self._item(topic.name)]
        item.waits = self._waits
        infers = topic.message_encoding in INFERRED
        sender_notes = notes_of(topic.schema) if infers else {}
        if infers:  # the messages really sent count, not the declared ones
            topic = replace(topic, schema=None)
        stream = TopicStream(
            item,
            topic,
            infers=infers,
            sender_notes=sender_notes,
            letters=self._pipeline.names.letters,
        )
        known = [s for s in self._streams if s.item is item]
        if known and not stream.infers:
            self._report_type_change(known[-1].topic, topic, item.name)
        if topic.latched and not stream.infers and item.options.image is None:
            self._pipeline.latched(stream)
        wrong = "" if stream.infers else stream.compile()
        if wrong:
            self.event(
                "undecodable", f"{item.name}: {wrong}; raw messages are kept", item=item.name
            )
        report_unused_names(stream, self._pipeline.event)
        return stream

    def _image_converter(self, stream: TopicStream) -> ImageConverter | None:
        """Return the converter of a stream whose images are to be converted, None for others."""
        item = stream.item
        if item.options.image is None or item.options.keep == "none":
            return None
        try:
            images = ImageFilter(item.options.image, stream.topic)
        except AmberboxError as error:
            text = f"{item.name}: images are kept as they come: {error.what}; {error.hint}"
            self.event("image_kept", text, item=item.name)
            if stream.topic.latched:
                self._pipeline.latched(stream)
            return None
        converted = TopicStream(item, images.topic, note=images.note)
        converted.compile()
        if images.topic.latched:
            self._pipeline.latched(converted)
        pipeline = self._pipeline
        late_ns = LATE_NS + (self._late.late_ns if self._late else 0)
        late = None if self._waits else pipeline.late_source(late_ns)
        streams = stream, converted
        return ImageConverter(images, streams, pipeline.queue, pipeline.event, late)

    def _report_type_change(self, old: Topic, new: Topic, item: str) -> None:
        if (old.message_encoding, old.schema) == (new.message_encoding, new.schema):
            return  # one publisher latches, another does not
        before = old.schema.name if old.schema else old.message_encoding
        after = new.schema.name if new.schema else new.message_encoding
        text = f"{item}: the definition changed from {before} to {after}"
        if before == after:
            text = f"{item}: the definition of {after} changed"
        self.event("type_changed", text, item=item, before=before, after=after)


def run_source(source: Any, block: SourceBlock, sink: ProcessSink, stop: threading.Event) -> None:
    """Run the source of a block as ``Source.run``, in its own process if its module asks for one.

    Raises what the source raises, and SourceProcessError if its process dies.
    """
    module, node = get(SOURCES, block.plugin).load(), block.node
    if node is None or not needs_process(module, block.config):
        source.run(sink, stop)
        return
    folder = Path(block.file).parent
    SourceProcess(module.__name__, block.plugin, block.name, node, folder).run(sink, stop)


# how late the messages of a source's process may be, as it or the recorder is held up
LATE_S = 5.0
_FIRST_BACKOFF_S = 1.0
_MAX_BACKOFF_S = 30.0


class SourceSupervisor:
    """Runs the source of one configured block until ``stop`` is set."""

    def __init__(self, pipeline: Pipeline, block: SourceBlock, stop: threading.Event) -> None:
        self._pipeline = pipeline
        self._block = block
        self._stop = stop
        self._module = get(SOURCES, block.plugin).load()
        self._source: Any = None
        self._sink: BlockSink | None = None
        self._lossless = False
        self.thread = threading.Thread(target=self._run, name=block.name, daemon=True)

    def prepare(self) -> None:
        """Create the configured items before the first file is written, which lists them.

        A source that fails here fails again in its thread, which records the error.
        """
        with suppress(Exception):
            source = self._module.Source(self._block.config, self._block.name)
            self._sink = self._make_sink(source)
            self._source = source

    def _run(self) -> None:
        try:
            self._run_until_stopped()
        finally:
            if self._sink is not None:
                self._sink.finish()

    def _run_until_stopped(self) -> None:
        backoff_s = _FIRST_BACKOFF_S
        while not self._stop.is_set():
            began = time.monotonic()
            error = self._run_once()
            # a file that failed halfway is not played again: its first half would be there twice
            if error is None or (
                self._lossless and self._sink is not None and self._sink.has_received()
            ):
                if error is not None:
                    self._report_failure(error, "failed and has ended")
                elif not self._stop.is_set():
                    name = self._block.name
                    self._pipeline.event("source_ended", f"{name} has ended", name)
                return
            if time.monotonic() - began > _MAX_BACKOFF_S:
                backoff_s = _FIRST_BACKOFF_S
            if self._stop.is_set():
                self._report_failure(error, "failed and has ended")
                return
            self._report_failure(error, f"failed and starts again in {backoff_s:.0f} s")
            self._stop.wait(backoff_s)
            backoff_s = min(2 * backoff_s, _MAX_BACKOFF_S)

    def _run_once(self) -> Exception | None:
        try:
            source, self._source = self._source, None
            if source is None:
                source = self._module.Source(self._block.config, self._block.name)
            if self._sink is None:
                self._sink = self._make_sink(source)
            run_source(source, self._block, self._sink, self._stop)
        except Exception as error:  # whatever it is: the other sources go on
            return error
        finally:
            if self._sink is not None:
                self._sink.end_run()
        return None

    def _make_sink(self, source: Any) -> BlockSink:
        self._lossless = source.lossless
        name = self._block.name
        late_s = min(getattr(source, "late_s", 0.0), MOST_LATE_S)
        if needs_process(self._module, self._block.config):
            late_s = max(late_s, LATE_S)
        sink = BlockSink(
            self._pipeline, name, source.topics(), lossless=source.lossless, late_s=late_s
        )
        sink.expect_topics()
        return sink

    def _report_failure(self, error: Exception, what: str) -> None:
        name = self._block.name
        if self._sink is not None and isinstance(error, SourceProcessError):
            self._sink.lose_links(error.what, error.since_ns)
        elif self._sink is not None:
            self._sink.lose_links(f"{name} failed")
        text = f"{name} {what}: {error}"
        self._pipeline.event("source_failed", text, name, error=repr(error))
