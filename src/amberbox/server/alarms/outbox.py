"""Notifications: an outbox written in the transaction of the alarm, delivered by mail or HTTP.

Messages about one alarm are delivered in order; each carries a key that stays the same at every
attempt. Destinations that ask for it also get messages when the alarm is acknowledged or resolved,
in the same thread.
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
import json
import secrets
import smtplib
import ssl
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.message import EmailMessage
from email.utils import format_datetime
from typing import Any, Final, Literal, TypeAlias
from urllib.parse import urlsplit

from sqlalchemy import (
    ColumnElement,
    Connection,
    RowMapping,
    and_,
    delete,
    exists,
    func,
    or_,
    select,
    update,
)

from amberbox.core.clock import NS, Clock
from amberbox.core.safe_text import one_line
from amberbox.core.timestamps import format_time, format_to_second
from amberbox.server.alarms.alarm import Alarm, is_worse, rank_of
from amberbox.server.alarms.recipients import (
    LOST_HINT,
    NAME,
    Destination,
    Email,
    Notifications,
    Smtp,
    Webhook,
)
from amberbox.server.database import ServerDatabase, upsert
from amberbox.server.schema import CHANGED, OUTBOX
from amberbox.server.settings import LOST, read

VERSION: Final = 1
"""Version of the messages to programs: increases when a field changes its meaning, not for new
fields.
"""

Event: TypeAlias = Literal["opened", "acknowledged", "resolved"]
"""The event that a message is about; ``opened`` also when it got worse or came back."""


@dataclass(frozen=True, slots=True)
class NotificationMessage:
    """A message to one destination; ``key`` is the same at every attempt to deliver it.

    ``thread`` is the key of the first message about the same alarm to the same destination.
    """

    key: str
    subject: str
    body: str
    data: dict[str, Any] = field(default_factory=dict)
    thread: str = ""


def subject_of(alarm: Alarm, event: Event = "opened") -> str:
    """Return the subject of a message: ``critical: ropod_001 laser``, with the event before it."""
    whose = alarm.robot or "several robots:"
    what = "" if event == "opened" else f"{event}: "
    return one_line(f"{what}{alarm.severity}: {whose} {alarm.origin}")[:200]


def body_of(alarm: Alarm, url: str, now_ns: int, event: Event = "opened") -> str:
    """Return the text of a message about an alarm."""
    lasts = "it lasts" if alarm.active else "it has ended meanwhile"
    lines = [
        subject_of(alarm, event),
        *_became(alarm, event),
        one_line(alarm.reason),
        *([f"cause: {one_line(alarm.cause)}"] if alarm.cause else []),
        f"since {format_to_second(alarm.opened_ns)}, {lasts}",
        *([f"it came {alarm.count} times"] if alarm.count > 1 else []),
        *(["the robot was offline when it happened"] if alarm.late else []),
        *([f"{url}/alarms/{alarm.number}"] if url else []),
    ]
    return "\n".join(lines)


def _became(alarm: Alarm, event: Event) -> list[str]:
    """Return a line on who acknowledged or resolved an alarm, when and why; none if opened."""
    if event == "opened":
        return []
    by, at_ns = _who_and_when(alarm, event)
    who = f" by {by}" if by else ""
    why = f": {alarm.resolution}" if event == "resolved" and by and alarm.resolution else ""
    return [one_line(f"{event}{who} {format_to_second(at_ns or 0)}{why}")]


def _who_and_when(alarm: Alarm, event: Event) -> tuple[str, int | None]:
    if event == "acknowledged":
        return alarm.acknowledged_by, alarm.acknowledged_ns
    if event == "resolved":
        return alarm.resolved_by, alarm.resolved_ns
    return "", alarm.opened_ns


def data_of(
    alarm: Alarm, robots: Sequence[str], url: str, event: Event = "opened"
) -> dict[str, Any]:
    """Return an alarm as the JSON object that webhooks receive."""
    by, at_ns = _who_and_when(alarm, event)
    return {
        "type": "alarm",
        "version": VERSION,
        "event": event,
        "at": None if at_ns is None else format_time(at_ns),
        "by": by,
        "resolution": alarm.resolution,
        "merged_into": alarm.merged_into,
        "id": alarm.number,
        "robots": list(robots),
        "origin": alarm.origin,
        "severity": alarm.severity,
        "state": alarm.state,
        "active": alarm.active,
        "reason": alarm.reason,
        "cause": alarm.cause,
        "opened": format_time(alarm.opened_ns),
        "count": alarm.count,
        "url": f"{url}/alarms/{alarm.number}" if url else "",
    }


TRIES: Final = 12
"""Number of attempts after which a message counts as failed: about ten hours."""
_FIRST_NS = 15 * NS
_LONGEST_NS = 3600 * NS
_GATHER_NS = 60 * NS
_LISTED = 200


@dataclass(frozen=True, slots=True)
class AlarmNotice:
    """An alarm to be notified, and its robots with their groups."""

    alarm: Alarm
    robots: dict[str, frozenset[str]]


@dataclass(frozen=True, slots=True)
class DestinationNotice:
    """The event of an alarm for one destination, with the robots that it may see."""

    alarm: Alarm
    robots: Sequence[str]
    event: Event = "opened"


def queue_alarm(
    connection: Connection, notice: AlarmNotice, now_ns: int, setting: Notifications, url: str
) -> int:
    """Add a message about an alarm to the outbox per destination that wants it; return how many."""
    wanted = [(one, names) for one in setting.destinations() if (names := _seen(one, notice))]
    for one, names in wanted:
        queue_message(connection, one, DestinationNotice(notice.alarm, names), now_ns, setting, url)
    return len(wanted)


def _seen(one: Destination, notice: AlarmNotice) -> list[str]:
    """Return the robots of an alarm that a destination is to be notified about."""
    if is_worse(one.least, notice.alarm.severity):
        return []
    groups = frozenset(one.groups)
    return [name for name, of in sorted(notice.robots.items()) if not groups or groups & of]


def queue_message(
    connection: Connection,
    one: Destination,
    notice: DestinationNotice,
    now_ns: int,
    setting: Notifications,
    url: str,
) -> None:
    """Add one message to the outbox; hold it in quiet hours, and when there are many."""
    alarm = notice.alarm
    quiet_ns = None if one.quiet is None else one.quiet.until_ns(now_ns)
    if quiet_ns is not None and one.quiet and not is_worse(one.quiet.but, alarm.severity):
        quiet_ns = None
    many = _recent(connection, one.name, now_ns, setting) >= setting.digest_above
    behind = notice.event != "opened" and _is_held(connection, one.name, alarm.number)
    held = quiet_ns is not None or many or behind
    key = secrets.token_hex(16)
    data = data_of(alarm, notice.robots, url, notice.event)
    data["dedup_key"] = _first_key(connection, one.name, alarm.number) or key
    connection.execute(OUTBOX.insert(), [{
        "key": key, "destination": one.name,
        "kind": "alarm" if notice.event == "opened" else notice.event,
        "alarm": alarm.number, "severity": alarm.severity, "state": "held" if held else "waiting",
        "subject": subject_of(alarm, notice.event),
        "body": body_of(alarm, url, now_ns, notice.event),
        "data": json.dumps(data), "created_ns": now_ns,
        "due_ns": quiet_ns or now_ns + (_GATHER_NS if many else 0), "tries": 0, "trouble": "",
        "sent_ns": None,
    }])  # fmt: skip


def _first_key(connection: Connection, destination: str, number: int) -> str:
    """Return the key of the first message about an alarm to a destination, empty for none.

    Later messages carry it too, so that receivers can group them.
    """
    chosen = (
        select(OUTBOX.c.key)
        .where(OUTBOX.c.alarm == number, OUTBOX.c.destination == destination)
        .order_by(OUTBOX.c.number)
        .limit(1)
    )
    return str(connection.execute(chosen).scalar() or "")


def _is_held(connection: Connection, destination: str, number: int) -> bool:
    """Return whether a message about an alarm is held for a digest: later ones are held too."""
    chosen = select(OUTBOX.c.number).where(
        OUTBOX.c.alarm == number, OUTBOX.c.destination == destination, OUTBOX.c.state == "held"
    )
    return connection.execute(chosen.limit(1)).first() is not None


def _recent(connection: Connection, destination: str, now_ns: int, setting: Notifications) -> int:
    """Count the messages to a destination in the last ``digest_s`` seconds, digests not counted."""
    since_ns = now_ns - round(setting.digest_s * NS)
    chosen = select(func.count()).where(
        OUTBOX.c.destination == destination, OUTBOX.c.created_ns > since_ns,
        OUTBOX.c.kind != "digest",
    )  # fmt: skip
    return int(connection.execute(chosen).scalar_one())


def gather(connection: Connection, now_ns: int, setting: Notifications) -> int:
    """Combine the held messages that are due into one digest per destination; return how many."""
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


def is_digest_due(connection: Connection, now_ns: int) -> bool:
    """Return whether a held message is due."""
    chosen = select(OUTBOX.c.number).where(OUTBOX.c.state == "held", OUTBOX.c.due_ns <= now_ns)
    return connection.execute(chosen.limit(1)).first() is not None


def _last_digest_ns(connection: Connection, destination: str) -> int:
    chosen = select(func.max(OUTBOX.c.created_ns)).where(
        OUTBOX.c.destination == destination, OUTBOX.c.kind == "digest"
    )
    return int(connection.execute(chosen).scalar() or 0)


def _digest(destination: str, rows: Sequence[RowMapping], now_ns: int) -> dict[str, Any]:
    ends = {row["alarm"]: row["number"] for row in rows if row["kind"] != "alarm"}
    rows = [row for row in rows if row["number"] >= ends.get(row["alarm"], 0)]  # drop outdated ones
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
    """Return up to ``most`` messages that are due for delivery, oldest first."""
    chosen = (
        select(OUTBOX)
        .where(OUTBOX.c.state == "waiting", _is_due(now_ns), ~_is_behind())
        .order_by(OUTBOX.c.due_ns, OUTBOX.c.number)
        .limit(most)
    )
    return list(connection.execute(chosen).mappings())


def _is_behind() -> ColumnElement[bool]:
    """Return the condition that an earlier message about the same alarm is not delivered yet."""
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


def drop_undelivered(connection: Connection) -> None:
    """Mark follow-ups as failed if the messages about the alarm itself failed."""
    first = OUTBOX.alias()
    notified = exists().where(
        first.c.alarm == OUTBOX.c.alarm, first.c.destination == OUTBOX.c.destination,
        first.c.kind == "alarm", first.c.state != "failed",
    )  # fmt: skip
    follows = OUTBOX.c.kind.in_(("acknowledged", "resolved"))
    gone = update(OUTBOX).where(OUTBOX.c.state.in_(("waiting", "held")), follows, ~notified)
    connection.execute(gone.values(state="failed", trouble="the alarm itself did not arrive"))


def _is_due(now_ns: int) -> ColumnElement[bool]:
    """Return the condition for a due message.

    A time too far ahead was set by a wrong clock and counts as due.
    """
    return or_(OUTBOX.c.due_ns <= now_ns, OUTBOX.c.due_ns > now_ns + 2 * _LONGEST_NS)


def message_of(row: RowMapping) -> NotificationMessage:
    """Return the message of a row of the outbox."""
    data = json.loads(row["data"])
    return NotificationMessage(
        row["key"], row["subject"], row["body"], data, data.get("dedup_key", "")
    )


def note_delivered(connection: Connection, numbers: Iterable[int], now_ns: int) -> None:
    """Mark messages as delivered."""
    done = update(OUTBOX).where(OUTBOX.c.number.in_(list(numbers)))
    connection.execute(done.values(state="sent", sent_ns=now_ns, trouble=""))


def note_failed(
    connection: Connection, row: RowMapping, now_ns: int, trouble: str, *, final: bool = False
) -> None:
    """Record a failed delivery: it is repeated after a wait that doubles up to one hour.

    After ``TRIES`` attempts, or if ``final``, the message is marked as failed.
    """
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


_AT_ONCE: Final = 50
FindAlarm: TypeAlias = Callable[[int], "Alarm | None"]


@dataclass(frozen=True, slots=True)
class _Thread:
    """Messages of one alarm to one destination, without failed ones."""

    rows: Sequence[RowMapping]

    @property
    def last(self) -> Literal["", "alarm", "acknowledged", "resolved"]:
        """The kind of the last message; empty if there was none."""
        kind: Literal["", "alarm", "acknowledged", "resolved"]
        kind = self.rows[-1]["kind"] if self.rows else ""
        return kind

    @property
    def robots(self) -> list[str]:
        """The robots named in the last message."""
        return list(json.loads(self.rows[-1]["data"])["robots"])

    @property
    def has_flapped(self) -> bool:
        """Whether a message that it is resolved was sent before."""
        return any(row["kind"] == "resolved" for row in self.rows)


def note_change(connection: Connection, before: Alarm, after: Alarm) -> None:
    """Record, in the transaction of the change, that the state of a notified alarm changed."""
    if after.state != before.state and (before.told or after.told):
        _look(connection, after.number, 0)


def is_followup_due(connection: Connection, now_ns: int) -> bool:
    """Return whether a recorded change of an alarm is due for follow-up messages."""
    chosen = select(CHANGED.c.alarm).where(CHANGED.c.due_ns <= now_ns).limit(1)
    return connection.execute(chosen).first() is not None


def follow_up(
    connection: Connection,
    find: FindAlarm,
    now_ns: int,
    stays_ns: int,
    setting: Notifications,
    url: str,
) -> None:
    """Add messages about changed alarms to the outbox, for destinations that ask for them.

    For an alarm that was resolved, came back and was resolved again automatically, the message is
    sent when it has stayed resolved for ``stays_ns``.
    """
    chosen = select(CHANGED.c.alarm).where(CHANGED.c.due_ns <= now_ns).order_by(CHANGED.c.alarm)
    for number in connection.execute(chosen.limit(_AT_ONCE)).scalars().all():
        connection.execute(delete(CHANGED).where(CHANGED.c.alarm == number))
        alarm = find(number)
        if alarm is None:
            continue
        for to in (one for one in setting.destinations() if one.also):
            thread = _thread(connection, to.name, number)
            wait_ns = _wait_ns(alarm, thread, stays_ns)
            if wait_ns > now_ns:
                _look(connection, number, wait_ns)
                continue
            for about, event, robots in _due_messages(connection, find, to, alarm, thread):
                queue_message(
                    connection, to, DestinationNotice(about, robots, event), now_ns, setting, url
                )


def _look(connection: Connection, number: int, due_ns: int) -> None:
    statement = upsert(connection.dialect, CHANGED, ("alarm",), ("due_ns",))
    connection.execute(statement, [{"alarm": number, "due_ns": due_ns}])


def _thread(connection: Connection, destination: str, number: int) -> _Thread:
    chosen = (
        select(OUTBOX)
        .where(
            OUTBOX.c.alarm == number,
            OUTBOX.c.destination == destination,
            OUTBOX.c.state != "failed",
        )
        .order_by(OUTBOX.c.number)
    )
    return _Thread(connection.execute(chosen).mappings().all())


def _wait_ns(alarm: Alarm, thread: _Thread, stays_ns: int) -> int:
    """Return until when (ns) messages of a flapping alarm are held back; 0 for any other."""
    by_itself = alarm.state == "resolved" and not alarm.resolved_by and alarm.merged_into is None
    if not (by_itself and thread.has_flapped) or thread.last == "resolved":
        return 0
    return (alarm.resolved_ns or 0) + stays_ns


def _due_messages(
    connection: Connection, find: FindAlarm, to: Destination, alarm: Alarm, thread: _Thread
) -> Iterator[tuple[Alarm, Event, list[str]]]:
    """Yield the messages due to a destination, in order: alarm, event, robots."""
    if not thread.rows:
        return
    robots = thread.robots
    if alarm.state == "resolved" and "resolved" in to.also and thread.last != "resolved":
        keep = find(alarm.merged_into) if alarm.merged_into is not None else None
        lasts = keep is not None and keep.state != "resolved"
        if keep is not None and lasts and not _thread(connection, to.name, keep.number).rows:
            yield keep, "opened", robots  # it would seem over to the receiver
        yield alarm, "resolved", robots
    if alarm.state in ("open", "acknowledged") and thread.last == "resolved":
        yield alarm, "opened", robots
    is_acknowledged = alarm.state == "acknowledged" and thread.last != "acknowledged"
    if is_acknowledged and "acknowledged" in to.also:
        yield alarm, "acknowledged", robots


TIMEOUT_S: Final = 10.0
SIGNATURE: Final = "Amberbox-Signature"
DELIVERY: Final = "Amberbox-Delivery"

Deliver: TypeAlias = Callable[[Destination, NotificationMessage, Notifications, int], str]
"""Delivers a message; returns the error, empty if there was none."""


def deliver(
    to: Destination, message: NotificationMessage, setting: Notifications, now_ns: int
) -> str:
    """Deliver a message; return the error in one line, empty if it was delivered."""
    try:
        if LOST in (to.secret if isinstance(to, Webhook) else "", _password(to, setting)):
            return f"its secret cannot be read: {LOST_HINT}"
        if isinstance(to, Webhook):
            return _post(to, message, now_ns)
        if setting.smtp is None:
            return "there is no mail server in the settings"
        return _mail(to, message, setting.smtp, now_ns)
    except (OSError, ValueError, smtplib.SMTPException, http.client.HTTPException) as error:
        # an invalid host name raises ValueError
        return one_line(f"{type(error).__name__}: {error}")[:500]


def _password(to: Destination, setting: Notifications) -> str:
    return "" if setting.smtp is None or isinstance(to, Webhook) else setting.smtp.password


def _mail(to: Email, message: NotificationMessage, smtp: Smtp, now_ns: int) -> str:
    context = ssl.create_default_context()
    kind = "tls" if smtp.security == "tls" else ""
    server: smtplib.SMTP
    if kind:
        server = smtplib.SMTP_SSL(smtp.host, smtp.port, timeout=TIMEOUT_S, context=context)
    else:
        server = smtplib.SMTP(smtp.host, smtp.port, timeout=TIMEOUT_S)
    with server:
        if smtp.security == "starttls":
            server.starttls(context=context)
        if smtp.user:
            server.login(smtp.user, smtp.password)
        refused = server.send_message(_email(to, message, smtp, now_ns), smtp.sender, to.to)
    return f"refused: {', '.join(refused)}" if refused else ""


def _email(to: Email, message: NotificationMessage, smtp: Smtp, now_ns: int) -> EmailMessage:
    mail = EmailMessage()
    mail["Subject"] = one_line(f"[amberbox] {message.subject}")
    mail["From"] = smtp.sender
    mail["To"] = ", ".join(to.to)
    mail["Date"] = format_datetime(datetime.fromtimestamp(now_ns // NS, UTC))
    mail["Message-ID"] = f"<{message.key}@amberbox.invalid>"
    if message.thread and message.thread != message.key:
        mail["In-Reply-To"] = mail["References"] = f"<{message.thread}@amberbox.invalid>"
    mail["Auto-Submitted"] = "auto-generated"
    mail.set_content(message.body + "\n")
    return mail


def _post(to: Webhook, message: NotificationMessage, now_ns: int) -> str:
    """Post JSON to a webhook; a redirect is an error because its target is not in the settings."""
    body = json.dumps({"delivery": message.key, "subject": message.subject, **message.data})
    data = body.encode()
    parts = urlsplit(to.url)
    path = parts._replace(scheme="", netloc="").geturl() or "/"
    headers = {
        "Content-Type": "application/json",
        "User-Agent": "amberbox",
        DELIVERY: message.key,
        SIGNATURE: signature(to.secret, now_ns // NS, data),
    }
    connection = _connection(parts.scheme, parts.hostname or "", parts.port)
    try:
        connection.request("POST", path, data, headers)
        answer = connection.getresponse()
    finally:
        connection.close()
    if 200 <= answer.status < 300:
        return ""
    more = ": redirects are not followed" if 300 <= answer.status < 400 else ""
    return f"the answer was {answer.status}{more}"


def _connection(scheme: str, host: str, port: int | None) -> http.client.HTTPConnection:
    if scheme == "https":
        context = ssl.create_default_context()
        return http.client.HTTPSConnection(host, port, timeout=TIMEOUT_S, context=context)
    return http.client.HTTPConnection(host, port, timeout=TIMEOUT_S)


def signature(secret: str, at_s: int, body: bytes) -> str:
    """Return the signature header of a body and its time: HMAC-SHA256 of ``{at_s}.{body}``."""
    signed = hmac.new(secret.encode(), f"{at_s}.".encode() + body, hashlib.sha256).hexdigest()
    return f"t={at_s},v1={signed}"


_DESTINATIONS_AT_ONCE = 4


@dataclass(slots=True, eq=False)
class NotificationSender:
    """Delivers the messages of the outbox; failed ones are tried again later."""

    database: ServerDatabase
    clock: Clock
    deliver: Deliver = deliver
    _stepping: threading.Lock = field(default_factory=threading.Lock)
    _closed: bool = False
    _pool: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(_DESTINATIONS_AT_ONCE, "notifying")
    )

    def step(self) -> int:
        """Deliver the messages that are due; return how many were delivered."""
        with self._stepping:
            return 0 if self._closed else self._step()

    def _step(self) -> int:
        now_ns = self.clock.wall_ns()
        with self.database.reading() as connection:
            setting = read(connection, NAME, Notifications)
            waiting = due(connection, now_ns)
            if not waiting and not is_digest_due(connection, now_ns):
                return 0
        with self.database.begin() as connection:
            drop_undelivered(connection)
            gather(connection, now_ns, setting)
            waiting = due(connection, now_ns)
        of: dict[str, list[RowMapping]] = {}
        for row in waiting:
            of.setdefault(row["destination"], []).append(row)
        work = [self._pool.submit(self._to, name, rows, setting) for name, rows in of.items()]
        return sum(one.result() for one in work)

    def _to(self, name: str, rows: Sequence[RowMapping], setting: Notifications) -> int:
        """Deliver the messages of one destination up to the first that fails; return how many."""
        to = setting.destination(name)
        for number, row in enumerate(rows):
            if trouble := self._one(to, row, setting):
                self._note(rows[number:], trouble, final=to is None)
                return number
        return len(rows)

    def _one(self, to: Destination | None, row: RowMapping, setting: Notifications) -> str:
        if to is None:
            return "this destination is not in the settings any more"
        trouble = self.deliver(to, message_of(row), setting, self.clock.wall_ns())
        if not trouble:
            with self.database.begin() as connection:
                note_delivered(connection, [row["number"]], self.clock.wall_ns())
        return trouble

    def _note(self, rows: Sequence[RowMapping], trouble: str, *, final: bool) -> None:
        with self.database.begin() as connection:
            for row in rows:
                note_failed(connection, row, self.clock.wall_ns(), trouble, final=final)

    def close(self) -> None:
        """Wait for deliveries under way, then stop."""
        with self._stepping:
            self._closed = True
        self._pool.shutdown()
