"""Rule tests: ``*.test.yaml`` files with input series and expected statuses, and their run.

Series are written compactly: ``26x20 20+0.5x10 _x3 nan 'drive'x2``. Rows in memory go through the
engine, and what it finds is compared. A mode can be tested alone, without a robot: then the tests
define the recorded items.
"""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from amberbox.blackbox.columns.variables import ColumnAddress, guessed_column
from amberbox.blackbox.journal import channels
from amberbox.blackbox.robot_folder.robot_yaml import RobotConfig
from amberbox.core.clock import NS
from amberbox.core.config import Finding as ConfigFinding
from amberbox.core.config import build
from amberbox.core.errors import Problem, UsageError, did_you_mean
from amberbox.core.names import identifier
from amberbox.core.options import option
from amberbox.core.source import TopicOptions
from amberbox.core.types import (
    Batch,
    Column,
    ColumnData,
    IntArray,
    ItemSchema,
    Level,
    Output,
    Ragged,
    Status,
)
from amberbox.core.yaml_nodes import Node, load_yaml
from amberbox.monitoring.component_files import ModeSource, find_functions
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import TICK_NS, AlarmChange, Finding, Transition
from amberbox.monitoring.mode_bindings import InputBinder
from amberbox.monitoring.plan import ComponentPlan, InputPlan, MonitoringPlan
from amberbox.monitoring.plan_loader import PlanContext, plan_mode
from amberbox.monitoring.recorded_items import RecordedItem, RecordedItems

MOST_VALUES = 200_000
HINT = "write values such as 5x20 0+0.1x30 _x10 null nan true 'text' [1, 2]x3"

_TOKEN = re.compile(
    r"""\s*(?P<value>'[^']*'|"[^"]*"|\[[^\]]*\]|[^\s'"\[x+]+?(?:[eE][-+]?\d+)?)
        (?:(?P<step>[-+][0-9.]+(?:[eE][-+]?\d+)?)?x(?P<count>\d+))?(?=\s|$)""",
    re.VERBOSE,
)
_WORDS: dict[str, Any] = {"true": True, "false": False, "null": None}
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)")


class AbsentValue:
    """No message at this time."""

    def __repr__(self) -> str:
        return "_"


ABSENT: Final = AbsentValue()


@dataclass(frozen=True, slots=True)
class RuleTestSeries:
    """Values, one for each interval; ``ABSENT`` for no message."""

    values: tuple[Any, ...]

    @classmethod
    def from_text(cls, text: str) -> RuleTestSeries:
        """Read the notation; raise UsageError for what cannot be read."""
        return cls(tuple(read_series(text)))


def read_series(text: str) -> list[Any]:
    """Return the values of a series, ``ABSENT`` for no message.

    Raises UsageError for unreadable text, and for more than ``MOST_VALUES`` values.
    """
    values: list[Any] = []
    for part in _parts(text.strip()):
        values += part
        if len(values) > MOST_VALUES:
            raise UsageError(f"a series has {MOST_VALUES} values at most", "use a longer interval")
    return values


def _parts(text: str) -> Iterator[list[Any]]:
    at = 0
    while at < len(text):
        token = _TOKEN.match(text, at)
        if token is None:
            raise _unreadable(text[at:].split()[0])
        at = token.end()
        yield _expanded(token)


def _expanded(token: re.Match[str]) -> list[Any]:
    count = min(int(token["count"] or 1), MOST_VALUES + 1)
    value = _value(token["value"], token[0].strip())
    if token["step"] is None:
        return [value] * count
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _unreadable(token[0].strip())
    return [_stepped(value, token["step"], number) for number in range(count)]


def _stepped(value: float, step: str, number: int) -> float:
    """Add a step some times, without the small errors of decimal fractions."""
    grown = value + _number(step) * number
    return grown if isinstance(grown, int) else round(grown, 12)


def _value(text: str, token: str) -> Any:
    if text == "_":
        return ABSENT
    if text[0] in "'\"":
        return text[1:-1]
    if text[0] == "[":
        words = text[1:-1].replace(",", " ").split()
        if not all(_NUMBER.fullmatch(word) for word in words):
            raise _unreadable(token)
        return [float(word) for word in words]
    if text in _WORDS:
        return _WORDS[text]
    if _NUMBER.fullmatch(text):
        return _number(text)
    raise _unreadable(token)


def _number(text: str) -> int | float:
    return int(text) if text.lstrip("+-").isdigit() else float(text)


def _unreadable(token: str) -> UsageError:
    return UsageError(f"cannot read {token} as a value", HINT)


def value_text(value: Any) -> str:
    """Return a value in the notation of tests."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False)


PATTERN = "*.test.yaml"


@dataclass(frozen=True, slots=True)
class ExpectedStatus:
    """The required status of a component or mode at a time; fields that are left out may be
    anything.
    """

    at: float = option(doc="when, after the first value", unit="s")
    of: str = option("", "component, or component/mode")
    level: Level | None = option(None, "ok, warn, error, stale or unknown")
    state: str | None = option(None, "state")
    outputs: Mapping[str, Any] = option({}, "outputs by name; a range is written 9.8 .. 10.2")
    reason: str = option("", "text that the reason contains")
    blocked_by: Sequence[str] | None = option(None, "dependencies that block it, exactly")


@dataclass(frozen=True, slots=True)
class ExpectedTransition:
    """A required change. The list is complete from its first entry on, for each name."""

    at: float | None = option(None, "when, after the first value; any time when absent", unit="s")
    of: str = option("", "component, or component/mode")
    level: Level | None = option(None, "level after it")
    state: str | None = option(None, "state after it")
    reason: str = option("", "text that the reason contains")


@dataclass(frozen=True, slots=True)
class ExpectedAlarm:
    """A required change of an alarm; all changes of all alarms are listed."""

    at: float | None = option(None, "when, after the first value; any time when absent", unit="s")
    of: str = option("", "component")
    state: Literal["open", "acknowledged", "shelved", "healed"] = option("open", "state after it")
    severity: Literal["warning", "urgent", "critical", "fatal"] | None = option(None, "severity")
    count: int | None = option(None, "how often it has opened")
    reason: str = option("", "text that the reason contains")


@dataclass(frozen=True, slots=True)
class PublisherLoss:
    """The known loss of a publisher of an item for some time."""

    item: str = option(doc="item, or the input as the mode file has it")
    at: float = option(doc="when it is lost, after the first value", unit="s")
    until: float | None = option(None, "when it is back; never when absent", unit="s")
    reason: str = option("publisher lost", "reason of the gap")


@dataclass(frozen=True, slots=True)
class RuleTest:
    """One test: its input, and the expectations."""

    test: str = option(doc="what is tested, in a few words")
    interval: float | None = option(None, "time from one value to the next", unit="s")
    series: Mapping[str, RuleTestSeries] = option({}, "values by variable, item or input")
    rows: Mapping[str, Mapping[str, RuleTestSeries]] = option(
        {}, "values of several columns of an item, or of what a probe measures"
    )
    received: Mapping[str, RuleTestSeries] = option(
        {}, "messages received in each interval, by item"
    )
    stamps: Mapping[str, RuleTestSeries] = option(
        {}, "own stamps of an item's rows, s after the first value"
    )
    lost: Sequence[PublisherLoss] = option((), "publishers that are lost")
    expect: Sequence[ExpectedStatus] = option((), "statuses at times")
    transitions: Sequence[ExpectedTransition] | None = option(None, "changes that must come")
    alarms: Sequence[ExpectedAlarm] | None = option(None, "changes of alarms that must come")

    def check(self) -> Iterator[ConfigFinding]:
        """Refuse a test that cannot fail."""
        if not self.expect and self.transitions is None and self.alarms is None:
            yield "nothing is expected: give 'expect', 'transitions' or 'alarms'"
        if self.transitions is not None and not self.transitions:
            yield "transitions", "name at least one; an initialisation is a transition, too"
        if self.interval is not None and not self.interval > 0:
            yield "interval", "must be above 0"


@dataclass(frozen=True, slots=True)
class RuleTestFile:
    """A ``*.test.yaml`` file."""

    tests: Sequence[RuleTest] = option(doc="the tests")
    of: str = option("", "component, or component/mode, that is meant where 'of' is absent")
    interval: float = option(1.0, "time from one value to the next", unit="s")
    mode: Any = option(None, "a mode file's text, to test a mode without a robot")

    def check(self) -> Iterator[ConfigFinding]:
        """Refuse what no test can run with."""
        if not self.interval > 0:
            yield "interval", "must be above 0"


class LoadedRuleTests(NamedTuple):
    """A file that has been read: its content, its nodes, and the folder it is for."""

    file: RuleTestFile
    node: Node
    folder: Path

    @property
    def mode(self) -> Node | None:
        """Return the mode defined in the file; None if it tests those of its robot."""
        return (self.node.mapping or {}).get("mode")

    def places(self, test: int, key: str = "") -> list[Node]:
        """Return the nodes of the entries of a list in a test; without a key, of the test."""
        node = _entries(self.node, "tests")[test]
        return _entries(node, key) if key else [node]

    def place(self, test: int, key: str) -> Node:
        """Return the node of a key of a test, or of the test where it has none."""
        node = _entries(self.node, "tests")[test]
        return (node.mapping or {}).get(key, node)


@dataclass(slots=True)
class FoundRuleTests:
    """The test files of a folder, and their problems."""

    rules: list[LoadedRuleTests] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def read_rule_tests(
    path: Path, name: str, folder: Path, problems: list[Problem]
) -> LoadedRuleTests | None:
    """Read one file, called ``name`` in messages; None if anything is wrong with it."""
    node = load_yaml(path, problems, name)
    built = build(RuleTestFile, node, problems) if node is not None else None
    return LoadedRuleTests(built, node, folder) if built is not None and node is not None else None


def find_rule_tests(folder: Path, skip: Path | None = None) -> FoundRuleTests:
    """Read every test file below a folder, in order; ``skip`` is a folder to leave out."""
    found = FoundRuleTests()
    for path in sorted(folder.rglob(PATTERN)):
        if skip is not None and path.is_relative_to(skip):
            continue
        rules = read_rule_tests(path, str(path), folder, found.problems)
        found.rules += [rules] if rules is not None else []
    return found


def _entries(node: Node, key: str) -> list[Node]:
    child = (node.mapping or {}).get(key)
    return list(child.items or ()) if child is not None else []


START_NS = 1_790_000_000 * NS  # time of the first value
_COUNTERS = identifier(channels.COUNTERS)
_GAPS = identifier(channels.GAP)
_STAMP = "stamp"


@dataclass(slots=True)
class RuleTestInput:
    """Values by item and variable, one for each interval."""

    interval_ns: int
    items: dict[str, dict[str, list[Any]]] = field(default_factory=lambda: defaultdict(dict))
    received: dict[str, list[Any]] = field(default_factory=dict)
    stamps: dict[str, list[Any]] = field(default_factory=dict)
    losses: list[PublisherLoss] = field(default_factory=list)

    @property
    def intervals(self) -> int:
        """Return the number of intervals of the longest series."""
        series = [s for columns in self.items.values() for s in columns.values()]
        return max(map(len, [*series, *self.received.values()]), default=0)

    def batches(self) -> list[Batch]:
        """Return everything as batches, one for each item."""
        batches = [self._rows(item, columns) for item, columns in self.items.items()]
        batches += [self._counts()] if self.received else []
        batches += [_gaps(self.losses)] if self.losses else []
        return [batch for batch in batches if len(batch)]

    def _rows(self, item: str, columns: Mapping[str, list[Any]]) -> Batch:
        count = max(map(len, columns.values()))
        padded = {name: _padded(values, count) for name, values in columns.items()}
        rows = [n for n in range(count) if any(v[n] is not ABSENT for v in padded.values())]
        log_ns = START_NS + np.array(rows, np.int64) * self.interval_ns
        chosen = {name: [_known(values[n]) for n in rows] for name, values in padded.items()}
        chosen.pop("", None)
        if item not in self.stamps:
            return _batch(item, chosen, log_ns, log_ns)
        stamps = _padded(self.stamps[item], count)
        return _batch(item, chosen, log_ns, _stamps([stamps[n] for n in rows], log_ns), _STAMP)

    def _counts(self) -> Batch:
        """Return the recorder's counters: all items at each interval that has a count."""
        rows: list[tuple[int, str, int, int]] = []
        for item, series in self.received.items():
            total, last_ns = 0, 0
            for number, count in enumerate(series):
                if count is ABSENT:
                    continue
                at_ns = START_NS + number * self.interval_ns
                total, last_ns = total + int(count), at_ns if count else last_ns
                rows.append((at_ns, item, total, last_ns))
        rows.sort()
        names = ("item", "received", "last_received_ns")
        columns = {name: [row[n] for row in rows] for n, name in enumerate(names, 1)}
        log_ns = np.array([row[0] for row in rows], np.int64)
        child = _batch(f"{_COUNTERS}__items", columns, log_ns, log_ns)
        return _batch(_COUNTERS, {}, log_ns, log_ns, children={"items": child})


def read_input(test: RuleTest, interval_s: float, plan: MonitoringPlan) -> RuleTestInput:
    """Read the input of a test; raise UsageError with what cannot be read."""
    found = RuleTestInput(round(interval_s * NS))
    by_text = {entry.text: entry for entry in plan.inputs()}
    parts: dict[tuple[str, str], dict[int, list[Any]]] = defaultdict(dict)
    for name, series in test.series.items():
        place = _place(name, by_text.get(name))
        if place.number is None:
            found.items[place.item][place.variable] = list(series.values)
        else:
            parts[place.item, place.variable][place.number] = list(series.values)
    for (item, variable), elements in parts.items():
        found.items[item][variable] = _lists(elements)
    for name, columns in test.rows.items():
        for column, series in columns.items():
            found.items[_item(name, by_text)][column] = list(series.values)
    for name, written in test.received.items():
        counts = list(written.values)
        for count in counts:
            if count is not ABSENT and (not isinstance(count, int) or count < 0):
                raise UsageError(f"{name}: messages are counted, {value_text(count)} is no count")
        found.received[_item(name, by_text)] = counts
    for name, written in test.stamps.items():
        item = _item(name, by_text)
        found.stamps[item] = list(written.values)
        found.items[item].setdefault("", found.stamps[item])
    found.losses = [
        PublisherLoss(_item(loss.item, by_text), loss.at, loss.until, loss.reason)
        for loss in test.lost
    ]
    return found


def _place(name: str, entry: InputPlan | None) -> ColumnAddress:
    """Return the item and variable that a name in a test means, and the element of a list."""
    if entry is not None and entry.kind == "probe":
        return ColumnAddress(entry.item, "ok")
    if entry is not None:
        return ColumnAddress(entry.item, entry.variable, entry.index)
    item, _, variable = name.partition(".")
    if identifier(item) != item:
        raise UsageError(
            f"'{name}' is no input of these monitors", "write item.variable, an item, or an input"
        )
    return guessed_column(item, variable) if variable else ColumnAddress(item, "")


def _lists(elements: Mapping[int, Sequence[Any]]) -> list[Any]:
    """Return a list for each interval, up to its last element that has a value; NaN for others.

    An element of a list, and a row of a list of structures, are read from it alike.
    """
    count = max(map(len, elements.values()))
    padded = {index: _padded(list(values), count) for index, values in elements.items()}
    lists: list[Any] = []
    for number in range(count):
        here = {index: v[number] for index, v in padded.items() if v[number] is not ABSENT}
        known = {index: value for index, value in here.items() if value is not None}
        long = [known.get(index, math.nan) for index in range(max(known, default=-1) + 1)]
        lists.append(long if here else ABSENT)
    return lists


def _item(name: str, by_text: Mapping[str, InputPlan]) -> str:
    return _place(name, by_text.get(name)).item


def _padded(values: list[Any], count: int) -> list[Any]:
    return values + [ABSENT] * (count - len(values))


def _known(value: Any) -> Any:
    return None if value is ABSENT else value


def _stamps(seconds: Sequence[Any], log_ns: IntArray) -> IntArray:
    """Return stamps (ns) from seconds after the first value; without one, the row's time."""
    known = [isinstance(value, int | float) for value in seconds]
    given = [START_NS + round(v * NS) if k else 0 for v, k in zip(seconds, known, strict=True)]
    stamps: IntArray = np.where(known, np.array(given, np.int64), log_ns)
    return stamps


def _gaps(losses: Sequence[PublisherLoss]) -> Batch:
    rows: list[tuple[int, str, int, int | None, str]] = []
    for loss in losses:
        from_ns = START_NS + round(loss.at * NS)
        rows.append((from_ns, loss.item, from_ns, None, loss.reason))
        if loss.until is not None:
            to_ns = START_NS + round(loss.until * NS)
            rows.append((to_ns, loss.item, from_ns, to_ns, loss.reason))
    rows.sort(key=lambda row: row[0])
    log_ns = np.array([row[0] for row in rows], np.int64)
    columns = {
        name: [row[place] for row in rows]
        for place, name in ((1, "item"), (2, "from_ns"), (3, "to_ns"), (4, "reason"))
    }
    return _batch(_GAPS, {**columns, "peer": [""] * len(rows)}, log_ns, log_ns)


def _batch(
    item: str,
    columns: Mapping[str, Sequence[Any]],
    log_ns: IntArray,
    stamp_ns: IntArray,
    stamp: str = "",
    children: Mapping[str, Batch] | None = None,
) -> Batch:
    made = {name: column_of(name, values) for name, values in columns.items()}
    schema = ItemSchema(
        "rule test", tuple(Column(n, n, kind) for n, (kind, _) in made.items()), stamp=stamp
    )
    return Batch(
        item, schema, "main", 1, np.arange(len(log_ns), dtype=np.int64), log_ns, log_ns, stamp_ns,
        {name: data for name, (_, data) in made.items()}, dict(children or {}),
    )  # fmt: skip


def column_of(name: str, values: Sequence[Any]) -> tuple[str, ColumnData]:
    """Return the type and data of a column; raise UsageError if its values are of several types."""
    known = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in known):
        return "bool", _masked(values, np.bool_, False)
    if any(isinstance(value, bool) for value in known):
        raise UsageError(f"{name} is both a condition and something else", "true and false only")
    if all(isinstance(value, int) for value in known):
        return "int64", _masked(values, np.int64, 0)
    if all(isinstance(value, int | float) for value in known):
        return "float64", _masked(values, np.float64, 0.0)
    if all(isinstance(value, str) for value in known):
        column = np.empty(len(values), object)
        column[:] = values
        return "string", column
    if all(isinstance(value, list) for value in known):
        return "list<float64>", _ragged(values)
    raise UsageError(f"{name} has values of several types", "numbers, texts or lists only")


def _masked(values: Sequence[Any], dtype: Any, filler: Any) -> Any:
    data = np.array([filler if value is None else value for value in values], dtype)
    null = [value is None for value in values]
    return np.ma.MaskedArray(data, null) if any(null) else data


def _ragged(values: Sequence[Any]) -> Ragged:
    lengths = [len(value or ()) for value in values]
    flat = [number for value in values for number in value or ()]
    return Ragged(np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64), np.array(flat, float))


COMPONENT = "tested"  # component of a mode that is tested alone


def single_mode_plan(
    mode: Node, file: RuleTestFile, folder: Path
) -> tuple[MonitoringPlan, list[Problem]]:
    """Make a plan of one mode; return it with the problems.

    ``folder`` is a robot folder, for the monitors and probes of its own.
    """
    problems: list[Problem] = []
    functions = find_functions(folder)
    inputs = InputBinder(TestItems(file), functions)
    bench = PlanContext(functions, inputs, RobotConfig(), problems, folder)
    plan = plan_mode(ModeSource(Path(mode.file), mode), bench)
    component = ComponentPlan(COMPONENT, COMPONENT, (plan,))
    return MonitoringPlan("rule_test", "", (component,)), problems


class TestItems(RecordedItems):
    """The recorded items of tests, with the columns that they define."""

    def __init__(self, file: RuleTestFile) -> None:
        self.items = tuple(_items(file))
        self.open = ()

    def schema(self, item: RecordedItem) -> ItemSchema | None:
        return item.schema

    def stored(self, name: str) -> ItemSchema | None:
        return None

    def rate_hz(self, name: str) -> float | None:
        return None

    @cached_property
    def detectors(self) -> Mapping[str, ItemSchema]:
        return {}

    @property
    def awaits_detectors(self) -> bool:
        return False


def _items(file: RuleTestFile) -> Iterator[RecordedItem]:
    columns: dict[str, dict[str, str]] = defaultdict(dict)
    for test in file.tests:
        for name, series in test.series.items():
            item, _, variable = name.strip("/").partition(".")
            place = guessed_column(item, variable) if "[" in variable else None
            if place is not None and place.number is not None:
                columns[place.item][place.variable] = "list<float64>"
            else:
                columns[item] |= dict(_types({variable: series}))
        for item, rows in test.rows.items():
            columns[item.strip("/")] |= dict(_types(rows))
        for name in (*test.received, *test.stamps, *(loss.item for loss in test.lost)):
            columns[name.strip("/")] |= {}
    for name, types in columns.items():
        types.pop("", None)
        if identifier(name) == name:
            schema = ItemSchema("rule test", tuple(Column(n, n, t) for n, t in types.items()))
            yield RecordedItem(name, "", f"/{name}", TopicOptions(name), schema)


def _types(columns: Mapping[str, RuleTestSeries]) -> Iterator[tuple[str, str]]:
    """Yield columns with their types."""
    for name, series in columns.items():
        with suppress(UsageError):  # reported when the test runs
            yield name, column_of(name, [v for v in series.values if v is not ABSENT])[0]


_NEAR = 1e-9


@dataclass(frozen=True, slots=True)
class RuleTestOutcome:
    """The outcome of a test: statuses at the requested times, and all findings."""

    statuses: Mapping[float, Mapping[tuple[str, str], Status]]
    findings: Sequence[Finding]


def differences(
    rules: LoadedRuleTests, number: int, test: RuleTest, outcome: RuleTestOutcome
) -> list[Problem]:
    """Return the deviations from a test's expectations, each with the expectation's line."""
    return [*_statuses(rules, number, test, outcome), *_changes(rules, number, test, outcome)]


def component_and_mode(of: str) -> tuple[str, str]:
    """Split a name as tests write it; the mode of a component is empty."""
    component, _, mode = of.partition("/")
    return component, mode


def _statuses(
    rules: LoadedRuleTests, number: int, test: RuleTest, outcome: RuleTestOutcome
) -> Iterator[Problem]:
    for place, entry in zip(rules.places(number, "expect"), test.expect, strict=True):
        status = outcome.statuses[entry.at][component_and_mode(entry.of)]
        for what in _differences(entry, status):
            named = " ".join(dict.fromkeys((status.level, status.state)))
            got = f"it is {named}" + (f": {status.reason}" if status.reason else "")
            yield _problem(place, test, entry.at, f"{entry.of}: {what}", got)


def _differences(entry: ExpectedStatus, status: Status) -> Iterator[str]:
    yield from _unlike(entry, status, "level", "state")
    if entry.blocked_by is not None and set(entry.blocked_by) != set(status.blocked_by):
        yield f"expected blocked_by {_listed(entry.blocked_by)}, got {_listed(status.blocked_by)}"
    for name, expected in entry.outputs.items():
        if name not in status.outputs:
            known = ", ".join(status.outputs) or "none"
            near = did_you_mean(name, status.outputs)
            yield f"there is no output '{name}'{near} (outputs: {known})"
        elif not _is_as(expected, status.outputs[name]):
            yield f"expected {name} {_written(expected)}, got {_written(status.outputs[name])}"


def _unlike(entry: Any, found: Any, *names: str, reason: str | None = None) -> Iterator[str]:
    """Yield deviations from the values that an entry expects by name, and from its reason."""
    for name in names:
        expected, value = getattr(entry, name), getattr(found, name)
        if expected is not None and expected != value:
            yield f"expected {name} {expected}, got {value}"
    got = found.reason if reason is None else reason
    if entry.reason not in got:
        yield f"expected a reason with '{entry.reason}', got '{got}'"


def _is_as(expected: Any, value: Output) -> bool:
    """Return whether an output is as expected: a value, or a range ``9.8 .. 10.2``."""
    if isinstance(expected, str) and ".." in expected and not isinstance(value, str):
        low, _, high = expected.partition("..")
        return isinstance(value, int | float) and float(low) <= value <= float(high)
    if isinstance(expected, bool) or isinstance(value, bool):
        return expected is value
    if isinstance(expected, int | float) and isinstance(value, int | float):
        return math.isclose(expected, value, rel_tol=_NEAR, abs_tol=_NEAR)
    return bool(expected == value)


def _changes(
    rules: LoadedRuleTests, number: int, test: RuleTest, outcome: RuleTestOutcome
) -> Iterator[Problem]:
    if test.transitions is not None:
        found = [finding for finding in outcome.findings if isinstance(finding, Transition)]
        places = rules.places(number, "transitions")
        for name in dict.fromkeys(entry.of for entry in test.transitions):
            of_name = [t for t in found if (t.component, t.mode) == component_and_mode(name)]
            listed = [
                (place, entry)
                for place, entry in zip(places, test.transitions, strict=True)
                if entry.of == name
            ]
            yield from _compare(test, listed, _from_first(listed[0][1], of_name), _as_transition)
    if test.alarms is not None:
        changes = [finding for finding in outcome.findings if isinstance(finding, AlarmChange)]
        listed_alarms = list(zip(rules.places(number, "alarms"), test.alarms, strict=True))
        if test.alarms:
            yield from _compare(test, listed_alarms, changes, _as_alarm)
        else:
            place = rules.place(number, "alarms")
            yield from (_surplus(place, test, c.changed_ns, _alarm_text(c)) for c in changes)


def _from_first(entry: ExpectedTransition, found: Sequence[Transition]) -> Sequence[Transition]:
    """Return the transitions from the first listed one on, without the initialisation."""
    for place, transition in enumerate(found):
        if not list(_as_transition(entry, transition)):
            return found[place:]
    return found


def _compare(
    test: RuleTest,
    listed: Sequence[tuple[Node, Any]],
    found: Sequence[Any],
    differences: Callable[[Any, Any], Iterator[str]],
) -> Iterator[Problem]:
    """Compare a list with the changes found, in order; yield the first difference only."""
    for number, (place, entry) in enumerate(listed):
        if number >= len(found):
            yield _problem(place, test, entry.at, f"{entry.of}: it did not come", "")
            return
        wrong = list(differences(entry, found[number]))
        if wrong:
            yield _problem(
                place, test, entry.at, f"{entry.of}: {'; '.join(wrong)}", _text(found[number])
            )
            return
    if len(found) > len(listed):
        extra = found[len(listed)]
        yield _surplus(listed[-1][0], test, _time_of(extra), _text(extra))


def _as_transition(entry: ExpectedTransition, found: Transition) -> Iterator[str]:
    yield from _at(entry.at, found.at_ns)
    yield from _unlike(entry, found.after, "level", "state", reason=found.reason)


def _as_alarm(entry: ExpectedAlarm, found: AlarmChange) -> Iterator[str]:
    yield from _at(entry.at, found.changed_ns)
    if entry.of != found.component:
        yield f"expected an alarm of {entry.of}, got one of {found.component}"
    yield from _unlike(entry, found, "state", "severity", "count")


def _at(expected_s: float | None, at_ns: int) -> Iterator[str]:
    if expected_s is not None and round(expected_s * NS) + START_NS != at_ns:
        yield f"expected at {expected_s:g} s, came at {_seconds(at_ns):g} s"


def _text(found: Transition | AlarmChange) -> str:
    text = found.text if isinstance(found, Transition) else _alarm_text(found)
    return f"at {_seconds(_time_of(found)):g} s came {text}"


def _alarm_text(change: AlarmChange) -> str:
    return f"alarm of {change.component} ({change.severity}) {change.state}: {change.reason}"


def _time_of(found: Transition | AlarmChange) -> int:
    return found.at_ns if isinstance(found, Transition) else found.changed_ns


def _surplus(place: Node, test: RuleTest, at_ns: int, text: str) -> Problem:
    return _problem(place, test, _seconds(at_ns), "a change came that is not listed", text)


def _problem(place: Node, test: RuleTest, at_s: float | None, what: str, got: str) -> Problem:
    when = "" if at_s is None else f" at {at_s:g} s"
    text = f"{what} ({got})" if got else what
    return place.problem(f"test '{test.test}'{when}", text)


def _seconds(at_ns: int) -> float:
    return (at_ns - START_NS) / NS


def _listed(names: Sequence[str]) -> str:
    return f"[{', '.join(sorted(names))}]"


def _written(value: Any) -> str:
    return value if isinstance(value, str) and ".." in value else value_text(value)


def run_rule_tests(rules: LoadedRuleTests, plan: MonitoringPlan) -> list[Problem]:
    """Run every test of a file; return the deviations, each with its line."""
    problems: list[Problem] = []
    if rules.mode is not None:
        plan, problems = single_mode_plan(rules.mode, rules.file, rules.folder)
        mode = plan.components[0].modes[0].id
        of = rules.file.of or f"{COMPONENT}/{mode}"
        rules = rules._replace(file=replace(rules.file, of=of))
    if any(problem.is_error for problem in problems):
        return problems
    return problems + [
        problem
        for number in range(len(rules.file.tests))
        for problem in _run_test(rules, number, plan)
    ]


def _run_test(rules: LoadedRuleTests, number: int, plan: MonitoringPlan) -> list[Problem]:
    test = _with_names(rules.file, rules.file.tests[number])
    where = f"test '{test.test}'"
    unknown = list(_unknown_names(rules, number, test, plan))
    if unknown:
        return unknown
    named = {component_and_mode(entry.of)[0] for entry in _expectations(test)}
    plan = _part_of(plan, named) if named else plan
    try:
        rows = read_input(test, test.interval or rules.file.interval, plan)
        engine = Engine(plan)
        engine.begin(START_NS - TICK_NS)
        for batch in rows.batches():
            engine.feed(batch)
        end_s = rows.intervals * rows.interval_ns / NS
        times = sorted({entry.at for entry in test.expect})
        changes: list[ExpectedTransition | ExpectedAlarm]
        changes = [*(test.transitions or ()), *(test.alarms or ())]
        last = [entry.at for entry in changes if entry.at is not None]
        findings: list[Finding] = []
        statuses: dict[float, Mapping[tuple[str, str], Status]] = {}
        for at in times:
            findings += engine.advance(START_NS + round(at * NS))
            statuses[at] = {(s.component, s.mode): s for s in engine.statuses()}
        findings += engine.advance(START_NS + round(max([end_s, *times, *last]) * NS))
        outcome = RuleTestOutcome(statuses, findings)
    except UsageError as error:
        return [rules.places(number)[0].problem(where, error.what, error.hint)]
    return differences(rules, number, test, outcome)


def _with_names(file: RuleTestFile, test: RuleTest) -> RuleTest:
    """Return a test in which each expectation names its component or mode."""
    component = component_and_mode(file.of)[0]
    return replace(
        test,
        expect=[replace(entry, of=entry.of or file.of) for entry in test.expect],
        transitions=test.transitions
        and [replace(entry, of=entry.of or file.of) for entry in test.transitions],
        alarms=test.alarms and [replace(entry, of=entry.of or component) for entry in test.alarms],
    )


def _expectations(
    test: RuleTest,
) -> Iterator[ExpectedStatus | ExpectedTransition | ExpectedAlarm]:
    yield from test.expect
    yield from test.transitions or ()
    yield from test.alarms or ()


def _unknown_names(
    rules: LoadedRuleTests, number: int, test: RuleTest, plan: MonitoringPlan
) -> Iterator[Problem]:
    known = {c.id for c in plan.components} | {f"{c.id}/{m.id}" for c, m in plan.modes()}
    for key in ("expect", "transitions", "alarms"):
        for place, entry in zip(rules.places(number, key), getattr(test, key) or (), strict=True):
            if entry.of not in known:
                what = f"there is no component or mode '{entry.of}'{did_you_mean(entry.of, known)}"
                hint = "" if entry.of else "name it with 'of', here or at the top of the file"
                yield place.problem(f"test '{test.test}'", what, hint)


def _part_of(plan: MonitoringPlan, wanted: set[str]) -> MonitoringPlan:
    """Return the components of a test, and their dependencies."""
    by_id = {component.id: component for component in plan.components}
    reached: set[str] = set()
    waiting = [name for name in wanted if name in by_id]
    while waiting:
        name = waiting.pop()
        if name in reached:
            continue
        reached.add(name)
        waiting += [d.component for d in by_id[name].dependencies if d.component in by_id]
    return replace(plan, components=[c for c in plan.components if c.id in reached])
