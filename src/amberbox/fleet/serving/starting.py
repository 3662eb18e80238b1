"""Everything from a data folder to a server that answers, and back."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.core.files import keep_to_group
from amberbox.fleet.accounts.passwords import Passwords
from amberbox.fleet.accounts.setupcode import SetupCode, needs_setup, new_setup_code
from amberbox.fleet.database.database import FILE, DatabaseBusyError, refuse_damaged
from amberbox.fleet.database.lock import ServerLock
from amberbox.fleet.demonstration import Demonstration
from amberbox.fleet.options.options import seal_plain
from amberbox.fleet.services import Services
from amberbox.fleet.serving import app, assembly, certificates, process
from amberbox.fleet.serving.binding import Wanted, settings_of
from amberbox.fleet.serving.certificates import Files
from amberbox.fleet.serving.process import Told
from amberbox.fleet.serving.reached import note_reached
from amberbox.fleet.serving.settings import Settings


@dataclass(frozen=True, slots=True)
class Start:
    """What a start came to: how the server is reached, and the code if one was made."""

    settings: Settings
    code: SetupCode | None = None
    renewed: bool = False
    """Whether the server's certificate was made anew."""


def run(
    folder: Path,
    wanted: Wanted,
    *,
    new_code: bool = False,
    begun: Callable[[Start], None] = lambda start: None,
    clock: Clock | None = None,
    demo: Demonstration | None = None,
) -> None:
    """Serve a data folder until somebody stops it; ``begun`` is told once it answers.

    With ``demo`` it is part of a demonstration: people sign in by links, and may break robots.

    Raises UsageError when another server has the folder, or what is wanted is not safe.
    """
    clock = clock or SystemClock()
    keep_to_group()
    make_folder(folder)
    with _locked(folder, clock):
        refuse_damaged(folder / FILE)
        renewed = Files(folder).are_there and certificates.renew(folder, clock.wall_ns())
        settings = settings_of(folder, wanted)
        port = process.listen(settings)
        process.raise_file_limit()
        services = assembly.assemble(folder, settings, clock, _passwords())
        services.demo = demo
        try:
            code = _prepared(services, new_code=new_code)
            told = Told(
                ready=lambda _: begun(Start(settings, code, renewed)),
                stopping=(lambda: None) if demo is None else demo.end,
            )
            asyncio.run(process.serve(services, port, told))
        finally:
            port.close()
            assembly.close(services)


def _passwords() -> Passwords:
    """Make what hashes passwords; its first hash takes as long as to load the routes: together."""
    with ThreadPoolExecutor(1) as threads:
        hashing = threads.submit(Passwords)
        app.rooms()
        return hashing.result()


def make_folder(folder: Path) -> None:
    """Make a data folder that only the server's user can look into; raises AmberboxError."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise AmberboxError(
            f"cannot make the folder {folder}: {error.strerror}",
            "name one that the server may write",
        ) from error


def _prepared(services: Services, *, new_code: bool) -> SetupCode | None:
    """Write down how the server is reached; make a code where one is needed or wanted.

    Secrets of settings that an earlier version kept in plain text are encrypted.
    """
    with services.database.begin() as connection:
        note_reached(connection, services.clock.wall_ns(), services.settings)
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
