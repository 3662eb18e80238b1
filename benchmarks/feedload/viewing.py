"""What open pages ask of a server: their feed, and the pieces that they fetch anew.

What pages listen to is read from their modules; when they fetch pieces stands here as it stands
there (``home.js``, ``robot.js``, ``robot_head.js``, ``page.js``).
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.server import web
from benchmarks.feedload.fleet import ROBOTS

_MODULES = Path(web.__file__).parent / "static/js"
_LISTENS = re.compile(r"\bsubscribe\(\{[^}]*?kinds: (\[[^\]]*\])")


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of a page that is fetched, at most once in so many seconds."""

    path: str
    every_s: float


@dataclass(frozen=True, slots=True)
class Page:
    """An open page: what it listens to, and what it fetches when.

    ``regular`` is fetched again and again, ``news`` when a level has changed, ``events`` when
    something happened, ``resting`` when a level has changed and the news cannot be fetched at once;
    ``{robot}`` is the robot that the news are about.
    """

    robots: Sequence[str] | None
    kinds: Sequence[str]
    regular: Sequence[Piece]
    news: Sequence[Piece] = ()
    events: Sequence[Piece] = ()
    resting: Sequence[Piece] = ()


def pages(count: int) -> list[Page]:
    """Return open pages: one half the fleet, the other half robots, evenly."""
    robots = [_robot(f"r{number % ROBOTS}") for number in range(count // 2)]
    return [*robots, *(_home() for _ in range(count - len(robots)))]


def _home() -> Page:
    path = "/pieces/robots"
    return Page(
        None, _kinds("home.js"), (Piece(path, 30), Piece("/pieces/alarm-count", 60)),
        news=(Piece(path, 5),), resting=(Piece(f"{path}/{{robot}}", 1),),
    )  # fmt: skip


def _robot(robot: str) -> Page:
    path = f"/pieces/robots/{robot}"
    now = Piece(f"{path}/now", 20)
    return Page(
        [robot], _kinds("robot.js", "robot_head.js"),
        (now, Piece("/pieces/alarm-count", 60)),
        news=(Piece(f"{path}/graph", 2), Piece(f"{path}/timeline?window=1h&lanes=", 5),
              Piece(f"{path}/head", 1)),
        events=(Piece(f"{path}/events?kind=", 1), Piece(now.path, 1)),
    )  # fmt: skip


def _kinds(*modules: str) -> list[str]:
    """Return the kinds that modules of one page listen to together."""
    found: set[str] = set()
    for name in modules:
        listens = _LISTENS.search((_MODULES / name).read_text())
        assert listens is not None, f"{name} does not say what it listens to"
        found.update(json.loads(listens[1]))
    return sorted(found)
