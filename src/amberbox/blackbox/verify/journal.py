"""Check one journal file: its chain, its end, and that it is the file its name says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.buffer import Buffer, open_buffer
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.journal.summary import read_summary
from amberbox.blackbox.journal.walk import Damage, Walk, metadata_at
from amberbox.blackbox.segments.entries import Sealed
from amberbox.blackbox.verify.block import Block, Identity, count_messages, digest, judge
from amberbox.blackbox.verify.findings import Finding
from amberbox.blackbox.verify.links import Link, displaced, joined, links
from amberbox.blackbox.verify.place import Places

_DATA_END = mcap.record(mcap.DATA_END, bytes(4))


@dataclass(frozen=True, slots=True)
class Target:
    """A journal file to check, and what is known of it from elsewhere.

    ``live`` says that it may still be written to.
    """

    name: str
    path: Path
    identity: Identity
    live: bool = False
    sealed: Sealed | None = None


@dataclass(slots=True)
class Checked:
    """What was found in a file: how far its chain goes, and what does not hold.

    ``loose_from`` is the first byte that no link speaks for, ``torn`` how many bytes at the end are
    no whole record, ``tail`` the SHA-256 of what follows the ``last`` link, itself included.
    ``noted`` are the links that somebody has asked for.
    """

    target: Target
    size: int = 0
    start_chain: str = ""
    last: Link | None = None
    noted: Sequence[Link] = ()
    loose_from: int = 0
    torn: int = 0
    tail: str = ""
    finished: bool = False
    findings: list[Finding] = field(default_factory=list)

    @property
    def places(self) -> Places:
        """Where the file's chunks lie and when they were received."""
        return Places(self.target.path, self.target.name)

    @property
    def tail_from(self) -> int:
        """Where the last link stands: what follows is for a seal to vouch for."""
        return self.last.to if self.last is not None else 0

    @property
    def chain(self) -> str:
        """The last link; where there is none, the one that the file began with."""
        return self.last.chain if self.last is not None else self.start_chain


def check_journal(target: Target, noted: tuple[str, ...] = ()) -> Checked:
    """Hash a journal file and compare with its chain, and with what was sealed.

    ``noted`` are beginnings of links that somebody wants to find again.
    """
    with open_buffer(target.path) as data:
        checking = _Checking(target, data, noted)
        checking.run()
        return checking.checked


class _Checking:
    """One pass over a file: ``chain`` and ``at`` say how far it has been proven."""

    def __init__(self, target: Target, data: Buffer, noted: tuple[str, ...]) -> None:
        self.target = target
        self.noted = noted
        self.data = data
        self.places = Places(target.path, target.name)
        self.start = dict(start_record(target.path))
        self.chain = self.start.get("chain", "")
        self.checked = Checked(target, len(data), self.chain)
        self.at = 0
        self.before: Link | None = None

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

    def _tell(self, finding: Finding) -> None:
        self.checked.findings.append(finding)

    def _size(self) -> None:
        """Compare the length with what was sealed; what was added is not looked at."""
        sealed = self.target.sealed
        if sealed is None or len(self.data) == sealed.bytes:
            return
        size, sealed_bytes = len(self.data), sealed.bytes
        if size > sealed_bytes:
            text = f"{size - sealed_bytes} bytes were added behind the end"
            self._tell(self.places.finding("altered", text, sealed_bytes, size))
            self.data = self.data[:sealed_bytes]

    def _links(self) -> list[Link]:
        """List the links; the last one is known from the manifest even where it is damaged."""
        found = links(self.data)
        sealed = self.target.sealed
        if sealed is None or not sealed.chain or len(self.data) < sealed.bytes:
            return found
        if not sealed.tail_from or (found and found[-1].to >= sealed.tail_from):
            return found
        start = found[-1].to if found else 0
        link = Link(start, sealed.tail_from, "", sealed.chain, sealed.end_seq, sealed.tail_from)
        return [*found, link]

    def _link(self, link: Link, after: Link | None) -> None:
        """Check the bytes that a link speaks for, and that it follows from the one before."""
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
            return joined(self.chain, block)
        except ValueError:
            return ""

    def _lost_link(self, link: Link) -> None:
        """Step over a link that cannot be read: what it said follows from the bytes before it."""
        here = digest(self.data, self.at, link.start)
        chain = self._chain_after(here)
        self.before = Link(self.at, link.start, here, chain, link.next_seq, link.start)
        self.chain, self.at = chain, link.start

    def _mismatch(self, link: Link, after: Link | None, here: str, chain: str) -> None:
        text = "a link of the chain is damaged; the bytes before it are proven"
        if chain == link.chain:
            self.before = Link(self.at, link.to, here, chain, link.next_seq, link.end)
            if link.block:  # else only the manifest knows of this link, and its end is judged
                self._tell(self.places.finding("damaged", text, link.to, link.end, link.to))
        elif here == link.block and self._confirmed_later(chain, link, after):
            self._tell(self.places.finding("damaged", text, link.to, link.end, link.to))
            self.before = Link(self.at, link.to, here, chain, link.next_seq, link.end)
        elif here == link.block:
            text = "a link does not follow from those before it: the chain was made anew"
            self._tell(self.places.finding("altered", text, self.at, link.to))
        else:
            self._judge(Block(self.at, link.to, link.block, self.before))

    def _confirmed_later(self, chain: str, link: Link, after: Link | None) -> bool:
        """Tell whether what follows goes on from the chain as it should be here."""
        sealed = self.target.sealed
        if after is not None and after.start == link.to:
            return joined(chain, after.block) == after.chain
        return sealed is not None and sealed.chain == chain

    def _judge(self, block: Block) -> None:
        found = judge(self.data, self.places, self.target.identity, block)
        self._tell(found)

    def _other(self) -> Finding | None:
        """Tell whether a sound file is another than its name says."""
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
        """Check what follows the last link."""
        sealed, moved = self.target.sealed, displaced(self.data, self.at)
        if moved is not None:
            self._tell(self._moved(*moved))
        elif sealed is None:
            self._open_end()
        elif len(self.data) < sealed.bytes:
            self._cut(sealed)
        elif sealed.chain and self.checked.chain != sealed.chain:
            self._rewritten(sealed)
        elif self.checked.tail != sealed.tail:
            self._judge(Block(sealed.tail_from, sealed.bytes, sealed.tail, self.before, tail=True))

    def _moved(self, offset: int, said: int) -> Finding:
        """Say what happened before a link that does not stand where it should."""
        first = self.before.next_seq if self.before is not None else self._first_seq()
        link = metadata_at(self.data, offset)
        next_seq = int(link.values.get("next_seq", 0)) if link is not None else 0
        if next_seq - first > count_messages(self.data, self.target.identity, self.at, offset):
            text = f"messages between positions {first} and {next_seq} were taken out"
            return self.places.finding("missing", text, self.at, offset)
        text = f"the content was changed: it is {abs(offset - said)} bytes "
        text += "longer" if offset > said else "shorter"
        return self.places.finding("altered", text, self.at, offset)

    def _first_seq(self) -> int:
        first = self.start.get("first_seq", "0")
        return int(first) if first.isdecimal() else 0

    def _cut(self, sealed: Sealed) -> None:
        size = len(self.data)
        text = f"the last {sealed.bytes - size} of {sealed.bytes} bytes were cut off"
        end_ns = self.places.end_ns(size)
        start_ns = sealed.start_ns if end_ns is None else end_ns
        self._tell(
            Finding("missing", self.target.name, text, None, size, sealed.bytes, start_ns,
                    sealed.end_ns)
        )  # fmt: skip

    def _rewritten(self, sealed: Sealed) -> None:
        if any(finding.state == "altered" for finding in self.checked.findings):
            return
        text = "the file is sound in itself, but not the one that was sealed: it was written anew"
        self._tell(
            Finding("altered", self.target.name, text, None, 0, sealed.bytes, sealed.start_ns,
                    sealed.end_ns)
        )  # fmt: skip

    def _open_end(self) -> None:
        """Look at the end of a file that is not sealed: only checksums speak for it."""
        self.checked.finished = self.before is not None and self._is_finished()
        if self.checked.finished:
            return
        walk = Walk(self.data, at=self.at, tag=self.target.identity.tag, trusted=self.at)
        for found in walk:
            if isinstance(found, Damage):
                self._open_damage(found)

    def _open_damage(self, found: Damage) -> None:
        torn = found.to_offset == len(self.data) and found.reason != "summary is damaged"
        if torn:
            self.checked.torn = found.to_offset - found.from_offset
        elif not self.target.live:
            self._tell(
                self.places.finding(
                    "damaged", found.reason, found.from_offset, found.to_offset, found.from_offset
                )
            )

    def _is_finished(self) -> bool:
        """Tell whether the file has its end, and check what no checksum covers there."""
        link, data = self.before, self.data
        summary = read_summary(data)
        if summary is None or link is None:
            return False
        end = link.end
        first = self._first_seq()
        if bytes(data[end : end + len(_DATA_END)]) != _DATA_END:
            text = "the mark at the end of the data is damaged; the messages are proven"
            self._tell(self.places.finding("damaged", text, end, end + len(_DATA_END), end))
        elif self.start and first + summary.counts.total() != link.next_seq:
            text = "the last link of the chain is damaged; the messages are proven"
            self._tell(self.places.finding("damaged", text, link.to, link.end, link.to))
        return True
