"""Which diagnosis of a robot is looked at, and the card that tells it.

``card_now`` never waits for a worker: pages are there at once, with the explanation if it is
known already, else in the robot's own words. ``card_told`` waits.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from fastapi import HTTPException

from amberbox.diagnosis.fmea.load import FILE
from amberbox.fleet.api.access import Caller
from amberbox.fleet.api.diagnoses import revision_json
from amberbox.fleet.knowledge import notebook
from amberbox.fleet.knowledge.asked import AskDiagnosis
from amberbox.fleet.knowledge.explained import Answer, kept_answer
from amberbox.fleet.knowledge.listing import Known, find, newest
from amberbox.fleet.pages.diagnosis.card import (
    DiagnosisCard,
    card_of,
    nothing_broken,
    plain_card_of,
)
from amberbox.fleet.services import Services

Missing: TypeAlias = Literal["", "never", "folder", "fmea"]
"""What a diagnosis needs and is not there: a connection, the robot's folder, its failure modes."""


@dataclass(frozen=True, slots=True)
class Look:
    """A diagnosis of a robot with what people said of it; ``known`` is None where there is none.

    ``is_newest``: it is what the robot found last.
    """

    robot: str
    known: Known | None = None
    is_newest: bool = True
    given: tuple[notebook.Given, ...] = ()
    made: tuple[notebook.Revision, ...] = ()
    causes: tuple[notebook.Cause, ...] = ()
    answers: dict[str, str] = field(default_factory=dict)

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


def card_now(fleet: Services, seen: Look, as_of: str | None) -> DiagnosisCard:
    """Return the card of what is looked at without waiting; ``as_of`` is how far is known."""
    if seen.known is None or not seen.stands:
        return nothing_broken(seen.robot, as_of)
    answer = _at_hand(fleet, seen)
    return _plain(seen, seen.known) if answer is None else _card(answer, seen, seen.known)


async def card_told(fleet: Services, who: Caller, seen: Look, as_of: str | None) -> DiagnosisCard:
    """Return the card with its explanation; raises AmberboxError where there can be none."""
    if seen.known is None or not seen.stands:
        return nothing_broken(seen.robot, as_of)
    return _card(await answer_told(fleet, who, seen), seen, seen.known)


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


def current_card(fleet: Services, robot: str, as_of: str | None) -> DiagnosisCard:
    """Return the card of what a robot has now, without waiting: for other pages."""
    return card_now(fleet, look(fleet, robot), as_of)


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


def _with_remarks(fleet: Services, seen: Look) -> Look:
    assert seen.known is not None
    of = seen.robot, seen.known.id
    with fleet.database.reading() as connection:
        given = notebook.given(connection, *of)
        made = notebook.revisions(connection, *of)
        causes = notebook.causes(connection, *of)
    return replace(
        seen, given=tuple(given), made=tuple(made), causes=tuple(causes),
        answers=notebook.counting(given),
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
