"""Inputs of a mode: what of the record, or of the robot's computer, a text means."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from amberbox.core.config import did_you_mean
from amberbox.core.errors import AmberboxError
from amberbox.core.names import has_item_form, item_name
from amberbox.core.probe import SOURCE, ProbeOrder
from amberbox.core.types import ItemSchema
from amberbox.monitoring.configuration.functions import Functions
from amberbox.monitoring.configuration.recorded import Item, Recorded, chosen_place
from amberbox.monitoring.configuration.variables import (
    Place,
    find_places,
    guessed,
    names_of,
    tables_of,
)
from amberbox.monitoring.plan import InputPlan

OWN_ITEMS = ("amberbox_",)
"""Items that the box writes by itself, and no block names."""
_SHORT_MOST = 6


class InputError(Exception):
    """A text means nothing, or too much."""


@dataclass
class Inputs:
    """Finds out what texts mean in one robot folder."""

    recorded: Recorded
    functions: Functions
    unknown_items: set[str] = field(default_factory=set)
    """Items whose variables nothing tells before they have been recorded."""

    def of(
        self, text: str, module: ModuleType, config: Any, kinds: Sequence[str] | None = None
    ) -> list[InputPlan]:
        """Return the inputs that a text means for a mode; several where it has ``*``.

        ``kinds`` are what it may be; what the mode accepts without. Raises InputError.
        """
        accepts = tuple(kinds or module.ACCEPTS)
        found = self._items(text) + self._variables(text)
        fitting = [plan for plan in (_accepted(plan, accepts) for plan in found) if plan]
        if not fitting and "probe" in accepts:
            return [self._probe(text, module, config)]
        if not fitting and not found:
            fitting = [p for p in (_accepted(p, accepts) for p in self._short(text)) if p]
        if not fitting:
            raise InputError(self._nothing(text, found, accepts))
        return _single(text, fitting)

    def _items(self, text: str) -> list[InputPlan]:
        """Find items by their name, or by their topic as configured."""
        plain = text.strip("/")
        found = [i for i in self.recorded.items if i.name == text or i.topic.strip("/") == plain]
        if found or not has_item_form(text):
            return [InputPlan(text, "item", item.name) for item in found]
        item = self._above(text)
        if item is not None:
            self._table(item, text)
        is_there = item is not None or self._is_open(text)
        return [InputPlan(text, "item", text)] if is_there else []

    def _above(self, name: str) -> Item | None:
        """Return the configured item that ``ITEM__PATH`` is a child table of, if it is one's."""
        items = [item for item in self.recorded.items if name.startswith(f"{item.name}__")]
        is_table = has_item_form(name) and name not in self.recorded.by_name
        return max(items, key=lambda item: len(item.name), default=None) if is_table else None

    def _table(self, item: Item, name: str) -> ItemSchema | None:
        """Return the variables of a child table; None where nothing tells them before.

        Raises InputError where the item's variables are known, and this is none of its tables.
        """
        schema = self.recorded.schema(item)
        if schema is None:
            self.unknown_items.add(item.name)
            return None
        tables = tables_of(item.name, schema)
        if name not in tables:
            near = did_you_mean(name, tables) or _some(list(tables), "no tables")
            raise InputError(f"{item.name} has no table '{name}'{near}")
        return tables[name]

    def _is_open(self, text: str) -> bool:
        """Tell whether a name may be an item that no block names."""
        names = (*(f"{name}_" for name in (*self.recorded.open, SOURCE)), *OWN_ITEMS)
        stored = self.recorded.stored(text.partition(".")[0].partition("/")[0])
        return text.startswith(names) or stored is not None

    def _variables(self, text: str) -> list[InputPlan]:
        """Find variables by ``ITEM.VARIABLE``, ``ITEM/PATH`` or ``TOPIC/PATH``."""
        found: list[InputPlan] = []
        for item in self.recorded.items:
            for path in _paths_in(text, item):
                found += self._in_item(text, item, path)
        name, path = _split(text)
        if found or not path or name in self.recorded.by_name:
            return found
        above = self._above(name)
        schema = None if above is None else self._table(above, name)
        if schema is not None:
            return _of_places(text, _checked(text, name, path, schema))
        is_there = above is not None or self._is_open(text)
        return self._in_open_item(text, name, path) if is_there else []

    def _in_item(self, text: str, item: Item, path: str) -> list[InputPlan]:
        schema = self.recorded.schema(item)
        if schema is not None:
            return _of_places(text, _checked(text, item.name, path, schema))
        if chosen_place(item, path) is False:
            near = did_you_mean(path, item.chosen)
            what = f"'{path}' is not among the variable_names of {item.name}{near}"
            raise InputError(f"{what} (black_box.yaml: add it there)")
        return self._guess(text, item.name, path)

    def _in_open_item(self, text: str, name: str, path: str) -> list[InputPlan]:
        schema = self.recorded.stored(name)
        if schema is not None:
            return _of_places(text, _checked(text, name, path, schema))
        return self._guess(text, name, path)

    def _guess(self, text: str, item: str, path: str) -> list[InputPlan]:
        if "*" in path:
            what = f"nobody can know yet how many '{path}' there are in {item}"
            raise InputError(f"{what}: write them one by one")
        self.unknown_items.add(item)
        return _of_places(text, [guessed(item, path)])

    def _short(self, text: str) -> list[InputPlan]:
        """Find a variable by its end alone, among those that are known."""
        found: list[InputPlan] = []
        for item in self.recorded.items:
            schema = self.recorded.schema(item)
            if schema is not None and "*" not in text:
                found += _of_places(text, find_places(schema, item.name, text))
        return found

    def _probe(self, text: str, module: ModuleType, config: Any) -> InputPlan:
        probe_of = getattr(module, "probe_of", None)
        try:
            kind, subject = probe_of(config, text) if probe_of else (module.PROBE, text)
        except AmberboxError as error:
            raise InputError(error.what) from error
        if kind not in self.functions.probes:
            near = did_you_mean(kind, self.functions.probes)
            raise InputError(f"there is no probe '{kind}'{near}")
        order = ProbeOrder(kind, subject)
        return InputPlan(text, "probe", order.item, probe=order)

    def _nothing(self, text: str, found: Sequence[InputPlan], accepts: Sequence[str]) -> str:
        """Say why a text is no input."""
        if found:
            wanted = " or ".join(_WORDS[kind] for kind in accepts)
            return f"'{text}' is {_WORDS[found[0].kind]}, this monitor takes {wanted}"
        items = [item.name for item in self.recorded.items]
        topics = [item.topic for item in self.recorded.items]
        near = did_you_mean(text, [*items, *topics]) or did_you_mean(_split(text)[0], items)
        if not near and text.startswith("/") and self.recorded.open:
            near = f"; write {item_name(self.recorded.open[0], text)}, as its block names no topics"
        return f"nothing that is recorded is called '{text}'{near}"


_WORDS = {
    "item": "an item",
    "variable": "a variable",
    "list": "a list of numbers",
    "probe": "the subject of a probe",
}


def _accepted(plan: InputPlan, accepts: Sequence[str]) -> InputPlan | None:
    """Return an input as a mode may take it; None if it does not."""
    return plan if plan.kind in accepts else None


def _single(text: str, found: Sequence[InputPlan]) -> list[InputPlan]:
    """Return what was found if it is one thing, or many by ``*``; raise InputError if not."""
    addresses = list(dict.fromkeys(_address(plan) for plan in found))
    if len(addresses) > 1 and "*" not in text:
        shown = " or ".join(addresses[:_SHORT_MOST])
        raise InputError(f"'{text}' is ambiguous: {shown}")
    unique = {_address(plan): plan for plan in found}
    return list(unique.values())


def _address(plan: InputPlan) -> str:
    return plan.item if plan.kind == "item" else Place(plan.item, plan.variable, plan.index).address


def _of_places(text: str, places: Sequence[Place]) -> list[InputPlan]:
    return [InputPlan(text, p.kind, p.item, p.variable, p.number) for p in places]


def _checked(text: str, item: str, path: str, schema: ItemSchema) -> list[Place]:
    places = find_places(schema, item, path)
    if places:
        return places
    if "*" in path and any(child in path for child in schema.children):
        raise InputError(f"how many rows '{path}' has changes: write 0, 1, ... for '*'")
    names = names_of(schema)
    raise InputError(f"{item} has no variable '{path}'{did_you_mean(path, names) or _some(names)}")


def _some(names: Sequence[str], nothing: str = "none") -> str:
    return f"; it has {', '.join(names[:8]) or nothing}{' ...' if len(names) > 8 else ''}"


def _split(text: str) -> tuple[str, str]:
    """Split at the first ``.`` or ``/`` after the beginning."""
    places = [place for place in (text.find(".", 1), text.find("/", 1)) if place > 0]
    return (text[: min(places)], text[min(places) + 1 :]) if places else (text, "")


def _paths_in(text: str, item: Item) -> Iterator[str]:
    """Yield the path of a variable where a text begins with an item's name or topic."""
    for name in dict.fromkeys((item.name, item.topic, item.topic.strip("/"))):
        if text.startswith((f"{name}.", f"{name}/")) and len(text) > len(name) + 1:
            yield text[len(name) + 1 :]
            return
