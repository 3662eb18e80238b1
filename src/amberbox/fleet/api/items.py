"""What there is of a robot: its data items, and the columns of each."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
from fastapi import HTTPException

from amberbox.fleet.api.access import Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.windows import ItemName
from amberbox.fleet.data import WORKER

routes = Routes("data")


@dataclass(frozen=True, slots=True)
class Item:
    """A data item or child table; ``source`` is ``amberbox`` for what the box says of itself.

    ``first`` and ``last`` are when its first and its last row was received. ``no_columns`` says why
    its messages are there only as they came; empty for an item with columns.
    """

    name: str
    source: str
    topic: str
    type: str
    rows: int
    first: str | None
    last: str | None
    rate_hz: float | None
    no_columns: str = ""


@dataclass(frozen=True, slots=True)
class Variable:
    """A column: ``path`` is where it stands in the message, ``labels`` name its values."""

    name: str
    path: str
    type: str
    unit: str
    labels: dict[str, str]


@dataclass(frozen=True, slots=True)
class ItemDetail:
    """An item with its columns.

    ``stamp`` is the path of its own time stamp, ``chosen`` are the variables that the robot's
    ``black_box.yaml`` names, ``children`` the tables of lists in its messages.
    """

    name: str
    source: str
    topic: str
    type: str
    rows: int
    first: str | None
    last: str | None
    rate_hz: float | None
    stamp: str
    parent: str
    children: list[str]
    chosen: list[str]
    columns: list[Variable]
    no_columns: str = ""


@routes.get("/robots/{robot}/items", "items.read")
def list_items(fleet: Fleet, who: Who, robot: OfRobot) -> list[Item]:
    """List the data items of a robot that the server has messages of, the box's own at the end."""
    answer = fleet.asking.ask_now(f"{WORKER}:items", {"robot": robot.id}, asker=who.asker)
    return msgspec.json.decode(answer, type=list[Item])


@routes.get("/robots/{robot}/items/{item}", "items.read")
def read_item(fleet: Fleet, who: Who, robot: OfRobot, item: ItemName) -> ItemDetail:
    """Describe a data item: columns with types, units and labels, over all its versions."""
    answer = fleet.asking.ask_now(
        f"{WORKER}:item", {"robot": robot.id, "item": item}, asker=who.asker
    )
    found = msgspec.json.decode(answer, type=ItemDetail | None)
    if found is None:
        raise HTTPException(404, f"there is no data item {item!r} of {robot.id}")
    return found
