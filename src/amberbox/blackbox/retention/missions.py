"""Missions: intervals of the record that have a name, an outcome and parameters.

Edges of conditions begin and end missions by rule (``MissionTracker``); people and programs do so
by request, through the maintenance process or in its place (``MissionService``).
"""

from __future__ import annotations

import bisect
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.columns.table_text import plain
from amberbox.blackbox.journal import channels
from amberbox.blackbox.retention.live_reader import LiveReader, RunSlice
from amberbox.blackbox.robot_folder.robot_yaml import MissionRule
from amberbox.blackbox.store.catalogue import StoreCatalogue, query_catalogue, read_catalogue
from amberbox.blackbox.store.clocks import ClockBook
from amberbox.blackbox.store.derived_journal import (
    ChannelValues,
    DerivedJournal,
    ReaderProgress,
    event,
    last_progress,
)
from amberbox.blackbox.store.journal_reader import previous_chain
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import (
    Store,
    StoreRequest,
    WriterLock,
    finish,
    is_locked,
    open_store,
    pending,
    store_path,
    submit,
)
from amberbox.blackbox.store.table_reader import RowRequest, gather
from amberbox.core.clock import NS, SystemClock
from amberbox.core.conditions import ConditionWatcher, RisingEdge, WatchedCondition
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.expression import Value, parse
from amberbox.core.names import derive_id, is_id
from amberbox.core.timestamps import format_time

# Outcomes that count as failures unless stated otherwise
FAILED = frozenset({"failed", "aborted", "timeout", "error"})
DONE, SUPERSEDED, TIMEOUT = "done", "superseded", "timeout"

_FIELDS = ("id", "name", "state", "outcome", "from_ns", "to_ns", "who", "details")


@dataclass(frozen=True, slots=True)
class MissionInstant:
    """The time of a moment as known then, and the position from which it can be corrected later.

    Either ``run`` and log time are known, or the boot and the time since then; or neither.
    """

    received_ns: int
    run: int | None = None
    log_ns: int = 0
    boot: str = ""
    boot_ns: int = 0

    def corrected_ns(self, book: ClockBook) -> int:
        """Return the time of receipt (ns) by the present knowledge of the clocks."""
        if self.run is not None:
            found = book.received_ns(self.run, self.log_ns)
            return self.received_ns if found is None else found
        clock = book.boots.get(self.boot)
        return self.received_ns if clock is None else clock.wall_ns(self.boot_ns)


@dataclass(frozen=True, slots=True)
class RecordedMission:
    """One interval; ``name`` is its kind (transport), ``to_ns`` is None while it lasts.

    Times are nanoseconds since the Unix epoch. ``failed`` and ``outcome`` are known at the end.
    """

    id: str
    name: str
    start: MissionInstant
    end: MissionInstant | None = None
    outcome: str = ""
    failed: bool = False
    who: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def from_ns(self) -> int:
        """Return when it began, ns."""
        return self.start.received_ns

    @property
    def to_ns(self) -> int | None:
        """Return when it ended, ns: the first instant that does not belong to it."""
        return None if self.end is None else self.end.received_ns

    def ended(
        self, end: MissionInstant, outcome: str, failed: bool | None = None
    ) -> RecordedMission:
        """Return the mission with its end and outcome."""
        judged = outcome in FAILED if failed is None else failed
        return replace(self, end=end, outcome=outcome, failed=judged)

    def corrected(self, book: ClockBook) -> RecordedMission:
        """Return the mission with times corrected by the present knowledge of the clocks."""
        start = replace(self.start, received_ns=self.start.corrected_ns(book))
        if self.end is None:
            return replace(self, start=start)
        end_ns = max(self.end.corrected_ns(book), start.received_ns)
        return replace(self, start=start, end=replace(self.end, received_ns=end_ns))

    def record(self) -> tuple[str, dict[str, Any]]:
        """Return its record for the maintenance journal: that it began, or how it ended."""
        details = {
            "failed": self.failed,
            "parameters": dict(self.parameters),
            "start": msgspec.to_builtins(self.start),
            "end": msgspec.to_builtins(self.end),
        }
        return channels.MISSION, {
            "id": self.id,
            "name": self.name,
            "state": "started" if self.end is None else "ended",
            "outcome": self.outcome,
            "from_ns": self.from_ns,
            "to_ns": self.to_ns,
            "who": self.who,
            "details": msgspec.json.encode(details).decode(),
        }

    def to_json(self) -> dict[str, Any]:
        """Return the mission as JSON has it: times are RFC 3339 strings."""
        return {
            "id": self.id,
            "name": self.name,
            "from": format_time(self.from_ns),
            "to": None if self.to_ns is None else format_time(self.to_ns),
            "outcome": self.outcome,
            "failed": self.failed,
            "who": self.who,
            "parameters": dict(self.parameters),
        }


def book_of_store(store: Path) -> ClockBook:
    """Return the present clock book of a store."""
    return read_catalogue(store, with_segments=can_build()).book


def load(store: Path) -> list[RecordedMission]:
    """Return all missions of a store in order of their start, with corrected times."""
    return query_catalogue(store, _load, with_segments=can_build())


def _load(catalogue: StoreCatalogue) -> list[RecordedMission]:
    table = next((n for n, v in catalogue.schemas.items() if v[-1].topic == channels.MISSION), None)
    if table is None:
        return []
    found: dict[str, RecordedMission] = {}
    pieces = gather(catalogue, RowRequest(table, _FIELDS)).pieces
    for piece in sorted(pieces, key=lambda piece: (piece.run, int(piece.seq[0]))):
        for row in zip(*(plain(piece.columns[name]) for name in _FIELDS), strict=True):
            mission = of_record(dict(zip(_FIELDS, row, strict=True)))
            if mission.id not in found or found[mission.id].end is None:
                found[mission.id] = mission
    corrected = (mission.corrected(catalogue.book) for mission in found.values())
    return sorted(corrected, key=lambda mission: (mission.from_ns, mission.id))


def of_record(row: Mapping[str, Any]) -> RecordedMission:
    """Return the mission of a record in the maintenance journal."""
    details = msgspec.json.decode(row["details"] or "{}")
    start = msgspec.convert(details.get("start") or {"received_ns": row["from_ns"]}, MissionInstant)
    end = details.get("end")
    return RecordedMission(
        row["id"],
        row["name"],
        start,
        None if end is None else msgspec.convert(end, MissionInstant),
        row["outcome"],
        bool(details.get("failed")),
        row["who"],
        details.get("parameters") or {},
    )


def choose(
    missions: Iterable[RecordedMission],
    name: str | None = None,
    *,
    failed: bool = False,
    last: int | None = None,
    span: tuple[int | None, int | None] = (None, None),
) -> list[RecordedMission]:
    """Return missions by name, failed ones, those that overlap ``[from, to)``, or the last few."""
    from_ns, to_ns = span
    chosen = [
        mission
        for mission in missions
        if (name is None or mission.name == name)
        and (mission.failed or not failed)
        and (to_ns is None or mission.from_ns < to_ns)
        and (from_ns is None or mission.to_ns is None or mission.to_ns > from_ns)
    ]
    return chosen if last is None else chosen[max(len(chosen) - last, 0) :]


def missions_named(missions: Sequence[RecordedMission], text: str) -> list[RecordedMission]:
    """Return the missions of ``ID``, ``last``, ``last:3``, ``failed:3`` or ``transport:3``.

    Raises UsageError when there is no such mission.
    """
    for mission in missions:
        if mission.id == text:
            return [mission]
    word, _, number = text.partition(":")
    if number and not (number.isdigit() and int(number)):
        raise UsageError(f"'{text}': after ':' comes how many", "such as last:3 or failed:1")
    kind = None if word in ("last", "failed") else word
    found = choose(missions, kind, failed=word == "failed", last=int(number or 1))
    if found:
        return found
    known = sorted({*(m.id for m in missions), *(m.name for m in missions)})
    hint = "amberbox mission list WHERE shows them" if missions else "there are none yet"
    if missions and word == "failed":
        raise UsageError("no mission has failed", hint)
    raise UsageError(f"there is no mission '{text}'{did_you_mean(text, known)}", hint)


# Turns a time of the conditions into an instant of the record
WhenIs = Callable[[int], MissionInstant]

RULE = "rule"  # ``who`` of the missions that rules find

_PARAMETER = "parameter "
_EVER_NS = 1 << 62


def conditions_of(rules: Sequence[MissionRule]) -> ConditionWatcher:
    """Compile the conditions of rules; raises ExpressionError for an unreadable one."""
    found: dict[str, WatchedCondition] = {}
    for rule in rules:
        starts = {_PARAMETER + key: parse(text) for key, text in rule.parameters.items()}
        ends = {"failed": rule.failed, "outcome": rule.outcome}
        found[f"{rule.name}:end"] = WatchedCondition(
            parse(rule.end), {key: parse(text) for key, text in ends.items() if text}
        )
        found[f"{rule.name}:start"] = WatchedCondition(parse(rule.start), starts)
    return ConditionWatcher(found)


def id_of(name: str, from_ns: int) -> str:
    """Make the id of a mission out of its name and start, to the millisecond, UTC."""
    day, _, rest = format_time(from_ns)[:23].partition("T")
    return derive_id(f"{name}-{day.replace('-', '')}t{rest.replace(':', '')}")


class MissionTracker:
    """The missions of a store; edges of conditions and people begin and end them.

    ``book`` is called where the clock may have been set since a mission began.
    """

    def __init__(
        self,
        rules: Sequence[MissionRule],
        known: Iterable[RecordedMission] = (),
        book: Callable[[], ClockBook] = ClockBook,
    ) -> None:
        self._book = book
        self._rules = {rule.name: rule for rule in rules}
        self._known = {mission.id: mission for mission in known}

    @property
    def open(self) -> list[RecordedMission]:
        """Return the missions that last, oldest first."""
        return [mission for mission in self._known.values() if mission.end is None]

    def start(self, mission: RecordedMission) -> list[RecordedMission]:
        """Begin a mission and end an open one of that name; return both.

        A mission that is already known changes nothing.
        """
        if mission.id in self._known:
            return []
        before = [m for m in self.open if m.name == mission.name]
        changed = [self._ended(m, mission.start, SUPERSEDED, False) for m in before]
        self._known[mission.id] = mission
        return [*changed, mission]

    def end(
        self,
        mission: RecordedMission,
        end: MissionInstant,
        outcome: str,
        failed: bool | None = None,
    ) -> list[RecordedMission]:
        """End a mission that lasts; it cannot end before it began."""
        if self._known.get(mission.id) != mission or mission.end is not None:
            return []
        return [self._ended(mission, end, outcome, failed)]

    def take(self, edges: Iterable[RisingEdge], when: WhenIs) -> list[RecordedMission]:
        """Begin and end missions at edges of ``conditions_of``; return what changed, in order."""
        changed: list[RecordedMission] = []
        for edge in edges:
            name, _, what = edge.name.rpartition(":")
            moment = when(edge.at_ns)
            changed += self.expire(moment)
            if what == "start":
                changed += self._begin(name, moment, edge)
            else:
                changed += self._finish(name, moment, edge)
        return changed

    def expire(self, now: MissionInstant) -> list[RecordedMission]:
        """End missions that have lasted for longer than their rule allows."""
        changed: list[RecordedMission] = []
        for mission in self.open:
            rule = self._rules.get(mission.name)
            if mission.who == RULE and rule is not None and rule.max_s is not None:
                limit_ns = round(rule.max_s * NS)
                late_ns = self._since_ns(mission, now, limit_ns) - limit_ns
                if late_ns > 0:
                    changed += self.end(mission, _earlier(now, late_ns), TIMEOUT)
        return changed

    def _begin(self, name: str, moment: MissionInstant, edge: RisingEdge) -> list[RecordedMission]:
        values = edge.values.items()
        parameters = {k.removeprefix(_PARAMETER): v for k, v in values if v is not None}
        mission_id = id_of(name, moment.received_ns)
        return self.start(
            RecordedMission(mission_id, name, moment, who=RULE, parameters=parameters)
        )

    def _finish(self, name: str, moment: MissionInstant, edge: RisingEdge) -> list[RecordedMission]:
        changed: list[RecordedMission] = []
        for mission in [m for m in self.open if m.name == name and m.who == RULE]:
            if self._since_ns(mission, moment, _EVER_NS) >= 0:
                outcome, failed = _judged(edge.values.get("outcome"), edge.values.get("failed"))
                changed += self.end(mission, moment, outcome, failed)
        return changed

    def _since_ns(self, mission: RecordedMission, now: MissionInstant, limit_ns: int) -> int:
        """Return how long a mission has lasted, by corrected times if the clock was set."""
        since_ns = now.received_ns - mission.from_ns
        if 0 <= since_ns <= limit_ns:
            return since_ns
        book = self._book()
        return now.corrected_ns(book) - mission.start.corrected_ns(book)

    def _ended(
        self, mission: RecordedMission, end: MissionInstant, outcome: str, failed: bool | None
    ) -> RecordedMission:
        self._known[mission.id] = mission.ended(end, outcome, failed)
        return self._known[mission.id]


def _judged(outcome: Value, failed: Value) -> tuple[str, bool | None]:
    """Return outcome and failure: as the rule states, else from whether it failed."""
    if outcome is None:
        return ("failed" if failed is True else DONE), failed is True
    text = outcome if isinstance(outcome, str) else f"{outcome}"
    return text, None if failed is None else failed is True


def _earlier(moment: MissionInstant, by_ns: int) -> MissionInstant:
    return replace(
        moment, received_ns=moment.received_ns - by_ns, log_ns=moment.log_ns - by_ns,
        boot_ns=moment.boot_ns - by_ns,
    )  # fmt: skip


KIND = "mission"
READER = "missions"
_LOOK_BACK_NS = 2 * NS
_SAVE_NS = 600 * NS


class MissionService:
    """Begins and ends missions of one store; ``step`` does the work due now.

    The caller holds the maintenance lock.
    """

    def __init__(
        self, store: Store, rules: Sequence[MissionRule] = (), journal: DerivedJournal | None = None
    ) -> None:
        self._store = store
        self._journal = journal or DerivedJournal(store, "keep")
        self._rules = rules
        self._tracker: MissionTracker | None = None
        self._follower: _Follower | None = None
        self._logged: set[str] = set()
        self._unwritten: list[ChannelValues] = []
        self._answers: dict[Path, list[ChannelValues]] = {}
        self._saved_ns = self._journal.now_ns()

    def step(self) -> None:
        """Handle requests, then evaluate rules along the record; after a full disk, try later."""
        self._take_requests()
        if self._rules:
            self._follow()

    def close(self) -> None:
        """Write down how far the record was read."""
        if self._follower is not None and self._follower.has_read:
            self._write_progress(self._follower)

    def note(self, missions: Sequence[RecordedMission]) -> None:
        """Write missions into the journal."""
        self._journal.write([mission.record() for mission in missions])

    def _take_requests(self) -> None:
        for request in pending(self._store):
            if request.kind != KIND:
                continue
            if request.path not in self._answers:
                records: list[ChannelValues] = [m.record() for m in self._answer_to(request)]
                self._answers[request.path] = records or [_refusal(request)]
            with suppress(OSError):  # then it is done at the next step
                self._journal.write(self._answers[request.path])
                finish(request)
                del self._answers[request.path]

    def _answer_to(self, request: StoreRequest) -> list[RecordedMission]:
        values, boot = request.values, str(request.values.get("boot_id", ""))[:8]
        moment = MissionInstant(request.wall_ns, boot=boot, boot_ns=request.boot_ns)
        if values.get("action") == "start":
            name = str(values.get("name", ""))
            return self._known().start(_started(name, values, moment)) if name else []
        wanted = str(values.get("id", ""))
        mission = next((m for m in self._known().open[::-1] if wanted in ("", m.id)), None)
        if mission is None:
            return []
        failed = values.get("failed")
        outcome = str(values.get("outcome") or ("failed" if failed else DONE))
        return self._known().end(mission, moment, outcome, failed)

    def _known(self) -> MissionTracker:
        if self._tracker is None:
            known = load(self._store.path)
            self._tracker = MissionTracker(
                self._rules, known, lambda: book_of_store(self._store.path)
            )
        return self._tracker

    def _follow(self) -> None:
        if self._follower is None:
            self._follower = _Follower(self._store, self._rules)
        is_idle = not is_locked(self._store, "main")  # before reading: then nothing is missed
        changed = self._follower.step(self._known())
        if is_idle:
            clock = self._journal.clock
            now = MissionInstant(clock.wall_ns(), boot=clock.boot_id()[:8], boot_ns=clock.boot_ns())
            changed += self._known().expire(now)
        self._unwritten += [mission.record() for mission in changed]
        for name, what in self._follower.problems.items():
            if name not in self._logged:
                self._logged.add(name)
                self._unwritten.append(
                    event("mission_rule", f"missions: {name}: {what}", rule=name)
                )
        now_ns = self._journal.now_ns()
        due = self._unwritten or now_ns - self._saved_ns > _SAVE_NS
        if due and self._follower.has_read and self._write_progress(self._follower):
            self._saved_ns = now_ns

    def _write_progress(self, follower: _Follower) -> bool:
        """Write the missions found and the reading position; return False if the disk is full."""
        try:
            self._journal.write(self._unwritten, follower.progress())
        except OSError:
            return False
        self._unwritten = []
        return True


class _Follower:
    """Follows the record for the rules, from where it was left."""

    def __init__(self, store: Store, rules: Sequence[MissionRule]) -> None:
        self._conditions = conditions_of(rules)
        self.problems = self._conditions.problems
        before = last_progress(store, "keep", READER)
        self._left = msgspec.json.decode(before.state or "{}") if before else {}
        cursor = before.cursor if before else None
        look_back_s = (self._conditions.history_ns + _LOOK_BACK_NS) / NS if cursor else 0.0
        self._reading = LiveReader(store, self._conditions.items, cursor, look_back_s)
        self._run: int | None = None
        self._at = (0, 0)
        self._offset_ns = 0
        self.has_read = False

    def step(self, tracker: MissionTracker) -> list[RecordedMission]:
        """Read on; return the missions that began or ended."""
        changed: list[RecordedMission] = []
        parts = self._reading.step()
        for part in parts:
            # a run before the one in which this was left is read again
            if self._run is None and part.run < self._left.get("run", 0):
                continue
            until_ns = part.until_ns - (part is parts[-1])  # more may come of the very instant
            self._enter(part)
            for batch, times_ns in part.batches:
                self._conditions.add(batch, times_ns)
            offsets = _Offsets(part, self._offset_ns)
            self._offset_ns = offsets.last_ns
            edges = self._conditions.edges(until_ns)
            changed += tracker.take(edges, offsets.moment)
            changed += tracker.expire(offsets.moment(until_ns))
            self._at = part.run, part.axis.log_of(until_ns)
            self.has_read = True
        return changed

    def progress(self) -> ReaderProgress:
        """Return the reading position and the conditions that were true there."""
        run, log_ns = self._at
        state = {"run": run, "log_ns": log_ns, "true": self._conditions.true}
        return ReaderProgress(self._reading.cursor(), READER, msgspec.json.encode(state).decode())

    def _enter(self, part: RunSlice) -> None:
        if part.run == self._run:
            return
        if self._run is not None:
            self._conditions.begin_anew()
        elif self._left.get("run") == part.run:
            self._conditions.resume(self._left["true"], part.left_ns(self._left["log_ns"]))
        else:
            self._conditions.resume(self._left.get("true", ()))
        self._run = part.run


class _Offsets:
    """Times of receipt of a part, as they were known when it was read."""

    def __init__(self, part: RunSlice, before_ns: int) -> None:
        self._part = part
        rows = [
            (int(times_ns[-1]), int(batch.received_ns[-1] - batch.log_time_ns[-1]))
            for batch, times_ns in part.batches
            if len(times_ns)
        ]
        self._rows = sorted(rows) or [(0, before_ns)]
        self.last_ns = self._rows[-1][1]

    def moment(self, time_ns: int) -> MissionInstant:
        """Return the moment of the record at a time of the axis."""
        at = self._part.moment(time_ns)
        place = min(bisect.bisect_left(self._rows, (time_ns,)), len(self._rows) - 1)
        return MissionInstant(at.log_ns + self._rows[place][1], at.run, at.log_ns)


def _started(name: str, values: Mapping[str, Any], moment: MissionInstant) -> RecordedMission:
    mission_id = str(values.get("id") or id_of(name, moment.received_ns))
    parameters = dict(values.get("parameters") or {})
    return RecordedMission(
        mission_id, name, moment, who=str(values.get("who", "")), parameters=parameters
    )


def _refusal(request: StoreRequest) -> ChannelValues:
    action = str(request.values.get("action"))
    wanted = str(request.values.get("id") or request.values.get("name") or "the last one")
    text = f"a mission was not {action}ed: '{wanted}' is known already or does not last"
    return event("mission_refused", text, who=str(request.values.get("who", "")))


PATIENCE_S = 5.0
_POLL_S = 0.05


def start(
    where: str | Path,
    name: str,
    *,
    mission_id: str = "",
    parameters: Mapping[str, Any] | None = None,
    who: str = "",
    patience_s: float = PATIENCE_S,
) -> RecordedMission:
    """Begin a mission now; one of the same name that still lasts ends.

    Raises UsageError for a name or id that is none or is taken, AmberboxError when the keeper
    does not answer.
    """
    for text in (name, mission_id or name):
        if not is_id(text):
            raise UsageError(f"'{text}' is no id", "use a-z 0-9 _ . - , at most 64 of them")
    store = open_store(store_path(where))
    if mission_id and any(m.id == mission_id for m in load(store.path)):
        raise UsageError(f"there is a mission '{mission_id}' already", "choose another id")
    chosen = mission_id or id_of(name, time.time_ns())
    values = {"name": name, "id": chosen, "parameters": dict(parameters or {}), "who": who}
    return _request(store, {"action": "start", **values}, chosen, patience_s)


def end(
    where: str | Path,
    mission_id: str = "",
    *,
    outcome: str = "",
    failed: bool | None = None,
    who: str = "",
    patience_s: float = PATIENCE_S,
) -> RecordedMission:
    """End a mission now: the one of this id, else the one that began last.

    Raises UsageError when none like that lasts, AmberboxError when the keeper does not answer.
    """
    store = open_store(store_path(where))
    lasting = [mission for mission in load(store.path) if mission.to_ns is None]
    wanted = [m for m in lasting if mission_id in ("", m.id)]
    if not wanted:
        what = f"no mission '{mission_id}' lasts" if mission_id else "no mission lasts"
        raise UsageError(
            what + did_you_mean(mission_id, [m.id for m in lasting]),
            "amberbox mission list WHERE shows them all",
        )
    chosen = wanted[-1].id
    values = {"id": chosen, "outcome": outcome, "failed": failed, "who": who}
    return _request(store, {"action": "end", **values}, chosen, patience_s)


def _request(
    store: Store, values: dict[str, Any], mission_id: str, patience_s: float
) -> RecordedMission:
    """Submit a request, wait until it is done, and return the mission."""
    path = submit(store, KIND, {**values, "boot_id": SystemClock().boot_id()})
    until = time.monotonic() + patience_s
    while path.exists():
        if with_retention_lock(store, lambda keeper: keeper.step()):
            continue
        if time.monotonic() > until:
            path.unlink(missing_ok=True)
            raise AmberboxError(
                "the keeper of this record does not answer; nothing was written down",
                "see whether it is busy or stuck: amberbox doctor FOLDER",
            )
        time.sleep(_POLL_S)
    found = next((m for m in load(store.path) if m.id == mission_id), None)
    if found is None or (values["action"] == "end" and found.end is None):
        raise AmberboxError(
            f"the keeper refused to {values['action']} the mission '{mission_id}'",
            "amberbox events WHERE says why",
        )
    return found


def with_retention_lock(store: Store, work: Callable[[MissionService], object]) -> bool:
    """Run ``work`` under the maintenance lock; False if another process holds it."""
    return with_maintenance_lock(store, lambda journal: work(MissionService(store, (), journal)))


def with_maintenance_lock(store: Store, work: Callable[[DerivedJournal], object]) -> bool:
    """Run ``work`` with the maintenance journal; False if another process holds its lock."""
    try:
        lock = WriterLock(store, "keeper")
    except UsageError:
        return False
    journal = DerivedJournal(store, "keep", chain=lambda: previous_chain(store, "keep"))
    try:
        work(journal)
    finally:
        journal.close()
        lock.release()
    return True


def write(store: Store, missions: list[RecordedMission]) -> None:
    """Write missions that were detected later; raises AmberboxError while a keeper runs."""

    def add(keeper: MissionService) -> None:
        for mission in missions:
            began = replace(mission, end=None, outcome="", failed=False)
            keeper.note([began] if mission.end is None else [began, mission])

    if missions and not with_retention_lock(store, add):
        raise AmberboxError(
            "a keeper runs on this store", "stop the recorder first, or put the rules in robot.yaml"
        )
