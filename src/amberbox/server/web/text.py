"""Texts of the pages: the catalogue of strings, the glossary, and formats of values and links."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import yaml

from amberbox.core.timestamps import NS, format_time
from amberbox.diagnosis.report import wording
from amberbox.diagnosis.report.wording import capitalize
from amberbox.server.drawing.symbols import DrawingTexts

FOLDER = Path(__file__).parent / "strings"
LANGUAGE = "en"


class MissingTextError(KeyError):
    """The catalogue has no such text: an error in a page."""


@dataclass(frozen=True, slots=True)
class TextCatalogue:
    """Texts by name."""

    texts: Mapping[str, str]

    def text(self, name: str, /, **fields: Any) -> str:
        """Return a text with its fields filled in; raises MissingTextError."""
        found = self.texts.get(name)
        if found is None:
            raise MissingTextError(f"no text '{name}' in strings/{LANGUAGE}")
        return found.format_map(fields) if fields else found


@lru_cache
def catalogue(folder: Path = FOLDER / LANGUAGE) -> TextCatalogue:
    """Return the catalogue of texts in a folder of YAML files."""
    texts: dict[str, str] = {}
    for file in sorted(folder.glob("*.yaml")):
        texts.update(_flat(yaml.safe_load(file.read_text(encoding="utf-8")), file.stem))
    return TextCatalogue(texts)


@lru_cache
def for_browser(parts: Sequence[str]) -> Mapping[str, str]:
    """Return the texts for browser modules of some parts: ``robot.js.x`` becomes ``robot.x``."""
    heads = tuple(f"{part}.js." for part in parts)
    texts = catalogue().texts
    return {name.replace(".js.", ".", 1): text for name, text in texts.items()
            if name.startswith(heads)}  # fmt: skip


def _flat(found: Any, name: str) -> Iterator[tuple[str, str]]:
    if isinstance(found, dict):
        for key, value in found.items():
            if not isinstance(key, str):
                raise MissingTextError(f"{name}: {key!r} is no text in YAML: write it in quotes")
            yield from _flat(value, f"{name}.{key}")
    else:
        yield name, str(found)


_SPANS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))
_UNITS = ("B", "kB", "MB", "GB", "TB", "PB")


def size(number: float) -> str:
    """Return bytes as text with three digits at most: ``1.23 GB``, ``56 MB``."""
    value, unit = float(number), 0
    while value >= 999.5 and unit < len(_UNITS) - 1:
        value, unit = value / 1000, unit + 1
    digits = 0 if unit == 0 or value >= 99.5 else 1 if value >= 9.95 else 2
    text = f"{value:.{digits}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text} {_UNITS[unit]}"


def count(number: int) -> str:
    """Return a count with separators: ``1,234,567``."""
    return f"{number:,}"


def percent(share: float) -> int:
    """Return a share in percent, where 0 and 100 are only for none and all.

    For the probability of a diagnosis see ``core.sureness.percent``.
    """
    if share <= 0 or share >= 1:
        return 0 if share <= 0 else 100
    return min(99, max(1, round(100 * share)))


def span(seconds: float) -> str:
    """Return a duration in one unit as text: ``5 min``."""
    whole = max(0, int(seconds))
    unit, size = next((one for one in _SPANS if whole >= one[1]), _SPANS[-1])
    return catalogue().text(f"common.js.span.{unit}", n=whole // size)


EXPERTS = "experts"
"""Words of this group are only under "Details" and on the pages about knowledge."""
_PART = "words."


@dataclass(frozen=True, slots=True)
class GlossaryEntry:
    """A word of the glossary with its meaning; ``group`` is its heading."""

    id: str
    group: str
    name: str
    text: str


@lru_cache
def words() -> Mapping[str, GlossaryEntry]:
    """Return the glossary by id, in the order of the catalogue."""
    texts = catalogue().texts
    ids = dict.fromkeys(name.split(".")[1] for name in texts if name.startswith(_PART))
    return {
        one: GlossaryEntry(
            one, *(texts[f"{_PART}{one}.{key}"] for key in ("group", "name", "text"))
        )
        for one in ids
    }


def groups() -> Iterator[tuple[str, list[GlossaryEntry]]]:
    """Yield the heading of each group of the glossary with its words."""
    for group, found in groupby(words().values(), lambda word: word.group):
        yield catalogue().text(f"help.group.{group}"), list(found)


AROUND_NS = 60 * NS
"""So much before and behind a moment is shown."""


def data_href(robot: str, start: str, to: str, variables: Iterable[str] = ()) -> str:
    """Return the address of a window of data; ``start`` and ``to`` as RFC 3339."""
    return _href(robot, [*_chosen(variables), ("from", start), ("to", to)])


def moment_href(
    robot: str, variables: Iterable[str], at_ns: int | None, until_ns: int | None = None
) -> str:
    """Return the address of the data around a moment, up to ``until_ns`` if that is earlier.

    Outputs of monitors, whose names contain slashes, are left out: they cannot be drawn.
    """
    drawn = [name for name in variables if "/" not in name]
    if at_ns is None:
        return _href(robot, _chosen(drawn))
    last_ns = at_ns + AROUND_NS
    to_ns = last_ns if until_ns is None else max(at_ns, min(until_ns, last_ns))
    return data_href(robot, _shortly(at_ns - AROUND_NS), _shortly(to_ns), drawn)


def mission_href(robot: str, mission: str) -> str:
    """Return the address of a mission's data."""
    return _href(robot, [("mission", mission)])


def _chosen(variables: Iterable[str]) -> list[tuple[str, str]]:
    return [("v", name) for name in dict.fromkeys(variables)]


def _shortly(at_ns: int) -> str:
    """Format a time to the millisecond, for addresses."""
    return f"{format_time(at_ns)[:23]}Z"


def _href(robot: str, query: list[tuple[str, str]]) -> str:
    return f"/robots/{quote(robot, safe='')}/data?{urlencode(query)}"


_LEVELS = ("ok", "warn", "error", "stale", "unknown")


@lru_cache
def drawing_words() -> DrawingTexts:
    """Return the texts of drawings."""
    text = catalogue().text
    levels = {name: text(f"common.level.{name}") for name in _LEVELS}
    own = {
        one.name: text(f"drawing.{one.name}")
        for one in fields(DrawingTexts)
        if one.name not in levels
    }
    return DrawingTexts(**levels, **own)


_CHECK = re.compile(r"(?:^|; )(?:not confirmed yet: )?([A-Za-z]\w*) (?:is|was|flapping)\b")
"""A check that a robot's reason names; what follows is its value."""


def checks_fail(what: str, reason: str) -> str:
    """Return which checks of a component fail, by its reason; the reason if it names none."""
    names = list(dict.fromkeys(readable(name).lower() for name in _CHECK.findall(reason)))
    if not names:
        return f"{what}: {reason}" if reason else what
    text, quoted = catalogue().text, [catalogue().text("alarms.quoted", text=n) for n in names]
    if len(names) == 1:
        return text("alarms.check_fails", what=what, name=quoted[0])
    if len(names) == 2:
        return text("alarms.checks_fail", what=what, one=quoted[0], other=quoted[1])
    return text("alarms.many_fail", what=what, one=quoted[0], n=len(names) - 1)


def plain_cause(cause: str) -> str:
    """Return the problem of a robot in words, from a cause such as "component: reason"."""
    component, colon, reason = cause.partition(": ")
    return checks_fail(capitalize(wording.readable(component)), reason) if colon else cause


def readable(name: str) -> str:
    """Return an id in words: ``laser_front`` is "Laser front"."""
    return capitalize(wording.readable(name)) or name
