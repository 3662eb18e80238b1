"""The card that answers what is broken: made of what the server says about a diagnosis.

It has the same parts wherever it stands: what is broken, how sure, why, whether the robot can be
used, what to do next. Texts about the robot come from its own list of what can fail.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.robotstatus import RobotStatus
from amberbox.core.sureness import LIKELY, percent
from amberbox.core.timetext import format_time
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
    """What may be broken; ``share`` is how probable it is, in words."""

    id: str
    text: str
    share: str
    kind: CauseKind = "fault"
    comes_from: str = ""


@dataclass(frozen=True, slots=True)
class Reason:
    """What was seen, since when, and where the data of that moment are.

    ``until`` is when it was gone, after ``lasted``; without it is there, as far as anybody knows.
    ``small`` is the id that it has.
    """

    text: str
    at: str | None
    href: str
    small: str = ""
    until: str | None = None
    lasted: str = ""

    def over(self, hold: Hold) -> Reason:
        """Return it with both ends, in the past, once it is over."""
        if hold.to_ns is None:
            return self
        lasted = _lasted((hold.to_ns - hold.from_ns) / NS)
        text = _FAILS.sub(r"failed\1", self.text)
        return replace(self, text=text, at=format_time(hold.from_ns),
                       until=format_time(hold.to_ns), lasted=lasted)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Choice:
    """An answer to a test: ``value`` is what is sent, ``leads`` what it would mean."""

    value: str
    chance: str = ""
    leads: str = ""
    then: str = ""


@dataclass(frozen=True, slots=True)
class Next:
    """What to do next; without ``test`` there is nothing to answer."""

    text: str
    test: str = ""
    role: str = ""
    minutes: str = ""
    risk: str = ""
    choices: Sequence[Choice] = ()
    remedies: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class DiagnosisCard:
    """A diagnosis for people.

    ``state`` is ``none`` where nothing is known to be broken; then ``at`` is up to when that is
    known. It is ``gone`` where nothing of what was seen is there any more, since ``gone``, and
    ``past`` for what was known when an alarm ended. ``complete`` is false while only the robot's
    own words are known, without explanation. ``more`` counts what was seen beyond ``why``.
    ``number`` is empty where there is none. ``names`` are failure modes in words, by id.
    ``status`` is that of the robot now, None on cards that are not about now.
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
    status: RobotStatus | None = None


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
    causes = tuple(_told_causes(told["broken"]))
    probability = told["sure"]["probability"]
    seen = told["because"] or told["unexplained"]
    return DiagnosisCard(
        robot, answer["state"], answer["at"], answer["id"], answer["revision"], causes,
        _sure(causes, probability), percent(probability) if causes else "",
        tuple(reason_of(robot, one, until_ns) for one in seen[:REASONS]),
        max(0, len(seen) - REASONS),
        told["use"]["severity"], sentence(told["use"]["text"]),
        tuple(lost["text"] for lost in told["use"]["lost"]), sentence(told["use"]["careful"]),
        _told_next(told["next"], answer["next_tests"]),
        answers=answer.get("answers"), names=names_in(told), notes=tuple(answer.get("notes", ())),
    )  # fmt: skip


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
        tuple(Reason(check_fails(name), revision["at"],
                     moment_href(robot, (), revision["at_ns"]), name) for name in names[:REASONS]),
        max(0, len(names) - REASONS),
        next=_plain_next(revision["next_tests"]), complete=False,
    )  # fmt: skip


def names_in(told: Answer) -> dict[str, str]:
    """Return what the failure modes are called that an explanation names."""
    groups = [*([told["broken"]] if told["broken"] else ()), *told["others"]]
    faults = (fault for group in groups for one in group["members"] for fault in one["faults"])
    return {fault["id"]: fault["text"] for fault in faults}


def _told_causes(broken: Answer | None) -> Iterator[Cause]:
    for member in broken["members"] if broken else ():
        ids = [fault["id"] for fault in member["faults"]]
        comes_from = "; ".join(fault["cause"] for fault in member["faults"] if fault["cause"])
        yield Cause(member["id"], capital(member["text"]), percent(member["probability"]),
                    kind_of(ids), comes_from)  # fmt: skip


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
    onset_ns = seen["onset_ns"]
    return Reason(
        sentence(seen["text"]), None if onset_ns is None else format_time(onset_ns),
        moment_href(robot, seen["measured_from"], onset_ns, until_ns), str(seen.get("id", "")),
    )  # fmt: skip


def check_fails(symptom: str) -> str:
    """Say that a check fails, by the id of its symptom."""
    parts = [capital(readable(part)) if k == 0 else readable(part)
             for k, part in enumerate(symptom.split("/"))]  # fmt: skip
    if len(parts) < 3:
        return sentence(" ".join(parts))
    return f"{parts[0]}: “{': '.join(parts[1:])}” fails."


def choices_of(test: Answer, step: Answer | None = None) -> tuple[Choice, ...]:
    """Return the answers of a test; of a step also what they would mean."""
    if step is None:
        plain = [Choice(value, percent(chance)) for value, chance in test["outcomes"].items()]
        return _in_order(plain)
    told = [
        Choice(b["answer"], percent(b["probability"]), b["leads"], percent(b["then"]))
        for b in step["answers"]
    ]
    return _in_order(told)


def _told_next(step: Answer, tests: Sequence[Answer]) -> Next:
    test = next((test for test in tests if test["id"] == step["test"]), None)
    return Next(
        sentence(step["text"]), step["test"], step["by"],
        minutes(test["cost_s"]) if test else step["takes"], step["risk"],
        choices_of({}, step) if step["test"] else (),
        tuple(sentence(text) for text in step["remedies"]),
    )  # fmt: skip


def _plain_next(tests: Sequence[Answer]) -> Next | None:
    if not tests:
        return None
    test = tests[0]
    return Next(sentence(test["text"]), test["id"], test["role"], minutes(test["cost_s"]),
                choices=choices_of(test))  # fmt: skip


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
