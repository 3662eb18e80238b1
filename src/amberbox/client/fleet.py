"""The Python client of a server: ``Fleet("https://fleet.example:8443").robots()``.

Paged lists are returned as one. Downloads are waited for, then saved; an interrupted one is
resumed.
"""

from __future__ import annotations

import base64
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar
from urllib.parse import quote

import msgspec

from amberbox.client import models, table_reader
from amberbox.client.address import read_address
from amberbox.client.models import Time, time_text
from amberbox.client.transport import TIMEOUT_S, ApiConnection, Query, UnreachableError
from amberbox.core.errors import AmberboxError

if TYPE_CHECKING:
    from http.client import HTTPResponse

    from amberbox.blackbox.query.table import Table
    from amberbox.client.models import Download, LearntModel
    from amberbox.client.transport import Change
    from amberbox.core.command import Command, CommandSignature


PAGE = 1000
One = TypeVar("One")


def paged(
    wire: ApiConnection,
    path: str,
    kind: type[One],
    last: Callable[[One], Any],
    query: Query | None = None,
    page: int = PAGE,
) -> Iterator[One]:
    """Yield all entries of a paged list; ``last(entry)`` returns its ``after`` parameter."""
    after: Any = ""
    while True:
        asked = {**(query or {}), "limit": page, "after": after}
        answers = msgspec.json.decode(wire.get(path, asked).body)
        found = [msgspec.convert(one, kind) for one in answers]
        yield from found
        if len(found) < page:
            return
        after = last(found[-1])


class AlarmCalls:
    """Requests about the alarms of a server.

    Changes take the ``revision`` that the caller has read; they raise ConflictError if the alarm
    was changed since.
    """

    wire: ApiConnection

    def alarms(
        self, robot: str = "", *, state: Sequence[str] = (), group: str = "",
        severity: str = "warning", since: Time = None,
    ) -> list[models.AlarmLine]:  # fmt: skip
        """Return alarms, newest first: of ``severity`` and worse, changed ``since`` then."""
        asked = {"robot": robot, "state": list(state), "group": group, "severity": severity,
                 "since": time_text(since)}  # fmt: skip
        return [*paged(self.wire, "/alarms", models.AlarmLine, lambda a: a.id, asked)]

    def alarm(self, alarm: int) -> models.AlarmPage:
        """Return an alarm with its consequences and its history."""
        found = self.wire.get(f"/alarms/{alarm}").body
        return msgspec.json.decode(found, type=models.AlarmPage)

    def acknowledge(self, alarm: int, revision: int, note: str = "") -> models.AlarmPage:
        """Acknowledge an alarm."""
        return self._do(alarm, "acknowledge", {"revision": revision, "note": note})

    def shelve(self, alarm: int, revision: int, until: Time, reason: str) -> models.AlarmPage:
        """Shelve an alarm until a time."""
        body = {"revision": revision, "until": time_text(until), "reason": reason}
        return self._do(alarm, "shelve", body)

    def unshelve(self, alarm: int, revision: int) -> models.AlarmPage:
        """Unshelve an alarm."""
        return self._do(alarm, "unshelve", {"revision": revision})

    def own(self, alarm: int, revision: int, user: str) -> models.AlarmPage:
        """Assign an owner to an alarm; an empty name removes the owner."""
        return self._do(alarm, "own", {"revision": revision, "user": user})

    def note(self, alarm: int, text: str) -> models.AlarmPage:
        """Add a note to the history of an alarm."""
        return self._do(alarm, "note", {"text": text})

    def resolve(self, alarm: int, revision: int, reason: str) -> models.AlarmPage:
        """Resolve an alarm; it reopens if the robot reports the fault again."""
        return self._do(alarm, "resolve", {"revision": revision, "reason": reason})

    def _do(self, alarm: int, action: str, body: Mapping[str, Any]) -> models.AlarmPage:
        reply = self.wire.send("POST", f"/alarms/{alarm}/{action}", body)
        return msgspec.json.decode(reply.body, type=models.AlarmPage)


class CommandCalls:
    """Requests about commands to robots, leases and revoked keys.

    They raise ConflictError where the robot does not allow it as it is now.
    """

    wire: ApiConnection

    def actions(self, robot: str) -> models.RobotCommands:
        """Return what a robot can do, who holds it, and what waits there."""
        body = self.wire.get(f"{_of(robot)}/actions").body
        return msgspec.json.decode(body, type=models.RobotCommands)

    def commands(
        self, robot: str, *, state: Sequence[str] = (), run: str = "", limit: int = 100
    ) -> list[models.CommandLine]:
        """Return commands of a robot, newest first."""
        asked = {"state": list(state), "run": run, "limit": limit}
        body = self.wire.get(f"{_of(robot)}/commands", asked).body
        return msgspec.json.decode(body, type=list[models.CommandLine])

    def command(self, robot: str, command: str) -> models.CommandLine:
        """Return a command with what the robot answered."""
        body = self.wire.get(f"{_of(robot)}/commands/{quote(command, safe='')}").body
        return msgspec.json.decode(body, type=models.CommandLine)

    def send_command(
        self, robot: str, command: Command, lifetime: float | None = None
    ) -> models.CommandLine:
        """Send a signed command; store an unsigned one until somebody signs it.

        ``lifetime`` is how long it waits for that, in seconds.
        """
        body: dict[str, Any] = {
            "id": command.id, "action": command.action, "parameters": command.parameters,
            "risk": command.risk, "run": command.run, "step": command.step,
        }  # fmt: skip
        if lifetime is not None:
            body["lifetime_s"] = lifetime
        if command.signature is not None:
            body["signature"] = _signature(command.signature)
        return self._command(robot, "commands", body)

    def sign_command(
        self, robot: str, command: str, signature: CommandSignature
    ) -> models.CommandLine:
        """Add a signature to a command that waits for one; it is sent at once."""
        return self._command(robot, f"commands/{command}/sign", _signature(signature))

    def withdraw_command(self, robot: str, command: str) -> models.CommandLine:
        """Withdraw a command that was not sent yet."""
        return self._command(robot, f"commands/{command}/withdraw", None)

    def confirm_command(self, robot: str, command: str, code: str) -> models.CommandLine:
        """Confirm a motion with the code that is shown at the robot."""
        return self._command(robot, f"commands/{command}/confirm", {"code": code})

    def abort(self, robot: str, target: str = "") -> models.AbortReport:
        """Stop a command (its id), a run (its name), or all that a robot does.

        It may be done twice, so a request that finds no answer is sent again.
        """
        path, body = f"{_of(robot)}/abort", {"target": target}
        try:
            reply = self.wire.send("POST", path, body)
        except UnreachableError:
            reply = self.wire.send("POST", path, body)
        return msgspec.json.decode(reply.body, type=models.AbortReport)

    def take_lease(self, robot: str, run: str = "") -> models.RobotLease:
        """Take a robot; the lease is lost if it is not renewed for 3 s."""
        return self._lease(robot, "lease", {"run": run})

    def renew_lease(self, robot: str, number: int) -> models.RobotLease:
        """Renew a lease."""
        return self._lease(robot, "lease/renew", {"number": number})

    def release_lease(self, robot: str, number: int) -> models.RobotLease:
        """Release a lease; what runs under it is stopped."""
        return self._lease(robot, "lease/release", {"number": number})

    def revoked_keys(self) -> list[models.RevokedKeyLine]:
        """Return the revoked keys of persons."""
        found = self.wire.get("/revoked-keys").body
        return msgspec.json.decode(found, type=list[models.RevokedKeyLine])

    def revoke_key(self, key_id: str, reason: str) -> models.RevokedKeyLine:
        """Revoke a person's key on all robots, for ever."""
        reply = self.wire.send("POST", "/revoked-keys", {"key_id": key_id, "reason": reason})
        return msgspec.json.decode(reply.body, type=models.RevokedKeyLine)

    def _command(self, robot: str, what: str, body: Any) -> models.CommandLine:
        reply = self.wire.send("POST", f"{_of(robot)}/{what}", body)
        return msgspec.json.decode(reply.body, type=models.CommandLine)

    def _lease(self, robot: str, what: str, body: Any) -> models.RobotLease:
        reply = self.wire.send("POST", f"{_of(robot)}/{what}", body)
        return msgspec.json.decode(reply.body, type=models.RobotLease)


def _signature(signature: CommandSignature) -> Mapping[str, Any]:
    return {
        "key_id": signature.key_id, "lease": signature.lease,
        "challenge": signature.challenge.hex(), "ttl_s": signature.ttl_s,
        "server": signature.server,
        "signature": base64.b64encode(signature.signature).decode(),
    }  # fmt: skip


class ExperimentCalls:
    """Requests about experiments, unit tests and their runs.

    They raise ConflictError where the robot or the run does not allow it as it is now.
    """

    wire: ApiConnection

    def experiments(self, robot: str = "") -> list[models.ExperimentLine]:
        """Return the experiments that a robot can run; without a robot those uploaded."""
        path = f"{_of(robot)}/experiments" if robot else "/experiments"
        return msgspec.json.decode(self.wire.get(path).body, type=list[models.ExperimentLine])

    def upload_experiment(self, name: str, files: Mapping[str, bytes]) -> models.ExperimentLine:
        """Upload an experiment with all its files, by name."""
        body = {"name": name, "files": {n: base64.b64encode(d).decode() for n, d in files.items()}}
        reply = self.wire.send("POST", "/experiments", body)
        return msgspec.json.decode(reply.body, type=models.ExperimentLine)

    def withdraw_experiment(self, name: str) -> None:
        """Take an uploaded experiment from the list."""
        self.wire.send("DELETE", f"/experiments/{quote(name, safe='')}")

    def diagram(self, robot: str, experiment: str = "", run: str = "") -> str:
        """Return the diagram of an experiment, or of a run with its states, as SVG."""
        path = f"runs/{run}" if run else f"experiments/{quote(experiment, safe='')}"
        return self.wire.get(f"{_of(robot)}/{path}/diagram").body.decode()

    def picture(self, robot: str, file: str, experiment: str = "", run: str = "") -> bytes:
        """Return a picture of an experiment, or of that of a run."""
        path = f"runs/{run}" if run else f"experiments/{quote(experiment, safe='')}"
        return self.wire.get(f"{_of(robot)}/{path}/files/{quote(file, safe='')}").body

    def tests(self, robot: str) -> list[models.UnitTestLine]:
        """Return the unit tests that a robot has announced."""
        body = self.wire.get(f"{_of(robot)}/tests").body
        return msgspec.json.decode(body, type=list[models.UnitTestLine])

    def runs(
        self, robot: str = "", *, state: Sequence[str] = (), name: str = "", series: str = "",
        limit: int = 100,
    ) -> list[models.RunLine]:  # fmt: skip
        """Return runs, newest first; without a robot those on all robots."""
        asked = {"state": list(state), "name": name, "limit": limit}
        path = f"{_of(robot)}/runs" if robot else "/runs"
        asked |= {"series": series} if robot else {}
        return msgspec.json.decode(self.wire.get(path, asked).body, type=list[models.RunLine])

    def start_run(
        self, robot: str, experiment: str = "", parameters: Mapping[str, Any] | None = None, *,
        test: str = "", repeats: int = 1, queue: bool = False, diagnosis: str = "",
        answers: str = "",
    ) -> models.RunLine:  # fmt: skip
        """Start an experiment or a unit test; ``queue`` plans it where the robot is away."""
        body = {
            "experiment": experiment, "test": test, "parameters": dict(parameters or {}),
            "repeats": repeats, "queue": queue, "diagnosis": diagnosis, "answers": answers,
        }  # fmt: skip
        reply = self.wire.send("POST", f"{_of(robot)}/runs", body)
        return msgspec.json.decode(reply.body, type=models.RunLine)

    def run(self, robot: str, run: str) -> models.RunDetail:
        """Return a run: what waits now, and all that has happened."""
        body = self.wire.get(f"{_of(robot)}/runs/{run}").body
        return msgspec.json.decode(body, type=models.RunDetail)

    def begin_run(self, robot: str, run: str) -> models.RunLine:
        """Begin a run that was planned."""
        reply = self.wire.send("POST", f"{_of(robot)}/runs/{run}/begin", {})
        return msgspec.json.decode(reply.body, type=models.RunLine)

    def be_present(self, robot: str, run: str, role: str) -> None:
        """Say that one is there for a run; to be said again every 10 s."""
        self.wire.send("POST", f"{_of(robot)}/runs/{run}/present", {"role": role})

    def complete_step(
        self, robot: str, run: str, task: str, values: Mapping[str, Any] | None = None
    ) -> models.RunDetail:
        """End a step of a person with the values of its form."""
        return self._part(robot, run, "complete", {"task": task, "values": dict(values or {})})

    def note_deviation(self, robot: str, run: str, task: str, text: str) -> models.RunDetail:
        """Note what was not as expected in a step."""
        return self._part(robot, run, "deviation", {"task": task, "text": text})

    def note_run(self, robot: str, run: str, text: str) -> models.RunDetail:
        """Note a remark about a run."""
        return self._part(robot, run, "note", {"text": text})

    def pause_run(self, robot: str, run: str, reason: str = "") -> models.RunDetail:
        """Stop the timers of a run, and begin no step of the robot."""
        return self._part(robot, run, "pause", {"reason": reason})

    def resume_run(self, robot: str, run: str, reason: str = "") -> models.RunDetail:
        """Go on with a run that is paused."""
        return self._part(robot, run, "resume", {"reason": reason})

    def abort_run(self, robot: str, run: str, reason: str = "") -> models.RunLine:
        """End a run and have the robot stopped.

        It may be done twice, so a request that finds no answer is sent again.
        """
        path, body = f"{_of(robot)}/runs/{run}/abort", {"reason": reason}
        try:
            reply = self.wire.send("POST", path, body)
        except UnreachableError:
            reply = self.wire.send("POST", path, body)
        return msgspec.json.decode(reply.body, type=models.RunLine)

    def run_report(self, robot: str, run: str, format: str = "json") -> bytes:
        """Return the report of a run: ``json``, ``html`` or ``junit``."""
        return self.wire.get(f"{_of(robot)}/runs/{run}/report", {"format": format}).body

    def compare_runs(
        self, robot: str, runs: Sequence[str], since: str = "", software: str = ""
    ) -> dict[str, Any]:
        """Compare runs of one experiment; ``since`` is a version of a software, else the robot."""
        asked = {"run": list(runs), "since": since, "software": software}
        body = self.wire.get(f"{_of(robot)}/comparison", asked).body
        return msgspec.json.decode(body, type=dict[str, Any])

    def _part(self, robot: str, run: str, what: str, body: Mapping[str, Any]) -> models.RunDetail:
        reply = self.wire.send("POST", f"{_of(robot)}/runs/{run}/{what}", body)
        return msgspec.json.decode(reply.body, type=models.RunDetail)


Progress = Callable[[float], None]
_PIECE = 1 << 18
_POLLS_S = (0.05, 0.1, 0.2, 0.5, 1.0)
_ATTEMPTS = 3


_Job = TypeVar("_Job", "Download", "LearntModel")


def wait_for_job(
    fleet: Fleet, ask: Callable[[], _Job], progress: Progress | None, limit_s: float | None
) -> _Job:
    """Wait until what the server makes, a download or a model, is ready; return its state.

    Raises AmberboxError when it failed, was cancelled, or took longer than ``limit_s``.
    """
    end_s = None if limit_s is None else time.monotonic() + limit_s
    number = 0
    while not (found := ask()).is_over:
        if progress is not None:
            progress(found.progress)
        if end_s is not None and time.monotonic() > end_s:
            raise AmberboxError(f"{fleet.url}: {found.id} is not made after {limit_s:g} s")
        time.sleep(_POLLS_S[min(number, len(_POLLS_S) - 1)])
        number += 1
    if found.state != "done":
        why = f": {found.error}" if found.error else ""
        raise AmberboxError(f"{fleet.url}: {found.id} is {found.state}{why}")
    return found


def save_file(
    fleet: Fleet, path: str, found: Download | LearntModel, target: Path,
    progress: Progress | None, sha256: str = "",
) -> Path:  # fmt: skip
    """Save a finished file of the server, ``path``; ``target`` may be a folder. Return its path.

    The file appears when it is complete, and has the hash ``sha256`` if one is given. A partial
    file of an earlier attempt, ``NAME.ID.part`` beside it, is continued.
    """
    file = target / Path(found.file or found.id).name if target.is_dir() else target
    part = file.with_name(f"{file.name}.{found.id}.part")
    for left in reversed(range(_ATTEMPTS)):
        try:
            _append(fleet, path, found, part, progress)
            break
        except AmberboxError:
            if not left or not part.exists():
                raise
    size = part.stat().st_size
    if size != found.bytes:
        part.unlink()
        raise AmberboxError(f"{found.bytes} bytes were to come, {size} came", "try again")
    if sha256 and hashlib.sha256(part.read_bytes()).hexdigest() != sha256:
        part.unlink()
        raise AmberboxError(f"{found.id} did not come as the server states its hash", "try again")
    part.replace(file)
    return file


def _append(
    fleet: Fleet, path: str, found: Download | LearntModel, part: Path, progress: Progress | None
) -> None:
    have = part.stat().st_size if part.exists() else 0
    if have > found.bytes:
        part.unlink()
        have = 0
    if have == found.bytes and part.exists():
        return
    with fleet.wire.stream(path, have) as answer:
        mode = "ab" if have and answer.status == 206 else "wb"
        _take(answer, part, mode, found.bytes, progress)


def _take(
    answer: HTTPResponse, part: Path, mode: str, size: int, progress: Progress | None
) -> None:
    with part.open(mode) as opened:
        while piece := answer.read(_PIECE):
            opened.write(piece)
            if progress is not None:
                progress(opened.tell() / max(size, 1))
        opened.flush()
        os.fsync(opened.fileno())


By = Literal["received", "timestamp"]
ROWS = 200_000
"""Maximum number of rows of one answer; more rows are requested in several answers."""
_Answer = TypeVar("_Answer")


class Fleet(AlarmCalls, CommandCalls, ExperimentCalls):
    """A connection to one server. A context manager; threads may share it.

    ``token`` is an API token; by default ``AMBERBOX_TOKEN`` of the environment, else that of
    ``amberbox sign-in``. ``ca`` is the fingerprint of the server's authority (``sha256:...``) or a
    PEM file; by default the pin of sign-in, else the system's authorities.

    All methods raise UnreachableError, NotSignedInError, NotAllowedError, UsageError for wrong
    input or unknown objects, and AmberboxError for other errors of the server; each names the
    address.
    """

    def __init__(
        self, url: str, token: str | None = None, ca: str | Path | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> None:  # fmt: skip
        from amberbox.client.credentials import wire_to

        self.url = read_address(url).url
        self.wire: ApiConnection = wire_to(url, token, ca, timeout_s)

    @classmethod
    def over(cls, wire: ApiConnection) -> Fleet:
        """Return the client of a connection that exists."""
        found = cls.__new__(cls)
        found.url, found.wire = wire.url, wire
        return found

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self.wire.close()

    # Robots and their statuses.

    def robots(self, group: str = "") -> list[models.Card]:
        """Return the robots that the token may see, by id."""
        return [*paged(self.wire, "/robots", models.Card, lambda r: r.robot, {"group": group})]

    def robot(self, robot: str) -> models.Card:
        """Return the overview of one robot."""
        return self._get(_of(robot), models.Card)

    def status(self, robot: str) -> models.StatusTree:
        """Return the components of a robot as a tree."""
        return self._get(f"{_of(robot)}/status", models.StatusTree)

    def timeline(
        self, robot: str, from_: Time = "now-1h", to: Time = "now", component: str = "",
        points: int = 500,
    ) -> models.Timeline:  # fmt: skip
        """Return the states of components over time, by default over the last hour."""
        asked = {**_span(from_, to), "component": component, "points": points}
        return self._get(f"{_of(robot)}/timeline", models.Timeline, asked)

    def events(
        self, robot: str, from_: Time = None, to: Time = None, kind: str = "", limit: int = 100,
        newest: bool = True,
    ) -> list[models.Event]:  # fmt: skip
        """Return events in order of time: the newest ones of a range, or the first ones."""
        asked = {**_span(from_, to), "kind": kind, "limit": limit, "newest": newest}
        return self._get(f"{_of(robot)}/events", list[models.Event], asked)

    # Recorded data.

    def items(self, robot: str) -> list[models.Item]:
        """Return the data items that the server has rows of."""
        return self._get(f"{_of(robot)}/items", list[models.Item])

    def item(self, robot: str, item: str) -> models.ItemDetail:
        """Return an item with its columns."""
        return self._get(f"{_of(robot)}/items/{quote(item, safe='')}", models.ItemDetail)

    def query(
        self, robot: str, item: str, variables: Sequence[str] | None = None, from_: Time = None,
        to: Time = None, by: By = "received", points: int | None = None,
    ) -> Table:  # fmt: skip
        """Return rows of ``[from_, to)`` (see ``Record.query``); ``points`` reduces their number.

        Of more than a million rows, ``points`` gives ``x:min``, ``x:max``, ``x:mean``, ``x:count``.
        """
        pages = self.pages(robot, item, variables, from_, to, by, points)
        return table_reader.concatenate([page.table for page in pages])

    def pages(
        self, robot: str, item: str, variables: Sequence[str] | None = None, from_: Time = None,
        to: Time = None, by: By = "received", points: int | None = None, rows: int = ROWS,
    ) -> Iterator[table_reader.RowPage]:  # fmt: skip
        """Yield the rows of a query in pages of at most ``rows``."""
        start: str = time_text(from_)
        while True:
            asked = {
                "item": item,
                "variables": variables,
                **_span(start, to),
                "by": by,
                "points": points,
                "limit": None if points else rows,
                "format": table_reader.row_format(),
            }
            page = table_reader.page_of(self.wire.get(f"{_of(robot)}/query", asked))
            yield page
            if not page.next:
                return
            start = page.next

    def statistics(
        self, robot: str, item: str, variables: Sequence[str] | None = None, from_: Time = None,
        to: Time = None,
    ) -> models.Summaries:  # fmt: skip
        """Return count, minimum, maximum and mean of variables in a range."""
        asked = {"item": item, "variables": variables, **_span(from_, to)}
        return self._get(f"{_of(robot)}/statistics", models.Summaries, asked)

    def gaps(
        self, robot: str, item: str = "", from_: Time = None, to: Time = None
    ) -> list[models.Gap]:
        """Return the gaps in a range, with their reasons, in order of time."""
        found: dict[models.Gap, None] = {}
        start = time_text(from_)
        while True:
            asked = {"item": item, **_span(start, to), "limit": PAGE}
            answer = self._get(f"{_of(robot)}/gaps", models.Gaps, asked)
            fresh = [gap for gap in answer.gaps if gap not in found]
            found.update(dict.fromkeys(fresh))
            if not (answer.more and fresh):
                return list(found)
            start = answer.gaps[-1].from_

    def missions(
        self, robot: str, name: str = "", failed: bool = False, from_: Time = None, to: Time = None
    ) -> list[models.Mission]:
        """Return missions, newest first."""
        asked = {"name": name, "failed": failed, **_span(from_, to)}
        path = f"{_of(robot)}/missions"
        return [*paged(self.wire, path, models.Mission, lambda m: m.id, asked)]

    def begin_mission(
        self, robot: str, name: str, parameters: Mapping[str, Any] | None = None, at: Time = None
    ) -> models.Mission:
        """Begin a mission on the server."""
        body = {"name": name, "parameters": dict(parameters or {}), "at": time_text(at)}
        return self._send("POST", f"{_of(robot)}/missions", models.Mission, body)

    def end_mission(
        self, robot: str, mission: str, outcome: str = "done", at: Time = None
    ) -> models.Mission:
        """End a mission that was begun on the server."""
        path = f"{_of(robot)}/missions/{quote(mission, safe='')}/end"
        return self._send("POST", path, models.Mission, {"outcome": outcome, "at": time_text(at)})

    def notes(self, robot: str, from_: Time = None, to: Time = None) -> list[models.MomentNote]:
        """Return the notes of people on moments and on missions, newest first."""
        path = f"{_of(robot)}/notes"
        return [*paged(self.wire, path, models.MomentNote, lambda n: n.id, _span(from_, to))]

    def annotate(
        self, robot: str, text: str, at: Time = None, to: Time = None, about: str = ""
    ) -> models.MomentNote:
        """Add a note at a moment of a robot, or on a range until ``to``.

        ``about`` is an item, a variable or a component. The robot's record gets the note, too.
        """
        body = {"text": text, "at": time_text(at), "to": time_text(to), "about": about}
        return self._send("POST", f"{_of(robot)}/notes", models.MomentNote, body)

    def change_note(self, robot: str, note: str, text: str) -> models.MomentNote:
        """Change the text of a note, by its ``note``."""
        path = f"{_of(robot)}/notes/{quote(note, safe='')}"
        return self._send("POST", path, models.MomentNote, {"text": text})

    def withdraw_note(self, robot: str, note: str) -> models.MomentNote:
        """Withdraw a note, by its ``note``."""
        path = f"{_of(robot)}/notes/{quote(note, safe='')}/withdraw"
        return self._send("POST", path, models.MomentNote)

    def incidents(self, robot: str, from_: Time = None, to: Time = None) -> list[models.Incident]:
        """Return the pinned windows of a robot's record, newest first."""
        path = f"{_of(robot)}/incidents"
        return [*paged(self.wire, path, models.Incident, lambda i: i.id, _span(from_, to))]

    def mark_incident(self, robot: str, from_: Time, to: Time, reason: str) -> models.Incident:
        """Pin a window: the server keeps all data of it until the incident is released."""
        body = {**_span(from_, to), "reason": reason}
        return self._send("POST", f"{_of(robot)}/incidents", models.Incident, body)

    def release_incident(self, robot: str, incident: str) -> models.Incident:
        """Release a window that was pinned on the server."""
        path = f"{_of(robot)}/incidents/{quote(incident, safe='')}/release"
        return self._send("POST", path, models.Incident)

    def copy_again(self, robot: str, journal: str, store_id: str = "") -> models.CommandLine:
        """Let a robot send a journal (``folder/file``) again that is damaged on the server."""
        body = {"journal": journal, "store_id": store_id}
        return self._send("POST", f"{_of(robot)}/recordings/copy", models.CommandLine, body)

    def rotate(self, robot: str) -> models.CommandLine:
        """Let the recorder of a robot begin new files at once."""
        return self._send("POST", f"{_of(robot)}/recordings/rotate", models.CommandLine)

    def recordings(self, robot: str) -> list[models.Recording]:
        """Return the journals of a robot by name, with the results of their integrity checks."""
        path = f"{_of(robot)}/recordings"
        return [*paged(self.wire, path, models.Recording, lambda r: f"{r.store_id}/{r.journal}")]

    # Data still on the robot.

    def fetch(self, robot: str, item: str, from_: Time, to: Time) -> models.Fetch:
        """Request a window of an item from a robot; of all items with an empty name."""
        body = {"item": item, **_span(from_, to)}
        return self._send("POST", f"{_of(robot)}/fetches", models.Fetch, body)

    def fetches(self, robot: str) -> list[models.Fetch]:
        """Return the requests for windows to a robot, newest first."""
        path = f"{_of(robot)}/fetches"
        return [*paged(self.wire, path, models.Fetch, lambda f: f.id)]

    def fetched(self, robot: str, fetch: str) -> models.Fetch:
        """Return the progress of a request for a window."""
        return self._get(f"{_of(robot)}/fetches/{fetch}", models.Fetch)

    # Downloads.

    def start_download(
        self, robots: Sequence[str], items: Sequence[str] = (), *, format: str = "csv",
        from_: Time = None, to: Time = None, missions: Sequence[str] = (),
        variables: Mapping[str, Sequence[str]] | None = None,
    ) -> models.Download:  # fmt: skip
        """Start making a file on the server: ``csv``, ``parquet``, ``mcap`` or ``journals``."""
        body = {
            "robots": list(robots), "items": list(items), "missions": list(missions),
            "variables": {k: list(v) for k, v in (variables or {}).items()}, "format": format,
            **_span(from_, to),
        }  # fmt: skip
        return self._send("POST", "/downloads", models.Download, body)

    def downloads(self) -> list[models.Download]:
        """Return one's own downloads, newest first."""
        return [*paged(self.wire, "/downloads", models.Download, lambda d: d.id)]

    def download(self, download: str) -> models.Download:
        """Return the state of a download."""
        return self._get(f"/downloads/{download}", models.Download)

    def cancel_download(self, download: str) -> models.Download:
        """Cancel a download, or delete it when it is done."""
        return self._send("DELETE", f"/downloads/{download}", models.Download)

    def wait_download(
        self, download: str, progress: Progress | None = None, limit_s: float | None = None
    ) -> models.Download:
        """Wait until a download is ready; raises AmberboxError when it fails."""
        return wait_for_job(self, lambda: self.download(download), progress, limit_s)

    def save_download(
        self, download: str, target: Path | str, progress: Progress | None = None
    ) -> Path:
        """Save the file of a download; an interrupted one continues where it stopped."""
        found = self.download(download)
        return save_file(self, f"/downloads/{download}/file", found, Path(target), progress)

    # Models of detectors.

    def learn(
        self, robots: Sequence[str], *, name: str = "", missions: Sequence[str] = (),
        from_: Time = None, to: Time = None, detectors: Sequence[str] = (),
        false_alarms_per_hour: float = 1.0, options: Mapping[str, Any] | None = None,
        team: bool = False,
    ) -> models.LearntModel:  # fmt: skip
        """Start learning a model on the server from nominal missions of robots.

        It is the next version of ``name``. ``missions`` are names or ids, all that did not fail
        without; ``options`` are plain values by detector. Of a ``team`` the robots are learnt side
        by side.
        """
        body = {
            "robots": list(robots), "name": name, "missions": list(missions),
            "detectors": list(detectors), "false_alarms_per_hour": false_alarms_per_hour,
            "options": dict(options or {}), "team": team, **_span(from_, to),
        }  # fmt: skip
        return self._send("POST", "/models", models.LearntModel, body)

    def learnt_models(self, name: str = "") -> list[models.LearntModel]:
        """Return the models of the server, or the versions of one name, newest first."""
        answer = self.wire.get("/models", {"name": name} if name else None).body
        return [msgspec.convert(one, models.LearntModel) for one in msgspec.json.decode(answer)]

    def model(self, model: str) -> models.LearntModel:
        """Return the state of a model, by its id."""
        return self._get(f"/models/{model}", models.LearntModel)

    def detect(
        self, model: str, from_: Time, to: Time, robots: Sequence[str] = ()
    ) -> list[models.DetectorAlarmLine]:
        """Return the alarms of a model on what robots recorded; its own robots if none is named."""
        asked: dict[str, Any] = {**_span(from_, to), "robot": list(robots)}
        answer = self.wire.get(f"/models/{model}/alarms", asked).body
        return msgspec.json.decode(answer, type=list[models.DetectorAlarmLine])

    def follow_model(self, model: str, from_: Time = None) -> models.FollowingModel:
        """Let a model of a team follow its robots from a time on, now by default, unless it does.

        Returns how far it is, and its alarms.
        """
        body = {"from": time_text(from_)}
        return self._send("POST", f"/models/{model}/follow", models.FollowingModel, body)

    def following_model(self, model: str) -> models.FollowingModel:
        """Return how far a model that follows its robots is, and its alarms."""
        return self._get(f"/models/{model}/follow", models.FollowingModel)

    def unfollow_model(self, model: str) -> models.LearntModel:
        """Let a model follow no longer, and forget its alarms."""
        return self._send("DELETE", f"/models/{model}/follow", models.LearntModel)

    def delete_model(self, model: str) -> models.LearntModel:
        """Stop learning a model, or delete one that is over."""
        return self._send("DELETE", f"/models/{model}", models.LearntModel)

    def wait_model(
        self, model: str, progress: Progress | None = None, limit_s: float | None = None
    ) -> models.LearntModel:
        """Wait until a model is learnt; raises AmberboxError when it fails."""
        return wait_for_job(self, lambda: self.model(model), progress, limit_s)

    def save_model(self, model: str, target: Path | str, progress: Progress | None = None) -> Path:
        """Save the file of a model, and check its hash; an interrupted transfer continues."""
        found = self.model(model)
        path = f"/models/{model}/file"
        return save_file(self, path, found, Path(target), progress, found.sha256)

    # Diagnosis.

    def diagnoses(
        self, robot: str, from_: Time = None, to: Time = None
    ) -> list[models.DiagnosisLine]:
        """Return the diagnoses of a robot's watcher, newest first."""
        path = f"{_of(robot)}/diagnoses"
        return [*paged(self.wire, path, models.DiagnosisLine, lambda d: d.id, _span(from_, to))]

    def diagnosis(self, robot: str, diagnosis: str) -> dict[str, Any]:
        """Return a diagnosis with all revisions, answers and causes."""
        return self._get(f"{_of(robot)}/diagnoses/{quote(diagnosis, safe='')}", dict[str, Any])

    def diagnose(
        self, robot: str, at: Time = None, symptoms: Mapping[str, str] | None = None,
        answers: Mapping[str, str] | None = None, *, diagnosis: str = "",
        engine: str = "covering", exposure_h: float | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Return a diagnosis now, at a time, or with assumed symptoms and answers.

        The object is that of ``amberbox diagnose --json``.
        """
        body = {
            "at": time_text(at), "symptoms": dict(symptoms or {}), "answers": dict(answers or {}),
            "diagnosis": diagnosis, "engine": engine, "exposure_h": exposure_h,
        }  # fmt: skip
        return self._send("POST", f"{_of(robot)}/diagnose", dict[str, Any], body)

    def answer(self, robot: str, diagnosis: str, test: str, answer: str) -> dict[str, Any]:
        """Store the answer to a test; return the diagnosis with the new ranking."""
        path = f"{_of(robot)}/diagnoses/{quote(diagnosis, safe='')}/answers"
        return self._send("POST", path, dict[str, Any], {"test": test, "answer": answer})

    def cause(
        self, robot: str, diagnosis: str, failure_mode: str, note: str = ""
    ) -> dict[str, Any]:
        """Store what a diagnosis was in the end: a failure mode, or ``none`` for a false alarm."""
        path = f"{_of(robot)}/diagnoses/{quote(diagnosis, safe='')}/cause"
        return self._send(
            "POST", path, dict[str, Any], {"failure_mode": failure_mode, "note": note}
        )

    def fmea(self, robot: str, at: Time = None, exposure_h: float | None = None) -> dict[str, Any]:
        """Return the failure modes: ``table``, ``criticality`` and ``coverage``."""
        asked = {"at": time_text(at), "exposure_h": exposure_h}
        return self._get(f"{_of(robot)}/fmea", dict[str, Any], asked)

    def faulttrees(
        self, robot: str, effect: str = "", *, cut_sets: int = 100, order: int | None = None,
        at: Time = None, exposure_h: float | None = None, most_probable: int = 0,
    ) -> dict[str, Any]:  # fmt: skip
        """Return the fault trees of all functions, or one with its cut sets and importances."""
        asked = {"effect": effect, "cut_sets": cut_sets, "order": order, "at": time_text(at),
                 "exposure_h": exposure_h, "most_probable": most_probable}  # fmt: skip
        return self._get(f"{_of(robot)}/faulttrees", dict[str, Any], asked)

    def model_files(self, robot: str, at: Time = None) -> list[models.ModelLine]:
        """Return the models of a robot's folder, by kind and name, and what is wrong with them."""
        asked = {"at": time_text(at)}
        return self._get(f"{_of(robot)}/models", list[models.ModelLine], asked)

    def structure(
        self, robot: str, model: str = "", *, show: str = "faults", causality: str = "mixed",
        measurable: Sequence[str] = (), fallible: bool = False, most: int = 1000, at: Time = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Return what a model of equations can show: ``show`` is ``faults``, ``matrix``,
        ``residuals``, ``mso``, ``mtes`` or ``sensor_sets``, of which there are at most ``most``.
        """
        asked = {"model": model, "show": show, "causality": causality, "fallible": fallible,
                 "measurable": list(measurable), "most": most, "at": time_text(at)}  # fmt: skip
        return self._get(f"{_of(robot)}/structure", dict[str, Any], asked)

    def residual(
        self, robot: str, residual: str, model: str = "", *, from_: Time, to: Time,
        points: int = 500, at: Time = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Return the size of a residual over at most six hours, and its threshold.

        Of each step of ``step_s`` the size that is greatest by magnitude, at most ``points``.
        """
        asked = {"model": model, "residual": residual, "from": time_text(from_),
                 "to": time_text(to), "points": points, "at": time_text(at)}  # fmt: skip
        return self._get(f"{_of(robot)}/residual", dict[str, Any], asked)

    def consistency(
        self, robot: str, model: str = "", observe: Sequence[str] = (), *,
        minimal: str = "subset", most: int = 1000, at: Time = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Return which modes of a model of components agree with its steps and ``observe``.

        ``observe`` are texts ``component.port=value``.
        """
        asked = {"model": model, "observe": list(observe), "minimal": minimal, "most": most,
                 "at": time_text(at)}  # fmt: skip
        return self._get(f"{_of(robot)}/consistency", dict[str, Any], asked)

    def rules(
        self, robot: str, query: str, want: str = "why", from_: Time = None, to: Time = None,
        steps: int = 0,
    ) -> dict[str, Any]:  # fmt: skip
        """Return all answers of the robot's rules to a goal: ``answers``, ``proof``, ``failed``."""
        body = {"query": query, "want": want, **_span(from_, to), "steps": steps}
        return self._send("POST", f"{_of(robot)}/rules", dict[str, Any], body)

    # The server itself, and its feed of changes.

    def follow(
        self, robots: Sequence[str] | None = None, kinds: Sequence[str] | None = None,
        live: Mapping[str, Sequence[str]] | None = None,
    ) -> Iterator[Change]:  # fmt: skip
        """Yield changes, beginning with a snapshot (``transport.follow``); needs websockets."""
        from amberbox.client.transport import follow

        return follow(self.wire, robots, kinds, live)

    def audit(self, from_: Time = None, to: Time = None, limit: int = 100) -> list[models.AuditRow]:
        """Return rows of the audit log, newest first."""
        return self._get("/audit", list[models.AuditRow], {**_span(from_, to), "limit": limit})

    def metrics(self) -> str:
        """Return the metrics of the server in Prometheus' text format."""
        return self.wire.get("/metrics").body.decode()

    def _get(
        self, path: str, kind: type[_Answer], query: Mapping[str, Any] | None = None
    ) -> _Answer:
        return msgspec.json.decode(self.wire.get(path, query).body, type=kind)

    def _send(self, method: str, path: str, kind: type[_Answer], body: Any = None) -> _Answer:
        return msgspec.json.decode(self.wire.send(method, path, body).body, type=kind)


def _of(robot: str) -> str:
    return f"/robots/{quote(robot, safe='')}"


def _span(from_: Time, to: Time) -> dict[str, str]:
    return {"from": time_text(from_), "to": time_text(to)}
