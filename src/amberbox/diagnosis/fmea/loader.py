"""Load ``fmea.yaml``: entries resolved to failure modes, components and functions, and checked.

Checks are of names, cycles, effects, and modes that nothing detects.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from amberbox.core.config import build, raise_errors
from amberbox.core.errors import AmberboxError, Problem, did_you_mean
from amberbox.core.expression import Expression, parse
from amberbox.core.expressions.tree import (
    AddressNode,
    AgeNode,
    ArithmeticNode,
    CallNode,
    ExpressionNode,
    WindowNode,
    children,
    of_monitors,
)
from amberbox.core.names import is_id
from amberbox.core.needs import NOTHING, Needs, all_of, cycles, parse_needs
from amberbox.core.options import option
from amberbox.core.types import TestKind
from amberbox.core.units import is_same_unit, per_second
from amberbox.core.yaml_nodes import Node, load_yaml, parse_yaml
from amberbox.diagnosis.fmea.blind_spots import few, indistinguishable, unexplained_notes
from amberbox.diagnosis.fmea.findings import (
    map_findings,
    named_by_findings,
    readers_of,
    unusual_findings,
)
from amberbox.diagnosis.fmea.model import (
    DependencyStructure,
    ExpectedOutcome,
    FailureMode,
    Fmea,
    FmeaComponent,
    FmeaFunction,
    FmeaReferences,
    FmeaSymptom,
    FmeaTest,
    FollowingMode,
    ModeEffects,
    RiskRanks,
    SizeDistribution,
    SizeScale,
    SymptomLink,
    SymptomMeasure,
    UnlistedFault,
    links_by_mode,
    miss_probability,
)
from amberbox.diagnosis.fmea.parser import (
    DefaultsFile,
    ExpandedComponent,
    FailureModeFile,
    FmeaFile,
    FunctionFile,
    LeadsToFile,
    LinkFile,
    MemberFile,
    MemberFunctionFile,
    ParsedFmea,
    RanksFile,
    ResultFile,
    ScalesFile,
    SizeFile,
    SymptomFile,
    TestFile,
    TypeFile,
    child_keys,
    child_node,
    rate_notes,
    read,
)
from amberbox.diagnosis.fmea.runs import MINUTE_S, RunCollector


@dataclass(frozen=True)
class Vocabulary:
    """One taxonomy: its source, and the meaning of each word, paraphrased."""

    source: str = option(doc="publication that the words come from")
    words: Mapping[str, str] = option(doc="meaning of each word")


@cache
def vocabularies() -> Mapping[str, Vocabulary]:
    """Return the taxonomies by name."""
    problems: list[Problem] = []
    node = load_yaml(Path(__file__).with_name("vocabulary.yaml"), problems)
    entries = (node.mapping if node else None) or {}
    built = {name: build(Vocabulary, entry, problems, name) for name, entry in entries.items()}
    raise_errors(problems)
    return {name: entry for name, entry in built.items() if entry is not None}


def resolve(word: str) -> str:
    """Return a class in full (``steinbauer.hardware``); a word of one taxonomy needs no more.

    Raises ValueError with a sentence for the person who wrote it.
    """
    full = [f"{name}.{entry}" for name, of in vocabularies().items() for entry in of.words]
    if word in full:
        return word
    matches = [name for name in full if name.endswith(f".{word}")]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise ValueError(f"'{word}' is ambiguous: {' or '.join(matches)}")
    short = [name.partition(".")[2] for name in full]
    raise ValueError(f"there is no class '{word}'{did_you_mean(word, [*full, *short])}")


class SymptomCollector:
    """Collects the symptoms that entries refer to, and those that the file names."""

    def __init__(
        self, defaults: DefaultsFile, known: FmeaReferences | None, problems: list[Problem]
    ) -> None:
        self._defaults = defaults
        self._named: dict[str, SymptomFile] = {}
        self._known = known
        self._problems = problems
        self.found: dict[str, FmeaSymptom] = {}

    def links(
        self, entries: Sequence[str | LinkFile], node: Node, where: str, owner: str
    ) -> tuple[SymptomLink, ...]:
        """Return the links of a cause; ``node`` is the list in the file.

        ``owner`` is the id of the cause: ``component#mode`` may use names of its component.
        """
        found = []
        for place, entry in enumerate(entries):
            at = f"{where}[{place}]"
            link = entry if isinstance(entry, LinkFile) else LinkFile(entry)
            symptom = self._symptom(link, child_node(node, place), at, f"{owner}.{place}")
            if symptom is not None:
                self._judge_size(symptom, link, child_node(node, place), at)
                found.append(self._link(symptom, link))
        for name in _twice(link.symptom for link in found):
            self._problems.append(node.problem(where, f"'{name}' is there twice"))
        return tuple(link for link in found if link.detects > 0)

    def address(self, text: str, node: Node, where: str) -> str | None:
        """Return the address of a monitor's output; None, and a problem, if there is none."""
        if self._known is None or text in self._known.outputs:
            return text
        near = did_you_mean(text, self._known.outputs)
        self._problems.append(node.problem(where, f"there is no output '{text}'{near}"))
        return None

    def _symptom(self, link: LinkFile, node: Node, where: str, name: str) -> FmeaSymptom | None:
        if link.when is not None:
            when = self._condition(link.when, child_node(node, "when"), where)
            made = FmeaSymptom(name, when, self._defaults.leak)
            return self.found.setdefault(name, made) if when is not None else None
        for text in (f"{name.partition('#')[0]}.{link.symptom}", link.symptom):
            if text in self.found and self.found[text].condition is not None:
                return self.found[text]
        return self._output(link.symptom, child_node(node, "symptom"), where)

    def _output(self, text: str, node: Node, where: str) -> FmeaSymptom | None:
        known = self._known
        if known is not None and text not in known.outputs:
            candidates = [*known.watched, *self._named]
            what = f"there is no symptom '{text}'{did_you_mean(text, candidates)}"
            hint = "write COMPONENT/MODE/OUTPUT of a monitor, or a name under 'symptoms'"
            self._problems.append(node.problem(where, what, hint))
            return None
        if known is not None and text not in known.watched:
            what = f"nothing is expected of '{text}', so that it is never bad"
            hint = "give the output 'expected', or write a condition: {when: ...}"
            self._problems.append(node.problem(where, what, hint))
            return None
        if known is None and text.count("/") != 2 and text not in self._named:
            what = f"there is no symptom '{text}'{did_you_mean(text, self._named)}"
            self._problems.append(node.problem(where, what))
            return None
        return self.found.setdefault(text, FmeaSymptom(text, None, self._defaults.leak))

    def _link(self, symptom: FmeaSymptom, link: LinkFile) -> SymptomLink:
        """Make the link; a symptom waits as long as the slowest of its links."""
        default = self._defaults
        named = self._named.get(symptom.id)
        detects = default.detects if link.detects is None else link.detects
        within_s = _first(link.within_s, named.within_s if named else None, default.within_s)
        within_s = max(within_s, *link.after_s) if link.after_s else within_s
        hold_s = _first(link.hold_s, named.hold_s if named else None, default.hold_s)
        self.found[symptom.id] = replace(
            symptom,
            within_s=max(symptom.within_s, within_s),
            hold_s=max(symptom.hold_s, hold_s),
        )
        return SymptomLink(
            symptom.id, detects, within_s, hold_s, interval(link.after_s),
            distribution(link.size),
        )  # fmt: skip

    def _judge_size(self, symptom: FmeaSymptom, link: LinkFile, node: Node, where: str) -> None:
        if link.size is not None and symptom.scale is None and not self._is_wrong(symptom.id):
            what = f"has a size, but nothing measures {symptom.id}, or its edges are missing"
            hint = f"symptoms: {{{symptom.id}: {{measure: ..., edges: [2, 5, 10]}}}}"
            self._problems.append(child_node(node, "size").problem(where, what, hint))

    def _is_wrong(self, name: str) -> bool:
        """Return whether an entry has edges, but no scale: that is reported already."""
        entry = self._named.get(name)
        return entry is not None and bool(entry.edges)

    def _made(self, name: str, entry: SymptomFile, node: Node, where: str) -> FmeaSymptom:
        leak = _first(entry.leak, None, self._defaults.leak)
        within_s, hold_s = entry.within_s or 0.0, entry.hold_s or 0.0
        return FmeaSymptom(
            name, entry.when, leak, within_s, hold_s, entry.description, entry.by_itself,
            self._scale(name, entry, node, where),
        )  # fmt: skip

    def _scale(self, name: str, entry: SymptomFile, node: Node, where: str) -> SizeScale | None:
        """Return the scale of a symptom's size; report one that cannot be measured."""
        if not entry.edges:
            if entry.measure is not None:
                what = "is of no use without edges: [2, 5, 10] are sizes that differ"
                self._problems.append(child_node(node, "measure").problem(f"{where}.measure", what))
            return None
        measures = self._known.measures if self._known else None
        measure: SymptomMeasure | None
        if entry.measure is not None:
            measure = self._measure(entry, node, where)
        elif measures is None:  # monitors that are not known may measure it
            measure = SymptomMeasure(parse("null"))
        elif (measure := measures.get(name)) is None:
            what = f"nothing measures how large {name} is: give measure: ..."
            self._problems.append(child_node(node, "edges").problem(f"{where}.edges", what))
        if measure is None:
            return None
        unit = self._unit(measure, entry.unit, child_node(node, "unit"), f"{where}.unit")
        if unit is None:
            return None
        return SizeScale(replace(measure, unit=unit), tuple(entry.edges), entry.settle_s)

    def _unit(self, measure: SymptomMeasure, stated: str, node: Node, where: str) -> str | None:
        """Return the unit of a measure; None, and a problem, if another one is stated."""
        units = self._known.units if self._known else {}
        own = dict(stated_units(measure.expression.tree, units))
        if measure.unit:
            own = {"what its monitor measures": measure.unit}
        for name, unit in own.items() if stated else ():
            if not is_same_unit(unit, stated):
                what = f"{name} is in {unit}, not in {stated}; values are not converted"
                self._problems.append(node.problem(where, what))
                return None
        return stated or next(iter(own.values()), "")

    def _measure(self, entry: SymptomFile, node: Node, where: str) -> SymptomMeasure | None:
        """Return the measure that an entry states, with its addresses resolved."""
        expression, place = entry.measure, child_node(node, "measure")
        assert expression is not None, "an entry with a measure"
        if expression.kind not in ("number", "any"):
            what = "is no number: it does not say how large the symptom is"
            self._problems.append(place.problem(f"{where}.measure", what))
            return None
        found = self._resolved(expression, place, f"{where}.measure")
        return None if found is None else SymptomMeasure(found)

    def add(
        self, entries: Mapping[str, SymptomFile], node: Node, where: str, component: str = ""
    ) -> None:
        """Add symptoms with a name or address; a component's names are ``component.name``.

        Reports symptoms that are neither an output nor a condition, and resolves conditions.
        """
        for short, entry in entries.items():
            place = child_node(node, short)
            name = f"{component}.{short}" if component and "/" not in short else short
            self._named[name] = entry
            self.found[name] = self._made(name, entry, place, f"{where}.{short}")
            self._judge(name, entry, place, f"{where}.{short}")

    def _judge(self, name: str, entry: SymptomFile, place: Node, where: str) -> None:
        if entry.when is None:
            self.address(name, place, where)
            return
        when = self._condition(entry.when, child_node(place, "when"), f"{where}.when")
        self.found[name] = replace(self.found[name], condition=when or entry.when)

    def _condition(self, when: Expression, node: Node, where: str) -> Expression | None:
        if when.kind not in ("condition", "any"):
            self._problems.append(node.problem(where, "is no condition: it is never true or false"))
            return None
        return self._resolved(when, node, where)

    def _resolved(self, expression: Expression, node: Node, where: str) -> Expression | None:
        addresses = self._known.addresses if self._known else None
        if addresses is None:
            return expression
        try:
            return expression.resolve(addresses)
        except AmberboxError as error:
            self._problems.append(node.problem(where, error.what, error.hint))
            return None


def interval(after_s: Sequence[float]) -> tuple[float, float] | None:
    """Return an interval of times; None if none is given."""
    return (after_s[0], after_s[1]) if after_s else None


def distribution(size: SizeFile | None) -> SizeDistribution | None:
    """Return a distribution of sizes; None if none is given."""
    if size is None:
        return None
    if size.uniform:
        return SizeDistribution("uniform", *size.uniform)
    return SizeDistribution("normal", *size.normal)


def stated_units(tree: ExpressionNode, units: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the units of an expression by the parts that state them; none where it is not known.

    Sums, limits and means are in the unit of what they read, ``age`` is in s, ``rate`` per second.
    """
    if isinstance(tree, AddressNode) and tree.name in units:
        yield tree.name, units[tree.name]
    elif isinstance(tree, AgeNode):
        yield f"age({tree.inner.name})", "s"
    elif isinstance(tree, WindowNode) and tree.name == "rate":
        for name, unit in stated_units(tree.inner, units):
            yield f"rate({name})", per_second(unit)
    elif not (
        (isinstance(tree, WindowNode | CallNode) and tree.name not in _SAME_UNIT)
        or (isinstance(tree, ArithmeticNode) and tree.operator not in ("+", "-"))
    ):
        for part in children(tree):
            yield from stated_units(part, units)


_SAME_UNIT = ("abs", "min", "max", "median", "mean", "std")


def _first(value: float | None, other: float | None, default: float) -> float:
    if value is not None:
        return value
    return default if other is None else other


def _twice(names: Iterator[str]) -> Iterator[str]:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            yield name
        seen.add(name)


def make_test(
    name: str, entry: TestFile, node: Node, symptoms: SymptomCollector, runs: RunCollector
) -> FmeaTest:
    """Make a test; report one that reads an unknown output, or runs what does not exist."""
    if entry.experiment:
        return runs.make("experiment", entry.experiment, name, entry, node)
    if entry.unit_test:
        return runs.make("unit_test", entry.unit_test, name, entry, node)
    kind: TestKind = "question" if entry.question else "check" if entry.look else "read"
    text = entry.question or entry.look or entry.text or f"Read off {entry.read}."
    if entry.read:
        symptoms.address(entry.read, child_node(node, "read"), f"tests.{name}.read")
    return FmeaTest(
        name, kind, text, entry.role, _first(entry.minutes, None, 1.0) * MINUTE_S, entry.risk,
        tuple(entry.outcomes), entry.sure,
    )  # fmt: skip


def test_outcomes(
    given: Mapping[str, str | ResultFile],
    part: ExpandedComponent,
    tests: Mapping[str, FmeaTest],
    node: Node,
    problems: list[Problem],
) -> Iterator[ExpectedOutcome]:
    """Yield the outcomes of tests for a mode; ``node`` is the mapping in the file."""
    for name, entry in given.items():
        place = child_node(node, name)
        test_id = next((key for key in (f"{part.component}.{name}", name) if key in tests), None)
        result = ResultFile(entry) if isinstance(entry, str) else entry
        if test_id is None and name in child_keys(part.node, "tests"):
            continue  # it is wrong, and reported already
        if test_id is None:
            short = [key.removeprefix(f"{part.component}.") for key in tests]
            what = f"there is no test '{name}'{did_you_mean(name, short)}"
            problems.append(place.problem("tests", what))
        elif result.outcome not in tests[test_id].outcomes:
            known = tests[test_id].outcomes
            near = did_you_mean(result.outcome, known)
            what = f"the test gives no '{result.outcome}'{near}"
            problems.append(place.problem(f"tests.{name}", what, f"it gives {', '.join(known)}"))
        else:
            yield ExpectedOutcome(test_id, result.outcome, result.detects)


@dataclass(frozen=True, slots=True)
class EntryScope:
    """What entries refer to, and the failure modes found so far."""

    file: FmeaFile
    symptoms: SymptomCollector
    tests: Mapping[str, FmeaTest]
    problems: list[Problem]
    modes: dict[str, FailureMode] = field(default_factory=dict)


def make_component(part: ExpandedComponent) -> FmeaComponent:
    """Make a component."""
    modes = tuple(f"{part.component}#{name}" for name in part.modes)
    return FmeaComponent(part.component, part.type, part.file.description, part.needs, modes)


def make_function(name: str, entry: FunctionFile, node: Node, scope: EntryScope) -> FmeaFunction:
    """Make a function."""
    where = f"functions.{name}"
    needs = parse_needs(child_node(node, "needs"), scope.problems, f"{where}.needs") or NOTHING
    place = child_node(node, "symptoms")
    links = scope.symptoms.links(entry.symptoms, place, f"{where}.symptoms", name)
    if not is_id(name):
        scope.problems.append(node.problem(where, f"'{name}' is no id: a-z 0-9 _ . - only"))
    if any(link.after_s is not None for link in links):
        what = "after_s is for symptoms of failure modes: a loss begins with one of them"
        scope.problems.append(place.problem(f"{where}.symptoms", what))
    return FmeaFunction(name, needs, entry.description, entry.system, entry.severity, links)


def add_failure_mode(part: ExpandedComponent, name: str, scope: EntryScope) -> None:
    """Make a failure mode and add it to the scope."""
    entry, node = part.modes[name], part.mode_node(name)
    where = f"types.{part.type}.failure_modes.{name}"
    mode_id = f"{part.component}#{name}"
    if not is_id(name):
        scope.problems.append(node.problem(where, f"'{name}' is no id: a-z 0-9 _ . - only"))
    symptoms = child_node(node, "symptoms")
    links = scope.symptoms.links(entry.symptoms, symptoms, f"{where}.symptoms", mode_id)
    rate, probability = _chance(entry, part.file, scope.file.scales, node, where, scope)
    results = test_outcomes(
        entry.tests, part, scope.tests, child_node(node, "tests"), scope.problems
    )
    exposure_h = scope.file.exposure_h if entry.exposure_h is None else entry.exposure_h
    mode = FailureMode(
        mode_id, part.component, name, entry.description, entry.cause,
        tuple(_classes(entry.classes, node, where, scope.problems)),
        entry.severity, rate, probability, exposure_h, entry.beta, RiskRanks(),
        ModeEffects(entry.effects.local, tuple(entry.effects.next), tuple(entry.effects.system)),
        links, entry.unobservable, tuple(results), entry.remedy, entry.takes_down,
        entry.intermittent, node.line, entry.make_safe, tuple(entry.recovery),
    )  # fmt: skip
    scope.modes[mode_id] = with_ranks(mode, entry.ranks, scope.file.scales)


def tie_modes(sheet: ParsedFmea, scope: EntryScope) -> None:
    """Add which modes exclude each other and which follow from others, once all are known."""
    for part in sheet.parts:
        along = {name: part.modes[name].along_with for name in part.modes}
        for name, entry in part.modes.items():
            mode_id, node = f"{part.component}#{name}", part.mode_node(name)
            where = f"types.{part.type}.failure_modes.{name}"
            for place, other in enumerate(entry.along_with):
                if other not in part.modes:
                    at = child_node(child_node(node, "with"), "along_with", place)
                    what = f"{part.component} has no mode '{other}'"
                    near = did_you_mean(other, part.modes)
                    scope.problems.append(at.problem(f"{where}.with", f"{what}{near}"))
            excluded = {
                f"{part.component}#{other}"
                for other in part.modes
                if other != name and other not in along[name] and name not in along[other]
            }
            scope.modes[mode_id] = replace(
                scope.modes[mode_id],
                excludes=frozenset(excluded if sheet.file.defaults.exclusive else ()),
                leads_to=tuple(_following(entry, part, node, where, scope)),
            )
    scope.problems.extend(_tie_problems(sheet, scope.modes))


def _following(
    entry: FailureModeFile, part: ExpandedComponent, node: Node, where: str, scope: EntryScope
) -> Iterator[FollowingMode]:
    for name, given in entry.leads_to.items():
        place = child_node(node, "leads_to", name)
        follows = given if isinstance(given, LeadsToFile) else LeadsToFile(given)
        effect = name if "#" in name else f"{part.component}#{name}"
        if effect not in scope.modes:
            near = did_you_mean(effect, scope.modes)
            what = f"there is no failure mode '{effect}'{near}"
            scope.problems.append(place.problem(f"{where}.leads_to", what))
        elif not 0 <= follows.p <= 1:
            what = f"{follows.p:g} is no probability from 0 to 1"
            scope.problems.append(place.problem(f"{where}.leads_to", what))
        else:
            yield FollowingMode(effect, follows.p, interval(follows.after_s))


def _tie_problems(sheet: ParsedFmea, modes: Mapping[str, FailureMode]) -> Iterator[Problem]:
    """Yield circles of consequences, and consequences that their causes exclude."""
    places = {
        f"{part.component}#{name}": (part.mode_node(name), part)
        for part in sheet.parts
        for name in part.modes
    }
    follows = {name: all_of(*(one.mode for one in mode.leads_to)) for name, mode in modes.items()}
    for circle in cycles(follows):
        node, part = places[circle[-1]]
        what = f"leads to itself: {' -> '.join((*circle, circle[0]))}"
        yield child_node(node, "leads_to").problem(f"types.{part.type}.failure_modes", what)
    for name, mode in modes.items():
        for one in mode.leads_to:
            if one.mode in mode.excludes:
                node, part = places[name]
                what = f"it leads to {one.mode}, which it excludes: write with: [...]"
                where = f"types.{part.type}.failure_modes"
                yield child_node(node, "leads_to").problem(where, what)


def with_ranks(mode: FailureMode, given: RanksFile, scales: ScalesFile) -> FailureMode:
    """Return the mode with S, O and D: by hand, else from the tables of the file."""
    s, o, d = (given.s, given.o, given.d)
    return replace(
        mode,
        ranks=RiskRanks(
            scales.severity.get(mode.severity) if s is None else s,
            _rank(scales.occurrence, _hourly(mode)) if o is None else o,
            _rank(scales.detection, miss_probability(mode.symptoms)) if d is None else d,
        ),
    )


def _hourly(mode: FailureMode) -> float:
    if mode.rate is not None:
        return mode.rate
    return (mode.probability or 0.0) / mode.exposure_h if mode.exposure_h else 0.0


def _rank(table: Mapping[str, float], value: float) -> int | None:
    """Return the lowest rank whose bound holds; the highest of the table if none does."""
    rows = sorted((int(rank), bound) for rank, bound in table.items())
    if not rows:
        return None
    return next((rank for rank, bound in rows if value <= bound), rows[-1][0])


def _chance(
    entry: FailureModeFile,
    of: TypeFile,
    scales: ScalesFile,
    node: Node,
    where: str,
    scope: EntryScope,
) -> tuple[float | None, float | None]:
    """Return rate and probability, one of which is None."""
    if entry.probability is not None:
        return None, entry.probability
    if entry.rate is not None:
        return entry.rate, None
    if entry.ratio is not None:
        return entry.ratio * (of.rate or 0.0), None
    rate = scales.occurrence.get(str(entry.ranks.o))
    if rate is None:
        what = f"the table scales.occurrence has no rank {entry.ranks.o}"
        scope.problems.append(child_node(node, "ranks").problem(where, what))
    return rate, None


def _classes(
    words: Sequence[str], node: Node, where: str, problems: list[Problem]
) -> Iterator[str]:
    place = child_node(child_node(node, "class"), "classes")
    for word in words:
        try:
            yield resolve(word)
        except ValueError as error:
            problems.append(place.problem(f"{where}.class", str(error)))


LOST = "lost"  # name of the failure mode of a member's function


def member_folders(robots: Mapping[str, MemberFile], folder: Path) -> dict[str, str]:
    """Return the folder of each robot for which the file gives one."""
    paths = {robot: folder / member.where for robot, member in robots.items() if member.where}
    places = {name: p.parent if p.suffix == ".yaml" else p for name, p in paths.items()}
    return {name: os.path.normpath(place) for name, place in places.items()}


def member_components(
    robots: Mapping[str, MemberFile], root: Node, scope: EntryScope, folder: Path
) -> dict[str, FmeaComponent]:
    """Return a component ``robot:function`` for each function that the team needs of a robot."""
    found: dict[str, FmeaComponent] = {}
    for robot, member in robots.items():
        node = child_node(root, "robots", robot)
        offered = _offered(member, node, scope, folder)
        for name, entry in member.functions.items():
            place = child_node(node, "functions", name)
            where = f"robots.{robot}.functions.{name}"
            if offered is not None and name not in offered:
                what = f"{robot} has no function '{name}'{did_you_mean(name, offered)}"
                scope.problems.append(place.problem(where, what))
            component, words = f"{robot}:{name}", (offered or {}).get(name) or name
            text = f"the robot {robot} cannot: {words}"
            _lost(component, text, entry, place, where, scope)
            found[component] = FmeaComponent(component, "robot", modes=(f"{component}#{LOST}",))
    return found


def _offered(
    member: MemberFile, node: Node, scope: EntryScope, folder: Path
) -> dict[str, str] | None:
    """Return the functions in the robot's own file, with descriptions; None if it does not exist
    (yet).
    """
    path = folder / member.where
    path = path / "fmea.yaml" if path.is_dir() else path
    if not member.where or not path.is_file():
        if member.where:
            what = f"{member.where} is not there yet: its functions are not compared"
            scope.problems.append(child_node(node, "where").problem("where", what, is_error=False))
        return None
    root = load_yaml(path, scope.problems)
    functions = (root.mapping or {}).get("functions") if root else None
    found = (functions.mapping or {}) if functions else {}
    return {name: _description(function) for name, function in found.items()}


def _description(function: Node) -> str:
    described = (function.mapping or {}).get("description")
    return str(described.value) if described else ""


def _lost(
    component: str,
    text: str,
    entry: MemberFunctionFile,
    node: Node,
    where: str,
    scope: EntryScope,
) -> None:
    mode_id = f"{component}#{LOST}"
    place = child_node(node, "symptoms")
    links = scope.symptoms.links(entry.symptoms, place, f"{where}.symptoms", mode_id)
    if (entry.rate is None) == (entry.probability is None):
        scope.problems.append(node.problem(where, "how probable is it? give probability or rate"))
    for key, what in entry.wrong():
        scope.problems.append(child_node(node, key).problem(f"{where}.{key}", what))
    scope.problems.extend(rate_notes(entry.rate, node, where))
    mode = FailureMode(
        mode_id, component, LOST, text,
        severity=entry.severity, rate=entry.rate, probability=entry.probability,
        exposure_h=scope.file.exposure_h, symptoms=links, unobservable=entry.unobservable,
        remedy=entry.remedy, line=node.line, make_safe=entry.make_safe,
    )  # fmt: skip
    scope.modes[mode_id] = with_ranks(mode, RanksFile(), scope.file.scales)


def check(
    fmea: Fmea, sheet: ParsedFmea, known: FmeaReferences | None, problems: list[Problem]
) -> Fmea | None:
    """Return the analysis with all effects filled in; None if names or needs are wrong."""
    found = [*_name_problems(fmea, sheet, known), *_circles(fmea, sheet)]
    problems += _not_analysed(fmea, sheet, known) if known else ()
    problems += found
    if any(problem.is_error for problem in found):
        return None
    places = {f"{part.component}#{name}": part.mode_node(name)
              for part in sheet.parts for name in part.modes}  # fmt: skip
    reach = _Reach.of(fmea)
    problems += _mode_problems(fmea, reach, places, sheet)
    modes = {
        name: replace(mode, effects=_effects(fmea, reach, mode))
        for name, mode in fmea.modes.items()
    }
    if not any(problem.is_error for problem in problems):
        problems += _look_the_same(fmea, sheet)
        problems += unexplained_notes(fmea, known, sheet.root.file) if known else ()
    return replace(fmea, modes=modes)


def _look_the_same(fmea: Fmea, sheet: ParsedFmea) -> Iterator[Problem]:
    """Yield a note for each component with modes that nothing tells apart."""
    groups = indistinguishable(fmea)
    for part in sheet.parts:
        alike = [
            few([name.partition("#")[2] for name in modes])
            for modes in groups.get(part.component, ())
        ]
        if alike:
            what = f"nothing tells apart: {few(alike, '; ')}"
            hint = "give one of them a symptom, a size or a test of its own, or make them one mode"
            place = child_node(part.node, "failure_modes")
            yield place.problem(f"{part.type}.failure_modes", what, hint, is_error=False)


@dataclass(frozen=True, slots=True)
class _Reach:
    """What needs each component: next to it, and in the end."""

    next: Mapping[str, tuple[str, ...]]
    all: Mapping[str, frozenset[str]]

    @classmethod
    def of(cls, fmea: Fmea) -> _Reach:
        structure = DependencyStructure.of(fmea.needs())
        reached = {name: structure.dependents([name]) for name in fmea.components}
        return cls(structure.users, reached)


def _name_problems(
    fmea: Fmea, sheet: ParsedFmea, known: FmeaReferences | None
) -> Iterator[Problem]:
    names = {*fmea.components, *sheet.names}
    for name in fmea.functions:
        if name in fmea.components:
            what = f"'{name}' is a component and a function"
            yield child_node(sheet.root, "functions", name).problem(f"functions.{name}", what)
    for user, of in fmea.needs().items():
        for name in of.names():
            if name not in names:
                what = f"there is no component or function '{name}'{did_you_mean(name, names)}"
                hint = "" if known else "components of a robot folder are known with the folder"
                yield _needs_node(user, sheet, name).problem(f"{user}.needs", what, hint)


def _not_analysed(fmea: Fmea, sheet: ParsedFmea, known: FmeaReferences) -> Iterator[Problem]:
    """Yield notes on components of the folder without an entry in the file."""
    needed = {name: user for user, of in fmea.needs().items() for name in of.names()}
    read = [a for of in fmea.symptoms.values() if of.condition for a in of.condition.addresses()]
    symptoms = {of_mode[0] for name in (*fmea.symptoms, *read) if (of_mode := of_monitors(name))}
    hint = f"give it failure_modes under 'types' of {sheet.root.file}"
    for name in sheet.folder:
        user = needed.get(name, "")
        if user in fmea.functions or any(part.component == user for part in sheet.parts):
            what = f"of '{name}' no failure mode is known: it fails only with what it needs"
            place = _needs_node(user, sheet, name)
            yield place.problem(f"{user}.needs", what, hint, is_error=False)
        elif name in known.files and name not in symptoms:
            what = f"'{name}' is monitored, but no failure mode is known: no diagnosis names it"
            yield Problem(known.files[name], 1, "component", what, hint, is_error=False)


def _needs_node(user: str, sheet: ParsedFmea, name: str = "") -> Node:
    """Return the node of a component's or function's need, if possible that of the name itself."""
    part = next((part for part in sheet.parts if part.component == user), None)
    node = child_node(part.node if part else child_node(sheet.root, "functions", user), "needs")
    return next((leaf for leaf in _leaves(node) if name and leaf.text == name), node)


def _leaves(node: Node) -> Iterator[Node]:
    for entry in (*(node.items or ()), *(node.mapping or {}).values()):
        yield from _leaves(entry)
    if node.items is None and node.mapping is None:
        yield node


def _circles(fmea: Fmea, sheet: ParsedFmea) -> Iterator[Problem]:
    for circle in cycles(fmea.needs()):
        what = f"needs itself: {' -> '.join((*circle, circle[0]))}"
        yield _needs_node(circle[-1], sheet, circle[0]).problem(f"{circle[-1]}.needs", what)


def _mode_problems(
    fmea: Fmea, reach: _Reach, places: Mapping[str, Node], sheet: ParsedFmea
) -> Iterator[Problem]:
    links = links_by_mode(fmea)
    found = named_by_findings(fmea)
    sized = {link.symptom for of in links.values() for link in of if link.size is not None}
    for mode in fmea.modes.values():
        node = places.get(mode.id) or _member_node(mode, sheet)
        yield from _effect_problems(fmea, reach, mode, node, sheet)
        for link in mode.symptoms:
            if link.size is None and link.symptom in sized:
                what = f"no size of {link.symptom}, for which other modes give one: any will do"
                where = f"{mode.name}.symptoms"
                yield child_node(node, "symptoms").problem(where, what, is_error=False)
        has_none = child_node(node, "symptoms") is node  # wrong ones are reported already
        shows = links[mode.id] or mode.id in found
        if has_none and not mode.unobservable and not shows:
            what = "nothing shows it: give symptoms, or 'unobservable:' with the reason"
            yield node.problem(mode.name, what)


def _member_node(mode: FailureMode, sheet: ParsedFmea) -> Node:
    robot, _, function = mode.component.partition(":")
    return child_node(sheet.root, "robots", robot, "functions", function)


def _effect_problems(
    fmea: Fmea, reach: _Reach, mode: FailureMode, node: Node, sheet: ParsedFmea
) -> Iterator[Problem]:
    names = {*fmea.components, *sheet.names}
    reached = reach.all[mode.component]
    for key, stated in (("next", mode.effects.next), ("system", mode.effects.system)):
        for place, name in enumerate(stated):
            where = f"{mode.name}.effects.{key}"
            at = child_node(node, "effects", key, place)
            if name not in names:
                what = f"there is no function '{name}'{did_you_mean(name, names)}"
                yield at.problem(where, what)
            elif name not in reached and mode.takes_down:
                what = f"{name} does not need {mode.component}, directly or not"
                yield at.problem(where, what, is_error=False)


def _effects(fmea: Fmea, reach: _Reach, mode: FailureMode) -> ModeEffects:
    """Return the effects that follow from needs: direct users, and functions of the system."""
    stated = mode.effects
    if not mode.takes_down:
        return stated
    users = reach.next.get(mode.component, ())
    reached = reach.all[mode.component]
    system = tuple(name for name in fmea.system_functions() if name in reached)
    return ModeEffects(stated.local, stated.next or users, stated.system or system)


FILE = "fmea.yaml"  # its name in a robot folder


def load_fmea(
    path: str | Path, known: FmeaReferences | None = None
) -> tuple[Fmea | None, list[Problem]]:
    """Read a file; return the analysis (None if anything is wrong) and all problems and notes.

    Without ``known``, symptoms are not compared with what monitors the robot has.
    """
    problems: list[Problem] = []
    node = load_yaml(Path(path), problems)
    return _loaded(node, known, problems, Path(path).parent)


def read_fmea(
    text: str, known: FmeaReferences | None = None, name: str = FILE
) -> tuple[Fmea | None, list[Problem]]:
    """Read the text of a file as ``load_fmea`` does; ``name`` is its name in messages."""
    problems: list[Problem] = []
    return _loaded(parse_yaml(text, name, problems), known, problems, Path())


def _loaded(
    node: Node | None, known: FmeaReferences | None, problems: list[Problem], folder: Path
) -> tuple[Fmea | None, list[Problem]]:
    fmea = _made(node, known, problems, folder) if node is not None else None
    # Keep one of the problems that all instances of a type share, in the order of the file.
    kept: dict[tuple[str, int, str], Problem] = {}
    for problem in problems:
        kept.setdefault((problem.file, problem.line, problem.where), problem)
    found = sorted(kept.values(), key=lambda problem: (problem.file, problem.line))
    return (None if any(p.is_error for p in found) else fmea), found


def _made(
    root: Node, known: FmeaReferences | None, problems: list[Problem], folder: Path
) -> Fmea | None:
    sheet = read(root, known, problems)
    symptoms = _symptoms(sheet, known, problems)
    tests = _tests(sheet, symptoms, RunCollector(known, problems))
    scope = EntryScope(sheet.file, symptoms, tests, problems)
    for part in sheet.parts:
        for name in part.modes:
            add_failure_mode(part, name, scope)
    tie_modes(sheet, scope)
    functions = {
        name: make_function(name, entry, child_node(root, "functions", name), scope)
        for name, entry in sheet.functions.items()
    }
    components = {part.component: make_component(part) for part in sheet.parts}
    components |= member_components(sheet.robots, root, scope, folder)
    components |= _of_folder(components, functions, sheet)
    conditions = {n: one.condition for n, one in symptoms.found.items() if one.condition}
    file = sheet.file.other
    other = UnlistedFault(
        file.probability, file.detects, file.looks_like, file.together_s, file.share,
        tuple(file.shows),
    )  # fmt: skip
    findings = map_findings(sheet, scope.modes, known, problems)
    unusual = unusual_findings(scope.modes, conditions, known, sheet.file.defaults, findings)
    fmea = Fmea(
        sheet.file.description, scope.modes, components, functions, symptoms.found, scope.tests,
        other, sheet.file.exposure_h, findings,
        member_folders(sheet.robots, folder), sheet.file.remember_s,
        unusual, readers_of(known),
    )  # fmt: skip
    return check(fmea, sheet, known, problems)


def _of_folder(
    components: Mapping[str, FmeaComponent],
    functions: Mapping[str, FmeaFunction],
    sheet: ParsedFmea,
) -> dict[str, FmeaComponent]:
    """Return the components without an entry that others need, directly or not.

    A component in a cycle of the folder's dependencies is taken to need nothing.
    """
    users = {name: component.needs for name, component in components.items()}
    users |= {name: function.needs for name, function in functions.items()}
    found: dict[str, FmeaComponent] = {}
    waiting = [name for needs in users.values() for name in needs.names()]
    while waiting:
        name = waiting.pop()
        if name in sheet.folder and name not in found:
            found[name] = FmeaComponent(name, "", needs=sheet.folder[name])
            waiting += sheet.folder[name].names()
    while circle := _first_circle(users | {name: of.needs for name, of in found.items()}, found):
        found |= {name: FmeaComponent(name, "") for name in circle}
    return found


def _first_circle(needs: Mapping[str, Needs], among: Mapping[str, FmeaComponent]) -> list[str]:
    """Return components on a cycle of needs, in order; none if there is no cycle."""
    parts = ([name for name in circle if name in among] for circle in cycles(needs))
    return next(filter(None, parts), [])


def _symptoms(
    sheet: ParsedFmea, known: FmeaReferences | None, problems: list[Problem]
) -> SymptomCollector:
    symptoms = SymptomCollector(sheet.file.defaults, known, problems)
    symptoms.add(sheet.symptoms, child_node(sheet.root, "symptoms"), "symptoms")
    for part in sheet.parts:
        where, place = f"types.{part.type}.symptoms", child_node(part.node, "symptoms")
        symptoms.add(part.symptoms, place, where, part.component)
    return symptoms


def _tests(
    sheet: ParsedFmea, symptoms: SymptomCollector, runs: RunCollector
) -> Mapping[str, FmeaTest]:
    tests = {
        name: make_test(name, entry, child_node(sheet.root, "tests", name), symptoms, runs)
        for name, entry in sheet.tests.items()
    }
    for part in sheet.parts:
        for name, entry in part.tests.items():
            test_id = f"{part.component}.{name}"
            tests[test_id] = make_test(
                test_id, entry, child_node(part.node, "tests", name), symptoms, runs
            )
    return tests
