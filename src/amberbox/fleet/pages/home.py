"""The first page: all robots at a glance, the worst first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from fastapi import Query, Request, Response

from amberbox.core.robotstatus import worst
from amberbox.core.types import Level
from amberbox.fleet.api.access import Fleet, OfRobot, Who
from amberbox.fleet.api.health import read_health
from amberbox.fleet.api.robots import list_cards, read_card
from amberbox.fleet.api.system import SystemFolder
from amberbox.fleet.api.system import read_status as read_system
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services
from amberbox.fleet.state.views import Card

routes = Pages()

Show = Literal["all", "trouble", "alarms", "offline"]
Sort = Literal["worst", "name", "battery", "seen"]
_MOST = 10_000
BEHIND_ROWS = 5000
"""More than that a robot records in some seconds: one that has so many to send was away."""


@dataclass(frozen=True, slots=True)
class Look:
    """What somebody wants to see of the robots; it stands in the address."""

    q: str = ""
    show: Show = "all"
    sort: Sort = "worst"
    by: Literal["", "team"] = ""


@dataclass(frozen=True, slots=True)
class Team:
    """Robots under one heading."""

    name: str
    cards: Sequence[Card]


Text = Annotated[str, Query(max_length=128)]


@routes.get("/", "status.read", each=True)
def show(
    request: Request, fleet: Fleet, who: Who,
    q: Text = "", show: Show = "all", sort: Sort = "worst", by: Literal["", "team"] = "",
) -> Response:  # fmt: skip
    """Show the robots, and how the system is."""
    look = Look(q, show, sort, by)
    return render(request, "home.html", **_listed(fleet, who, look), system=_system(fleet, who))


@routes.get("/pieces/robots", "status.read", each=True)
def show_list(
    request: Request, fleet: Fleet, who: Who,
    q: Text = "", show: Show = "all", sort: Sort = "worst", by: Literal["", "team"] = "",
) -> Response:  # fmt: skip
    """Show the list of robots alone."""
    return render(request, "home_list.html", **_listed(fleet, who, Look(q, show, sort, by)))


@routes.get("/pieces/robots/{robot}", "status.read")
def show_card(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Show one robot alone."""
    return render(request, "home_card.html", card=read_card(fleet, robot), behind_rows=BEHIND_ROWS)


def _listed(fleet: Services, who: Who, look: Look) -> Mapping[str, Any]:
    cards = list_cards(fleet, who, "", "", _MOST)
    shown = sorted((card for card in cards if _fits(card, look)), key=_order(look.sort))
    return {
        "look": look, "all": cards, "teams": list(_teams(shown, look)), "counts": counts(cards),
        "behind_rows": BEHIND_ROWS,
    }  # fmt: skip


def counts(cards: Sequence[Card]) -> Mapping[str, int]:
    """Count the robots that each choice of ``show`` stands for."""
    shows: Sequence[Show] = ("all", "trouble", "alarms", "offline")
    return {name: sum(_fits(card, Look(show=name)) for card in cards) for name in shows}


def _fits(card: Card, look: Look) -> bool:
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


def _teams(cards: Sequence[Card], look: Look) -> Iterator[Team]:
    """Yield robots by team, those of none last; a robot of two teams stands in both."""
    if look.by != "team":
        yield Team("", cards)
        return
    names = sorted({group for card in cards for group in card.groups})
    yield from (Team(name, [c for c in cards if name in c.groups]) for name in names)
    if rest := [card for card in cards if not card.groups]:
        yield Team("", rest)


@dataclass(frozen=True, slots=True)
class System:
    """How the server and the teams are."""

    health: str
    folders: Sequence[SystemFolder]
    level: Level


def _system(fleet: Services, who: Who) -> System:
    health = read_health(fleet, Response()).status
    folders = read_system(fleet) if who.may("status.read") else []
    levels = {one.level for folder in folders for one in folder.statuses if not one.mode}
    return System(health, folders, worst(levels))
