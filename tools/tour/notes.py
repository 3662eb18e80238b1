"""What a technician notes down, the trail in the access log, and the truth of a fault."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from amberbox.blackbox.sources.sim import FOLDER
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timestamps import parse_time
from amberbox.demo.fleet import OFFERED_FAULTS
from amberbox.diagnosis.fmea.loader import FILE, load_fmea
from amberbox.diagnosis.fmea.model import Fmea

_BROKEN, _SURE, _WHY = "What is broken", "How sure", "Why"
_USE, _NEXT = "Can the robot be used?", "Do this next"
_AS_OF, _ONE_OF = "As of ", "One of these "
_SINCE, _MORE = " since ", re.compile(r"and \d+ more\b.*")
_SHARE = re.compile(r"(?:over |under )?\d+\s?%")
_HEADINGS = (_BROKEN, _SURE, _WHY, _USE, _NEXT)


@dataclass(frozen=True, slots=True)
class Notes:
    """What is broken (several where they look alike), why, whether it can be used, what to do."""

    causes: Sequence[str]
    sure: str
    why: Sequence[str]
    use: str
    next: str

    def __str__(self) -> str:
        return "\n".join((*self.causes, self.sure, *self.why, self.use, self.next))


def notes_of(text: str) -> Notes:
    """Read the card; raises ValueError where a part of it is missing."""
    parts = _parts(text)
    lacking = [heading for heading in _HEADINGS if not parts.get(heading)]
    if lacking:
        raise ValueError(f"the page does not say: {', '.join(lacking)}")
    return Notes(
        _causes(parts[_BROKEN]), " ".join(parts[_SURE]), _reasons(parts[_WHY]), parts[_USE][0],
        parts[_NEXT][0],
    )  # fmt: skip


def _parts(text: str) -> dict[str, list[str]]:
    """Return the lines below each heading of the card, without empty ones."""
    parts: dict[str, list[str]] = {}
    below: list[str] | None = None
    for line in filter(None, map(str.strip, text.splitlines())):
        if line in _HEADINGS:
            below = parts.setdefault(line, [])
        elif below is not None:
            below.append(line)
    return parts


def _causes(lines: Sequence[str]) -> list[str]:
    """Return the causes: one, or those of a list, each of which has its share behind it."""
    said = [line for line in lines if not line.startswith(_AS_OF)]
    if not said[0].startswith(_ONE_OF):
        return said[:1]
    return [line for line in said[1:] if not _SHARE.fullmatch(line)]


def _reasons(lines: Sequence[str]) -> list[str]:
    """Return what was seen; since when, and how much more there is, is left out."""
    return [line.partition(_SINCE)[0] for line in lines if not _MORE.fullmatch(line)]


# addresses that pages fetch by themselves; any other one counts as a click
_PART = re.compile(r"/(?:static|api|pieces|help)/|/robots/[^/]+/(?:data|diagnosis)/|/favicon\.ico$")
_ARRIVAL = ("/in", "/sign-in")  # pages for people who are not signed in
_MS = NS // 1000


@dataclass(frozen=True, slots=True)
class Trail:
    """The pages that were opened, in order, and from the first of them to the last thing asked."""

    pages: Sequence[str]
    seconds: float

    @property
    def clicks(self) -> int:
        """Count the clicks: on the link, which leads over its own page, and each one after that."""
        return sum(page not in _ARRIVAL for page in self.pages)


def trail_of(lines: Iterable[str], who: str) -> Trail:
    """Follow one person through lines of the log; raises ValueError where there is no page.

    A line is written when a request has ended, so each began ``ms`` before its time. The feed of
    a page is such a request too: it ends when the page is left, which is the last one sees here.
    """
    asked = [line for line in map(json.loads, lines) if _is_of(line, who)]
    pages = [line for line in asked if _is_page(line)]
    if not any(line["principal"] == who for line in pages):
        raise ValueError(f"{who} opened no page")
    began_ns = min(_ended_ns(line) - round(line["ms"] * _MS) for line in pages)
    return Trail([line["path"] for line in pages], (max(map(_ended_ns, asked)) - began_ns) / NS)


def _is_of(line: Any, who: str) -> bool:
    """Tell whether somebody asked that, or nobody yet who was about to sign in."""
    return line["principal"] == who or (not line["principal"] and line["path"] in _ARRIVAL)


def _is_page(line: Any) -> bool:
    shown = line["method"] == "GET" and 200 <= line["status"] < 300
    return shown and _PART.match(line["path"]) is None


def _ended_ns(line: Any) -> int:
    return parse_time(line["time"], lambda: 0, lambda: None)


@dataclass(frozen=True, slots=True)
class Truth:
    """One fault: what it is called, the components that show it, its remedy and its tests."""

    cause: str
    shown_by: frozenset[str]
    steps: tuple[str, ...]

    def wrong(self, notes: Notes) -> Iterator[str]:
        """Yield what somebody has written down that is not so."""
        if _plain(self.cause) not in map(_plain, notes.causes):
            yield f"it is: {self.cause}; written down: {'; '.join(notes.causes)}"
        if not any(_plain(why).startswith(one) for one in self.shown_by for why in notes.why):
            yield f"no reason has to do with it: {'; '.join(notes.why)}"
        if _plain(notes.next) not in map(_plain, self.steps):
            yield f"what to do next neither mends it nor tells whether it is that: {notes.next}"


def truth_of(fault: str) -> Truth:
    """Look up a fault that the demonstration offers."""
    fmea = _analysis()
    mode = fmea.modes[OFFERED_FAULTS[fault].failure_mode]
    tests = [fmea.tests[outcome.test].text for outcome in mode.tests]
    shown_by = frozenset(_component(link.symptom) for link in mode.symptoms)
    return Truth(mode.description, shown_by, (mode.remedy, *tests))


@cache
def _analysis() -> Fmea:
    fmea, _problems = load_fmea(FOLDER / FILE)
    if fmea is None:
        raise AmberboxError(f"{FOLDER / FILE} cannot be read", "amberbox fmea check")
    return fmea


def _component(symptom: str) -> str:
    """Return how a reason begins that is about the component of a symptom."""
    component = re.split("[/.]", symptom)[0]
    known = _analysis().components.get(component)
    return f"{_plain(known.description if known else component)}:"


def _plain(text: str) -> str:
    return text.casefold().rstrip(".?! ")
