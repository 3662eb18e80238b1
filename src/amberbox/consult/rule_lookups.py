"""Facts for rules: those of a robot's folder, and lookups in its record.

Lookups find conditions (``holds/3``), missions, and statuses reported by the watcher.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.columns.variables import resolve_columns
from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.record_window import (
    DAY_NS,
    RecordWindow,
    event_time_ns,
    in_words,
    join_spans,
)
from amberbox.blackbox.retention.missions import RecordedMission, choose
from amberbox.blackbox.robot_folder.folder import ROBOT_FILE, RobotFolder, inspect_folder
from amberbox.blackbox.store.store import is_store
from amberbox.consult.folder_knowledge import fmea_references
from amberbox.core.clock import NS
from amberbox.core.conditions import change_instants, condition_problem, true_spans
from amberbox.core.config import raise_errors
from amberbox.core.contracts import Span
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.expression import Expression, parse
from amberbox.core.types import IntArray
from amberbox.diagnosis.evidence.rules import Facts, known_facts, rule_files
from amberbox.diagnosis.fmea.loader import FILE, load_fmea
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.prolog.machine import LookupSource, Virtual
from amberbox.diagnosis.prolog.program import Interval, Intervals, Keys
from amberbox.diagnosis.prolog.syntax import write
from amberbox.diagnosis.prolog.terms import RuleFault, Term, TextTerm, make, to_term
from amberbox.diagnosis.status_history import RecentStatuses
from amberbox.monitoring.current_state import SILENT_NS
from amberbox.monitoring.findings import COMPONENT_STATE, HealthState

_BLOCK_NS = 900 * NS
_LATE_NS = 5 * NS
_MOST_BLOCKS = 16
"""Number of adjacent blocks that are read together."""
_LOOKBACKS_NS = (60 * NS, 3600 * NS)
"""So far back the value at the beginning is sought, before the whole run is."""
_HINT = "give both times in a goal before it (mission(M, failed, From, To)), or --from T --to T"


@dataclass(frozen=True, slots=True)
class _Read:
    """An address of an expression, and where the record has it."""

    address: str
    item: str
    variable: str
    column: str


@dataclass(frozen=True)
class _Question:
    """A condition, the variables it reads, and its known intervals by blocks of time."""

    when: Expression
    reads: tuple[_Read, ...]
    known: dict[int, list[Span]]


@dataclass(slots=True)
class ConditionCache:
    """When conditions were true in blocks of time that are over, for later looks at a record.

    It is emptied when the runs of the record begin elsewhere: then clocks are known better.
    """

    runs: tuple[int, ...] = ()
    known: dict[str, dict[int, list[Span]]] = field(default_factory=dict)
    reached_ns: dict[str, int] = field(default_factory=dict)

    def of(self, window: RecordWindow, condition: str) -> dict[int, list[Span]]:
        """Return the blocks of a condition that were over when they were looked at."""
        runs = tuple(first for first, _ in window.recorded)
        if runs[: len(self.runs)] != self.runs:
            self.known.clear()
        self.runs = runs
        first_ns, last_ns = window.span
        over_ns = self.reached_ns.get(condition, 0)
        self.reached_ns[condition] = last_ns
        self.known[condition] = {
            block: spans
            for block, spans in self.known.get(condition, {}).items()
            if block >= first_ns // _BLOCK_NS and (block + 1) * _BLOCK_NS <= over_ns
        }
        return self.known[condition]


class ConditionLookup:
    """Looks up when conditions were true; results are cached, with a cache for later ones too."""

    def __init__(self, window: RecordWindow, cache: ConditionCache | None = None) -> None:
        self._window = window
        self._cache = cache or ConditionCache()
        self._questions: dict[str, _Question] = {}

    def find(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield the intervals in which a condition was true, in order of time.

        Raises RuleFault for an invalid condition, and for a query over the whole of a long record.
        """
        (given,) = keys
        question = self._question(given)
        first, last = self._window.cut(span)
        if span is None and last - first > DAY_NS and not self._window.is_given:
            what = f"holds({write(given or '_')}, _, _) would look through {_days(last - first)}"
            raise RuleFault(what, _HINT)
        for found in self._held(question, first, max(last, first + 1)):
            yield Interval((given,), *found, _source(question, found))

    def _question(self, given: Term | None) -> _Question:
        if not isinstance(given, str | TextTerm):
            what = "is no condition" if given is not None else "has no condition"
            shown = write(given) if given is not None else "holds(_, _, _)"
            hint = "write it as an expression in quotes: holds('sim_battery.charge < 20', F, T)"
            raise RuleFault(f"{shown} {what}", hint)
        text = given if isinstance(given, str) else given.value
        if text not in self._questions:
            try:
                self._questions[text] = self._made(parse(text), self._cache.of(self._window, text))
            except AmberboxError as error:
                raise RuleFault(f"condition '{text}': {error.what}", error.hint) from error
        return self._questions[text]

    def _made(self, when: Expression, known: dict[int, list[Span]]) -> _Question:
        problem = condition_problem(when)
        if problem:
            raise UsageError(problem, "docs/reference/expressions.md describes conditions")
        return _Question(when, tuple(map(self._read, when.addresses())), known)

    def _read(self, address: str) -> _Read:
        item, _, variable = address.partition(".")
        columns = self._window.record.variables(item).columns
        found = resolve_columns(columns, [variable], item)
        if len(found) != 1:
            raise UsageError(f"'{address}' stands for {len(found)} variables", "name one of them")
        return _Read(address, item, variable, found[0].name)

    def _held(self, question: _Question, first: int, last: int) -> Iterator[Span]:
        """Yield the joined spans in which it held, covering at least the given span."""
        blocks = range(first // _BLOCK_NS, (last - 1) // _BLOCK_NS + 1)
        missing = [block for block in blocks if block not in question.known]
        for start, count in _intervals(missing):
            self._look(question, start, count)
        for since, until in join_spans(f for block in blocks for f in question.known[block]):
            cut = self._window.cut((since, until))  # earlier looks may have reached further back
            if cut[0] < cut[1]:
                yield cut

    def _look(self, question: _Question, start: int, count: int) -> None:
        """Evaluate some blocks, and cache when the condition held in each."""
        since, until = start * _BLOCK_NS, (start + count) * _BLOCK_NS
        found: list[Span] = []
        for run in self._window.recorded:
            first, last = self._window.cut((max(run[0], since), min(run[1], until)))
            if first < last:
                found.extend(self._in_run(question, run[0], first, last))
        for block in range(start, start + count):
            edges = block * _BLOCK_NS, (block + 1) * _BLOCK_NS
            inside = ((max(f, edges[0]), min(t, edges[1])) for f, t in found)
            question.known[block] = [(f, t) for f, t in inside if f < t]

    def _in_run(self, question: _Question, run_ns: int, first: int, last: int) -> Iterator[Span]:
        """Yield the spans in which it held in ``[first, last)`` of a run begun at ``run_ns``."""
        series = self._series(question, run_ns, first, last)
        edge = np.array([first], np.int64)
        instants = [edge, *change_instants(question.when, series, first, last - 1)]
        times = np.concatenate(instants)
        holds = _true(question.when.evaluate_series(series, times))
        yield from true_spans(times, holds, last)

    def _series(self, question: _Question, run_ns: int, first: int, last: int) -> dict[str, Any]:
        series: dict[str, Any] = {}
        by_item: dict[str, list[_Read]] = {}
        for read in question.reads:
            by_item.setdefault(read.item, []).append(read)
        for item, reads in by_item.items():
            series |= self._rows(item, reads, question.when.history_ns, run_ns, first, last)
        return series

    def _rows(
        self, item: str, reads: list[_Read], history_ns: int, run_ns: int, first: int, last: int
    ) -> dict[str, Any]:
        """Return the rows of an item from the one in force at ``first`` on."""
        names = ["received", *dict.fromkeys(read.variable for read in reads)]
        reached = first - history_ns
        for back_ns in (*_LOOKBACKS_NS, None):
            since = run_ns if back_ns is None else max(run_ns, reached - back_ns)
            table = self._window.record.query(item, names, since, last)
            received = table.columns["received"]
            assert isinstance(received, np.ndarray)  # it is never a list
            if since == run_ns or (len(received) and received.min() <= reached):
                break
        assert isinstance(received, np.ndarray)  # it is never a list
        times: IntArray = np.maximum.accumulate(received)
        return {read.address: (times, table.columns[read.column]) for read in reads}


def _true(values: Any) -> Any:
    """Return where a condition is known to be true."""
    data = np.ma.getdata(values)
    if data.dtype != bool:
        if not np.ma.getmaskarray(values).all():
            raise RuleFault("is no condition", "compare it with something, such as: x > 0")
        return np.zeros(len(values), bool)
    return data & ~np.ma.getmaskarray(values)


def _intervals(blocks: list[int]) -> Iterator[tuple[int, int]]:
    """Yield stretches of neighbouring blocks: the first, and how many."""
    start, count = 0, 0
    for block in blocks:
        if count and block == start + count and count < _MOST_BLOCKS:
            count += 1
            continue
        if count:
            yield start, count
        start, count = block, 1
    if count:
        yield start, count


def _source(question: _Question, span: Span) -> LookupSource:
    items = ", ".join(dict.fromkeys(read.item for read in question.reads))
    evidence = tuple((read.address, *span) for read in question.reads)
    return LookupSource(f"record, {items}, {in_words(span)}", evidence)


def _days(length_ns: int) -> str:
    return f"{length_ns / DAY_NS:.1f} days of the record"


LASTS = "lasts"
FAILED = "failed"
_FIRST_NS = (3 * NS, 60 * NS)
"""Statuses are written every second; the first of a run may be later."""


@dataclass(frozen=True)
class MissionLookup:
    """The missions of a record.

    What began or ended in the last ``late_ns`` of the window is not known yet, as its record may
    be written so late.
    """

    window: RecordWindow
    late_ns: int = 0

    @cached_property
    def known(self) -> list[RecordedMission]:
        """Return all missions that overlap the window; one that ends after it still lasts."""
        first, last = self.window.span
        end = self.window.to_ns
        if end is not None:
            end -= self.late_ns
            last = min(last, end)
        return [
            mission
            if mission.to_ns is None or end is None or mission.to_ns <= end
            else replace(mission, end=None, outcome="", failed=False)
            for mission in choose(self.window.missions(), span=(first, last))
        ]

    def find(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield missions with each of their outcomes."""
        wanted = keys[0]
        for mission in self.known:
            if wanted is None or wanted == mission.id:
                yield from self._of(mission)

    def _of(self, mission: RecordedMission) -> Iterator[Interval]:
        end = self.window.span[1] if mission.to_ns is None else mission.to_ns
        span = mission.from_ns, max(end, mission.from_ns + 1)
        source = LookupSource(
            f"record, mission {mission.name}, {in_words(span)}", ((f"mission {mission.id}", *span),)
        )
        for outcome in _outcomes(mission):
            yield Interval((mission.id, outcome), *span, source)

    def names(self, args: tuple[Term | None, ...]) -> Iterator[tuple[object, ...]]:
        """Yield the kind of each mission."""
        yield from ((mission.id, mission.name) for mission in self.known)

    def parameters(self, args: tuple[Term | None, ...]) -> Iterator[tuple[object, ...]]:
        """Yield the parameters of each mission."""
        for mission in self.known:
            for name, value in mission.parameters.items():
                if not isinstance(value, str | int | float):  # as the JSON that it was written as
                    value = msgspec.json.encode(value).decode()
                yield mission.id, name, value


def _outcomes(mission: RecordedMission) -> Iterator[str]:
    """Yield the outcomes of a mission; a failure under another name also yields "failed"."""
    if mission.to_ns is None:
        yield LASTS
        return
    yield mission.outcome
    if mission.failed and mission.outcome != FAILED:
        yield FAILED


@dataclass(frozen=True, slots=True)
class _ConditionInterval:
    """The condition of a component over a span."""

    component: str
    condition: HealthState
    span: Span


@dataclass(frozen=True)
class StatusLookup:
    """Statuses of components as the watcher reported them, from change to change.

    ``recent`` are those that a watcher knows without having written them all.
    """

    window: RecordWindow
    recent: RecentStatuses | None = None

    @cached_property
    def intervals(self) -> list[_ConditionInterval]:
        """Return conditions of components in order of time, run by run of the watcher."""
        return [*self._written(), *self.known]

    @cached_property
    def known(self) -> list[_ConditionInterval]:
        """Return the recent ones."""
        return [
            _ConditionInterval(one.component, HealthState(one.level, one.state), one[3:])
            for one in (() if self.recent is None else self.recent.spans)
        ]

    def _written(self) -> Iterator[_ConditionInterval]:
        """Yield those of the watcher's journal, up to the recent ones."""
        last = self.window.span[1]
        end = last if self.recent is None else min(last, self.recent.from_ns)
        for run in map(self.window.cut, self._watched()):
            until = min(run[1], end)
            if run[0] < until:
                yield from self._in_run((run[0], until))

    def _watched(self) -> Iterator[Span]:
        """Yield the watcher's runs; each counts until its silence would be noticed.

        Without this no status would hold now: a watcher writes a little behind the recorder.
        """
        runs = self.window.watched
        ends = [run[0] for run in runs[1:]]
        for (first, last), end in zip(runs, [*ends, self.window.span[1]], strict=False):
            yield first, max(last, min(last + SILENT_NS, end))

    def levels(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield the levels of components: ok, warn, error, stale, unknown."""
        return self._find(keys, span, lambda condition: condition.level)

    def states(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield the states of components: nominal, not_initialised, a fault state."""
        return self._find(keys, span, lambda condition: condition.state)

    def _find(
        self, keys: Keys, span: Span | None, word: Callable[[HealthState], str]
    ) -> Iterator[Interval]:
        component, wanted = keys
        is_recent = span is not None and self.recent is not None and span[0] >= self.recent.from_ns
        intervals = self.known if is_recent else self.intervals
        found = (s for s in intervals if component is None or s.component == component)
        for name, text, span in _joined((s.component, word(s.condition), s.span) for s in found):
            if wanted is None or wanted == text:
                source = LookupSource(f"watcher, {in_words(span)}", ((name, *span),))
                yield Interval((name, text), *span, source)

    def _in_run(self, run: Span) -> Iterator[_ConditionInterval]:
        changes = list(self._changes(run))
        now = self._first(run) | {
            change["component"]: HealthState(**change["before"]) for _, change in reversed(changes)
        }
        since = dict.fromkeys(now, run[0])
        for at_ns, change in changes:
            name = change["component"]
            if since[name] < at_ns:
                yield _ConditionInterval(name, now[name], (since[name], at_ns))
            since[name], now[name] = at_ns, HealthState(**change["after"])
        for name, from_ns in since.items():
            yield _ConditionInterval(name, now[name], (from_ns, max(run[1], from_ns + 1)))

    def _changes(self, run: Span) -> Iterator[tuple[int, Mapping[str, Any]]]:
        """Yield changes of components, with their times."""
        for row in self.window.rows(channels.EVENT, ("kind", "details"), run):
            if row["kind"] != COMPONENT_STATE:
                continue
            change = msgspec.json.decode(row["details"])
            if not change["mode"]:
                at_ns = event_time_ns(change["at_ns"], row["received"])
                yield min(max(at_ns, run[0]), run[1]), change

    def _first(self, run: Span) -> dict[str, HealthState]:
        """Return the conditions of components when the run began."""
        for length_ns in _FIRST_NS:
            span = run[0], min(run[1], run[0] + length_ns)
            names = ("component", "mode", "level", "state")
            rows = list(self.window.rows(channels.STATUS, names, span))
            found = {
                row["component"]: HealthState(row["level"], row["state"])
                for row in reversed(rows)
                if not row["mode"]
            }
            if found:
                return found
        return {}


def _joined(found: Iterable[tuple[str, str, Span]]) -> Iterator[tuple[str, str, Span]]:
    """Join adjacent equal conditions of a component; runs of the watcher stay apart."""
    open_: dict[str, tuple[str, Span]] = {}
    for name, word, span in found:
        before = open_.get(name)
        if before is not None and before[0] == word and before[1][1] == span[0]:
            open_[name] = word, (before[1][0], span[1])
            continue
        if before is not None:
            yield name, *before
        open_[name] = word, span
    for name, last in open_.items():
        yield name, *last


_ROWS = Callable[["tuple[Term | None, ...]"], Iterable["tuple[object, ...]"]]


@dataclass(frozen=True, slots=True)
class RuleTarget:
    """The meaning of WHERE: a robot folder or not, and the analysis in it."""

    path: Path
    folder: RobotFolder | None = None
    fmea: Fmea | None = None

    @property
    def rules(self) -> list[Path]:
        """Return the folder's rule files."""
        return rule_files(self.path)

    def has_record(self) -> bool:
        """Return whether there is a record, or a path that should be one."""
        if self.folder is None:
            return self.fmea is None
        return is_store(self.folder.store_path)


def rule_target(where: str) -> RuleTarget:
    """Read a robot folder with its FMEA; a store or recording file has neither.

    Raises ConfigurationError for a folder or an FMEA that is wrong.
    """
    path = Path(where)
    folder = None
    if (path / ROBOT_FILE).exists():
        folder, problems = inspect_folder(path)
        raise_errors(problems)
    if not (path / FILE).exists():
        return RuleTarget(path, folder)
    fmea, problems = load_fmea(path / FILE, fmea_references(folder) if folder is not None else None)
    raise_errors(problems)
    return RuleTarget(path, folder, fmea)


def record_predicates(
    window: RecordWindow,
    cache: ConditionCache | None = None,
    recent: RecentStatuses | None = None,
) -> list[Virtual]:
    """Return the predicates that query a record.

    While it is followed, the ``cache`` keeps what is over for later queries, and ``recent`` are the
    latest statuses.
    """
    missions, statuses, conditions = (
        MissionLookup(window, 0 if cache is None else _LATE_NS),
        StatusLookup(window, recent),
        ConditionLookup(window, cache),
    )
    text, condition = window.read_time, (frozenset({1}),)
    hint = "say which condition: holds('sim_battery.charge < 20', From, To)"
    found = (
        Intervals("mission", 2, missions.find, text),
        Intervals("status", 2, statuses.levels, text),
        Intervals("state", 2, statuses.states, text),
        Intervals("holds", 1, conditions.find, text, needs=condition, hint=hint),
        Intervals("holds_throughout", 1, conditions.find, text, True, condition, hint),
    )
    return [
        *(of.virtual() for of in found),
        _table("now", 1, lambda _: [(window.span[1] - 1,)]),
        _table("mission_name", 2, missions.names),
        _table("mission_parameter", 3, missions.parameters),
    ]


def _table(name: str, arity: int, rows: _ROWS) -> Virtual:
    return Virtual(name, arity, rows, clauses=partial(_written, name, arity, rows))


def _written(name: str, arity: int, rows: _ROWS, firsts: Iterable[Term]) -> Iterator[str]:
    for row in rows((None,) * arity):
        yield f"{write(make(name, map(to_term, row)), most=999)}."


def rule_facts(
    place: RuleTarget, record: Record | None, span: tuple[int | None, int | None]
) -> Facts:
    """Return the facts and lookups for rules at a place."""
    robot = place.folder.robot.id if place.folder is not None else _robot_of(record)
    known = tuple(known_facts(robot, place.fmea))
    if record is None:
        return Facts(known)
    return Facts(known, (), tuple(record_predicates(RecordWindow(record, *span))))


def _robot_of(record: Record | None) -> str:
    """Return the robot of a record, as stated by its newest run; empty if none states it."""
    if record is None or not record.has_item("amberbox_run"):
        return ""
    names = [str(name) for name in record.query("amberbox_run", ["robot"]).values("robot") if name]
    return names[-1] if names else ""
