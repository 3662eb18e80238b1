"""What a sender's JSON Schema says of its values beside their types: units and names of codes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import msgspec

from amberbox.blackbox.unroll.shapes import DEEPEST, escape
from amberbox.core.types import Schema

NOTES = "x-notes"
"""Keyword of schemas in journals: the notes of all paths, also of those that never came."""
UNIT, LABELS = "unit", "labels"
"""Keywords of senders, beside the type of a place."""


@dataclass(frozen=True, slots=True)
class Note:
    """What is known of one place: the unit of its numbers, the names of its whole numbers."""

    unit: str = ""
    labels: Mapping[int, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.unit or self.labels)


Notes: TypeAlias = Mapping[str, Note]
"""By path; a place in a list of structures goes by the path of the list and its own."""


def notes_of(schema: Schema | None) -> Notes:
    """Read what a schema says, a sender's or one of ours; what cannot be understood is nothing."""
    if schema is None or schema.encoding != "jsonschema":
        return {}
    try:
        document = msgspec.json.decode(schema.data)
    except (msgspec.DecodeError, RecursionError):
        return {}
    if not isinstance(document, dict):
        return {}
    kept = document.get(NOTES)
    if isinstance(kept, dict):
        found = ((path, _note(said)) for path, said in kept.items())
    else:
        found = ((path, note) for path, note in _said(document, ""))
    return {path: note for path, note in found if note}


def notes_json(notes: Notes) -> dict[str, Any]:
    """Return notes as a part of a schema's document: nothing where there are none."""
    return {NOTES: {path: _plain(note) for path, note in notes.items()}} if notes else {}


def _said(document: Any, path: str, depth: int = 0) -> Iterator[tuple[str, Note]]:
    """Go down a sender's document, as far as messages are unrolled."""
    if not isinstance(document, dict) or depth > 2 * DEEPEST:  # a list is a step of its own
        return
    yield path or "value", _note(document)
    yield from _said(document.get("items"), path or "value", depth + 1)
    below = document.get("properties")
    for key, inner in below.items() if isinstance(below, dict) else ():
        yield from _said(inner, f"{path}/{escape(key)}" if path else escape(key), depth + 1)


def _note(said: Any) -> Note:
    said = said if isinstance(said, dict) else {}
    unit, labels = said.get(UNIT), said.get(LABELS)
    words = labels.items() if isinstance(labels, dict) else ()
    return Note(
        unit if isinstance(unit, str) else "",
        {int(n): w for n, w in words if isinstance(w, str) and _is_whole(n)},
    )


def _is_whole(text: str) -> bool:
    return text.removeprefix("-").isdecimal() and text.isascii()


def _plain(note: Note) -> dict[str, Any]:
    labels = {str(number): word for number, word in note.labels.items()}
    return {key: value for key, value in ((UNIT, note.unit), (LABELS, labels)) if value}
