"""Parameters of the built-in commands: what is taken, and what is refused."""

from __future__ import annotations

import json

import pytest

from amberbox.core.command import CommandError
from amberbox.core.record_commands import (
    RECORD_COMMANDS,
    AlarmShelve,
    IncidentMark,
    JournalCopy,
    action_of,
    decode_record_command,
    parameters_of,
)

ALARM = {"component": "base", "who": "anna"}
MARK = {"id": "server-1", "from_ns": 1, "to_ns": 2, "who": "anna"}


def test_what_is_written_is_read() -> None:
    shelve = AlarmShelve("base", 7200.0, "anna", "a part\ncomes", "base-1")
    assert decode_record_command(action_of(shelve), parameters_of(shelve)) == shelve
    mark = decode_record_command("incident.mark", json.dumps(MARK))
    assert mark == IncidentMark("server-1", 1, 2, "anna")


def test_names_have_a_dot_and_every_one_has_parameters() -> None:
    assert all("." in name for name in RECORD_COMMANDS)
    assert {action_of(kind) for kind in (JournalCopy("journal/1-a-1.mcap"),)} == {"journal.copy"}


@pytest.mark.parametrize(
    ("action", "values"),
    [
        ("alarm.acknowledge", {"component": "base"}),
        ("alarm.acknowledge", {**ALARM, "more": 1}),
        ("alarm.acknowledge", {**ALARM, "component": "a b"}),
        ("alarm.acknowledge", {**ALARM, "component": "a\n"}),
        ("alarm.acknowledge", {**ALARM, "who": ""}),
        ("alarm.acknowledge", {**ALARM, "who": "\x1b[2J"}),
        ("alarm.acknowledge", {**ALARM, "note": "x" * 2001}),
        ("alarm.acknowledge", {**ALARM, "note": "\x00"}),
        ("alarm.shelve", {**ALARM, "for_s": 0}),
        ("alarm.shelve", {**ALARM, "for_s": 1e12}),
        ("alarm.shelve", {**ALARM, "for_s": "1"}),
        ("incident.mark", {**MARK, "to_ns": 1}),
        ("incident.mark", {**MARK, "to_ns": 2**63}),
        ("incident.mark", {**MARK, "to_ns": 40 * 86_400 * 10**9}),
        ("journal.copy", {"journal": "../../etc/passwd"}),
        ("journal.copy", {"journal": "journal/1-a-1.mcap", "sha256": "0" * 63}),
        ("journal.rotate", {"now": True}),
        ("diagnosis.answer", {"diagnosis": "d", "test": "t", "answer": "x\ny", "who": "anna"}),
    ],
)
def test_what_does_not_fit_is_refused(action: str, values: dict[str, object]) -> None:
    with pytest.raises(CommandError, match=action):
        decode_record_command(action, json.dumps(values))


@pytest.mark.parametrize("text", ["", "[]", '{"a": 1, "a": 2}', "nan", "{" * 100])
def test_what_is_no_object_is_refused(text: str) -> None:
    with pytest.raises(CommandError):
        decode_record_command("journal.rotate", text)
