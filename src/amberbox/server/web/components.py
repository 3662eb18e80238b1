"""Components of a robot on its page: values, expectations, the tree, the graph, groups."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from math import floor, isfinite, log10, nan
from typing import Any, Literal
from urllib.parse import quote

from amberbox.core.api import Component, Mode, Output, StatusTree
from amberbox.core.svg import SvgElement
from amberbox.diagnosis.report.wording import capitalize, readable
from amberbox.server.drawing.graph import ComponentBox as Box
from amberbox.server.drawing.graph import DependencyEdge, dependency_graph
from amberbox.server.web.text import catalogue, drawing_words, span

_UNITS: Mapping[str, str] = {
    "hz": "Hz", "s": "s", "ms": "ms", "us": "µs", "ns": "ns", "min": "min", "h": "h",
    "percent": "%", "volts": "V", "voltage": "V", "v": "V", "mv": "mV", "amps": "A", "a": "A",
    "ma": "mA", "watts": "W", "w": "W", "celsius": "°C", "degc": "°C", "m": "m", "mm": "mm",
    "cm": "cm", "rad": "rad", "deg": "°", "rpm": "rpm", "kb": "kB", "mb": "MB", "gb": "GB",
    "bytes": "B", "dbm": "dBm", "newton": "N", "nm": "Nm", "kg": "kg",
}  # fmt: skip
_UNIT_NAMES = ("voltage", "newton")
"""What says more of an output than the unit behind its value does."""
_LONG_S = 120.0
"""From this duration on, two units are shown."""
_SPANS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))
_DIGITS = 4
_FOREVER_S = 1e9
DURATION = "duration"


def shown(output: Output) -> str:
    """Return a value as text: numbers with four digits, durations with units, yes or no."""
    value = output.value
    if isinstance(value, int | float) and value_type(output) == DURATION:
        return duration(value)
    if value is None:
        return catalogue().text("robot.js.value.none")
    if isinstance(value, bool):
        return catalogue().text(f"robot.js.value.{'yes' if value else 'no'}")
    return number(value) if isinstance(value, float) else str(value)


def number(value: float) -> str:
    """Return a number with four digits, zeros kept; with an exponent if very large or small."""
    size = abs(value)
    if not isfinite(value) or size >= 1e6 or 0 < size < 1e-3:
        return f"{value:.2e}"
    whole = floor(log10(size)) if size >= 1 else 0
    return f"{value:.{max(0, _DIGITS - 1 - whole)}f}"


def duration(seconds: float) -> str:
    """Return a duration as text: ``0.100 s``, ``13 h 51 min``, in two units from 2 min on."""
    if not _LONG_S <= abs(seconds) < _FOREVER_S:
        return f"{number(seconds)} s"
    whole = int(abs(seconds))
    place = next(n for n, (_, size) in enumerate(_SPANS) if whole >= size)
    most, size = _SPANS[place]
    smaller = [(name, whole % size // step) for name, step in _SPANS[place + 1 :][:1]]
    parts = [(most, whole // size), *smaller]
    text = " ".join(catalogue().text(f"common.js.span.{name}", n=n) for name, n in parts if n)
    return f"-{text}" if seconds < 0 else text


def unit(output: Output) -> str:
    """Return the unit of a value: declared, else guessed; empty for durations, which include it."""
    return "" if value_type(output) == DURATION else _unit(output)


def value_type(output: Output) -> str:
    """Return the type for display: numbers in seconds are durations."""
    return DURATION if _unit(output) == "s" else output.type


def label(output: Output) -> str:
    """Return the name of an output in words, without the unit that follows its value."""
    rest, _, last = output.name.rpartition("_")
    unit = _unit(output)
    is_named = unit and unit == guessed_unit(output.name) and last.casefold() not in _UNIT_NAMES
    return readable(rest if rest and is_named else output.name)


def guessed_unit(name: str) -> str:
    """Return the unit at the end of a name; empty for none, or for a rate."""
    rest, _, last = name.casefold().rpartition("_")
    if rest.split("_")[-1] == "per":
        return ""
    return _UNITS.get(last, "") if "_" in name or len(last) > 3 else ""


def _unit(output: Output) -> str:
    if output.type not in ("int", "float"):
        return ""
    return output.unit or guessed_unit(output.name)


_COMPARE: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq, "!=": operator.ne, ">=": operator.ge, "<=": operator.le,
    ">": operator.gt, "<": operator.lt,
}  # fmt: skip
_WORDS = {"!=": "not", ">=": "at_least", "<=": "at_most", ">": "more_than", "<": "less_than"}
_NUMBERS = ("int", "float")
_BOOLS = {"true": "yes", "false": "no"}


@dataclass(frozen=True, slots=True)
class _Expected:
    """A relation and its operand, as monitors write them; ``high`` is the end of a range."""

    relation: str
    low: str
    high: str = ""


def is_met(output: Output) -> bool:
    """Return whether a value is as expected, as expected.js does; True without an expectation."""
    value = output.value
    if not output.expected or value is None:
        return True
    expected = _parsed(output)
    if expected.high:
        return _number(expected.low) <= float(value) <= _number(expected.high)
    compare = _COMPARE[expected.relation]
    if isinstance(value, bool):
        return compare(str(value).lower(), expected.low)
    if isinstance(value, int | float):
        return compare(value, _number(expected.low))
    return compare(value, expected.low)


def failing(mode: Mode, output: Output) -> bool:
    """Return whether an output is a reason why its mode is not ok."""
    condition = mode.condition
    return condition.level != "ok" and (condition.state == output.name or not is_met(output))


def is_healing(mode: Mode, output: Output) -> bool:
    """Return whether an output is as expected again, but still counts as failed for a while."""
    return bool(output.expected) and failing(mode, output) and is_met(output)


def text(output: Output) -> str:
    """Return the expectation of an output in the form of its value; empty without one."""
    if not output.expected:
        return ""
    expected = _parsed(output)
    low = _shown(output, expected.low)
    if expected.high:
        return _relation_text("range", low=low, high=_shown(output, expected.high))
    word = _WORDS.get(expected.relation)
    return _relation_text(word, value=low) if word else low


def _relation_text(word: str, **values: str) -> str:
    return catalogue().text(f"robot.tree.relation.{word}", **values)


def _parsed(output: Output) -> _Expected:
    text = output.expected
    low, to, high = text.partition(" to ")
    if to and output.type in _NUMBERS and not isinstance(output.value, str):
        return _Expected("within", low, high)
    first, _, rest = text.partition(" ")
    return _Expected(first, rest) if rest and first in _WORDS else _Expected("==", text)


def _shown(output: Output, text: str) -> str:
    if output.type == "bool" and text in _BOOLS:
        return catalogue().text(f"robot.js.value.{_BOOLS[text]}")
    value = _number(text)
    if output.type not in _NUMBERS or value != value:
        return text
    if value_type(output) == DURATION:
        return duration(value)
    return f"{value:g} {unit(output)}".strip()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return nan  # unequal to every value


Show = Literal["all", "trouble"]

OPENED = 3
"""Components in trouble that are open as long as the user has chosen none."""
NONE = "-"
"""Value in the address when the user has closed all."""
_KEPT = "!'()*"
"""Characters that encodeURIComponent of browsers does not encode."""


@dataclass(frozen=True, slots=True)
class ComponentBranch:
    """A component in the tree; ``root``: it is not well, and nothing that it needs blocks it.

    ``holding`` are modes, and outputs of modes, that are folded because others fail.
    """

    component: Component
    name: str
    id: str
    level: str
    is_open: bool
    is_hidden: bool
    root: bool
    holding: Set[tuple[str, str]]

    @property
    def held(self) -> int:
        """Return the number of folded outputs."""
        return sum(bool(output) for _, output in self.holding)


def branches(tree: StatusTree, q: str, show: Show, chosen: Sequence[str]) -> list[ComponentBranch]:
    """Return the branches of the tree in order; ``chosen`` are those that the user has opened."""
    opened = set(chosen) or set(_in_trouble(tree.components))
    return [
        ComponentBranch(
            one, called(one.component, one.name), branch_id(one.component), level_of(one),
            one.component in opened, not _fits(one, q, show), is_root(one), set(_holding(one)),
        )
        for one in tree.components
    ]  # fmt: skip


def called(component: str, name: str = "") -> str:
    """Return the name of a component: that of its file, else its id with spaces."""
    return capitalize(name if name != component and name else readable(component))


def names(components: Sequence[Component]) -> Mapping[str, str]:
    """Return the name of each component, by its id."""
    return {one.component: called(one.component, one.name) for one in components}


def needs_id(component: str, name: str) -> bool:
    """Return whether the id of a component differs from its name."""
    return component.casefold() != name.casefold()


def branch_id(component: str) -> str:
    """Return the id of a component's HTML element, with special characters encoded."""
    return f"c-{quote(component, safe='')}"


def key(component: str, mode: str = "", output: str = "") -> str:
    """Return the key of an element that shows a value, as live.js makes it."""
    return "/".join(quote(name, safe=_KEPT) for name in (component, mode, output))


def level_of(component: Component) -> str:
    """Return the level of a component; unknown without a status."""
    return component.condition.level if component.condition else "unknown"


def is_root(component: Component) -> bool:
    """Return whether a component is not well, and nothing that it needs blocks it."""
    condition = component.condition
    return (
        condition is not None
        and condition.level in ("error", "warn", "stale")
        and not condition.blocked_by
    )


def span_text(seconds: float) -> str:
    """Return a duration as text in one unit, at least 1 s."""
    return span(max(1, seconds))


def _in_trouble(components: Sequence[Component]) -> Iterator[str]:
    worst = sorted(filter(is_root, components), key=lambda one: level_of(one) != "error")
    yield from (one.component for one in worst[:OPENED])


def _holding(component: Component) -> Iterator[tuple[str, str]]:
    """Yield the modes and outputs beside the failing ones; nothing if none fails."""
    bad = {mode.mode: [one.name for one in mode.outputs if failing(mode, one)]
           for mode in component.modes}  # fmt: skip
    if not any(bad.values()):
        return
    for mode in component.modes:
        holds = mode.condition.level == "ok"
        if holds:
            yield mode.mode, ""
        if holds or bad[mode.mode]:
            yield from ((mode.mode, one.name) for one in mode.outputs
                        if one.name not in bad[mode.mode])  # fmt: skip


def _fits(component: Component, q: str, show: Show) -> bool:
    words = " ".join(_words(component)).casefold()
    return all(word in words for word in q.casefold().split()) and (
        show == "all" or level_of(component) != "ok"
    )


def _words(component: Component) -> Iterator[str]:
    yield from (component.component, called(component.component, component.name))
    for mode in component.modes:
        yield from (mode.mode, mode.name, *(output.name for output in mode.outputs))


@dataclass(frozen=True, slots=True)
class ComponentRow:
    """A component in the list, with its dependencies and dependents."""

    component: Component
    name: str
    id: str
    level: str
    root: bool
    needs: Sequence[str]
    needed_by: Sequence[str]


def edges(components: Sequence[Component]) -> list[DependencyEdge]:
    """Return the edges of need and of part between known components."""
    known = {one.component for one in components}
    found: list[DependencyEdge] = []
    for one in components:
        needs = dict.fromkeys(need.component for need in one.needs)
        found += [
            DependencyEdge(one.component, name) for name in needs if name in known - {one.component}
        ]
        if one.part_of in known and one.part_of != one.component and one.part_of not in needs:
            found.append(DependencyEdge(one.component, one.part_of, "part of"))
    return found


def graph(components: Sequence[Component], label: str) -> SvgElement | None:
    """Return the drawing, in which boxes link to the tree; None if there are no edges."""
    lines = edges(components)
    if not lines:
        return None
    return dependency_graph(
        [_box(one) for one in components], lines, label=label, words=drawing_words()
    )


def as_list(components: Sequence[Component]) -> list[ComponentRow]:
    """Return the graph as a list, components that are not well first."""
    needs = [edge for edge in edges(components) if edge.kind == "needs"]
    name = names(components)
    found = [
        ComponentRow(
            one, name[one.component], branch_id(one.component), level_of(one), is_root(one),
            [name[edge.end] for edge in needs if edge.start == one.component],
            [name[edge.start] for edge in needs if edge.end == one.component],
        )
        for one in components
    ]  # fmt: skip
    return sorted(found, key=lambda line: (not line.root, line.level == "ok"))


def _box(one: Component) -> Box:
    condition = one.condition
    state = readable(condition.state) if condition and condition.level != "ok" else ""
    return Box(
        one.component, called(one.component, one.name), level_of(one), state,
        condition.reason if condition else "", f"#{branch_id(one.component)}", is_root(one),
    )  # fmt: skip


COLUMNS = 3
"""Outputs that are compared; the tree has all of them."""
_FEW = 2
_FIRST = re.compile(r"[^\W\d_]+")

Key = tuple[str, str]
"""Mode and output."""


@dataclass(frozen=True, slots=True)
class GroupMember:
    """A component of a group; ``rest`` is its name without that of the group."""

    component: Component
    rest: str
    outputs: Mapping[Key, Output]


@dataclass(frozen=True, slots=True)
class ComponentGroup:
    """Components with the same first word that have outputs in common."""

    name: str
    columns: Sequence[Key]
    members: Sequence[GroupMember]


def groups(components: Sequence[Component]) -> list[ComponentGroup]:
    """Return groups of at least two components with the same first word and shared outputs."""
    by_word: dict[str, list[Component]] = {}
    for component in components:
        if found := _FIRST.match(component.component):
            by_word.setdefault(found[0], []).append(component)
    return [
        ComponentGroup(word, columns, [_member(word, one) for one in found])
        for word, found in by_word.items()
        if len(found) >= _FEW and (columns := _common(found))
    ]


def _common(components: Sequence[Component]) -> list[Key]:
    """Return up to three outputs that all components have, numbers first."""
    every = [set(_outputs(one)) for one in components]
    known = _outputs(components[0])
    shared = [key for key in known if all(key in keys for keys in every)]
    shared.sort(key=lambda key: known[key].type not in ("float", "int"))
    return shared[:COLUMNS]


def _member(word: str, component: Component) -> GroupMember:
    rest = component.component.removeprefix(word).strip("_-. ").replace("_", " ")
    return GroupMember(component, rest or component.component, _outputs(component))


def _outputs(component: Component) -> dict[Key, Output]:
    return dict(_each(component))


def _each(component: Component) -> Iterator[tuple[Key, Output]]:
    for mode in component.modes:
        yield from (((mode.mode, output.name), output) for output in mode.outputs)
