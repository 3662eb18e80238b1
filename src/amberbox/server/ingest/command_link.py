"""Commands on a robot's connection: what is sent on contact and after a challenge, and answers.

On contact the server sends revoked keys and which answers are stored; commands only after the
robot has minted a challenge on this connection. Each piece of work is one job of the database that
checks the connection's epoch, so that of two connections only the newer one sends and stores.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from sqlalchemy import Connection

from amberbox.core.clock import NS, Clock
from amberbox.core.command import MOST_TTL_S, LeaseState
from amberbox.link import limits
from amberbox.link.frames import (
    ActionsFrame,
    AnsweredFrame,
    AnswersFrame,
    ChallengeFrame,
    CommandsFrame,
    RevokedFrame,
    RobotCommandFrame,
    ServerFrame,
)
from amberbox.server import commands
from amberbox.server.ingest.ledger import GroupedWrites
from amberbox.server.ingest.link_state import log_event

_CHALLENGE_NS = MOST_TTL_S * NS
# Challenges of a connection that are remembered: a robot mints one in 10 s
_MOST_CHALLENGES = 16
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class WaitingMotion:
    """A motion that waits for its confirmation at the robot; none with an empty ``id``."""

    id: str = ""
    by_code: bool = False
    tries: int = 0


@dataclass(slots=True, eq=False)
class RobotContact:
    """One connection of a robot that takes commands, and what it said on it; not durable."""

    robot: str
    epoch: int
    store_id: str
    is_other_history: bool = False
    """Whether an old image of its disk was restored since the connection before."""
    challenges: tuple[tuple[int, bytes], ...] = ()
    """Times of receipt (ns since the server's boot) and challenges, oldest first."""
    lease: LeaseState | None = None
    """Who holds the robot, as it said last; None before it did."""
    waiting: WaitingMotion = WaitingMotion()
    """The motion that waits for its confirmation."""
    revoked: frozenset[str] = frozenset()
    """Ids of the revoked keys that were sent."""
    heard: asyncio.Event = field(default_factory=asyncio.Event)
    """Set with the next challenge, and then replaced."""

    def challenged(self, frame: ChallengeFrame, now_ns: int) -> bool:
        """Keep a challenge, received at ``now_ns`` since boot.

        Return whether lease or waiting motion are news.
        """
        kept = [one for one in self.challenges if now_ns - one[0] <= _CHALLENGE_NS]
        self.challenges = (*kept[1 - _MOST_CHALLENGES :], (now_ns, frame.challenge))
        before = self.lease, self.waiting
        self.lease = frame.lease
        self.waiting = WaitingMotion(frame.waiting, frame.by_code, frame.tries)
        self.heard.set()
        self.heard = asyncio.Event()
        return before != (self.lease, self.waiting)

    def fresh(self, now_ns: int) -> list[bytes]:
        """Return the challenges that a signature may be over now, oldest first."""
        return [one for at_ns, one in self.challenges if now_ns - at_ns <= _CHALLENGE_NS]


# Called in the event loop with a robot and the ids of its commands that have changed, or that
# waited or wait for their confirmation
CommandsChanged = Callable[[str, Sequence[str]], None]


class CommandLink:
    """Does what robots' connections need of commands; its methods return frames to send.

    The work is queued at the call, so that it is done in the order of the robot's frames. The
    frames are ready once it is durable; StaleEpochError where the robot has connected again.
    """

    def __init__(
        self,
        writes: GroupedWrites,
        clock: Clock,
        changed: CommandsChanged,
        leased: CommandsChanged,
    ) -> None:
        self._writes = writes
        self._clock = clock
        self._changed = changed
        self._leased = leased

    def begin(self, contact: RobotContact) -> Awaitable[Sequence[ServerFrame]]:
        """Begin a connection: return revoked keys, and which answers are stored."""
        work = partial(
            commands.begin_contact, robot=contact.robot, epoch=contact.epoch,
            store_id=contact.store_id, is_other_history=contact.is_other_history,
        )  # fmt: skip
        return self._after(
            work,
            lambda found: [*_revocations(contact, found.revoked), AnsweredFrame(found.answered)],
        )

    def receive(
        self, contact: RobotContact, frame: RobotCommandFrame
    ) -> Awaitable[Sequence[ServerFrame]]:
        """Process a frame of a robot; return what to send."""
        if isinstance(frame, ChallengeFrame):
            before = contact.waiting.id
            if not contact.challenged(frame, self._clock.boot_ns()):
                return self.send(contact)
            waiting = sorted({before, contact.waiting.id} - {""})
            return self.send(contact, frame.lease, lambda: self._leased(contact.robot, waiting))
        if isinstance(frame, AnswersFrame):
            return self._answers(contact, frame)
        return self._actions(contact, frame)

    def send(
        self,
        contact: RobotContact,
        lease: LeaseState | None = None,
        recorded: Callable[[], None] = lambda: None,
    ) -> Awaitable[Sequence[ServerFrame]]:
        """Return keys that were revoked since, and the commands that are to be sent now.

        A new lease is recorded, then ``recorded`` is called.
        """
        now_ns = self._clock.wall_ns()

        def work(connection: Connection) -> tuple[Sequence[str], Sequence[bytes]]:
            if lease is not None:
                commands.record_lease(connection, contact.robot, contact.epoch, lease, now_ns)
            found = commands.claim(connection, contact.robot, contact.epoch, now_ns)
            return [one.key_id for one in commands.revoked_keys(connection)], found

        def frames(found: tuple[Sequence[str], Sequence[bytes]]) -> Sequence[ServerFrame]:
            recorded()
            return [*_revocations(contact, found[0]), *_portions(found[1])]

        return self._after(work, frames)

    def _answers(
        self, contact: RobotContact, frame: AnswersFrame
    ) -> Awaitable[Sequence[ServerFrame]]:
        def done(found: commands.StoredAnswers) -> Sequence[ServerFrame]:
            if found.changed:
                self._changed(contact.robot, found.changed)
            return [AnsweredFrame(found.number)] if found.number else []

        now_ns = self._clock.wall_ns()

        def work(connection: Connection) -> commands.StoredAnswers:
            found = commands.store_answers(
                connection, contact.robot, contact.epoch, contact.store_id, frame.answers, now_ns
            )
            if found.unknown:
                text = (
                    f"it answered commands that this server does not know ({len(found.unknown)}): "
                    f"was it restored from an older copy? {', '.join(found.unknown[:3])}"
                )
                log_event(connection, contact.robot, now_ns, "unknown_command", text)
            return found

        return self._after(work, done)

    def _actions(
        self, contact: RobotContact, frame: ActionsFrame
    ) -> Awaitable[Sequence[ServerFrame]]:
        work = partial(
            commands.announce, robot=contact.robot, epoch=contact.epoch,
            announcement=frame.announcement.decode(), now_ns=self._clock.wall_ns(),
        )  # fmt: skip
        return self._after(work, lambda _: [])

    def _after(
        self, work: Callable[[Connection], T], frames: Callable[[T], Sequence[ServerFrame]]
    ) -> Awaitable[Sequence[ServerFrame]]:
        """Queue work on the database; return the frames for its result."""
        return _frames(self._writes.submit(work), frames)


async def _frames(
    done: Future[T], frames: Callable[[T], Sequence[ServerFrame]]
) -> Sequence[ServerFrame]:
    return frames(await asyncio.wrap_future(done))


def _revocations(contact: RobotContact, revoked: Sequence[str]) -> Iterator[RevokedFrame]:
    """Yield frames with the keys that were not sent on this connection."""
    keys = [key for key in revoked if key not in contact.revoked]
    contact.revoked |= set(keys)
    for at in range(0, len(keys), limits.KEYS_COUNT):
        yield RevokedFrame(keys[at : at + limits.KEYS_COUNT])


def _portions(found: Sequence[bytes]) -> Iterator[CommandsFrame]:
    """Yield commands in portions that fit into a frame."""
    portion, size = list[bytes](), 0
    for data in found:
        if portion and size + len(data) > limits.COMMANDS_BYTES:
            yield CommandsFrame(portion)
            portion, size = [], 0
        portion.append(data)
        size += len(data)
    if portion:
        yield CommandsFrame(portion)
