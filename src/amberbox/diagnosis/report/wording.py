"""Names, numbers, times and lists in words: failure modes, components, symptoms, instances."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis, Hypothesis
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.covering.observations import Check
from amberbox.diagnosis.fmea.findings import text_of as finding_text
from amberbox.diagnosis.fmea.model import Fmea, FollowingMode
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import CREDIBLE, mode_probabilities
from amberbox.diagnosis.report.explanation import ExplainedFault, Possibility

NS = 1_000_000_000

WORTH_SHOWING = 0.005  # from which probability on another possibility is shown

MANY = ("no", "one", "two", "three", "four", "five", "six")


def duration(seconds: float) -> str:
    """Write how long something takes, in the unit that people would use."""
    if seconds < 90:
        return "1 min" if seconds == 60 else f"{seconds:.3g} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    hours = seconds / 3600
    return f"{hours:.0f} h" if hours >= 10 else f"{hours:.2g} h"


def delay_text(seconds: float) -> str:
    """Return a delay after the first symptom as text."""
    if seconds <= 0:
        return "first"
    if seconds < 0.05:
        return "at once"
    if seconds < 120:
        return f"{seconds:.1f} s later"
    return f"{duration(seconds)} later"


def clock(time_ns: int) -> str:
    """Write the time of day, UTC."""
    return f"{format_time(time_ns)[11:19]} UTC"


def date_and_clock(time_ns: int) -> str:
    """Write date and time of day, UTC."""
    return f"{format_time(time_ns)[:10]} {clock(time_ns)}"


def readable(name: str) -> str:
    """Turn an id into words."""
    return re.sub(r"[_\s]+", " ", name).strip()


def sentence(text: str) -> str:
    """Begin with a capital letter and end with a full stop."""
    if not text:
        return ""
    return capitalize(text) + ("" if text[-1] in ".!?" else ".")


def capitalize(text: str) -> str:
    """Begin with a capital letter."""
    return text[:1].upper() + text[1:]


def join_with_and(texts: Sequence[str]) -> str:
    """Join descriptions of simultaneous faults with "and"."""
    if len(texts) < 3:
        return " and ".join(texts)
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def join_with_or(texts: Sequence[str], most: int = 3) -> str:
    """Join what may be instead of each other; beyond ``most`` only their number is given."""
    if len(texts) < 2:
        return "".join(texts)
    if len(texts) > most:
        return f"{'; '.join(texts[: most - 1])}; or {len(texts) - most + 1} more"
    return f"{'; '.join(texts[:-1])}; or {texts[-1]}"


def number_word(number: int) -> str:
    """Write a small number as a word."""
    return MANY[number] if number < len(MANY) else str(number)


def mode_kind(fmea: Fmea, fault: str) -> str:
    """Return what failure modes of all instances of a type have in common: ``type#mode``."""
    component, _, name = fault.partition("#")
    known = fmea.components.get(component)
    return f"{known.type if known else component}#{name}"


def mode_kinds(fmea: Fmea, faults: Collection[str]) -> tuple[str, ...]:
    """Return the kinds of failure modes that are present together."""
    return tuple(sorted(mode_kind(fmea, fault) for fault in faults))


def merge_texts(texts: Sequence[str]) -> str:
    """Join texts that differ in some words: ``the tyres of the front left or rear left unit``."""
    texts = list(dict.fromkeys(texts))
    first, last, middles = _differing(texts)
    if not middles:
        return join_with_or(texts, len(texts))
    words = texts[0].split()
    return " ".join([*words[:first], _listed(middles), *words[len(words) - last :]])


def instance_words(texts: Sequence[str]) -> list[str]:
    """Return the words in which each text differs from the others; none where nothing is alike."""
    return _differing(texts)[2]


def _differing(texts: Sequence[str]) -> tuple[int, int, list[str]]:
    """Return how many words are equal at the beginning and at the end, and the different words
    between.
    """
    words = [text.split() for text in texts]
    first = _common_words(words)
    last = _common_words([one[first:][::-1] for one in words])
    middles = [" ".join(one[first : len(one) - last]) for one in words]
    return first, last, middles if first + last and all(middles) else []


def merge_by_kind(kinds: Sequence[tuple[str, ...]], texts: Sequence[str]) -> list[str]:
    """Return texts in order, those of one kind merged to one."""
    found: dict[tuple[str, ...], list[str]] = {}
    for kind, text in zip(kinds, texts, strict=True):
        found.setdefault(kind, []).append(text)
    return [merge_texts(of) for of in found.values()]


def test_text(check: Check) -> str:
    """Return what to do for a test; of a run also how long it takes and whether the robot moves."""
    if not check.run:
        return check.text
    facts = [duration(check.cost_s)] if check.cost_s else []
    facts += ["the robot moves", "somebody has to stand by"] if check.moves else []
    return f"{check.text.rstrip('.')} ({', '.join(facts)})" if facts else check.text


def run_command(kind: str, run: str, folder: str) -> str:
    """Return the command that runs an experiment or a unit test of a robot folder."""
    if kind == "experiment":
        return shlex.join(["amberbox", "experiment", "run", folder, run])
    return shlex.join(["amberbox", "test", folder, "-k", run])


def same_tests(knowledge: Knowledge, diagnosis: Diagnosis, check: Check) -> list[Check]:
    """Return a test together with the same test of other instances that may be broken.

    They are in order of the probability of the causes that they detect.
    """
    component, _, name = check.id.rpartition(".")
    known = knowledge.fmea.components
    if component not in known:
        return [check]
    shares = mode_probabilities(diagnosis.hypotheses)
    asked = {test.id for test in diagnosis.next_tests}
    kind = known[component].type
    of_type = (f"{other.id}.{name}" for other in known.values() if other.type == kind)
    others = [knowledge.checks[i] for i in of_type if i in asked and i in knowledge.checks]
    chances = {
        one.id: sum(shares.get(detection.cause, 0.0) for detection in one.detections)
        for one in others
    }
    credible = [one for one in others if chances[one.id] >= CREDIBLE and one.id != check.id]
    return [check, *sorted(credible, key=lambda one: -chances[one.id])]


def _common_words(words: Sequence[Sequence[str]]) -> int:
    """Return how many words all texts have in common at their beginning."""
    same = (len(set(column)) == 1 for column in zip(*words, strict=False))
    return sum(1 for _ in takewhile(bool, same))


def _listed(words: Iterable[str]) -> str:
    *rest, last = words
    return f"{', '.join(rest)} or {last}" if rest else last


OTHER = "something that the FMEA does not know"
FALSE_ALARM = "probably a false alarm"


@dataclass(frozen=True, slots=True)
class FaultNames:
    """Describes an FMEA's entries in words; unknown entries are called by their id.

    ``cleared`` are failure modes whose symptoms have all gone, with the time: beside active ones
    they are not named.
    """

    fmea: Fmea
    cleared: Mapping[str, int] = field(default_factory=dict)

    def mode(self, mode_id: str) -> str:
        """Describe a failure mode."""
        if mode_id == UNKNOWN:
            return OTHER
        mode = self.fmea.modes.get(mode_id)
        if mode is not None and mode.description:
            return mode.description
        component, _, name = mode_id.partition("#")
        return f"{self.component(component)}: {readable(name)}"

    def component(self, name: str) -> str:
        """Describe a component."""
        component = self.fmea.components.get(name)
        return component.description if component and component.description else readable(name)

    def function(self, name: str) -> str:
        """Describe what the robot does."""
        function = self.fmea.functions.get(name)
        return function.description if function and function.description else readable(name)

    def part(self, name: str) -> str:
        """Return in a few words that a component or a function is lost."""
        if name in self.fmea.functions:
            return f"cannot: {self.function(name)}"
        return f"out of service: {self.component(name)}"

    def symptom(self, symptom_id: str, reason: str = "") -> str:
        """Return the observation when a symptom is present; ``reason`` is a value and its limit."""
        symptom = self.fmea.symptoms.get(symptom_id)
        text = symptom.description if symptom is not None else ""
        text = text or finding_text(self.fmea, symptom_id)
        if text:
            return f"{text} ({reason})" if reason else text
        parts = symptom_id.split("/")
        if len(parts) == 3 and reason:
            return f"{self.component(parts[0])}: {reason}"
        if len(parts) == 3:
            return f'{self.component(parts[0])}: the self-check "{_check(*parts[1:])}" fails'
        if symptom is not None and symptom.condition is not None and "#" in symptom_id:
            return f"it is true that {symptom.condition.text}"
        component, dot, name = symptom_id.partition(".")
        if dot and component in self.fmea.components:
            return f"{self.component(component)}: {readable(name)}"
        return readable(symptom_id)

    def owner(self, symptom_id: str) -> str:
        """Describe the component where a symptom shows."""
        component = symptom_id.partition("/")[0]
        if component not in self.fmea.components:
            component = component.partition("#")[0].partition(".")[0]
        return self.component(component)

    def faults(self, faults: Collection[str]) -> str:
        """Describe failure modes that are present together; none is a false alarm."""
        if not faults:
            return FALSE_ALARM
        active = set(self.active(faults))
        follows = {one.mode for name in active for one in self._leads_to(name)} & active
        texts = [self.mode(fault) for fault in sort_modes(active - follows)]
        text = f"{join_with_and(texts)}{common_onset_text(len(texts))}"
        if not follows:
            return text
        later = join_with_and([self.mode(fault) for fault in sort_modes(follows)])
        return f"{text}, and from {'it' if len(texts) == 1 else 'one of them'} {later}"

    def _leads_to(self, mode_id: str) -> Sequence[FollowingMode]:
        mode = self.fmea.modes.get(mode_id)
        return mode.leads_to if mode is not None else ()

    def active(self, faults: Collection[str]) -> Collection[str]:
        """Return those of some failure modes that show still; all if none does."""
        return set(faults) - self.cleared.keys() or faults

    def fault(self, mode_id: str) -> ExplainedFault:
        """Describe a failure mode with what may be its cause and what helps."""
        mode, gone_ns = self.fmea.modes.get(mode_id), self.cleared.get(mode_id)
        if mode is None:
            return ExplainedFault(mode_id, self.mode(mode_id), gone_ns=gone_ns)
        return ExplainedFault(
            mode_id, self.mode(mode_id), mode.severity, mode.cause, mode.remedy, gone_ns,
            mode.intermittent, mode_kind(self.fmea, mode_id),
        )  # fmt: skip

    def possibility(self, hypothesis: Hypothesis) -> Possibility:
        """Describe a hypothesis."""
        return Possibility(
            hypothesis.id,
            self.faults(hypothesis.faults),
            hypothesis.probability,
            tuple(self.fault(fault) for fault in sort_modes(hypothesis.faults)),
            hypothesis.criticality,
            hypothesis.proof,
        )


def common_onset_text(number: int) -> str:
    """Return the text that several faults are present at once."""
    if number < 2:
        return ""
    return " (both together)" if number == 2 else f" (all {number_word(number)} together)"


def sort_modes(faults: Collection[str]) -> list[str]:
    """Sort failure modes by their ids, faults that are not in the FMEA last."""
    return sorted(faults, key=lambda fault: (fault == UNKNOWN, fault))


def _check(mode: str, output: str) -> str:
    """Name an output by its mode, once if both are called the same."""
    return readable(mode) if mode == output else f"{readable(mode)}: {readable(output)}"
