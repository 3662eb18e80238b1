"""The keys of ``fmea.yaml``, and its entries parsed with types expanded to their instances.

A wrong entry does not hide what else is wrong; ``docs/robot/fmea.md`` describes the keys.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

from amberbox.core.config import build
from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.expression import Expression
from amberbox.core.names import is_id
from amberbox.core.needs import NOTHING, Needs, parse_needs
from amberbox.core.options import option
from amberbox.core.robot_status import Severity
from amberbox.core.yaml_nodes import Node
from amberbox.diagnosis.fmea.model import FmeaReferences

Finding = str | tuple[str, str]
_MOST = 1e9  # no time, rate or exposure is larger; sums of times stay within 64 bits of nanoseconds
# A higher rate is a failure every few minutes: likely the time between failures was meant
MOST_PER_HOUR = 1.0
MOST_EDGES = 20
MOST_SHOWS = 4
_LEAST_PERCENT = 2.0  # A share from here on was meant in percent; 1.2 may as well be 1 with a slip


@dataclass(frozen=True)
class DefaultsFile:
    """Defaults of entries."""

    detects: float = option(0.99, "how probable a symptom shows when its cause is there")
    leak: float = option(1e-4, "how probable a symptom shows although no cause of it is there")
    within_s: float = option(60.0, "so long after a cause began a symptom may come", unit="s")
    hold_s: float = option(0.0, "so long a symptom that has gone is remembered", unit="s")
    exclusive: bool = option(False, "whether modes of one component exclude each other")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _shares(self, "detects", "leak")
        yield from _not_below_zero(self, "within_s", "hold_s")


@dataclass(frozen=True)
class OtherFile:
    """The failure mode for all that is not in this file."""

    probability: float = option(1e-3, "how probable it is that something else is broken")
    detects: float = option(0.05, "how probable that shows in a symptom, whichever")
    looks_like: float = option(0.0, "how probable it looks like a failure mode, of several at once")
    together_s: float = option(10.0, "so short after each other these begin", unit="s")
    share: float = option(0.0, "share of the faults of a component that are not in this file")
    shows: Sequence[float] = option(
        (1.0, 8.0), "numbers of symptoms that such a fault shows on average, equally often"
    )

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _shares(self, "probability", "detects", "looks_like", "share")
        yield from _not_below_zero(self, "together_s")
        if self.share == 1:
            yield "share", "1 would leave no fault for the failure modes of this file"
        if not self.shows or any(not 0 < number <= _MOST for number in self.shows):
            yield "shows", "must be numbers above 0: [1, 8]"
        elif len(self.shows) > MOST_SHOWS:
            yield "shows", f"has more than {MOST_SHOWS} numbers"


@dataclass(frozen=True)
class ScalesFile:
    """Tables from 1 (good) to 10 (bad)."""

    severity: Mapping[str, int] = option({}, "S of each severity: {fatal: 10}")
    occurrence: Mapping[str, float] = option({}, "failures per hour, at most, of each O: {1: 1e-7}")
    detection: Mapping[str, float] = option(
        {}, "share that no symptom shows, at most, of each D: {1: 0.001}"
    )

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        words = Severity.__args__  # type: ignore[attr-defined]  # a Literal has its words there
        for word, rank in self.severity.items():
            if word not in words:
                yield "severity", f"there is no severity '{word}': {', '.join(words)}"
            elif not 1 <= rank <= 10:
                yield "severity", f"{rank} is no rank from 1 to 10"
        for key in ("occurrence", "detection"):
            for rank in getattr(self, key):
                if not rank.isdigit() or not 1 <= int(rank) <= 10:
                    yield key, f"'{rank}' is no rank from 1 to 10"


@dataclass(frozen=True)
class RanksFile:
    """Ranks given by hand."""

    s: int | None = option(None, "severity from 1 to 10")
    o: int | None = option(None, "occurrence from 1 to 10")
    d: int | None = option(None, "detection from 1 (always seen) to 10 (never)")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        for key in ("s", "o", "d"):
            rank = getattr(self, key)
            if rank is not None and not 1 <= rank <= 10:
                yield key, f"{rank} is no rank from 1 to 10"


@dataclass(frozen=True)
class SizeFile:
    """How large a symptom is when its cause is there; negative sizes have the other sign."""

    uniform: Sequence[float] = option((), "from and to, all equally probable")
    normal: Sequence[float] = option((), "mean and standard deviation")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        if bool(self.uniform) == bool(self.normal):
            yield "give either uniform: [from, to] or normal: [mean, sd]"
            return
        key = "uniform" if self.uniform else "normal"
        values = self.uniform or self.normal
        if len(values) != 2 or not all(map(math.isfinite, values)):
            yield key, "expected two numbers"
        elif self.uniform and not values[0] < values[1]:
            yield key, f"nothing is from {values[0]:g} to {values[1]:g}"
        elif self.normal and values[1] <= 0:
            yield key, "the standard deviation must be above 0"


@dataclass(frozen=True)
class LeadsToFile:
    """A failure mode that may follow from another one."""

    p: float = option(doc="how probable it follows")
    after_s: Sequence[float] = option((), "so long afterwards: [from, to]; any time if absent")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _shares(self, "p")
        yield from _delay(self)


@dataclass(frozen=True)
class LinkFile:
    """One symptom of a failure mode or of a lost function."""

    symptom: str = option("", "address of a monitor's output, or a name under 'symptoms'")
    when: Expression | None = option(None, "a condition instead, true when it shows")
    detects: float | None = option(None, "how probable it shows when the cause is there")
    within_s: float | None = option(None, "so long after the cause began it may come", unit="s")
    hold_s: float | None = option(None, "so long it is remembered when it has gone", unit="s")
    after_s: Sequence[float] = option((), "it begins so long after the cause: [from, to], seconds")
    size: SizeFile | None = option(None, "how large it is then, in the unit of its measure")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        if bool(self.symptom) == (self.when is not None):
            yield "give either 'symptom' or 'when'"
        yield from _shares(self, "detects")
        yield from _not_below_zero(self, "within_s", "hold_s")
        yield from _delay(self)


@dataclass(frozen=True)
class SymptomFile:
    """A condition with a name, or what holds for an address wherever it is used."""

    when: Expression | None = option(None, "condition; absent for the address of an output")
    leak: float | None = option(None, "how probable it shows although no cause is there")
    within_s: float | None = option(None, "so long after a cause began it may come", unit="s")
    hold_s: float | None = option(None, "so long it is remembered when it has gone", unit="s")
    by_itself: bool = option(False, "whether what its component needs has no part in it")
    description: str = option("", "what it is")
    measure: Expression | None = option(None, "how large it is, signed: temp - 45")
    unit: str = option("", "unit of the measure")
    edges: Sequence[float] = option((), "sizes that differ: above 0, rising")
    settle_s: float = option(
        2.0, "the largest size of so long after its beginning counts", unit="s"
    )

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _shares(self, "leak")
        yield from _not_below_zero(self, "within_s", "hold_s", "settle_s")
        if any(not 0 < edge < math.inf for edge in self.edges):
            yield "edges", "must be above 0"
        elif any(not low < high for low, high in pairwise(self.edges)):
            yield "edges", "must rise: [2, 5, 10]"
        if len(self.edges) > MOST_EDGES:
            yield "edges", f"are more than {MOST_EDGES}"


@dataclass(frozen=True)
class EffectsFile:
    """The effects of a failure mode."""

    local: str = option("", "what its component does then, as text")
    next: Sequence[str] = option((), "components and functions that it harms directly")
    system: Sequence[str] = option((), "functions of the system that it harms in the end")


@dataclass(frozen=True)
class ResultFile:
    """The outcome of a test when the failure mode is present."""

    outcome: str = option(doc="one of the test's outcomes")
    detects: float = option(0.95, "how probable it gives that")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _shares(self, "detects")


@dataclass(frozen=True)
class FailureModeFile:
    """One failure mode."""

    description: str = option("", "what is wrong, for a technician")
    classes: Sequence[str] = option((), "words of the vocabularies", aliases=("class",))
    cause: str = option("", "why it happens")
    severity: Severity = option("urgent", "warning, urgent, critical or fatal")
    probability: float | None = option(None, "how probable it is to be there, at any time")
    rate: float | None = option(None, "failures per hour")
    ratio: float | None = option(None, "share of the component's failures (alpha); needs its rate")
    beta: float = option(1.0, "how probable the effect on the system is, given the failure")
    exposure_h: float | None = option(None, "hours that it had to come about", unit="h")
    ranks: RanksFile = option(RanksFile(), "S, O and D by hand", aliases=("sod",))
    effects: EffectsFile = option(EffectsFile(), "local, next, system")
    symptoms: Sequence[str | LinkFile] = option((), "how it shows")
    unobservable: str = option("", "why nothing shows it, instead of symptoms")
    tests: Mapping[str, str | ResultFile] = option({}, "outcome of tests when it is there")
    remedy: str = option("", "what to do about it")
    recovery: Sequence[str] = option((), "actions of the robot that may help")
    make_safe: str = option("", "what to do first, before anybody tests or repairs it")
    takes_down: bool = option(True, "whether the component stops serving")
    intermittent: bool = option(False, "whether it comes and goes")
    along_with: Sequence[str] = option(
        (), "modes of the component that it does not exclude", aliases=("with",)
    )
    leads_to: Mapping[str, float | LeadsToFile] = option(
        {}, "failure modes that may follow from it: how probable, and when"
    )

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _shares(self, "probability", "ratio", "beta")
        yield from _not_below_zero(self, "rate", "exposure_h")
        given = [key for key in ("probability", "rate", "ratio") if getattr(self, key) is not None]
        if len(given) > 1:
            yield given[1], f"give one of {' and '.join(given)}"
        if not given and self.ranks.o is None:
            yield "how probable is it? give probability, rate, ratio or ranks: {o: ...}"
        if self.symptoms and self.unobservable:
            yield "unobservable", "it has symptoms, so it is not unobservable"


@dataclass(frozen=True)
class TestFile:
    """A test that a person or a program can do."""

    question: str = option("", "what somebody is asked")
    look: str = option("", "what somebody looks at or measures", aliases=("check",))
    read: str = option("", "address of an output that somebody reads off")
    experiment: str = option("", "name of an experiment (`experiments/`) that is run")
    unit_test: str = option("", "name of a unit test (`tests/`) that is run")
    text: str = option("", "how to read it, or what is run", aliases=("how",))
    passed: str = option("", "answer of a run that passes; the first outcome if not given")
    moves: bool | None = option(None, "whether the robot moves in the run; else as it declares")
    role: str = option("", "who can do it: operator, technician ...")
    minutes: float | None = option(
        None, "how long it takes; else as the experiment declares, or 1", unit="min"
    )
    risk: float = option(0.0, "how probable it does harm")
    outcomes: Sequence[str] = option(("no", "yes"), "answers; the first is a sound robot's")
    sure: float = option(0.99, "how probable the first answer is when nothing is wrong with it")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        keys = ("question", "look", "read", "experiment", "unit_test")
        given = [key for key in keys if getattr(self, key)]
        if len(given) != 1:
            yield "give one of question, check, read, experiment and unit_test"
        elif self.experiment or self.unit_test:
            if len(self.outcomes) != 2:
                yield "outcomes", "a run passes or fails: it has two answers"
            elif self.passed and self.passed not in self.outcomes:
                yield "passed", f"is none of the answers, {' and '.join(self.outcomes)}"
        else:
            for key in ("passed", "moves"):
                if getattr(self, key) not in ("", None):
                    yield key, "belongs to an experiment or a unit test"
        yield from _shares(self, "risk", "sure")
        yield from _not_below_zero(self, "minutes")
        if len(set(self.outcomes)) != len(self.outcomes) or len(self.outcomes) < 2:
            yield "outcomes", "a test has at least two different answers"


@dataclass(frozen=True)
class TypeFile:
    """A kind of component: its failure modes are written once."""

    description: str = option("", "what it is")
    needs: Any = option(None, "what it needs; otherwise what its component file says")
    rate: float | None = option(None, "failures per hour of the component, for 'ratio'")
    failure_modes: Any = option(None, "how it fails", aliases=("modes",))
    tests: Any = option(None, "tests of each instance")
    symptoms: Any = option(None, "conditions with a name, of each instance")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _not_below_zero(self, "rate")


@dataclass(frozen=True)
class FunctionFile:
    """A function of the robot."""

    needs: Any = option(doc="components and functions that it needs")
    description: str = option("", "what it is")
    system: bool = option(False, "whether its loss is an effect on the system")
    severity: Severity = option("urgent", "what its loss means for the robot")
    symptoms: Sequence[str | LinkFile] = option((), "how its loss shows")


@dataclass(frozen=True)
class FindingFile:
    """A finding of another engine, and the failure modes that it indicates."""

    rule: str = option("", "a goal of rules/*.pl; each answer is a finding")
    finding: str = option("", "a detector's finding instead, by its id")
    maps_to: Sequence[str] = option((), "failure modes; <Variable> stands for its value")
    detects: float | None = option(None, "how probable it is found when one of them is there")
    leak: float | None = option(None, "how probable it is found although none of them is there")
    proves: bool = option(False, "whether at least one of them is there for sure")
    description: str = option("", "what it means, for a technician")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        if bool(self.rule) == bool(self.finding):
            yield "give either 'rule' or 'finding'"
        yield from _shares(self, "detects", "leak")
        if self.proves and not self.maps_to:
            yield "proves", "what does it prove? give maps_to: [component#mode, ...]"
        for key in ("detects", "leak") if self.proves else ():
            if getattr(self, key) is not None:
                yield key, "what is proven has no probability"


@dataclass(frozen=True)
class MemberFunctionFile:
    """A function of a robot as a part of its team."""

    probability: float | None = option(None, "how probable it is lost")
    rate: float | None = option(None, "losses per hour")
    severity: Severity = option("urgent", "what its loss means for the team")
    symptoms: Sequence[str | LinkFile] = option((), "how its loss shows to the team")
    unobservable: str = option("", "why nothing shows it")
    remedy: str = option("", "what to do about it")
    make_safe: str = option("", "what to do first, before anybody tests or repairs it")

    def wrong(self) -> Iterator[tuple[str, str]]:
        """Yield each value out of its range, by key; the functions beside it are checked, too."""
        yield from _shares(self, "probability")
        yield from _not_below_zero(self, "rate")


@dataclass(frozen=True)
class MemberFile:
    """A robot of the team."""

    where: str = option("", "its fmea.yaml or its folder, seen from this file")
    functions: Mapping[str, MemberFunctionFile] = option({}, "what the team wants of it")


@dataclass(frozen=True)
class FmeaFile:
    """The whole file."""

    description: str = option("", "what it is about")
    exposure_h: float = option(24.0, "hours since all was known to be well", unit="h")
    remember_s: float = option(
        600.0, "so long a symptom that nobody can look at goes on to count", unit="s"
    )
    defaults: DefaultsFile = option(DefaultsFile(), "what counts where an entry does not say it")
    other: OtherFile = option(OtherFile(), "something that is not in this file")
    scales: ScalesFile = option(ScalesFile(), "tables for S, O and D")
    types: Any = option(None, "kinds of components with their failure modes")
    instances: Any = option(None, "components of each type")
    functions: Any = option(None, "what the robot can do")
    symptoms: Any = option(None, "conditions with a name; leaks of outputs")
    tests: Any = option(None, "tests of no component in particular")
    robots: Any = option(None, "members of the team, one level down")
    findings: Any = option(None, "what other engines find, and what it speaks for")

    def check(self) -> Iterator[Finding]:
        """Yield the errors."""
        yield from _not_below_zero(self, "exposure_h", "remember_s")


def _shares(entry: object, *keys: str) -> Iterator[tuple[str, str]]:
    """Yield each value that is no probability."""
    for key in keys:
        value = getattr(entry, key)
        if value is not None and not 0 <= value <= 1:
            side = "above 1" if value > 1 else "below 0"
            meant = f"; did you mean {value / 100:g}?" if _LEAST_PERCENT <= value <= 100 else ""
            yield key, f"{value:g} is {side}: expected a share from 0 to 1{meant}"


def _delay(entry: LinkFile | LeadsToFile) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with an interval of time."""
    after_s = entry.after_s
    if not after_s:
        return
    if len(after_s) != 2 or not 0 <= after_s[0] <= _MOST or not 0 <= after_s[1] <= _MOST:
        yield "after_s", "expected two times from 0 on, in seconds: [0, 30]"
    elif after_s[0] > after_s[1]:
        yield "after_s", f"nothing is from {after_s[0]:g} to {after_s[1]:g}"


def _not_below_zero(entry: object, *keys: str) -> Iterator[tuple[str, str]]:
    for key in keys:
        value = getattr(entry, key)
        if value is not None and value < 0:
            yield key, f"{value:g} lies below 0"
        elif value is not None and value > _MOST:
            yield key, f"{value:g} is more than {_MOST:,.0f}"


def child_node(node: Node, *keys: str | int) -> Node:
    """Follow keys and list indices down a tree, as far as they exist."""
    for key in keys:
        if isinstance(key, int):
            node = (node.items or ())[key] if key < len(node.items or ()) else node
        else:
            node = (node.mapping or {}).get(key, node)
    return node


_PARAMETER = re.compile(r"<([a-z_][a-z0-9_]*)>")


@dataclass(frozen=True, slots=True)
class TypeInstance:
    """A component with the node of its type, parameters filled in."""

    component: str
    type: str
    node: Node


def type_instances(root: Node, problems: list[Problem]) -> list[TypeInstance]:
    """Return all components; a type that ``instances`` does not name is its own only one."""
    types = _mapping(root, "types", problems)
    given = _mapping(root, "instances", problems)
    for name, node in given.items():
        if name not in types:
            what = f"there is no type '{name}'{did_you_mean(name, types)}"
            problems.append(node.problem("instances", what))
    found: list[TypeInstance] = []
    for name, node in types.items():
        found += _of_type(name, node, given.get(name), problems)
    return _each_once(found, problems)


def _mapping(root: Node, key: str, problems: list[Problem]) -> Mapping[str, Node]:
    node = (root.mapping or {}).get(key)
    if node is None or node.value is None:
        return {}
    if node.mapping is None:
        what = f"expected a mapping (key: value), got {node.kind}"
        problems.append(node.problem(key, what))
    return node.mapping or {}


def _of_type(
    name: str, node: Node, given: Node | None, problems: list[Problem]
) -> Iterator[TypeInstance]:
    for component, place, parameters in _named(name, node, given, problems):
        if not is_id(component):
            what = f"'{component}' is no id: a-z 0-9 _ . - only"
            problems.append(place.problem(f"instances.{name}", what))
            continue
        values = {"component": component, **parameters}
        yield TypeInstance(component, name, _filled(node, values, f"types.{name}", problems))


def _named(
    name: str, node: Node, given: Node | None, problems: list[Problem]
) -> Iterator[tuple[str, Node, Mapping[str, str]]]:
    """Yield the components of a type: a list of names, or names with their parameters."""
    if given is None:
        yield name, node, {}
    elif given.items is not None:
        for entry in given.items:
            yield entry.text, entry, {}
    elif given.mapping is not None:
        for component, entry in given.mapping.items():
            yield component, entry, {k: v.text for k, v in (entry.mapping or {}).items()}
    else:
        what = "expected a list of names, or names with parameters"
        problems.append(given.problem(f"instances.{name}", what))


def _each_once(found: list[TypeInstance], problems: list[Problem]) -> list[TypeInstance]:
    """Keep the first of several components with one name."""
    kept: dict[str, TypeInstance] = {}
    for entry in found:
        first = kept.setdefault(entry.component, entry)
        if first is not entry:
            what = f"the component '{entry.component}' is there already, as {first.type}"
            problems.append(entry.node.problem(f"types.{entry.type}", what))
    return list(kept.values())


def _filled(node: Node, values: Mapping[str, str], where: str, problems: list[Problem]) -> Node:
    """Return a copy of a tree with the parameters filled in."""
    if node.items is not None:
        return replace(node, value=tuple(_filled(n, values, where, problems) for n in node.items))
    if node.mapping is not None:
        entries = {
            _text(key, entry, values, where, problems): _filled(entry, values, where, problems)
            for key, entry in node.mapping.items()
        }
        return replace(node, value=entries)
    if not isinstance(node.value, str) or "<" not in node.value:
        return node
    text = _text(node.value, node, values, where, problems)
    return replace(node, value=text, text=text)


def _text(
    text: str, node: Node, values: Mapping[str, str], where: str, problems: list[Problem]
) -> str:
    def value(match: re.Match[str]) -> str:
        if match[1] not in values:
            what = f"there is no parameter <{match[1]}>{did_you_mean(match[1], values)}"
            problems.append(node.problem(where, what, f"known: {', '.join(values)}"))
        return values.get(match[1], match[0])

    return _PARAMETER.sub(value, text)


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ExpandedComponent:
    """A component as the file has it: its type written out."""

    component: str
    type: str
    file: TypeFile
    node: Node
    needs: Needs
    modes: Mapping[str, FailureModeFile]
    tests: Mapping[str, TestFile]
    symptoms: Mapping[str, SymptomFile]

    def mode_node(self, name: str) -> Node:
        """Return the node of a failure mode."""
        return child_node(_modes_node(self.node), name)


@dataclass(frozen=True, slots=True)
class ParsedFmea:
    """Everything that could be read, and the names of all entries.

    ``folder`` has the components that only the robot folder has, with their needs.
    """

    root: Node
    file: FmeaFile
    parts: Sequence[ExpandedComponent]
    functions: Mapping[str, FunctionFile]
    tests: Mapping[str, TestFile]
    symptoms: Mapping[str, SymptomFile]
    robots: Mapping[str, MemberFile]
    names: frozenset[str]
    folder: Mapping[str, Needs]
    findings: Sequence[tuple[Node, FindingFile]] = ()


def read(root: Node, known: FmeaReferences | None, problems: list[Problem]) -> ParsedFmea:
    """Read the file; wrong entries are left out and reported."""
    file = build(FmeaFile, root, problems) or FmeaFile()
    found = type_instances(root, problems)
    here = {entry.component for entry in found} | set(child_keys(root, "functions"))
    others = {name: of for name, of in (known.needs if known else {}).items() if name not in here}
    names = here | others.keys()
    return ParsedFmea(
        root,
        file,
        [_part(entry, names, known, problems) for entry in found],
        dict(_entries(FunctionFile, root, "functions", problems)),
        dict(_entries(TestFile, root, "tests", problems)),
        dict(_entries(SymptomFile, root, "symptoms", problems)),
        dict(_entries(MemberFile, root, "robots", problems)),
        frozenset(names),
        {name: of.restricted(names.__contains__) for name, of in others.items()},
        list(_findings(root, problems)),
    )


def child_keys(node: Node, key: str) -> tuple[str, ...]:
    """Return the names of the entries below a key."""
    entry = (node.mapping or {}).get(key)
    return tuple((entry.mapping if entry else None) or ())


def _part(
    entry: TypeInstance, names: set[str], known: FmeaReferences | None, problems: list[Problem]
) -> ExpandedComponent:
    """Read a type for one of its components."""
    where = f"types.{entry.type}"
    file = build(TypeFile, entry.node, problems, where) or TypeFile()
    node = entry.node
    key = "failure_modes" if _modes_node(node) is child_node(node, "failure_modes") else "modes"
    modes = dict(_entries(FailureModeFile, node, key, problems, where))
    problems += rate_notes(file.rate, node, where)
    for name, mode in modes.items():
        problems += rate_notes(mode.rate, child_node(node, key, name), f"{where}.{key}.{name}")
    problems += _ratio_problems(file, modes, node, where)
    return ExpandedComponent(
        entry.component,
        entry.type,
        file,
        node,
        _needs(node, entry.component, names, known, problems),
        modes,
        dict(_entries(TestFile, node, "tests", problems, where)),
        dict(_entries(SymptomFile, node, "symptoms", problems, where)),
    )


def _modes_node(node: Node) -> Node:
    entries = child_node(node, "failure_modes")
    return child_node(node, "modes") if entries is node else entries


def _needs(
    node: Node,
    component: str,
    names: set[str],
    known: FmeaReferences | None,
    problems: list[Problem],
) -> Needs:
    """Return the needs of the type, else those of the component's own file.

    Of the latter, names that are not in this file are taken to be up.
    """
    entry = (node.mapping or {}).get("needs")
    if entry is not None:
        where = f"{component}.needs"
        return parse_needs(entry, problems, where, may_be_empty=True) or NOTHING
    inherited = known.needs.get(component, NOTHING) if known else NOTHING
    return inherited.restricted(names.__contains__)


def _entries(
    cls: type[T], node: Node, key: str, problems: list[Problem], where: str = ""
) -> Iterator[tuple[str, T]]:
    """Yield the entries below a key that can be read."""
    place = (node.mapping or {}).get(key)
    where = f"{where}.{key}" if where else key
    if place is None or place.value is None:
        return
    if place.mapping is None:
        what = f"expected a mapping (key: value), got {place.kind}"
        problems.append(place.problem(where, what))
    for name, entry in (place.mapping or {}).items():
        built = build(cls, entry, problems, f"{where}.{name}")
        if built is not None:
            yield name, built


def _findings(root: Node, problems: list[Problem]) -> Iterator[tuple[Node, FindingFile]]:
    """Yield the findings of other engines, each with its node."""
    place = (root.mapping or {}).get("findings")
    if place is None or place.value is None:
        return
    if place.items is None:
        problems.append(
            place.problem("findings", f"expected a list (- rule: ...), got {place.kind}")
        )
    for number, entry in enumerate(place.items or ()):
        built = build(FindingFile, entry, problems, f"findings[{number}]")
        if built is not None:
            yield entry, built


def rate_notes(rate: float | None, node: Node, where: str) -> Iterator[Problem]:
    """Yield a note on a rate per hour that no part of a robot has."""
    if rate is not None and rate > MOST_PER_HOUR:
        hours = 1 / rate
        every = f"{hours * 60:.3g} min" if hours * 60 >= 1 else f"{hours * 3600:.3g} s"
        what = f"{rate:g} per hour is one failure every {every}; did you mean {hours:.3g}?"
        hint = "a rate is failures per hour: 1 / (hours between two failures)"
        yield child_node(node, "rate").problem(f"{where}.rate", what, hint, is_error=False)


def _ratio_problems(
    file: TypeFile, modes: Mapping[str, FailureModeFile], node: Node, where: str
) -> Iterator[Problem]:
    """Yield the errors in shares of a component's failures."""
    ratios = {name: mode.ratio for name, mode in modes.items() if mode.ratio is not None}
    place = _modes_node(node)
    if sum(ratios.values()) > 1 + 1e-9:
        what = f"their ratios sum up to {sum(ratios.values()):g}, more than 1"
        yield place.problem(f"{where}.failure_modes", what)
    for name in ratios if file.rate is None else ():
        what = "it has a ratio, but the type has no rate"
        yield child_node(place, name).problem(f"{where}.failure_modes.{name}", what)
