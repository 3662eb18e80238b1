"""Keys that robots sign with: another one than before counts when an admin has confirmed it.

A link key may be stolen; whoever has it must not make a robot's record trusted under a key of its
own. What such a key signs meanwhile is kept aside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import ColumnElement, Connection, and_, select, update

from amberbox.core.errors import UsageError
from amberbox.fleet.linkend.events import note
from amberbox.fleet.linkend.tables import SIGNING_KEY, STORE
from amberbox.fleet.uploads.tables import UPLOAD, is_other_history

KeyState = Literal["pending", "confirmed", "refused"]


@dataclass(frozen=True, slots=True)
class SigningKey:
    """Another key than a robot had before; ``first_seen_ns`` is when it came with a hello."""

    robot: str
    store_id: str
    public_key: str
    first_seen_ns: int
    state: KeyState


def waiting_reason(public_key: str) -> str:
    """Return why a journal is kept aside that a key signs which nobody has confirmed."""
    return f"it is signed with another key than before, which waits for an admin: {public_key}"


def admit_key(
    connection: Connection, robot: str, store_id: str, public_key: str, now_ns: int
) -> bool:
    """Tell whether a key may be the one of a store; another than the robot had is noted, once."""
    stores = select(STORE.c.public_key).where(STORE.c.robot == robot)
    trusted = set(connection.scalars(stores)) - {""}
    found = _state(connection, robot, public_key)
    if not public_key or not trusted or public_key in trusted or "confirmed" in found:
        return True
    mine = and_(_of(robot, public_key), SIGNING_KEY.c.store_id == store_id)
    if connection.execute(select(SIGNING_KEY.c.state).where(mine)).first() is None:
        state = "refused" if "refused" in found else "pending"
        row = {"robot": robot, "store_id": store_id, "public_key": public_key,
               "first_seen_ns": now_ns, "state": state}  # fmt: skip
        connection.execute(SIGNING_KEY.insert(), [row])
        text = (
            f"the store {store_id} signs with another key than before; what it signs is kept "
            f"aside until an admin has confirmed the key: {public_key}"
        )
        note(connection, robot, now_ns, "new_key", text)
    return False


def key_state(connection: Connection, robot: str, public_key: str) -> KeyState | None:
    """Return what became of a key that took another's place; None for any other key."""
    found = _state(connection, robot, public_key)
    return next((state for state in ("refused", "confirmed", "pending") if state in found), None)


def pending_keys(connection: Connection, robot: str = "") -> list[SigningKey]:
    """Return the keys that wait for an admin, of all robots without a name."""
    chosen = select(SIGNING_KEY).where(SIGNING_KEY.c.state == "pending")
    chosen = chosen.where(SIGNING_KEY.c.robot == robot) if robot else chosen
    rows = connection.execute(chosen.order_by(SIGNING_KEY.c.robot, SIGNING_KEY.c.first_seen_ns))
    return [SigningKey(*row) for row in rows]


def distrusted_stores(connection: Connection) -> dict[tuple[str, str], KeyState]:
    """Return the stores, with their robot, that sign with a key that no admin has confirmed."""
    chosen = select(SIGNING_KEY.c.robot, SIGNING_KEY.c.store_id, SIGNING_KEY.c.state)
    rows = connection.execute(chosen.where(SIGNING_KEY.c.state != "confirmed"))
    return {(row.robot, row.store_id): row.state for row in rows}


def decide(
    connection: Connection, now_ns: int, robot: str, public_key: str, *, confirm: bool
) -> int:
    """Confirm or refuse a key that waits; return how many journals this was about.

    Confirmed ones are verified from now on; the archive takes them over. Raises UsageError when
    no such key waits.
    """
    waiting = [key for key in pending_keys(connection, robot) if key.public_key == public_key]
    if not waiting:
        what = f"no key {public_key} of {robot} waits for a decision"
        raise UsageError(what, "the keys that wait are shown at /admin/robots")
    state: KeyState = "confirmed" if confirm else "refused"
    changed = update(SIGNING_KEY).where(_of(robot, public_key)).values(state=state)
    connection.execute(changed)
    note(connection, robot, now_ns, f"key_{state}", f"the key was {state}: {public_key}")
    if confirm:
        stores = and_(STORE.c.robot == robot, STORE.c.store_id.in_(k.store_id for k in waiting))
        connection.execute(update(STORE).where(stores).values(public_key=public_key))
    return _settle(connection, robot, public_key, confirm=confirm)


def _settle(connection: Connection, robot: str, public_key: str, *, confirm: bool) -> int:
    table = UPLOAD.c
    wanted = and_(table.robot == robot, table.reason == waiting_reason(public_key))
    rows = connection.execute(select(UPLOAD).where(wanted).order_by(table.run, table.number)).all()
    for row in rows:
        keys = row.robot, row.store_id, row.journal, row.sha256
        held = row.writer, row.run, row.first_seq, row.end_seq
        verified = confirm and not is_other_history(connection, keys, held)
        mine = and_(wanted, table.store_id == row.store_id, table.sha256 == row.sha256)
        reason = "" if confirm else "it is signed with a key that an admin refused"
        values = {"state": "verified" if verified else "aside", "reason": reason}
        connection.execute(update(UPLOAD).where(mine).values(**values))
    return len(rows)


def _state(connection: Connection, robot: str, public_key: str) -> Sequence[str]:
    return connection.scalars(select(SIGNING_KEY.c.state).where(_of(robot, public_key))).all()


def _of(robot: str, public_key: str) -> ColumnElement[bool]:
    return and_(SIGNING_KEY.c.robot == robot, SIGNING_KEY.c.public_key == public_key)
