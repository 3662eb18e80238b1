"""The server's state of robots' links: presence, current statuses, events, and signing keys.

A robot's new signing key is accepted once an admin has confirmed it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Literal, get_args

import msgspec
from sqlalchemy import ColumnElement, Connection, and_, func, or_, select, update

from amberbox.blackbox.journal import channels
from amberbox.core.errors import UsageError
from amberbox.core.robot_status import Monitoring
from amberbox.link.frames import BeatFrame, LinkRow
from amberbox.monitoring.current_state import WatcherHeartbeat
from amberbox.server.database import Excluded, upsert_rows
from amberbox.server.schema import (
    BOOT,
    EVENT,
    HEADS,
    ROBOT,
    ROW,
    SIGNING_KEY,
    STATUS,
    STORE,
    UPLOAD,
)


def log_event(connection: Connection, robot: str, at_ns: int, kind: str, text: str) -> None:
    """Log an event; ``at_ns`` by the server's clock."""
    values = {"robot": robot, "at_ns": at_ns, "kind": kind, "text": text}
    connection.execute(EVENT.insert(), [values])


@dataclass(frozen=True, slots=True)
class RobotPresence:
    """The last known state of a robot's link; times by the server's clock."""

    robot: str
    connected: bool
    last_seen_ns: int
    connected_ns: int
    store_id: str
    boot_id: str
    config_hash: str
    version: str
    backlog: int
    backlog_bytes: int


def presences(connection: Connection) -> list[RobotPresence]:
    """Return all robots that have ever connected, by name."""
    rows = connection.execute(select(ROBOT).order_by(ROBOT.c.robot))
    return [
        RobotPresence(
            row.robot, row.connected, row.last_seen_ns, row.connected_ns, row.store_id,
            row.boot_id, row.config_hash, row.version, row.backlog, row.backlog_bytes,
        )
        for row in rows
    ]  # fmt: skip


def clock_offset_ns(connection: Connection, robot: str) -> int | None:
    """Return the server's clock minus that of a robot in its present boot (ns); None if unknown."""
    chosen = select(BOOT.c.offset_ns).join(
        ROBOT, and_(ROBOT.c.robot == BOOT.c.robot, ROBOT.c.boot_id == BOOT.c.boot_id)
    )
    return connection.execute(chosen.where(BOOT.c.robot == robot)).scalar()


def store_of(connection: Connection, robot: str) -> str:
    """Return the id of a robot's present store; empty for one that was never connected."""
    found = connection.execute(select(ROBOT.c.store_id).where(ROBOT.c.robot == robot)).scalar()
    return str(found or "")


def newest_report_ns(connection: Connection, robot: str) -> int | None:
    """Return the robot's time of writing (ns) of its newest link row; None without any."""
    newest = (select(func.max(t.c.log_ns)).where(t.c.robot == robot) for t in (STATUS, ROW))
    times = [connection.execute(chosen).scalar() for chosen in newest]
    return max((time_ns for time_ns in times if time_ns is not None), default=None)


def record_heartbeat(
    connection: Connection, robot: str, epoch: int, beat: BeatFrame, boot: str, at_ns: int
) -> None:
    """Store a heartbeat; one of an older epoch changes nothing."""
    mine = (ROBOT.c.robot == robot, ROBOT.c.epoch == epoch)
    values = {"last_seen_ns": at_ns, "backlog": beat.backlog, "backlog_bytes": beat.backlog_bytes}
    connection.execute(update(ROBOT).where(*mine).values(**values))
    if beat.offset_ns is not None and beat.round_ns is not None:
        row = {"robot": robot, "boot_id": boot, "offset_ns": beat.offset_ns,
               "round_ns": beat.round_ns, "at_ns": at_ns}  # fmt: skip
        upsert_rows(connection, BOOT, [row], ("offset_ns", "round_ns", "at_ns"))


def reported_monitoring(beat: BeatFrame) -> WatcherHeartbeat | None:
    """Return the state of the robot's watcher from a heartbeat; None where it is unknown."""
    state = next((state for state in get_args(Monitoring) if state == beat.monitoring), None)
    if state is None:
        return None
    return WatcherHeartbeat(state, max(beat.delay_s, 0.0) if isfinite(beat.delay_s) else 0.0)


def record_disconnect(connection: Connection, robot: str, epoch: int, last_seen_ns: int) -> None:
    """Store the end of a connection, unless the robot has reconnected."""
    mine = (ROBOT.c.robot == robot, ROBOT.c.epoch == epoch)
    values = {"connected": False, "last_seen_ns": last_seen_ns}
    connection.execute(update(ROBOT).where(*mine).values(**values))


def reset_connections(connection: Connection) -> None:
    """Mark all robots as disconnected, after a restart of the server."""
    connection.execute(update(ROBOT).values(connected=False))


def keep_heads(connection: Connection, robot: str, store_id: str, heads: bytes, at_ns: int) -> None:
    """Store a robot's signed statement of how far its record reaches."""
    digest = hashlib.sha256(heads).hexdigest()
    row = {"robot": robot, "store_id": store_id, "sha256": digest, "at_ns": at_ns, "heads": heads}
    upsert_rows(connection, HEADS, [row])


def short_boot_id(boot_id: str) -> str:
    """Return the short form of a boot id, as in the names of journals."""
    return boot_id.replace("-", "")[:8]


# Largest size in bytes of a status that is shown; longer ones are stored as rows only
LONGEST = 64 << 10
_CHANGE = ("level", "store_id", "run", "seq", "log_ns", "received_ns", "data")


class _Status(msgspec.Struct):
    """The fields of a status that identify its table row."""

    component: str
    mode: str = ""
    level: str = "unknown"


_DECODER = msgspec.json.Decoder(_Status)


def newest_statuses(
    robot: str, store_id: str, rows: Sequence[LinkRow], now_ns: int
) -> Sequence[dict[str, Any]]:
    """Return the newest status among rows of each component and mode, as table rows."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in sorted((r for r in rows if r.channel == channels.STATUS), key=lambda r: r.place):
        if len(row.data) > LONGEST:
            continue
        try:
            status = _DECODER.decode(row.data)
        except msgspec.MsgspecError:
            continue  # stored as a row, but not decodable
        component, mode = status.component[:128], status.mode[:128]
        found[component, mode] = {
            "robot": robot, "component": component, "mode": mode, "level": status.level[:128],
            "store_id": store_id, "run": row.run, "seq": row.seq, "log_ns": row.log_ns,
            "received_ns": now_ns, "data": row.data,
        }  # fmt: skip
    return list(found.values())


def write_statuses(connection: Connection, values: Sequence[dict[str, Any]]) -> None:
    """Write statuses; of two for one component and mode, the later in the record is kept."""
    upsert_rows(connection, STATUS, values, _CHANGE, when=_is_newer)


def current_statuses(connection: Connection, robot: str) -> list[dict[str, Any]]:
    """Return the newest statuses of a robot as they were written, in the order of components."""
    wanted = select(STATUS).where(STATUS.c.robot == robot).order_by(*STATUS.primary_key.columns)
    return [
        {**msgspec.json.decode(row.data), "received_ns": row.received_ns, "log_ns": row.log_ns}
        for row in connection.execute(wanted)
    ]


def _is_newer(new: Excluded) -> Any:
    """Compare positions, not times: a robot's clock may not have been set."""
    shown = STATUS.c
    later = and_(new.run == shown.run, new.seq >= shown.seq)
    return or_(new.store_id != shown.store_id, new.run > shown.run, later)


KeyState = Literal["pending", "confirmed", "refused"]


@dataclass(frozen=True, slots=True)
class NewSigningKey:
    """A signing key other than the robot's earlier ones; ``first_seen_ns``: first arrival."""

    robot: str
    store_id: str
    public_key: str
    first_seen_ns: int
    state: KeyState


def waiting_reason(public_key: str) -> str:
    """Return the reason why a journal is set aside whose signing key is not confirmed."""
    return f"it is signed with another key than before, which waits for an admin: {public_key}"


def admit_key(
    connection: Connection, robot: str, store_id: str, public_key: str, now_ns: int
) -> bool:
    """Return whether a key may be used for a store; a new one is logged once, and waits."""
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
        log_event(connection, robot, now_ns, "new_key", text)
    return False


def key_state(connection: Connection, robot: str, public_key: str) -> KeyState | None:
    """Return the state of a key that replaced another; None for any other key."""
    found = _state(connection, robot, public_key)
    return next((state for state in ("refused", "confirmed", "pending") if state in found), None)


def pending_keys(connection: Connection, robot: str = "") -> list[NewSigningKey]:
    """Return the keys that wait for an admin, of all robots without a name."""
    chosen = select(SIGNING_KEY).where(SIGNING_KEY.c.state == "pending")
    chosen = chosen.where(SIGNING_KEY.c.robot == robot) if robot else chosen
    rows = connection.execute(chosen.order_by(SIGNING_KEY.c.robot, SIGNING_KEY.c.first_seen_ns))
    return [NewSigningKey(*row) for row in rows]


def distrusted_stores(connection: Connection) -> dict[tuple[str, str], KeyState]:
    """Return the stores, with their robot, whose signing key no admin has confirmed."""
    chosen = select(SIGNING_KEY.c.robot, SIGNING_KEY.c.store_id, SIGNING_KEY.c.state)
    rows = connection.execute(chosen.where(SIGNING_KEY.c.state != "confirmed"))
    return {(row.robot, row.store_id): row.state for row in rows}


def decide(
    connection: Connection, now_ns: int, robot: str, public_key: str, *, confirm: bool
) -> int:
    """Confirm or refuse a waiting key; return how many journals were concerned.

    After confirmation they count as verified, and the archive takes them over. Raises UsageError
    when no such key waits.
    """
    waiting = [key for key in pending_keys(connection, robot) if key.public_key == public_key]
    if not waiting:
        what = f"no key {public_key} of {robot} waits for a decision"
        raise UsageError(what, "the keys that wait are shown at /admin/robots")
    state: KeyState = "confirmed" if confirm else "refused"
    changed = update(SIGNING_KEY).where(_of(robot, public_key)).values(state=state)
    connection.execute(changed)
    log_event(connection, robot, now_ns, f"key_{state}", f"the key was {state}: {public_key}")
    if confirm:
        stores = and_(STORE.c.robot == robot, STORE.c.store_id.in_(k.store_id for k in waiting))
        connection.execute(update(STORE).where(stores).values(public_key=public_key))
    return _settle(connection, robot, public_key, confirm=confirm)


def is_other_history(
    connection: Connection, keys: tuple[str, str, str, str], held: tuple[str, int, int, int]
) -> bool:
    """Return whether the record of a store has other content for these rows or this journal name.

    ``keys`` are robot, store, journal and its SHA-256; the same bytes are no conflict. ``held`` are
    the journal's writer, run, first row number and end (exclusive).
    """
    table, (writer, run, first_seq, end_seq) = UPLOAD.c, held
    record = and_(
        table.robot == keys[0], table.store_id == keys[1], table.state == "verified",
        table.sha256 != keys[3],
    )  # fmt: skip
    other = and_(
        table.writer == writer, table.run == run,
        table.first_seq < max(end_seq, first_seq + 1), table.end_seq > first_seq,
    )  # fmt: skip
    wanted = select(table.journal).where(record, other | (table.journal == keys[2])).limit(1)
    return connection.execute(wanted).first() is not None


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
