"""The page of one robot: how all of its parts are, what happened, what can be done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import Query, Request, Response

from amberbox.core.errors import AmberboxError
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Fleet, OfRobot, Who
from amberbox.fleet.api.forms import time_of
from amberbox.fleet.api.robots import (
    Event,
    known_now,
    list_events,
    read_card,
    read_link,
    read_status,
    read_timeline,
    status_now,
    status_without_folder,
)
from amberbox.fleet.data import remarks
from amberbox.fleet.pages.datalinks import moment_href
from amberbox.fleet.pages.diagnosis.card import DiagnosisCard
from amberbox.fleet.pages.diagnosis.look import current_card
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.pages.robot import expected, values
from amberbox.fleet.pages.robot import graph as robotgraph
from amberbox.fleet.pages.robot import tree as robottree
from amberbox.fleet.pages.robot.battery import Said, hour, said
from amberbox.fleet.pages.robot.groups import groups
from amberbox.fleet.pages.robot.times import Lanes, Times, Window, times
from amberbox.fleet.pages.robot.tree import Show
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.services import Services
from amberbox.fleet.state.said import moment
from amberbox.fleet.state.views import Card, StatusTree

routes = Pages()

EVENTS = 30
_KINDS_OF = 300
"""Newest events among which the kinds are looked for that one can choose."""
_POINTS = 300
_NOTED = 5
"""What was noticed of a link, the newest."""
_ACTIONS = ("items.read", "diagnoses.read", "diagnoses.write", "incidents.write", "missions.write",
            "robots.write")  # fmt: skip
NOTHING: list[str] = []
NO_FILLS: Mapping[str, str] = {}

Text = Annotated[str, Query(max_length=128)]
Chosen = Annotated[list[Annotated[str, Query(max_length=256)]], Query(alias="open", max_length=500)]


@dataclass(frozen=True, slots=True)
class Look:
    """What somebody wants to see of a robot; it stands in the address."""

    q: str = ""
    show: Show = "all"
    chosen: Sequence[str] = ()
    window: Window = "1h"
    lanes: Lanes = ""
    kind: str = ""


@routes.get("/robots/{robot}", "status.read")
def show(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, q: Text = "", show: Show = "all",
    chosen: Chosen = NOTHING, window: Window = "1h", lanes: Lanes = "", kind: Text = "",
) -> Response:  # fmt: skip
    """Show a robot."""
    look = Look(q, show, chosen, window, lanes, kind)
    known, card = status_now(fleet, robot), read_card(fleet, robot)
    tree = known or status_without_folder(fleet, robot)
    may = {name: who.may(name, robot) for name in _ACTIONS}
    return _show(
        request, "robot/robot.html", card=card, look=look, may=may, **_tree(tree, look),
        **_graph(tree), **_panels(tree, card), **_now(fleet, who, robot),
        fill=_fills(request, robot) if known is None else {},
        has_files=_has_files(fleet, who, robot, card), robot=robot,
        seen=_times(fleet, robot, look, tree), **_events(fleet, robot, kind, may["items.read"]),
        diagnosis=_diagnosis(fleet, robot) if may["diagnoses.read"] else None,
        strings=("diagnosis",),
    )  # fmt: skip


@routes.get("/pieces/robots/{robot}/head", "status.read")
def show_head(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Show how a robot is and whether it is there: the head of all its pages."""
    return _show(request, "robot/head.html", card=read_card(fleet, robot))


@routes.get("/pieces/robots/{robot}/tree", "status.read")
def show_tree(
    request: Request, fleet: Fleet, robot: OfRobot, q: Text = "", show: Show = "all",
    chosen: Chosen = NOTHING,
) -> Response:  # fmt: skip
    """Show the tree alone."""
    tree, card = read_status(fleet, robot), read_card(fleet, robot)
    return _show(request, "robot/tree.html", card=card, **_tree(tree, Look(q, show, chosen)))


@routes.get("/pieces/robots/{robot}/graph", "status.read")
def show_graph(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Show what needs what alone."""
    tree = read_status(fleet, robot)
    return _show(request, "robot/graph.html", tree=tree, **_graph(tree))


@routes.get("/pieces/robots/{robot}/timeline", "status.read")
def show_timeline(
    request: Request, fleet: Fleet, robot: OfRobot, window: Window = "1h", lanes: Lanes = ""
) -> Response:
    """Show what was when alone."""
    look = Look(window=window, lanes=lanes)
    tree = status_now(fleet, robot) or status_without_folder(fleet, robot)
    seen = _times(fleet, robot, look, tree)
    return _show(request, "robot/timeline.html", robot=robot, look=look, seen=seen)


@routes.get("/pieces/robots/{robot}/events", "items.read")
def show_events(request: Request, fleet: Fleet, robot: OfRobot, kind: Text = "") -> Response:
    """Show the newest events alone."""
    found = _events(fleet, robot, kind, may=True)
    return _show(request, "robot/events.html", robot=robot, **found)


@routes.get("/pieces/robots/{robot}/now", "status.read")
def show_now(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Show what it is doing and how it is linked, alone."""
    return _show(request, "robot/now.html", card=read_card(fleet, robot), **_now(fleet, who, robot))


@routes.get("/pieces/robots/{robot}/panels", "status.read")
def show_panels(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Show battery and components that are alike, alone."""
    tree, card = read_status(fleet, robot), read_card(fleet, robot)
    return _show(request, "robot/panels.html", card=card, **_panels(tree, card))


@routes.get("/pieces/robots/{robot}/files", "folder.read")
def show_files(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Show the files of the folder that the robot has now, alone."""
    config_hash = fleet.folders.current(robot.id)
    files = fleet.folders.files(robot.id, config_hash) or ()
    found = {"robot": robot.id, "config_hash": config_hash, "files": files}
    return _show(request, "robot/files.html", **found)


@routes.get("/pieces/robots/{robot}/battery", "items.read")
async def show_battery(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Show how the battery went in the last hour."""
    try:
        found = await hour(fleet, who, robot.id)
    except AmberboxError:  # too much is asked at the moment: the value itself is on the page
        found = None
    return _show(request, "robot/trend.html", hour=found)


def _show(request: Request, template: str, **shown: Any) -> Response:
    return render(
        request, template, rt=robottree, vals=values, expect=expected,
        **{"fill": NO_FILLS, **shown},
    )  # fmt: skip


def _tree(tree: StatusTree, look: Look) -> Mapping[str, Any]:
    return {
        "tree": tree,
        "branches": robottree.branches(tree, look.q, look.show, look.chosen),
        "names": robottree.names(tree.components),
    }  # fmt: skip


def _graph(tree: StatusTree) -> Mapping[str, Any]:
    label = catalogue().text("robot.graph.label", robot=tree.robot)
    return {
        "drawn": robotgraph.graph(tree.components, label),
        "lines": robotgraph.as_list(tree.components),
    }


def _times(fleet: Services, robot: KnownRobot, look: Look, tree: StatusTree) -> Times:
    found = read_timeline(fleet, robot, f"now-{look.window}", "now", points=_POINTS)
    return times(robot.id, found, look.lanes, robottree.names(tree.components))


def _events(fleet: Services, robot: KnownRobot, kind: str, may: bool) -> Mapping[str, Any]:
    if not may:
        return {"events": None, "kinds": [], "kind": ""}
    newest = list_events(fleet, robot, limit=_KINDS_OF)
    found = newest if not kind else list_events(fleet, robot, kind=kind, limit=EVENTS)
    kinds = sorted({one.kind for one in newest} | ({kind} if kind else set()))
    shown = [(one, _href(fleet, robot.id, one)) for one in reversed(found[-EVENTS:])]
    return {"events": shown, "kinds": kinds, "kind": kind}


def _href(fleet: Services, robot: str, event: Event) -> str:
    """Return where the data around an event are shown."""
    at_ns = time_of(event.at or "", fleet.clock)
    return "" if at_ns is None else moment_href(robot, (), at_ns)


def _diagnosis(fleet: Services, robot: KnownRobot) -> DiagnosisCard:
    return current_card(fleet, robot.id, known_now(fleet, robot))


def _now(fleet: Services, who: Who, robot: KnownRobot) -> Mapping[str, Any]:
    with fleet.database.reading() as connection:
        ours = [one for one in remarks.missions(connection, robot.id) if one.to_ns is None]
    return {
        "link": read_link(fleet, robot, limit=_NOTED),
        "missions": [(one, moment(one.from_ns)) for one in reversed(ours)],
        "may_begin": who.may("missions.write", robot),
    }  # fmt: skip


def _panels(tree: StatusTree, card: Card) -> Mapping[str, Any]:
    shown = card.battery.output if card.battery else ""
    return {"groups": groups(tree.components), "battery": _battery(tree, shown)}


def _battery(tree: StatusTree, shown: str) -> Said | None:
    found = (one for one in tree.components if "battery" in one.component.casefold())
    return said(next(found, None), shown)


def _fills(request: Request, robot: KnownRobot) -> Mapping[str, str]:
    """Return where the parts come from that wait for the robot's folder."""
    base = f"/pieces/robots/{quote(robot.id, safe='')}"
    tree = f"{base}/tree?{request.url.query}"
    return {"tree": tree, "panels": f"{base}/panels", "graph": f"{base}/graph"}


def _has_files(fleet: Services, who: Who, robot: KnownRobot, card: Card) -> bool:
    """Tell whether the robot's folder is here, and may be read."""
    is_here = card.config_hash and not fleet.folders.wants(robot.id, card.config_hash)
    return bool(is_here) and who.may("folder.read", robot)
