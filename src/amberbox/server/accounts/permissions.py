"""Permissions: roles, scopes, actions, and ``allowed``, which decides. Denied by default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from amberbox.core.errors import did_you_mean


class Role(StrEnum):
    """What a person may do; each role may do all that the ones before it may."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    TECHNICIAN = "technician"
    ADMIN = "admin"

    def covers(self, least: Role) -> bool:
        """Return whether this role is ``least`` or a higher one."""
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
    "read:experiments": "see experiments, unit tests and their runs",
    "write:experiments": "upload experiments, and start runs",
    "step:experiments": "do steps of runs, note deviations, pause and abort",
    "write:fetch": "ask a robot for a window of its data",
    "write:models": "learn models of detectors from recordings, and delete them",
    "read:commands": "see commands to robots, and what robots can do",
    "write:commands": "send, sign, confirm and abort commands, hold robots, revoke keys",
}
"""Scopes that a token can have. Accounts, keys and settings are for people only."""

Reach = Literal["robot", "server", "own"]


@dataclass(frozen=True, slots=True)
class Action:
    """The requirements of an action.

    ``role`` is the least role of a person, ``scope`` the scope that a token needs in addition;
    None: never allowed. ``reach``: ``robot`` concerns one robot (or all of them if none is named),
    ``server`` everything (not for accounts restricted to groups), ``own`` one's own account. With
    ``robots`` a robot may do it, for itself. With ``first`` it is allowed before a required change
    of password.
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
    "models.read": Action(Role.VIEWER, "read:data"),
    "models.write": Action(Role.TECHNICIAN, "write:models"),
    "alarms.read": Action(Role.VIEWER, "read:alarms"),
    "alarms.write": Action(Role.OPERATOR, "write:alarms"),
    "incidents.read": Action(Role.VIEWER, "read:data"),
    "incidents.write": Action(Role.OPERATOR, "write:incidents"),
    "missions.read": Action(Role.VIEWER, "read:data"),
    "missions.write": Action(Role.OPERATOR, "write:missions"),
    "diagnoses.read": Action(Role.VIEWER, "read:diagnoses"),
    "diagnoses.write": Action(Role.OPERATOR, "write:diagnoses"),
    "commands.read": Action(Role.VIEWER, "read:commands"),
    "commands.write": Action(Role.TECHNICIAN, "write:commands"),
    "commands.confirm": Action(Role.OPERATOR, "write:commands"),
    "commands.abort": Action(Role.OPERATOR, "write:commands"),
    "keys.write": Action(Role.TECHNICIAN, "write:commands", reach="server"),
    "experiments.read": Action(Role.VIEWER, "read:experiments"),
    "experiments.write": Action(Role.TECHNICIAN, "write:experiments"),
    "experiments.upload": Action(Role.TECHNICIAN, "write:experiments", reach="server"),
    "experiments.step": Action(Role.OPERATOR, "step:experiments"),
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


Kind = Literal["user", "token", "robot"]


@dataclass(frozen=True, slots=True)
class Principal:
    """An authenticated person, token or robot.

    ``id`` is the name of a person, or the id of a token or robot; ``role`` that of the person (of a
    token: of its owner). ``groups`` None is all robots, an empty set is none. While a person
    ``must_change`` the password, only actions with ``first`` are allowed. ``owner`` is the owner of
    a token.
    """

    kind: Kind
    id: str
    role: Role | None = None
    groups: frozenset[str] | None = frozenset()
    scopes: frozenset[str] = frozenset()
    must_change: bool = False
    owner: str = ""

    def __str__(self) -> str:
        return f"{self.kind}:{self.id}" + (f" of {self.owner}" if self.owner else "")


@dataclass(frozen=True, slots=True)
class RobotGroups:
    """A robot and its groups, as permissions need them."""

    id: str
    groups: frozenset[str] = frozenset()


class UnknownActionError(ValueError):
    """An action is not in ``ACTIONS``: a programming error in the server."""


def allowed(principal: Principal, action: str, robot: RobotGroups | None = None) -> bool:
    """Return whether a principal may do an action on a robot or, without one, on all of them.

    Raises UnknownActionError for an action that is not in ``ACTIONS``.
    """
    rule = ACTIONS.get(action)
    if rule is None:
        raise UnknownActionError(f"unknown action '{action}'{did_you_mean(action, ACTIONS)}")
    if principal.kind == "robot":
        return rule.robots and robot is not None and robot.id == principal.id
    return _may(principal, rule) and _reaches(principal, rule, robot)


def _may(principal: Principal, rule: Action) -> bool:
    if principal.role is None or rule.role is None or not principal.role.covers(rule.role):
        return False
    if principal.kind == "token":
        return rule.scope is not None and rule.scope in principal.scopes
    return principal.kind == "user" and (rule.first or not principal.must_change)


def _reaches(principal: Principal, rule: Action, robot: RobotGroups | None) -> bool:
    if rule.reach == "own" or principal.groups is None:
        return True
    if rule.reach == "server" or robot is None:
        return False
    return bool(principal.groups & robot.groups)
