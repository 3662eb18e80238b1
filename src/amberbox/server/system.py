"""Monitoring of teams and of the whole system on the server, from their robot folders."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.robot_folder.folder import BLACK_BOX_FILE, ROBOT_FILE, inspect_folder
from amberbox.blackbox.store.own_records import newest_records
from amberbox.blackbox.store.store import FOLDERS, create_store, is_store, open_store
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.names import is_id
from amberbox.core.pacing import Backoff
from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.current_state import WRITER as WATCHER
from amberbox.monitoring.current_state import findings_until
from amberbox.monitoring.findings import status_of
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.ingest.link_server import LinkServer
from amberbox.server.knowledge.diagnoses import DiagnosisHistory

_SECONDS = 60.0
_STORE = "store"


class _Report(msgspec.Struct):
    problems: list[Problem] = []


@dataclass
class FolderChecks:
    """Caches the problems found in each folder."""

    _known: dict[Path, tuple[float, tuple[Problem, ...]]] = field(default_factory=dict)

    async def of(self, folder: Path) -> tuple[Problem, ...]:
        """Return the problems of a folder; code that it contains runs in a separate process."""
        changed = await asyncio.to_thread(_changed, folder)
        known = self._known.get(folder)
        if known is None or known[0] != changed:
            self._known[folder] = known = changed, tuple(await _check(folder))
        return known[1]


def _changed(folder: Path) -> float:
    """Return when a file of the folder last changed (s since the epoch), its store left out."""
    times = [folder.stat().st_mtime]
    for path in folder.iterdir():
        if path.name == _STORE or path.name.startswith("."):
            continue
        times.append(path.stat().st_mtime)
        times += [below.stat().st_mtime for below in path.rglob("*") if path.is_dir()]
    return max(times)


async def _check(folder: Path) -> Sequence[Problem]:
    command = (sys.executable, "-m", "amberbox", "check", "--json", str(folder))
    process = await asyncio.create_subprocess_exec(
        *command, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    try:
        async with asyncio.timeout(_SECONDS):
            out, _ = await process.communicate()
        return msgspec.json.decode(out, type=_Report).problems
    except (TimeoutError, msgspec.MsgspecError):
        what = "could not be checked: 'amberbox check' of it does not end, or says nothing"
        return [Problem(str(folder), 1, "folder", what)]
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


SYSTEM, TEAMS, MEMBERS = "system", "teams", "members"
_STATUS = "status"


@dataclass(frozen=True, slots=True)
class LevelFolder:
    """A robot folder of a team or of the system, and its members.

    ``store`` is the path of its recording; None where its sources cannot be read.
    """

    name: str
    path: Path
    members: frozenset[str] = frozenset()
    store: Path | None = None
    problems: tuple[Problem, ...] = ()


def paths(root: Path) -> dict[str, Path]:
    """Return the existing folders by name: teams, then the system."""
    found = {path.name: path for path in sorted((root / TEAMS).glob("*")) if is_id(path.name)}
    known = {**found, SYSTEM: root / SYSTEM}
    return {name: path for name, path in known.items() if _is_folder(path)}


def look(root: Path, name: str, path: Path) -> LevelFolder:
    """Read the sources of a folder; returns an empty description for wrong files."""
    try:
        folder, _ = inspect_folder(path)
    except (AmberboxError, OSError):
        folder = None
    if folder is None:
        return LevelFolder(name, path)
    return LevelFolder(name, path, frozenset(_members(root, folder.blocks)), folder.store_path)


def _members(root: Path, blocks: Any) -> Iterator[str]:
    """Yield the robots whose statuses the folder reads from stores that the server fills."""
    for block in blocks:
        if block.plugin == _STATUS:
            where = Path(block.config.where).absolute().resolve()
            if where.parent == (root / MEMBERS).resolve() and is_id(where.name):
                yield where.name


def _is_folder(path: Path) -> bool:
    return any((path / name).is_file() for name in (ROBOT_FILE, BLACK_BOX_FILE))


WRITER = "watch"
CHANNELS = (channels.STATUS, channels.ALARM)
# Number of journals kept per member; older data are in the archive
KEPT_FILES = 3
_ROTATE_BYTES = 4_000_000


@dataclass(frozen=True, slots=True)
class MemberRecord:
    """A present record of a member, timed by the member's own clock."""

    channel: str
    log_ns: int
    data: bytes


class MemberStore:
    """A store with the layout of the member's own, holding its watcher's present records only."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self.store = create_store(path)
        folder = path / FOLDERS[WRITER]
        options = JournalOptions(
            folder, self.store.id, WRITER, self.store.next_run(), clock.boot_id(), _ROTATE_BYTES
        )
        self._writer = JournalWriter(options)
        self._numbers = {name: self._channel(name) for name in CHANNELS}
        self._last_ns = 0

    def write(self, records: Sequence[MemberRecord]) -> None:
        """Write records; their times never decrease."""
        if not records:
            return
        if self._writer.rotation_due(records[0].log_ns):
            self._rotate()
        times = list(
            itertools.accumulate((one.log_ns for one in records), max, initial=self._last_ns)
        )
        self._last_ns = times[-1]
        numbers = [self._numbers[one.channel] for one in records]
        self._writer.write(numbers, times[1:], times[1:], [one.data for one in records])

    def close(self) -> None:
        """Close the journal."""
        self._writer.close()

    def _rotate(self) -> None:
        self._writer.rotate()
        self._writer.mark_sync().wait()
        for path in self.store.journal_files(WRITER)[:-KEPT_FILES]:
            path.unlink(missing_ok=True)

    def _channel(self, name: str) -> int:
        marks = {"item": name.replace("/", "_"), "source": channels.SOURCE}
        return self._writer.channel(channels.topic_of(name), marks)


# Records that arrive later than this are past: they are archived, but not used by teams
FRESH_NS = 10 * NS
_SETTLED_NS = 3 * NS
_FEW_ROWS = 200


@dataclass
class RecordLateness:
    """Estimates how late a robot's records arrive, from the offset of its clock.

    ``ahead_ns`` is by how much the server's clock was ahead at the robot's hello. The robot's log
    time may differ from its clock after that was set; if the robot has no backlog, its records are
    taken as present, whatever their log time.
    """

    ahead_ns: int
    since_ns: int
    _of_run: dict[tuple[str, int], int] = field(default_factory=dict)

    def of(self, run: tuple[str, int], log_ns: int, now_ns: int, backlog: int) -> int:
        """Return how late a record of the watcher's run is, in nanoseconds."""
        lag_ns = now_ns - log_ns
        known = self._of_run.get(run, self.ahead_ns)
        settled = now_ns - self.since_ns > _SETTLED_NS and backlog <= _FEW_ROWS
        if settled and abs(lag_ns - known) > FRESH_NS:
            known = self._of_run[run] = lag_ns
        return max(0, lag_ns - known)


State = Literal["off", "running", "waiting"]
HEALTHY_S = 60.0
END_S = 12.0


def command_of(folder: Path) -> list[str]:
    """Return the command that runs a folder's recorder and monitors."""
    return [sys.executable, "-m", "amberbox.server.systemchild", str(os.getpid()), str(folder)]


@dataclass
class FolderRunner:
    """One folder and its process; ``trouble`` is its last error message."""

    folder: Path
    command: Sequence[str] = ()
    backoff: Backoff = field(default_factory=lambda: Backoff(least_s=1.0, most_s=60.0))
    state: State = "off"
    restarts: int = 0
    trouble: str = ""
    _process: asyncio.subprocess.Process | None = None

    async def run(self) -> None:
        """Run the process until cancelled, restarting it; terminate it then, or kill it if it does
        not end.
        """
        loop = asyncio.get_running_loop()
        while True:
            began_s = loop.time()
            try:
                await self._once()
            except OSError as error:
                self.trouble = f"cannot be started: {error.strerror}"
            if loop.time() - began_s > HEALTHY_S:
                self.backoff.succeeded()
            self.state, self.restarts = "waiting", self.restarts + 1
            await asyncio.sleep(self.backoff.failed())

    async def _once(self) -> None:
        process = self._process = await asyncio.create_subprocess_exec(
            *(self.command or command_of(self.folder)), stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        self.state = "running"
        try:
            await self._listen(process)
            status = await process.wait()
            self.trouble = self.trouble or f"it ended with status {status}"
        finally:
            await _end(process)
            self._process = None
            self.state = "off"

    async def _listen(self, process: asyncio.subprocess.Process) -> None:
        """Read its stderr, so that it never blocks on a full pipe; keep the last error message."""
        assert process.stderr is not None
        while line := await _line(process.stderr):
            text = line.decode("utf-8", "replace").strip()
            if "error:" in text:
                self.trouble = text.partition("error:")[2].strip()[:500]

    def kill(self) -> None:
        """Terminate the process after the event loop has ended."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGTERM)


async def _line(stream: asyncio.StreamReader) -> bytes:
    try:
        return await stream.readline()
    except ValueError:  # a line longer than the buffer
        return b"..."


async def _end(process: asyncio.subprocess.Process) -> None:
    """Terminate a process, and kill it when it does not end in time."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(END_S):
            await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


_LOOKBACK_S = 3.0
_FOREVER_NS = (1 << 63) - 1


def statuses(store: Path | None) -> list[Status]:
    """Return the newest status of each component and mode; empty without a store."""
    if store is None or not is_store(store):
        return []
    found = newest_records(open_store(store), WATCHER, {channels.STATUS}, _LOOKBACK_S)
    reported = (status_of(record.values) for record in found)
    newest = {(status.component, status.mode): status for status in reported}
    return [newest[key] for key in sorted(newest)]


def diagnoses(store: Path | None) -> list[DiagnosisHistory]:
    """Return the diagnoses in the watcher's journal, newest first."""
    if store is None or not is_store(store):
        return []
    found = _by_id(findings_until(open_store(store), _FOREVER_NS).diagnoses)
    return sorted(found, key=lambda one: (-one.last.at_ns, one.id))


def _by_id(diagnoses: Iterable[Diagnosis]) -> list[DiagnosisHistory]:
    by_id: dict[str, dict[tuple[int, str], Diagnosis]] = {}
    for diagnosis in diagnoses:
        revisions = by_id.setdefault(diagnosis.id, {})
        revisions.setdefault((diagnosis.revision, diagnosis.state), diagnosis)
    return [DiagnosisHistory(name, tuple(revisions.values())) for name, revisions in by_id.items()]


_LOOK_S = 10.0
_WRITE_S = 0.2
# Largest number of member records that wait to be written; the oldest are dropped
_WAITING = 20_000


@dataclass(frozen=True, slots=True)
class WatchedFolder:
    """A team or system folder in its present version, and the state of its process."""

    place: LevelFolder
    state: State
    restarts: int
    trouble: str


class SystemLevel:
    """Runs the monitoring of teams and the system on the server.

    Members' statuses are written, as they arrive, to stores laid out like robots' own; ``amberbox
    run`` of each folder reads them there.
    """

    def __init__(self, folder: Path, bus: EventBus, clock: Clock, links: LinkServer) -> None:
        self._folder = folder
        self._clock = clock
        self._links = links
        self._members: dict[str, MemberStore] = {}
        self._wanted: frozenset[str] = frozenset()
        self._late: dict[str, RecordLateness] = {}
        self._waiting: dict[str, list[MemberRecord]] = {}
        self._places: dict[str, LevelFolder] = {}
        self._runners: dict[str, FolderRunner] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._checks = FolderChecks()
        self._ends = [bus.on("connected", self._connected), bus.on("rows", self._rows)]

    async def run(self) -> None:
        """Search for folders periodically, run them, and record what their members send."""
        writing = asyncio.create_task(self._write_on())
        try:
            while True:
                await self.look()
                await asyncio.sleep(_LOOK_S)
        finally:
            writing.cancel()
            for task in self._tasks.values():
                task.cancel()
            await asyncio.gather(writing, *self._tasks.values(), return_exceptions=True)
            self._tasks.clear()

    def close(self) -> None:
        """Remove the listeners, end the processes and close the members' stores."""
        for end in self._ends:
            end()
        for runner in self._runners.values():
            runner.kill()
        for member in self._members.values():
            with contextlib.suppress(OSError):
                member.close()
        self._members.clear()

    def watched(self) -> list[WatchedFolder]:
        """Return the team and system folders, teams first."""
        found = []
        for name, place in self._places.items():
            runner = self._runners.get(name, FolderRunner(place.path))
            found.append(WatchedFolder(place, runner.state, runner.restarts, runner.trouble))
        return found

    async def look(self) -> None:
        """Read which folders exist and who their members are; start and stop processes to match."""
        there = await asyncio.to_thread(paths, self._folder)
        found = {
            name: await asyncio.to_thread(look, self._folder, name, path)
            for name, path in there.items()
        }
        self._wanted = frozenset[str]().union(*(place.members for place in found.values()))
        await asyncio.to_thread(self._open)
        for name, place in found.items():
            found[name] = replace(place, problems=await self._checks.of(place.path))
        self._places = found
        for name, place in found.items():
            if name not in self._tasks and place.store is not None:
                runner = self._runners.setdefault(name, FolderRunner(place.path))
                self._tasks[name] = asyncio.create_task(runner.run())
        for name in [name for name in self._tasks if name not in found]:
            self._tasks.pop(name).cancel()
            self._runners.pop(name).state = "off"

    def _open(self) -> None:
        for robot in self._wanted - self._members.keys():
            path = self._folder / MEMBERS / robot
            with contextlib.suppress(AmberboxError, OSError):  # tried again at the next look
                self._members[robot] = MemberStore(path, self._clock)

    def _connected(self, change: ServerChange) -> None:
        now_ns = self._clock.wall_ns()
        ahead_ns = now_ns - change.data["hello"].wall_ns
        self._late[change.robot] = RecordLateness(ahead_ns, now_ns)

    def _rows(self, change: ServerChange) -> None:
        """Queue a change's present records; a thread writes them."""
        robot, late = change.robot, self._late.get(change.robot)
        if robot not in self._wanted or late is None:
            return
        now_ns, one = self._clock.wall_ns(), self._links.robots.get(robot)
        backlog = 0 if one is None else one.backlog
        waiting = self._waiting.setdefault(robot, [])
        for row in change.data["rows"]:
            if row.channel in CHANNELS and row.writer == "watch":
                run = change.data["store_id"], row.run
                late_ns = late.of(run, row.log_ns, now_ns, backlog)
                if late_ns <= FRESH_NS:
                    waiting.append(MemberRecord(row.channel, row.log_ns + late_ns, row.data))
        del waiting[:-_WAITING]

    async def _write_on(self) -> None:
        while True:
            await asyncio.sleep(_WRITE_S)
            waiting, self._waiting = self._waiting, {}
            if waiting:
                await asyncio.to_thread(partial(self._write, waiting))

    def _write(self, waiting: Mapping[str, list[MemberRecord]]) -> None:
        for robot, records in waiting.items():
            member = self._members.get(robot)
            if member is not None:
                with contextlib.suppress(OSError):  # the disk is full: the members go stale
                    member.write(records)
