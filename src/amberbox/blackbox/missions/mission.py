"""A mission: from when to when a robot was about something, and what came of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.catalogue import Catalogue, ask, look
from amberbox.blackbox.query.clockbook import ClockBook
from amberbox.blackbox.query.gather import Request, gather
from amberbox.blackbox.query.tabletext import plain
from amberbox.blackbox.segments.build import can_build
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time

FAILED = frozenset({"failed", "aborted", "timeout", "error"})
"""Outcomes that count as failures where nothing else is said."""
DONE, SUPERSEDED, TIMEOUT = "done", "superseded", "timeout"

_FIELDS = ("id", "name", "state", "outcome", "from_ns", "to_ns", "who", "details")


@dataclass(frozen=True, slots=True)
class Moment:
    """When something was, as well as it was known then, and how to find out better.

    Either ``run`` and log time are known, or the boot and the time since then; or neither.
    """

    received_ns: int
    run: int | None = None
    log_ns: int = 0
    boot: str = ""
    boot_ns: int = 0

    def corrected_ns(self, book: ClockBook) -> int:
        """Return the time of receipt by what is known of the clocks now."""
        if self.run is not None:
            found = book.received_ns(self.run, self.log_ns)
            return self.received_ns if found is None else found
        clock = book.boots.get(self.boot)
        return self.received_ns if clock is None else clock.wall_ns(self.boot_ns)


@dataclass(frozen=True, slots=True)
class Mission:
    """One interval; ``name`` says what kind it is (transport), ``to_ns`` is None while it lasts.

    Times are nanoseconds since the Unix epoch. ``failed`` and ``outcome`` are known at the end.
    """

    id: str
    name: str
    start: Moment
    end: Moment | None = None
    outcome: str = ""
    failed: bool = False
    who: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def from_ns(self) -> int:
        """When it began."""
        return self.start.received_ns

    @property
    def to_ns(self) -> int | None:
        """When it ended: the first instant that does not belong to it."""
        return None if self.end is None else self.end.received_ns

    def ended(self, end: Moment, outcome: str, failed: bool | None = None) -> Mission:
        """Return the mission as it is once it has ended."""
        judged = outcome in FAILED if failed is None else failed
        return replace(self, end=end, outcome=outcome, failed=judged)

    def corrected(self, book: ClockBook) -> Mission:
        """Return the mission with times as they are known now."""
        start = replace(self.start, received_ns=self.start.corrected_ns(book))
        if self.end is None:
            return replace(self, start=start)
        end_ns = max(self.end.corrected_ns(book), start.received_ns)
        return replace(self, start=start, end=replace(self.end, received_ns=end_ns))

    def record(self) -> tuple[str, dict[str, Any]]:
        """Compose what the keeper's journal says of it: that it began, or how it ended."""
        details = {
            "failed": self.failed,
            "parameters": dict(self.parameters),
            "start": msgspec.to_builtins(self.start),
            "end": msgspec.to_builtins(self.end),
        }
        return reserved.MISSION, {
            "id": self.id,
            "name": self.name,
            "state": "started" if self.end is None else "ended",
            "outcome": self.outcome,
            "from_ns": self.from_ns,
            "to_ns": self.to_ns,
            "who": self.who,
            "details": msgspec.json.encode(details).decode(),
        }

    def to_json(self) -> dict[str, Any]:
        """Return the mission as JSON has it: times are RFC 3339 strings."""
        return {
            "id": self.id,
            "name": self.name,
            "from": format_time(self.from_ns),
            "to": None if self.to_ns is None else format_time(self.to_ns),
            "outcome": self.outcome,
            "failed": self.failed,
            "who": self.who,
            "parameters": dict(self.parameters),
        }


def book_of_store(store: Path) -> ClockBook:
    """Return what is known now of a store's clocks."""
    return look(store, with_segments=can_build()).book


def load(store: Path) -> list[Mission]:
    """Return all missions of a store in order of their start, with corrected times."""
    return ask(store, _load, with_segments=can_build())


def _load(catalogue: Catalogue) -> list[Mission]:
    table = next((n for n, v in catalogue.schemas.items() if v[-1].topic == reserved.MISSION), None)
    if table is None:
        return []
    found: dict[str, Mission] = {}
    pieces = gather(catalogue, Request(table, _FIELDS)).pieces
    for piece in sorted(pieces, key=lambda piece: (piece.run, int(piece.seq[0]))):
        for row in zip(*(plain(piece.columns[name]) for name in _FIELDS), strict=True):
            mission = of_record(dict(zip(_FIELDS, row, strict=True)))
            if mission.id not in found or found[mission.id].end is None:
                found[mission.id] = mission
    corrected = (mission.corrected(catalogue.book) for mission in found.values())
    return sorted(corrected, key=lambda mission: (mission.from_ns, mission.id))


def of_record(row: Mapping[str, Any]) -> Mission:
    """Return the mission that a record of the keeper's journal tells of."""
    details = msgspec.json.decode(row["details"] or "{}")
    start = msgspec.convert(details.get("start") or {"received_ns": row["from_ns"]}, Moment)
    end = details.get("end")
    return Mission(
        row["id"], row["name"], start, None if end is None else msgspec.convert(end, Moment),
        row["outcome"], bool(details.get("failed")), row["who"], details.get("parameters") or {},
    )  # fmt: skip


def choose(
    missions: Iterable[Mission],
    name: str | None = None,
    *,
    failed: bool = False,
    last: int | None = None,
    span: tuple[int | None, int | None] = (None, None),
) -> list[Mission]:
    """Choose missions of a name, failed ones, those that meet ``[from, to)``, the last few."""
    from_ns, to_ns = span
    chosen = [
        mission
        for mission in missions
        if (name is None or mission.name == name)
        and (mission.failed or not failed)
        and (to_ns is None or mission.from_ns < to_ns)
        and (from_ns is None or mission.to_ns is None or mission.to_ns > from_ns)
    ]
    return chosen if last is None else chosen[max(len(chosen) - last, 0) :]


def named(missions: Sequence[Mission], text: str) -> list[Mission]:
    """Return what ``ID``, ``last``, ``last:3``, ``failed:3`` or ``transport:3`` stands for.

    Raises UsageError when there is no such mission.
    """
    for mission in missions:
        if mission.id == text:
            return [mission]
    word, _, number = text.partition(":")
    if number and not (number.isdigit() and int(number)):
        raise UsageError(f"'{text}': after ':' comes how many", "such as last:3 or failed:1")
    kind = None if word in ("last", "failed") else word
    found = choose(missions, kind, failed=word == "failed", last=int(number or 1))
    if found:
        return found
    known = sorted({*(m.id for m in missions), *(m.name for m in missions)})
    hint = "amberbox mission list WHERE shows them" if missions else "there are none yet"
    if missions and word == "failed":
        raise UsageError("no mission has failed", hint)
    raise UsageError(f"there is no mission '{text}'{did_you_mean(text, known)}", hint)
