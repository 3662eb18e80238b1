"""Figures of ``benchmarks.diagnosis``: how often diagnoses are right, from the kept outcomes."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from amberbox.core.errors import UsageError
from amberbox.diagnosis.covering.model import UNKNOWN
from benchmarks.common import Row
from benchmarks.run import number

SURE = 0.8
"""A wrong mode that is said to be more probable than this misleads."""
KNOWN_KINDS, UNKNOWN_KINDS = ("single", "double"), ("knobs", "drawn")
BANDS = (*((n / 10, (n + 1) / 10) for n in range(10)), (0.95, 1.0))
Z = 1.96


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a mission was diagnosed.

    ``group`` is the first ambiguity group of the answer that stands when the mission ends, as a
    person would see it: open, and not ended; ``probability`` is that of its leading hypothesis. If
    an answer was given that has ended, ``ended_group`` is its first group. Times are seconds since
    the onset of the last fault: ``symptom_s`` of the first revision after the first onset,
    ``named_s`` and ``led_s`` of the first revision with the truth in the first group, and first.
    ``misled`` is the highest probability that a leading wrong mode has had since that onset, None
    if an older version has kept the outcome. ``alarmed`` are the detectors that have begun an alarm
    since the first onset, and ``alarms`` how many they have begun before it (in nominal missions
    all of them); None without detectors. ``evidence`` is what the diagnosis had
    (``benchmarks.providers``).
    """

    kind: str
    seed: int
    faults: list[str]
    truth: list[str]
    scenario: str = ""
    seconds: float = 0.0
    group: list[list[str]] = field(default_factory=list)
    probability: float = 0.0
    ended_group: list[list[str]] = field(default_factory=list)
    symptom_s: float | None = None
    named_s: float | None = None
    led_s: float | None = None
    misled: float | None = None
    early: int = 0
    diagnoses: int = 0
    cpu_s: float = 0.0
    alarmed: list[str] | None = None
    alarms: int | None = None
    evidence: str = ""

    @property
    def shows(self) -> bool:
        """Tell whether any symptom was confirmed after the first onset."""
        return self.symptom_s is not None

    @property
    def stands(self) -> bool:
        """Tell whether an answer is open when the mission ends."""
        return bool(self.group)

    @property
    def is_right(self) -> bool:
        """Tell whether the first group has the true set of faults."""
        return self.truth in self.group

    @property
    def leads(self) -> bool:
        """Tell whether the leading hypothesis is the true set of faults."""
        return self.stands and self.group[0] == self.truth

    @property
    def clears(self) -> bool:
        """Tell whether the leading hypothesis is that nothing is broken."""
        return self.stands and not self.group[0]

    @property
    def is_wrong_mode(self) -> bool:
        """Tell whether the leading hypothesis has a mode, and is not the truth."""
        return self.stands and not self.leads and not self.clears

    @property
    def misleads(self) -> bool:
        """Tell whether a wrong mode leads, and is said to be almost sure."""
        return self.is_wrong_mode and self.probability > SURE


def rows(found: Sequence[Outcome]) -> list[Row]:
    """Return the figures of an experiment."""
    return [*_headlines(found), *_calibration(found)]


def _headlines(found: Sequence[Outcome]) -> list[Row]:
    parts = (_known, _unknown, _groups_and_times, _nominal)
    return [row for part in parts for row in part(found)]


def _of(found: Sequence[Outcome], *kinds: str) -> list[Outcome]:
    return [outcome for outcome in found if outcome.kind in kinds]


def _known(found: Sequence[Outcome]) -> Iterator[Row]:
    for kind, name, targets in (
        ("single", "one fault", ("target: 95", "target: 90")),
        ("double", "two faults", ("both, in one set; target: 80", "both, in one set")),
    ):
        of = _of(found, kind)
        if of:
            yield _share(f"{name}, in the first group", of, lambda o: o.is_right, targets[0])
            yield _share(f"{name}, first member", of, lambda o: o.leads, targets[1])
    faulty = _of(found, *KNOWN_KINDS)
    if faulty:
        yield _share("without any symptom", faulty, lambda o: not o.shows, "counted as misses")
        yield _share(
            "answer had ended",
            faulty,
            lambda o: o.shows and not o.stands,
            f"misses, {sum(o.truth in o.ended_group for o in faulty)} of them right before",
        )


def _unknown(found: Sequence[Outcome]) -> Iterator[Row]:
    for kind, name in (("drawn", "disturbance"), ("knobs", "unknown fault")):
        of = _of(found, kind)
        shown = [o for o in of if o.stands]
        if not of:
            continue
        yield _share(f"{name}: no answer", of, lambda o: not o.stands, "nothing shown, or ended")
        if not shown:
            continue
        note = "of those with an answer; target: 70"
        yield _share(f"{name}: said so", shown, lambda o: o.leads, note)
        yield _share(f"{name}: in the first group", shown, lambda o: o.is_right, "")
        yield _share(f"{name}: nothing is broken", of, lambda o: o.clears, "of all")
        yield _share(f"{name}: wrong mode", of, lambda o: o.is_wrong_mode, "of all")
        note = "of all; target: 5 at most"
        yield _share(f"{name}: wrong mode, above 80 %", of, lambda o: o.misleads, note)
        if all(o.misled is not None for o in of):
            note = "of all, also if it has changed or ended since"
            told = f"{name}: that at any time"
            yield _share(told, of, lambda o: (o.misled or 0.0) > SURE, note)


def _groups_and_times(found: Sequence[Outcome]) -> Iterator[Row]:
    sizes = [len(o.group) for o in _of(found, *KNOWN_KINDS, *UNKNOWN_KINDS) if o.stands]
    if sizes:
        note = "unknown faults included; target: "
        yield Row("mean size of the first group", statistics.fmean(sizes), "sets", note=f"{note}2")
        yield Row("largest first group", max(sizes), "sets", note=f"{note}6")
    for kind, name in (("single", "one fault"), ("double", "two faults")):
        shown = [o for o in _of(found, kind) if o.symptom_s is not None]
        if not shown:
            continue
        since_s = [math.inf if o.named_s is None else max(0.0, o.named_s) for o in shown]
        text = "of those with a symptom, never named is infinite"
        target = "; target: 2" if kind == "single" else ""
        yield Row(f"{name} named, from its onset", statistics.median(since_s), "s",
                  note=f"median {text}{target}")  # fmt: skip
        after_s = [s - max(0.0, o.symptom_s or 0.0) for s, o in zip(since_s, shown, strict=True)]
        yield Row(f"{name} named, from a symptom", statistics.median(after_s), "s",
                  note=f"median {text}; the first symptom that was confirmed")  # fmt: skip


def _nominal(found: Sequence[Outcome]) -> Iterator[Row]:
    others = _of(found, *KNOWN_KINDS, *UNKNOWN_KINDS)
    if others:
        note = "missions, their first 25 s to 60 s"
        yield _share("answer before any fault", others, lambda o: o.early > 0, note)
    runs = _of(found, "nominal")
    if not runs:
        return
    hours = sum(outcome.seconds for outcome in runs) / 3600.0
    count = sum(outcome.diagnoses for outcome in runs)
    low, high = count_interval(count)
    by = Counter[str]()
    for outcome in runs:
        by[outcome.scenario] += outcome.diagnoses
    each = ", ".join(f"{name} {number}" for name, number in sorted(by.items()))
    note = f"{count} in {hours:g} h ({each}); 95 % interval {low / hours:.2g}-{high / hours:.2g}"
    yield Row("diagnoses of a sound robot", count / hours, "1/h", note=f"{note}; target: 0.05")


def _calibration(found: Sequence[Outcome]) -> Iterator[Row]:
    """Yield how often leading hypotheses are right, by how probable they are said to be."""
    for name, inside in _bands(found):
        said = statistics.fmean(o.probability for o in inside)
        note = f"said {100 * said:.0f} % on average"
        yield _share(f"right where {name} is said", inside, lambda o: o.leads, note)


def _bands(found: Sequence[Outcome]) -> Iterator[tuple[str, list[Outcome]]]:
    """Yield the answers of each tenth of probability that has any, unknown faults included."""
    answered = [o for o in _of(found, *KNOWN_KINDS, *UNKNOWN_KINDS) if o.stands]
    for low, high in BANDS:
        inside = [o for o in answered if low <= o.probability < high or high == o.probability == 1]
        if inside:
            yield f"{100 * low:.0f}-{100 * high:.0f} %", inside


def _share(
    name: str, outcomes: Sequence[Outcome], counts: Callable[[Outcome], bool], note: str
) -> Row:
    right, count = sum(map(counts, outcomes)), len(outcomes)
    low, high = interval(right, count)
    text = f"{right} of {count}; 95 % interval {100 * low:.0f}-{100 * high:.0f} %"
    return Row(name, 100.0 * right / max(1, count), "%", note=f"{text}; {note}" if note else text)


def interval(right: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson's)."""
    if not count:
        return 0.0, 1.0
    share, extra = right / count, Z * Z / count
    middle = (share + extra / 2) / (1 + extra)
    half = Z / (1 + extra) * math.sqrt(share * (1 - share) / count + extra / (4 * count))
    return max(0.0, middle - half), min(1.0, middle + half)


def count_interval(count: int) -> tuple[float, float]:
    """Return the 95 % interval of the mean of a Poisson count (Garwood's exact one)."""

    def at_most(number: int, mean: float) -> float:
        of = range(number + 1)
        return sum(math.exp(n * math.log(mean) - mean - math.lgamma(n + 1)) for n in of)

    def mean_where(number: int, tail: float) -> float:
        low, high = 1e-9, 10.0 + 4.0 * count
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if at_most(number, middle) > tail else (low, middle)
        return (low + high) / 2

    return (mean_where(count - 1, 0.975) if count else 0.0), mean_where(count, 0.025)


# -- the page

_BEGIN, _END = "<!-- measured -->", "<!-- end of measured -->"


def with_figures(page: str, figures: str, marks: tuple[str, str] | None = None) -> str:
    """Return a page with other figures between its marks; UsageError if it has no marks."""
    first, last = marks or (_BEGIN, _END)
    before, begin, rest = page.partition(first)
    _, end, after = rest.partition(last)
    if not begin or not end:
        raise UsageError("the page has no place for figures", f"write {first} and {last} into it")
    return f"{before}{begin}\n{figures}{end}{after}"


def measured(found: Sequence[Outcome], state: str) -> str:
    """Return what is measured in docs/reference/accuracy.md, as Markdown."""
    counts = Counter(outcome.kind for outcome in found)
    seeds = [outcome.seed for outcome in found] or [0]
    lines = [
        f"State of the code: {state or 'not named'}. Seeds {min(seeds)} to {max(seeds)}: "
        f"{counts['single']} missions with one fault, {counts['double']} with two, "
        f"{counts['drawn']} with a drawn disturbance, {counts['knobs']} with a fault of "
        f"`unknown_faults.yaml`.",
        "",
        "| what | value | unit | note |",
        "|---|--:|---|---|",
        *(
            f"| {row.name} | {number(row.value)} | {row.unit} | {row.note} |"
            for row in _headlines(found)
        ),
    ]
    parts = {
        "Stated against right": calibration_table(found),
        "Disturbances by kind": kind_table(found),
        "Each fault that is not in the FMEA": unknown_table(found),
        "Faults of the FMEA that do not lead": missed_table(found),
    }
    tables = "\n".join(f"### {title}\n\n{text}" for title, text in parts.items())
    return "\n".join(lines) + f"\n\n{tables}"


def calibration_table(found: Sequence[Outcome]) -> str:
    """Return stated probabilities against the share that is right, by tenths, as Markdown."""
    lines = ["| stated | missions | on average | right | 95 % interval | in the FMEA | not in it |"]
    lines.append("|---|--:|--:|--:|---|---|---|")
    for name, inside in _bands(found):
        right = sum(o.leads for o in inside)
        low, high = (100 * end for end in interval(right, len(inside)))
        said = 100 * statistics.fmean(o.probability for o in inside)
        parts = (_of(inside, *KNOWN_KINDS), _of(inside, *UNKNOWN_KINDS))
        counts = " | ".join(f"{sum(o.leads for o in part)} of {len(part)}" for part in parts)
        cells = (
            f"{said:.0f} % | {100 * right / len(inside):.0f} % | {low:.0f}-{high:.0f} % | {counts}"
        )
        lines.append(f"| {name} | {len(inside)} | {cells} |")
    return "\n".join(lines) + "\n"


def unknown_table(found: Sequence[Outcome]) -> str:
    """Return what every fault that is not in the FMEA was answered with, as Markdown."""
    lines = ["| kind | what was done | answer | probability |", "|---|---|---|--:|"]
    for outcome in sorted(_of(found, *UNKNOWN_KINDS), key=lambda o: (o.kind, o.faults)):
        said = f"{100 * outcome.probability:.1f} %" if outcome.stands else ""
        lines.append(f"| {outcome.kind} | `{outcome.faults[0]}` | {_answer(outcome)} | {said} |")
    return "\n".join(lines) + "\n"


def kind_table(found: Sequence[Outcome]) -> str:
    """Return how disturbances of each kind were answered, as Markdown."""
    names = ("missions", "no answer", "said so", "nothing is broken", "wrong mode", "above 80 %")
    lines = [f"| disturbance | {' | '.join(names)} |", f"|---|{'--:|' * len(names)}"]
    kinds: dict[str, list[Outcome]] = {}
    for outcome in _of(found, "drawn"):
        kinds.setdefault(outcome.faults[0].partition(":")[0], []).append(outcome)
    for kind, of in sorted(kinds.items()):
        parts = [(not o.stands, o.leads, o.clears, o.is_wrong_mode, o.misleads) for o in of]
        numbers = (len(of), *map(sum, zip(*parts, strict=True)))
        lines.append(f"| {kind} | {' | '.join(map(str, numbers))} |")
    return "\n".join(lines) + "\n"


def missed_table(found: Sequence[Outcome]) -> str:
    """Return the missions with faults of the FMEA whose answer was wrong, as Markdown."""
    lines = ["| seed | faults | answer | probability |", "|--:|---|---|--:|"]
    for outcome in _of(found, *KNOWN_KINDS):
        if not outcome.leads:
            said = f"{100 * outcome.probability:.1f} %" if outcome.stands else ""
            faults = ", ".join(f"`{fault}`" for fault in outcome.faults)
            lines.append(f"| {outcome.seed} | {faults} | {_answer(outcome)} | {said} |")
    return "\n".join(lines) + "\n"


def _answer(outcome: Outcome) -> str:
    if not outcome.stands:
        return "ended" if outcome.shows else "nothing shown"
    first = outcome.group[0]
    text = "not in the FMEA" if first == [UNKNOWN] else ", ".join(first) or "nothing is broken"
    more = len(outcome.group) - 1
    return f"{text} (or {more} more)" if more else text
