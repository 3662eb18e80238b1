"""Who asks, and whether they may: one function answers for people, tokens and robots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from amberbox.core.config import did_you_mean
from amberbox.fleet.accounts.actions import ACTIONS, Action, Role

Kind = Literal["user", "token", "robot"]


@dataclass(frozen=True, slots=True)
class Principal:
    """Who asks.

    ``id`` is the name of a person, the id of a token or of a robot; ``role`` that of the person
    (of a token: of its owner). ``groups`` None is all robots, an empty set is none. A person who
    ``must_change`` the password may do nothing else before. ``owner`` is whose token it is.
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
class Robot:
    """A robot as permissions see it."""

    id: str
    groups: frozenset[str] = frozenset()


class UnknownActionError(ValueError):
    """An action that is not in the table: a mistake in the server, never an answer to somebody."""


def allowed(principal: Principal, action: str, robot: Robot | None = None) -> bool:
    """Tell whether somebody may do something, to a robot or, without one, to all of them.

    Raises UnknownActionError for what is not in ``ACTIONS``.
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


def _reaches(principal: Principal, rule: Action, robot: Robot | None) -> bool:
    if rule.reach == "own" or principal.groups is None:
        return True
    if rule.reach == "server" or robot is None:
        return False
    return bool(principal.groups & robot.groups)
