"""Random disturbances: the variables of a stream, and a draw among them."""

from __future__ import annotations

import math
import numbers
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from amberbox.core.errors import UsageError
from amberbox.sim.disturbances import (
    CONVERSIONS,
    KINDS,
    Disturbance,
    KindName,
    Message,
    is_list,
)
from amberbox.sim.topics import TOPICS, leaves

VariableKind = Literal["number", "integer", "numbers", "code", "flag", "text"]


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable that can be disturbed, with the values it has had: ``low`` to ``high``.

    ``kind`` is ``code`` for whole numbers whose values have names: they are never calculated with.
    For flags and texts ``low`` and ``high`` differ if the value has changed.
    """

    item: str
    path: str
    kind: VariableKind
    unit: str = ""
    low: float = 0.0
    high: float = 0.0

    @property
    def span(self) -> float:
        """Return a typical size of its changes, for constants of its value, else 1."""
        return self.high - self.low or abs(self.high) or 1.0

    @property
    def is_number(self) -> bool:
        """Return whether one can calculate with it."""
        return self.kind in ("number", "integer", "numbers")


def survey(
    messages: Iterable[Message], units: Mapping[str, str] | None = None, codes: Iterable[str] = ()
) -> list[Variable]:
    """Return the variables of a stream, by item and path, without those of headers.

    ``units`` gives the unit of ``ITEM.PATH``, ``codes`` lists whole numbers that are codes.
    """
    seen: dict[tuple[str, str], _Seen] = {}
    for item, _, fields in messages:
        for path, value in _values(fields, ""):
            if path.split(".")[0] != "header":
                seen.setdefault((item, path), _Seen()).add(value)
    named = set(codes)
    found = []
    for (item, path), values in sorted(seen.items()):
        kind = values.kind
        if kind is None:
            continue
        address = f"{item}.{path}"
        kind = "code" if address in named and kind == "integer" else kind
        unit = (units or {}).get(address, "")
        low, high = (values.low, values.high) if values.low <= values.high else (0.0, 0.0)
        found.append(Variable(item, path, kind, unit, low, high))
    return found


def simulated_variables(messages: Iterable[Message]) -> list[Variable]:
    """Return the variables of messages of the simulated robot, with units and codes."""
    facts = {f"{spec.name}.{at}": (kind, unit) for spec in TOPICS for at, kind, unit in
             leaves(spec.shape())}  # fmt: skip
    units = {address: unit for address, (_, unit) in facts.items() if unit}
    return survey(messages, units, [a for a, (kind, _) in facts.items() if " (" in kind])


class _Seen:
    """The values that a variable has had."""

    def __init__(self) -> None:
        self.kind: VariableKind | None = None
        self.low, self.high = math.inf, -math.inf
        self._first: Any = None

    def add(self, value: Any) -> None:
        if value is None:
            return
        kind = _kind(value)
        if self.kind is None:
            self.kind, self._first = kind, value
        if kind in ("flag", "text"):
            value = float(value != self._first)
        for number in value if is_list(value) else (value,):
            if math.isfinite(number):
                self.low, self.high = min(self.low, float(number)), max(self.high, float(number))


def _kind(value: Any) -> VariableKind:
    if isinstance(value, bool | np.bool_):
        return "flag"
    if isinstance(value, numbers.Integral):
        return "integer"
    if isinstance(value, numbers.Real):
        return "number"
    return "numbers" if is_list(value) else "text"


def _values(fields: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    for key, value in fields.items():
        if isinstance(value, dict):
            yield from _values(value, f"{path}{key}.")
        elif not is_list(value) or all(_kind(each) in ("number", "integer") for each in value):
            yield f"{path}{key}", value


def draw(
    seed: int | str,
    variables: Sequence[Variable],
    at_s: float = 0.0,
    until_s: float | None = None,
) -> Disturbance:
    """Draw a disturbance: evenly over the kinds, then over the variables that the kind can disturb.

    Kinds of whole messages are drawn evenly over the items; ``delay`` is half the time one of an
    item, half of a variable. Amounts are drawn in proportion to the values the variable has had.
    Raises UsageError if there are no variables.
    """
    chance = random.Random(f"disturbance {seed}")
    order = chance.sample(list(KINDS), len(KINDS))
    found = next(((kind, places) for kind in order if (places := _places(kind, variables))), None)
    if found is None:
        raise UsageError("there is no variable that could be disturbed", "survey a longer stream")
    kind, places = found
    whole = KINDS[kind].reach == "item"
    changing = [each for each in variables if each.low < each.high]
    if kind == "delay" and changing:
        whole = chance.random() < 0.5
        places = places if whole else changing
    place = chance.choice(places)
    return Disturbance(
        kind,
        place.item,
        "" if whole else place.path,
        amount=_amount(kind, place, chance),
        other=chance.choice(_partners(place, variables)).path if kind == "swap" else "",
        conversion=chance.choice(_conversions(place)) if kind == "unit" else "",
        at_s=at_s,
        until_s=until_s,
    )


def _places(kind: KindName, variables: Sequence[Variable]) -> list[Variable]:
    """Return what a kind can disturb so that something changes; of items the first variable."""
    if KINDS[kind].reach != "variable":
        return list({each.item: each for each in reversed(variables)}.values())[::-1]
    if kind == "swap":
        return [each for each in variables if _partners(each, variables)]
    if kind == "freeze":
        return [each for each in variables if each.low < each.high]
    counted = [each for each in variables if each.is_number and (each.low or each.high)]
    if kind == "unit":
        return [each for each in counted if _conversions(each)]
    if kind == "mirror":
        return [each for each in counted if each.low < each.high]
    return counted


def _partners(place: Variable, variables: Sequence[Variable]) -> list[Variable]:
    values = place.low, place.high
    return [
        each
        for each in variables
        if (each.item, each.kind) == (place.item, place.kind)
        and each.path != place.path
        and (each.low < each.high or (each.low, each.high) != values)
    ]


def _conversions(place: Variable) -> list[str]:
    return [name for name, to in CONVERSIONS.items() if to.unit == place.unit]


def _amount(kind: KindName, place: Variable, chance: random.Random) -> float | None:
    def evenly(low: float, high: float) -> float:
        return low * math.pow(high / low, chance.random())

    way = chance.choice((-1, 1))
    if kind == "scale":
        return evenly(1.2, 5.0) ** way
    if kind in ("offset", "quantise"):
        size = place.span * (evenly(0.3, 3.0) if kind == "offset" else evenly(0.1, 1.0))
        size = max(1.0, round(size)) if place.kind == "integer" else size
        return way * size if kind == "offset" else size
    if kind == "drift":
        return way * place.span * evenly(0.01, 0.2)
    if kind == "mirror":
        return None if place.kind == "numbers" else (place.low + place.high) / 2
    if kind in ("delay", "jitter"):
        return evenly(0.1, 5.0 if kind == "delay" else 2.0)
    if kind == "drop":
        return chance.uniform(0.2, 1.0)
    return float(chance.randint(1, 5)) if kind == "repeat" else None
