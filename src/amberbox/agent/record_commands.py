"""Carry out the built-in commands about the record, in the command process of a robot.

Nothing moves: each becomes a request on the disk to the process whose matter it is (watcher,
keeper, link, recorder), under the id of the command, so that doing it twice changes nothing. They
are checked in a thread of their own: that reads files, and motions must not wait for it.
"""

from __future__ import annotations

import hashlib
import json
import queue
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from amberbox.blackbox.recorder.recorder import ROTATE_KIND
from amberbox.blackbox.retention.incidents import KIND as MARK_KIND
from amberbox.blackbox.retention.incidents import RELEASE_KIND
from amberbox.blackbox.retention.notes import submit_note
from amberbox.blackbox.retention.pins import window_in
from amberbox.blackbox.robot_folder.folder import RobotFolder, load_folder
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.incident import incident_of_firing, load_all
from amberbox.blackbox.store.store import FOLDERS, Store, is_locked, pending, submit
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.clock import NS, Clock
from amberbox.core.command import AnswerState, Command
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.notes import RecordedNote
from amberbox.core.record_commands import (
    AlarmAcknowledge,
    AlarmCommand,
    AlarmShelve,
    AlarmUnshelve,
    DiagnosisAnswer,
    IncidentMark,
    IncidentRelease,
    JournalCopy,
    JournalRotate,
    NoteWrite,
    RecordCommand,
    decode_record_command,
)
from amberbox.diagnosis.evidence.user import parse_answers
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.link.uploader import COPY_KIND
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.watcher import ANSWER_KIND
from amberbox.monitoring.watcher import KIND as ALARM_KIND
from amberbox.monitoring.watcher_journal import retained_findings

_READ_BYTES: Final = 1 << 20
_WATCH = "watch"
_MAIN = "main"


@dataclass(frozen=True, slots=True)
class Answered:
    """The end of a command: ``done`` with a result (JSON text), or why not."""

    id: str
    state: AnswerState
    reason: str = ""
    result: str = ""


class RecordRequests:
    """Turns commands about the record of one robot into requests to its processes."""

    def __init__(self, folder: RobotFolder, store: Store, clock: Clock) -> None:
        self._folder, self._store, self._clock = folder, store, clock
        self._known: tuple[str, Knowledge | None] | None = None

    def carry_out(self, command: Command) -> Answered:
        """Check a command and leave its request on the disk."""
        try:
            asked = decode_record_command(command.action, command.parameters)
            will = self._do(asked, command.id)
        except AmberboxError as error:
            return Answered(command.id, "refused", error.what)
        except OSError as error:
            text = f"the robot's disk refuses it: {error.strerror or error}"
            return Answered(command.id, "refused", text)
        return Answered(command.id, "done", "", json.dumps({"will": will}, ensure_ascii=False))

    def _do(self, asked: RecordCommand, command_id: str) -> str:
        """Submit the request; return what will happen. Raises UsageError for what cannot be."""
        if isinstance(asked, DiagnosisAnswer):
            return self._answer(asked, command_id)
        if isinstance(asked, IncidentMark):
            return self._mark(asked, command_id)
        if isinstance(asked, IncidentRelease):
            return self._release(asked, command_id)
        if isinstance(asked, NoteWrite):
            note = msgspec.convert(msgspec.to_builtins(asked), RecordedNote)
            submit_note(self._store, note, command_id)
            return self._later("the note will be written", "amberbox record", "keeper")
        if isinstance(asked, JournalCopy):
            return self._copy(asked, command_id)
        if isinstance(asked, JournalRotate):
            return self._rotate(command_id)
        return self._change_alarm(asked, command_id)

    def _submit(self, kind: str, values: Mapping[str, Any], command_id: str) -> None:
        submit(self._store, kind, values, command_id)

    def _later(self, text: str, verb: str, writer: str = _WATCH) -> str:
        """Return what will happen, and if a process has to be started for it, which."""
        return text if is_locked(self._store, writer) else f"{text} as soon as {verb} runs"

    def _change_alarm(self, asked: AlarmCommand, command_id: str) -> str:
        lasting = retained_findings(self._store).alarms.values()
        about = [alarm for alarm in lasting if alarm.component == asked.component]
        found = next((alarm for alarm in about if asked.alarm in ("", alarm.id)), None)
        if found is None and about:
            raise UsageError(f"the alarm {asked.alarm} is over; {about[0].id} is another one")
        if found is None:
            raise UsageError(f"there is no alarm of {asked.component} now")
        values: dict[str, Any] = {"id": found.id, "who": asked.who, "command": command_id}
        if isinstance(asked, AlarmAcknowledge):
            values |= {"action": "acknowledge", "note": asked.note}
            text = "acknowledged"
        elif isinstance(asked, AlarmShelve):
            until_ns = self._clock.wall_ns() + round(asked.for_s * NS)
            values |= {"action": "shelve", "note": asked.reason, "until_ns": until_ns}
            text = "shelved"
        elif isinstance(asked, AlarmUnshelve):
            values |= {"action": "unshelve"}
            text = "taken from the shelf"
        else:
            values |= {"action": "resolve", "note": asked.reason}
            text = "resolved"
        self._submit(ALARM_KIND, values, command_id)
        return self._later(f"{found.id} will be {text}", "amberbox watch")

    def _answer(self, asked: DiagnosisAnswer, command_id: str) -> str:
        if asked.diagnosis not in retained_findings(self._store).diagnoses:
            raise UsageError(f"the diagnosis {asked.diagnosis} is over, or not known here")
        knowledge = self._knowledge()
        if knowledge is None:
            raise UsageError("this robot has no fmea.yaml: it has no tests")
        for test, answer in parse_answers([f"{asked.test}={asked.answer}"], knowledge).items():
            given = RecordedAnswer(asked.diagnosis, test, answer, asked.who, command_id)
            self._submit(ANSWER_KIND, msgspec.to_builtins(given), command_id)
        return self._later(f"the next revision of {asked.diagnosis} counts it", "amberbox watch")

    def _knowledge(self) -> Knowledge | None:
        """Return the failure modes of the robot folder as it is now."""
        folder = load_folder(self._folder.path)
        if self._known is None or self._known[0] != folder.config_hash:
            knowledge, _ = load_knowledge(folder, load_plan(folder)[0])
            self._known = folder.config_hash, knowledge
        return self._known[1]

    def _mark(self, asked: IncidentMark, command_id: str) -> str:
        if window_in(self._store, asked.from_ns, asked.to_ns) is None:
            raise UsageError("nothing of its window is in the robot's record")
        values = {
            "key": asked.id, "from_ns": asked.from_ns, "to_ns": asked.to_ns,
            "reason": asked.reason, "who": asked.who,
        }  # fmt: skip
        self._submit(MARK_KIND, values, command_id)
        return self._later("the window will be pinned", "amberbox record", "keeper")

    def _release(self, asked: IncidentRelease, command_id: str) -> str:
        waits = any(
            request.kind == MARK_KIND and request.values.get("key") == asked.id
            for request in pending(self._store)
        )
        known = incident_of_firing(load_all(self._store), asked.id)
        if not waits and (known is None or not known.is_pinned):
            raise UsageError(f"the robot keeps no window for {asked.id}")
        self._submit(RELEASE_KIND, {"key": asked.id, "who": asked.who}, command_id)
        return self._later("the window will be released", "amberbox record", "keeper")

    def _copy(self, asked: JournalCopy, command_id: str) -> str:
        folder = asked.journal.partition("/")[0]
        path = self._store.journal_path(asked.journal) if folder in FOLDERS.values() else None
        if path is None or not path.is_file():
            raise UsageError(f"the robot has no journal {asked.journal} any more")
        is_sealed = asked.journal in manifest.read(self._store.path).sealed
        if not is_sealed and folder != FOLDERS["ring"]:
            raise UsageError(f"{asked.journal} is not sealed yet: it is copied once it is")
        if asked.sha256 and _sha256(path) != asked.sha256:
            raise UsageError(f"the robot's {asked.journal} has another content than was asked for")
        self._submit(COPY_KIND, {"journal": asked.journal}, command_id)
        return f"{asked.journal} will be sent again"

    def _rotate(self, command_id: str) -> str:
        if not is_locked(self._store, _MAIN):
            raise UsageError("nothing is recorded now: all files are closed")
        self._submit(ROTATE_KIND, {"who": "the server"}, command_id)
        return "the recorder will begin new files within a second or two"


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(_READ_BYTES):
            digest.update(part)
    return digest.hexdigest()


class RecordCommandThread:
    """Carries out commands one after the other; ``ended`` returns what has been done since."""

    def __init__(self, requests: RecordRequests) -> None:
        self._requests = requests
        self._waiting: queue.SimpleQueue[Command | None] = queue.SimpleQueue()
        self._ended: queue.SimpleQueue[Answered] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="record commands", daemon=True)
        self._thread.start()

    def put(self, command: Command) -> None:
        """Add a command."""
        self._waiting.put(command)

    def ended(self) -> list[Answered]:
        """Return the commands that have ended since the last call, in their order."""
        found = []
        while not self._ended.empty():
            found.append(self._ended.get())
        return found

    def close(self, wait_s: float) -> None:
        """End after what waits, or after so long."""
        self._waiting.put(None)
        self._thread.join(wait_s)

    def _run(self) -> None:
        while (command := self._waiting.get()) is not None:
            try:
                done = self._requests.carry_out(command)
            except Exception as error:  # a defect, or a damaged store: the next one goes on
                done = Answered(command.id, "failed", f"{type(error).__name__}: {error}")
            self._ended.put(done)
