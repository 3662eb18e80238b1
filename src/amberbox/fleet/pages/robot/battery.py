"""How full a robot's battery was in the last hour, out of what it recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.fleet.api.access import Caller
from amberbox.fleet.data import WORKER
from amberbox.fleet.data.asked import Asked, arguments
from amberbox.fleet.drawing.spark import spark
from amberbox.fleet.drawing.svg import Element
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.services import Services

BACK_NS = 3600 * NS
POINTS = 60
_CHARGES = ("percent", "charge", "soc", "level", "volt")
"""Parts of the names of variables that tell how full it is, the best first."""
_LONG = (180.0, 36.0)

Found: TypeAlias = "dict[str, Any]"


@dataclass(frozen=True, slots=True)
class Trend:
    """The line of one variable, where it began and what it came to."""

    name: str
    unit: str
    first: float
    last: float
    drawing: Element


async def trend(fleet: Services, who: Caller, robot: str) -> Trend | None:
    """Return how the battery went; None where nothing of it is recorded."""
    ask = _Asking(fleet, who, robot)
    items = [one["name"] for one in await ask("items") if "battery" in one["name"].casefold()]
    for item in items:
        variable = _charge((await ask("item", item=item))["columns"])
        values = await ask.values(item, variable["name"]) if variable else []
        known = [value for value in values if value is not None]
        if variable and known:
            line = spark(values, label=catalogue().text("robot.battery.trend"), size=_LONG)
            return Trend(variable["name"], variable["unit"], known[0], known[-1], line)
    return None


@dataclass(frozen=True, slots=True)
class _Asking:
    fleet: Services
    who: Caller
    robot: str

    async def __call__(self, op: str, **more: str) -> Any:
        about = {"robot": self.robot, **more}
        answer = await self.fleet.asking.ask(f"{WORKER}:{op}", about, asker=self.who.asker)
        return msgspec.json.decode(answer)

    async def values(self, item: str, variable: str) -> Sequence[float | None]:
        """Return some numbers of the last hour, in order of time."""
        now_ns = self.fleet.clock.wall_ns()
        question = Asked(self.robot, item, [variable], now_ns - BACK_NS, now_ns, points=POINTS)
        about = arguments(question)
        answer = await self.fleet.asking.ask(f"{WORKER}:query", about, asker=self.who.asker)
        body = msgspec.json.decode(answer[4 + int.from_bytes(answer[:4], "little") :])
        place = next((n for n, one in enumerate(body["columns"])
                      if one["name"].partition(":")[0] == variable), None)  # fmt: skip
        rows = body["data"] if place is not None else ()
        return [_number(row[place]) for row in rows]


def _charge(variables: Sequence[Found]) -> Found | None:
    numbers = [one for one in variables if one["type"].startswith(("float", "double", "int", "u"))]
    for word in _CHARGES:
        for one in numbers:
            if word in one["name"].casefold():
                return one
    return None


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None
