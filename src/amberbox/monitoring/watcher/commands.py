"""What people say of alarms: requests in the store, carried out by the watcher."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from amberbox.blackbox.requests import Request, finish, pending
from amberbox.blackbox.store import Store
from amberbox.core.errors import UsageError
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
    """Do what a request says; nothing where it makes no sense any more.

    Its times are wall clock; log time is ``shift_ns`` more.
    """
    values = request.values
    until_ns = values.get("until_ns")
    if until_ns is not None:
        until_ns = int(until_ns) + shift_ns
    try:
        changes = command(
            str(values.get("action")), str(values.get("id")), str(values.get("who", "")),
            at_ns, until_ns,
        )  # fmt: skip
    except UsageError:  # healed meanwhile, or acknowledged twice
        return []
    return list(changes)


def done(request: Request) -> None:
    """Remove a request that was carried out and written down."""
    finish(request)
