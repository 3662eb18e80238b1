"""Start and stop of the server: lock, checks, services and event loop over a data folder.

One server per data folder: a second one fails, naming the process that holds the lock.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import logging
import os
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from sqlalchemy import Connection

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import keep_to_group
from amberbox.core.timestamps import format_time
from amberbox.link.join_line import JoinLine, join_line
from amberbox.server import app, certificates, process
from amberbox.server import settings as server_settings
from amberbox.server.accounts.passwords import Passwords
from amberbox.server.accounts.signin import SetupCode, needs_setup, new_setup_code
from amberbox.server.certificates import CertificateFiles, fingerprint
from amberbox.server.config import ListenOptions, ServerSettings, resolve_settings
from amberbox.server.database import FILE as DATABASE_FILE
from amberbox.server.database import DatabaseBusyError, refuse_damaged
from amberbox.server.process import LifecycleHooks
from amberbox.server.services.context import Demonstration, Services
from amberbox.server.settings import seal_plain

FILE = "lock"


class ServerLock:
    """Locks a data folder against a second server; the system releases it when the process ends."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._file = _opened(folder / FILE)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = _holder(self._file)
            self._file.close()
            raise UsageError(
                f"{folder} is in use by a server: {holder}",
                "stop that one first, or give this one a folder of its own with --data",
            ) from None
        held = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "since": format_time(clock.wall_ns()).partition(".")[0] + "Z",
        }
        self._file.seek(0)
        self._file.truncate()
        self._file.write(json.dumps(held) + "\n")
        self._file.flush()

    def release(self) -> None:
        """Release the lock."""
        self._file.close()


def _opened(path: Path) -> IO[str]:
    try:
        return path.open("a+", encoding="utf-8")
    except OSError as error:
        raise AmberboxError(
            f"cannot write {path}: {error.strerror}", "name a folder that the server may write"
        ) from error


def _holder(file: IO[str]) -> str:
    try:
        file.seek(0)
        held = json.loads(file.read())
        return f"process {held['pid']} on {held['host']}, since {held['since']}"
    except (OSError, ValueError, TypeError, KeyError):
        return "it does not say which"


_NAME = "server.reached"


@dataclass(frozen=True, slots=True)
class PublishedAddress:
    """The URL under which the server was last started, and whether it does TLS itself."""

    url: str = ""
    own_tls: bool = False


def save_address(connection: Connection, now_ns: int, settings: ServerSettings) -> None:
    """Store how the server is reached."""
    found = PublishedAddress(settings.public_url, settings.certificate is not None)
    if server_settings.read(connection, _NAME, PublishedAddress) != found:
        server_settings.write(connection, now_ns, _NAME, found)


def robot_join_line(connection: Connection, folder: Path, robot: str, key: str) -> JoinLine:
    """Return the line to paste on a robot; raises UsageError before the server's first start."""
    reached = server_settings.read(connection, _NAME, PublishedAddress)
    if not reached.url:
        raise UsageError(
            "nobody knows yet what this server is called", f"amberbox serve --data {folder}"
        )
    return join_line(reached.url, robot, key, fingerprint(folder) if reached.own_tls else "")


@dataclass(frozen=True, slots=True)
class StartedServer:
    """The result of a start: how the server is reached, and the setup code if one was made."""

    settings: ServerSettings
    code: SetupCode | None = None
    renewed: bool = False
    """Whether the server's certificate was renewed."""


def run(
    folder: Path,
    wanted: ListenOptions,
    *,
    new_code: bool = False,
    begun: Callable[[StartedServer], None] = lambda start: None,
    clock: Clock | None = None,
    demo: Demonstration | None = None,
) -> None:
    """Serve a data folder until stopped; ``begun`` is called once the server answers.

    With ``demo`` the server is part of a demonstration: people sign in by links and may inject
    faults into robots.

    Raises UsageError when another server has the folder, or the options are not safe.
    """
    clock = clock or SystemClock()
    keep_to_group()
    make_folder(folder)
    with _locked(folder, clock):
        refuse_damaged(folder / DATABASE_FILE)
        renewed = CertificateFiles(folder).are_there and certificates.renew(folder, clock.wall_ns())
        settings = resolve_settings(folder, wanted)
        port = process.listen(settings)
        process.raise_file_limit()
        services = process.make_services(folder, settings, clock, _passwords())
        services.demo = demo
        try:
            code = _prepared(services, new_code=new_code)
            hooks = LifecycleHooks(
                ready=lambda _: begun(StartedServer(settings, code, renewed)),
                stopping=(lambda: None) if demo is None else demo.end,
            )
            asyncio.run(process.serve(services, port, hooks))
        finally:
            port.close()
            process.close(services)


def _passwords() -> Passwords:
    """Return the password hasher; its first hash is computed while the routes load."""
    with ThreadPoolExecutor(1) as threads:
        hashing = threads.submit(Passwords)
        app.all_routes()
        return hashing.result()


def make_folder(folder: Path) -> None:
    """Create a data folder that only the server's user can read; raises AmberboxError."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise AmberboxError(
            f"cannot make the folder {folder}: {error.strerror}",
            "name one that the server may write",
        ) from error


def _prepared(services: Services, *, new_code: bool) -> SetupCode | None:
    """Store the server's address; return a setup code if one is needed or requested.

    Secrets of settings that an earlier version stored in plain text are encrypted.
    """
    with services.database.begin() as connection:
        save_address(connection, services.clock.wall_ns(), services.settings)
        is_first = needs_setup(connection)
        were_plain = seal_plain(connection)
    if were_plain:
        try:
            services.database.forget_deleted()
        except DatabaseBusyError as error:
            what = "secrets that were kept in plain text are encrypted, but remains of them may be"
            logging.getLogger(__name__).warning("%s in free places of %s", what, error.what)
    if not is_first and not new_code:
        return None
    return new_setup_code(services.database, services.clock, services.folder)


@contextlib.contextmanager
def _locked(folder: Path, clock: Clock) -> Iterator[None]:
    lock = ServerLock(folder, clock)
    try:
        yield
    finally:
        lock.release()
