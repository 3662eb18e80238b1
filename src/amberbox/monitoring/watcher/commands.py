"""What people say of alarms: requests in the store, carried out by the watcher."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Protocol

from amberbox.blackbox.requests import Request, finish, pending
from amberbox.blackbox.store import Store
from amberbox.monitoring.engine.alarms import NEVER_NS
from amberbox.monitoring.engine.findings import AlarmChange

KIND = "alarm"


class Command(Protocol):
    """Does what a person says of an alarm."""

    def __call__(
        self, action: Any, alarm_id: str, who: str, at_ns: int, until_ns: int | None = None
    ) -> Sequence[AlarmChange]:
        """Return the alarm after it; raises UsageError if that makes no sense."""


def requests(store: Store) -> list[Request]:
    """Return the requests about alarms that nobody has seen to."""
    return [request for request in pending(store) if request.kind == KIND]


def carry_out(request: Request, command: Command, at_ns: int, shift_ns: int) -> list[AlarmChange]:
    """Do what a request says; its times are wall clock, log time is ``shift_ns`` more.

    Raises UsageError where it makes no sense any more (the alarm has healed meanwhile), and
    ValueError for a request that nobody can read.
    """
    values = request.values
    until_ns = _time(values.get("until_ns"))
    if until_ns is not None:
        until_ns += shift_ns
    return list(
        command(
            str(values.get("action")), str(values.get("id")), str(values.get("who", "")),
            at_ns, until_ns,
        )
    )  # fmt: skip


def _time(value: Any) -> int | None:
    if value is None or (type(value) is int and 0 <= value < NEVER_NS):
        return value
    raise ValueError(f"until_ns: {value!r:.40} is no time")


def set_aside(request: Request) -> str:
    """Keep a request that cannot be read where nobody takes it for one; return its name."""
    aside = request.path.with_suffix(".refused")
    with suppress(FileNotFoundError):
        request.path.rename(aside)
    return aside.name


def done(request: Request) -> None:
    """Remove a request that was carried out and written down."""
    finish(request)
