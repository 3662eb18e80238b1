"""The tree of a robot's components as its page shows it: what is open, what is looked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import Literal
from urllib.parse import quote

from amberbox.fleet.pages import wording
from amberbox.fleet.pages.figures import span
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.state.views import Component, Mode, Output, StatusTree

Show = Literal["all", "trouble"]

OPENED = 3
"""So many components in trouble are open where nobody has chosen what is."""
NONE = "-"
"""Stands in the address where somebody has closed all."""
_UNITS: Mapping[str, str] = {
    "hz": "Hz", "s": "s", "ms": "ms", "us": "µs", "ns": "ns", "min": "min", "h": "h",
    "percent": "%", "volts": "V", "voltage": "V", "v": "V", "mv": "mV", "amps": "A", "a": "A",
    "ma": "mA", "watts": "W", "w": "W", "celsius": "°C", "degc": "°C", "m": "m", "mm": "mm",
    "cm": "cm", "rad": "rad", "deg": "°", "rpm": "rpm", "kb": "kB", "mb": "MB", "gb": "GB",
    "bytes": "B", "dbm": "dBm", "newton": "N", "nm": "Nm", "kg": "kg",
}  # fmt: skip
_TELLING = ("voltage", "newton")
"""What says more of an output than the unit behind its value does."""
_LONG_S = 120.0
"""From here on a duration is told in two units."""
_SPANS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))
_DIGITS = 4
_FOREVER_S = 1e9
DURATION = "duration"
_KEPT = "!'()*"
"""What encodeURIComponent of browsers leaves as it is."""


@dataclass(frozen=True, slots=True)
class Branch:
    """A component with what is inside; ``root``: it is in trouble and nothing is in its way."""

    component: Component
    id: str
    level: str
    is_open: bool
    is_hidden: bool
    root: bool


def branches(tree: StatusTree, q: str, show: Show, chosen: Sequence[str]) -> list[Branch]:
    """Return the components in their order; ``chosen`` are those that somebody has opened."""
    opened = set(chosen) or set(_in_trouble(tree.components))
    return [
        Branch(
            one, branch_id(one.component), level_of(one), one.component in opened,
            not _fits(one, q, show), is_root(one),
        )
        for one in tree.components
    ]  # fmt: skip


def branch_id(component: str) -> str:
    """Return the id of a component's element: nothing in it has a meaning of its own."""
    return f"c-{quote(component, safe='')}"


def key(component: str, mode: str = "", output: str = "") -> str:
    """Return the name by which the browser finds what shows something, as robottree.js makes it."""
    return "/".join(quote(name, safe=_KEPT) for name in (component, mode, output))


def level_of(component: Component) -> str:
    """Return the level of a component; unknown where nothing was said of it."""
    return component.condition.level if component.condition else "unknown"


def is_root(component: Component) -> bool:
    """Tell whether trouble begins here: it is not well, and nothing that it needs is in the way."""
    said = component.condition
    return said is not None and said.level in ("error", "warn", "stale") and not said.blocked_by


def failing(mode: Mode, output: Output) -> str:
    """Return the level of an output that its mode is not well for; empty for the others."""
    said = mode.condition
    return said.level if said.level != "ok" and said.state == output.name else ""


def shown(output: Output) -> str:
    """Write a value: numbers with as many digits as tell something, yes and no."""
    value = output.value
    if isinstance(value, int | float) and value_type(output) == DURATION:
        return duration(value)
    if value is None:
        return catalogue().text("robot.js.value.none")
    if isinstance(value, bool):
        return catalogue().text(f"robot.js.value.{'yes' if value else 'no'}")
    return number(value) if isinstance(value, float) else str(value)


def number(value: float) -> str:
    """Write a number with four digits that count, of which none is dropped: widths stay."""
    size = abs(value)
    if not isfinite(value) or size >= 1e6 or 0 < size < 1e-3:
        return f"{value:.2e}"
    whole = floor(log10(size)) if size >= 1 else 0
    return f"{value:.{max(0, _DIGITS - 1 - whole)}f}"


def duration(seconds: float) -> str:
    """Write how long something takes: ``0.100 s``, ``13 h 51 min``, in two units from 2 min on."""
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
    """Return the unit behind a value: as declared, else guessed; a duration says it itself."""
    return "" if value_type(output) == DURATION else _unit(output)


def value_type(output: Output) -> str:
    """Return the type that a value is written as: numbers of seconds are durations."""
    return DURATION if _unit(output) == "s" else output.type


def label(output: Output) -> str:
    """Return the name of an output in words, without the unit that is shown behind its value."""
    rest, _, last = output.name.rpartition("_")
    said = _unit(output)
    is_said = said and said == guessed_unit(output.name) and last.casefold() not in _TELLING
    return wording.readable(rest if rest and is_said else output.name)


def guessed_unit(name: str) -> str:
    """Return the unit that a name ends with; empty where it names none, or one of a rate."""
    rest, _, last = name.casefold().rpartition("_")
    if rest.split("_")[-1] == "per":
        return ""
    return _UNITS.get(last, "") if "_" in name or len(last) > 3 else ""


def _unit(output: Output) -> str:
    if output.type not in ("int", "float"):
        return ""
    return output.unit or guessed_unit(output.name)


def span_text(seconds: float) -> str:
    """Write how long something lasts, as pages do: in one unit, at least 1 s."""
    return span(max(1, seconds))


def _in_trouble(components: Sequence[Component]) -> Iterator[str]:
    worst = sorted(filter(is_root, components), key=lambda one: level_of(one) != "error")
    yield from (one.component for one in worst[:OPENED])


def _fits(component: Component, q: str, show: Show) -> bool:
    words = " ".join(_words(component)).casefold()
    return all(word in words for word in q.casefold().split()) and (
        show == "all" or level_of(component) != "ok"
    )


def _words(component: Component) -> Iterator[str]:
    yield from (component.component, component.name)
    for mode in component.modes:
        yield from (mode.mode, mode.name, *(output.name for output in mode.outputs))
