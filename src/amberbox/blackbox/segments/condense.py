"""Keep the manifest small over months: write anew only what still counts, on the same chain."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from amberbox.blackbox.journal.clocktable import simplified
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import (
    Tombstone,
    confirmed_record,
    to_record,
    unconfirmed_record,
)
from amberbox.blackbox.segments.lines import CHECKPOINT, encode
from amberbox.blackbox.segments.manifest import Manifest, Part, Segment

LARGE_BYTES = 4_000_000
_WORTH = 3

Record = Mapping[str, Any]
SignHead = Callable[[str], Record | None]
"""Makes the line that signs a head, None where there is no key."""


def condense(
    store: Path, exists: Callable[[str], bool], sign: SignHead, large_bytes: int = LARGE_BYTES
) -> bool:
    """Write a large manifest anew if that makes it a third or less; tell whether it was done.

    ``exists`` tells which journals are still there. The first line is a checkpoint that goes on
    from the old one's last hash, the second the signature of that hash.
    """
    path = store / mf.NAME
    size = path.stat().st_size if path.exists() else 0
    if size <= large_bytes:
        return False
    with mf.CHANGING:
        return _condense(store, exists, sign, size)


def _condense(store: Path, exists: Callable[[str], bool], sign: SignHead, size: int) -> bool:
    known = mf.read(store)
    if known.lines < _WORTH * _live_lines(known):
        return False
    records = [*_beginning(known, exists, sign), *live_records(known, exists)]
    if _WORTH * len(encode(records, known.last_hash)) > size:
        return False
    mf.replace(store, records, known.last_hash)
    return True


def _live_lines(known: Manifest) -> int:
    """Count about how many lines would be left; cheap, for it is asked often."""
    segments = sum(map(len, known.segments.values()))
    others = (known.journals, known.sealed, known.schemas, known.incidents)
    return segments + sum(map(len, others))


def _beginning(known: Manifest, exists: Callable[[str], bool], sign: SignHead) -> Iterator[Record]:
    found = known.segments.values()
    named = {part.journal for segments in found for s in segments for part in s.parts}
    still = sorted(n for n in known.columns_gone if n in named or exists(n))
    yield {"kind": CHECKPOINT, "columns_gone": still, "damage": list(known.damage)}
    signature = sign(known.last_hash)
    if signature is not None:
        yield signature


def live_records(known: Manifest, exists: Callable[[str], bool]) -> Iterator[Record]:
    """Give the records that say the same as all of a manifest's lines do."""
    listed = [segment for found in known.segments.values() for segment in found]
    segments = [*listed, *known.lost]
    used = {segment.schema for segment in segments}
    for name, schema in known.schemas.items():
        if name in used:
            yield mf.schema_record(schema)
    for segment in segments:
        yield mf.segment_record(_coalesced(segment, known, exists))
    yield from kept_records(known, exists)


def kept_records(known: Manifest, exists: Callable[[str], bool]) -> Iterator[Record]:
    """Give what is said of journals and incidents: done, sealed, deleted, confirmed, signed."""
    alive = {name for name in known.sealed if exists(name) or name not in known.columns_gone}
    for sealed in known.sealed.values():
        if sealed.journal in alive:
            yield to_record(sealed)
    if known.names:
        yield mf.names_record(known.names)
    for journal in known.journals.values():
        yield mf.journal_record(journal)
    for tombstone in joined(known.tombstones):
        yield to_record(tombstone)
    yield from known.incidents.values()
    confirmed = tuple(sorted(n for n in known.confirmed if exists(n) or n in known.journals))
    if confirmed:
        yield confirmed_record(confirmed, "", 0)
    unconfirmed = tuple(sorted(filter(exists, known.unconfirmed)))
    if unconfirmed:
        yield unconfirmed_record(unconfirmed, "", 0)
    for signature in known.signatures[-1:]:
        yield to_record(signature)


def joined(tombstones: Iterable[Tombstone]) -> list[Tombstone]:
    """Join the tombstones of neighbouring journals that went for the same reason."""
    found: list[Tombstone] = []
    for tombstone in sorted(tombstones, key=_order):
        if found and _neighbours(found[-1], tombstone):
            found[-1] = _join(found[-1], tombstone)
        else:
            found.append(tombstone)
    return found


def _order(tombstone: Tombstone) -> tuple[Any, ...]:
    return (*_kind(tombstone), tombstone.first_seq, tombstone.end_seq)


def _kind(tombstone: Tombstone) -> tuple[Any, ...]:
    t = tombstone
    return t.writer, t.run, t.what, t.reason, t.confirmed


def _neighbours(first: Tombstone, second: Tombstone) -> bool:
    return _kind(first) == _kind(second) and first.end_seq == second.first_seq


def _join(first: Tombstone, second: Tombstone) -> Tombstone:
    names = (*first.journals, *second.journals)
    return replace(
        second,
        journals=(names[0], names[-1]),
        first_seq=first.first_seq,
        start_ns=min(first.start_ns, second.start_ns),
        end_ns=max(first.end_ns, second.end_ns),
        at_ns=max(first.at_ns, second.at_ns),
    )


def _coalesced(segment: Segment, known: Manifest, exists: Callable[[str], bool]) -> Segment:
    """Take parts of journals that are gone for one part, called like the last of them."""
    parts: list[Part] = []
    for part in segment.parts:
        gone = part.journal in known.columns_gone and not exists(part.journal)
        if gone and parts and _may_join(parts[-1], part, known, exists):
            parts[-1] = _joined_part(parts[-1], part)
        else:
            parts.append(part)
    return replace(segment, parts=tuple(parts))


def _may_join(first: Part, second: Part, known: Manifest, exists: Callable[[str], bool]) -> bool:
    gone = first.journal in known.columns_gone and not exists(first.journal)
    ordered = first.to_ns <= second.from_ns and first.last_seq < second.first_seq
    return gone and ordered and (first.writer, first.run) == (second.writer, second.run)


def _joined_part(first: Part, second: Part) -> Part:
    points = sorted({*mf.part_clock(first), *mf.part_clock(second)})
    return replace(
        second,
        first_seq=first.first_seq,
        rows=first.rows + second.rows,
        from_ns=first.from_ns,
        stamp_from_ns=min(first.stamp_from_ns, second.stamp_from_ns),
        stamp_to_ns=max(first.stamp_to_ns, second.stamp_to_ns),
        files=1,
        bytes=first.bytes + second.bytes,
        clock=simplified(points),
    )


def no_signature(_head: str) -> None:
    """Stand in where there is no key."""
