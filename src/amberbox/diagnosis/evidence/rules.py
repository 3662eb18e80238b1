"""Evidence from rules: facts they build on, what they find, what they conclude by themselves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from amberbox.core.config import raise_errors
from amberbox.core.contracts import (
    Budget,
    Conflict,
    EvidenceItem,
    EvidenceNeeds,
    EvidenceWindow,
    Finding,
)
from amberbox.core.errors import ConfigurationError, UsageError
from amberbox.core.types import Diagnosis, Hypothesis, Symptom
from amberbox.diagnosis.diagnose import (
    DiagnosisContext,
    DiagnosisId,
    Measured,
    ObservedSituation,
    answer,
    diagnosis_id_of,
    measured,
)
from amberbox.diagnosis.fmea.findings import faults_of, finding_instances, symptom_of
from amberbox.diagnosis.fmea.model import FailureMode, FindingMapping, Fmea, FmeaReferences
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.prolog.machine import (
    ProofNode,
    Virtual,
)
from amberbox.diagnosis.prolog.program import Fact, Program, reachable, read_rules
from amberbox.diagnosis.prolog.query import Answer, ask, python_value
from amberbox.diagnosis.prolog.syntax import read_goal, write
from amberbox.diagnosis.prolog.terms import RuleError, StoppedError, key_of, show_key

RULES = "rules"
"""Where they are in a robot folder."""


def rule_files(folder: Path) -> list[Path]:
    """Return the rule files of a robot folder, by name."""
    return sorted((folder / RULES).glob("*.pl"))


def with_rules(known: FmeaReferences, folder: Path) -> FmeaReferences:
    """Return the references of failure modes, with the names that a folder's rules define.

    Rules that cannot be read define no names: ``amberbox check`` reports their errors, and the
    robot is diagnosed without them meanwhile.
    """
    try:
        program = read_rules(rule_files(folder))
    except ConfigurationError:
        return known
    heads = {key: (place.file, place.line) for key, place in program.heads.items()}
    return replace(known, predicates=frozenset(program.known), heads=heads)


FMEA = "fmea.yaml"
SEEN = "symptoms"
"""Origin of facts about symptoms, as shown in proofs."""


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts besides the rules' own.

    ``seen`` are facts of an instant, each with the data it was measured from. ``lookups`` are
    predicates that query a record.
    """

    known: tuple[Fact, ...] = ()
    seen: tuple[tuple[Fact, Measured], ...] = ()
    lookups: tuple[Virtual, ...] = ()

    def added_to(self, program: Program) -> Program:
        """Return the program with all of them.

        Raises RuleError for a predicate that a file defines and that is a lookup as well.
        """
        for lookup in self.lookups:
            own = program.predicates.get(lookup.key)
            if own is not None and own.clauses:
                what = f"{own.clauses[0].place}: {show_key(lookup.key)} is looked up in the record"
                raise RuleError(what, "give the predicate of the file another name")
        seen = [fact for fact, _ in self.seen]
        added = program.with_facts(self.known, FMEA).with_facts(seen, SEEN)
        return added.with_virtual(*self.lookups)


def fmea_facts(
    fmea: Fmea, exposure_h: float | None = None, parts: Mapping[str, str] | None = None
) -> Iterator[Fact]:
    """Yield the facts of an FMEA; ``parts`` maps each component to the one it is part of."""
    for component in fmea.components.values():
        yield "component", component.id
        yield "type", component.id, component.type
    yield from (("part_of", name, whole) for name, whole in (parts or {}).items())
    yield from (("function", name) for name in fmea.functions)
    for user, needs in fmea.needs().items():
        yield from (("needs", user, name) for name in dict.fromkeys(needs.names()))
    for mode in fmea.modes.values():
        yield from _mode_facts(mode, exposure_h)
    yield from (("symptom", name) for name in fmea.symptoms)
    yield from (("test", test.id, test.text) for test in fmea.tests.values())


def _mode_facts(mode: FailureMode, exposure_h: float | None) -> Iterator[Fact]:
    of = mode.component, mode.name
    yield "failure_mode", *of
    yield "severity", *of, mode.severity
    yield "probability", *of, mode.chance(exposure_h)
    if mode.ranks.number is not None:
        yield "risk", *of, mode.ranks.number
    for name, text in (("cause", mode.cause), ("remedy", mode.remedy)):
        if text:
            yield name, *of, text
    yield from (("class", *of, word) for word in mode.classes)
    harmed = dict.fromkeys((*mode.effects.next, *mode.effects.system))
    yield from (("effect", *of, name) for name in harmed)
    yield from (("shows", *of, link.symptom) for link in mode.symptoms)
    yield from (("outcome", *of, given.test, given.outcome) for given in mode.tests)


def known_facts(robot: str, fmea: Fmea | None, exposure_h: float | None = None) -> Iterator[Fact]:
    """Yield the facts of a robot without its record."""
    if robot:
        yield "robot", robot
    if fmea is not None:
        yield from fmea_facts(fmea, exposure_h)
        yield from (("part_of", name, robot) for name in fmea.components if robot)


def seen_facts(symptoms: Iterable[Symptom], fmea: Fmea) -> Iterator[tuple[Fact, Measured]]:
    """Yield ``present``, ``absent`` and ``unknown`` of symptoms, all of the FMEA included.

    A symptom whose component is blocked by a dependency is unknown.
    """
    stated = {}
    for symptom in symptoms:
        state = "unknown" if symptom.blocked_by else symptom.state
        stated[symptom.id] = (state, symptom.id), measured(symptom)
    unknown: dict[str, tuple[Fact, Measured]] = {
        name: (("unknown", name), ()) for name in fmea.symptoms if name not in stated
    }
    yield from (stated | unknown).values()


SOURCE = "rules"
_BESIDE_OTHERS = 1.0 - 1e-9
"""Strength of a finding: if a monitor uses the same measurement, the monitor counts first."""
_MOST_SHOWN = 20
_STATUS = ("status", "state")


@dataclass(frozen=True, slots=True)
class RuleFindings:
    """The findings of rules.

    ``symptoms`` are ``rule:GOAL``, ``conflicts`` sets of failure modes of which one is certainly
    present, ``findings`` texts that indicate no failure mode. ``proofs`` are those of each symptom
    and each conflict (its failure modes joined by `` or ``).
    """

    symptoms: tuple[Symptom, ...] = ()
    conflicts: tuple[frozenset[str], ...] = ()
    findings: tuple[str, ...] = ()
    proofs: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[frozenset[str], str] = field(default_factory=dict)
    """The finding that proves each conflict."""

    def items(self) -> Iterator[EvidenceItem]:
        """Yield them as evidence."""
        yield from self.symptoms
        for conflict in self.conflicts:
            proof, name = self.proofs[_name(conflict)], self.names.get(conflict, "")
            yield Conflict(conflict, SOURCE, proof, name)
        yield from (Finding(text, SOURCE) for text in self.findings)

    def faults(self, fmea: Fmea) -> dict[str, list[str]]:
        """Return the failure modes that they indicate, with the proofs."""
        found: dict[str, list[str]] = {}
        for conflict in self.conflicts:
            for mode in conflict:
                found.setdefault(mode, []).append(self.proofs[_name(conflict)])
        present = {symptom.id for symptom in self.symptoms}
        for name, modes in _mapped_symptoms(fmea):
            for mode in modes if name in present else ():
                found.setdefault(mode, []).append(self.proofs[name])
        return found


def rule_findings(
    program: Program,
    fmea: Fmea,
    facts: Facts,
    at_ns: int | None = None,
    budget: Budget | None = None,
    *,
    all_heads: bool = False,
) -> RuleFindings:
    """Query the rules that ``findings:`` of the FMEA names; ``all_heads``: others, too.

    A rule without an answer is no evidence. A goal that cannot be answered, or not within the
    budget, is named among the findings. Raises ConfigurationError for rules that call undefined
    predicates.
    """
    collected = _Collected(fmea, _by_component(facts), facts, at_ns)
    asked = facts.added_to(program)
    for of in fmea.findings:
        if of.goal:
            collected.take(of, asked, budget)
    for goal in _heads(program, fmea) if all_heads else ():
        collected.take(FindingMapping(goal), asked, budget)
    return collected.findings()


ALONE = "By the rules alone, which weigh nothing else:"
NOTHING = "nothing follows from them"
NO_ANSWERS = "answers to tests count for nothing where the rules alone are asked"
_NEEDS = EvidenceNeeds(history_s=86_400.0)
_OF_SYMPTOMS = EvidenceNeeds()
LOOKED_UP = frozenset({
    *("holds", "holds_throughout", "mission", "mission_name", "mission_parameter"),
    *("now", "state", "status"),
})  # fmt: skip
"""Predicates whose answers come from the record, and change as it grows."""
_CALLS = frozenset({"call", "maplist", "foldl", "include", "exclude"})  # may call any of them


def needs(knowledge: Knowledge, folder: Path) -> EvidenceNeeds | None:
    """Return that rules need a day of the record, if those that the FMEA names look anything up.

    None for a folder without rules; raises ConfigurationError with all their problems.
    """
    if not rule_files(folder):
        return None
    goals = [read_goal(of.goal).term for of in knowledge.fmea.findings if of.goal]
    names = {name for name, _ in reachable(goals, _program(knowledge, folder).known)}
    return _NEEDS if names & (LOOKED_UP | _CALLS) else _OF_SYMPTOMS


def provide(knowledge: Knowledge, window: EvidenceWindow) -> Iterator[EvidenceItem]:
    """Yield the findings of the folder's rules; raises ConfigurationError with all problems."""
    program = _with_known_facts(_RobotRules(window.folder, knowledge))
    facts = _facts(knowledge, window)
    yield from rule_findings(program, knowledge.fmea, facts, window.at_ns).items()


def alone(knowledge: Knowledge, window: EvidenceWindow, case: DiagnosisContext) -> Diagnosis | None:
    """Return the diagnosis by the folder's rules; raises UsageError if it has none."""
    if not rule_files(window.folder):
        raise UsageError(f"there are no rules/*.pl in {window.folder}", "see docs/robot/rules.md")
    known = known_facts(knowledge.robot, knowledge.fmea, knowledge.exposure_h)
    facts = replace(_facts(knowledge, window), known=tuple(known))
    made = conclude(
        knowledge, _program(knowledge, window.folder), facts, diagnosis_id_of(knowledge, case)
    )
    return made if made.hypotheses or made.findings else None


@dataclass(frozen=True, eq=False)
class _RobotRules:
    """The rules of a folder with what its FMEA says; equal ones have equal files."""

    folder: Path
    knowledge: Knowledge

    @property
    def _key(self) -> tuple[object, ...]:
        of = self.knowledge
        return self.folder, of.config_hash, of.robot, of.exposure_h

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _RobotRules) or not self.knowledge.config_hash:
            return self is other
        return self._key == other._key


def _program(knowledge: Knowledge, folder: Path) -> Program:
    return _read_once(_RobotRules(folder, knowledge))


@lru_cache(maxsize=4)
def _read_once(rules: _RobotRules) -> Program:
    return _read(rules.folder)


@lru_cache(maxsize=4)
def _with_known_facts(rules: _RobotRules) -> Program:
    of = rules.knowledge
    return _read_once(rules).with_facts(known_facts(of.robot, of.fmea, of.exposure_h), FMEA)


def _read(folder: Path) -> Program:
    program = read_rules(rule_files(folder))
    raise_errors(program.problems())
    return program


def _facts(knowledge: Knowledge, window: EvidenceWindow) -> Facts:
    """Return the facts of the instant; those of the FMEA are known besides."""
    others = (symptom for symptom in window.symptoms if symptom.source != SOURCE)
    seen = seen_facts(others, knowledge.fmea)
    return Facts((), tuple(seen), tuple(window.lookups(_NEEDS)))


def conclude(
    knowledge: Knowledge, program: Program, facts: Facts, heading: DiagnosisId
) -> Diagnosis:
    """Return the diagnosis by the rules alone.

    The hypotheses are failure modes that answers indicate, each with the proof; answers that
    indicate none are in ``findings``. Probabilities are computed from those of the FMEA, given only
    the answers.
    """
    found = rule_findings(program, knowledge.fmea, facts, heading.at_ns, all_heads=True)
    alone = ObservedSituation(found.symptoms, conflicts=found.conflicts, findings=found.findings)
    diagnosis = answer(knowledge, alone, heading)
    proofs = found.faults(knowledge.fmea)
    kept = tuple(
        _with_proof(hypothesis, proofs)
        for hypothesis in diagnosis.hypotheses
        if hypothesis.faults and hypothesis.faults <= proofs.keys()
    )
    ids = {hypothesis.id for hypothesis in kept}
    groups = tuple(group for group in diagnosis.groups if ids.issuperset(group.members))
    return replace(diagnosis, hypotheses=kept, groups=groups)


def _with_proof(hypothesis: Hypothesis, proofs: Mapping[str, Sequence[str]]) -> Hypothesis:
    texts = dict.fromkeys(text for fault in sorted(hypothesis.faults) for text in proofs[fault])
    return replace(hypothesis, proof="\n".join(texts))


class _Collected:
    """Answers so far: by symptom, by conflict, and those of no failure mode."""

    def __init__(
        self, fmea: Fmea, components: Mapping[str, Measured], facts: Facts, at_ns: int | None
    ) -> None:
        self._fmea = fmea
        self._components = components
        self._facts = facts
        self._at_ns = at_ns
        self._evidence: dict[str, dict[tuple[str, int, int], None]] = {}
        self._onsets_ns: dict[str, list[int]] = {}
        self._conflicts: dict[str, frozenset[str]] = {}
        self._names: dict[frozenset[str], str] = {}
        self._texts: list[str] = []
        self._proofs: dict[str, list[str]] = {}

    def take(self, of: FindingMapping, program: Program, budget: Budget | None) -> None:
        """Query one goal and keep its answers."""
        try:
            found = ask(program, of.goal, budget, "why")
        except (RuleError, StoppedError) as error:
            self._texts.append(f"rule:{of.goal}: not answered: {error.what}")
            return
        others = [
            _text(of, given)
            for given, proof in zip(found.answers, found.proof, strict=True)
            if not self._keep(of, given, proof)
        ]
        self._texts.extend(others[:_MOST_SHOWN])
        if len(others) > _MOST_SHOWN:
            self._texts.append(f"rule:{of.goal}: and {len(others) - _MOST_SHOWN} more")

    def _keep(self, of: FindingMapping, given: Answer, proof: Sequence[ProofNode]) -> bool:
        """Keep an answer; return False if it indicates no failure mode."""
        values = {
            name: str(value) for name, term in given.items() if (value := python_value(term)) != []
        }
        faults = faults_of(of, values, self._fmea.modes)
        if not faults:
            return False
        name = symptom_of(of, values)
        if of.proves:
            conflict = frozenset(faults)
            self._names.setdefault(conflict, name)
            name = _name(conflict)
            self._conflicts[name] = conflict
        else:
            measured = (m for node in proof for leaf in node.leaves() for m in self._measured(leaf))
            self._evidence.setdefault(name, {}).update(dict.fromkeys(measured))
            self._onsets_ns.setdefault(name, []).extend(self._onset_ns(proof))
        self._proofs.setdefault(name, []).append("\n".join(node.text() for node in proof))
        return True

    def _measured(self, leaf: ProofNode) -> Measured:
        """Return the data that a leaf of a proof was measured from; for a status, those of its
        symptoms.
        """
        if leaf.place is not None and leaf.place.file == SEEN and leaf.kind == "fact":
            return self._facts.seen[leaf.place.line - 1][1]
        if leaf.source is None:
            return ()
        named = _status_of(leaf)
        return self._components.get(named) or leaf.source.evidence

    def _onset_ns(self, proof: Sequence[ProofNode]) -> Iterator[int]:
        """Yield when (ns) each goal of an answer became true; the answer began with the last of
        them.

        Absent or unknown symptoms have no onset, neither has an answer from facts alone.
        """
        begun = [self._begun_ns(leaf) for node in proof for leaf in node.leaves()]
        yield from sorted(at_ns for at_ns in begun if at_ns is not None)[-1:]

    def _begun_ns(self, leaf: ProofNode) -> int | None:
        """Return since when (ns) a leaf of a proof holds, by its own measurements."""
        found: Measured = leaf.source.evidence if leaf.source is not None else ()
        if leaf.place is not None and leaf.place.file == SEEN and leaf.kind == "fact":
            fact, of = self._facts.seen[leaf.place.line - 1]
            found = of if fact[0] == "present" else ()
        return min((from_ns for _, from_ns, _ in found), default=None)

    def findings(self) -> RuleFindings:
        """Return the findings of all answers."""
        symptoms = tuple(self._symptom(name, tuple(of)) for name, of in self._evidence.items())
        proofs = {name: "\n".join(dict.fromkeys(texts)) for name, texts in self._proofs.items()}
        texts = tuple(dict.fromkeys(self._texts))
        conflicts = tuple(self._conflicts.values())
        return RuleFindings(symptoms, conflicts, texts, proofs, self._names)

    def _symptom(self, name: str, evidence: Measured) -> Symptom:
        onset_ns = min(self._onsets_ns[name], default=self._at_ns)
        return Symptom(
            name, "present", name, onset_ns, self._at_ns, _BESIDE_OTHERS, SOURCE, evidence
        )


def _by_component(facts: Facts) -> dict[str, Measured]:
    """Return the data that the present symptoms of each component were measured from."""
    found: dict[str, Measured] = {}
    for (name, *values), of in facts.seen:
        component, slash, _ = str(values[0]).partition("/")
        if name == "present" and slash:
            found[component] = (*found.get(component, ()), *of)
    return found


def _status_of(leaf: ProofNode) -> str:
    """Return the component that a looked up status is about; empty for anything else."""
    key = key_of(leaf.goal)
    if key is None or key[0] not in _STATUS or isinstance(leaf.goal, str):
        return ""
    return str(python_value(leaf.goal.args[0])) if hasattr(leaf.goal, "args") else ""


def _heads(program: Program, fmea: Fmea) -> Iterator[str]:
    """Yield goals for the heads of rules that no rule calls and that the FMEA does not name."""
    named = {key_of(read_goal(of.goal).term) for of in fmea.findings if of.goal}
    for name, count in program.heads:
        if (name, count) not in named:
            variables = ", ".join(f"X{number}" for number in range(1, count + 1))
            yield f"{write(name)}({variables})" if count else write(name)


def _text(of: FindingMapping, given: Answer) -> str:
    """Return the text of an answer that indicates no failure mode."""
    sentence = read_goal(of.goal)
    for name, value in given.items():
        sentence.names[name].ref = value
    text = f"rule:{write(sentence.term)}"
    return f"{text}: {of.description}" if of.description else text


def _name(conflict: Iterable[str]) -> str:
    return " or ".join(sorted(conflict))


def _mapped_symptoms(fmea: Fmea) -> Iterator[tuple[str, tuple[str, ...]]]:
    for of in fmea.findings:
        if of.goal and not of.proves:
            yield from finding_instances(of, fmea.modes)
