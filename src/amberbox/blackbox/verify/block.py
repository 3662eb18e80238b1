"""Judge a stretch of a journal whose hash is not the one that was stated: disk or person?"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import msgspec
import numpy as np

from amberbox.blackbox.journal import mcap, reserved
from amberbox.blackbox.journal.buffer import Buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.mcap import CHAIN_METADATA, START_METADATA
from amberbox.blackbox.journal.walk import Damage, Metadata, Walk, run_tag
from amberbox.blackbox.verify.findings import Finding
from amberbox.blackbox.verify.links import Link, link_values
from amberbox.blackbox.verify.mended import first_difference, mended
from amberbox.blackbox.verify.place import Places

_PROFILES = ("", "ros1", "ros2")


@dataclass(frozen=True, slots=True)
class Identity:
    """What the start of a journal file has to say; ``chains`` are the links it may go on from."""

    store_id: str
    writer: str
    run: int
    number: int
    chains: Sequence[str]

    @property
    def tag(self) -> str:
        """The mark that each chunk of the file carries."""
        values = {"store_id": self.store_id, "writer": self.writer, "run": str(self.run)}
        return run_tag(values)


@dataclass(frozen=True, slots=True)
class Block:
    """A stretch of a file whose SHA-256 should be ``digest``.

    ``before`` is the link that stands at its start, None at the start of the file. ``tail`` says
    that the stretch is the end of the file, index included.
    """

    start: int
    end: int
    digest: str
    before: Link | None
    tail: bool = False


@dataclass(frozen=True, slots=True)
class _Seen:
    """What a walk over a block finds."""

    chunks: Sequence[Chunk]
    damage: Sequence[Damage]
    start: Metadata | None


def judge(data: Buffer, places: Places, identity: Identity, block: Block) -> Finding:
    """Tell what is wrong with a block that has not the hash it should have."""
    seen = _look(data, identity, block)
    whole = _mend(data, identity, block, seen)
    if whole is not None:
        at = first_difference(data, block.start, whole)
        text = "bytes around the messages are damaged; the messages themselves are proven"
        return places.finding("damaged", text, at, at + 1, _chunk_of(seen, at))
    if seen.damage and (block.tail or block.before is None or _lost(seen)):
        return _damaged(places, seen)
    return _altered(places, block, seen)


def _look(data: Buffer, identity: Identity, block: Block) -> _Seen:
    """Walk the chunks of a block."""
    walk = Walk(data[: block.end], at=block.start, tag=identity.tag, trusted=block.start)
    found = list(walk)
    start = next((f for f in found if isinstance(f, Metadata) and f.name == START_METADATA), None)
    chunks = sorted((f for f in found if isinstance(f, Chunk)), key=lambda chunk: chunk.offset)
    return _Seen(chunks, [f for f in found if isinstance(f, Damage)], start)


def _mend(data: Buffer, identity: Identity, block: Block, seen: _Seen) -> bytes | None:
    """Write the block anew from what its checksums vouch for."""
    if block.before is None:
        leads = list(_file_starts(identity, seen))
    else:
        leads = list(_link_records(block.before, seen))
    ends = [b""]
    if block.tail:
        ends = list(_file_ends(data, seen, leads, block))
    for end in ends:
        whole = mended(data, leads, seen.chunks, end, block.digest)
        if whole is not None:
            return whole
    return None


def _file_ends(data: Buffer, seen: _Seen, leads: Sequence[bytes], block: Block) -> Iterator[bytes]:
    """Give what may follow the last chunk of a file: as it is, or its index after a sound mark."""
    for lead in leads[:1]:
        at = seen.chunks[-1].end if seen.chunks else block.start + len(lead)
        rest = bytes(data[at : block.end])
        yield rest
        mark = mcap.record(mcap.DATA_END, bytes(4))
        yield mark + rest[len(mark) :]


def _file_starts(identity: Identity, seen: _Seen) -> Iterator[bytes]:
    """Give what may stand before the first chunk of a file."""
    first_seq = int(seen.chunks[0].sequence[0]) if seen.chunks else 0
    stated = seen.start.values if seen.start is not None else {}
    boots = list(dict.fromkeys([stated.get("boot_id", ""), *_boot_ids(seen)]))
    chains = list(dict.fromkeys([stated.get("chain", ""), *identity.chains]))
    firsts = list(dict.fromkeys([stated.get("first_seq", ""), str(first_seq)]))
    for profile, boot_id, chain, first in product(_PROFILES, boots, chains, firsts):
        values = {
            "store_id": identity.store_id,
            "writer": identity.writer,
            "run": str(identity.run),
            "boot_id": boot_id,
            "file": str(identity.number),
            "first_seq": first,
            "chain": chain,
        }
        start = mcap.metadata_record(START_METADATA, values)
        yield mcap.MAGIC + mcap.header(profile) + start


def _boot_ids(seen: _Seen) -> Iterator[str]:
    """Read the boot from the record of the run, which a checksum vouches for."""
    for chunk in seen.chunks[:1]:
        for number in (n for n, c in chunk.channels.items() if c.topic == reserved.RUN):
            for message in chunk.messages(chunk.rows_of(number)):
                yield str(msgspec.json.decode(message).get("boot_id", ""))


def _link_records(before: Link, seen: _Seen) -> Iterator[bytes]:
    """Give the record of a link as it may have been written."""
    values = link_values(before)
    yield mcap.metadata_record(CHAIN_METADATA, values)
    if seen.chunks:
        low = int(seen.chunks[0].sequence[0])
        next_seq = before.next_seq + ((low - before.next_seq) & 0xFFFFFFFF)
        for number in (low, next_seq):
            yield mcap.metadata_record(CHAIN_METADATA, {**values, "next_seq": str(number)})


def _lost(seen: _Seen) -> bool:
    """Tell whether messages are missing between the chunks, before or after them."""
    if not seen.chunks or any(_holds_chunk(damage) for damage in seen.damage):
        return True
    numbers = np.concatenate([chunk.sequence.astype(np.int64) for chunk in seen.chunks])
    return bool((np.diff(numbers) & 0xFFFFFFFF != 1).any())


def _holds_chunk(damage: Damage) -> bool:
    return damage.reason not in ("message index is damaged", "metadata record is damaged")


def _damaged(places: Places, seen: _Seen) -> Finding:
    first, last = seen.damage[0], seen.damage[-1]
    text = f"{first.reason}: the disk or a copy did this"
    if len(seen.damage) > 1:
        text += f" ({len(seen.damage)} places)"
    return places.finding("damaged", text, first.from_offset, last.to_offset, first.from_offset)


def _altered(places: Places, block: Block, seen: _Seen) -> Finding:
    text = "all checksums hold, but the hash chain does not: the content was changed"
    if len(seen.chunks) > 1:
        text += f" in one or more of {len(seen.chunks)} chunks"
    first = seen.chunks[0].offset if seen.chunks else None
    return places.finding("altered", text, block.start, block.end, first)


def count_messages(data: Buffer, identity: Identity, start: int, end: int) -> int:
    """Count the messages of the sound chunks in a stretch of a file."""
    walk = Walk(data[:end], at=start, tag=identity.tag, trusted=start)
    return sum(len(found) for found in walk if isinstance(found, Chunk))


def _chunk_of(seen: _Seen, at: int) -> int | None:
    """Return the chunk that a byte belongs to, its indices included."""
    before = [chunk.offset for chunk in seen.chunks if chunk.offset <= at]
    return before[-1] if before else None


def digest(data: Buffer, start: int, end: int) -> str:
    """SHA-256 of some bytes of a file."""
    return hashlib.sha256(data[start:end]).hexdigest()
