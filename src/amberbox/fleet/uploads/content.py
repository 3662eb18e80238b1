"""What a journal may hold: names, sizes and counts that a server can keep, whoever sealed it.

A seal says that a file is the robot's, not that it is harmless. Nothing that the file announces is
believed: chunks are unpacked one after the other, each up to a limit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from amberbox.blackbox.follow.read import JournalFile, describe
from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.mcap import Channel, parse_chunk_head
from amberbox.blackbox.journal.scan import ChunkPlace, read_chunk, scan
from amberbox.blackbox.unroll import MOST_SCHEMA_BYTES
from amberbox.blackbox.verify.block import Identity
from amberbox.core.clock import NS
from amberbox.core.names import has_item_form
from amberbox.core.types import Schema

MOST_CHANNELS = 10_000
MOST_CHUNK_BYTES = 64 << 20
"""Of a compressed chunk, unpacked: a box packs about 1 MB at a time."""
MOST_BYTES = 16 << 30
"""Of all chunks of a file, unpacked: a box begins a new file after 64 MB."""
MOST_MESSAGES = 50_000_000
MOST_DAYS = 400
"""Each day of receipt is a file of its own in each table; a box begins a new file in minutes."""

_DAY_NS = 24 * 3600 * NS


class ContentError(ValueError):
    """A journal that holds what no robot of ours writes, and no server can keep."""


def check_content(path: Path, name: str, identity: Identity) -> JournalFile:
    """Describe a journal after all of it was looked at.

    Raises ContentError for one that is another than its name says, or names or holds what it
    may not.
    """
    found = scan(path)
    summary = found.summary
    _check_definitions(summary.channels, summary.schemas)
    with open_buffer(path) as data:
        _check_sizes(data, found.places)
        _check_chunks(filter(None, (read_chunk(data, place) for place in found.places)))
    journal = describe(found, name)
    _check_identity(journal, identity)
    return journal


def _check_identity(journal: JournalFile, identity: Identity) -> None:
    """Compare all that a file says of itself with its name: readers go by what it says."""
    stated = journal.store_id, journal.writer, journal.run, journal.number
    if stated != (identity.store_id, identity.writer, identity.run, identity.number):
        raise ContentError("it does not say at its start that it is the file of its name")


def _check_definitions(channels: Mapping[int, Channel], schemas: Mapping[int, Schema]) -> None:
    if max(len(channels), len(schemas)) > MOST_CHANNELS:
        raise ContentError(f"it has more than {MOST_CHANNELS} channels or schemas")
    for schema in schemas.values():
        if len(schema.data) > MOST_SCHEMA_BYTES:
            raise ContentError(f"a schema has more than {MOST_SCHEMA_BYTES >> 20} MB")
    for channel in channels.values():
        item = channel.metadata.get("item", "")
        if item and not has_item_form(item):
            said = ascii(item[:60])
            raise ContentError(f"it names an item {said}: letters, digits and _ make a name")


def _check_sizes(data: bytes | memoryview, places: list[ChunkPlace]) -> None:
    """Compare the sizes that compressed chunks state with the limits, before any is unpacked."""
    total = 0
    for place in places:
        head = parse_chunk_head(data, place.offset)
        if head is None or not head.compression:
            continue
        total += head.size
        if head.size > MOST_CHUNK_BYTES:
            raise ContentError(f"a chunk unpacks to more than {MOST_CHUNK_BYTES >> 20} MB")
    if total > MOST_BYTES:
        raise ContentError(f"it unpacks to more than {MOST_BYTES >> 30} GB")


def _check_chunks(chunks: Iterator[Chunk]) -> None:
    messages, days = 0, set[int]()
    for chunk in chunks:
        _check_definitions(chunk.channels, chunk.schemas)
        messages += len(chunk)
        if not len(chunk):
            continue
        if int(chunk.log_ns.min()) < 0:
            raise ContentError("a message is of a time that no clock shows")
        days.update(np.unique(chunk.log_ns // _DAY_NS).tolist())
        if messages > MOST_MESSAGES:
            raise ContentError(f"it has more than {MOST_MESSAGES} messages")
        if len(days) > MOST_DAYS:
            raise ContentError(f"it has messages of more than {MOST_DAYS} days")
