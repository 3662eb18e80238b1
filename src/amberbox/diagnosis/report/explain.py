"""Explain a diagnosis: what is broken, how confident, why, and what to do next."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.core.robot_status import SEVERITIES
from amberbox.core.robot_status import Severity as RobotSeverity
from amberbox.core.timestamps import format_time
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom
from amberbox.core.units import confidence_word, percent
from amberbox.diagnosis.covering.hypotheses import FEWEST, NO_FAULT
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.covering.observations import predict
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import mode_probabilities
from amberbox.diagnosis.report.causal_graph import (
    CausalPaths,
    SymptomDescriptions,
    build_causal_graph,
)
from amberbox.diagnosis.report.explanation import (
    Confidence,
    ExplainedFault,
    ExplainedGroup,
    Explanation,
    LostFunction,
    Severity,
    Usability,
)
from amberbox.diagnosis.report.next_step import Leading, step_of
from amberbox.diagnosis.report.wording import (
    FaultNames,
    capitalize,
    clock,
    join_with_and,
    join_with_or,
    merge_by_kind,
    mode_kinds,
    sentence,
    sort_modes,
)


def similarity_text(names: FaultNames, diagnosis: Diagnosis, leading: Sequence[Hypothesis]) -> str:
    """Return the known failure modes that the leading unknown one looks like; empty if none."""
    if [h.faults for h in leading] != [{UNKNOWN}] or not names.fmea.other.looks_like:
        return ""
    known = (h.faults - {UNKNOWN} for h in diagnosis.hypotheses)
    faults = next((faults for faults in known if len(faults) >= FEWEST), None)
    if faults is None:
        return ""
    texts = join_with_and([names.mode(fault) for fault in sort_modes(faults)])
    return f"it looks like {texts} at once, which have no cause in common that the FMEA knows"


# A symptom is one of a cause that shows it at least so surely as the surest one beside it
OWN_SHARE = 0.5
# How bad a cause is: its symptoms are ordered by this times its probability
WEIGHTS: Mapping[RobotSeverity, float] = {
    "warning": 1.0,
    "urgent": 2.0,
    "critical": 4.0,
    "fatal": 8.0,
}


@dataclass(frozen=True, slots=True)
class FaultActivity:
    """Which failure modes show no more, since when, and how much each symptom matters."""

    cleared: Mapping[str, int]
    weights: Mapping[str, float]

    @classmethod
    def of(
        cls, knowledge: Knowledge, diagnosis: Diagnosis, symptoms: Iterable[Symptom]
    ) -> FaultActivity:
        """Compare the symptoms of hypotheses with those still present.

        A cause is cleared when all its symptoms are gone, except intermittent causes, and causes of
        a diagnosis that has healed.
        """
        shown = _shown(knowledge, diagnosis.hypotheses)
        gone = {s.id: s.gone_ns for s in symptoms if s.gone_ns is not None}
        cleared = _cleared(knowledge, shown, gone) if diagnosis.state == "open" else {}
        return cls(cleared, _weights(knowledge, diagnosis.hypotheses, shown))

    def active(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a hypothesis with its active failure modes; unchanged if none is active."""
        left = hypothesis.faults - frozenset(self.cleared)
        return replace(hypothesis, faults=left) if left else hypothesis


def _shown(knowledge: Knowledge, hypotheses: Sequence[Hypothesis]) -> dict[str, set[str]]:
    """Return by failure mode the symptoms that it shows in any of the hypotheses."""
    detects = {f: _detects(knowledge, f) for h in hypotheses for f in h.faults}
    shown: dict[str, set[str]] = {fault: set() for fault in detects}
    for hypothesis in hypotheses:
        for symptom in hypothesis.explains:
            for fault in _owners(symptom, hypothesis.faults, detects):
                shown[fault].add(symptom)
    return shown


def _detects(knowledge: Knowledge, fault: str) -> Mapping[str, float]:
    """Return the probability with which a failure mode shows each symptom, directly or by lost
    functions.
    """
    model = knowledge.model
    if fault == UNKNOWN or fault not in model.mode_places:
        return {}
    misses = predict(model, [fault]).misses
    return {model.signs[place].id: 1.0 - miss for place, miss in misses.items()}


def _owners(
    symptom: str, faults: Iterable[str], detects: Mapping[str, Mapping[str, float]]
) -> Iterator[str]:
    """Yield those of some failure modes that show a symptom; all where none does alone."""
    chances = {fault: detects[fault].get(symptom, 0.0) for fault in faults}
    best = max(chances.values(), default=0.0)
    return (fault for fault, chance in chances.items() if chance >= OWN_SHARE * best)


def _cleared(
    knowledge: Knowledge, shown: Mapping[str, set[str]], gone: Mapping[str, int]
) -> dict[str, int]:
    modes, found = knowledge.fmea.modes, {}
    for fault, symptoms in shown.items():
        comes_and_goes = fault in modes and modes[fault].intermittent
        if symptoms and symptoms <= gone.keys() and not comes_and_goes:
            found[fault] = max(gone[symptom] for symptom in symptoms)
    return found


def _weights(
    knowledge: Knowledge, hypotheses: Sequence[Hypothesis], shown: Mapping[str, set[str]]
) -> dict[str, float]:
    """Return by symptom the worst of its causes: its severity times its probability."""
    weights: dict[str, float] = {}
    for fault, share in mode_probabilities(hypotheses).items():
        mode = knowledge.fmea.modes.get(fault)
        weight = share * (WEIGHTS[mode.severity] if mode else WEIGHTS["urgent"])
        for symptom in shown[fault]:
            weights[symptom] = max(weight, weights.get(symptom, 0.0))
    return weights


def _details(
    diagnosis: Diagnosis, found: Sequence[tuple[AmbiguityGroup, Sequence[Hypothesis]]]
) -> Iterator[str]:
    """Yield ids and numbers of every hypothesis, criticality and proof, and of the search."""
    of = f"revision {diagnosis.revision}, of {format_time(diagnosis.at_ns)}"
    yield f"diagnosis {diagnosis.id}, {of}"
    if diagnosis.config_hash:
        yield f"configuration {diagnosis.config_hash}"
    looked = f"{diagnosis.mass_covered:.6g}"
    yield f"{len(diagnosis.hypotheses)} hypotheses, which hold {looked} of all probability"
    if diagnosis.incomplete:
        yield f"incomplete: {diagnosis.incomplete}"
    for number, (group, members) in enumerate(found, 1):
        yield f"group {number}: {percent(group.probability)}"
        for hypothesis in members:
            numbers = f"probability {hypothesis.probability:.6g}"
            yield f"    {hypothesis.id}: {numbers}, criticality {hypothesis.criticality:.3g}"
            if hypothesis.proof:
                yield f"        proof: {hypothesis.proof}"
        if group.wider:
            yield f"    the same with faults that leave no trace: {', '.join(group.wider)}"


COVERED = 0.98  # what share of all probability must have been looked at to say nothing of the rest


def confidence_of(
    diagnosis: Diagnosis, broken: ExplainedGroup | None, remark: str = ""
) -> Confidence:
    """Return the confidence of the leading group; its word is that of the lower bound.

    ``remark`` comes before the sentence on the part that was not searched.
    """
    if broken is None:
        return Confidence(confidence_word(0.0), 0.0, 0.0, diagnosis.incomplete)
    covered = min(1.0, diagnosis.mass_covered)
    complete = covered >= COVERED and not diagnosis.incomplete
    probability = min(1.0, broken.probability)
    least = probability if complete else probability * covered
    notes = [remark] if remark else []
    if not complete:
        why = diagnosis.incomplete or "the list of possibilities is full"
        notes.append(f"not all possibilities were looked at ({why})")
        notes.append(f"those that were hold at least {percent(covered)} of all probability")
    return Confidence(confidence_word(least), probability, least, "; ".join(notes))


NOTHING = "nothing that is known explains what was seen"


def headline(
    diagnosis: Diagnosis,
    broken: ExplainedGroup | None,
    sure: Confidence,
    symptoms: Iterable[Symptom],
) -> str:
    """Return what is broken and the confidence; for a healed diagnosis in the past tense."""
    if broken is None:
        return sentence(NOTHING)
    ids = [member.id for member in broken.members]
    what, how = broken.text, f" {capitalize(sure.word)} ({chance(sure)})."
    if ids == [NO_FAULT]:
        what, how = f"{broken.text} ({chance(sure)})", ""
    if diagnosis.state == "healed":
        healed = f"all symptoms have healed since {clock(_healed_ns(diagnosis, symptoms))}"
        return f"It was: {what}.{how} {sentence(healed)}"
    return f"{sentence(f'{what} is broken' if ids == [UNKNOWN] else what)}{how}"


def chance(sure: Confidence) -> str:
    """Write the probability, as a range where not everything was looked at."""
    if percent(sure.at_least) == percent(sure.probability):
        return percent(sure.probability)
    return f"{percent(sure.at_least)} to {percent(sure.probability)}"


def _healed_ns(diagnosis: Diagnosis, symptoms: Iterable[Symptom]) -> int:
    """Return when the last symptom disappeared, else when the diagnosis was closed."""
    gone = {s.id: s.confirmed_ns for s in symptoms if s.state == "absent"}
    times = [gone.get(name) for name in diagnosis.symptoms]
    known = [time for time in times if time is not None]
    return max(known) if known and len(known) == len(times) else diagnosis.at_ns


def ranked_groups(
    diagnosis: Diagnosis,
) -> tuple[tuple[AmbiguityGroup, tuple[Hypothesis, ...]], ...]:
    """Return the groups with their members; hypotheses without a group become groups of one."""
    by_id = {hypothesis.id: hypothesis for hypothesis in diagnosis.hypotheses}
    grouped = {name for g in diagnosis.groups for name in (*g.members, *g.wider)}
    alone = (
        AmbiguityGroup((hypothesis.id,), hypothesis.probability)
        for hypothesis in diagnosis.hypotheses
        if hypothesis.id not in grouped
    )
    groups = sorted((*diagnosis.groups, *alone), key=lambda group: -group.probability)
    found = ((g, tuple(by_id[name] for name in g.members if name in by_id)) for g in groups)
    return tuple((group, members) for group, members in found if members)


def describe_group(
    names: FaultNames, group: AmbiguityGroup, members: Sequence[Hypothesis]
) -> ExplainedGroup:
    """Describe a group."""
    possibilities = tuple(names.possibility(hypothesis) for hypothesis in members)
    return ExplainedGroup(_text(names, members), group.probability, possibilities, group.wider)


def _text(names: FaultNames, members: Sequence[Hypothesis]) -> str:
    sets = list(dict.fromkeys(frozenset(names.active(hypothesis.faults)) for hypothesis in members))
    if len(sets) == 1:
        return names.faults(sets[0])
    common = frozenset.intersection(*sets)
    rests = [faults - common for faults in sets]
    if not common or not all(rests):
        texts = _texts(names, sets)
        return texts[0] if len(texts) == 1 else f"one of: {join_with_or(texts)}"
    rest = join_with_or(_texts(names, rests))
    both = join_with_and([names.mode(fault) for fault in sort_modes(common)])
    return f"{both}, together with one of: {rest}"


def _texts(names: FaultNames, sets: Sequence[Collection[str]]) -> list[str]:
    """Describe sets of failure modes; sets that differ only in an instance are combined."""
    kinds = [mode_kinds(names.fmea, faults) for faults in sets]
    return merge_by_kind(kinds, [names.faults(faults) for faults in sets])


ANSWERS: dict[Severity, str] = {
    "": "yes, as far as anybody can tell",
    "warning": "yes, it works",
    "urgent": "yes, it works; see to it soon",
    "critical": "no, it cannot go on with what it does",
    "fatal": "no, it must stop and stay stopped",
}
UNKNOWN_USE = "nobody can tell: what is broken is not known; watch it, and stop it when in doubt"
WORTH_A_WORD = 0.05  # how probable something graver must be to be warned of


def usability(
    paths: CausalPaths,
    members: Sequence[Hypothesis],
    others: Sequence[tuple[ExplainedGroup, Sequence[Hypothesis]]],
) -> Usability:
    """Return what the robot can still do: the worst over the members of the leading group."""
    lost = _lost(paths, members)
    severity = worst_severity(_severity(paths, hypothesis) for hypothesis in members)
    faults = {fault for hypothesis in members for fault in hypothesis.faults}
    if not members or faults - paths.names.fmea.modes.keys():
        text = UNKNOWN_USE if severity in ("", "warning", "urgent") else ANSWERS[severity]
    else:
        text = ANSWERS[severity]
    differ = len({_severity(paths, hypothesis) for hypothesis in members}) > 1
    return Usability(
        severity, f"at worst: {text}" if differ else text, lost, _careful(paths, severity, others)
    )


def worst_severity(severities: Iterable[Severity]) -> Severity:
    """Return the worst of severities, empty if there is none."""
    return max(severities, key=_rank, default="")


def _rank(severity: Severity) -> int:
    return SEVERITIES.index(severity) + 1 if severity else 0


def _severity(paths: CausalPaths, hypothesis: Hypothesis) -> Severity:
    modes = paths.names.fmea.modes
    own = (modes[fault].severity for fault in hypothesis.faults if fault in modes)
    return worst_severity([*own, *(lost.severity for lost in _lost(paths, [hypothesis]))])


def _lost(paths: CausalPaths, members: Sequence[Hypothesis]) -> tuple[LostFunction, ...]:
    """Return the system functions that are lost with any of the members, the gravest first."""
    fmea = paths.names.fmea
    gone = {name for hypothesis in members for name in _gone(paths, hypothesis)}
    lost = [
        LostFunction(name, paths.names.function(name), fmea.functions[name].severity)
        for name in fmea.system_functions()
        if name in gone
    ]
    return tuple(sorted(lost, key=lambda function: -_rank(function.severity)))


def _gone(paths: CausalPaths, hypothesis: Hypothesis) -> Iterable[str]:
    """Return the lost functions and the effects of modes that do not take their component down.

    For modes that take it down the effects are left out, because they name everything that may
    suffer, regardless of redundancy.
    """
    modes = (paths.names.fmea.modes.get(fault) for fault in sorted(hypothesis.faults))
    named = [name for m in modes if m and not m.takes_down for name in m.effects.system]
    return (*paths.losses(hypothesis.faults).lost, *named)


def _careful(
    paths: CausalPaths,
    severity: Severity,
    others: Sequence[tuple[ExplainedGroup, Sequence[Hypothesis]]],
) -> str:
    """Warn of something less probable with which the robot must not go on."""
    graver = [
        (worst_severity(_severity(paths, hypothesis) for hypothesis in members), group)
        for group, members in others
        if group.probability >= WORTH_A_WORD
    ]
    most = max(_rank(severity), _rank("urgent"))
    graver = [found for found in graver if _rank(found[0]) > most]
    if not graver:
        return ""
    of, group = max(graver, key=lambda found: (_rank(found[0]), found[1].probability))
    return (
        f"careful: if it is not that but {group.text} ({percent(group.probability)}): {ANSWERS[of]}"
    )


OTHERS = 3  # how many groups are described besides the leading one


def explain(diagnosis: Diagnosis, knowledge: Knowledge, symptoms: Iterable[Symptom]) -> Explanation:
    """Return the explanation of a diagnosis in words.

    ``symptoms`` are those it was made from, with their times and data; symptoms that are not among
    them are described without these. Failure modes and tests that the knowledge does not have are
    called by their ids.
    """
    symptoms = tuple(symptoms)
    activity = FaultActivity.of(knowledge, diagnosis, symptoms)
    names = FaultNames(knowledge.fmea, activity.cleared)
    descriptions = SymptomDescriptions.of(names, diagnosis, symptoms, activity.weights)
    found = _merge_cleared(activity, ranked_groups(diagnosis))
    members = found[0][1] if found else ()
    active = [(group, tuple(map(activity.active, of))) for group, of in found]
    groups = [describe_group(names, *group) for group in found[: 1 + OTHERS]]
    broken, others = (groups[0] if groups else None), groups[1:]
    others_with = list(zip(others, (group[1] for group in active[1:]), strict=False))
    sure = confidence_of(diagnosis, broken, similarity_text(names, diagnosis, members))
    use = usability(descriptions.paths, active[0][1] if active else (), others_with)
    explained = tuple(dict.fromkeys(name for h in members for name in h.explains))
    missed = _missed(diagnosis, members, explained)
    blocked = (s.id for s in symptoms if s.state == "present" and s.blocked_by)
    hidden = (name for name in blocked if name not in explained and name not in missed)
    return Explanation(
        diagnosis.id,
        diagnosis.revision,
        diagnosis.robot,
        diagnosis.at_ns,
        diagnosis.state,
        headline(diagnosis, broken, sure, symptoms),
        broken,
        sure,
        descriptions.worst_first(explained, members),
        descriptions.worst_first(missed, ()),
        descriptions.in_time((name for h in members for name in h.contradicted), members),
        diagnosis.findings,
        descriptions.in_time(hidden, ()),
        tuple(others),
        use,
        step_of(knowledge, names, diagnosis, active[0] if active else None),
        tuple(_details(diagnosis, found)),
        build_causal_graph(descriptions, found[: 1 + OTHERS]),
        cleared=_explain_cleared(names, members),
    )


def _merge_cleared(activity: FaultActivity, found: Iterable[Leading]) -> list[Leading]:
    """Join groups that differ by causes alone that show no more, the most probable first."""
    joined: dict[frozenset[frozenset[str]], Leading] = {}
    for group, members in found:
        key = frozenset(activity.active(hypothesis).faults for hypothesis in members)
        first, of = joined.get(key, (replace(group, probability=0.0), members))
        whole = min(1.0, first.probability + group.probability)
        joined[key] = replace(first, probability=whole), of
    return sorted(joined.values(), key=lambda one: -one[0].probability)


def _explain_cleared(
    names: FaultNames, members: Sequence[Hypothesis]
) -> tuple[ExplainedFault, ...]:
    """Return what shows no more of what leads, beside what does."""
    lasting = [h for h in members if h.faults - names.cleared.keys()]
    faults = dict.fromkeys(fault for h in lasting for fault in sort_modes(h.faults))
    return tuple(names.fault(fault) for fault in faults if fault in names.cleared)


def _missed(
    diagnosis: Diagnosis, members: Sequence[Hypothesis], explained: Collection[str]
) -> tuple[str, ...]:
    """Return the present symptoms that the leading hypotheses do not explain."""
    missed = [name for h in members for name in h.unexplained]
    if not members:
        missed = [name for name in diagnosis.symptoms if name not in diagnosis.findings]
    return tuple(dict.fromkeys(name for name in missed if name not in explained))
