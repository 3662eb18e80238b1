"""Check one journal file: its hash chain, its end, and its identity with its name.

A block of a journal holds compressed messages with a checksum, and bytes around them that follow
from the messages (indices, lengths, links of the chain). If the messages are valid, all other bytes
can be rebuilt. If the rebuilt block has the hash of the chain, the messages are proven and only the
bytes around them were damaged; otherwise messages were changed and their checksums recomputed.
"""

from __future__ import annotations

import hashlib
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import msgspec
import numpy as np
import zstandard

from amberbox.blackbox.journal import channels, mcap
from amberbox.blackbox.journal.chunk import Buffer, Chunk, open_buffer
from amberbox.blackbox.journal.mcap import CHAIN_METADATA, FOOTER_SIZE, START_METADATA, read_summary
from amberbox.blackbox.journal.scan import (
    JournalDamage,
    JournalWalk,
    MetadataRecord,
    metadata_at,
    run_tag,
    start_record,
)
from amberbox.blackbox.journal.writer import CHUNK_BYTES, COMPRESSION_LEVEL
from amberbox.blackbox.signing.findings import ChunkLocator, FindingState, VerifyFinding
from amberbox.blackbox.store.manifest_entries import SealedJournal
from amberbox.blackbox.store.store import FOLDERS, Store, run_and_number

_LINK = re.compile(rb"\x0c.{8}\x0e\0\0\0" + CHAIN_METADATA.encode(), re.DOTALL)


@dataclass(frozen=True, slots=True)
class ChainLink:
    """One link: it is at ``to`` and covers the bytes from ``start`` to there."""

    start: int
    to: int
    block: str
    chain: str
    next_seq: int
    end: int


def next_chain_hash(chain: str, block: str) -> str:
    """Compute a link from the one before and the SHA-256 of the bytes in between."""
    return hashlib.sha256(bytes.fromhex(chain + block)).hexdigest()


def link_values(link: ChainLink) -> dict[str, str]:
    """Return the values in the record of a link, in the order of writing."""
    return {
        "from": str(link.start),
        "to": str(link.to),
        "block": link.block,
        "chain": link.chain,
        "next_seq": str(link.next_seq),
    }


def links(data: Buffer) -> list[ChainLink]:
    """Find the links of a file: by the index at its end, else by looking at all bytes."""
    indexed = [link for at in _indexed(data) if (link := link_at(data, at)) is not None]
    if indexed and _tile(indexed) and _may_be_last(data, indexed[-1]):
        return indexed
    return [link for m in _LINK.finditer(data) if (link := link_at(data, m.start())) is not None]


def _tile(found: list[ChainLink]) -> bool:
    """Return whether each link begins where the one before ended."""
    starts = [0, *(link.to for link in found[:-1])]
    return all(link.start == start for link, start in zip(found, starts, strict=True))


def _may_be_last(data: Buffer, link: ChainLink) -> bool:
    """Return whether the end of the file follows a link, as its writer leaves it."""
    return link.end < len(data) and data[link.end] == mcap.DATA_END


def link_at(data: Buffer, offset: int) -> ChainLink | None:
    """Read the link at an offset, if it states that offset; None if there is none."""
    found = metadata_at(data, offset)
    if found is None or found.name != CHAIN_METADATA:
        return None
    return _link(found, found.values)


def _link(found: MetadataRecord, values: Mapping[str, str]) -> ChainLink | None:
    try:
        link = ChainLink(
            int(values["from"]), int(values["to"]), values["block"], values["chain"],
            int(values["next_seq"]), found.end,
        )  # fmt: skip
        whole = len(bytes.fromhex(link.block)) == len(bytes.fromhex(link.chain)) == 32
    except (KeyError, ValueError):
        return None
    return link if whole and 0 <= link.start < link.to == found.offset else None


def _indexed(data: Buffer) -> Iterator[int]:
    """Yield the places of all links that the end of a finished file names."""
    group = _group(data, mcap.METADATA_INDEX)
    if group is None:
        return
    at, end = group
    try:
        while at < end:
            length, offset = struct.unpack_from("<QQ", data, at + 1)
            name = bytes(data[at + 29 : at + 9 + length])
            if name == CHAIN_METADATA.encode():
                yield int(offset)
            at += 9 + length
    except struct.error:
        return


def _group(data: Buffer, kind: int) -> tuple[int, int] | None:
    """Find one kind of records in the summary by its offsets, from the footer on."""
    footer = len(data) - FOOTER_SIZE
    try:
        opcode, length, _, at = struct.unpack_from("<BQQQ", data, max(footer, 0))
        while (opcode, length) == (mcap.FOOTER, 20) and 0 < at < footer:
            group, start, size = struct.unpack_from("<BQQ", data, at + 9)
            if data[at] != mcap.SUMMARY_OFFSET:
                return None
            if group == kind:
                return start, min(start + size, footer)
            at += 26
    except struct.error:
        return None
    return None


def displaced_link(data: Buffer, after: int) -> tuple[int, int] | None:
    """Find the first link behind ``after`` that is not where it states: (offset, stated)."""
    for match in _LINK.finditer(data, after):
        found = metadata_at(data, match.start())
        stated = found.values.get("to", "") if found is not None else ""
        if stated.isdecimal() and int(stated) != match.start():
            return match.start(), int(stated)
    return None


def rebuilt_block(
    data: Buffer, leads: Sequence[bytes], chunks: Sequence[Chunk], end: bytes, digest: str
) -> bytes | None:
    """Return a block rebuilt from its sound chunks; None if no attempt has the ``digest``.

    ``leads`` are possible bytes before the first chunk, ``end`` those after the last one.
    """
    for body in (_as_stored(data, chunks), _packed_again(chunks)):
        for lead in leads:
            block = lead + body + end
            if hashlib.sha256(block).hexdigest() == digest:
                return block
    return None


def first_difference(data: Buffer, start: int, block: bytes) -> int:
    """Return the offset of the first byte that differs."""
    is_now = np.frombuffer(data[start : start + len(block)], np.uint8)
    was = np.frombuffer(block, np.uint8)[: len(is_now)]
    different = np.flatnonzero(is_now != was)
    return start + (int(different[0]) if len(different) else len(was))


def _as_stored(data: Buffer, chunks: Sequence[Chunk]) -> bytes:
    """Keep the compressed bytes as they are."""
    parts = []
    for chunk in chunks:
        head = mcap.parse_chunk_head(data, chunk.offset)
        assert head is not None  # the chunk was opened by it
        packed = bytes(data[head.data_offset : head.data_offset + head.data_length])
        parts.append(_framed(chunk, packed))
    return b"".join(parts)


def _packed_again(chunks: Sequence[Chunk]) -> bytes:
    """Return the chunks compressed again: a flipped bit may leave the content unchanged."""
    zstd = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_content_size=True)
    return b"".join(_framed(c, zstd.compress(c.body) if _is_packed(c) else c.body) for c in chunks)


def _is_packed(chunk: Chunk) -> bool:
    return len(chunk) > 1 or len(chunk.body) <= CHUNK_BYTES


def _framed(chunk: Chunk, packed: bytes) -> bytes:
    """Return one chunk and its indices as the journal's writer frames them."""
    times = int(chunk.log_ns.min()), int(chunk.log_ns.max())
    kind = "zstd" if _is_packed(chunk) else ""
    record = mcap.chunk_record(*times, len(chunk.body), zlib.crc32(chunk.body), kind, packed)
    for channel in np.unique(chunk.channel).tolist():
        rows = chunk.rows_of(channel)
        entries = np.stack([chunk.log_ns[rows], chunk.starts[rows] - mcap.MESSAGE_HEAD], axis=1)
        record += mcap.message_index_record(channel, entries.astype(np.int64).tobytes())
    return record


def undo_one_flipped_bit(content: bytes, holds: Callable[[bytes], bool]) -> bytes | None:
    """Turn each bit of some bytes until they hold; None if more than one bit was flipped."""
    tried = bytearray(content)
    for place in range(len(tried)):
        for bit in range(8):
            tried[place] ^= 1 << bit
            if holds(bytes(tried)):
                return bytes(tried)
            tried[place] ^= 1 << bit
    return None


_DATA_END = mcap.record(mcap.DATA_END, bytes(4))
_PROFILES = ("", "ros1", "ros2")


@dataclass(frozen=True, slots=True)
class JournalIdentity:
    """The expected start of a journal file; ``chains`` are the links it may continue from."""

    store_id: str
    writer: str
    run: int
    number: int
    chains: Sequence[str]

    @property
    def tag(self) -> str:
        """Return the tag in each chunk of the file."""
        values = {"store_id": self.store_id, "writer": self.writer, "run": str(self.run)}
        return run_tag(values)


@dataclass(frozen=True, slots=True)
class HashedBlock:
    """A stretch of a file whose SHA-256 should be ``digest``.

    ``before`` is the link at its start, None at the start of the file. ``tail``: the stretch is the
    end of the file, index included.
    """

    start: int
    end: int
    digest: str
    before: ChainLink | None
    tail: bool = False


@dataclass(frozen=True, slots=True)
class _Seen:
    """The result of a walk over a block."""

    chunks: Sequence[Chunk]
    damage: Sequence[JournalDamage]
    start: MetadataRecord | None


def finding_of_block(
    data: Buffer, places: ChunkLocator, identity: JournalIdentity, block: HashedBlock
) -> VerifyFinding:
    """Return the finding on a block whose hash is wrong."""
    seen = _look(data, identity, block)
    whole = _mend(data, identity, block, seen)
    if whole is not None:
        at = first_difference(data, block.start, whole)
        text = "bytes around the messages are damaged; the messages themselves are proven"
        # Return the chunk that a byte belongs to, its indices included.
        before = [chunk.offset for chunk in seen.chunks if chunk.offset <= at]
        return places.finding("damaged", text, at, at + 1, (before[-1] if before else None))
    if seen.damage and (block.tail or block.before is None or _lost(seen)):
        return _damaged(places, seen)
    return _altered(places, block, seen)


def _look(data: Buffer, identity: JournalIdentity, block: HashedBlock) -> _Seen:
    """Walk the chunks of a block."""
    walk = JournalWalk(data[: block.end], at=block.start, tag=identity.tag, trusted=block.start)
    found = list(walk)
    start = next(
        (f for f in found if isinstance(f, MetadataRecord) and f.name == START_METADATA), None
    )
    chunks = sorted((f for f in found if isinstance(f, Chunk)), key=lambda chunk: chunk.offset)
    return _Seen(chunks, [f for f in found if isinstance(f, JournalDamage)], start)


def _mend(data: Buffer, identity: JournalIdentity, block: HashedBlock, seen: _Seen) -> bytes | None:
    """Return the block rebuilt from the data that its checksums cover."""
    if block.before is None:
        leads = list(_file_starts(identity, seen))
    else:
        leads = list(_link_records(block.before, seen))
    ends = [b""]
    if block.tail:
        ends = list(_file_ends(data, seen, leads, block))
    for end in ends:
        whole = rebuilt_block(data, leads, seen.chunks, end, block.digest)
        if whole is not None:
            return whole
    return None


def _file_ends(
    data: Buffer, seen: _Seen, leads: Sequence[bytes], block: HashedBlock
) -> Iterator[bytes]:
    """Yield possible ends of a file after its last chunk: the present bytes, or an index after a
    mark.
    """
    for lead in leads[:1]:
        at = seen.chunks[-1].end if seen.chunks else block.start + len(lead)
        rest = bytes(data[at : block.end])
        yield rest
        yield _DATA_END + rest[len(_DATA_END) :]


def _file_starts(identity: JournalIdentity, seen: _Seen) -> Iterator[bytes]:
    """Yield possible bytes before the first chunk of a file."""
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
    """Read the boot from the record of the run, which a checksum covers."""
    for chunk in seen.chunks[:1]:
        for number in (n for n, c in chunk.channels.items() if c.topic == channels.RUN):
            for message in chunk.messages(chunk.rows_of(number)):
                yield str(msgspec.json.decode(message).get("boot_id", ""))


def _link_records(before: ChainLink, seen: _Seen) -> Iterator[bytes]:
    """Yield the record of a link as it may have been written."""
    values = link_values(before)
    yield mcap.metadata_record(CHAIN_METADATA, values)
    if seen.chunks:
        low = int(seen.chunks[0].sequence[0])
        next_seq = before.next_seq + ((low - before.next_seq) & 0xFFFFFFFF)
        for number in (low, next_seq):
            yield mcap.metadata_record(CHAIN_METADATA, {**values, "next_seq": str(number)})


def _lost(seen: _Seen) -> bool:
    """Return whether messages are missing between the chunks, before or after them."""
    if not seen.chunks or any(_holds_chunk(damage) for damage in seen.damage):
        return True
    numbers = np.concatenate([chunk.sequence.astype(np.int64) for chunk in seen.chunks])
    return bool((np.diff(numbers) & 0xFFFFFFFF != 1).any())


def _holds_chunk(damage: JournalDamage) -> bool:
    return damage.reason not in ("message index is damaged", "metadata record is damaged")


def _damaged(places: ChunkLocator, seen: _Seen) -> VerifyFinding:
    first, last = seen.damage[0], seen.damage[-1]
    text = f"{first.reason}: the disk or a copy did this"
    if len(seen.damage) > 1:
        text += f" ({len(seen.damage)} places)"
    return places.finding("damaged", text, first.from_offset, last.to_offset, first.from_offset)


def _altered(places: ChunkLocator, block: HashedBlock, seen: _Seen) -> VerifyFinding:
    text = "all checksums hold, but the hash chain does not: the content was changed"
    if len(seen.chunks) > 1:
        text += f" in one or more of {len(seen.chunks)} chunks"
    first = seen.chunks[0].offset if seen.chunks else None
    return places.finding("altered", text, block.start, block.end, first)


def count_messages(data: Buffer, identity: JournalIdentity, start: int, end: int) -> int:
    """Count the messages of the sound chunks in a stretch of a file."""
    walk = JournalWalk(data[:end], at=start, tag=identity.tag, trusted=start)
    return sum(len(found) for found in walk if isinstance(found, Chunk))


def digest(data: Buffer, start: int, end: int) -> str:
    """Return the SHA-256 of some bytes of a file."""
    return hashlib.sha256(data[start:end]).hexdigest()


@dataclass(frozen=True, slots=True)
class CheckTarget:
    """A journal file to check, and the facts about it from the manifest and other files.

    ``live``: it may still be written to.
    """

    name: str
    path: Path
    identity: JournalIdentity
    live: bool = False
    sealed: SealedJournal | None = None


@dataclass(slots=True)
class CheckedJournal:
    """The result of checking a file: how far its chain reaches, and the findings.

    ``loose_from`` is the first byte that no link covers, ``torn`` the number of bytes of an
    incomplete record at the end, ``tail`` the SHA-256 from the ``last`` link to the end. ``noted``
    are the links that were searched for.
    """

    target: CheckTarget
    size: int = 0
    start_chain: str = ""
    last: ChainLink | None = None
    noted: Sequence[ChainLink] = ()
    loose_from: int = 0
    torn: int = 0
    tail: str = ""
    finished: bool = False
    findings: list[VerifyFinding] = field(default_factory=list)

    @property
    def places(self) -> ChunkLocator:
        """Return the places of the file's chunks, with their times of receipt."""
        return ChunkLocator(self.target.path, self.target.name)

    @property
    def tail_from(self) -> int:
        """Return the offset of the last link: bytes after it are covered by the seal only."""
        return self.last.to if self.last is not None else 0

    @property
    def chain(self) -> str:
        """Return the last link; without one, the link that the file began with."""
        return self.last.chain if self.last is not None else self.start_chain


def check_journal(target: CheckTarget, noted: tuple[str, ...] = ()) -> CheckedJournal:
    """Hash a journal file and compare it with its chain, and with its seal.

    ``noted`` are beginnings of links to search for.
    """
    with open_buffer(target.path) as data:
        checking = _Checking(target, data, noted)
        checking.run()
        return checking.checked


class _Checking:
    """One pass over a file: ``chain`` and ``at`` are how far it has been proven."""

    def __init__(self, target: CheckTarget, data: Buffer, noted: tuple[str, ...]) -> None:
        self.target = target
        self.noted = noted
        self.data = data
        self.places = ChunkLocator(target.path, target.name)
        self.start = dict(start_record(target.path))
        self.chain = self.start.get("chain", "")
        self.checked = CheckedJournal(target, len(data), self.chain)
        self.at = 0
        self.before: ChainLink | None = None

    def run(self) -> None:
        """Check the file from its start to its end."""
        self._size()
        found, known = self._links(), len(self.checked.findings)
        for number, link in enumerate(found):
            if link.start >= self.at:
                self._link(link, found[number + 1] if number + 1 < len(found) else None)
            if number == 0 and len(self.checked.findings) == known:
                other = self._other()
                if other is not None:
                    self.checked.findings = [other]
                    return
        self.checked.last, self.checked.loose_from = found[-1] if found else None, self.at
        self.checked.noted = [link for link in found if link.chain.startswith(self.noted)]
        self.checked.tail = digest(self.data, self.checked.tail_from, len(self.data))
        self._end()

    def _add(
        self, state: FindingState, text: str, start: int, end: int, chunk: int | None = None
    ) -> None:
        self.checked.findings.append(self.places.finding(state, text, start, end, chunk))

    def _size(self) -> None:
        """Compare the length with the sealed one; bytes added later are not checked."""
        sealed = self.target.sealed
        if sealed is None or len(self.data) == sealed.bytes:
            return
        size = len(self.data)
        if size > sealed.bytes:
            text = f"{size - sealed.bytes} bytes were added behind the end"
            self._add("altered", text, sealed.bytes, size)
            self.data = self.data[: sealed.bytes]

    def _links(self) -> list[ChainLink]:
        """Return the links; the last one is known from the manifest even where it is damaged."""
        found = links(self.data)
        sealed = self.target.sealed
        if sealed is None or not sealed.chain or len(self.data) < sealed.bytes:
            return found
        if not sealed.tail_from or (found and found[-1].to >= sealed.tail_from):
            return found
        start = found[-1].to if found else 0
        link = ChainLink(
            start, sealed.tail_from, "", sealed.chain, sealed.end_seq, sealed.tail_from
        )
        return [*found, link]

    def _link(self, link: ChainLink, after: ChainLink | None) -> None:
        """Check the bytes that a link covers, and that it follows from the one before."""
        if link.start > self.at:
            self._lost_link(link)
        here = digest(self.data, self.at, link.to)
        chain = self._chain_after(here)
        if here != link.block or chain != link.chain:
            self._mismatch(link, after, here, chain)
        self.chain, self.at = link.chain, link.to
        if self.before is None or self.before.to != link.to:
            self.before = link

    def _chain_after(self, block: str) -> str:
        try:
            return next_chain_hash(self.chain, block)
        except ValueError:
            return ""

    def _lost_link(self, link: ChainLink) -> None:
        """Skip an unreadable link: its content follows from the bytes before it."""
        here = digest(self.data, self.at, link.start)
        chain = self._chain_after(here)
        self.before = ChainLink(self.at, link.start, here, chain, link.next_seq, link.start)
        self.chain, self.at = chain, link.start

    def _mismatch(self, link: ChainLink, after: ChainLink | None, here: str, chain: str) -> None:
        text = "a link of the chain is damaged; the bytes before it are proven"
        if chain == link.chain:
            self.before = ChainLink(self.at, link.to, here, chain, link.next_seq, link.end)
            if link.block:  # else only the manifest has this link, and its end is checked
                self._add("damaged", text, link.to, link.end, link.to)
        elif here == link.block and self._confirmed_later(chain, link, after):
            self._add("damaged", text, link.to, link.end, link.to)
            self.before = ChainLink(self.at, link.to, here, chain, link.next_seq, link.end)
        elif here == link.block:
            text = "a link does not follow from those before it: the chain was made anew"
            self._add("altered", text, self.at, link.to)
        else:
            self._judge(HashedBlock(self.at, link.to, link.block, self.before))

    def _confirmed_later(self, chain: str, link: ChainLink, after: ChainLink | None) -> bool:
        """Return whether a later link confirms the chain as it should be here."""
        sealed = self.target.sealed
        if after is not None and after.start == link.to:
            return next_chain_hash(chain, after.block) == after.chain
        return sealed is not None and sealed.chain == chain

    def _judge(self, block: HashedBlock) -> None:
        found = finding_of_block(self.data, self.places, self.target.identity, block)
        self.checked.findings.append(found)

    def _other(self) -> VerifyFinding | None:
        """Return a finding if a sound file is another than its name states."""
        wanted, start = self.target.identity, self.start
        stated = (start.get("run"), start.get("file"), start.get("writer"))
        if not start or "store_id" not in start:
            return None
        if start["store_id"] != wanted.store_id:
            text = f"belongs to another store ({start['store_id']})"
            return self.places.finding("altered", text, 0, len(self.data))
        if stated != (str(wanted.run), str(wanted.number), wanted.writer):
            text = f"is not there: under its name lies file {stated[1]} of run {stated[0]}"
            return self.places.finding("missing", f"{text} of {stated[2]}", 0, len(self.data))
        return None

    def _end(self) -> None:
        """Check the bytes after the last link."""
        sealed, moved = self.target.sealed, displaced_link(self.data, self.at)
        if moved is not None:
            self.checked.findings.append(self._moved(*moved))
        elif sealed is None:
            self._open_end()
        elif len(self.data) < sealed.bytes:
            self._cut(sealed)
        elif sealed.chain and self.checked.chain != sealed.chain:
            self._rewritten(sealed)
        elif self.checked.tail != sealed.tail:
            self._judge(
                HashedBlock(sealed.tail_from, sealed.bytes, sealed.tail, self.before, tail=True)
            )

    def _moved(self, offset: int, stated: int) -> VerifyFinding:
        """Return the finding on a link that is not at its place: what happened before it."""
        first = self.before.next_seq if self.before is not None else self._first_seq()
        link = metadata_at(self.data, offset)
        next_seq = int(link.values.get("next_seq", 0)) if link is not None else 0
        if next_seq - first > count_messages(self.data, self.target.identity, self.at, offset):
            text = f"messages between positions {first} and {next_seq} were taken out"
            return self.places.finding("missing", text, self.at, offset)
        text = f"the content was changed: it is {abs(offset - stated)} bytes "
        text += "longer" if offset > stated else "shorter"
        return self.places.finding("altered", text, self.at, offset)

    def _first_seq(self) -> int:
        first = self.start.get("first_seq", "0")
        return int(first) if first.isdecimal() else 0

    def _cut(self, sealed: SealedJournal) -> None:
        size = len(self.data)
        text = f"the last {sealed.bytes - size} of {sealed.bytes} bytes were cut off"
        end_ns = self.places.end_ns(size)
        start_ns = sealed.start_ns if end_ns is None else end_ns
        self.checked.findings.append(
            VerifyFinding("missing", self.target.name, text, None, size, sealed.bytes, start_ns,
                    sealed.end_ns)
        )  # fmt: skip

    def _rewritten(self, sealed: SealedJournal) -> None:
        if any(finding.state == "altered" for finding in self.checked.findings):
            return
        text = "the file is sound in itself, but not the one that was sealed: it was written anew"
        self.checked.findings.append(
            VerifyFinding("altered", self.target.name, text, None, 0, sealed.bytes, sealed.start_ns,
                    sealed.end_ns)
        )  # fmt: skip

    def _open_end(self) -> None:
        """Check the end of a file that is not sealed, by its checksums only."""
        self.checked.finished = self.before is not None and self._is_finished()
        if self.checked.finished:
            return
        walk = JournalWalk(self.data, at=self.at, tag=self.target.identity.tag, trusted=self.at)
        for found in walk:
            if isinstance(found, JournalDamage):
                self._open_damage(found)

    def _open_damage(self, found: JournalDamage) -> None:
        torn = found.to_offset == len(self.data) and found.reason != "summary is damaged"
        if torn:
            self.checked.torn = found.to_offset - found.from_offset
        elif not self.target.live:
            start, end = found.from_offset, found.to_offset
            self._add("damaged", found.reason, start, end, start)

    def _is_finished(self) -> bool:
        """Return whether the file has its final records; check their bytes, which no checksum
        covers.
        """
        link, data = self.before, self.data
        summary = read_summary(data)
        if summary is None or link is None:
            return False
        end = link.end
        first = self._first_seq()
        if bytes(data[end : end + len(_DATA_END)]) != _DATA_END:
            text = "the mark at the end of the data is damaged; the messages are proven"
            self._add("damaged", text, end, end + len(_DATA_END), end)
        elif self.start and first + summary.counts.total() != link.next_seq:
            text = "the last link of the chain is damaged; the messages are proven"
            self._add("damaged", text, link.to, link.end, link.to)
        return True


_FOLDER_OF = {folder: writer for writer, folder in FOLDERS.items()}
FIRST_CHAIN = "0" * 64


def check_target(
    store: Store,
    path: Path,
    *,
    sealed: SealedJournal | None = None,
    before: str = "",
    live: bool = False,
    store_id: str = "",
) -> CheckTarget:
    """Return the target of a journal file; ``before`` is the last link of the file before it."""
    run, number = run_and_number(path)
    stated = (sealed.start_chain,) if sealed is not None else ()
    chains = tuple(chain for chain in (*stated, before, FIRST_CHAIN) if chain)
    writer = _FOLDER_OF[path.parent.name]
    identity = JournalIdentity(store_id or store.id, writer, run, number, chains)
    return CheckTarget(f"{path.parent.name}/{path.name}", path, identity, live, sealed)
