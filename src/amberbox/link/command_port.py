"""The link's port for commands: what a robot's gate receives from the server, and sends to it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from amberbox.core.command import CommandAnswer, LeaseState
from amberbox.link.frames import AbortFrame, ConfirmFrame, LeaseFrame


@dataclass(frozen=True, slots=True)
class MintedChallenge:
    """Random bytes that the gate has minted, who holds the robot now, and which motion waits."""

    challenge: bytes
    lease: LeaseState
    waiting: str = ""
    by_code: bool = False
    tries: int = 0


@dataclass(frozen=True, slots=True)
class ActionAnnouncement:
    """What the robot can do, as JSON."""

    actions: bytes


@dataclass(frozen=True, slots=True)
class GateAnswers:
    """Answers to commands, in the order of their numbers."""

    answers: Sequence[CommandAnswer]


# What a gate sends to the server
GateReport: TypeAlias = MintedChallenge | ActionAnnouncement | GateAnswers


class CommandPort(Protocol):
    """The gate of a robot as its link sees it; called in the event loop, must not block.

    Commands may come twice, and answers are lost with a connection: after each ``begin`` the gate
    reports its actions, all answers that were not acknowledged, oldest first, and a new challenge.
    """

    @property
    def capabilities(self) -> Sequence[str]:
        """What the robot says that it can; nothing else is called without ``limits.COMMANDS``."""

    def begin(self, server_id: str) -> None:
        """Begin a connection to a server that carries commands."""

    def end(self) -> None:
        """End the connection: reports wait for the next one."""

    async def report(self) -> GateReport:
        """Wait for what to send next; may be cancelled at the end of the connection."""

    def commands(self, commands: Sequence[bytes]) -> None:
        """Receive commands as they were encoded; nothing in them was checked."""

    def answered(self, number: int) -> None:
        """Forget the answers up to a number: the server has stored them.

        A number that was never given is of another history, and means nothing.
        """

    def revoked(self, keys: Sequence[str]) -> None:
        """Refuse these keys of persons from now on, for ever."""

    def lease(self, frame: LeaseFrame) -> None:
        """Take, renew or release a lease; who has it is in the next challenge."""

    def abort(self, frame: AbortFrame) -> None:
        """Stop what a run or a command does, safely."""

    def confirm(self, frame: ConfirmFrame) -> None:
        """Confirm the motion that waits, if the code is right."""


class NoCommands:
    """The port of a robot without a gate: it says no capability, so that nothing comes."""

    capabilities: Sequence[str] = ()

    def begin(self, server_id: str) -> None:
        """Do nothing."""

    def end(self) -> None:
        """Do nothing."""

    async def report(self) -> GateReport:
        """Wait for ever: there is nothing to send."""
        never: asyncio.Future[GateReport] = asyncio.get_running_loop().create_future()
        return await never

    def commands(self, commands: Sequence[bytes]) -> None:
        """Do nothing."""

    def answered(self, number: int) -> None:
        """Do nothing."""

    def revoked(self, keys: Sequence[str]) -> None:
        """Do nothing."""

    def lease(self, frame: LeaseFrame) -> None:
        """Do nothing."""

    def abort(self, frame: AbortFrame) -> None:
        """Do nothing."""

    def confirm(self, frame: ConfirmFrame) -> None:
        """Do nothing."""
