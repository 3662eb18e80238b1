"""A server in memory: its parts over a folder, people of every role, and clients that ask it."""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fastapi import FastAPI
from starlette.testclient import TestClient

from amberbox.core.clock import NS
from amberbox.server import database, process
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import SCOPES, Role
from amberbox.server.accounts.robots import add_group, add_robot
from amberbox.server.accounts.sessions import begin_session, csrf_token
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import add_user, find_user
from amberbox.server.app import make_app
from amberbox.server.config import ServerSettings
from amberbox.server.database import FILE
from amberbox.server.http.auth import COOKIE, CSRF_HEADER
from amberbox.testing.clock import PATIENCE_S, ManualClock

URL = "https://fleet.example"
PASSWORD = "a long enough passphrase"
ROBOTS = {"ropod_001": ("ward",), "ropod_002": ("ward",), "ropod_003": ("kitchen",)}
START_NS = 1_800_000_000 * NS


_really = database._configure


def _configure(connection: Any, record: object) -> None:
    """Do not wait for the disk: no power is cut here."""
    _really(connection, record)
    connection.execute("PRAGMA synchronous=OFF").close()


class House:
    """A server without a network: ``client(name)`` is a signed-in person."""

    def __init__(self, folder: Path, app: FastAPI | None = None, start_ns: int = START_NS) -> None:
        self.clock = ManualClock(start_ns)
        self.passwords = Passwords(HashCost(1, 8, 1))
        self.keys: dict[str, str] = {}
        first = _FIRST.get(start_ns)
        if first:
            (folder / FILE).write_bytes(first.database)
            self.keys.update(first.keys)
        with patch.object(database, "_configure", _configure):
            self.services = process.make_services(
                folder, ServerSettings(URL), self.clock, self.passwords
            )
        if not first:
            self._people()
            with closing(sqlite3.connect(folder / FILE)) as written:
                _FIRST[start_ns] = _First(written.serialize(), dict(self.keys))
        self.app = app or make_app(self.services)
        self.app.state.services = self.services

    def _people(self) -> None:
        """Add robots in two groups, one person of each role, and one who is for the ward only."""
        hashed = self.passwords.hash(PASSWORD)
        with self.services.database.begin() as connection:
            now_ns = self.clock.wall_ns()
            for group in ("ward", "kitchen"):
                add_group(connection, now_ns, group)
            for robot, groups in ROBOTS.items():
                self.keys[robot] = add_robot(connection, now_ns, robot, groups).text
            for role in Role:
                add_user(connection, now_ns, str(role), role, hashed)
            add_user(connection, now_ns, "nurse", Role.TECHNICIAN, hashed, groups=["ward"])

    def client(self, name: str = "", **options: Any) -> TestClient:
        """Return a client of a signed-in person; without a name one that is signed out."""
        client = TestClient(self.app, base_url=URL, raise_server_exceptions=False, **options)
        if name:
            with self.services.database.begin() as connection:
                user = find_user(connection, name)
                session = begin_session(
                    connection, self.clock.wall_ns(), user.user_id, "192.0.2.1", "tests"
                )
            client.cookies.set(COOKIE, session.secret)
            client.headers[CSRF_HEADER] = csrf_token(session.secret)
        return client

    def token_client(self, owner: str = "technician", *scopes: str) -> TestClient:
        """Return a client with a token of a person; with all scopes if none is named."""
        with self.services.database.begin() as connection:
            user = find_user(connection, owner)
            token = add_token(connection, self.clock.wall_ns(), user, "test", scopes or SCOPES)
        client = self.client()
        client.headers["Authorization"] = f"Bearer {token.text}"
        return client

    def robot_client(self, robot: str = "ropod_001") -> TestClient:
        """Return a client with the key of a robot."""
        client = self.client()
        client.headers["Authorization"] = f"Robot {robot}:{self.keys[robot]}"
        return client

    def close(self) -> None:
        """Let go of everything."""
        process.close(self.services)


@dataclass(frozen=True)
class _First:
    """What the first house of a time wrote down: later ones begin with it."""

    database: bytes
    keys: Mapping[str, str]


_FIRST: dict[int, _First] = {}
_APP: list[FastAPI] = []
"""Getting ready for its first request takes an app 0.3 s."""


@contextmanager
def house(folder: Path, *, shared: bool = False) -> Iterator[House]:
    """Keep a house for the time of a test; ``shared`` takes the app of the last such one."""
    folder.mkdir(parents=True, exist_ok=True)
    found = House(folder, _APP[0] if shared and _APP else None)
    if shared and not _APP:
        _APP.append(found.app)
    try:
        yield found
    finally:
        found.close()


def work_until(
    work: Callable[[], Coroutine[Any, Any, None]],
    until: Callable[[], bool],
    begun: Callable[[], None] | None = None,
) -> None:
    """Let a service of the server work until something is so; call ``begun`` once it waits."""

    async def run() -> None:
        task = asyncio.create_task(work())
        if begun is not None:
            await asyncio.sleep(0.05)
            begun()
        ends = time.monotonic() + PATIENCE_S
        while not until() and time.monotonic() < ends:
            await asyncio.sleep(0.02)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    asyncio.run(run())
    assert until()
