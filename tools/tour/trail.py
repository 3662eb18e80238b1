"""What the server's access log says of somebody's way through the pages: clicks and seconds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.timetext import parse_time

_PART = re.compile(r"/(?:static|api|pieces|help)/|/robots/[^/]+/(?:data|diagnosis)/|/favicon\.ico$")
"""What pages fetch by themselves; every other address that somebody opens counts as a click."""
_ARRIVAL = ("/in", "/sign-in")
"""Pages for people who are not signed in."""
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
