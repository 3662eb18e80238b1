"""The links of a journal file's hash chain, found without reading what lies between them."""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.buffer import Buffer
from amberbox.blackbox.journal.mcap import CHAIN_METADATA
from amberbox.blackbox.journal.summary import FOOTER_SIZE
from amberbox.blackbox.journal.walk import Metadata, metadata_at

_LINK = re.compile(rb"\x0c.{8}\x0e\0\0\0" + CHAIN_METADATA.encode(), re.DOTALL)


@dataclass(frozen=True, slots=True)
class Link:
    """One link: it stands at ``to`` and speaks for the bytes from ``start`` to there."""

    start: int
    to: int
    block: str
    chain: str
    next_seq: int
    end: int


def joined(chain: str, block: str) -> str:
    """Compute a link from the one before and the SHA-256 of the bytes in between."""
    return hashlib.sha256(bytes.fromhex(chain + block)).hexdigest()


def link_values(link: Link) -> dict[str, str]:
    """Return what stands in the record of a link, in the order in which it is written."""
    return {
        "from": str(link.start),
        "to": str(link.to),
        "block": link.block,
        "chain": link.chain,
        "next_seq": str(link.next_seq),
    }


def links(data: Buffer) -> list[Link]:
    """Find the links of a file: by the index at its end, else by looking at all bytes."""
    indexed = [link for at in _indexed(data) if (link := link_at(data, at)) is not None]
    if indexed and _tile(indexed) and _may_be_last(data, indexed[-1]):
        return indexed
    return [link for m in _LINK.finditer(data) if (link := link_at(data, m.start())) is not None]


def _tile(found: list[Link]) -> bool:
    """Tell whether each link begins where the one before ended."""
    starts = [0, *(link.to for link in found[:-1])]
    return all(link.start == start for link, start in zip(found, starts, strict=True))


def _may_be_last(data: Buffer, link: Link) -> bool:
    """Tell whether the end of the file follows a link, as its writer leaves it."""
    return link.end < len(data) and data[link.end] == mcap.DATA_END


def link_at(data: Buffer, offset: int) -> Link | None:
    """Read the link that stands at an offset and says so; None if there is none."""
    found = metadata_at(data, offset)
    if found is None or found.name != CHAIN_METADATA:
        return None
    return _link(found, found.values)


def _link(found: Metadata, values: Mapping[str, str]) -> Link | None:
    try:
        link = Link(
            int(values["from"]), int(values["to"]), values["block"], values["chain"],
            int(values["next_seq"]), found.end,
        )  # fmt: skip
        whole = len(bytes.fromhex(link.block)) == len(bytes.fromhex(link.chain)) == 32
    except (KeyError, ValueError):
        return None
    return link if whole and 0 <= link.start < link.to == found.offset else None


def _indexed(data: Buffer) -> Iterator[int]:
    """Give the places of all links that the end of a finished file names."""
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


def displaced(data: Buffer, after: int) -> tuple[int, int] | None:
    """Find the first link behind ``after`` that does not stand where it says: (offset, said)."""
    for match in _LINK.finditer(data, after):
        found = metadata_at(data, match.start())
        said = found.values.get("to", "") if found is not None else ""
        if said.isdecimal() and int(said) != match.start():
            return match.start(), int(said)
    return None
