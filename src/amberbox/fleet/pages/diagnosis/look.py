"""Which diagnosis of a robot is looked at, and the card that tells it.

``card_now`` never waits for a worker: pages are there at once, with the explanation if it is
known already, else in the robot's own words. ``card_told`` waits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from fastapi import HTTPException

from amberbox.core.timetext import format_time
from amberbox.diagnosis.fmea.load import FILE
from amberbox.fleet.api.access import Caller
from amberbox.fleet.api.diagnoses import revision_json
from amberbox.fleet.knowledge import notebook
from amberbox.fleet.knowledge.asked import AskDiagnosis
from amberbox.fleet.knowledge.explained import Answer, kept_answer
from amberbox.fleet.knowledge.holding import Hold, gone_since, holds_of
from amberbox.fleet.knowledge.listing import Known, find, newest
from amberbox.fleet.pages.diagnosis.card import (
    DiagnosisCard,
    card_of,
    nothing_broken,
    plain_card_of,
)
from amberbox.fleet.services import Services
from amberbox.fleet.services.status import Known as Now

Missing: TypeAlias = Literal["", "never", "folder", "fmea"]
"""What a diagnosis needs and is not there: a connection, the robot's folder, its failure modes."""


@dataclass(frozen=True, slots=True)
class Look:
    """A diagnosis of a robot with what people said of it; ``known`` is None where there is none.

    ``is_newest``: it is what the robot found last. ``is_past``: it is as it was at some revision,
    whatever was found later. ``holds`` tells which of its symptoms are there still.
    """

    robot: str
    known: Known | None = None
    is_newest: bool = True
    given: tuple[notebook.Given, ...] = ()
    made: tuple[notebook.Revision, ...] = ()
    causes: tuple[notebook.Cause, ...] = ()
    answers: dict[str, str] = field(default_factory=dict)
    holds: Mapping[str, Hold] = field(default_factory=dict)
    is_past: bool = False

    @property
    def stands(self) -> bool:
        """Tell whether something is known to be broken by it."""
        return self.known is not None and (self.known.last.state == "open" or not self.is_newest)


def look(fleet: Services, robot: str, diagnosis: str = "") -> Look:
    """Look at one diagnosis, at the newest without a name; raises 404 for one that is not there."""
    last = newest(fleet, robot)
    if not diagnosis or (last is not None and last.id == diagnosis):
        known, is_newest = last, not diagnosis or (last is not None and last.last.state == "open")
    else:
        known, is_newest = find(fleet, robot, diagnosis), False
        if known is None:
            raise HTTPException(404, "this robot has no such diagnosis")
    return _with_remarks(fleet, Look(robot, known, is_newest)) if known else Look(robot)


def look_then(
    fleet: Services, robot: str, diagnosis: str, revision: int, end_ns: int | None = None
) -> Look:
    """Look at a diagnosis as it was at a revision, of which later ones change nothing.

    Without a number (0) it is the last one up to an instant. Raises 404 as ``look`` does.
    """
    whole = find(fleet, robot, diagnosis)
    if whole is None:
        raise HTTPException(404, "this robot has no such diagnosis")
    if not revision and end_ns is not None:
        early = [one.revision for one in whole.revisions if one.at_ns <= end_ns]
        revision = max(early, default=whole.revisions[0].revision)
    known = whole.until(revision) if revision else whole
    later = next((one.at_ns for one in whole.revisions if one.revision > known.last.revision), None)
    return _with_remarks(fleet, Look(robot, known, is_newest=False, is_past=True), later)


def card_now(fleet: Services, seen: Look, now: Now | None = None) -> DiagnosisCard:
    """Return the card of what is looked at without waiting; ``now`` is how the robot is now."""
    if seen.known is None or not seen.stands:
        return _nothing(seen, now)
    answer = _at_hand(fleet, seen)
    known = seen.known
    card = _plain(seen, known) if answer is None else _card(answer, seen, known)
    return _timed(card, seen, known, now, fleet.clock.wall_ns())


async def card_told(fleet: Services, who: Caller, seen: Look, now: Now | None) -> DiagnosisCard:
    """Return the card with its explanation; raises AmberboxError where there can be none."""
    if seen.known is None or not seen.stands:
        return _nothing(seen, now)
    card = _card(await answer_told(fleet, who, seen), seen, seen.known)
    return _timed(card, seen, seen.known, now, fleet.clock.wall_ns())


async def answer_told(fleet: Services, who: Caller, seen: Look) -> Answer:
    """Return the explained answer of a diagnosis that is there."""
    assert seen.known is not None
    found = _at_hand(fleet, seen)
    if found is not None:
        return found
    return await fleet.explained.read(seen.robot, seen.known.last, seen.answers, who.asker)


def asked_of(fleet: Services, robot: str, at: str = "", **more: Any) -> AskDiagnosis:
    """Return a question about a robot as of an instant."""
    return AskDiagnosis(robot=robot, now_ns=fleet.clock.wall_ns(), at=at, **more)


def current_card(fleet: Services, robot: str, now: Now | None = None) -> DiagnosisCard:
    """Return the card of what a robot has now, without waiting: for other pages."""
    return card_now(fleet, look(fleet, robot), now)


def missing(fleet: Services, robot: str, ever_seen: bool) -> Missing:
    """Say what a diagnosis of a robot needs and is not there."""
    if not ever_seen:
        return "never"
    stated = fleet.folders.current(robot)
    wanted = stated if stated and not fleet.folders.wants(robot, stated) else ""
    kept = [wanted] if wanted else [one.config_hash for one in fleet.folders.kept(robot)[:1]]
    if not kept:
        return "folder"
    return "" if (fleet.folders.shelf.place(robot, kept[0]) / FILE).is_file() else "fmea"


def leading_faults(fleet: Services, seen: Look) -> list[str]:
    """Return the failure modes that the answer names, the most probable first."""
    if seen.known is None:
        return []
    answer = _at_hand(fleet, seen)
    found = answer["hypotheses"] if answer else revision_json(seen.known.peak)["hypotheses"]
    return [fault for entry in found for fault in entry["faults"]]


def _with_remarks(fleet: Services, seen: Look, before_ns: int | None = None) -> Look:
    """Add what people said, before a later revision where there is one, and what holds still."""
    assert seen.known is not None
    of = seen.robot, seen.known.id
    with fleet.database.reading() as connection:
        given = notebook.given(connection, *of)
        made = notebook.revisions(connection, *of)
        causes = notebook.causes(connection, *of)
    if before_ns is not None:
        given = [one for one in given if one.at_ns < before_ns]
        made = [one for one in made if one.at_ns < before_ns]
    return replace(
        seen, given=tuple(given), made=tuple(made), causes=tuple(causes),
        answers=notebook.counting(given), holds=holds_of(fleet, seen.robot, seen.known.revisions),
    )  # fmt: skip


def _at_hand(fleet: Services, seen: Look) -> Answer | None:
    assert seen.known is not None
    kept = kept_answer(seen.known, list(seen.made))
    return kept or fleet.explained.known(seen.robot, seen.known.last, seen.answers)


def _plain(seen: Look, known: Known) -> DiagnosisCard:
    plain = plain_card_of(revision_json(known.peak))
    return replace(plain, state=known.last.state, answers=seen.answers)


def _card(answer: Answer, seen: Look, known: Known) -> DiagnosisCard:
    """Return the card of an answer; its state is that of now, not of when it was given.

    What the robot says is broken is shown in its own words where the answer knows of nothing.
    """
    card = card_of(answer)
    if card.state == "none":
        return replace(_plain(seen, known), complete=True, notes=card.notes)
    return replace(card, state=known.last.state, answers=seen.answers)


def _nothing(seen: Look, now: Now | None) -> DiagnosisCard:
    if now is None:
        return nothing_broken(seen.robot, None)
    return replace(nothing_broken(seen.robot, now.status.as_of), status=now.status)


def _timed(
    card: DiagnosisCard, seen: Look, known: Known, now: Now | None, now_ns: int
) -> DiagnosisCard:
    """Return a card that says of each reason until when it was there, and if all are gone.

    Of the diagnosis that the robot made last, its one status says whether anything is seen still.
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
