"""The keys of ``fmea.yaml``; ``docs/fmea.md`` describes them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.core.expression import Expression
from amberbox.core.options import option
from amberbox.diagnosis.fmea.model import Severity

Finding = str | tuple[str, str]
_MOST = 1e9
"""No time, rate or exposure is larger; sums of times stay within 64 bits of nanoseconds."""
MOST_PER_HOUR = 1.0
"""A higher rate is a failure every few minutes: likely the time between failures was meant."""
_LEAST_PERCENT = 2.0
"""A share from here on was meant in percent; 1.2 may as well be 1 with a slip."""


@dataclass(frozen=True)
class DefaultsFile:
    """What counts where an entry does not say it."""

    detects: float = option(0.99, "how probable a symptom shows when its cause is there")
    leak: float = option(1e-4, "how probable a symptom shows although no cause of it is there")
    within_s: float = option(60.0, "so long after a cause began a symptom may come", unit="s")
    hold_s: float = option(0.0, "so long a symptom that has gone is remembered", unit="s")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
        yield from _shares(self, "detects", "leak")
        yield from _not_below_zero(self, "within_s", "hold_s")


@dataclass(frozen=True)
class OtherFile:
    """Something that is not in this file."""

    probability: float = option(1e-3, "how probable it is that something else is broken")
    detects: float = option(0.05, "how probable that shows in a symptom, whichever")
    looks_like: float = option(0.0, "how probable it looks like a failure mode, of several at once")
    together_s: float = option(10.0, "so short after each other these begin", unit="s")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
        yield from _shares(self, "probability", "detects", "looks_like")
        yield from _not_below_zero(self, "together_s")


@dataclass(frozen=True)
class ScalesFile:
    """Tables from 1 (good) to 10 (bad)."""

    severity: Mapping[str, int] = option({}, "S of each severity: {fatal: 10}")
    occurrence: Mapping[str, float] = option({}, "failures per hour, at most, of each O: {1: 1e-7}")
    detection: Mapping[str, float] = option(
        {}, "share that no symptom shows, at most, of each D: {1: 0.001}"
    )

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
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
        """Yield what is wrong."""
        for key in ("s", "o", "d"):
            rank = getattr(self, key)
            if rank is not None and not 1 <= rank <= 10:
                yield key, f"{rank} is no rank from 1 to 10"


@dataclass(frozen=True)
class LinkFile:
    """One symptom of a failure mode or of a lost function."""

    symptom: str = option("", "address of a monitor's output, or a name under 'symptoms'")
    when: Expression | None = option(None, "a condition instead, true when it shows")
    detects: float | None = option(None, "how probable it shows when the cause is there")
    within_s: float | None = option(None, "so long after the cause began it may come", unit="s")
    hold_s: float | None = option(None, "so long it is remembered when it has gone", unit="s")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
        if bool(self.symptom) == (self.when is not None):
            yield "give either 'symptom' or 'when'"
        yield from _shares(self, "detects")
        yield from _not_below_zero(self, "within_s", "hold_s")


@dataclass(frozen=True)
class SymptomFile:
    """A condition with a name, or what holds for an address wherever it is used."""

    when: Expression | None = option(None, "condition; absent for the address of an output")
    leak: float | None = option(None, "how probable it shows although no cause is there")
    within_s: float | None = option(None, "so long after a cause began it may come", unit="s")
    hold_s: float | None = option(None, "so long it is remembered when it has gone", unit="s")
    by_itself: bool = option(False, "whether what its component needs has no part in it")
    description: str = option("", "what it is")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
        yield from _shares(self, "leak")
        yield from _not_below_zero(self, "within_s", "hold_s")


@dataclass(frozen=True)
class EffectsFile:
    """What a failure mode does."""

    local: str = option("", "what its component does then, as text")
    next: Sequence[str] = option((), "components and functions that it harms directly")
    system: Sequence[str] = option((), "functions of the system that it harms in the end")


@dataclass(frozen=True)
class ResultFile:
    """What a test gives when the failure mode is there."""

    outcome: str = option(doc="one of the test's outcomes")
    detects: float = option(0.95, "how probable it gives that")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
        yield from _shares(self, "detects")


@dataclass(frozen=True)
class ModeFile:
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
    make_safe: str = option("", "what to do first, before anybody tests or repairs it")
    takes_down: bool = option(True, "whether the component stops serving")
    intermittent: bool = option(False, "whether it comes and goes")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
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
    """Something that a person or a program can look at to learn more."""

    question: str = option("", "what somebody is asked")
    look: str = option("", "what somebody looks at or measures", aliases=("check",))
    read: str = option("", "address of an output that somebody reads off")
    text: str = option("", "how to read it", aliases=("how",))
    role: str = option("", "who can do it: operator, technician ...")
    minutes: float = option(1.0, "how long it takes", unit="min")
    risk: float = option(0.0, "how probable it does harm")
    outcomes: Sequence[str] = option(("no", "yes"), "answers; the first is a sound robot's")
    sure: float = option(0.99, "how probable the first answer is when nothing is wrong with it")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
        given = [key for key in ("question", "look", "read") if getattr(self, key)]
        if len(given) != 1:
            yield "give one of question, check and read"
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
        """Yield what is wrong."""
        yield from _not_below_zero(self, "rate")


@dataclass(frozen=True)
class FunctionFile:
    """Something the robot can do."""

    needs: Any = option(doc="components and functions that it needs")
    description: str = option("", "what it is")
    system: bool = option(False, "whether its loss is an effect on the system")
    severity: Severity = option("urgent", "what its loss means for the robot")
    symptoms: Sequence[str | LinkFile] = option((), "how its loss shows")


@dataclass(frozen=True)
class FindingFile:
    """What another engine finds, and the failure modes that it speaks for."""

    rule: str = option("", "a goal of rules/*.pl; each answer is a finding")
    finding: str = option("", "a detector's finding instead, by its id")
    maps_to: Sequence[str] = option((), "failure modes; <Variable> stands for its value")
    detects: float | None = option(None, "how probable it is found when one of them is there")
    leak: float | None = option(None, "how probable it is found although none of them is there")
    proves: bool = option(False, "whether at least one of them is there for sure")
    description: str = option("", "what it means, for a technician")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong."""
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
    """A function of a robot as its team sees it."""

    probability: float | None = option(None, "how probable it is lost")
    rate: float | None = option(None, "losses per hour")
    severity: Severity = option("urgent", "what its loss means for the team")
    symptoms: Sequence[str | LinkFile] = option((), "how its loss shows to the team")
    unobservable: str = option("", "why nothing shows it")
    remedy: str = option("", "what to do about it")
    make_safe: str = option("", "what to do first, before anybody tests or repairs it")

    def wrong(self) -> Iterator[tuple[str, str]]:
        """Yield each value out of its range, by key; the functions beside it are judged, too."""
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
        """Yield what is wrong."""
        yield from _not_below_zero(self, "exposure_h", "remember_s")


def _shares(entry: object, *keys: str) -> Iterator[tuple[str, str]]:
    """Yield each value that is no probability."""
    for key in keys:
        value = getattr(entry, key)
        if value is not None and not 0 <= value <= 1:
            side = "above 1" if value > 1 else "below 0"
            meant = f"; did you mean {value / 100:g}?" if _LEAST_PERCENT <= value <= 100 else ""
            yield key, f"{value:g} is {side}: expected a share from 0 to 1{meant}"


def _not_below_zero(entry: object, *keys: str) -> Iterator[tuple[str, str]]:
    for key in keys:
        value = getattr(entry, key)
        if value is not None and value < 0:
            yield key, f"{value:g} lies below 0"
        elif value is not None and value > _MOST:
            yield key, f"{value:g} is more than {_MOST:,.0f}"
