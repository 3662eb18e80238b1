"""Recordings: what there is of all robots; missions, incidents and journals of one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from fastapi import Query, Request, Response

from amberbox.core.timetext import format_time
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Who
from amberbox.fleet.api.fetches import list_fetches
from amberbox.fleet.api.missions import Mission
from amberbox.fleet.api.robots import list_cards, read_card
from amberbox.fleet.data.journals import Recording
from amberbox.fleet.drawing.coverage import KINDS, Stretch, coverage, swatch
from amberbox.fleet.pages import figures
from amberbox.fleet.pages.drawingwords import drawing_words
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.pages.recordings.cover import WINDOWS, Window, parts
from amberbox.fleet.pages.recordings.look import (
    Cover,
    Record,
    Retaining,
    cover,
    fitting,
    journals,
    record,
    with_journals,
    with_journals_of,
)
from amberbox.fleet.pages.recordings.state import Held, held
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.services import Services
from amberbox.fleet.state.views import Card

routes = Pages()

Show = Literal["all", "trouble", "coming", "deleted"]
SHOWS: Sequence[Show] = ("all", "trouble", "coming", "deleted")
_MOST = 10_000
_PAGE = 50
_LISTED = 100
"""Stretches in the list beside a bar."""
_COMING = ("copying", "waiting", "aside")

After = Annotated[str, Query(max_length=400)]
Names = Annotated[list[Annotated[str, Query(max_length=64)]], Query(max_length=200)]
Chosen = Annotated[Window | None, Query(description="empty: what holds all, at most 7 days")]
NOTHING: list[str] = []


@dataclass(frozen=True, slots=True)
class Line:
    """A robot in the overview."""

    card: Card
    held: Held


@dataclass(frozen=True, slots=True)
class Look:
    """What somebody wants to see of a robot's recordings; it stands in the address."""

    window: Window = "7d"
    show: Show = "all"
    after: str = ""
    mission: str = ""


@routes.get("/recordings", "items.read", each=True)
def show(request: Request, fleet: Fleet, who: Who, window: Chosen = None) -> Response:
    """Show what there is of all robots: cheap figures at once, the rest as it is asked for."""
    lines = _lines(fleet, who)
    window = window or fitting(fleet, [line.card.robot for line in lines])
    return render(
        request, "recordings/recordings.html", lines=lines, window=window, windows=tuple(WINDOWS),
        swatches=_swatches(), total=_total(lines), may_download=who.may_some("data.download"),
        **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings", "items.read", each=True)
def show_states(request: Request, fleet: Fleet, who: Who, robot: Names = NOTHING) -> Response:
    """Show of robots (all, if none is named) how far their copying is; asked for every 10 s."""
    return render(request, "recordings/states.html", lines=_lines(fleet, who, robot), **_words())


@routes.get("/pieces/recordings/{robot}", "items.read")
def show_card(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, window: Window = "7d",
    link: bool = True,
) -> Response:  # fmt: skip
    """Show what there is of one robot: its bar, whether it holds; with ``link`` also how many
    missions and incidents there are, and where more is.
    """
    found = with_journals(fleet, robot, record(fleet, who, robot, missions=link), window)
    seen = cover(fleet, who, robot, found, window)
    return render(
        request, "recordings/card.html", found=found, link=link,
        **_drawn(seen, robot.id, window), **_words(),
    )  # fmt: skip


@routes.get("/recordings/{robot}", "items.read")
def show_robot(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, window: Chosen = None,
    show: Show = "all", after: After = "", mission: After = "",
) -> Response:  # fmt: skip
    """Show the recordings of a robot: what costs little at once, the rest when workers answer."""
    look = Look(window or fitting(fleet, [robot.id]), show, after, mission)
    return render(
        request, "recordings/robot.html", card=read_card(fleet, robot),
        robot=robot.id, held=_held(fleet, [robot.id])[robot.id], look=look, windows=tuple(WINDOWS),
        swatches=_swatches(), **_may(who, robot), **_fetches(fleet, robot),
        **_journals(fleet, robot, journals(fleet, robot), look), **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings/{robot}/missions", "items.read")
def show_missions(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, mission: After = ""
) -> Response:
    """Show the missions of a robot alone."""
    found = record(fleet, who, robot, incidents=False)
    page = _page_of(found.missions, mission)
    found = with_journals_of(fleet, robot, found, page)
    return render(
        request, "recordings/missions.html", found=found, look=Look(mission=mission),
        **_missions(found, page), **_may(who, robot), **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings/{robot}/incidents", "items.read")
def show_incidents(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Show the incidents of a robot alone."""
    found = record(fleet, who, robot, missions=False)
    return render(request, "recordings/incidents.html", found=found, **_may(who, robot), **_words())


@routes.get("/pieces/recordings/{robot}/fetches", "data.query")
def show_fetches(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Show alone what was asked of a robot."""
    return render(
        request, "recordings/fetches.html", robot=robot.id, **_fetches(fleet, robot),
        **_may(who, robot), **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings/{robot}/journals", "items.read")
def show_journals(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, show: Show = "all", after: After = ""
) -> Response:
    """Show the journals of a robot alone."""
    look = Look(show=show, after=after)
    return render(
        request, "recordings/journals.html", robot=robot.id, look=look,
        **_journals(fleet, robot, journals(fleet, robot), look), **_may(who, robot), **_words(),
    )  # fmt: skip


def _lines(fleet: Services, who: Caller, only: Sequence[str] = ()) -> list[Line]:
    with fleet.database.reading() as connection:
        seen = who.robots(connection, "items.read")
    mine = {robot.id for robot in seen if not only or robot.id in only}
    cards = [card for card in list_cards(fleet, who, "", "", _MOST) if card.robot in mine]
    known = _held(fleet, [card.robot for card in cards])
    cards.sort(key=lambda card: card.damaged_files == 0)
    return [Line(card, known[card.robot]) for card in cards]


def _held(fleet: Services, robots: Sequence[str]) -> Mapping[str, Held]:
    with fleet.database.reading() as connection:
        return held(connection, fleet.folder, robots)


def _total(lines: Sequence[Line]) -> Held:
    found = [line.held for line in lines]
    return Held(sum(one.files for one in found), sum(one.bytes for one in found))


def _drawn(seen: Cover, robot: str, window: Window) -> Mapping[str, Any]:
    label = catalogue().text("recordings.cover.label", robot=robot)
    told = [_told(one) for one in seen.stretches]
    bar = coverage(told, seen.axis, label=label, name=f"cover-{robot}", words=drawing_words())
    recorded = any(one.kind == "recorded" for one in seen.stretches)
    return {"cover": seen, "bar": bar, "recorded": recorded, "window": window,
            "parts": parts(seen.stretches, _LISTED)}  # fmt: skip


def _told(one: Stretch) -> Stretch:
    """Return a stretch whose text also says when it was, for a pointer that rests on it."""
    when = catalogue().text("recordings.cover.when", start=_utc(one.start), to=_utc(one.to))
    return Stretch(one.start, one.to, one.kind, f"{one.text} {when}".strip())


def _utc(time_ns: int) -> str:
    return format_time(time_ns)[:16].replace("T", " ")


def _swatches() -> Sequence[tuple[str, Any]]:
    return [(kind, swatch(kind, name=f"key-{kind}", words=drawing_words())) for kind in KINDS]


def _page_of(missions: Sequence[Mission], after: str) -> Sequence[Mission]:
    ids = [one.id for one in missions]
    start = ids.index(after) + 1 if after in ids else 0
    return missions[start : start + _PAGE]


def _missions(found: Record, page: Sequence[Mission]) -> Mapping[str, Any]:
    last = page[-1].id if page else ""
    more = last if page and found.missions[-1].id != last else ""
    return {
        "missions": [(one, found.share(one)) for one in page], "missions_more": more,
        "missions_all": len(found.missions),
    }  # fmt: skip


def _fetches(fleet: Services, robot: KnownRobot) -> Mapping[str, Any]:
    return {"fetches": list_fetches(fleet, robot, limit=_PAGE)}


def _journals(
    fleet: Services, robot: KnownRobot, found: Sequence[Recording], look: Look
) -> Mapping[str, Any]:
    chosen = [one for one in found if _fits(one, look.show)]
    chosen.sort(key=lambda one: not _fits(one, "trouble"))
    names = [_name(one) for one in chosen]
    start = names.index(look.after) + 1 if look.after in names else 0
    page = chosen[start : start + _PAGE]
    retaining = Retaining(fleet, robot.id)
    return {
        "journals": [(_name(one), one, retaining.until(one)) for one in page],
        "journals_first": start, "journals_all": len(chosen), "files_all": len(found),
        "journals_more": names[start + _PAGE - 1] if len(names) > start + _PAGE else "",
        "counts": {name: sum(_fits(one, name) for one in found) for name in SHOWS},
        "shows": SHOWS, "days_kept": retaining.days,
    }  # fmt: skip


def _name(one: Recording) -> str:
    return f"{one.store_id}/{one.journal}"


def _fits(one: Recording, show: Show) -> bool:
    return {
        "all": True,
        "trouble": one.integrity in ("altered", "missing")
        or one.state in ("refused", "quarantined"),
        "coming": one.state in _COMING,
        "deleted": one.integrity == "deleted",
    }[show]


def _may(who: Caller, robot: KnownRobot) -> Mapping[str, bool]:
    return {
        "may_mark": who.may("incidents.write", robot),
        "may_begin": who.may("missions.write", robot),
        "may_download": who.may("data.download", robot),
        "may_fetch": who.may("data.fetch", robot),
    }


def _words() -> Mapping[str, Any]:
    return {"size": figures.size, "count": figures.count, "percent": figures.percent,
            "rfc3339": format_time}  # fmt: skip
