"""Put messages into the outbox, in the transaction of the alarm they speak of; and take them out.

A message that was put in is delivered once it can be, whatever happens to the server meanwhile.
Only a crash between a delivery and the note of it repeats one, with the same key.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import (
    ColumnElement,
    Connection,
    RowMapping,
    and_,
    exists,
    func,
    or_,
    select,
    update,
)

from amberbox.core.clock import NS
from amberbox.fleet.alarms.alarm import Alarm, is_worse, rank_of
from amberbox.fleet.notifying.message import Event, Message, body_of, data_of, subject_of
from amberbox.fleet.notifying.settings import Destination, Notifications
from amberbox.fleet.notifying.tables import OUTBOX

TRIES: Final = 12
"""After so many attempts a message counts as failed: that is about ten hours."""
_FIRST_NS = 15 * NS
_LONGEST_NS = 3600 * NS
_GATHER_NS = 60 * NS
_LISTED = 200


@dataclass(frozen=True, slots=True)
class Told:
    """An alarm that somebody is to be told of, and its robots with their groups."""

    alarm: Alarm
    robots: dict[str, frozenset[str]]


@dataclass(frozen=True, slots=True)
class Telling:
    """What one destination is told of an alarm, and of which of its robots."""

    alarm: Alarm
    robots: Sequence[str]
    event: Event = "opened"


def put(connection: Connection, told: Told, now_ns: int, setting: Notifications, url: str) -> int:
    """Put a message about an alarm into the outbox for each who wants it; return how many."""
    wanted = [(one, names) for one in setting.destinations() if (names := _seen(one, told))]
    for one, names in wanted:
        enter(connection, one, Telling(told.alarm, names), now_ns, setting, url)
    return len(wanted)


def _seen(one: Destination, told: Told) -> list[str]:
    """Return the robots of an alarm that a destination is to hear of."""
    if is_worse(one.least, told.alarm.severity):
        return []
    groups = frozenset(one.groups)
    return [name for name, of in sorted(told.robots.items()) if not groups or groups & of]


def enter(
    connection: Connection,
    one: Destination,
    told: Telling,
    now_ns: int,
    setting: Notifications,
    url: str,
) -> None:
    """Put one message into the outbox; it is held in quiet hours, and when there are many."""
    alarm = told.alarm
    quiet_ns = None if one.quiet is None else one.quiet.until_ns(now_ns)
    if quiet_ns is not None and one.quiet and not is_worse(one.quiet.but, alarm.severity):
        quiet_ns = None
    many = _recent(connection, one.name, now_ns, setting) >= setting.digest_above
    behind = told.event != "opened" and _is_held(connection, one.name, alarm.number)
    held = quiet_ns is not None or many or behind
    key = secrets.token_hex(16)
    data = data_of(alarm, told.robots, url, told.event)
    data["dedup_key"] = _first_key(connection, one.name, alarm.number) or key
    connection.execute(OUTBOX.insert(), [{
        "key": key, "destination": one.name,
        "kind": "alarm" if told.event == "opened" else told.event,
        "alarm": alarm.number, "severity": alarm.severity, "state": "held" if held else "waiting",
        "subject": subject_of(alarm, told.event), "body": body_of(alarm, url, now_ns, told.event),
        "data": json.dumps(data), "created_ns": now_ns,
        "due_ns": quiet_ns or now_ns + (_GATHER_NS if many else 0), "tries": 0, "trouble": "",
        "sent_ns": None,
    }])  # fmt: skip


def _first_key(connection: Connection, destination: str, number: int) -> str:
    """Return the key of the first message about an alarm to a destination, empty for none.

    It stays when later messages follow, so receivers know by it what belongs together.
    """
    chosen = (
        select(OUTBOX.c.key)
        .where(OUTBOX.c.alarm == number, OUTBOX.c.destination == destination)
        .order_by(OUTBOX.c.number)
        .limit(1)
    )
    return str(connection.execute(chosen).scalar() or "")


def _is_held(connection: Connection, destination: str, number: int) -> bool:
    """Tell whether something about an alarm waits for a digest: what follows comes with it."""
    chosen = select(OUTBOX.c.number).where(
        OUTBOX.c.alarm == number, OUTBOX.c.destination == destination, OUTBOX.c.state == "held"
    )
    return connection.execute(chosen.limit(1)).first() is not None


def _recent(connection: Connection, destination: str, now_ns: int, setting: Notifications) -> int:
    """Count the messages that a destination got, or is to get, in the last while."""
    since_ns = now_ns - round(setting.digest_s * NS)
    chosen = select(func.count()).where(
        OUTBOX.c.destination == destination, OUTBOX.c.created_ns > since_ns,
        OUTBOX.c.kind != "digest",
    )  # fmt: skip
    return int(connection.execute(chosen).scalar_one())


def gather(connection: Connection, now_ns: int, setting: Notifications) -> int:
    """Make one message of those that are held and due, per destination; return how many."""
    chosen = (
        select(OUTBOX)
        .where(OUTBOX.c.state == "held", OUTBOX.c.due_ns <= now_ns + _GATHER_NS)
        .order_by(OUTBOX.c.number)
    )
    held: dict[str, list[RowMapping]] = {}
    for row in connection.execute(chosen).mappings():
        held.setdefault(row["destination"], []).append(row)
    made = 0
    for destination, rows in held.items():
        if min(row["due_ns"] for row in rows) > now_ns:
            continue
        if _last_digest_ns(connection, destination) > now_ns - round(setting.digest_s * NS):
            continue
        connection.execute(OUTBOX.insert(), [_digest(destination, rows, now_ns)])
        numbers = [row["number"] for row in rows]
        done = update(OUTBOX).where(OUTBOX.c.number.in_(numbers))
        connection.execute(done.values(state="digested"))
        made += 1
    return made


def held(connection: Connection, now_ns: int) -> bool:
    """Tell whether messages are held that are due."""
    chosen = select(OUTBOX.c.number).where(OUTBOX.c.state == "held", OUTBOX.c.due_ns <= now_ns)
    return connection.execute(chosen.limit(1)).first() is not None


def _last_digest_ns(connection: Connection, destination: str) -> int:
    chosen = select(func.max(OUTBOX.c.created_ns)).where(
        OUTBOX.c.destination == destination, OUTBOX.c.kind == "digest"
    )
    return int(connection.execute(chosen).scalar() or 0)


def _digest(destination: str, rows: Sequence[RowMapping], now_ns: int) -> dict[str, Any]:
    ends = {row["alarm"]: row["number"] for row in rows if row["kind"] != "alarm"}
    rows = [row for row in rows if row["number"] >= ends.get(row["alarm"], 0)]  # the last word
    shown = "\n\n".join(row["body"] for row in rows[:_LISTED])
    more = f"\n\nand {len(rows) - _LISTED} more" if len(rows) > _LISTED else ""
    alarms = [json.loads(row["data"]) for row in rows[:_LISTED]]
    last = max(rows, key=lambda row: rank_of(row["severity"]))
    return {
        "key": secrets.token_hex(16), "destination": destination, "kind": "digest", "alarm": 0,
        "severity": last["severity"], "state": "waiting",
        "subject": f"{len(rows)} alarm{'s' * (len(rows) > 1)}, up to {last['severity']}",
        "body": shown + more,
        "data": json.dumps({"type": "digest", "count": len(rows), "alarms": alarms}),
        "created_ns": now_ns, "due_ns": now_ns, "tries": 0, "trouble": "", "sent_ns": None,
    }  # fmt: skip


def due(connection: Connection, now_ns: int, most: int = 20) -> list[RowMapping]:
    """Return messages that are to be delivered now, oldest first."""
    chosen = (
        select(OUTBOX)
        .where(OUTBOX.c.state == "waiting", _is_due(now_ns), ~_is_behind())
        .order_by(OUTBOX.c.due_ns, OUTBOX.c.number)
        .limit(most)
    )
    return list(connection.execute(chosen).mappings())


def _is_behind() -> ColumnElement[bool]:
    """Judge whether an earlier message about the same alarm has to arrive first."""
    earlier, other = OUTBOX.alias(), OUTBOX.alias()
    in_digest = exists().where(
        other.c.alarm == OUTBOX.c.alarm, other.c.destination == OUTBOX.c.destination,
        other.c.state == "digested", other.c.number < earlier.c.number,
    )  # fmt: skip
    same = earlier.c.alarm == OUTBOX.c.alarm
    return exists().where(
        OUTBOX.c.kind != "digest", earlier.c.state == "waiting",
        earlier.c.destination == OUTBOX.c.destination, earlier.c.number < OUTBOX.c.number,
        or_(same, and_(earlier.c.kind == "digest", in_digest)),
    )  # fmt: skip


def drop_untold(connection: Connection) -> None:
    """Give up what became of alarms that their destination was never told of: that has failed."""
    first = OUTBOX.alias()
    told = exists().where(
        first.c.alarm == OUTBOX.c.alarm, first.c.destination == OUTBOX.c.destination,
        first.c.kind == "alarm", first.c.state != "failed",
    )  # fmt: skip
    follows = OUTBOX.c.kind.in_(("acknowledged", "resolved"))
    gone = update(OUTBOX).where(OUTBOX.c.state.in_(("waiting", "held")), follows, ~told)
    connection.execute(gone.values(state="failed", trouble="the alarm itself did not arrive"))


def _is_due(now_ns: int) -> ColumnElement[bool]:
    """Judge when a message is due; one so far off is of a clock that has been put right since."""
    return or_(OUTBOX.c.due_ns <= now_ns, OUTBOX.c.due_ns > now_ns + 2 * _LONGEST_NS)


def message_of(row: RowMapping) -> Message:
    """Return a message as it is delivered."""
    data = json.loads(row["data"])
    return Message(row["key"], row["subject"], row["body"], data, data.get("dedup_key", ""))


def delivered(connection: Connection, numbers: Iterable[int], now_ns: int) -> None:
    """Note that messages have arrived."""
    done = update(OUTBOX).where(OUTBOX.c.number.in_(list(numbers)))
    connection.execute(done.values(state="sent", sent_ns=now_ns, trouble=""))


def troubled(
    connection: Connection, row: RowMapping, now_ns: int, trouble: str, *, final: bool = False
) -> None:
    """Note that a message could not be delivered: it is tried again later, each time later."""
    tries = row["tries"] + 1
    failed = final or tries >= TRIES
    wait_ns = min(_FIRST_NS << min(row["tries"], 20), _LONGEST_NS)
    values = {"tries": tries, "trouble": trouble[:500], "due_ns": now_ns + wait_ns,
              "state": "failed" if failed else "waiting"}  # fmt: skip
    connection.execute(update(OUTBOX).where(OUTBOX.c.number == row["number"]).values(**values))
    if failed and row["kind"] == "digest":
        numbers = [one["id"] for one in json.loads(row["data"])["alarms"]]
        lost = update(OUTBOX).where(
            OUTBOX.c.destination == row["destination"], OUTBOX.c.alarm.in_(numbers),
            OUTBOX.c.state == "digested", OUTBOX.c.number < row["number"],
        )  # fmt: skip
        connection.execute(lost.values(state="failed", trouble="its digest did not arrive"))
