"""Notifications: what became of them, and a test of one destination."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import HTTPException, Query
from pydantic import StringConstraints
from sqlalchemy import select

from amberbox.core.timetext import format_time
from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.fleet.api.forms import Form, Limit, shown
from amberbox.fleet.notifying.message import Message
from amberbox.fleet.notifying.settings import NAME, Notifications
from amberbox.fleet.notifying.tables import OUTBOX
from amberbox.fleet.options.options import read

routes = Routes("settings")

Fate = Literal["waiting", "held", "sent", "failed", "digested"]


@dataclass(frozen=True, slots=True)
class Notification:
    """A message to one destination; ``trouble`` is why it has not arrived, ``due`` when next.

    Those that are ``held`` come in one digest, after which they are ``digested``.
    """

    number: int
    destination: str
    kind: Literal["alarm", "acknowledged", "resolved", "digest"]
    alarm: int | None
    severity: str
    state: Fate
    subject: str
    created: str
    due: str
    tries: int
    trouble: str
    sent: str | None


class NotificationTest(Form):
    """The destination that is to be tried, by its name in the settings."""

    destination: Annotated[str, StringConstraints(min_length=1, max_length=64)]


@dataclass(frozen=True, slots=True)
class NotificationTried:
    """Whether the test has arrived; if not, why."""

    arrived: bool
    trouble: str


@routes.get("/settings/notifications/messages", "settings.write")
def list_notifications(
    fleet: Fleet,
    state: Fate | None = None,
    alarm: Annotated[int, Query(ge=0, le=2**62, description="0: of all alarms")] = 0,
    after: Annotated[int, Query(ge=0, le=2**62, description="the last of the page before")] = 0,
    limit: Limit = 100,
) -> list[Notification]:
    """List messages that were sent, wait, or failed, the newest first."""
    chosen = select(OUTBOX).order_by(OUTBOX.c.number.desc()).limit(limit)
    chosen = chosen.where(OUTBOX.c.state == state) if state else chosen
    chosen = chosen.where(OUTBOX.c.alarm == alarm) if alarm else chosen
    chosen = chosen.where(OUTBOX.c.number < after) if after else chosen
    with fleet.database.reading() as connection:
        return [
            Notification(
                row.number, row.destination, row.kind, row.alarm or None, row.severity, row.state,
                row.subject, format_time(row.created_ns), format_time(row.due_ns), row.tries,
                row.trouble, shown(row.sent_ns),
            )
            for row in connection.execute(chosen)
        ]  # fmt: skip


@routes.post("/settings/notifications/test", "settings.write")
def try_notification(fleet: Fleet, who: Who, body: NotificationTest) -> NotificationTried:
    """Send a test to a destination of the settings, now, and tell whether it arrived."""
    now_ns = fleet.clock.wall_ns()
    with fleet.database.begin() as connection:
        setting = read(connection, NAME, Notifications)
        to = setting.destination(body.destination)
        if to is None:
            raise HTTPException(404, "no destination has this name in the settings")
        who.note(connection, now_ns, "notifications.test", body.destination)
    message = Message(
        f"test-{now_ns}", "a test", "This is a test: notifications of alarms arrive here.",
        {"type": "test"},
    )  # fmt: skip
    trouble = fleet.alarms.sender.deliver(to, message, setting, now_ns)
    return NotificationTried(not trouble, trouble)
