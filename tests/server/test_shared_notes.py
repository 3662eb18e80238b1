"""Notes of robot and server: each once on both sides, whatever comes in which order, or twice."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.command import decode_command
from amberbox.core.notes import RecordedNote, newest_notes, note_event
from amberbox.core.record_commands import RECORD_COMMANDS, NoteWrite, decode_record_command
from amberbox.link.frames import LinkRow
from amberbox.server import annotations as server_annotations
from amberbox.server import commands, record_orders
from amberbox.server.alarms.reports import content_of, is_of_interest
from tests.server.alarms.stand import START_NS, STORE, Stand, stand

NOTE = RecordedNote("note-1", START_NS, "anna", "it squeaks", written_ns=START_NS)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as found:
        yield found


def row(note: RecordedNote, writer: str = "keep", **changes: Any) -> LinkRow:
    values = {**note_event(note), **changes}
    return LinkRow(writer, 1, 1, channels.EVENT, START_NS, msgspec.json.encode(values))


def take(server: Stand, note: RecordedNote) -> bool:
    found = content_of(row(note))
    assert isinstance(found, RecordedNote)
    with server.database.begin() as connection:
        return server_annotations.take_note(connection, "r1", found)


def listed(server: Stand) -> list[tuple[str, str, int]]:
    with server.database.reading() as connection:
        found = server_annotations.moment_annotations(connection, "r1", (None, None), None, 99)
    return [(one.note.text, one.note.who, one.note.revision) for one in found]


def changed(note: RecordedNote, text: str, revision: int = 2, **more: Any) -> RecordedNote:
    return msgspec.structs.replace(note, text=text, revision=revision, **more)


def test_a_note_of_a_robot_is_listed_once_with_its_last_text(server: Stand) -> None:
    assert take(server, NOTE) and not take(server, NOTE)
    assert listed(server) == [("it squeaks", "anna at the robot", 1)]
    assert take(server, changed(NOTE, "it hums")) and not take(server, NOTE)
    assert listed(server) == [("it hums", "anna at the robot", 2)]
    assert take(server, changed(NOTE, "it hums", 3, withdrawn=True))
    assert listed(server) == []
    assert not take(server, changed(NOTE, "late", 2))
    assert listed(server) == []


def test_hostile_rows_are_no_notes(server: Stand) -> None:
    assert is_of_interest(row(NOTE))
    details = json.loads(str(note_event(NOTE)["details"]))
    hostile: list[dict[str, Any]] = [
        {**details, "text": "x" * 4001}, {**details, "text": "\0"}, {**details, "id": "../x"},
        {**details, "at_ns": 2**63}, {**details, "revision": 0}, {**details, "more": 1}, {},
    ]  # fmt: skip
    texts = [json.dumps(one) for one in hostile] + ["[]", "{", "", "[" * 100_000]
    assert [content_of(row(NOTE, details=text)) for text in texts] == [None] * len(texts)
    assert content_of(row(NOTE, writer="watch")) is None


def test_a_robot_cannot_write_notes_without_end(
    server: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_annotations, "_MOST", 3)
    notes = [msgspec.structs.replace(NOTE, id=f"note-{number}") for number in range(5)]
    assert [take(server, note) for note in notes] == [True, True, True, False, False]


def test_a_robot_that_is_away_gets_the_last_state_when_it_is_back(server: Stand) -> None:
    connect(server)
    server.lose("r1")
    with server.database.begin() as connection:
        server_annotations.annotate(connection, "r1", NOTE)
        now_ns = server.clock.wall_ns()
        assert server_annotations.send_note(connection, now_ns, "r1", NOTE)
        second = changed(NOTE, "it hums")
        server_annotations.change_note(connection, "r1", second)
        assert server_annotations.send_note(connection, now_ns + NS, "r1", second)
    connect(server)
    with server.database.begin() as connection:
        raw = commands.claim(connection, "r1", server.epochs["r1"], server.clock.wall_ns())
    (command,) = [decode_command(data) for data in raw]
    assert decode_record_command(command.action, command.parameters) == NoteWrite(
        **msgspec.structs.asdict(second)
    )
    assert command.risk == "record"
    assert not take(server, second), "its echo is no news"
    with server.database.reading() as connection:
        order = record_orders.find(connection, "r1", server_annotations.note_matter("note-1"))
    assert order is not None and order.is_seen


def connect(server: Stand) -> None:
    server.connect("r1")
    names = json.dumps({"record": sorted(RECORD_COMMANDS)})
    with server.database.begin() as connection:
        epoch, now_ns = server.epochs["r1"], server.clock.wall_ns()
        commands.begin_contact(connection, "r1", epoch, STORE)
        commands.announce(connection, "r1", epoch, names, now_ns)


REVISIONS = st.lists(
    st.builds(
        RecordedNote,
        id=st.sampled_from(["note-1", "note-2"]),
        at_ns=st.just(START_NS),
        who=st.sampled_from(["anna", "bo"]),
        text=st.sampled_from(["a", "b", "c"]),
        revision=st.integers(1, 3),
        withdrawn=st.booleans(),
        written_ns=st.integers(0, 2),
    ),
    max_size=8,
)


@given(st.data())
@settings(max_examples=200, suppress_health_check=list(HealthCheck))
def test_both_sides_come_to_the_same_state_in_any_order(data: st.DataObject) -> None:
    revisions = data.draw(REVISIONS)
    other = data.draw(st.permutations([*revisions, *revisions[:3]]))
    states = [
        {
            name: (note.text, note.withdrawn, note.revision)
            for name, note in newest_notes(order).items()
        }
        for order in (revisions, other)
    ]
    assert states[0] == states[1]
