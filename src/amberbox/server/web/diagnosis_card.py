"""The card of a diagnosis: what is broken, why, and what to do next."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias
from urllib.parse import quote, urlencode

from fastapi import HTTPException

from amberbox.core.api import CauseKind
from amberbox.core.clock import NS
from amberbox.core.robot_status import RobotStatus
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.core.units import LIKELY, percent
from amberbox.diagnosis.fmea.loader import FILE
from amberbox.diagnosis.report.explain import OWN_SHARE
from amberbox.diagnosis.report.wording import (
    capitalize,
    common_onset_text,
    join_with_and,
    merge_texts,
    readable,
    sentence,
)
from amberbox.server.alarms.alarm import kind_of
from amberbox.server.knowledge import explanations
from amberbox.server.knowledge.diagnoses import (
    DiagnosisHistory,
    SymptomInterval,
    find_diagnosis,
    gone_since,
    newest_diagnosis,
    symptom_intervals,
)
from amberbox.server.knowledge.explanations import Answer as explanations_Answer
from amberbox.server.knowledge.explanations import latest_answer
from amberbox.server.live.status import AssessedRobot as Now
from amberbox.server.services.commands import remedies
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.knowledge import revision_json
from amberbox.server.web.text import catalogue, moment_href, span

REASONS = 3
"""Number of sentences under "Why"."""
CANNOT = "cannot"
_RECOVERIES = 6

Sure: TypeAlias = Literal["", "likely", "possible", "cannot_tell_apart"]
State: TypeAlias = Literal["open", "healed", "gone", "past", "none"]
Answer: TypeAlias = Mapping[str, Any]

_SHORT_S = 10.0
"""A shorter duration is shown in tenths of a second."""
_FAILS = re.compile(r"\bfails(\.?)$")


@dataclass(frozen=True, slots=True)
class CardCause:
    """A possible cause; ``share`` is its probability as text.

    ``parts`` are its failure modes with their names, if it is one cause alone; ``of_kind`` is what
    they have in common with those of other instances of their types.
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
    """A failure mode without remaining symptoms, and since when."""

    id: str
    text: str
    since: str | None


@dataclass(frozen=True, slots=True)
class CardReason:
    """An observed symptom, its onset, and a link to the data at that time.

    ``until`` is its end, after ``lasted``; without ``until`` it is still present as far as is
    known. ``small`` is its id. ``owners`` are the failure modes that show it, ``weight`` is its
    importance, ``beside``: it does not follow from the leading hypothesis.
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

    def over(self, hold: SymptomInterval) -> CardReason:
        """Return it with onset and end, in the past tense, if it has ended; else without an end."""
        if hold.to_ns is None:
            return replace(self, until=None, lasted="")
        lasted = _lasted((hold.to_ns - hold.from_ns) / NS)
        text = _FAILS.sub(r"failed\1", self.text)
        return replace(self, text=text, at=format_time(hold.from_ns),
                       until=format_time(hold.to_ns), lasted=lasted)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Choice:
    """An answer to a test: ``value`` is sent, ``leads`` is the hypothesis that would lead then.

    Where several tests are asked as one, ``test`` is the one that it answers, ``also`` its values
    for the other tests, and ``text`` the label.
    """

    value: str
    chance: str = ""
    leads: str = ""
    then: str = ""
    text: str = ""
    test: str = ""
    also: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SafetyAction:
    """An action that makes safe; ``why`` are its failure modes in words, ``faults`` their ids."""

    text: str
    why: str = ""
    faults: frozenset[str] = frozenset()
    is_fatal: bool = True


@dataclass(frozen=True, slots=True)
class CardNextStep:
    """The next step; without ``test`` there is nothing to answer.

    ``make_safe`` are actions before it, in the words of the robot's FMEA. ``about`` are the failure
    modes that the test concerns. ``run`` is the name of the experiment or unit test (``kind``) that
    the test is.
    """

    text: str
    test: str = ""
    role: str = ""
    minutes: str = ""
    risk: str = ""
    choices: Sequence[Choice] = ()
    remedies: Sequence[str] = ()
    make_safe: Sequence[SafetyAction] = ()
    about: frozenset[str] = frozenset()
    kind: str = ""
    run: str = ""

    def run_href(self, robot: str, diagnosis: str) -> str:
        """Return the page that starts the run; its verdict answers the test."""
        about = {"diagnosis": diagnosis, "test": self.test}
        page = f"/robots/{quote(robot, '')}/experiments"
        if self.kind == "unit_test":
            return f"{page}?{urlencode({**about, 'unit_test': self.run})}#unit-tests"
        return f"{page}/{quote(self.run, '')}?{urlencode(about)}"


@dataclass(frozen=True, slots=True)
class DiagnosisCard:
    """The content of the card of a diagnosis.

    ``state`` is ``none`` if nothing is known to be broken; then ``at`` is the time up to which that
    is known. It is ``gone`` if no symptom is present any more, since ``gone``, and ``past`` for the
    diagnosis when an alarm ended. ``complete`` is false while only the robot's own report is known,
    without explanation. ``seen`` are all symptoms, ``why`` the first of them, ``more`` counts the
    others. ``cleared`` are causes without remaining symptoms, ``steady`` failure modes that are not
    intermittent. ``number`` is the probability as text, empty if there is none. ``names`` are the
    names of failure modes and ``helps`` their remedies, by id; ``shares`` are the hypotheses with
    their probabilities. ``status`` is the present status of the robot, None on cards that are not
    about the present. ``recoveries`` are actions that the robot says to be remedies.
    """

    robot: str
    state: State
    at: str | None
    diagnosis: str = ""
    revision: int = 0
    causes: Sequence[CardCause] = ()
    sure: Sure = ""
    number: str = ""
    why: Sequence[CardReason] = ()
    more: int = 0
    severity: str = ""
    use: str = ""
    lost: Sequence[str] = ()
    careful: str = ""
    next: CardNextStep | None = None
    complete: bool = True
    answers: Mapping[str, str] | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    gone: str | None = None
    cleared: Sequence[Cleared] = ()
    steady: frozenset[str] = frozenset()
    helps: Mapping[str, str] = field(default_factory=dict)
    shares: Sequence[tuple[frozenset[str], float]] = ()
    seen: Sequence[CardReason] = ()
    status: RobotStatus | None = None
    recoveries: Sequence[str] = ()

    def having(self, seen: Iterable[CardReason]) -> DiagnosisCard:
        """Return it with symptoms: those still present first, then by weight."""
        found = in_order(seen)
        return replace(self, seen=found, why=found[:REASONS], more=max(0, len(found) - REASONS))

    def held(self, holds: Mapping[str, SymptomInterval]) -> DiagnosisCard:
        """Return it with the ends of its symptoms."""
        seen = [one.over(holds[one.small]) if one.small in holds else one for one in self.seen]
        card = self.having(seen)
        return card if self.state != "open" else card.without(cleared_in(card))

    def without(self, over: Mapping[str, str]) -> DiagnosisCard:
        """Return it with failure modes without symptoms moved to ``cleared``, if others remain."""
        parts = {id_: text for cause in self.causes for id_, text in cause.parts}
        if not (over.keys() & parts.keys() or self.cleared) or not parts.keys() - over.keys():
            return self
        causes = [_lasting(cause, over) for cause in self.causes]
        cleared = [Cleared(id_, capitalize(parts[id_]), over[id_]) for id_ in parts if id_ in over]
        kept = tuple({cause.text: cause for cause in causes}.values())
        step = _next_without(self.next, over, self._help(parts.keys() - over.keys()))
        return replace(self._sure_of(kept, over), causes=kept, cleared=cleared, next=step)

    def _help(self, faults: Iterable[str]) -> str:
        """Return the remedies of failure modes as a sentence."""
        texts = (self.helps[fault] for fault in sorted(faults) if self.helps.get(fault))
        return sentence("; and ".join(dict.fromkeys(texts)))

    def _sure_of(self, causes: Sequence[CardCause], over: Mapping[str, str]) -> DiagnosisCard:
        """Return the card with the probability of the one remaining cause, alone or with others."""
        if len(causes) != 1 or not causes[0].parts:
            return self
        left = {id_ for id_, _ in causes[0].parts} - over.keys()
        share = min(1.0, sum(share for faults, share in self.shares if left <= faults))
        return replace(self, number=percent(share), sure=_sure(causes, share))


def in_order(seen: Iterable[CardReason]) -> list[CardReason]:
    """Return symptoms sorted: those still present first, then by weight."""
    return sorted(seen, key=lambda one: (one.until is not None, -one.weight))


def cleared_in(card: DiagnosisCard) -> dict[str, str]:
    """Return the steady failure modes whose symptoms have all ended, and since when."""
    shown: dict[str, list[str | None]] = {}
    for one in card.seen:
        for fault in one.owners & card.steady:
            shown.setdefault(fault, []).append(one.until)
    ended = {fault: [end for end in ends if end] for fault, ends in shown.items()}
    return {fault: max(ends) for fault, ends in ended.items() if len(ends) == len(shown[fault])}


def _next_without(
    step: CardNextStep | None, over: Mapping[str, str], helps: str
) -> CardNextStep | None:
    """Return the step without cleared failure modes; the remedies if its test has no others."""
    if step is None:
        return None
    safe = [
        one for one in step.make_safe
        if one.is_fatal or not one.faults or one.faults - over.keys()
    ]  # fmt: skip
    if step.about and step.about <= over.keys():
        return CardNextStep(helps, make_safe=safe) if helps or safe else None
    return replace(step, make_safe=safe)


def _lasting(cause: CardCause, over: Mapping[str, str]) -> CardCause:
    """Return a cause without its cleared failure modes; unchanged if all are cleared."""
    left = [(id_, text) for id_, text in cause.parts if id_ not in over]
    if not left:
        return cause
    text = f"{join_with_and([text for _, text in left])}{common_onset_text(len(left))}"
    kind = kind_of([id_ for id_, _ in left])
    return replace(cause, text=capitalize(text), kind=kind)


def _lasted(seconds: float) -> str:
    short = seconds < _SHORT_S
    return catalogue().text("common.js.span.s", n=f"{seconds:.1f}") if short else span(seconds)


def nothing_broken(robot: str, at: str | None, notes: Sequence[str] = ()) -> DiagnosisCard:
    """Return the card of a robot without any known failure."""
    return DiagnosisCard(robot, "none", at, notes=tuple(notes))


def card_of(answer: Answer, until_ns: int | None = None) -> DiagnosisCard:
    """Return the card of an answer of ``POST .../diagnose``.

    ``until_ns``: links do not include data after this.
    """
    explanation, robot = answer["explanation"], str(answer["robot"])
    if explanation is None:
        return nothing_broken(robot, answer["at"], answer.get("notes", ()))
    causes = tuple(_as_one(_causes_of(explanation["broken"])))
    probability = explanation["sure"]["probability"]
    seen = [reason_of(robot, one, until_ns) for one in explanation["because"]]
    beside = [reason_of(robot, one, until_ns) for one in explanation["unexplained"]]
    seen += [replace(one, beside=bool(seen)) for one in beside]
    cleared = [
        Cleared(one["id"], capitalize(one["text"]), maybe_time(one["gone_ns"]))
        for one in explanation.get("cleared", ())
    ]
    return DiagnosisCard(
        robot, answer["state"], answer["at"], answer["id"], answer["revision"], causes,
        _sure(causes, probability), percent(probability) if causes else "",
        severity=explanation["use"]["severity"], use=sentence(explanation["use"]["text"]),
        lost=tuple(lost["text"] for lost in explanation["use"]["lost"]),
        careful=sentence(explanation["use"]["careful"]),
        next=_next_of(explanation["next"], answer["next_tests"]),
        answers=answer.get("answers"), names=names_in(explanation),
        notes=tuple(answer.get("notes", ())),
        cleared=cleared, steady=frozenset(_steady(explanation["broken"])),
        helps={fault["id"]: fault["remedy"] for fault in _faults(explanation["broken"])},
        shares=[(frozenset(h["faults"]), h["probability"]) for h in answer["hypotheses"]],
    ).having(seen)  # fmt: skip


def plain_card_of(revision: Answer) -> DiagnosisCard:
    """Return the card of a robot's own report: without explanation, causes named by their ids."""
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
        robot,
        revision["state"],
        revision["at"],
        revision["id"],
        revision["revision"],
        causes,
        _sure(causes, probability),
        percent(probability) if causes else "",
        next=_plain_next(revision["next_tests"], revision.get("make_safe", ())),
        complete=False,
    ).having(
        CardReason(
            check_fails(name), revision["at"], moment_href(robot, (), revision["at_ns"]), name
        )
        for name in names
    )


def names_in(explanation: Answer) -> dict[str, str]:
    """Return the names of the failure modes in an explanation, by id."""
    groups = [explanation["broken"], *explanation["others"]]
    return {fault["id"]: fault["text"] for group in groups for fault in _faults(group)}


def _causes_of(broken: Answer | None) -> Iterator[CardCause]:
    for member in broken["members"] if broken else ():
        ids = [fault["id"] for fault in member["faults"]]
        comes_from = "; ".join(fault["cause"] for fault in member["faults"] if fault["cause"])
        yield CardCause(member["id"], capitalize(member["text"]), percent(member["probability"]),
                    kind_of(ids), comes_from,
                    tuple((fault["id"], fault["text"]) for fault in member["faults"]),
                    _kinds(member["faults"]), member["probability"])  # fmt: skip


def _kinds(faults: Sequence[Answer]) -> tuple[str, ...]:
    """Return the kinds of failure modes; empty if one has none, as from older servers."""
    kinds = sorted(fault.get("kind", "") for fault in faults)
    return tuple(kinds) if all(kinds) else ()


def _as_one(causes: Iterable[CardCause]) -> Iterator[CardCause]:
    """Merge causes that differ only in the instance of a type: a test finds out which one it is."""
    found: dict[object, list[CardCause]] = {}
    for cause in causes:
        found.setdefault(cause.of_kind or cause.id, []).append(cause)
    for alike in found.values():
        text = merge_texts([cause.text for cause in alike])
        whole = percent(min(1.0, sum(cause.probability for cause in alike)))
        joined = replace(alike[0], text=text, share=whole, parts=())
        yield joined if len(alike) > 1 else alike[0]


def _steady(broken: Answer | None) -> Iterator[str]:
    """Yield the leading failure modes that are not intermittent."""
    return (one["id"] for one in _faults(broken) if not one.get("intermittent", True))


def _faults(group: Answer | None) -> Iterator[Answer]:
    """Yield the failure modes of a group."""
    for member in group["members"] if group else ():
        yield from member["faults"]


def _owners(seen: Answer) -> frozenset[str]:
    """Return the failure modes that show a symptom with (nearly) the highest probability."""
    best = max((way["detects"] for way in seen["ways"]), default=0.0)
    return frozenset(w["fault"] for w in seen["ways"] if w["detects"] >= OWN_SHARE * best)


def _plain_cause(ids: Sequence[str], probability: float | None) -> CardCause:
    text = " + ".join(
        capitalize(readable(name.replace("#", ": ").replace("/", " "))) for name in ids
    )
    share = "" if probability is None else percent(probability)
    return CardCause(" ".join(ids), text, share, kind_of(ids))


def _sure(causes: Sequence[CardCause], probability: float) -> Sure:
    if len(causes) > 1:
        return "cannot_tell_apart"
    if not causes:
        return ""
    return "likely" if probability >= LIKELY else "possible"


def reason_of(robot: str, seen: Answer, until_ns: int | None = None) -> CardReason:
    """Return a symptom, with a link to the data at its onset."""
    onset_ns, gone_ns = seen["onset_ns"], seen.get("gone_ns")
    found = CardReason(
        sentence(seen["text"]), maybe_time(onset_ns),
        moment_href(robot, seen["measured_from"], onset_ns, until_ns), str(seen.get("id", "")),
        weight=seen.get("weight", 0.0), owners=_owners(seen),
    )  # fmt: skip
    return found if gone_ns is None else found.over(SymptomInterval(onset_ns or gone_ns, gone_ns))


def check_fails(symptom: str) -> str:
    """Return the sentence that a check fails, from the id of its symptom."""
    parts = [capitalize(readable(part)) if k == 0 else readable(part)
             for k, part in enumerate(symptom.split("/"))]  # fmt: skip
    if len(parts) < 3:
        return sentence(" ".join(parts))
    return f"{parts[0]}: “{': '.join(parts[1:])}” fails."


def choices_of(test: Answer, step: Answer | None = None) -> tuple[Choice, ...]:
    """Return the answers of a test; for a step with their consequences."""
    if step and step.get("instances"):
        return _which(step["instances"])
    if step is None:
        plain = [Choice(value, percent(chance)) for value, chance in test["outcomes"].items()]
        return _in_order(plain)
    choices = [
        Choice(b["answer"], percent(b["probability"]), b["leads"], percent(b["then"]))
        for b in step["answers"]
    ]
    return _in_order(choices)


def _which(instances: Sequence[Answer]) -> tuple[Choice, ...]:
    """Return the answers to several tests asked as one: which of them fails, or none."""
    found = [
        Choice(value, text=f"{capitalize(one['where'])}: {value}", test=one["test"])
        for one in instances for value in one["outcomes"][1:]
    ]  # fmt: skip
    sound = {one["test"]: one["outcomes"][0] for one in instances}
    first = next(iter(sound))
    text = catalogue().text("diagnosis.card.none_of_them", value=sound[first])
    none = Choice(sound.pop(first), text=text, test=first, also=sound)
    return (*found, none)


def _next_of(step: Answer, tests: Sequence[Answer]) -> CardNextStep:
    test = next((test for test in tests if test["id"] == step["test"]), None)
    safe = step.get("make_safe", ())
    return CardNextStep(
        sentence(step["then"] if safe else step["text"]), step["test"], step["by"],
        minutes(test["cost_s"]) if test else step["takes"], step["risk"],
        choices_of({}, step) if step["test"] else (),
        tuple(sentence(text) for text in step["remedies"]),
        tuple(_safety(action) for action in safe),
        frozenset(step.get("about", ())), step.get("kind", ""), step.get("run", ""),
    )  # fmt: skip


def _safety(action: Answer) -> SafetyAction:
    is_fatal = action["severity"] == "fatal"
    return SafetyAction(
        sentence(action["text"]), capitalize(action["why"]), frozenset(action["faults"]), is_fatal
    )


def _plain_next(tests: Sequence[Answer], safe: Sequence[str]) -> CardNextStep | None:
    actions = tuple(SafetyAction(sentence(text)) for text in safe)
    if not tests:
        return CardNextStep("", make_safe=actions) if actions else None
    test = tests[0]
    return CardNextStep(sentence(test["text"]), test["id"], test["role"], minutes(test["cost_s"]),
                choices=choices_of(test), make_safe=actions,
                kind=test["kind"], run=test.get("run") or "")  # fmt: skip


def _in_order(choices: Sequence[Choice]) -> tuple[Choice, ...]:
    """Return answers with yes before no, whatever their probability; others keep their order."""
    rank = {"yes": 0, "no": 1}
    return tuple(sorted(choices, key=lambda choice: rank.get(choice.value, 2)))


def minutes(seconds: float) -> str:
    """Return a duration in minutes as text: ``½`` at least, empty for none."""
    if seconds <= 0:
        return ""
    if seconds <= 45:
        return "½"
    return f"{max(1, round(seconds / 60))}"


Missing: TypeAlias = Literal["", "never", "folder", "fmea"]
"""A missing requirement of a diagnosis: a connection, the robot's folder, its failure modes."""


@dataclass(frozen=True, slots=True)
class DiagnosisView:
    """A diagnosis of a robot with answers and causes from people; ``known`` is None without one.

    ``is_newest``: it is the robot's last diagnosis. ``is_past``: it is shown in the state of an
    earlier revision. ``holds`` are the intervals of its symptoms.
    """

    robot: str
    known: DiagnosisHistory | None = None
    is_newest: bool = True
    given: tuple[explanations.GivenAnswer, ...] = ()
    made: tuple[explanations.Revision, ...] = ()
    causes: tuple[explanations.GivenCause, ...] = ()
    answers: dict[str, str] = field(default_factory=dict)
    holds: Mapping[str, SymptomInterval] = field(default_factory=dict)
    is_past: bool = False

    @property
    def stands(self) -> bool:
        """Return whether it states that something is broken, or is an earlier one."""
        return self.known is not None and (self.known.last.state == "open" or not self.is_newest)


def look(fleet: Services, robot: str, diagnosis: str = "") -> DiagnosisView:
    """Return a diagnosis, by default the newest; raises 404 for an unknown id."""
    last = newest_diagnosis(fleet, robot)
    if not diagnosis or (last is not None and last.id == diagnosis):
        known, is_newest = last, not diagnosis or (last is not None and last.last.state == "open")
    else:
        known, is_newest = find_diagnosis(fleet, robot, diagnosis), False
        if known is None:
            raise HTTPException(404, "this robot has no such diagnosis")
    return (
        _with_annotations(fleet, DiagnosisView(robot, known, is_newest))
        if known
        else DiagnosisView(robot)
    )


def view_diagnosis_at(
    fleet: Services, robot: str, diagnosis: str, revision: int, end_ns: int | None = None
) -> DiagnosisView:
    """Return a diagnosis in the state of a revision.

    With revision 0 it is the last one up to an instant. Raises 404 as ``look`` does.
    """
    whole = find_diagnosis(fleet, robot, diagnosis)
    if whole is None:
        raise HTTPException(404, "this robot has no such diagnosis")
    if not revision and end_ns is not None:
        early = [one.revision for one in whole.revisions if one.at_ns <= end_ns]
        revision = max(early, default=whole.revisions[0].revision)
    known = whole.until(revision) if revision else whole
    later = next((one.at_ns for one in whole.revisions if one.revision > known.last.revision), None)
    return _with_annotations(
        fleet, DiagnosisView(robot, known, is_newest=False, is_past=True), later
    )


def card_now(fleet: Services, seen: DiagnosisView, now: Now | None = None) -> DiagnosisCard:
    """Return the card of a diagnosis without waiting; ``now`` is the robot's present status."""
    if seen.known is None or not seen.stands:
        return _nothing(seen, now)
    answer = _at_hand(fleet, seen)
    known = seen.known
    card = _plain(seen, known) if answer is None else _card(answer, seen, known)
    return _with_recoveries(fleet, _timed(card, seen, known, now, fleet.clock.wall_ns()))


async def explained_card(
    fleet: Services, who: Caller, seen: DiagnosisView, now: Now | None
) -> DiagnosisCard:
    """Return the card with its explanation; raises AmberboxError if there can be none."""
    if seen.known is None or not seen.stands:
        return _nothing(seen, now)
    card = _card(await read_explanation(fleet, who, seen), seen, seen.known)
    timed = _timed(card, seen, seen.known, now, fleet.clock.wall_ns())
    return await asyncio.to_thread(_with_recoveries, fleet, timed)


def _with_recoveries(fleet: Services, card: DiagnosisCard) -> DiagnosisCard:
    """Return a card with the actions that the robot says to be remedies of its causes."""
    if card.state != "open":
        return card
    known = remedies(fleet, card.robot)
    faults = [id_ for cause in card.causes for id_ in cause.id.split()]
    found = [name for id_ in faults for key in (id_, id_.partition("#")[0])
             for name in known.get(key, ())]  # fmt: skip
    return replace(card, recoveries=tuple(dict.fromkeys(found))[:_RECOVERIES])


async def read_explanation(
    fleet: Services, who: Caller, seen: DiagnosisView
) -> explanations_Answer:
    """Return the explained diagnosis, cached or from a worker."""
    assert seen.known is not None
    found = _at_hand(fleet, seen)
    if found is not None:
        return found
    return await fleet.explained.read(seen.robot, seen.known.last, seen.answers, who.person)


def current_card(fleet: Services, robot: str, now: Now | None = None) -> DiagnosisCard:
    """Return the card of a robot's newest diagnosis without waiting, for other pages."""
    return card_now(fleet, look(fleet, robot), now)


def missing(fleet: Services, robot: str, ever_seen: bool) -> Missing:
    """Return the missing requirement of a diagnosis of a robot."""
    if not ever_seen:
        return "never"
    stated = fleet.folders.current(robot)
    wanted = stated if stated and not fleet.folders.wants(robot, stated) else ""
    kept = [wanted] if wanted else [one.config_hash for one in fleet.folders.kept(robot)[:1]]
    if not kept:
        return "folder"
    return "" if (fleet.folders.shelf.place(robot, kept[0]) / FILE).is_file() else "fmea"


def leading_faults(fleet: Services, seen: DiagnosisView) -> list[str]:
    """Return the failure modes of the hypotheses, most probable first."""
    if seen.known is None:
        return []
    answer = _at_hand(fleet, seen)
    found = answer["hypotheses"] if answer else revision_json(seen.known.peak)["hypotheses"]
    return [fault for entry in found for fault in entry["faults"]]


def _with_annotations(
    fleet: Services, seen: DiagnosisView, before_ns: int | None = None
) -> DiagnosisView:
    """Add answers and causes (answers only before a later revision), and intervals of symptoms."""
    assert seen.known is not None
    of = seen.robot, seen.known.id
    with fleet.database.reading() as connection:
        given = explanations.read_answers(connection, *of)
        made = explanations.read_revisions(connection, *of)
        causes = explanations.read_causes(connection, *of)
    if before_ns is not None:
        given = [one for one in given if one.at_ns < before_ns]
        made = [one for one in made if one.at_ns < before_ns]
    return replace(
        seen, given=tuple(given), made=tuple(made), causes=tuple(causes),
        answers=explanations.latest_by_test(given),
        holds=symptom_intervals(fleet, seen.robot, seen.known.revisions),
    )  # fmt: skip


def _at_hand(fleet: Services, seen: DiagnosisView) -> explanations_Answer | None:
    assert seen.known is not None
    kept = latest_answer(seen.known, list(seen.made))
    return kept or fleet.explained.known(seen.robot, seen.known.last, seen.answers)


def _plain(seen: DiagnosisView, known: DiagnosisHistory) -> DiagnosisCard:
    plain = plain_card_of(revision_json(known.peak))
    return replace(plain, state=known.last.state, answers=seen.answers)


def _card(
    answer: explanations_Answer, seen: DiagnosisView, known: DiagnosisHistory
) -> DiagnosisCard:
    """Return the card of an answer, with the present state of the diagnosis.

    If the answer finds nothing broken, the robot's own report is shown.
    """
    card = card_of(answer)
    if card.state == "none":
        return replace(_plain(seen, known), complete=True, notes=card.notes)
    return replace(card, state=known.last.state, answers=seen.answers)


def _nothing(seen: DiagnosisView, now: Now | None) -> DiagnosisCard:
    if now is None:
        return nothing_broken(seen.robot, None)
    return replace(nothing_broken(seen.robot, now.status.as_of), status=now.status)


def _timed(
    card: DiagnosisCard, seen: DiagnosisView, known: DiagnosisHistory, now: Now | None, now_ns: int
) -> DiagnosisCard:
    """Return a card with the ends of its symptoms, and its state.

    For the robot's newest diagnosis, its status determines whether symptoms are present.
    """
    card = card.held(seen.holds)
    if seen.is_past:
        return replace(card, state="past")
    if now is not None and seen.is_newest:
        card = replace(card, status=now.status)
    if card.state != "open":
        return card
    standing = now.recent.diagnosis if now is not None else None
    if now is not None and standing is not None and standing.id == known.id:
        gone_ns = now.gone_ns
    else:
        gone_ns = gone_since(known.last.symptoms, seen.holds, now_ns)
    return card if gone_ns is None else replace(card, state="gone", gone=format_time(gone_ns))
