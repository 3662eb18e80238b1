"""What the watcher remembers in its own journal: how far it has come, and what it knew then."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.follow.read import newest_first, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.keeper.ownjournal import Progress
from amberbox.blackbox.store import Store
from amberbox.core.types import Cursor, WriterCursor
from amberbox.monitoring.engine.findings import is_live_only
from amberbox.monitoring.messages.records import finding_of
from amberbox.monitoring.watcher.epoch import Epoch, epoch_of

EVALUATED = "evaluated"
CHECKPOINT = "checkpoint"
_FINDINGS = (
    *(reserved.STATUS, reserved.EVENT, reserved.ALARM),
    *(reserved.SYMPTOM, reserved.DIAGNOSIS),
)


@dataclass(frozen=True, slots=True)
class Place:
    """An instant of the record up to which everything is evaluated."""

    epoch: Epoch
    until_ns: int

    def before(self) -> Place:
        """Return the place before the first instant of the epoch."""
        return Place(self.epoch, 0)

    def note(self, store_id: str) -> Progress:
        """Make the note that stands beside the findings up to here."""
        state = {"epoch": str(self.epoch), "until_ns": self.until_ns}
        return Progress(Cursor(store_id), EVALUATED, msgspec.json.encode(state).decode())


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """All that is needed to go on from a place: what the engine knew, where the reading stood.

    Rows that matter begin ``lookback_s`` before there. Without anything in ``engine`` it has to
    begin anew there.
    """

    place: Place
    positions: Mapping[str, WriterCursor]
    lookback_s: float
    engine: Mapping[str, Any]
    monitors: str = ""

    def note(self, store_id: str) -> Progress:
        """Make the note that is written down."""
        state = {
            "epoch": str(self.place.epoch),
            "until_ns": self.place.until_ns,
            "lookback_s": self.lookback_s,
            "monitors": self.monitors,
            "engine": self.engine,
        }
        cursor = Cursor(store_id, self.positions)
        encoded = msgspec.json.encode(state, enc_hook=_plain)
        return Progress(cursor, CHECKPOINT, encoded.decode())


@dataclass(slots=True)
class Memory:
    """What a watcher left behind: its last checkpoint, how far it came after it.

    ``more`` findings were written after those up to ``place``: it was killed amid them.
    """

    place: Place | None = None
    checkpoint: Checkpoint | None = None
    more: int = 0
    is_ours: bool = True
    """What the engine knew was known by the same monitors."""


def _plain(value: Any) -> Any:
    """Return what numpy has made as plain Python."""
    return value.tolist()


def recall(store: Store) -> Memory:
    """Read what the last watcher of a store left behind, from the end of its journal back."""
    memory = Memory()
    for chunk, topics in _chunks_from_end(store):
        for topic, values in reversed(_records(chunk, topics)):
            _take(memory, store.id, topic, values)
        if memory.checkpoint is not None:
            break
    return memory


def _chunks_from_end(store: Store) -> Iterator[tuple[Chunk, Mapping[int, str]]]:
    for journal in newest_first(store, "watch"):
        topics = {n: s.topic.name for n, s in journal.streams.items()}
        wanted = {n: t for n, t in topics.items() if t in (reserved.CURSOR, *_FINDINGS)}
        for place in reversed(journal.places):
            for chunk in sound_chunks(journal, partial(operator.is_, place)):
                yield chunk, wanted


def _records(chunk: Chunk, topics: Mapping[int, str]) -> Sequence[tuple[str, Any]]:
    rows = np.flatnonzero(np.isin(chunk.channel, list(topics)))
    messages = map(msgspec.json.decode, chunk.messages(rows))
    return [
        (topics[number], values)
        for number, values in zip(chunk.channel[rows].tolist(), messages, strict=True)
    ]


def _take(memory: Memory, store_id: str, topic: str, values: Mapping[str, Any]) -> None:
    """Take one record, newest first."""
    if topic != reserved.CURSOR:
        if memory.place is None:
            finding = finding_of(topic, values)
            memory.more += finding is not None and not is_live_only(finding)
        return
    state = msgspec.json.decode(values["state"] or "{}")
    epoch = epoch_of(str(state.get("epoch", "")))
    cursor = Cursor.from_json(values["cursor"])
    if epoch is None or cursor.store_id != store_id:
        return
    place = Place(epoch, int(state["until_ns"]))
    if memory.place is None:
        memory.place = place
    if values["reader"] == CHECKPOINT and memory.checkpoint is None:
        memory.checkpoint = Checkpoint(
            place, cursor.writers, float(state["lookback_s"]), state["engine"], state["monitors"]
        )
