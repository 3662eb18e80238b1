"""Passwords: hashed with argon2id, slowly on purpose, and never on the thread of the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import ParamSpec, TypeVar

from argon2 import PasswordHasher, Type
from argon2.exceptions import InvalidHashError, VerificationError, VerifyMismatchError

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.accounts.weak import LONGEST, normal, weakness

P = ParamSpec("P")
T = TypeVar("T")

_AT_ONCE = 2
_WAITING = 30


@dataclass(frozen=True, slots=True)
class Cost:
    """What one hash costs: passes over memory, its size, and threads.

    The standard is the second recommendation of RFC 9106: 0.23 s of one core of a small server.
    """

    passes: int = 3
    memory_kib: int = 65_536
    threads: int = 2


class TooManyError(AmberboxError):
    """More people log in at this moment than the server can check passwords for."""


class Passwords:
    """Hashes and compares passwords, at most two at a time; threads may share it.

    64 MB are in use for each at a time. ``apart`` is for an event loop: it never waits for a hash.
    """

    def __init__(self, cost: Cost | None = None) -> None:
        cost = cost or Cost()
        self._hasher = PasswordHasher(
            cost.passes, cost.memory_kib, cost.threads, hash_len=32, salt_len=16, type=Type.ID
        )
        self._slots = threading.BoundedSemaphore(_AT_ONCE)
        self._queue = threading.BoundedSemaphore(_AT_ONCE + _WAITING)
        self._threads = ThreadPoolExecutor(_AT_ONCE + _WAITING, "passwords")
        self._nobody = self.hash("the password of nobody")

    def hash(self, password: str) -> str:
        """Hash a password; the cost and a new salt stand in the result."""
        with self._slots:
            return self._hasher.hash(normal(password))

    def verify(self, held: str | None, password: str) -> bool:
        """Tell whether a password is the one hashed; with None nothing is right.

        It takes as long for an account that does not exist (None) as for one that does. Raises
        TooManyError rather than to let too many wait.
        """
        if not self._queue.acquire(blocking=False):
            raise TooManyError("too many people log in at once", "try again in a few seconds")
        try:
            with self._slots:
                return self._matches(held or self._nobody, password) and held is not None
        finally:
            self._queue.release()

    def _matches(self, held: str, password: str) -> bool:
        text = normal(password)
        if len(text) > LONGEST:
            return False
        try:
            return self._hasher.verify(held, text)
        except VerifyMismatchError:
            return False
        except (InvalidHashError, VerificationError) as error:
            raise AmberboxError(
                f"the hash of a password cannot be read: {error}", "give the account a new password"
            ) from error

    def is_outdated(self, held: str) -> bool:
        """Tell whether a hash was made at another cost, so that it should be made anew."""
        return self._hasher.check_needs_rehash(held)

    async def apart(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do work that hashes or compares on a thread of its own, while the event loop goes on."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, partial(work, *args, **kwargs))

    def close(self) -> None:
        """End the threads, when what they do is done."""
        self._threads.shutdown()


def refuse_weak(password: str, name: str) -> None:
    """Raise UsageError for a password that would be guessed."""
    why = weakness(password, name)
    if why is not None:
        raise UsageError(
            f"this password is refused: {why}",
            "take four words that do not belong together",
        )
