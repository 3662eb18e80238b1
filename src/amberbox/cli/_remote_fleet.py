"""``amberbox status`` of a server: the status of each of its robots, the worst first."""

from __future__ import annotations

import argparse
import shutil
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NoReturn

import msgspec

from amberbox.cli._colour import painter
from amberbox.cli._output import print_json
from amberbox.cli._text import in_columns
from amberbox.client.address import read_address
from amberbox.client.fleet import Fleet
from amberbox.client.models import Card
from amberbox.core.robotstatus import RANK, WORDS, Observed, RobotStatus, judge
from amberbox.core.terminal import OWN
from amberbox.core.types import Level

_PERIOD_S = 1.0
_NARROWEST = 24


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot of a server with its one status."""

    card: Card
    status: RobotStatus


def is_fleet(args: argparse.Namespace) -> bool:
    """Tell whether WHERE is a server, and all of it is meant: no robot of it, and no component."""
    one = read_address(args.where).robot or args.component or args.wait is not None
    return not one and args.format == "table"


def robots_of(fleet: Fleet) -> list[Robot]:
    """Return the robots that one may see, the worst first; at the end those switched off."""
    found = [Robot(card, _status(card)) for card in fleet.robots()]
    return sorted(found, key=lambda one: (one.card.disabled, -one.status.rank, one.card.robot))


def show(robots: Sequence[Robot], args: argparse.Namespace) -> None:
    """Print a line for each robot, or JSON."""
    if args.json:
        print_json({"server": read_address(args.where).url,
                    "robots": [_as_json(one) for one in robots]})  # fmt: skip
        return
    print("\n".join(_lines(robots)))


def watch(fleet: Fleet, args: argparse.Namespace) -> NoReturn:
    """Draw again every second until Ctrl-C."""
    while True:
        robots = robots_of(fleet)
        if sys.stdout.isatty():
            print(f"{OWN}[H{OWN}[J", end="")
        show(robots, args)
        sys.stdout.flush()
        time.sleep(_PERIOD_S)


def verdict(robots: Sequence[Robot]) -> int:
    """Return 0 if every robot that is not switched off is known to work, as of one robot."""
    meant = (one for one in robots if not one.card.disabled)
    return int(any(one.status.level not in ("ok", "warn") for one in meant))


def _status(card: Card) -> RobotStatus:
    """Return the status that the server states; of an older server, what its card comes to."""
    if card.status is not None:
        stated = msgspec.to_builtins(card.status)
        known = {**stated, "level": _level(card.status.level),
                 "last_level": _level(card.status.last_level)}  # fmt: skip
        return RobotStatus(**known)
    seen = Observed(
        "online" if card.online else "offline" if card.last_seen else "never",
        "running" if card.level != "unknown" or not card.online else "silent",
        _level(card.last_level or card.level), card.cause, as_of=card.last_seen,
    )  # fmt: skip
    return judge(seen)


def _level(text: str) -> Level:
    """Read a level; a newer server's word that is none here is ``unknown``."""
    return next((level for level in RANK if level == text), "unknown")


def _lines(robots: Sequence[Robot]) -> Iterator[str]:
    paint = painter(sys.stdout)
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    levels = Counter(one.status.level for one in robots)
    ordered = sorted(levels, key=RANK.__getitem__, reverse=True)
    counted = ", ".join(paint(f"{levels[level]} {WORDS[level]}", level) for level in ordered)
    yield f"{len(robots)} {'robot' if len(robots) == 1 else 'robots'}: {counted}"
    header = ("robot", "status", "alarms")
    rows = [(one.card.robot, WORDS[one.status.level], _alarms(one.card)) for one in robots]
    widths = [2 + max(map(len, column)) for column in zip(header, *rows, strict=True)]
    at, end = widths[0], sum(widths)
    lines = in_columns([header, *rows], "")
    yield lines[0]
    for line, (_, word, _), one in zip(lines[1:], rows, robots, strict=True):
        first, *more = _wrapped(_said(one), None if width is None else width - end)
        line = line.ljust(end)
        yield line[:at] + paint(word, one.status.level) + line[at + len(word) :] + first
        yield from (" " * end + text for text in more)


def _wrapped(text: str, width: int | None) -> list[str]:
    """Break a text to a width; a narrow terminal gets at least some words on each line."""
    return [text] if width is None else textwrap.wrap(text, max(width, _NARROWEST)) or [""]


def _alarms(card: Card) -> str:
    return f"{card.alarms} open" if card.alarms else ""


def _said(one: Robot) -> str:
    """Say in a line how a robot is: of one that is away, as of when."""
    status = one.status
    if one.card.disabled:
        return "Switched off by an admin."
    if status.is_current:
        return " ".join(f"{status.text} {status.reason}".split())
    away = {"offline": "Offline.", "silent": "Silent.", "never": "Never connected."}
    as_of = f"(as of {status.as_of[:19]}Z)" if status.as_of else ""
    return " ".join(filter(None, (away.get(status.contact), status.text, as_of)))


def _as_json(one: Robot) -> dict[str, object]:
    card = one.card
    return {
        "robot": card.robot, "groups": list(card.groups), "online": card.online,
        "last_seen": card.last_seen, "alarms": card.alarms,
        **msgspec.to_builtins(one.status),
    }  # fmt: skip
