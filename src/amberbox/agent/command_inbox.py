"""What the server has sent and the gate has not handled yet: bounded, what stops the robot first.

A server that sends without end keeps neither aborts nor renewals waiting, nor the command process
from its other work: each turn takes a few commands only, and equal requests count once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import TypeVar

from amberbox.core.pacing import TokenBucket
from amberbox.link import limits
from amberbox.link.frames import (
    AbortFrame,
    CommandsFrame,
    LeaseFrame,
    RevokedFrame,
    ServerCommandFrame,
)

# Commands a second, lastingly and at once, a large one counting as several: each is recorded, and
# what is recorded of commands is never deleted
COMMANDS_PER_S = 10.0
BURST = 200.0
_BYTES = 4096
# Commands of one turn: each is checked and synced to the disk
AT_ONCE = 5
# What may wait; a server sends again what is not answered
MOST_COMMANDS = 1000
MOST_BYTES = 4 << 20
# Aborts a second, lastingly and at once; with more of them everything is stopped
ABORTS_PER_S = 10.0
ABORTS = 50
# Other frames that are kept of one turn: the newest
_FEW = 16


class CommandInbox:
    """Frames of the server; ``add`` them as they come, ``take`` those to handle in each turn.

    ``dropped`` counts commands for which there was no room.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._commands: deque[bytes] = deque()
        self._bytes = 0
        self._rate = TokenBucket(COMMANDS_PER_S, BURST)
        self._aborts: dict[AbortFrame, None] = {}
        self._abort_rate = TokenBucket(ABORTS_PER_S, float(ABORTS))
        self._revoked: dict[str, None] = {}
        self._prompt: dict[ServerCommandFrame, None] = {}
        self._takes: dict[LeaseFrame, None] = {}

    @property
    def has_commands(self) -> bool:
        """Whether commands wait for the next turns."""
        return bool(self._commands)

    def add(self, frame: ServerCommandFrame) -> None:
        """Add a frame that has come."""
        if isinstance(frame, CommandsFrame):
            self._add_commands(frame)
        elif isinstance(frame, AbortFrame):
            _keep_newest(self._aborts, frame, ABORTS + 1)
        elif isinstance(frame, RevokedFrame):
            self._revoked.update(dict.fromkeys(frame.keys))
        elif isinstance(frame, LeaseFrame) and frame.do == "take":
            _keep_newest(self._takes, frame, _FEW)
        else:
            _keep_newest(self._prompt, frame, _FEW)

    def _add_commands(self, frame: CommandsFrame) -> None:
        for command in frame.commands:
            size = self._bytes + len(command)
            if len(self._commands) >= MOST_COMMANDS or size > MOST_BYTES:
                self.dropped += 1
            else:
                self._bytes = size
                self._commands.append(command)

    def forget_commands(self) -> None:
        """Forget the commands that wait: the connection that they came by has ended."""
        self._commands.clear()
        self._bytes = 0

    def take(self, now_s: float, room: int = AT_ONCE) -> Iterator[ServerCommandFrame]:
        """Yield the frames to handle in this turn, with commands for which there is ``room``."""
        aborts, self._aborts = self._aborts, {}
        if any(self._abort_rate.take_one(now_s) for _ in aborts):
            yield AbortFrame()
        else:
            yield from aborts
        revoked, self._revoked = list(self._revoked), {}
        for start in range(0, len(revoked), limits.KEYS_COUNT):
            yield RevokedFrame(revoked[start : start + limits.KEYS_COUNT])
        prompt, self._prompt = self._prompt, {}
        yield from prompt
        while self._takes and not self._rate.take_one(now_s):
            first = next(iter(self._takes))
            del self._takes[first]
            yield first
        commands = list[bytes]()
        most = min(room, AT_ONCE, len(self._commands))
        while len(commands) < most and not self._rate.take_one(now_s):
            commands.append(self._commands.popleft())
            self._bytes -= len(commands[-1])
            self._rate.take(len(commands[-1]) // _BYTES, now_s)
        if commands:
            yield CommandsFrame(commands)


_Frame = TypeVar("_Frame")


def _keep_newest(waiting: dict[_Frame, None], frame: _Frame, most: int) -> None:
    waiting.pop(frame, None)
    waiting[frame] = None
    if len(waiting) > most:
        del waiting[next(iter(waiting))]
