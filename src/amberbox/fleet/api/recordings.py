"""Recordings: the journals of a robot, what they cover, whether they hold, how long they stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import msgspec
from fastapi import HTTPException, Query

from amberbox.core.clock import NS
from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Limit, shown
from amberbox.fleet.api.windows import FROM, Shown
from amberbox.fleet.archive.retaining import rule_of
from amberbox.fleet.archive.store import Retention
from amberbox.fleet.data import WORKER
from amberbox.fleet.data.journals import Integrity, State, recordings
from amberbox.fleet.data.journals import Recording as Kept
from amberbox.fleet.options.options import read
from amberbox.fleet.services import Services

routes = Routes("recordings")

_CHECKED = 50


class Recording(Shown):
    """A journal on the server, or on its way to it.

    ``state``: ``copying`` (``copied`` of ``bytes``), ``waiting`` for its columns, ``in_columns``,
    ``refused``, ``quarantined``, or ``aside``: sound, but of another history of the same store.
    ``integrity``: ``intact``, ``unsigned`` (holds, but the robot has signed no head behind it yet),
    ``altered``, ``missing``, ``deleted`` by retention, ``unknown`` while it is copied.
    ``from`` and ``to`` are null where they are not known: while it is copied, of what is damaged.
    ``journal_until`` and ``columns_until`` are when retention may take them; null is never.
    """

    store_id: str
    journal: str
    keeping: str
    sha256: str
    state: State
    integrity: Integrity
    reason: str
    bytes: int
    copied: int
    rows: int
    from_: str | None = FROM
    to: str | None
    came: str | None
    journal_until: str | None
    columns_until: str | None


@routes.get("/robots/{robot}/recordings", "items.read")
def list_recordings(
    fleet: Fleet, who: Who, robot: OfRobot, limit: Limit = 100,
    after: Annotated[
        str, Query(max_length=400, description="store_id/journal of the last one before")
    ] = "",
    check: Annotated[
        bool, Query(description=f"read each, at most {_CHECKED}, and compare its hash")
    ] = False,
) -> list[Recording]:  # fmt: skip
    """List the journals of a robot by name; without ``check`` their integrity is as last known."""
    if check and limit > _CHECKED:
        raise HTTPException(400, f"at most {_CHECKED} are checked at a time: give limit")
    with fleet.database.reading() as connection:
        found = recordings(connection, fleet.folder, robot.id, after, limit)
        rules = read(connection, "retention", tuple[Retention, ...])
    checked = _checked(fleet, who, robot.id, found) if check else found
    return [_shown(one, robot.id, rules) for one in checked]


def _checked(fleet: Services, who: Caller, robot: str, found: Sequence[Kept]) -> Sequence[Kept]:
    named = [
        [one.store_id, one.journal, one.sha256]
        for one in found
        if one.integrity in ("intact", "unsigned")
    ]
    arguments = {"robot": robot, "journals": named}
    answer = fleet.asking.ask_now(f"{WORKER}:altered", arguments, asker=who.asker)
    altered = set(msgspec.json.decode(answer, type=list[str]))
    return [
        replace(one, integrity="altered") if f"{one.store_id}/{one.journal}" in altered else one
        for one in found
    ]


def _shown(one: Kept, robot: str, rules: Sequence[Retention]) -> Recording:
    rule = rule_of(robot, one.keeping, rules)
    until = [
        None if seconds is None or one.came_ns is None else one.came_ns + int(seconds * NS)
        for seconds in (rule.journals_s, rule.columns_s)
    ] if rule is not None else [None, None]  # fmt: skip
    return Recording(
        store_id=one.store_id, journal=one.journal, keeping=one.keeping, sha256=one.sha256,
        state=one.state, integrity=one.integrity, reason=one.reason, bytes=one.bytes,
        copied=one.copied, rows=one.rows, from_=shown(one.from_ns),
        to=shown(one.to_ns), came=shown(one.came_ns), journal_until=shown(until[0]),
        columns_until=shown(until[1]),
    )  # fmt: skip
