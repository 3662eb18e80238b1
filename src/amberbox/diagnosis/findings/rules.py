"""What rules find, as evidence for the one answer, and what they conclude by themselves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.types import Diagnosis, Hypothesis, Symptom
from amberbox.diagnosis.answering import Heading, answer
from amberbox.diagnosis.findings.facts import SEEN, Facts, Measured, measured
from amberbox.diagnosis.fmea.findings import faults_of, instances, symptom_of
from amberbox.diagnosis.fmea.model import Fmea, Mapped
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.rules.answers import Answer, plain
from amberbox.diagnosis.rules.ask import ask
from amberbox.diagnosis.rules.budget import Budget
from amberbox.diagnosis.rules.faults import RuleError, StoppedError
from amberbox.diagnosis.rules.program import Program
from amberbox.diagnosis.rules.proof import Node
from amberbox.diagnosis.rules.reader import read_goal
from amberbox.diagnosis.rules.terms import key_of
from amberbox.diagnosis.rules.writer import write
from amberbox.diagnosis.situation import Situation

SOURCE = "rules"
_BESIDE_OTHERS = 1.0 - 1e-9
"""Strength of a finding: of one measurement, what a monitor makes of it counts first."""
_MOST_SHOWN = 20
_STATUS = ("status", "state")


@dataclass(frozen=True, slots=True)
class RuleFindings:
    """What rules find.

    ``symptoms`` are ``rule:GOAL``, ``conflicts`` sets of failure modes of which one is there for
    sure, ``findings`` texts of what speaks for no failure mode. ``proofs`` say why each symptom
    and each conflict (its failure modes joined by `` or ``) is found.
    """

    symptoms: tuple[Symptom, ...] = ()
    conflicts: tuple[frozenset[str], ...] = ()
    findings: tuple[str, ...] = ()
    proofs: Mapping[str, str] = field(default_factory=dict)

    def faults(self, fmea: Fmea) -> dict[str, list[str]]:
        """Return the failure modes that they speak for, with the proofs."""
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
    """Ask the rules that ``findings:`` of the FMEA names; ``all_heads``: others, too.

    A rule that gives no answer says nothing. A goal that cannot be answered, or not within the
    budget, is named among the findings. Raises ConfigurationError for rules that call what there
    is not.
    """
    collected = _Collected(fmea, _by_component(facts), facts, at_ns)
    asked = facts.added_to(program)
    for of in fmea.findings:
        if of.goal:
            collected.take(of, asked, budget)
    for goal in _heads(program, fmea) if all_heads else ():
        collected.take(Mapped(goal), asked, budget)
    return collected.findings()


def with_rule_findings(situation: Situation, found: RuleFindings) -> Situation:
    """Return a situation with what rules found, so that one measurement counts once."""
    own = [replace(symptom, evidence=measured(symptom)) for symptom in situation.symptoms]
    return replace(
        situation,
        symptoms=(*own, *found.symptoms),
        conflicts=(*situation.conflicts, *found.conflicts),
        findings=(*situation.findings, *found.findings),
    )


def conclude(knowledge: Knowledge, program: Program, facts: Facts, heading: Heading) -> Diagnosis:
    """Return what the rules alone conclude.

    The hypotheses are failure modes that answers speak for, each with the proof; what speaks for
    none is in ``findings``. Probabilities come of the FMEA's, given nothing but the answers.
    """
    found = rule_findings(program, knowledge.fmea, facts, heading.at_ns, all_heads=True)
    alone = Situation(found.symptoms, conflicts=found.conflicts, findings=found.findings)
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
        self._texts: list[str] = []
        self._proofs: dict[str, list[str]] = {}

    def take(self, of: Mapped, program: Program, budget: Budget | None) -> None:
        """Ask one goal and keep its answers."""
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

    def _keep(self, of: Mapped, given: Answer, proof: Sequence[Node]) -> bool:
        """Keep an answer; False if it speaks for no failure mode."""
        values = {name: str(value) for name, term in given.items() if (value := plain(term)) != []}
        faults = faults_of(of, values, self._fmea.modes)
        if not faults:
            return False
        name = symptom_of(of, values)
        if of.proves:
            conflict = frozenset(faults)
            name = _name(conflict)
            self._conflicts[name] = conflict
        else:
            measured = (m for node in proof for leaf in node.leaves() for m in self._measured(leaf))
            self._evidence.setdefault(name, {}).update(dict.fromkeys(measured))
            self._onsets_ns.setdefault(name, []).extend(self._onset_ns(proof))
        self._proofs.setdefault(name, []).append("\n".join(node.text() for node in proof))
        return True

    def _measured(self, leaf: Node) -> Measured:
        """Return what a leaf of a proof was measured from; of a status, what its symptoms were."""
        if leaf.place is not None and leaf.place.file == SEEN and leaf.kind == "fact":
            return self._facts.seen[leaf.place.line - 1][1]
        if leaf.source is None:
            return ()
        named = _status_of(leaf)
        return self._components.get(named) or leaf.source.evidence

    def _onset_ns(self, proof: Sequence[Node]) -> Iterator[int]:
        """Yield when an answer became true: with the last of the goals that it took.

        What is absent or unknown has no beginning; nor has an answer of facts alone.
        """
        begun = [self._begun_ns(leaf) for node in proof for leaf in node.leaves()]
        yield from sorted(at_ns for at_ns in begun if at_ns is not None)[-1:]

    def _begun_ns(self, leaf: Node) -> int | None:
        """Return since when a leaf of a proof holds, by its own measurements."""
        found: Measured = leaf.source.evidence if leaf.source is not None else ()
        if leaf.place is not None and leaf.place.file == SEEN and leaf.kind == "fact":
            fact, of = self._facts.seen[leaf.place.line - 1]
            found = of if fact[0] == "present" else ()
        return min((from_ns for _, from_ns, _ in found), default=None)

    def findings(self) -> RuleFindings:
        """Return all of it."""
        symptoms = tuple(self._symptom(name, tuple(of)) for name, of in self._evidence.items())
        proofs = {name: "\n".join(dict.fromkeys(texts)) for name, texts in self._proofs.items()}
        texts = tuple(dict.fromkeys(self._texts))
        return RuleFindings(symptoms, tuple(self._conflicts.values()), texts, proofs)

    def _symptom(self, name: str, evidence: Measured) -> Symptom:
        onset_ns = min(self._onsets_ns[name], default=self._at_ns)
        return Symptom(
            name, "present", name, onset_ns, self._at_ns, _BESIDE_OTHERS, SOURCE, evidence
        )


def _by_component(facts: Facts) -> dict[str, Measured]:
    """Return what the present symptoms of each component were measured from."""
    found: dict[str, Measured] = {}
    for (name, *values), of in facts.seen:
        component, slash, _ = str(values[0]).partition("/")
        if name == "present" and slash:
            found[component] = (*found.get(component, ()), *of)
    return found


def _status_of(leaf: Node) -> str:
    """Return the component that a looked up status is about; empty for anything else."""
    key = key_of(leaf.goal)
    if key is None or key[0] not in _STATUS or isinstance(leaf.goal, str):
        return ""
    return str(plain(leaf.goal.args[0])) if hasattr(leaf.goal, "args") else ""


def _heads(program: Program, fmea: Fmea) -> Iterator[str]:
    """Yield goals for the heads of rules that no rule calls and that the FMEA does not name."""
    named = {key_of(read_goal(of.goal).term) for of in fmea.findings if of.goal}
    for name, count in program.heads:
        if (name, count) not in named:
            variables = ", ".join(f"X{number}" for number in range(1, count + 1))
            yield f"{write(name)}({variables})" if count else write(name)


def _text(of: Mapped, given: Answer) -> str:
    """Write an answer that speaks for no failure mode."""
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
            yield from instances(of, fmea.modes)
