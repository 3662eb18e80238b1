"""Notes that people write on a moment or a range of a robot's record, as events in the record.

A note has an id that robot and server share. A change is a further event with the same id and a
higher revision; the highest counts, on both sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from amberbox.core.timestamps import format_time

KIND: Final = "note"
"""Kind of these events."""
TEXT_LENGTH: Final = 4000
MOST_REVISIONS: Final = 2**31 - 1
_LARGEST_NS = 2**62

CAUSE: Final = "cause:"
"""Begins what a note is about that names the cause of a fault: ``cause:laser_front#dirty``."""
NO_CAUSE: Final = "none"
"""The cause of a false alarm: nothing was broken."""

NoteId = Annotated[str, Meta(pattern=r"\A[a-z0-9][a-z0-9_-]{0,63}\Z")]
# Line ends and tabs are allowed
NoteText = Annotated[
    str,
    Meta(
        min_length=1,
        max_length=TEXT_LENGTH,
        pattern=r"\A[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]*\Z",
    ),
]
_Line = Annotated[str, Meta(max_length=200, pattern=r"\A[^\x00-\x1f\x7f-\x9f]*\Z")]
_TimeNs = Annotated[int, Meta(ge=0, le=_LARGEST_NS)]


class RecordedNote(Struct, frozen=True, forbid_unknown_fields=True):
    """A note of a person on ``[at_ns, to_ns)`` of the record, or on the moment ``at_ns`` alone.

    ``about`` is an item, a variable, a component or a cause, ``mission`` a mission; both may be
    empty. Times are the robot's, in ns; ``written_ns`` is when this revision was written.
    """

    id: NoteId
    at_ns: _TimeNs
    who: _Line
    text: NoteText
    to_ns: _TimeNs | None = None
    about: _Line = ""
    mission: _Line = ""
    revision: Annotated[int, Meta(ge=1, le=MOST_REVISIONS)] = 1
    withdrawn: bool = False
    written_ns: _TimeNs = 0

    @property
    def rank(self) -> tuple[int, bool, int, str]:
        """Return what decides between two states of a note, on both sides the same way."""
        return self.revision, self.withdrawn, self.written_ns, self.text

    @property
    def cause(self) -> str:
        """Return the failure mode, or NO_CAUSE, that was the cause; empty for any other note."""
        return self.about.removeprefix(CAUSE) if self.about.startswith(CAUSE) else ""

    def to_json(self) -> dict[str, Any]:
        """Return the note as JSON has it: times are RFC 3339 strings."""
        return {
            "id": self.id,
            "at": format_time(self.at_ns),
            "to": None if self.to_ns is None else format_time(self.to_ns),
            "who": self.who,
            "text": self.text,
            "about": self.about,
            "mission": self.mission,
            "revision": self.revision,
        }


_DECODER: msgspec.json.Decoder[RecordedNote] = msgspec.json.Decoder(RecordedNote)


def note_event(note: RecordedNote) -> Mapping[str, Any]:
    """Return the values of the event that a note is recorded as."""
    word = "withdrew" if note.withdrawn else ("noted" if note.revision == 1 else "changed")
    about = f" ({note.about})" if note.about else ""
    text = f"{note.who or 'somebody'} {word}{about}: {' '.join(note.text.split())}"
    details = msgspec.json.encode(note).decode()
    return {"kind": KIND, "text": text, "source": note.about, "details": details}


def note_of(values: Mapping[str, Any]) -> RecordedNote | None:
    """Return the note that an event records; None for any other event."""
    if values.get("kind") != KIND:
        return None
    try:
        return _DECODER.decode(str(values.get("details")))
    except (msgspec.MsgspecError, RecursionError):
        return None


def in_range(
    notes: Iterable[RecordedNote], from_ns: int | None, to_ns: int | None
) -> list[RecordedNote]:
    """Return the notes that meet ``[from, to)`` and are not withdrawn, in order of their times."""
    chosen = [
        note
        for note in notes
        if not note.withdrawn
        and (from_ns is None or (note.to_ns or note.at_ns + 1) > from_ns)
        and (to_ns is None or note.at_ns < to_ns)
    ]
    return sorted(chosen, key=lambda note: (note.at_ns, note.id))


def newest_notes(found: Iterable[RecordedNote]) -> dict[str, RecordedNote]:
    """Return the state that counts of each note, by id."""
    notes: dict[str, RecordedNote] = {}
    for note in found:
        if note.id not in notes or note.rank > notes[note.id].rank:
            notes[note.id] = note
    return notes
