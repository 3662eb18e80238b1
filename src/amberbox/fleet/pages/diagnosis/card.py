"""The card that answers what is broken: made of what the server says about a diagnosis.

It has the same parts wherever it stands: what is broken, how sure, why, whether the robot can be
used, what to do next. Texts about the robot come from its own list of what can fail.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.robotstatus import RobotStatus
from amberbox.core.sureness import LIKELY, percent
from amberbox.core.timetext import format_time
from amberbox.diagnosis.explanation.activity import OWN_SHARE
from amberbox.diagnosis.explanation.instances import merged
from amberbox.diagnosis.explanation.names import together
from amberbox.diagnosis.explanation.words import both
from amberbox.fleet.alarms.words import CauseKind, kind_of
from amberbox.fleet.knowledge.holding import Hold
from amberbox.fleet.pages.datalinks import moment_href
from amberbox.fleet.pages.figures import span
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.pages.wording import capital, readable, sentence

REASONS = 3
"""How many sentences say why."""
CANNOT = "cannot"

Sure: TypeAlias = Literal["", "likely", "possible", "cannot_tell_apart"]
State: TypeAlias = Literal["open", "healed", "gone", "past", "none"]
Answer: TypeAlias = Mapping[str, Any]

_SHORT_S = 10.0
"""What lasted less long is told in tenths of a second."""
_FAILS = re.compile(r"\bfails(\.?)$")


@dataclass(frozen=True, slots=True)
class Cause:
    """What may be broken; ``share`` is how probable it is, in words.

    ``parts`` are its failure modes, each with what it is called, if it is one cause alone;
    ``of_kind`` is what they have in common with those of other instances of their types.
    """

    id: str
    text: str
    share: str
    kind: CauseKind = "fault"
    comes_from: str = ""
    parts: Sequence[tuple[str, str]] = ()
    of_kind: tuple[str, ...] = ()
    probability: float = 0.0


@dataclass(frozen=True, slots=True)
class Cleared:
    """A failure mode of which nothing shows any more, and since when."""

    id: str
    text: str
    since: str | None


@dataclass(frozen=True, slots=True)
class Reason:
    """What was seen, since when, and where the data of that moment are.

    ``until`` is when it was gone, after ``lasted``; without it is there, as far as anybody knows.
    ``small`` is the id that it has. ``owners`` are the failure modes that show it, ``weight`` is
    how much it matters, ``beside`` tells that it does not follow from what leads.
    """

    text: str
    at: str | None
    href: str
    small: str = ""
    until: str | None = None
    lasted: str = ""
    weight: float = 0.0
    owners: frozenset[str] = frozenset()
    beside: bool = False

    def over(self, hold: Hold) -> Reason:
        """Return it with both ends, in the past, once it is over; else as it is there."""
        if hold.to_ns is None:
            return replace(self, until=None, lasted="")
        lasted = _lasted((hold.to_ns - hold.from_ns) / NS)
        text = _FAILS.sub(r"failed\1", self.text)
        return replace(self, text=text, at=format_time(hold.from_ns),
                       until=format_time(hold.to_ns), lasted=lasted)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Choice:
    """An answer to a test: ``value`` is what is sent, ``leads`` what it would mean.

    Where several tests are asked as one, ``test`` is the one that it answers, ``also`` what it
    says of the others, and ``text`` what people read.
    """

    value: str
    chance: str = ""
    leads: str = ""
    then: str = ""
    text: str = ""
    test: str = ""
    also: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Safety:
    """What makes safe, against which failure modes (``why`` in words, ``faults`` by their ids)."""

    text: str
    why: str = ""
    faults: frozenset[str] = frozenset()
    is_fatal: bool = True


@dataclass(frozen=True, slots=True)
class Next:
    """What to do next; without ``test`` there is nothing to answer.

    ``make_safe`` comes before it, in the words of the robot's analysis. ``about`` are the failure
    modes that the test is about.
    """

    text: str
    test: str = ""
    role: str = ""
    minutes: str = ""
    risk: str = ""
    choices: Sequence[Choice] = ()
    remedies: Sequence[str] = ()
    make_safe: Sequence[Safety] = ()
    about: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class DiagnosisCard:
    """A diagnosis for people.

    ``state`` is ``none`` where nothing is known to be broken; then ``at`` is up to when that is
    known. It is ``gone`` where nothing of what was seen is there any more, since ``gone``, and
    ``past`` for what was known when an alarm ended. ``complete`` is false while only the robot's
    own words are known, without explanation. ``seen`` is all that was seen, ``why`` the first of
    it, ``more`` counts the others. ``cleared`` are causes beside those that lead of which nothing
    shows any more, ``steady`` failure modes that do not come and go. ``number`` is empty where
    there is none. ``names`` are failure modes in words, ``helps`` what mends them, by id;
    ``shares`` are the hypotheses with their probabilities. ``status`` is that of the robot now,
    None on cards that are not about now.
    """

    robot: str
    state: State
    at: str | None
    diagnosis: str = ""
    revision: int = 0
    causes: Sequence[Cause] = ()
    sure: Sure = ""
    number: str = ""
    why: Sequence[Reason] = ()
    more: int = 0
    severity: str = ""
    use: str = ""
    lost: Sequence[str] = ()
    careful: str = ""
    next: Next | None = None
    complete: bool = True
    answers: Mapping[str, str] | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    gone: str | None = None
    cleared: Sequence[Cleared] = ()
    steady: frozenset[str] = frozenset()
    helps: Mapping[str, str] = field(default_factory=dict)
    shares: Sequence[tuple[frozenset[str], float]] = ()
    seen: Sequence[Reason] = ()
    status: RobotStatus | None = None

    def having(self, seen: Iterable[Reason]) -> DiagnosisCard:
        """Return it with what was seen: what is there still first, of that what matters most."""
        found = in_order(seen)
        return replace(self, seen=found, why=found[:REASONS], more=max(0, len(found) - REASONS))

    def held(self, holds: Mapping[str, Hold]) -> DiagnosisCard:
        """Return it with what is known of each symptom now: until when it was there."""
        seen = [one.over(holds[one.small]) if one.small in holds else one for one in self.seen]
        card = self.having(seen)
        return card if self.state != "open" else card.without(cleared_in(card))

    def without(self, over: Mapping[str, str]) -> DiagnosisCard:
        """Return it with failure modes put apart that show no more, if others lead still."""
        parts = {id_: text for cause in self.causes for id_, text in cause.parts}
        if not (over.keys() & parts.keys() or self.cleared) or not parts.keys() - over.keys():
            return self
        causes = [_lasting(cause, over) for cause in self.causes]
        cleared = [Cleared(id_, capital(parts[id_]), over[id_]) for id_ in parts if id_ in over]
        kept = tuple({cause.text: cause for cause in causes}.values())
        step = _next_without(self.next, over, self._help(parts.keys() - over.keys()))
        return replace(self._sure_of(kept, over), causes=kept, cleared=cleared, next=step)

    def _help(self, faults: Iterable[str]) -> str:
        """Return what mends failure modes."""
        texts = (self.helps[fault] for fault in sorted(faults) if self.helps.get(fault))
        return sentence("; and ".join(dict.fromkeys(texts)))

    def _sure_of(self, causes: Sequence[Cause], over: Mapping[str, str]) -> DiagnosisCard:
        """Return it with how probable the one cause is that is left, alone or with others."""
        if len(causes) != 1 or not causes[0].parts:
            return self
        left = {id_ for id_, _ in causes[0].parts} - over.keys()
        share = min(1.0, sum(share for faults, share in self.shares if left <= faults))
        return replace(self, number=percent(share), sure=_sure(causes, share))


def in_order(seen: Iterable[Reason]) -> list[Reason]:
    """Put what is there still first, and of that what matters most."""
    return sorted(seen, key=lambda one: (one.until is not None, -one.weight))


def cleared_in(card: DiagnosisCard) -> dict[str, str]:
    """Return the failure modes of which all that they show is over, and since when."""
    shown: dict[str, list[str | None]] = {}
    for one in card.seen:
        for fault in one.owners & card.steady:
            shown.setdefault(fault, []).append(one.until)
    ended = {fault: [end for end in ends if end] for fault, ends in shown.items()}
    return {fault: max(ends) for fault, ends in ended.items() if len(ends) == len(shown[fault])}


def _next_without(step: Next | None, over: Mapping[str, str], helps: str) -> Next | None:
    """Return what to do without what shows no more; what helps in place of a test of that alone."""
    if step is None:
        return None
    safe = [
        one for one in step.make_safe
        if one.is_fatal or not one.faults or one.faults - over.keys()
    ]  # fmt: skip
    if step.about and step.about <= over.keys():
        return Next(helps, make_safe=safe) if helps or safe else None
    return replace(step, make_safe=safe)


def _lasting(cause: Cause, over: Mapping[str, str]) -> Cause:
    """Return a cause without what shows no more of it; as it is if all of it does not."""
    left = [(id_, text) for id_, text in cause.parts if id_ not in over]
    if not left:
        return cause
    text = f"{both([text for _, text in left])}{together(len(left))}"
    kind = kind_of([id_ for id_, _ in left])
    return replace(cause, text=capital(text), kind=kind)


def _lasted(seconds: float) -> str:
    short = seconds < _SHORT_S
    return catalogue().text("common.js.span.s", n=f"{seconds:.1f}") if short else span(seconds)


def nothing_broken(robot: str, at: str | None, notes: Sequence[str] = ()) -> DiagnosisCard:
    """Return the card of a robot of which nothing is known to be broken."""
    return DiagnosisCard(robot, "none", at, notes=tuple(notes))


def card_of(answer: Answer, until_ns: int | None = None) -> DiagnosisCard:
    """Return the card of an answer of ``POST .../diagnose``.

    ``until_ns``: data after this are not linked to.
    """
    told, robot = answer["explanation"], str(answer["robot"])
    if told is None:
        return nothing_broken(robot, answer["at"], answer.get("notes", ()))
    causes = tuple(_as_one(_told_causes(told["broken"])))
    probability = told["sure"]["probability"]
    seen = [reason_of(robot, one, until_ns) for one in told["because"]]
    beside = [reason_of(robot, one, until_ns) for one in told["unexplained"]]
    seen += [replace(one, beside=bool(seen)) for one in beside]
    cleared = [
        Cleared(one["id"], capital(one["text"]), _at(one["gone_ns"]))
        for one in told.get("cleared", ())
    ]
    return DiagnosisCard(
        robot, answer["state"], answer["at"], answer["id"], answer["revision"], causes,
        _sure(causes, probability), percent(probability) if causes else "",
        severity=told["use"]["severity"], use=sentence(told["use"]["text"]),
        lost=tuple(lost["text"] for lost in told["use"]["lost"]),
        careful=sentence(told["use"]["careful"]),
        next=_told_next(told["next"], answer["next_tests"]),
        answers=answer.get("answers"), names=names_in(told), notes=tuple(answer.get("notes", ())),
        cleared=cleared, steady=frozenset(_steady(told["broken"])),
        helps={fault["id"]: fault["remedy"] for fault in _faults(told["broken"])},
        shares=[(frozenset(h["faults"]), h["probability"]) for h in answer["hypotheses"]],
    ).having(seen)  # fmt: skip


def plain_card_of(revision: Answer) -> DiagnosisCard:
    """Return the card of a robot's own words alone: causes are called by their ids."""
    group = next(iter(revision["groups"]), None)
    faults = group["faults"] if group else []
    shares = {entry["id"]: entry["probability"] for entry in revision["hypotheses"]}
    causes = tuple(
        _plain_cause(ids, shares.get(name)) for name, ids in zip(
            group["members"] if group else (), faults, strict=False)
    )  # fmt: skip
    probability = group["probability"] if group else 0.0
    robot, names = str(revision["robot"]), revision.get("symptoms", [])
    return DiagnosisCard(
        robot, revision["state"], revision["at"], revision["id"], revision["revision"], causes,
        _sure(causes, probability), percent(probability) if causes else "",
        next=_plain_next(revision["next_tests"], revision.get("make_safe", ())), complete=False,
    ).having(
        Reason(check_fails(name), revision["at"], moment_href(robot, (), revision["at_ns"]), name)
        for name in names
    )  # fmt: skip


def names_in(told: Answer) -> dict[str, str]:
    """Return what the failure modes are called that an explanation names."""
    groups = [told["broken"], *told["others"]]
    return {fault["id"]: fault["text"] for group in groups for fault in _faults(group)}


def _told_causes(broken: Answer | None) -> Iterator[Cause]:
    for member in broken["members"] if broken else ():
        ids = [fault["id"] for fault in member["faults"]]
        comes_from = "; ".join(fault["cause"] for fault in member["faults"] if fault["cause"])
        yield Cause(member["id"], capital(member["text"]), percent(member["probability"]),
                    kind_of(ids), comes_from,
                    tuple((fault["id"], fault["text"]) for fault in member["faults"]),
                    _kinds(member["faults"]), member["probability"])  # fmt: skip


def _kinds(faults: Sequence[Answer]) -> tuple[str, ...]:
    """Return the kinds of failure modes; nothing where one has none, as of older servers."""
    kinds = sorted(fault.get("kind", "") for fault in faults)
    return tuple(kinds) if all(kinds) else ()


def _as_one(causes: Iterable[Cause]) -> Iterator[Cause]:
    """Join causes that differ by the instance of a type alone: which it is, is one question."""
    found: dict[object, list[Cause]] = {}
    for cause in causes:
        found.setdefault(cause.of_kind or cause.id, []).append(cause)
    for alike in found.values():
        text = merged([cause.text for cause in alike])
        whole = percent(min(1.0, sum(cause.probability for cause in alike)))
        joined = replace(alike[0], text=text, share=whole, parts=())
        yield joined if len(alike) > 1 else alike[0]


def _steady(broken: Answer | None) -> Iterator[str]:
    """Yield the failure modes that lead and do not come and go by their nature."""
    return (one["id"] for one in _faults(broken) if not one.get("intermittent", True))


def _faults(group: Answer | None) -> Iterator[Answer]:
    """Yield the failure modes of a group."""
    for member in group["members"] if group else ():
        yield from member["faults"]


def _owners(seen: Answer) -> frozenset[str]:
    """Return the failure modes that show what was seen, as surely as any of them or nearly so."""
    best = max((way["detects"] for way in seen["ways"]), default=0.0)
    return frozenset(w["fault"] for w in seen["ways"] if w["detects"] >= OWN_SHARE * best)


def _at(at_ns: int | None) -> str | None:
    return None if at_ns is None else format_time(at_ns)


def _plain_cause(ids: Sequence[str], probability: float | None) -> Cause:
    text = " + ".join(capital(readable(name.replace("#", ": ").replace("/", " "))) for name in ids)
    share = "" if probability is None else percent(probability)
    return Cause(" ".join(ids), text, share, kind_of(ids))


def _sure(causes: Sequence[Cause], probability: float) -> Sure:
    if len(causes) > 1:
        return "cannot_tell_apart"
    if not causes:
        return ""
    return "likely" if probability >= LIKELY else "possible"


def reason_of(robot: str, seen: Answer, until_ns: int | None = None) -> Reason:
    """Return what was seen, with a link to the data of its beginning."""
    onset_ns, gone_ns = seen["onset_ns"], seen.get("gone_ns")
    found = Reason(
        sentence(seen["text"]), _at(onset_ns),
        moment_href(robot, seen["measured_from"], onset_ns, until_ns), str(seen.get("id", "")),
        weight=seen.get("weight", 0.0), owners=_owners(seen),
    )  # fmt: skip
    return found if gone_ns is None else found.over(Hold(onset_ns or gone_ns, gone_ns))


def check_fails(symptom: str) -> str:
    """Say that a check fails, by the id of its symptom."""
    parts = [capital(readable(part)) if k == 0 else readable(part)
             for k, part in enumerate(symptom.split("/"))]  # fmt: skip
    if len(parts) < 3:
        return sentence(" ".join(parts))
    return f"{parts[0]}: “{': '.join(parts[1:])}” fails."


def choices_of(test: Answer, step: Answer | None = None) -> tuple[Choice, ...]:
    """Return the answers of a test; of a step also what they would mean."""
    if step and step.get("instances"):
        return _which(step["instances"])
    if step is None:
        plain = [Choice(value, percent(chance)) for value, chance in test["outcomes"].items()]
        return _in_order(plain)
    told = [
        Choice(b["answer"], percent(b["probability"]), b["leads"], percent(b["then"]))
        for b in step["answers"]
    ]
    return _in_order(told)


def _which(instances: Sequence[Answer]) -> tuple[Choice, ...]:
    """Return the answers to tests that are asked as one: which of them gives what, or none."""
    found = [
        Choice(value, text=f"{capital(one['where'])}: {value}", test=one["test"])
        for one in instances for value in one["outcomes"][1:]
    ]  # fmt: skip
    sound = {one["test"]: one["outcomes"][0] for one in instances}
    first = next(iter(sound))
    text = catalogue().text("diagnosis.card.none_of_them", value=sound[first])
    none = Choice(sound.pop(first), text=text, test=first, also=sound)
    return (*found, none)


def _told_next(step: Answer, tests: Sequence[Answer]) -> Next:
    test = next((test for test in tests if test["id"] == step["test"]), None)
    safe = step.get("make_safe", ())
    return Next(
        sentence(step["then"] if safe else step["text"]), step["test"], step["by"],
        minutes(test["cost_s"]) if test else step["takes"], step["risk"],
        choices_of({}, step) if step["test"] else (),
        tuple(sentence(text) for text in step["remedies"]),
        tuple(_safety(action) for action in safe),
        frozenset(step.get("about", ())),
    )  # fmt: skip


def _safety(action: Answer) -> Safety:
    is_fatal = action["severity"] == "fatal"
    return Safety(
        sentence(action["text"]), capital(action["why"]), frozenset(action["faults"]), is_fatal
    )


def _plain_next(tests: Sequence[Answer], safe: Sequence[str]) -> Next | None:
    actions = tuple(Safety(sentence(text)) for text in safe)
    if not tests:
        return Next("", make_safe=actions) if actions else None
    test = tests[0]
    return Next(sentence(test["text"]), test["id"], test["role"], minutes(test["cost_s"]),
                choices=choices_of(test), make_safe=actions)  # fmt: skip


def _in_order(choices: Sequence[Choice]) -> tuple[Choice, ...]:
    """Put yes before no, whatever is more probable; others stay as they are."""
    rank = {"yes": 0, "no": 1}
    return tuple(sorted(choices, key=lambda choice: rank.get(choice.value, 2)))


def minutes(seconds: float) -> str:
    """Write how many minutes something takes: half a minute at least."""
    if seconds <= 0:
        return ""
    if seconds <= 45:
        return "½"
    return f"{max(1, round(seconds / 60))}"
