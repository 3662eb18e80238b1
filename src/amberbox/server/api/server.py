"""Routes of the server itself: health, metrics, settings, notifications, the retention clock,
teams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from fastapi import Body, HTTPException, Query, Request, Response
from pydantic import Field, StringConstraints

from amberbox.core.api import DiagnosisLine
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time, ns_of
from amberbox.server import settings, system
from amberbox.server.alarms.outbox import NotificationMessage
from amberbox.server.alarms.recipients import NAME, Notifications
from amberbox.server.archive.retention import SLACK_NS
from amberbox.server.http.auth import Fleet, Open, Routes, Who
from amberbox.server.http.forms import Form, Limit, Named
from amberbox.server.services import alarms, health
from amberbox.server.services import settings as setting_service
from amberbox.server.services.alarms import Notification, NotificationState
from amberbox.server.services.context import Caller
from amberbox.server.services.health import (
    CONTENT_TYPE,
    Health,
    ServerClock,
    SystemFolder,
    families,
    metrics_text,
    server_clock,
)
from amberbox.server.services.knowledge import diagnosis_line, revision_json
from amberbox.server.services.settings import (
    Setting,
    SettingDefinition,
    find_setting,
    mask_secrets,
    restore_secrets,
    setting_definitions,
    setting_line,
)
from amberbox.server.settings import read

health_routes = Routes("health")
clock_routes = Routes("health")


_BAD: dict[int | str, dict[str, Any]] = {503: {"model": Health, "description": "it does not"}}


@health_routes.get("/health", Open("for monitors of the server; says no more"), responses=_BAD)
def read_health(fleet: Fleet, response: Response) -> Health:
    """Return 200 if the server and its database answer, else 503.

    ``poor``: it answers, and needs somebody soon (the disk is nearly full, nothing is committed,
    files that robots copied are damaged, a jump of the clock is held).
    """
    found = health.read_health(fleet)
    if found.status == "bad":
        response.status_code = 503
    return found


metrics_routes = Routes("metrics")

_ABOUT: dict[int | str, dict[str, Any]] = {
    200: {"description": "samples", "content": {"text/plain": {"schema": {"type": "string"}}}}
}


@metrics_routes.get("/metrics", "metrics.read", responses=_ABOUT, response_class=Response)
def read_metrics(fleet: Fleet, request: Request) -> Response:
    """Return the figures of the server in Prometheus' text format."""
    state = request.app.state
    found = [*families(fleet, state.received), *state.requests.families()]
    return Response(metrics_text(found), media_type=CONTENT_TYPE)


class RightTime(Form):
    """What the server's clock says, as it was read: another jump meanwhile is not confirmed."""

    time: Annotated[str, Field(max_length=40)]


@clock_routes.get("/clock", "metrics.read")
def read_clock(fleet: Fleet) -> ServerClock:
    """Show the server's clock, and whether a jump of it is held."""
    return server_clock(fleet.archive.ages.read())


@clock_routes.post("/clock/confirm", "retention.write")
def confirm_clock(fleet: Fleet, who: Who, right: RightTime) -> ServerClock:
    """Confirm that the server's clock is right; what is too old by it is deleted from then on."""
    ages = fleet.archive.ages
    read_ns = ns_of(right.time)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        if abs(now_ns - read_ns) > SLACK_NS:
            raise HTTPException(409, f"the server's clock says {format_time(now_ns)} by now")
        held = ages.confirm(connection, str(who.principal))
        details = {"jump": held.jump, "by_s": round(held.ahead_ns / NS)}
        who.note(connection, now_ns, "clock.confirm", details=details)
    return server_clock(ages.read())


setting_routes = Routes("settings")

_MOST_BYTES = 200_000


@setting_routes.get("/settings", "settings.write")
def list_settings(fleet: Fleet) -> list[Setting]:
    """List all settings with their values; secrets in them are masked."""
    with fleet.database.reading() as connection:
        return [
            setting_line(connection, name, setting)
            for name, setting in setting_definitions().items()
        ]


@setting_routes.get("/settings/{name}", "settings.write")
def read_setting(fleet: Fleet, name: Named) -> Setting:
    """Show a setting; secrets in it are masked."""
    return setting_service.read_setting(fleet, name)


@setting_routes.put("/settings/{name}", "settings.write")
def change_setting(fleet: Fleet, who: Who, name: Named, value: Annotated[Any, Body()]) -> Setting:
    """Replace a setting by a value of its form; a masked secret stays as it is."""
    setting = find_setting(name)
    _refuse(who, setting, value)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        before = msgspec.to_builtins(settings.read(connection, name, setting.kind))
        new = settings.parsed(restore_secrets(value, before), setting.kind)
        setting.refuse(new)
        settings.write(connection, now_ns, name, new)
        details = {"before": mask_secrets(before), "after": mask_secrets(msgspec.to_builtins(new))}
        who.note(connection, now_ns, "settings.change", name, details=details)
        return setting_line(connection, name, setting)


def _refuse(who: Caller, setting: SettingDefinition, value: Any) -> None:
    if not who.may(setting.action):
        raise HTTPException(403, "you may not change this setting")
    try:
        size = len(msgspec.json.encode(value))
    except (UnicodeEncodeError, RecursionError, msgspec.MsgspecError, OverflowError) as error:
        raise UsageError("the setting has text or numbers that cannot be written") from error
    if size > _MOST_BYTES:
        raise UsageError("the setting is too long", f"at most {_MOST_BYTES:,} bytes")


notification_routes = Routes("settings")


class NotificationTest(Form):
    """The destination that is to be tried, by its name in the settings."""

    destination: Annotated[str, StringConstraints(min_length=1, max_length=64)]


@dataclass(frozen=True, slots=True)
class NotificationTried:
    """Whether the test has arrived; if not, why."""

    arrived: bool
    trouble: str


@notification_routes.get("/settings/notifications/messages", "settings.write")
def list_notifications(
    fleet: Fleet,
    state: NotificationState | None = None,
    alarm: Annotated[int, Query(ge=0, le=2**62, description="0: of all alarms")] = 0,
    after: Annotated[int, Query(ge=0, le=2**62, description="the last of the page before")] = 0,
    limit: Limit = 100,
) -> list[Notification]:
    """List messages that were sent, wait, or failed, the newest first."""
    return alarms.list_notifications(fleet, state, alarm, after, limit)


@notification_routes.post("/settings/notifications/test", "settings.write")
def try_notification(fleet: Fleet, who: Who, body: NotificationTest) -> NotificationTried:
    """Send a test to a destination of the settings, now, and tell whether it arrived."""
    now_ns = fleet.clock.wall_ns()
    with fleet.database.begin() as connection:
        setting = read(connection, NAME, Notifications)
        to = setting.destination(body.destination)
        if to is None:
            raise HTTPException(404, "no destination has this name in the settings")
        who.note(connection, now_ns, "notifications.test", body.destination)
    message = NotificationMessage(
        f"test-{now_ns}", "a test", "This is a test: notifications of alarms arrive here.",
        {"type": "test"},
    )  # fmt: skip
    trouble = fleet.alarms.sender.deliver(to, message, setting, now_ns)
    return NotificationTried(not trouble, trouble)


system_routes = Routes("system")


@dataclass(frozen=True, slots=True)
class SystemDiagnosis:
    """A diagnosis of a team or of the system; ``last`` is all of its last revision."""

    name: str
    diagnosis: DiagnosisLine
    last: dict[str, Any]


@system_routes.get("/system/status", "status.read")
def read_status(fleet: Fleet) -> list[SystemFolder]:
    """Return how teams and the system are, teams first; nothing if none is set up."""
    return health.read_system(fleet)


@system_routes.get("/system/diagnoses", "diagnoses.read")
def list_system_diagnoses(
    fleet: Fleet, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> list[SystemDiagnosis]:
    """List what is, or was, broken in teams and in the system, the newest of each first."""
    return [
        SystemDiagnosis(
            watched.place.name,
            diagnosis_line(known),
            revision_json(known.last),
        )
        for watched in fleet.system.watched()
        for known in system.diagnoses(watched.place.store)[:limit]
    ]
