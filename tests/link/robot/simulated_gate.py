"""A gate for tests of the link: does each command once, remembers what it answered."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Sequence

from amberbox.core.command import (
    CHALLENGE_BYTES,
    AnswerState,
    CommandAnswer,
    CommandError,
    LeaseState,
    decode_command,
)
from amberbox.link import limits
from amberbox.link.command_port import (
    ActionAnnouncement,
    GateAnswers,
    GateReport,
    MintedChallenge,
)
from amberbox.link.frames import AbortFrame, ConfirmFrame, LeaseFrame


class SimulatedGate:
    """Its log outlasts connections and links; ``pending`` are commands that it accepted."""

    def __init__(self, capabilities: Sequence[str] = (limits.COMMANDS,)) -> None:
        self.capabilities = capabilities
        self.begun: list[str] = []
        self.connected = False
        self.log: dict[str, tuple[bytes, CommandAnswer]] = {}
        self.done: list[str] = []
        self.pending: list[str] = []
        self.received = 0
        self.refused: list[bytes] = []
        self.keys: set[str] = set()
        self.state = LeaseState()
        self.aborted: list[AbortFrame] = []
        self.challenges: list[bytes] = []
        self._unanswered: list[CommandAnswer] = []
        self._numbers = 0
        self._reports: asyncio.Queue[GateReport] = asyncio.Queue()

    def begin(self, server_id: str) -> None:
        """Report everything that the server may lack."""
        self.begun.append(server_id)
        self.connected = True
        self._reports = asyncio.Queue()
        self._reports.put_nowait(ActionAnnouncement(b'[{"name": "dock"}]'))
        if self._unanswered:
            self._reports.put_nowait(GateAnswers(list(self._unanswered)))
        self.mint()

    def end(self) -> None:
        """Note the end of the connection."""
        self.connected = False

    async def report(self) -> GateReport:
        """Wait for what to send next."""
        return await self._reports.get()

    def mint(self) -> None:
        """Report a new challenge."""
        self.challenges.append(secrets.token_bytes(CHALLENGE_BYTES))
        self._reports.put_nowait(MintedChallenge(self.challenges[-1], self.state))

    def commands(self, commands: Sequence[bytes]) -> None:
        """Do each once; of one that is known repeat the answer."""
        for data in commands:
            self.received += 1
            try:
                command_id = decode_command(data).id
            except CommandError:
                self.refused.append(data)
                continue
            if command_id in self.log:
                known, answer = self.log[command_id]
                if known == data:
                    self._reports.put_nowait(GateAnswers([answer]))
                else:
                    self.refused.append(data)
                continue
            self.log[command_id] = data, CommandAnswer(command_id, "accepted")
            self.answer(command_id, "accepted")
            self.pending.append(command_id)

    def finish(self, state: AnswerState = "done") -> None:
        """End all commands that were accepted."""
        pending, self.pending = self.pending, []
        for command_id in pending:
            self.done.append(command_id)
            self.answer(command_id, state)

    def answer(self, command_id: str, state: AnswerState) -> None:
        """Note an answer, and report it."""
        self._numbers += 1
        answer = CommandAnswer(command_id, state, number=self._numbers, boot="b")
        data = self.log[command_id][0] if command_id in self.log else b""
        self.log[command_id] = data, answer
        self._unanswered.append(answer)
        self._reports.put_nowait(GateAnswers([answer]))

    def unanswered(self) -> list[CommandAnswer]:
        """Return the answers that were not acknowledged."""
        return list(self._unanswered)

    def answered(self, number: int) -> None:
        """Forget answers; a number that was never given means nothing."""
        if number <= self._numbers:
            self._unanswered = [one for one in self._unanswered if one.number > number]

    def revoked(self, keys: Sequence[str]) -> None:
        """Remember revoked keys."""
        self.keys |= set(keys)

    def lease(self, frame: LeaseFrame) -> None:
        """Give everybody a lease, and say so."""
        if frame.do == "take":
            self.state = LeaseState(self.state.number + 1, frame.holder, frame.run)
        elif frame.do == "release":
            self.state = LeaseState(self.state.number)
        self.mint()

    def confirm(self, frame: ConfirmFrame) -> None:
        """Do nothing: no motion waits here."""

    def abort(self, frame: AbortFrame) -> None:
        """Note what was aborted."""
        self.aborted.append(frame)
