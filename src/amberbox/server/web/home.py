"""The first page with all robots, the help, and the licences."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import distribution
from typing import Annotated, Any, Literal, cast

from fastapi import HTTPException, Query, Request, Response
from starlette.responses import JSONResponse

from amberbox.core.api import Card
from amberbox.core.robot_status import worst
from amberbox.core.types import Level
from amberbox.server.http.auth import Fleet, OfRobot, Open, Who
from amberbox.server.services.commands import list_unsigned
from amberbox.server.services.context import Services
from amberbox.server.services.health import SystemFolder, read_health, read_system
from amberbox.server.services.robots import list_cards, read_card
from amberbox.server.web.assets import uplot
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import EXPERTS, groups, words

routes = PageRoutes()

Show = Literal["all", "trouble", "alarms", "offline"]
Sort = Literal["worst", "name", "battery", "seen"]
_MOST = 10_000
BEHIND_ROWS = 5000
"""Rows that a robot records in some seconds: a robot with a larger backlog was offline."""


@dataclass(frozen=True, slots=True)
class HomeQuery:
    """Query of the list of robots, as in the address."""

    q: str = ""
    show: Show = "all"
    sort: Sort = "worst"
    by: Literal["", "team"] = ""


@dataclass(frozen=True, slots=True)
class TeamOfCards:
    """Robots of one team."""

    name: str
    cards: Sequence[Card]


Text = Annotated[str, Query(max_length=128)]


@routes.get("/", "status.read", each=True)
def show(
    request: Request, fleet: Fleet, who: Who,
    q: Text = "", show: Show = "all", sort: Sort = "worst", by: Literal["", "team"] = "",
) -> Response:  # fmt: skip
    """Show the robots, and the state of the system."""
    look = HomeQuery(q, show, sort, by)
    unsigned = len(list_unsigned(fleet, who))
    return render(request, "home.html", **_listed(fleet, who, look), system=_system(fleet, who),
                  unsigned=unsigned)  # fmt: skip


@routes.get("/pieces/robots", "status.read", each=True)
def show_list(
    request: Request, fleet: Fleet, who: Who,
    q: Text = "", show: Show = "all", sort: Sort = "worst", by: Literal["", "team"] = "",
) -> Response:  # fmt: skip
    """Return the fragment with the list of robots."""
    return render(request, "home_list.html", **_listed(fleet, who, HomeQuery(q, show, sort, by)))


@routes.get("/pieces/robots/{robot}", "status.read")
def show_card(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Return the fragment with one robot."""
    return render(request, "home_card.html", card=read_card(fleet, robot), behind_rows=BEHIND_ROWS)


def _listed(fleet: Services, who: Who, look: HomeQuery) -> Mapping[str, Any]:
    cards = list_cards(fleet, who, "", "", _MOST)
    shown = sorted((card for card in cards if _fits(card, look)), key=_order(look.sort))
    return {
        "look": look, "all": cards, "teams": list(_teams(shown, look)), "counts": counts(cards),
        "behind_rows": BEHIND_ROWS,
    }  # fmt: skip


def counts(cards: Sequence[Card]) -> Mapping[str, int]:
    """Return the number of robots for each choice of ``show``."""
    shows: Sequence[Show] = ("all", "trouble", "alarms", "offline")
    return {name: sum(_fits(card, HomeQuery(show=name)) for card in cards) for name in shows}


def _fits(card: Card, look: HomeQuery) -> bool:
    words = f"{card.robot} {card.model} {' '.join(card.groups)} {card.cause}".casefold()
    return (
        all(word in words for word in look.q.casefold().split())
        and {
            "all": True,
            "trouble": card.status.is_trouble or card.alarms > 0,
            "alarms": card.alarms > 0,
            "offline": not card.online,
        }[look.show]
    )


def _order(sort: Sort) -> Callable[[Card], tuple[Any, ...]]:
    keys: Mapping[Sort, Callable[[Card], tuple[Any, ...]]] = {
        "worst": lambda c: (c.disabled, -c.status.rank, c.robot),
        "name": lambda c: (c.robot,),
        "battery": lambda c: (c.battery is None, c.battery.percent if c.battery else 0.0, c.robot),
        "seen": lambda c: (c.online, c.last_seen or "", c.robot),
    }
    return keys[sort]


def _teams(cards: Sequence[Card], look: HomeQuery) -> Iterator[TeamOfCards]:
    """Yield robots by team, those without a team last; a robot of two teams is in both."""
    if look.by != "team":
        yield TeamOfCards("", cards)
        return
    names = sorted({group for card in cards for group in card.groups})
    yield from (TeamOfCards(name, [c for c in cards if name in c.groups]) for name in names)
    if rest := [card for card in cards if not card.groups]:
        yield TeamOfCards("", rest)


@dataclass(frozen=True, slots=True)
class SystemSummary:
    """The state of the server and of the teams."""

    health: str
    folders: Sequence[SystemFolder]
    level: Level


def _system(fleet: Services, who: Who) -> SystemSummary:
    health = read_health(fleet).status
    folders = read_system(fleet) if who.may("status.read") else []
    levels = {
        cast("Level", one.level) for folder in folders for one in folder.statuses if not one.mode
    }
    return SystemSummary(health, folders, worst(levels))


_OPEN = Open("what words mean: the same for everybody")


@routes.get("/help", _OPEN)
def show_help(request: Request) -> Response:
    """Show the glossary by groups."""
    return render(request, "help.html", groups=list(groups()), experts=EXPERTS)


@routes.get("/help/{word}", _OPEN, response_model=None)
def read_word(word: str) -> Response:
    """Return the meaning of a word as JSON, for the question marks on pages."""
    found = words().get(word)
    if found is None:
        raise HTTPException(404, "there is no such word")
    return JSONResponse({"title": found.name[:1].upper() + found.name[1:], "text": found.text})


@routes.get("/licences", Open("whose work the pages use is for everybody to know"))
def show_licences(request: Request) -> Response:
    """Show the licences of the code that is sent to browsers."""
    return render(request, "licences.html", notice=_notice(), carrier=_carrier())


def _notice() -> str:
    """Return the copyright notice at the head of uPlot's file."""
    head = uplot("uplot.iife.min.js")[:2000].decode("utf-8", "replace")
    found = re.match(r"\s*/\*!(.*?)\*/", head, re.DOTALL)
    return found[1].strip() if found else ""


def _carrier() -> Mapping[str, str]:
    """Return name, version and licence of the package that contains uPlot."""
    package = distribution("youplot")
    files = [file for file in package.files or () if file.name.upper().startswith("LICENSE")]
    text = "\n\n".join(file.read_text() for file in files)
    return {"name": package.metadata["Name"], "version": package.version, "licence": text}
