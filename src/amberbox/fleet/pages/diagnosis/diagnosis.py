"""The page that answers what is broken on a robot, and what to do next.

The page comes at once; what a worker has to think about follows in parts, each by its address:
the card with its explanation, and what stands behind "Details", a tab at a time.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from dataclasses import replace
from functools import partial
from typing import Annotated

from fastapi import Query, Request, Response

from amberbox.core.errors import AmberboxError
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Fleet, OfRobot, Who
from amberbox.fleet.api.robots import known_now, read_card
from amberbox.fleet.knowledge.asked import SymptomWord
from amberbox.fleet.pages.diagnosis import asking, parts
from amberbox.fleet.pages.diagnosis import tree as trees
from amberbox.fleet.pages.diagnosis.card import DiagnosisCard, card_of
from amberbox.fleet.pages.diagnosis.look import (
    Look,
    card_now,
    card_told,
    look,
    look_then,
    missing,
)
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services

routes = Pages()

TABS = ("others", "effects", "tree", "rules", "whatif", "history", "cause")
ASKING = ("rules", "whatif")
"""Tabs in which one asks the robot's knowledge something: for operators, as over the API."""

Id = Annotated[str, Query(pattern=r"^[A-Za-z0-9_.:#-]{0,128}$")]
At = Annotated[str, Query(max_length=64)]
Word = Annotated[str, Query(max_length=300)]
Words = Annotated[list[Annotated[str, Query(max_length=300)]], Query(max_length=100)]
NOTHING: list[str] = []
Revision = Annotated[int, Query(ge=0, le=2**62)]
Goal = Annotated[str, Query(max_length=4000)]


@routes.get("/robots/{robot}/diagnosis", "diagnoses.read")
def show(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    tab: Word = "",
) -> Response:  # fmt: skip
    """Show what is known to be broken; nothing here waits for a worker."""
    now, seen = known_now(fleet, robot), look(fleet, robot.id, diagnosis)
    card, shown = read_card(fleet, robot), card_now(fleet, seen, now)
    may = who.may("diagnoses.write", robot)
    tabs = [name for name in TABS if may or name not in ASKING]
    lacks = missing(fleet, robot.id, card.last_seen is not None) if not seen.stands else ""
    return render(
        request, "diagnosis/diagnosis.html", card=card, seen=seen, shown=shown, at=at, lacks=lacks,
        tabs=tabs, tab=tab if tab in tabs else tabs[0], may=may,
        before=_before(fleet, seen),
    )  # fmt: skip


@routes.get("/robots/{robot}/diagnosis/card", "diagnoses.read")
async def show_card(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    link: bool = False, revision: Revision = 0,
) -> Response:  # fmt: skip
    """Return the card alone, with its explanation: what pages put in its place.

    ``link``: it leads to the page of the diagnosis, because it stands on another one.
    ``revision``: as the diagnosis was then, whatever was found later.
    """
    may = who.may("diagnoses.write", robot)
    then = partial(look_then, revision=revision) if diagnosis and revision else look
    seen = await asyncio.to_thread(then, fleet, robot.id, diagnosis)
    now = await asyncio.to_thread(known_now, fleet, robot)
    try:
        if at:
            answer = await parts.Asked(fleet, who, robot.id, at=at).at_then()
            card, may = replace(card_of(answer), answers={}), False
        else:
            card = await card_told(fleet, who, seen, now)
    except AmberboxError as error:
        plain = None if at else await asyncio.to_thread(card_now, fleet, seen, now)
        return render(request, "diagnosis/trouble.html", error=error, plain=plain, may=may)
    return render(request, "diagnosis/part.html", shown=card, seen=seen, may=may, link=link)


@routes.get("/robots/{robot}/diagnosis/others", "diagnoses.read")
async def show_others(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = ""
) -> Response:
    """Return all candidates, with what speaks for and against them."""
    asked = parts.Asked(fleet, who, robot.id, diagnosis, at)
    return await _part(request, "others", asked, robot, parts.others(asked))


@routes.get("/robots/{robot}/diagnosis/effects", "diagnoses.read")
async def show_effects(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = ""
) -> Response:
    """Return the graph from causes to what is seen."""
    asked = parts.Asked(fleet, who, robot.id, diagnosis, at)
    return await _part(request, "effects", asked, robot, parts.effects(asked))


@routes.get("/robots/{robot}/diagnosis/tree", "diagnoses.read")
async def show_tree(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, at: At = "", effect: Word = ""
) -> Response:
    """Return the fault tree of one function of the robot."""
    asked = parts.Asked(fleet, who, robot.id, at=at)
    return await _part(request, "tree", asked, robot, trees.tree(asked, effect))


@routes.get("/robots/{robot}/diagnosis/history", "diagnoses.read")
async def show_history(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = ""
) -> Response:
    """Return what was found before, and how the answer came about."""
    asked = parts.Asked(fleet, who, robot.id, diagnosis)
    return await _part(request, "history", asked, robot, parts.history(asked))


@routes.get("/robots/{robot}/diagnosis/cause", "diagnoses.read")
async def show_cause(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = ""
) -> Response:
    """Return what it was by what people say, and where to say it."""
    asked = parts.Asked(fleet, who, robot.id, diagnosis)
    return await _part(request, "cause", asked, robot, parts.cause(asked))


@routes.get("/robots/{robot}/diagnosis/rules", "diagnoses.write")
async def show_rules(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, at: At = "", q: Goal = "",
    want: Word = "",
) -> Response:  # fmt: skip
    """Return what the robot's rules say to a goal, and why."""
    asked = parts.Asked(fleet, who, robot.id, at=at)
    return await _part(request, "rules", asked, robot, asking.rules(asked, q.strip(), want))


@routes.get("/robots/{robot}/diagnosis/whatif", "diagnoses.write")
async def show_what_if(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    present: Words = NOTHING, absent: Words = NOTHING, unknown: Words = NOTHING, engine: Word = "",
) -> Response:  # fmt: skip
    """Return what can be supposed to be seen."""
    asked = parts.Asked(fleet, who, robot.id, diagnosis, at)
    given = _given(present, absent, unknown)
    return await _part(request, "whatif", asked, robot, asking.what_if(asked, given, engine))


@routes.get("/robots/{robot}/diagnosis/whatif/answer", "diagnoses.write")
async def show_supposed(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    present: Words = NOTHING, absent: Words = NOTHING, unknown: Words = NOTHING, engine: Word = "",
) -> Response:  # fmt: skip
    """Return the answer if other things were seen."""
    asked = parts.Asked(fleet, who, robot.id, diagnosis, at)
    given = _given(present, absent, unknown)
    return await _part(request, "supposed", asked, robot, asking.supposed(asked, given, engine))


def _given(present: list[str], absent: list[str], unknown: list[str]) -> dict[str, SymptomWord]:
    return {
        **dict.fromkeys(unknown, "unknown"), **dict.fromkeys(absent, "absent"),
        **dict.fromkeys(present, "present"),
    }  # fmt: skip


async def _part(
    request: Request, tab: str, asked: parts.Asked, robot: KnownRobot,
    made: Awaitable[parts.Values],
) -> Response:  # fmt: skip
    """Return a tab, or what keeps it from being shown and what to do then."""
    may = asked.who.may("diagnoses.write", robot)
    try:
        values = await made
    except AmberboxError as error:
        return render(request, "diagnosis/trouble.html", error=error, plain=None, may=may)
    return render(request, f"diagnosis/{tab}.html", asked=asked, may=may, **values)


def _before(fleet: Services, seen: Look) -> DiagnosisCard | None:
    """Return the card of what was found last, where nothing is known to be broken any more."""
    if seen.known is None or seen.stands:
        return None
    return card_now(fleet, replace(seen, is_newest=False))
