"""Rule tests as files: ``*.test.yaml`` says what comes in and what monitors must make of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from amberbox.core.config import build, load_yaml
from amberbox.core.errors import Problem
from amberbox.core.nodes import Node
from amberbox.core.options import option
from amberbox.core.standins import Finding
from amberbox.core.types import Level
from amberbox.monitoring.ruletests.notation import Series

PATTERN = "*.test.yaml"


@dataclass(frozen=True, slots=True)
class ExpectedStatus:
    """What a component or mode must be at a time; what is left out may be anything."""

    at: float = option(doc="when, after the first value", unit="s")
    of: str = option("", "component, or component/mode")
    level: Level | None = option(None, "ok, warn, error, stale or unknown")
    state: str | None = option(None, "state")
    outputs: Mapping[str, Any] = option({}, "outputs by name; a range is written 9.8 .. 10.2")
    reason: str = option("", "text that the reason contains")
    blocked_by: Sequence[str] | None = option(None, "dependencies that block it, exactly")


@dataclass(frozen=True, slots=True)
class ExpectedTransition:
    """A change that must come. The list is complete from its first entry on, for each name."""

    at: float | None = option(None, "when, after the first value; any time when absent", unit="s")
    of: str = option("", "component, or component/mode")
    level: Level | None = option(None, "level after it")
    state: str | None = option(None, "state after it")
    reason: str = option("", "text that the reason contains")


@dataclass(frozen=True, slots=True)
class ExpectedAlarm:
    """A change of an alarm that must come; all changes of all alarms are listed."""

    at: float | None = option(None, "when, after the first value; any time when absent", unit="s")
    of: str = option("", "component")
    state: Literal["open", "acknowledged", "shelved", "healed"] = option("open", "state after it")
    severity: Literal["warning", "urgent", "critical", "fatal"] | None = option(None, "severity")
    count: int | None = option(None, "how often it has opened")
    reason: str = option("", "text that the reason contains")


@dataclass(frozen=True, slots=True)
class Loss:
    """A publisher of an item is known to be lost for some time."""

    item: str = option(doc="item, or the input as the mode file has it")
    at: float = option(doc="when it is lost, after the first value", unit="s")
    until: float | None = option(None, "when it is back; never when absent", unit="s")
    reason: str = option("publisher lost", "reason of the gap")


@dataclass(frozen=True, slots=True)
class RuleTest:
    """One test: what comes in, and what is expected."""

    test: str = option(doc="what is tested, in a few words")
    interval: float | None = option(None, "time from one value to the next", unit="s")
    series: Mapping[str, Series] = option({}, "values by variable, item or input")
    rows: Mapping[str, Mapping[str, Series]] = option(
        {}, "values of several columns of an item, or of what a probe measures"
    )
    received: Mapping[str, Series] = option({}, "messages received in each interval, by item")
    stamps: Mapping[str, Series] = option(
        {}, "own stamps of an item's rows, s after the first value"
    )
    lost: Sequence[Loss] = option((), "publishers that are lost")
    expect: Sequence[ExpectedStatus] = option((), "statuses at times")
    transitions: Sequence[ExpectedTransition] | None = option(None, "changes that must come")
    alarms: Sequence[ExpectedAlarm] | None = option(None, "changes of alarms that must come")

    def check(self) -> Iterator[Finding]:
        """Refuse a test that cannot fail."""
        if not self.expect and self.transitions is None and self.alarms is None:
            yield "nothing is expected: give 'expect', 'transitions' or 'alarms'"
        if self.transitions is not None and not self.transitions:
            yield "transitions", "name at least one; an initialisation is a transition, too"
        if self.interval is not None and not self.interval > 0:
            yield "interval", "must be above 0"


@dataclass(frozen=True, slots=True)
class RuleFile:
    """A ``*.test.yaml`` file."""

    tests: Sequence[RuleTest] = option(doc="the tests")
    of: str = option("", "component, or component/mode, that is meant where 'of' is absent")
    interval: float = option(1.0, "time from one value to the next", unit="s")
    mode: Any = option(None, "a mode file's text, to test a mode without a robot")

    def check(self) -> Iterator[Finding]:
        """Refuse what no test can run with."""
        if not self.interval > 0:
            yield "interval", "must be above 0"


class Rules(NamedTuple):
    """A file that has been read: what it says, where it says it, and the folder it is for."""

    file: RuleFile
    node: Node
    folder: Path

    @property
    def mode(self) -> Node | None:
        """The mode that the file brings along; None if it tests those of its robot."""
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
class Found:
    """Test files of a folder, and what is wrong with them."""

    rules: list[Rules] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def read_rules(path: Path, name: str, folder: Path, problems: list[Problem]) -> Rules | None:
    """Read one file, called ``name`` in messages; None if anything is wrong with it."""
    node = load_yaml(path, problems, name)
    built = build(RuleFile, node, problems) if node is not None else None
    return Rules(built, node, folder) if built is not None and node is not None else None


def find_rules(folder: Path, skip: Path | None = None) -> Found:
    """Read every test file below a folder, in order; ``skip`` is a folder not to look into."""
    found = Found()
    for path in sorted(folder.rglob(PATTERN)):
        if skip is not None and path.is_relative_to(skip):
            continue
        rules = read_rules(path, str(path), folder, found.problems)
        found.rules += [rules] if rules is not None else []
    return found


def _entries(node: Node, key: str) -> list[Node]:
    child = (node.mapping or {}).get(key)
    return list(child.items or ()) if child is not None else []
