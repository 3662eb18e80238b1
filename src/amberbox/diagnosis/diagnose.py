"""Diagnose a situation: from symptoms, test answers and conflicts at an instant to a diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal, TypeAlias, cast

from amberbox.core.contracts import (
    AnsweredTest,
    Budget,
    Conflict,
    EvidenceEngine,
    EvidenceFollower,
    EvidenceItem,
    EvidenceProvider,
    EvidenceWindow,
    Finding,
    FollowedEvidence,
)
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.plugins import find, get
from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.covering.hypotheses import RankedHypotheses, diagnose
from amberbox.diagnosis.covering.next_test import next_tests, splitting_test, with_answer
from amberbox.diagnosis.covering.observations import (
    Check,
    Evidence,
    collect_evidence,
    reading_check,
)
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import with_safety_actions


@dataclass(frozen=True, slots=True)
class ObservedSituation:
    """The evidence at an instant.

    A symptom that is unknown, or blocked by a dependency of its component, is no evidence.
    ``answers`` are the outcomes of tests, by the test's id (``cannot check`` is one). ``conflicts``
    are sets of failure modes of which other engines proved that at least one is present.
    ``watched``: the symptoms come from a watcher, which reads all of them as soon as possible, so
    that reading a symptom is not proposed as a test. ``findings`` are texts of other engines'
    findings that indicate no failure mode.
    """

    symptoms: tuple[Symptom, ...] = ()
    answers: Mapping[str, str] = field(default_factory=dict)
    conflicts: tuple[frozenset[str], ...] = ()
    watched: bool = False
    findings: tuple[str, ...] = ()

    def present(self) -> tuple[Symptom, ...]:
        """Return the symptoms that are present and count, in order of onset."""
        there = (s for s in self.symptoms if s.state == "present" and not s.blocked_by)
        return tuple(sorted(there, key=lambda s: (s.onset_ns or 0, s.id)))

    def with_items(self, items: Iterable[EvidenceItem]) -> ObservedSituation:
        """Return it with the evidence of a provider, so that one measurement counts once."""
        items = tuple(items)
        own = [replace(symptom, evidence=measured(symptom)) for symptom in self.symptoms]
        found = (item for item in items if isinstance(item, Symptom))
        answers = {item.test: item.outcome for item in items if isinstance(item, AnsweredTest)}
        conflicts = (item.faults for item in items if isinstance(item, Conflict))
        texts = (item.text for item in items if isinstance(item, Finding))
        return replace(
            self,
            symptoms=(*own, *found),
            answers={**self.answers, **answers},
            conflicts=(*self.conflicts, *conflicts),
            findings=(*self.findings, *texts),
        )


# What was measured: address, from and to in nanoseconds
Measured: TypeAlias = tuple[tuple[str, int, int], ...]


def measured(symptom: Symptom) -> Measured:
    """Return the measurements of a present symptom; without any, the symptom itself."""
    if symptom.state != "present" or symptom.evidence:
        return symptom.evidence
    from_ns = symptom.onset_ns if symptom.onset_ns is not None else symptom.confirmed_ns
    to_ns = symptom.confirmed_ns if symptom.confirmed_ns is not None else from_ns
    return ((symptom.address or symptom.id, from_ns or 0, to_ns or 0),)


def evidence_of_situation(knowledge: Knowledge, situation: ObservedSituation) -> Evidence:
    """Return the evidence of a situation that counts.

    Raises UsageError for an answer to an unknown test, or an unknown answer.
    """
    counting = (_as_monitored(symptom) for symptom in situation.symptoms if not symptom.blocked_by)
    found = collect_evidence(counting, situation.conflicts)
    if situation.watched:
        read = frozenset(f"read:{sign.id}" for sign in knowledge.model.signs)
        found = replace(found, asked=found.asked | read)
    for test, answer in situation.answers.items():
        found = with_answer(found, check_named(knowledge, test), answer)
    return found


def _as_monitored(symptom: Symptom) -> Symptom:
    """Count the FMEA's own conditions as findings of monitors: the same author wrote both.

    The author of the file has given both a ``detects``, knowing that they use the same measurement.
    """
    return replace(symptom, source="monitor") if symptom.source == "condition" else symptom


def check_named(knowledge: Knowledge, test: str) -> Check:
    """Return the check of an id; ``read:SYMPTOM`` is the reading of a symptom."""
    symptom = test.removeprefix("read:")
    if test in knowledge.checks:
        return knowledge.checks[test]
    if symptom != test and symptom in knowledge.model.sign_places:
        return reading_check(symptom, 0.0)
    known = [*knowledge.checks, *(f"read:{sign.id}" for sign in knowledge.model.signs)]
    raise UsageError(f"there is no test '{test}'{did_you_mean(test, known)}")


@dataclass(frozen=True, slots=True)
class DiagnosisId:
    """The identity of a diagnosis and of its revision."""

    id: str
    revision: int
    at_ns: int


Heading = DiagnosisId  # its documented name of earlier versions


@dataclass(frozen=True, slots=True)
class Effort:
    """The budget of an answer, and how much of it is wanted."""

    hypotheses: int = 20
    mass: float = 0.99
    budget: Budget = field(default_factory=Budget)
    tests: int = 5


def answer(
    knowledge: Knowledge,
    situation: ObservedSituation,
    heading: DiagnosisId,
    effort: Effort = Effort(),
) -> Diagnosis:
    """Return the diagnosis of a situation: a pure function of its arguments.

    Raises UsageError for answers and conflicts with names that the knowledge does not have.
    """
    known = evidence_of_situation(knowledge, situation)
    found = diagnose(
        knowledge.model, known, max_hypotheses=effort.hypotheses, mass=effort.mass,
        budget=effort.budget,
    )  # fmt: skip
    made = build_diagnosis(knowledge, situation, heading, known, found, effort)
    return with_safety_actions(knowledge.fmea, made)


def build_diagnosis(
    knowledge: Knowledge,
    situation: ObservedSituation,
    heading: DiagnosisId,
    known: Evidence,
    found: RankedHypotheses,
    effort: Effort,
) -> Diagnosis:
    """Return the diagnosis that an engine's answer makes, with the tests to do next."""
    model, hypotheses = knowledge.model, found.hypotheses
    checks = tuple(knowledge.checks.values())
    tests = next_tests(model, known, hypotheses, checks, most=effort.tests)
    groups = []
    for group in found.groups:
        best = None
        if len(group.members) > 1:
            best = splitting_test(model, known, hypotheses, group.members, checks)
        groups.append(replace(group, split_by="" if best is None else best.test.id))
    return Diagnosis(
        heading.id,
        heading.revision,
        knowledge.robot,
        heading.at_ns,
        knowledge.config_hash,
        hypotheses,
        found.mass_covered,
        found.incomplete,
        (*found.findings, *situation.findings),
        tuple(proposal.test for proposal in tests),
        tuple(groups),
        tuple(symptom.id for symptom in situation.present()),
    )


# Origin of the symptoms: the watcher's journal, an evaluation, the user alone; or only the
# watcher's statuses, as on a server (they have no conditions)
Origin: TypeAlias = Literal["watcher", "record", "given", "status"]


@dataclass(frozen=True, slots=True)
class DiagnosisContext:
    """The evidence at an instant, and the last revision of a diagnosis up to then, if any.

    ``seen`` are the symptoms of that diagnosis at its time; they need not be present any more.
    ``has_more``: there is more evidence than that diagnosis used.
    """

    at_ns: int
    situation: ObservedSituation = field(default_factory=ObservedSituation)
    last_diagnosis: Diagnosis | None = None
    origin: Origin = "given"
    seen: tuple[Symptom, ...] = ()
    has_more: bool = False

    @property
    def is_over(self) -> bool:
        """Return whether the last diagnosis has healed, so that nothing is wrong now."""
        return self.last_diagnosis is not None and self.last_diagnosis.state == "healed"

    @property
    def open(self) -> Diagnosis | None:
        """Return the open diagnosis; None without one."""
        return None if self.is_over else self.last_diagnosis

    def with_observations(self, items: Sequence[EvidenceItem]) -> DiagnosisContext:
        """Return the context with the user's evidence, which replaces the symptoms that were read.

        If only answers are given after a diagnosis is over, they apply to that diagnosis.
        """
        stated = {item.id: item for item in items if isinstance(item, Symptom)}
        answers = {item.test: item.outcome for item in items if isinstance(item, AnsweredTest)}
        if not (stated or answers):
            return self
        last_diagnosis = None if self.is_over and stated else self.last_diagnosis
        if self.is_over and not stated:
            stated = {symptom.id: symptom for symptom in self.seen}
        read = (symptom for symptom in self.situation.symptoms if symptom.id not in stated)
        situation = replace(
            self.situation,
            symptoms=(*read, *stated.values()),
            answers={**self.situation.answers, **answers},
        )
        return replace(
            self, situation=situation, last_diagnosis=last_diagnosis, seen=(), has_more=True
        )

    def with_items(self, items: Sequence[EvidenceItem]) -> DiagnosisContext:
        """Return the context with the evidence of a provider.

        Texts alone indicate no failure mode: they are added to the last diagnosis.
        """
        known = replace(self, situation=self.situation.with_items(items))
        texts = [item.text for item in items if isinstance(item, Finding)]
        if len(texts) < len(items):
            return replace(known, last_diagnosis=self.open, has_more=True)
        if known.last_diagnosis is None or not texts:
            return known
        findings = tuple(dict.fromkeys((*known.last_diagnosis.findings, *texts)))
        return replace(known, last_diagnosis=replace(known.last_diagnosis, findings=findings))


def diagnose_context(knowledge: Knowledge, context: DiagnosisContext) -> Diagnosis | None:
    """Return the diagnosis of a context; None if nothing indicates a fault.

    The last diagnosis is returned unchanged if there is no further evidence.
    """
    if context.last_diagnosis is not None and not context.has_more:
        return context.last_diagnosis
    situation = context.situation
    if not (situation.present() or situation.answers or situation.conflicts):
        return None
    made = answer(knowledge, context.situation, diagnosis_id_of(knowledge, context))
    if context.last_diagnosis is None or not context.is_over:
        return made
    return replace(made, state="healed", at_ns=context.last_diagnosis.at_ns)


def diagnosis_id_of(knowledge: Knowledge, context: DiagnosisContext) -> DiagnosisId:
    """Return the id of the last diagnosis; without one, an id made of the instant."""
    if context.last_diagnosis is not None:
        return DiagnosisId(
            context.last_diagnosis.id, context.last_diagnosis.revision, context.at_ns
        )
    stamp = format_time(context.at_ns)[:19].replace("-", "").replace(":", "").lower()
    return DiagnosisId(f"{knowledge.robot}-{stamp}", 1, context.at_ns)


def is_fault_indicated(context: DiagnosisContext, diagnosis: Diagnosis | None) -> bool:
    """Return whether there is a fault: a symptom is present, or the leading hypothesis
    has a fault.
    """
    if diagnosis is None or diagnosis.state == "healed":
        return False
    leading = diagnosis.hypotheses[:1]
    return bool(context.situation.present()) or any(entry.faults for entry in leading)


EVIDENCE = "amberbox.diagnosis.evidence"
COVERING = "covering"  # the engine that uses all evidence together; any other one answers alone

Engine: TypeAlias = EvidenceEngine[Knowledge, DiagnosisContext]
# Opens the robot and its record at the instant of a context
OpenWindow: TypeAlias = Callable[[DiagnosisContext], EvidenceWindow]


@cache
def engine_names() -> tuple[str, ...]:
    """Return the names of all engines: covering, then the providers that can answer alone."""
    both = find(EVIDENCE, defines=("provide", "alone"))
    return tuple(dict.fromkeys((COVERING, *both, *find(EVIDENCE, defines=("alone",)))))


def load_engine(name: str) -> Engine | None:
    """Load the engine of a name; None for the covering one, which is not alone."""
    if name == COVERING:
        return None
    return cast("Engine", get(EVIDENCE, name, defines=("alone",)).load())


def followers(knowledge: Knowledge) -> dict[str, EvidenceFollower]:
    """Return the followers of evidence as a record grows, by name."""
    return {
        name: cast("FollowedEvidence[Knowledge]", plugin.load()).follow(knowledge)
        for name, plugin in find(EVIDENCE, defines=("follow",)).items()
    }


def observe(
    knowledge: Knowledge, context: DiagnosisContext, window: OpenWindow
) -> DiagnosisContext:
    """Return a context with evidence of providers that need no symptoms; raises their errors."""
    for provider in _providers().values():
        opened = window(context)
        needs = provider.needs(knowledge, opened.folder)
        if needs is not None and not needs.symptoms:
            context = context.with_observations(tuple(provider.provide(knowledge, opened)))
    return context


def diagnose_with_evidence(
    knowledge: Knowledge,
    context: DiagnosisContext,
    window: OpenWindow,
    engine: str = COVERING,
    left_out: list[str] | None = None,
) -> tuple[DiagnosisContext, Diagnosis | None]:
    """Add the evidence of providers that need symptoms, and return an engine's diagnosis.

    An engine that answers alone is not called for evidence before. Returns the context with the
    evidence, and None where nothing is wrong. A provider that fails is left out and named in
    ``left_out``; without that list its error is raised.
    """
    for name, provider in _providers().items():
        if name == engine:
            continue
        try:
            opened = window(context)
            needs = provider.needs(knowledge, opened.folder)
            if needs is not None and needs.symptoms:
                context = context.with_items(tuple(provider.provide(knowledge, opened)))
        except AmberboxError as error:
            if left_out is None:
                raise
            left_out.append(f"its {name} were left out: {error.what}")
    alone = load_engine(engine)  # its diagnosis has no make-safe actions yet
    if alone is None:
        made = diagnose_context(knowledge, context)
    else:
        made = alone.alone(knowledge, window(context), context)
    return context, None if made is None else with_safety_actions(knowledge.fmea, made)


def _providers() -> dict[str, EvidenceProvider[Knowledge]]:
    found = find(EVIDENCE, defines=("needs", "provide"))
    return {name: cast("EvidenceProvider[Knowledge]", of.load()) for name, of in found.items()}
