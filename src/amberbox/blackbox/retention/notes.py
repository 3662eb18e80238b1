"""Notes of people in a store: written by the maintenance process, read from the events."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec

from amberbox.blackbox.columns.table_text import plain
from amberbox.blackbox.journal import channels
from amberbox.blackbox.retention.missions import PATIENCE_S, with_maintenance_lock
from amberbox.blackbox.store.catalogue import StoreCatalogue, query_catalogue
from amberbox.blackbox.store.derived_journal import DerivedJournal, event
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import (
    Store,
    finish,
    open_store,
    pending,
    store_path,
    submit,
)
from amberbox.blackbox.store.table_reader import RowRequest, gather
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.names import identifier
from amberbox.core.notes import KIND, RecordedNote, newest_notes, note_event, note_of

_EVENTS = identifier(channels.EVENT)
_POLL_S = 0.05


def load_notes(store: Path) -> dict[str, RecordedNote]:
    """Return all notes of a store by id, also those that are withdrawn."""
    return query_catalogue(store, _load, with_segments=can_build())


def _load(catalogue: StoreCatalogue) -> dict[str, RecordedNote]:
    if _EVENTS not in catalogue.schemas:
        return {}
    pieces = gather(catalogue, RowRequest(_EVENTS, ("kind", "details"))).pieces
    found = (
        note_of({"kind": kind, "details": details})
        for piece in pieces
        for kind, details in zip(
            plain(piece.columns["kind"]), plain(piece.columns["details"]), strict=True
        )
        if kind == KIND
    )
    return newest_notes(note for note in found if note is not None)


class NoteService:
    """Writes the notes that other processes request; the caller holds the maintenance lock."""

    def __init__(self, store: Store, journal: DerivedJournal) -> None:
        self._store, self._journal = store, journal
        self._known: dict[str, RecordedNote] | None = None

    def step(self) -> None:
        """Write what waits; a note that is recorded already, or newer, is not written again."""
        for request in pending(self._store):
            if request.kind != KIND:
                continue
            try:
                note = msgspec.convert(request.values, RecordedNote)
            except msgspec.ValidationError as error:
                record = event("note_refused", f"a note was not written down: {error}")
            else:
                known = self._notes().get(note.id)
                if known is not None and known.rank >= note.rank:
                    finish(request)
                    continue
                record = channels.EVENT, note_event(note)
            with suppress(OSError):  # a full disk: with the next step
                self._journal.write([record])
                finish(request)
                self._known = None

    def _notes(self) -> dict[str, RecordedNote]:
        if self._known is None:
            self._known = load_notes(self._store.path)
        return self._known


def submit_note(store: Store, note: RecordedNote, name: str = "") -> Path:
    """Leave a note for the maintenance process, under the id of a command if it has one."""
    return submit(store, KIND, msgspec.to_builtins(note), name)


def annotate(
    where: str | Path,
    text: str,
    at_ns: int,
    to_ns: int | None = None,
    *,
    who: str = "",
    about: str = "",
    mission: str = "",
) -> RecordedNote:
    """Write a note on a moment, or on the range ``[at_ns, to_ns)``, into a robot's record.

    Raises UsageError for a text that is none or too long, AmberboxError when the keeper does not
    answer.
    """
    if to_ns is not None and to_ns <= at_ns:
        raise UsageError("the range ends before it begins", "exchange --from and --to")
    note_id, now_ns = f"note-{secrets.token_hex(8)}", time.time_ns()
    return _write(
        open_store(store_path(where)),
        RecordedNote(note_id, at_ns, who, text, to_ns, about, mission, written_ns=now_ns),
    )


def change_note(
    where: str | Path, note_id: str, text: str = "", *, who: str = "", withdrawn: bool = False
) -> RecordedNote:
    """Change the text of a note, or withdraw it; raises UsageError where there is no such note."""
    store = open_store(store_path(where))
    return _write(store, changed(load_notes(store.path), note_id, text, who, withdrawn=withdrawn))


def changed(
    known: dict[str, RecordedNote], note_id: str, text: str, who: str, *, withdrawn: bool
) -> RecordedNote:
    """Return the next revision of a note; raises UsageError where there is no such note."""
    lasting = [note.id for note in known.values() if not note.withdrawn]
    if note_id not in lasting:
        what = f"there is no note '{note_id}'{did_you_mean(note_id, lasting)}"
        raise UsageError(what, "amberbox annotate list WHERE shows them")
    note = known[note_id]
    return msgspec.structs.replace(
        note, text=text or note.text, who=who or note.who, withdrawn=withdrawn,
        revision=note.revision + 1, written_ns=time.time_ns(),
    )  # fmt: skip


def _write(store: Store, note: RecordedNote) -> RecordedNote:
    """Submit a note, and wait until it is in the record."""
    try:
        msgspec.convert(msgspec.to_builtins(note), RecordedNote)
    except msgspec.ValidationError as error:
        raise UsageError(f"this is no note: {error}", "write 1 to 4000 characters") from error
    path = submit_note(store, note)
    until_s = time.monotonic() + PATIENCE_S
    step: Callable[[DerivedJournal], None] = lambda journal: NoteService(store, journal).step()  # noqa: E731 - typed
    while path.exists():
        if with_maintenance_lock(store, step):
            continue
        if time.monotonic() > until_s:
            path.unlink(missing_ok=True)
            raise AmberboxError(
                "the keeper of this record does not answer; nothing was written down",
                "see whether it is busy or stuck: amberbox doctor FOLDER",
            )
        time.sleep(_POLL_S)
    return note
