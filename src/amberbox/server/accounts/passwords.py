"""Passwords and random secrets: hashing with argon2id, refusal of weak passwords.

Hashing is slow on purpose and never runs on the thread of the event loop. Random secrets have 256
bits; the server stores only their hashes. One-time passwords have 20 characters.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
import secrets
import threading
import unicodedata
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import ParamSpec, TypeVar

from argon2 import PasswordHasher, Type
from argon2.exceptions import InvalidHashError, VerificationError, VerifyMismatchError

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.link.join_line import MARKS, Kind


@dataclass(frozen=True, slots=True)
class Secret:
    """A new secret: its text, to be shown once, its public id, and the hash to store.

    The text is such as ``abt_<id>_<43 characters>``: the prefix names the kind of secret, so that
    scanners for leaked secrets find it.
    """

    text: str
    id: str
    hash: str

    def __repr__(self) -> str:
        return f"Secret({self.id})"


def new_secret(kind: Kind) -> Secret:
    """Return a new secret from the random numbers of the operating system."""
    id_ = secrets.token_hex(6)
    text = f"{MARKS[kind]}_{id_}_{secrets.token_urlsafe(32)}"
    return Secret(text, id_, digest(text))


def digest(text: str) -> str:
    """Return the SHA-256 of a secret as 64 hex digits."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


ALPHABET = "abcdefghjkmnpqrstuvwxyz23456789"
_GROUPS, _LONG = 4, 5


def one_time_password() -> str:
    """Return a new one-time password, such as ``k7mqd-2xwdn-pa4ch-ytr9b``."""
    groups = ("".join(secrets.choice(ALPHABET) for _ in range(_LONG)) for _ in range(_GROUPS))
    return "-".join(groups)


SHORTEST = 12
LONGEST = 256
_FEWEST_DIFFERENT = 6
_FEWEST_LEFT = 4
_FEWEST_GUESSES = 1e8
"""Least number of guesses that a password has to withstand: zxcvbn calls that safely
unguessable.
"""
_LOOKED_AT = 32
_MOST_SIGNS = 12
"""Beyond this number of characters, or of different digits and signs, zxcvbn takes seconds."""
_COMMON = (
    "|password|passwort|kennwort|contrasena|motdepasse|qwertyuiop|qwertzuiop|asdfghjkl|yxcvbnm"
    "|zxcvbnm|azertyuiop|qwerty|qwertz|azerty|letmein|welcome|willkommen|iloveyou|administrator|admin"
    "|root|user|test|monkey|dragon|football|baseball|sunshine|princess|superman|batman|trustno|changeme"
    "|default|guest|master|secret|geheim|login|hospital|krankenhaus|klinik|robot|roboter|ropod|amberbox"
    "|server|schalke|sommer|winter|summer|spring|fruehling|herbst|autumn|hallo|hello"
)
_LEET = str.maketrans("013457@$!", "oleastasi")
_ROWS = (
    "abcdefghijklmnopqrstuvwxyz",
    "01234567890",
    "qwertyuiop",
    "qwertzuiop",
    "asdfghjkl",
    "1q2w3e4r5t6y7u8i9o0p",
)
_YEAR = r"(?:19|20)\d\d"


def normal(password: str) -> str:
    """Return a password in Unicode form NFKC, so that it is the same typed on any system."""
    return unicodedata.normalize("NFKC", password)


def weakness(password: str, name: str = "") -> str | None:
    """Return why a password is refused; None when it is good enough.

    A good one has 12 to 256 characters, at least 6 different ones, and at least 4 that remain
    without common words, the name of the account, sequences (``1234``, ``qwer``) and repetitions.
    zxcvbn must estimate 100 million guesses or more.
    """
    text = normal(password)
    if len(text) < SHORTEST:
        return f"it has {len(text)} characters, {SHORTEST} are the least"
    if len(text) > LONGEST:
        return f"it has more than {LONGEST} characters"
    if len(set(text.casefold())) < _FEWEST_DIFFERENT:
        return "it uses too few different characters"
    for plain in (text.casefold(), _plain(text.casefold())):
        if len(_left(plain, name.casefold())) < _FEWEST_LEFT:
            return "it is made of words and sequences that are tried first"
    if _is_guessed(text, name):
        return "it is like passwords that are tried first"
    return None


def _is_guessed(text: str, name: str) -> bool:
    """Return whether both the beginning and the end can be found with few guesses, by zxcvbn's
    estimate.
    """
    from zxcvbn import zxcvbn  # its import reads lists of words

    known = [*_COMMON.split("|")[1:], *_parts(name.casefold())]
    for piece in {text[:_LOOKED_AT], text[-_LOOKED_AT:]}:
        if len({char for char in piece if not char.isalpha()}) > _MOST_SIGNS:
            return False
        if zxcvbn(piece, known)["guesses"] >= _FEWEST_GUESSES:
            return False
    return True


def _left(text: str, name: str) -> str:
    """Return a password without words, sequences and repetitions, which are easy to guess."""
    words = sorted((*_COMMON.split("|")[1:], *_parts(name)), key=len, reverse=True)
    for word in words:
        text = text.replace(word, " ")
    for piece in _runs(text):
        text = text.replace(piece, " ")
    text = re.sub(r"(.{1,4}?)\1+", r"\1", text)
    return re.sub(rf"[\W_]|{_YEAR}", "", text)


def _plain(text: str) -> str:
    """Replace digits and signs by the letters they stand for; drop years and trailing digits."""
    return re.sub(rf"{_YEAR}|[\d\W]+$", "", text).translate(_LEET)


def _parts(name: str) -> Iterator[str]:
    if len(name) >= 3:
        yield name
    yield from (part for part in re.split(r"[^a-z0-9]+", name) if len(part) >= 3)


def _runs(text: str) -> Iterator[str]:
    """Yield runs of four or more adjacent characters of a keyboard row or the alphabet."""
    for row in (*_ROWS, *(row[::-1] for row in _ROWS)):
        for start in range(len(text)):
            end = start
            while end < len(text) and text[start : end + 1] in row:
                end += 1
            if end - start >= 4:
                yield text[start:end]


P = ParamSpec("P")
T = TypeVar("T")

_AT_ONCE = 2
_WAITING = 30


@dataclass(frozen=True, slots=True)
class HashCost:
    """The cost of one hash: passes over memory, memory in KiB, and threads.

    The default is the second recommendation of RFC 9106: 0.23 s on one core of a small server.
    """

    passes: int = 3
    memory_kib: int = 65_536
    threads: int = 2


class TooManyError(AmberboxError):
    """More people sign in at this moment than the server can check passwords for."""


class Passwords:
    """Hashes and verifies passwords, at most two at a time; threads may share it.

    Each takes 64 MB while it runs. In an event loop use ``apart``, which does not block it.
    """

    def __init__(self, cost: HashCost | None = None) -> None:
        cost = cost or HashCost()
        self._hasher = PasswordHasher(
            cost.passes, cost.memory_kib, cost.threads, hash_len=32, salt_len=16, type=Type.ID
        )
        self._slots = threading.BoundedSemaphore(_AT_ONCE)
        self._queue = threading.BoundedSemaphore(_AT_ONCE + _WAITING)
        self._threads = ThreadPoolExecutor(_AT_ONCE + _WAITING, "passwords")
        self._no_account = self.hash("the password of nobody")

    def hash(self, password: str) -> str:
        """Return the hash of a password, which includes the cost and a new salt."""
        with self._slots:
            return self._hasher.hash(normal(password))

    def verify(self, held: str | None, password: str) -> bool:
        """Return whether a password matches a hash; False without a hash (None).

        It takes as long for an account that does not exist (None) as for one that does. Raises
        TooManyError when too many wait already.
        """
        if not self._queue.acquire(blocking=False):
            raise TooManyError("too many people log in at once", "try again in a few seconds")
        try:
            with self._slots:
                return self._matches(held or self._no_account, password) and held is not None
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
        """Return whether a hash was made at another cost and should be replaced."""
        return self._hasher.check_needs_rehash(held)

    async def apart(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run work that hashes or verifies on another thread; return its result."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, partial(work, *args, **kwargs))

    def close(self) -> None:
        """Wait for the work under way, then end the threads."""
        self._threads.shutdown()


def refuse_weak(password: str, name: str) -> None:
    """Raise UsageError for a password that is easy to guess."""
    why = weakness(password, name)
    if why is not None:
        raise UsageError(
            f"this password is refused: {why}",
            "take four words that do not belong together",
        )
