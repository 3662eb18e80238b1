"""Commanding a robot from a person's computer: hold its lease, sign for a fresh challenge."""

from __future__ import annotations

import threading
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING

import msgspec

from amberbox.client.signing_key import SigningKey
from amberbox.client.transport import ApiConnection, ConflictError
from amberbox.core.command import Command, Risk, sign_command
from amberbox.core.errors import AmberboxError

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import CommandLine

_RENEW_S = 1.0
_REQUEST_S = 2.0


class HeldLease:
    """A robot that is held for a run: the lease is renewed until the end of the context.

    ``lost`` is why it could not be renewed last. The lease ends by itself soon after this process
    does. Raises ConflictError where somebody else holds the robot, or it is away.
    """

    def __init__(self, fleet: Fleet, robot: str, run: str = "") -> None:
        from amberbox.client.fleet import Fleet as _Fleet

        wire = fleet.wire
        self.lease = fleet.take_lease(robot, run)
        self.lost = ""
        self._robot = robot
        self._end = threading.Event()
        # a connection of its own: a slow answer to another request must not end the lease
        self._fleet = _Fleet.over(ApiConnection(wire.url, wire.token, wire.context, _REQUEST_S))
        self._thread = threading.Thread(target=self._renew, daemon=True)
        self._thread.start()

    def __enter__(self) -> HeldLease:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end.set()
        self._thread.join()
        if not self.lost:
            with suppress(AmberboxError):  # it ends by itself
                self._fleet.release_lease(self._robot, self.lease.number)
        self._fleet.close()

    def _renew(self) -> None:
        while not self._end.wait(_RENEW_S):
            try:
                self._fleet.renew_lease(self._robot, self.lease.number)
                self.lost = ""
            except AmberboxError as error:
                self.lost = error.what  # perhaps not for good: the robot decides


def signed_now(
    fleet: Fleet, robot: str, command: Command, key: SigningKey, lease: int, ttl_s: int
) -> Command:
    """Return a command signed for the robot's newest challenge.

    Raises ConflictError where the robot has given none.
    """
    state = fleet.actions(robot)
    if not state.challenge:
        raise ConflictError(f"{robot} takes no commands now", "wait until it is connected")
    return sign_command(
        command, key.private, lease=lease, challenge=bytes.fromhex(state.challenge), ttl_s=ttl_s,
        server=state.server_id,
    )  # fmt: skip


def sign_line(
    fleet: Fleet, robot: str, line: CommandLine, key: SigningKey, lease: int, ttl_s: int
) -> CommandLine:
    """Sign a command as it is shown, under a lease, for the robot's newest challenge."""
    risk: Risk = msgspec.convert(line.risk, Risk)
    command = Command(
        line.id, robot, line.action, line.parameters, line.issuer, risk, line.run, line.step
    )
    signed = signed_now(fleet, robot, command, key, lease, ttl_s)
    assert signed.signature is not None
    return fleet.sign_command(robot, line.id, signed.signature)
