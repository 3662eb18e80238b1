"""Built-in commands of risk ``record``: a server asks a robot for what only concerns the record.

They are unsigned and need no configuration. Their names have a dot, so that no action that a robot
folder declares can be called so. Parameters travel as JSON text and are decoded here alone, the
same way by robot and server.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, TypeAlias

import msgspec
from msgspec import Meta, Struct

from amberbox.core.command import CommandError, read_parameters
from amberbox.core.notes import RecordedNote

# Longest time for which an alarm is shelved, and longest window of an incident, seconds
LONGEST_SHELF_S: Final = 366 * 86_400.0
LONGEST_WINDOW_S: Final = 31 * 86_400.0
NOTE_LENGTH: Final = 2000
_LARGEST_NS = 2**62

_NO_CONTROLS = r"\A[^\x00-\x1f\x7f-\x9f]*\Z"
# An id of a component, an alarm, a diagnosis, a test or an incident
_Id: TypeAlias = Annotated[
    str, Meta(min_length=1, max_length=300, pattern=r"\A[^\s\x00-\x1f\x7f-\x9f]+\Z")
]
_OptionalId: TypeAlias = Annotated[
    str, Meta(max_length=300, pattern=r"\A[^\s\x00-\x1f\x7f-\x9f]*\Z")
]
_Who: TypeAlias = Annotated[str, Meta(min_length=1, max_length=128, pattern=_NO_CONTROLS)]
_Line: TypeAlias = Annotated[str, Meta(min_length=1, max_length=300, pattern=_NO_CONTROLS)]
# Text of a person; line ends and tabs are allowed
_Note: TypeAlias = Annotated[
    str, Meta(max_length=NOTE_LENGTH, pattern=r"\A[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]*\Z")
]
_TimeNs: TypeAlias = Annotated[int, Meta(ge=0, le=_LARGEST_NS)]


class AlarmAcknowledge(Struct, frozen=True, forbid_unknown_fields=True):
    """Acknowledge the present alarm of a component; ``alarm`` refuses any other than this one."""

    component: _Id
    who: _Who
    note: _Note = ""
    alarm: _OptionalId = ""


class AlarmShelve(Struct, frozen=True, forbid_unknown_fields=True):
    """Shelve the alarm of a component for some time from now on, as clocks differ."""

    component: _Id
    for_s: Annotated[float, Meta(gt=0, le=LONGEST_SHELF_S)]
    who: _Who
    reason: _Note = ""
    alarm: _OptionalId = ""


class AlarmUnshelve(Struct, frozen=True, forbid_unknown_fields=True):
    """Take the alarm of a component from the shelf."""

    component: _Id
    who: _Who
    alarm: _OptionalId = ""


class AlarmResolve(Struct, frozen=True, forbid_unknown_fields=True):
    """Close the alarm of a component; it opens again when it gets worse or comes back."""

    component: _Id
    who: _Who
    reason: _Note = ""
    alarm: _OptionalId = ""


class DiagnosisAnswer(Struct, frozen=True, forbid_unknown_fields=True):
    """Take what a test of an open diagnosis gave as evidence."""

    diagnosis: _Id
    test: _Id
    answer: _Line
    who: _Who


class IncidentMark(Struct, frozen=True, forbid_unknown_fields=True):
    """Keep a window of the record; times of receipt by the robot's clock, without the end."""

    id: _Id
    from_ns: _TimeNs
    to_ns: _TimeNs
    who: _Who
    reason: _Note = ""


class IncidentRelease(Struct, frozen=True, forbid_unknown_fields=True):
    """Release a window that was marked with this id."""

    id: _Id
    who: _Who


class NoteWrite(RecordedNote, frozen=True, forbid_unknown_fields=True):
    """Write a note of a person into the record, change or withdraw it; times by the robot's clock.

    A revision that the robot has already changes nothing.
    """


class JournalCopy(Struct, frozen=True, forbid_unknown_fields=True):
    """Send a sealed journal (``folder/file``) again; with ``sha256`` only if it is this content."""

    journal: Annotated[
        str,
        Meta(pattern=r"\A[a-z]{1,16}/[0-9]{1,12}-[0-9a-z]{1,16}-[0-9]{1,12}\.mcap\Z"),
    ]
    sha256: Annotated[str, Meta(pattern=r"\A([0-9a-f]{64})?\Z")] = ""


class JournalRotate(Struct, frozen=True, forbid_unknown_fields=True):
    """Close the recorder's present files and begin new ones."""


AlarmCommand: TypeAlias = AlarmAcknowledge | AlarmShelve | AlarmUnshelve | AlarmResolve
RecordCommand: TypeAlias = (
    AlarmCommand
    | DiagnosisAnswer
    | IncidentMark
    | IncidentRelease
    | NoteWrite
    | JournalCopy
    | JournalRotate
)

RECORD_COMMANDS: Final[Mapping[str, type[RecordCommand]]] = {
    "alarm.acknowledge": AlarmAcknowledge,
    "alarm.shelve": AlarmShelve,
    "alarm.unshelve": AlarmUnshelve,
    "alarm.resolve": AlarmResolve,
    "diagnosis.answer": DiagnosisAnswer,
    "incident.mark": IncidentMark,
    "incident.release": IncidentRelease,
    "note.write": NoteWrite,
    "journal.copy": JournalCopy,
    "journal.rotate": JournalRotate,
}
_NAMES: Final = {kind: name for name, kind in RECORD_COMMANDS.items()}


def action_of(command: RecordCommand) -> str:
    """Return the name under which a command travels."""
    return _NAMES[type(command)]


def parameters_of(command: RecordCommand) -> str:
    """Return the parameters of a command as JSON text.

    Raises CommandError for a command that ``decode_record_command`` refuses.
    """
    text = msgspec.json.encode(command).decode()
    decode_record_command(action_of(command), text)
    return text


def decode_record_command(action: str, parameters: str) -> RecordCommand:
    """Decode and check the parameters (JSON text) of a built-in command.

    Raises CommandError for parameters that are missing, unknown, of another type or out of range.
    """
    kind = RECORD_COMMANDS[action]
    values = read_parameters(parameters)
    try:
        found: RecordCommand = msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        raise CommandError(f"{action}: {error}", f"it takes {_fields(kind)}") from error
    if isinstance(found, IncidentMark):
        _check_window(found)
    return found


def _check_window(mark: IncidentMark) -> None:
    length_s = (mark.to_ns - mark.from_ns) / 1e9
    if not 0 < length_s <= LONGEST_WINDOW_S:
        raise CommandError(
            f"incident.mark: a window of {length_s:g} s",
            f"a window ends after it begins, and has {LONGEST_WINDOW_S:g} s at most",
        )


def _fields(kind: type[RecordCommand]) -> str:
    return ", ".join(kind.__struct_fields__) or "no parameters"
