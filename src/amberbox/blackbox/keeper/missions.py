"""The keeper's part in missions: it follows the rules and writes down what people ask for."""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.keeper.missiontracker import Tracker, conditions_of, id_of
from amberbox.blackbox.keeper.options import MissionRule
from amberbox.blackbox.keeper.ownjournal import (
    OwnJournal,
    Progress,
    Record,
    event,
    last_progress,
)
from amberbox.blackbox.keeper.reading import Reading, RunPart
from amberbox.blackbox.missions.mission import DONE, Mission, Moment, book_of_store, load
from amberbox.blackbox.requests import Request, finish, pending
from amberbox.blackbox.store import Store, is_locked
from amberbox.core.clock import NS, Clock

KIND = "mission"
READER = "missions"
_LOOK_BACK_NS = 2 * NS
_SAVE_NS = 600 * NS


class MissionKeeper:
    """Begins and ends missions of one store; ``step`` does what there is to do now.

    Whoever calls this holds the keeper's lock.
    """

    def __init__(
        self, store: Store, rules: Sequence[MissionRule] = (), journal: OwnJournal | None = None
    ) -> None:
        self._store = store
        self._journal = journal or OwnJournal(store, "keep")
        self._rules = rules
        self._tracker: Tracker | None = None
        self._follower: _Follower | None = None
        self._told: set[str] = set()
        self._unwritten: list[Record] = []
        self._answers: dict[Path, list[Record]] = {}
        self._saved_ns = self._journal.now_ns()

    def step(self) -> None:
        """See to requests, then go on along the record; what a full disk refuses waits."""
        self._take_requests()
        if self._rules:
            self._follow()

    def close(self) -> None:
        """Write down how far the record was read."""
        if self._follower is not None and self._follower.has_read:
            self._write_progress(self._follower)

    def note(self, missions: Sequence[Mission]) -> None:
        """Write missions down as they are."""
        self._journal.write([mission.record() for mission in missions])

    def _take_requests(self) -> None:
        for request in pending(self._store):
            if request.kind != KIND:
                continue
            if request.path not in self._answers:
                records: list[Record] = [m.record() for m in self._asked(request)]
                self._answers[request.path] = records or [_refusal(request)]
            with suppress(OSError):  # then it is done at the next step
                self._journal.write(self._answers[request.path])
                finish(request)
                del self._answers[request.path]

    def _asked(self, request: Request) -> list[Mission]:
        values, moment = request.values, _moment_of(request)
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

    def _known(self) -> Tracker:
        if self._tracker is None:
            known = load(self._store.path)
            self._tracker = Tracker(self._rules, known, lambda: book_of_store(self._store.path))
        return self._tracker

    def _follow(self) -> None:
        if self._follower is None:
            self._follower = _Follower(self._store, self._rules)
        is_idle = not is_locked(self._store, "main")  # before reading: then nothing is missed
        changed = self._follower.step(self._known())
        if is_idle:
            changed += self._known().expire(_now(self._journal.clock))
        self._unwritten += [mission.record() for mission in changed]
        for name, what in self._follower.problems.items():
            if name not in self._told:
                self._told.add(name)
                self._unwritten.append(
                    event("mission_rule", f"missions: {name}: {what}", rule=name)
                )
        now_ns = self._journal.now_ns()
        due = self._unwritten or now_ns - self._saved_ns > _SAVE_NS
        if due and self._follower.has_read and self._write_progress(self._follower):
            self._saved_ns = now_ns

    def _write_progress(self, follower: _Follower) -> bool:
        """Write down what was found and how far this has come; False if the disk is full."""
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
        self._reading = Reading(store, self._conditions.items, cursor, look_back_s)
        self._run: int | None = None
        self._at = (0, 0)
        self._offset_ns = 0
        self.has_read = False

    def step(self, tracker: Tracker) -> list[Mission]:
        """Read on; return the missions that began or ended."""
        changed: list[Mission] = []
        parts = self._reading.step()
        for part in parts:
            if self._is_done(part):
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

    def progress(self) -> Progress:
        """Say how far this has come and what was true then."""
        run, log_ns = self._at
        state = {"run": run, "log_ns": log_ns, "true": self._conditions.true}
        return Progress(self._reading.cursor(), READER, msgspec.json.encode(state).decode())

    def _is_done(self, part: RunPart) -> bool:
        """Tell whether a run came before the one in which this was left: it is read again."""
        return self._run is None and part.run < self._left.get("run", 0)

    def _enter(self, part: RunPart) -> None:
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

    def __init__(self, part: RunPart, before_ns: int) -> None:
        self._part = part
        rows = [
            (int(times_ns[-1]), int(batch.received_ns[-1] - batch.log_time_ns[-1]))
            for batch, times_ns in part.batches
            if len(times_ns)
        ]
        self._rows = sorted(rows) or [(0, before_ns)]
        self.last_ns = self._rows[-1][1]

    def moment(self, time_ns: int) -> Moment:
        """Return the moment of the record at a time of the axis."""
        at = self._part.moment(time_ns)
        place = min(bisect.bisect_left(self._rows, (time_ns,)), len(self._rows) - 1)
        return Moment(at.log_ns + self._rows[place][1], at.run, at.log_ns)


def _started(name: str, values: Mapping[str, Any], moment: Moment) -> Mission:
    mission_id = str(values.get("id") or id_of(name, moment.received_ns))
    parameters = dict(values.get("parameters") or {})
    return Mission(mission_id, name, moment, who=str(values.get("who", "")), parameters=parameters)


def _now(clock: Clock) -> Moment:
    return Moment(clock.wall_ns(), boot=clock.boot_id()[:8], boot_ns=clock.boot_ns())


def _moment_of(request: Request) -> Moment:
    boot = str(request.values.get("boot_id", ""))[:8]
    return Moment(request.wall_ns, boot=boot, boot_ns=request.boot_ns)


def _refusal(request: Request) -> Record:
    action = str(request.values.get("action"))
    wanted = str(request.values.get("id") or request.values.get("name") or "the last one")
    text = f"a mission was not {action}ed: '{wanted}' is known already or does not last"
    return event("mission_refused", text, who=str(request.values.get("who", "")))
