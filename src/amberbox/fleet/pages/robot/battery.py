"""What a robot's battery says: what it measures, its checks, how it went in the last hour."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.fleet.api.access import Caller
from amberbox.fleet.data import WORKER
from amberbox.fleet.data.asked import Asked, arguments
from amberbox.fleet.drawing.spark import spark
from amberbox.fleet.drawing.svg import Element
from amberbox.fleet.pages.robot import values
from amberbox.fleet.pages.robot.expected import failing
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.services import Services
from amberbox.fleet.state.views import Component, Mode, Output

BACK_NS = 3600 * NS
POINTS = 60
CHARGE = "charge"
_UNITS: Mapping[str, str] = {
    "%": CHARGE, "V": "voltage", "mV": "voltage", "A": "current", "mA": "current",
    "°C": "temperature", "degC": "temperature", "K": "temperature",
}  # fmt: skip
_NAMES: Mapping[str, tuple[str, ...]] = {
    "temperature": ("temp",), "voltage": ("volt",), "current": ("current", "amp"),
    CHARGE: ("percent", "charge", "soc", "level"),
}  # fmt: skip
"""Parts of names that tell what is measured where no unit does, in the order of looking."""
_ORDER = (CHARGE, "voltage", "current", "temperature")
_CHARGING = re.compile(r"(^|[._])(is_)?(charging|docked|plugged(_in)?)$")
_NUMBERS = ("float", "double", "int", "uint")
_SMALL = (84.0, 22.0)

Found: TypeAlias = "dict[str, Any]"
Key: TypeAlias = "tuple[Mode, Output]"


@dataclass(frozen=True, slots=True)
class Said:
    """What the battery's component says: what is measured, and the rest, of which some check."""

    component: Component
    measured: Sequence[Key]
    rest: Sequence[Key]

    @property
    def checks(self) -> int:
        """Count the outputs of which something is expected."""
        return sum(bool(output.expected) for _, output in self.rest)

    @property
    def failing(self) -> bool:
        """Tell whether some check does not hold."""
        return any(failing(mode, output) for mode, output in self.rest)


@dataclass(frozen=True, slots=True)
class Trend:
    """How one quantity went: its first and last value with their unit, the line between them."""

    quantity: str
    first: str
    last: str
    drawing: Element


@dataclass(frozen=True, slots=True)
class Hour:
    """What was recorded in the last hour; ``charging`` is whether it charged at its end."""

    trends: Sequence[Trend]
    charging: bool | None = None


def said(component: Component | None, shown: str) -> Said | None:
    """Sort what a battery's component says; the output ``shown`` stands on the page already."""
    if component is None:
        return None
    measured: list[Key] = []
    rest: list[Key] = []
    for mode in component.modes:
        for output in mode.outputs:
            if output.name != shown:
                (measured if _is_measured(output) else rest).append((mode, output))
    return Said(component, measured, rest)


async def hour(fleet: Services, who: Caller, robot: str) -> Hour | None:
    """Return how the battery went; None where nothing of it is recorded."""
    ask = _Asking(fleet, who, robot)
    items = [one["name"] for one in await ask("items") if "battery" in one["name"].casefold()]
    for item in items:
        columns = (await ask("item", item=item))["columns"]
        chosen, charging = quantities(columns), charging_of(columns)
        names = [one["name"] for one in chosen.values()] + ([charging] if charging else [])
        found = await ask.values(item, names) if chosen else {}
        trends = [_trend(name, one, found.get(one["name"], ())) for name, one in chosen.items()]
        known = [one for one in trends if one is not None]
        if known:
            return Hour(known, _last_flag(found.get(charging, ())))
    return None


def quantities(columns: Sequence[Found]) -> dict[str, Found]:
    """Return which variable tells each quantity: of several that with the shortest name."""
    found: dict[str, Found] = {}
    for one in sorted(columns, key=lambda one: len(one["name"])):
        if one["type"].startswith(_NUMBERS) and (name := quantity_of(one["name"], one["unit"])):
            found.setdefault(name, one)
    return {name: found[name] for name in _ORDER if name in found}


def quantity_of(name: str, unit: str) -> str:
    """Return what a variable measures, by its unit, else by its name; empty where it is no matter.

    What has another unit is none of them, whatever it is called.
    """
    if unit:
        return _UNITS.get(unit, "")
    small = name.casefold()
    return next((q for q, parts in _NAMES.items() if any(part in small for part in parts)), "")


def charging_of(columns: Sequence[Found]) -> str:
    """Return the variable that tells whether it charges; empty where none does."""
    flags = (one["name"] for one in columns if one["type"].startswith("bool"))
    return next((name for name in flags if _CHARGING.search(name.casefold())), "")


def _is_measured(output: Output) -> bool:
    """Tell whether an output says how the battery is, rather than whether that is good."""
    if output.type not in ("int", "float"):
        return not output.expected
    is_left = values.value_type(output) == values.DURATION or output.unit in ("s", "min", "h")
    return is_left or bool(quantity_of(output.name, values.unit(output)))


def _trend(quantity: str, variable: Found, numbers: Sequence[float | None]) -> Trend | None:
    known = [value for value in numbers if value is not None]
    if not known:
        return None
    unit = _unit(variable)
    label = catalogue().text(f"robot.battery.trends.{quantity}")
    first, last = (f"{values.number(value)} {unit}".strip() for value in (known[0], known[-1]))
    return Trend(quantity, first, last, spark(numbers, label=label, size=_SMALL))


def _unit(variable: Found) -> str:
    """Return the unit of a variable: as declared, else as its name says."""
    name: str = variable["name"]
    return variable["unit"] or values.guessed_unit(name) or ("%" if "percent" in name else "")


def _last_flag(numbers: Sequence[float | None]) -> bool | None:
    known = [value for value in numbers if value is not None]
    return bool(known[-1]) if known else None


@dataclass(frozen=True, slots=True)
class _Asking:
    fleet: Services
    who: Caller
    robot: str

    async def __call__(self, op: str, **more: str) -> Any:
        about = {"robot": self.robot, **more}
        answer = await self.fleet.asking.ask(f"{WORKER}:{op}", about, asker=self.who.asker)
        return msgspec.json.decode(answer)

    async def values(
        self, item: str, variables: Sequence[str]
    ) -> Mapping[str, Sequence[float | None]]:
        """Return some numbers of the last hour, in order of time, by variable."""
        now_ns = self.fleet.clock.wall_ns()
        names = list(variables)
        question = Asked(self.robot, item, names, now_ns - BACK_NS, now_ns, points=POINTS)
        about = arguments(question)
        answer = await self.fleet.asking.ask(f"{WORKER}:query", about, asker=self.who.asker)
        body = msgspec.json.decode(answer[4 + int.from_bytes(answer[:4], "little") :])
        return dict(_series(body, names))


def _series(body: Found, variables: Sequence[str]) -> Iterator[tuple[str, list[float | None]]]:
    columns = [one["name"] for one in body["columns"]]
    for variable in variables:
        place = next((n for n, name in enumerate(columns)
                      if variable in (name, name.rpartition(":")[0])), None)  # fmt: skip
        if place is not None:
            yield variable, [_number(row[place]) for row in body["data"]]


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None
