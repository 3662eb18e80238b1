"""Diagnose a situation: from symptoms, test answers and conflicts at an instant to a diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal, TypeAlias, cast

from amberbox.core.clock import NS
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
from amberbox.core.types import UNKNOWN_FAULT, Diagnosis, Hypothesis, Symptom
from amberbox.diagnosis.covering.hypotheses import RankedHypotheses, diagnose
from amberbox.diagnosis.covering.next_test import next_tests, splitting_test, with_answer
from amberbox.diagnosis.covering.observations import (
    Check,
    Evidence,
    collect_evidence,
    reading_check,
)
from amberbox.diagnosis.fmea.findings import COMBINED
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import with_safety_actions
from amberbox.diagnosis.status_history import RecentStatuses
from amberbox.diagnosis.symptom_presence import PROOF

_OR = " or "
_READ = ("monitor", "given")
"""Sources of symptoms that never measure the same; a finding may be of data that they measured."""


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

    def with_items(self, items: Iterable[EvidenceItem], at_ns: int = 0) -> ObservedSituation:
        """Return it with the evidence that a provider has found at an instant."""
        items = tuple(items)
        answers = {item.test: item.outcome for item in items if isinstance(item, AnsweredTest)}
        texts = (item.text for item in items if isinstance(item, Finding))
        return replace(
            self,
            symptoms=(*self.symptoms, *found_symptoms(items, at_ns)),
            answers={**self.answers, **answers},
            findings=(*self.findings, *texts),
        )

    def without(self, provider: str) -> ObservedSituation:
        """Return it without the symptoms that a provider has found."""
        others = tuple(symptom for symptom in self.symptoms if symptom.source != provider)
        return replace(self, symptoms=others)


def found_symptoms(items: Iterable[EvidenceItem], at_ns: int) -> Iterator[Symptom]:
    """Yield the symptoms among evidence; a conflict is that of the finding which proves it."""
    for item in items:
        if isinstance(item, Symptom):
            yield item
        elif isinstance(item, Conflict):
            name = item.finding or PROOF + _OR.join(sorted(item.faults))
            yield Symptom(name, "present", name, at_ns, at_ns, source=item.source)


def proven_by(knowledge: Knowledge, symptom: Symptom) -> frozenset[str] | None:
    """Return the failure modes of which a symptom proves that one is present; None if none."""
    if symptom.id.startswith(PROOF):
        names = symptom.id.removeprefix(PROOF).split(_OR)
        faults = frozenset(fault for name in names for fault in _faults_of(knowledge, name))
        return faults | _unlisted_with(knowledge, faults)
    return knowledge.proven.get(symptom.id)


def _unlisted_with(knowledge: Knowledge, faults: frozenset[str]) -> frozenset[str]:
    """Return what is not in the FMEA of the components of faults, if a fault may be unknown."""
    if UNKNOWN_FAULT not in faults:
        return frozenset()
    components = {fault.partition("#")[0] for fault in faults}
    modes = knowledge.model.modes
    return frozenset(m.id for m in modes if m.is_unlisted and m.component in components)


def suspicion(components: Iterable[str]) -> str:
    """Return the id of the symptom that one of some components is faulty."""
    return PROOF + _OR.join(sorted(components))


def _faults_of(knowledge: Knowledge, name: str) -> Iterator[str]:
    """Yield a failure mode; those of a component, with what is not in the FMEA."""
    if "#" in name:
        yield name
        return
    yield from (mode.id for mode in knowledge.model.modes if mode.component == name)
    yield UNKNOWN_FAULT


# What was measured: address, from and to in nanoseconds
Measured: TypeAlias = tuple[tuple[str, int, int], ...]


def measured(symptom: Symptom) -> Measured:
    """Return the measurements of a present symptom; without any, the symptom itself."""
    if symptom.state != "present" or symptom.evidence:
        return symptom.evidence
    from_ns = _onset_ns(symptom)
    to_ns = symptom.confirmed_ns if symptom.confirmed_ns is not None else from_ns
    return ((symptom.address or symptom.id, from_ns, to_ns),)


def _proofs(knowledge: Knowledge, situation: ObservedSituation) -> dict[str, frozenset[str]]:
    """Return what present findings prove: the failure modes of which one is there, by finding."""
    found = {symptom.id: proven_by(knowledge, symptom) for symptom in situation.present()}
    return {name: faults for name, faults in found.items() if faults}


def _suspicions(
    knowledge: Knowledge, situation: ObservedSituation
) -> dict[str, tuple[frozenset[str], float]]:
    """Return the conflicts that are only as sure as the finding they are of, by its name."""
    return {
        symptom.id: (faults, symptom.strength)
        for symptom in situation.present()
        if symptom.strength < 1.0 and symptom.id.startswith(PROOF)
        and (faults := proven_by(knowledge, symptom))
    }  # fmt: skip


def evidence_of_situation(knowledge: Knowledge, situation: ObservedSituation) -> Evidence:
    """Return the evidence of a situation that counts.

    Raises UsageError for an answer to an unknown test, or an unknown answer.
    """
    counting = [_as_monitored(symptom) for symptom in situation.symptoms if not symptom.blocked_by]
    suspicions = _suspicions(knowledge, situation)
    proofs = [
        faults for name, faults in _proofs(knowledge, situation).items() if name not in suspicions
    ]
    conflicts = dict.fromkeys((*situation.conflicts, *proofs))
    counting = [symptom for symptom in counting if proven_by(knowledge, symptom) is None]
    counting = _without_effects(knowledge, counting)
    if any(symptom.source not in _READ for symptom in counting):
        counting = [replace(symptom, evidence=measured(symptom)) for symptom in counting]
    found = collect_evidence(counting, conflicts, knowledge.level)
    found = replace(found, suspicions=tuple(suspicions.values()))
    if situation.watched:
        read = frozenset(f"read:{sign.id}" for sign in knowledge.model.signs)
        found = replace(found, asked=found.asked | read)
    for test, answer in situation.answers.items():
        found = with_answer(found, check_named(knowledge, test), answer)
    return found


def _without_effects(knowledge: Knowledge, counting: list[Symptom]) -> list[Symptom]:
    """Leave out what detectors find in items that may be an effect of what monitors show.

    A fault may have effects in items that the FMEA does not list, but not before it began: that is
    at most ``within_s`` before its symptoms.
    """
    known = knowledge.fmea.symptoms
    began_ns = [
        _onset_ns(symptom) - round(known[symptom.id].within_s * NS if symptom.id in known else 0)
        for symptom in counting
        if symptom.state == "present" and symptom.source in _READ
    ]
    return [
        symptom
        for symptom in counting
        if not (began_ns and symptom.id.startswith(COMBINED))
        or (symptom.state == "present" and _onset_ns(symptom) < min(began_ns))
    ]


def _onset_ns(symptom: Symptom) -> int:
    return (symptom.confirmed_ns if symptom.onset_ns is None else symptom.onset_ns) or 0


def _as_monitored(symptom: Symptom) -> Symptom:
    """Count the FMEA's own conditions as findings of monitors: the same author wrote both.

    The author of the file has given both a ``detects``, knowing that they use the same measurement.
    """
    return replace(symptom, source="monitor") if symptom.source == "condition" else symptom


def is_answer(knowledge: Knowledge, test: str, answer: str) -> bool:
    """Return whether a test exists and gives such an answer."""
    try:
        with_answer(Evidence(), check_named(knowledge, test), answer)
    except UsageError:
        return False
    return True


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
    model, proofs = knowledge.model, _proofs(knowledge, situation)
    hypotheses = tuple(_with_proofs(hypothesis, proofs) for hypothesis in found.hypotheses)
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


def _with_proofs(hypothesis: Hypothesis, proofs: Mapping[str, frozenset[str]]) -> Hypothesis:
    """Return a hypothesis that explains the findings that prove one of its failure modes."""
    names = tuple(name for name, faults in proofs.items() if faults & hypothesis.faults)
    return replace(hypothesis, explains=(*hypothesis.explains, *names)) if names else hypothesis


# Origin of the symptoms: the watcher's journal, an evaluation, the user alone; or only the
# watcher's statuses, as on a server (they have no conditions)
Origin: TypeAlias = Literal["watcher", "record", "given", "status"]


@dataclass(frozen=True, slots=True)
class DiagnosisContext:
    """The evidence at an instant, and the last revision of a diagnosis up to then, if any.

    ``seen`` are the symptoms of that diagnosis at its time; they need not be present any more.
    ``has_more``: there is more evidence than that diagnosis used. ``statuses`` are the latest ones
    of components, where a tracker knows them.
    """

    at_ns: int
    situation: ObservedSituation = field(default_factory=ObservedSituation)
    last_diagnosis: Diagnosis | None = None
    origin: Origin = "given"
    seen: tuple[Symptom, ...] = ()
    has_more: bool = False
    statuses: RecentStatuses | None = None

    @property
    def is_over(self) -> bool:
        """Return whether the last diagnosis has healed, so that nothing is wrong now."""
        return self.last_diagnosis is not None and self.last_diagnosis.state == "healed"

    @property
    def open(self) -> Diagnosis | None:
        """Return the open diagnosis; None without one."""
        return None if self.is_over else self.last_diagnosis

    @property
    def asked(self) -> tuple[str, ...]:
        """Return the providers whose findings are among the evidence of the last diagnosis."""
        if self.has_more or self.last_diagnosis is None:
            return ()
        return self.last_diagnosis.asked

    @property
    def found_by_watcher(self) -> tuple[str, ...]:
        """Return the providers whose findings are among the symptoms, whatever a user adds."""
        return () if self.last_diagnosis is None else self.last_diagnosis.asked

    def without(self, provider: str) -> DiagnosisContext:
        """Return the context without the symptoms that a provider has found."""
        return replace(self, situation=self.situation.without(provider))

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
        known = replace(self, situation=self.situation.with_items(items, self.at_ns))
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
    for provider in evidence_providers().values():
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

    An engine that answers alone is not called for evidence before, nor is a provider that the
    tracker has asked: its findings are among the symptoms. Returns the context with the evidence,
    and None where nothing is wrong. A provider that fails is left out and named in ``left_out``;
    without that list its error is raised. What the watcher found is answered again where the
    exposure is not the file's.
    """
    if knowledge.exposure_h is not None and context.origin == "watcher" and context.open:
        context = replace(context, has_more=True)
    for name, provider in evidence_providers().items():
        if name in (engine, *context.asked):
            continue
        try:
            opened = window(context)
            needs = provider.needs(knowledge, opened.folder)
            if needs is None or not needs.symptoms:
                continue
            if needs.reads_symptoms or name not in context.found_by_watcher:
                opened = window(context := context.without(name))
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


def evidence_providers() -> dict[str, EvidenceProvider[Knowledge]]:
    """Return the providers that are asked for an instant, by name."""
    found = find(EVIDENCE, defines=("needs", "provide"))
    return {name: cast("EvidenceProvider[Knowledge]", of.load()) for name, of in found.items()}
