"""Windows asked for, in the database: sent, answered, copied."""

from __future__ import annotations

import secrets
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
from sqlalchemy import Connection, Row, func, select, update

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_duration
from amberbox.fleet.fetches.tables import FETCH
from amberbox.fleet.uploads.tables import UPLOAD
from amberbox.link.limits import FILES

State = Literal["waiting", "asked", "copying", "ready", "gone", "cancelled"]
OPEN: Sequence[State] = ("waiting", "asked", "copying")
IDLE_NS = 3600 * NS
"""Time that a robot is connected and sends nothing, after which a window is given up."""
MOST_OPEN = 100
"""Windows that wait for one robot."""

_GONE = "gone"
_LATE = "late"
_ENDED = ("verified", "aside", "quarantined")
"""States of an upload that nothing more comes of."""


class File(msgspec.Struct, frozen=True):
    """A journal of a window: ``state`` is empty while it is to come, then that of its upload.

    ``gone`` is one that the robot had named and has deleted before it was copied, ``late`` one that
    did not come although the robot was connected for long.
    """

    store_id: str
    journal: str
    bytes: int
    state: str = ""


@dataclass(frozen=True, slots=True)
class Fetched:
    """A window of a robot's record that somebody wants on the server."""

    id: str
    robot: str
    item: str
    from_ns: int
    to_ns: int
    who: str
    state: State
    files: Sequence[File]
    asked_ns: int
    sent_ns: int | None
    ended_ns: int | None

    @property
    def reason(self) -> str:
        """Say why not all has come, and what helps; empty where nothing was given up."""
        late = sum(file.state == _LATE for file in self.files)
        if not late:
            return ""
        return (
            f"{late} of {len(self.files)} journals did not come although {self.robot} was "
            f"connected for {format_duration(IDLE_NS)}. An amberbox from before servers could be "
            "restored takes them for copied: update it on the robot, and ask again. Over a metered "
            "network nothing is copied"
        )


def add(
    connection: Connection, now_ns: int, robot: str, who: str, item: str, span: tuple[int, int]
) -> Fetched:
    """Ask for a window; raises UsageError when too many wait for this robot."""
    counted = select(func.count()).select_from(FETCH)
    count = connection.scalar(counted.where(FETCH.c.robot == robot, FETCH.c.state.in_(OPEN))) or 0
    if count >= MOST_OPEN:
        raise UsageError(f"{count} windows of {robot} are waited for", "wait, or cancel some")
    fetch_id = f"f-{secrets.token_hex(12)}"
    row = {
        "id": fetch_id, "robot": robot, "item": item, "from_ns": span[0], "to_ns": span[1],
        "who": who, "state": "waiting", "files": "[]", "asked_ns": now_ns,
    }  # fmt: skip
    connection.execute(FETCH.insert(), [row])
    found = find(connection, robot, fetch_id)
    assert found is not None
    return found


def find(connection: Connection, robot: str, fetch_id: str) -> Fetched | None:
    """Return what was asked for, of this robot."""
    chosen = select(FETCH).where(FETCH.c.id == fetch_id, FETCH.c.robot == robot)
    row = connection.execute(chosen).one_or_none()
    return None if row is None else _fetched(row)


def listed(connection: Connection, robot: str, after: str = "", limit: int = 100) -> list[Fetched]:
    """Return what was asked of a robot, newest first, behind that of an id."""
    chosen = select(FETCH).where(FETCH.c.robot == robot)
    mark = find(connection, robot, after) if after else None
    if mark is not None:
        same = (FETCH.c.asked_ns == mark.asked_ns) & (FETCH.c.id > mark.id)
        chosen = chosen.where((FETCH.c.asked_ns < mark.asked_ns) | same)
    ordered = chosen.order_by(FETCH.c.asked_ns.desc(), FETCH.c.id).limit(limit)
    return [_fetched(row) for row in connection.execute(ordered)]


def waiting(connection: Connection, robot: str) -> list[Fetched]:
    """Return what is open of a robot, in the order in which it was asked."""
    chosen = select(FETCH).where(FETCH.c.robot == robot, FETCH.c.state.in_(OPEN))
    return [_fetched(r) for r in connection.execute(chosen.order_by(FETCH.c.asked_ns, FETCH.c.id))]


def robots(connection: Connection) -> list[str]:
    """Return the robots of which something is waited for."""
    chosen = select(FETCH.c.robot).where(FETCH.c.state.in_(OPEN)).distinct()
    return list(connection.scalars(chosen))


def sent(connection: Connection, now_ns: int, one: Fetched) -> bool:
    """Note that the robot was asked; tell whether that is a change."""
    changed = update(FETCH).where(FETCH.c.id == one.id, FETCH.c.state == "waiting")
    return connection.execute(changed.values(state="asked", sent_ns=now_ns)).rowcount > 0


def answered(
    connection: Connection, now_ns: int, one: Fetched, named: Sequence[File]
) -> Fetched | None:
    """Note which journals a robot named; None where that changes nothing.

    A robot names all that hold the window: what it named before and has not sent, and does not
    name any more, will not come (``gone``).
    """
    known = {(file.store_id, file.journal) for file in one.files}
    more = [file for file in named if (file.store_id, file.journal) not in known]
    more = more[: FILES - len(one.files)]  # a robot that names ever more names nonsense
    if one.state not in OPEN:
        return None
    if not (one.files or more):
        return _change(connection, one, state="gone", ended_ns=now_ns)
    here = {(file.store_id, file.journal) for file in named}
    is_all = len(named) < FILES  # else there are more than fit in a frame
    return looked(connection, now_ns, one, [*one.files, *more], here if is_all else None)


def looked(
    connection: Connection, now_ns: int, one: Fetched, files: Sequence[File],
    here: Collection[tuple[str, str]] | None = None,
) -> Fetched | None:  # fmt: skip
    """See which journals have come; None where that changes nothing.

    ``here`` is what the robot still has (store and journal), None where that is not known.
    """
    found = [_with_state(connection, one.robot, file) for file in files]
    if here is not None:
        found = [file if _is_expected(file, here) else _gone(file) for file in found]
    done = all(file.state for file in found)
    nothing = all(file.state in (_GONE, _LATE) for file in found)
    state: State = "copying" if not done else "gone" if nothing else "ready"
    if (list(one.files), one.state) == (found, state):
        return None
    text = msgspec.json.encode(found).decode()
    return _change(connection, one, state=state, files=text, ended_ns=now_ns if done else None)


def give_up(connection: Connection, now_ns: int, one: Fetched) -> Fetched | None:
    """Wait no longer for the journals of a window; None where all has come meanwhile."""
    files = [_with_state(connection, one.robot, file) for file in one.files]
    late = [file if file.state else msgspec.structs.replace(file, state=_LATE) for file in files]
    return looked(connection, now_ns, one, late)


def cancel(connection: Connection, now_ns: int, one: Fetched) -> bool:
    """Want a window no more; tell whether it was open."""
    changed = update(FETCH).where(FETCH.c.id == one.id, FETCH.c.state.in_(OPEN))
    return connection.execute(changed.values(state="cancelled", ended_ns=now_ns)).rowcount > 0


def _with_state(connection: Connection, robot: str, file: File) -> File:
    if file.state:
        return file
    chosen = select(UPLOAD.c.state).where(
        UPLOAD.c.robot == robot, UPLOAD.c.store_id == file.store_id,
        UPLOAD.c.journal == file.journal, UPLOAD.c.state.in_(_ENDED),
    )  # fmt: skip
    states = set(connection.scalars(chosen))
    best = next((state for state in _ENDED if state in states), "")
    return msgspec.structs.replace(file, state=best)


def _is_expected(file: File, here: Collection[tuple[str, str]]) -> bool:
    return bool(file.state) or (file.store_id, file.journal) in here


def _gone(file: File) -> File:
    return msgspec.structs.replace(file, state=_GONE)


def _change(connection: Connection, one: Fetched, **values: Any) -> Fetched | None:
    connection.execute(update(FETCH).where(FETCH.c.id == one.id).values(**values))
    return find(connection, one.robot, one.id)


def _fetched(row: Row[Any]) -> Fetched:
    return Fetched(
        row.id, row.robot, row.item, row.from_ns, row.to_ns, row.who, row.state,
        msgspec.json.decode(row.files, type=list[File]), row.asked_ns, row.sent_ns, row.ended_ns,
    )  # fmt: skip
