"""Make up for lines of the manifest that cannot be read, from segments' own metadata and journals.

A reader does so in memory and writes nothing; the keeper writes it down (``restore``).
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from amberbox.blackbox.segments import lines
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.blackbox.segments.manifest import Journal, Manifest, Part, Restored, Segment
from amberbox.core.files import sync_folder

FOLDER = "segments"
_MOST_TOLD = 5

Described = tuple[TableSchema, Segment]
Key = tuple[str, str, str]
"""Names rows of a segment: those of one table, version and journal."""


def restored(store: Path, known: Manifest) -> Manifest:
    """Return a manifest with what its damaged lines said, as far as that can be found out."""
    return known if _is_whole(store, known) else _find(store, known).manifest


def restore(store: Path) -> list[str]:
    """Mend the manifest on the disk; return what was wrong with it. Only the keeper calls this.

    A line of which one bit is flipped becomes what it was. Lines that cannot be read stay where
    they are, and what they said follows at the end. Raises OSError when the disk does not take it.
    """
    with mf.CHANGING:
        told = _mend(store)
        known = mf.read_lines(store)
        gone = _missing(store, known)
        if _is_whole(store, known) and not gone:
            return told
        found = _find(store, known)
        made_up = Restored(_damage(known), tuple(found.undone), tuple(found.replaced))
        records = [mf.restored_record(made_up), *found.records()]
        if made_up != Restored() or len(records) > 1:
            mf.append(store, records)
        missing = [f"{segment.path} is gone or was cut" for segment in gone]
        unlisted = [
            f"no line told of {segment.path}"
            for segment in found.adopted
            if segment not in found.manifest.lost
        ]
        return [*told, *_damage(known), *missing, *unlisted]


def notes(store: Path) -> list[str]:
    """Say what is damaged in a store's manifest and what that costs who reads it."""
    known = mf.read(store)
    unlisted = _paths(known) - _paths(mf.read_lines(store))
    found = [*known.mended, *known.open_damage]
    if not (found or unlisted or known.lost):
        return []
    what = in_short(found) or f"{len(unlisted)} segments are in none of its lines"
    text = f"{mf.NAME} is damaged ({what}): segments and journals make up for it"
    lost = [f"{len(known.lost)} segments that it lists cannot be used"] if known.lost else []
    return [text, *lost]


def _paths(known: Manifest) -> set[str]:
    return {segment.path for found in known.segments.values() for segment in found}


def in_short(told: Sequence[str]) -> str:
    """Join what is to be said in one line; of very many the first ones."""
    more = len(told) - _MOST_TOLD
    return "; ".join(told[:_MOST_TOLD]) + (f"; and {more} more" if more > 0 else "")


def _damage(known: Manifest) -> tuple[str, ...]:
    """Name the damaged lines; of an empty manifest all are."""
    return known.open_damage or (() if known.lines else (f"{mf.NAME}: there is none",))


def _is_whole(store: Path, known: Manifest) -> bool:
    """Tell whether every line can be read, has its schema, and every file on the disk its line."""
    used = {segment.schema for found in known.segments.values() for segment in found}
    if known.open_damage or not used <= known.schemas.keys():
        return False
    told = _paths(known) | known.gone_segments
    return all(path in told for path in _files(store))


def _files(store: Path) -> Iterator[str]:
    """Name the segments on the disk; there may be tens of thousands."""
    try:
        folders = [entry.name for entry in os.scandir(store / FOLDER) if entry.is_dir()]
    except OSError:
        return
    for folder in folders:
        with suppress(OSError):  # its last segment was deleted meanwhile
            for entry in os.scandir(store / FOLDER / folder):
                if entry.name.endswith(".parquet"):
                    yield f"{FOLDER}/{folder}/{entry.name}"


def _mend(store: Path) -> list[str]:
    """Put right the lines of which one bit is flipped; return what was done."""
    if not mf.read_lines(store).mended:
        return []
    path, temporary = store / mf.NAME, store / f".{mf.NAME}.tmp"
    content = bytearray(path.read_bytes())
    told = []
    for line in reversed(list(lines.split(bytes(content)))):
        if line.mended:
            end = line.offset + line.size - 1
            content[line.offset : end] = line.mended
            told.append(f"{mf.NAME} line {line.number}: one bit was flipped")
    temporary.unlink(missing_ok=True)
    lines.append_durably(temporary, bytes(content))
    temporary.rename(path)
    sync_folder(store)
    return told[::-1]


@dataclass(frozen=True, slots=True)
class _Found:
    """What was found out: the manifest as it should be, and how it differs from its lines.

    ``undone`` are journals to be looked through again, ``replaced`` segments that are listed and
    not needed.
    """

    manifest: Manifest
    schemas: Sequence[TableSchema]
    adopted: Sequence[Segment]
    journals: Sequence[Journal]
    undone: Sequence[str]
    replaced: Sequence[str]

    def records(self) -> Iterator[Mapping[str, Any]]:
        """Give the lines that say again what was lost."""
        yield from (mf.schema_record(schema) for schema in self.schemas)
        yield from (mf.segment_record(segment) for segment in self.adopted)
        yield from (mf.journal_record(journal) for journal in self.journals)


def _find(store: Path, known: Manifest) -> _Found:
    """Compare the lines with the files; nothing is adopted that a journal can still tell."""
    segments = {s.path: s for found in known.segments.values() for s in found}
    schemas = dict(known.schemas)
    live = [s for s in segments.values() if _is_there(store, s, schemas)]
    adopted = _adopted(store, known, live, schemas)
    rows_of = {*_keys(live), *_keys(adopted)}
    usable = {segment.path for segment in live}
    absent = [s for path, s in segments.items() if path not in usable]
    needed = [lost for s in absent if (lost := _lost(store, s, rows_of)) is not None]
    kept = [*live, *adopted]
    here = {name for name in known.journals if (store / name).exists()}
    if _damage(known):  # of a journal that left only events and the like, the tombstone is lost
        data = [s for s in (*kept, *needed) if s.schema in schemas]
        data = [s for s in data if not mf.is_kept(schemas[s.schema])]
        undone = sorted(here | (known.journals.keys() - _journals(data)))
    else:
        undone = sorted(here & _journals(absent))
    journals = {n: j for n, j in known.journals.items() if n not in undone}
    said = {*journals, *known.columns_gone, *_journals(needed), *undone}
    more = [
        journal
        for journal in journals_of(kept, known)
        if journal.name not in said and not (store / journal.name).exists()
    ]
    journals |= {journal.name: journal for journal in more}
    manifest = replace(
        known, schemas=schemas, segments=mf.by_item(kept), journals=journals, lost=tuple(needed)
    )
    new = [schema for name, schema in schemas.items() if name not in known.schemas]
    still = {segment.path for segment in needed}
    trimmed = [s for s in needed if s != segments[s.path]]
    replaced = sorted(s.path for s in absent if s.path not in still)
    return _Found(manifest, new, [*adopted, *trimmed], more, undone, replaced)


def _missing(store: Path, known: Manifest) -> list[Segment]:
    """List the segments whose file is gone or was cut although a journal could still tell."""
    listed = (s for segments in known.segments.values() for s in segments)
    return [
        s for s in listed
        if not has_size(store, s) and any((store / part.journal).exists() for part in s.parts)
    ]  # fmt: skip


def _lost(store: Path, segment: Segment, rows_of: Collection[Key]) -> Segment | None:
    """Return what a segment held that no journal and no other segment holds; None if nothing."""
    parts = tuple(
        part
        for part in segment.parts
        if (segment.item, segment.schema, part.journal) not in rows_of
        and not (store / part.journal).exists()
    )
    return replace(segment, parts=parts) if parts else None


def has_size(store: Path, segment: Segment) -> bool:
    """Tell whether a segment's file is there with as many bytes as were written."""
    try:
        return (store / segment.path).stat().st_size == segment.bytes
    except OSError:
        return False


def _has_raw(store: Path, segment: Segment) -> bool:
    """Tell whether all journals of a segment are still there."""
    return all((store / part.journal).exists() for part in segment.parts)


def _is_there(store: Path, segment: Segment, schemas: dict[str, TableSchema]) -> bool:
    """Tell whether a listed segment can be used; a schema whose line was lost is added."""
    if not has_size(store, segment):
        return False
    if segment.schema not in schemas:
        described = _described(store, segment.path)
        if described is None or described[0].id != segment.schema:
            return False
        schemas[segment.schema] = described[0]
    return True


def _described(store: Path, path: str) -> Described | None:
    """Read a segment's own metadata, and all of its pages; None if that cannot be done here."""
    if importlib.util.find_spec("pyarrow") is None:
        return None
    from amberbox.blackbox.segments.parquet import outline, read_segment

    try:
        schema, segment = outline(store, path)
        read_segment(store, segment, schema, [column.name for column in schema.columns])
        with (store / path).open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    except mf.UNREADABLE:
        return None
    return schema, replace(segment, sha256=sha256)


def _adopted(
    store: Path,
    known: Manifest,
    live: Sequence[Segment],
    schemas: dict[str, TableSchema],
) -> list[Segment]:
    """Take over segments that no line lists and whose rows are nowhere else; add their schemas."""
    listed = {segment.path for segment in live} | known.gone_segments
    paths = [path for path in _files(store) if path not in listed]
    found = [_described(store, path) for path in sorted(paths)]
    taken = set(_keys(live))
    adopted = []
    for schema, segment in sorted((d for d in found if d), key=lambda d: -len(d[1].parts)):
        over = _journals([segment]) <= known.columns_gone and not mf.is_kept(schema)
        if over or _has_raw(store, segment) or not taken.isdisjoint(_keys([segment])):
            continue
        taken |= _keys([segment])
        schemas.setdefault(schema.id, schema)
        adopted.append(segment)
    return adopted


def _journals(segments: Iterable[Segment]) -> set[str]:
    return {part.journal for segment in segments for part in segment.parts}


def _keys(segments: Iterable[Segment]) -> set[Key]:
    """Name the rows of segments."""
    return {(s.item, s.schema, part.journal) for s in segments for part in s.parts}


def journals_of(segments: Collection[Segment], known: Manifest) -> list[Journal]:
    """Tell from segments, and from seals, which journals they came from and how far these went."""
    parts: dict[str, list[Part]] = {}
    for part in (part for segment in segments for part in segment.parts):
        parts.setdefault(part.journal, []).append(part)
    return [_journal(name, found, known) for name, found in parts.items()]


def _journal(name: str, parts: Sequence[Part], known: Manifest) -> Journal:
    sealed, part = known.sealed.get(name), parts[0]
    if sealed is not None:
        return Journal(
            name, sealed.chain, sealed.writer, sealed.run, sealed.first_seq, sealed.end_seq,
            sealed.start_ns, sealed.end_ns,
        )  # fmt: skip
    return Journal(
        name, part.head, part.writer, part.run,
        min(part.first_seq for part in parts), 1 + max(part.last_seq for part in parts),
        min(part.from_ns for part in parts), max(part.to_ns for part in parts),
    )  # fmt: skip
