"""What can be done on the server, and what it takes: the table that every request is judged by.

What does not stand here cannot be done by anybody.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


class Role(StrEnum):
    """What a person may do; each role may do all that the ones before it may."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    TECHNICIAN = "technician"
    ADMIN = "admin"

    def covers(self, least: Role) -> bool:
        """Tell whether this role is the one asked for, or a higher one."""
        order = list(Role)
        return order.index(self) >= order.index(least)


SCOPES: Mapping[str, str] = {
    "read:status": "see robots, their statuses and live values",
    "read:data": "list and query data items, events, missions and incidents",
    "read:download": "download recordings and large extracts",
    "read:alarms": "see alarms",
    "read:diagnoses": "see diagnoses",
    "read:metrics": "read the server's own figures",
    "read:audit": "read the audit log",
    "write:alarms": "acknowledge, shelve, own, annotate and resolve alarms",
    "write:diagnoses": "ask for diagnoses and answer their tests",
    "write:incidents": "mark incidents",
    "write:missions": "begin and end missions",
    "write:fetch": "ask a robot for a window of its data",
}
"""What a token can be given. Accounts, keys and settings are for people only."""

Reach = Literal["robot", "server", "own"]


@dataclass(frozen=True, slots=True)
class Action:
    """What an action takes.

    ``role`` is the least role of a person, ``scope`` what a token needs besides; None is: never.
    ``reach`` is what it touches: ``robot`` one robot (or, where none is named, all of them),
    ``server`` everybody (not for those who are restricted to groups), ``own`` one's own account.
    With ``robots`` a robot may do it, to itself. With ``first`` also a person who has to change the
    password first.
    """

    role: Role | None
    scope: str | None = None
    reach: Reach = "robot"
    robots: bool = False
    first: bool = False


ACTIONS: Mapping[str, Action] = {
    "status.read": Action(Role.VIEWER, "read:status"),
    "items.read": Action(Role.VIEWER, "read:data"),
    "data.query": Action(Role.VIEWER, "read:data"),
    "data.download": Action(Role.TECHNICIAN, "read:download"),
    "data.fetch": Action(Role.TECHNICIAN, "write:fetch"),
    "alarms.read": Action(Role.VIEWER, "read:alarms"),
    "alarms.write": Action(Role.OPERATOR, "write:alarms"),
    "incidents.read": Action(Role.VIEWER, "read:data"),
    "incidents.write": Action(Role.OPERATOR, "write:incidents"),
    "missions.read": Action(Role.VIEWER, "read:data"),
    "missions.write": Action(Role.OPERATOR, "write:missions"),
    "diagnoses.read": Action(Role.VIEWER, "read:diagnoses"),
    "diagnoses.write": Action(Role.OPERATOR, "write:diagnoses"),
    "demo.break": Action(Role.VIEWER),
    "folder.read": Action(Role.TECHNICIAN),
    "robots.write": Action(Role.ADMIN, reach="server"),
    "retention.write": Action(Role.ADMIN, reach="server"),
    "users.read": Action(Role.ADMIN, reach="server"),
    "users.write": Action(Role.ADMIN, reach="server"),
    "settings.write": Action(Role.ADMIN, reach="server"),
    "audit.read": Action(Role.ADMIN, "read:audit", reach="server"),
    "metrics.read": Action(Role.TECHNICIAN, "read:metrics", reach="server"),
    "own.read": Action(Role.VIEWER, reach="own", first=True),
    "own.write": Action(Role.VIEWER, reach="own", first=True),
    "own.tokens": Action(Role.TECHNICIAN, reach="own"),
    "link.connect": Action(None, robots=True),
    "journals.upload": Action(None, robots=True),
}
