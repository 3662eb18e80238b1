"""Put the parts of a server together: who is told of what."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sqlalchemy import select

from amberbox.core.clock import Clock, SystemClock
from amberbox.fleet.accounts.passwords import Passwords
from amberbox.fleet.alarms.alarms import Alarms
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.keeping import Keeping
from amberbox.fleet.archive.store import JournalKey
from amberbox.fleet.asking.asking import Asking
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import FILE, Database
from amberbox.fleet.feed.feed import Feed
from amberbox.fleet.fetches.fetches import Fetches
from amberbox.fleet.folders.folders import Folders
from amberbox.fleet.jobs.jobs import Jobs
from amberbox.fleet.knowledge.announcing import announce
from amberbox.fleet.knowledge.explained import Explained
from amberbox.fleet.linkend.server import Hooks, LinkServer
from amberbox.fleet.linkend.tables import STORE
from amberbox.fleet.pages.warming import Warming
from amberbox.fleet.part import Part
from amberbox.fleet.services import Services
from amberbox.fleet.serving.doorkeeper import Doorkeeper
from amberbox.fleet.serving.settings import Settings
from amberbox.fleet.serving.threads import Threads
from amberbox.fleet.state.state import State
from amberbox.fleet.system.system import SystemLevel
from amberbox.fleet.uploads.desk import Desk
from amberbox.fleet.uploads.pieces import Incoming
from amberbox.fleet.uploads.verifying import Result


def assemble(
    folder: Path,
    settings: Settings,
    clock: Clock | None = None,
    passwords: Passwords | None = None,
) -> Services:
    """Make all parts over a server's data folder, which has to be there; nothing runs yet."""
    clock = clock or SystemClock()
    database = Database(folder / FILE, clock)
    bus = Bus()
    announce(bus)
    archive = FolderArchive(folder, database, clock)
    asking = Asking(folder)
    preparing = Asking.for_robots(folder)
    folders = Folders(folder, database, bus, clock, preparing)
    links = LinkServer(database, _hooks(bus, folders), clock)
    state = State(database, archive, bus, links, folders, preparing)
    desk = Desk(
        folder,
        database,
        partial(_public_key, database),
        clock,
        verified=partial(_keep, archive, bus),
    )
    return Services(
        folder=folder, settings=settings, clock=clock, database=database,
        passwords=passwords or Passwords(), bus=bus, archive=archive, links=links, desk=desk,
        folders=folders, asking=asking, preparing=preparing,
        explained=Explained(database, archive, bus, clock, asking, preparing),
        jobs=Jobs(folder, database, bus, clock),
        fetches=Fetches(folder, database, bus, clock, links),
        alarms=Alarms(database, bus, clock, settings.public_url),
        feed=Feed(database, bus, clock, links, state),
        system=SystemLevel(folder, bus, clock, links),
        keeping=Keeping(folder, database, bus, clock, archive),
        doors=Doorkeeper(database, bus, clock, links), threads=Threads(),
    )  # fmt: skip


def parts(services: Services) -> Sequence[Part]:
    """Return what works in the background."""
    return (
        services.folders, services.asking, services.explained, services.jobs, services.fetches,
        services.alarms, services.feed, services.system, services.keeping, services.doors,
        Warming(),
    )  # fmt: skip


def close(services: Services) -> None:
    """Let go of everything, in the order of who needs whom."""
    for part in reversed(parts(services)):
        part.close()
    services.preparing.close()
    services.links.close()
    services.threads.close()
    services.desk.close()
    services.passwords.close()
    services.database.close()


def _hooks(bus: Bus, folders: Folders) -> Hooks:
    return Hooks(
        rows=lambda robot, store, rows: bus.publish(
            Change("rows", robot, {"store_id": store, "rows": rows})
        ),
        admitted=lambda hello, admission: bus.publish(
            Change("connected", hello.robot, {"hello": hello, "admission": admission})
        ),
        gone=lambda robot: bus.publish(Change("gone", robot)),
        live=lambda robot, values: bus.publish(Change("live", robot, {"values": values})),
        has=lambda robot, store, has: bus.publish(
            Change("has", robot, {"store_id": store, "id": has.id, "files": has.files})
        ),
        wants_folder=folders.wants,
    )


def _public_key(database: Database, robot: str, store_id: str) -> str:
    """Return with which key a robot said, in its hello, that its store signs."""
    chosen = select(STORE.c.public_key).where(STORE.c.robot == robot, STORE.c.store_id == store_id)
    with database.reading() as connection:
        return str(connection.execute(chosen).scalar() or "")


def _keep(archive: FolderArchive, bus: Bus, incoming: Incoming, result: Result, path: Path) -> None:
    """Hand a verified journal to the archive, and tell of it."""
    state = "aside"
    if path.is_relative_to(archive.layout.journals):
        key = JournalKey(incoming.robot, incoming.store_id, incoming.journal, incoming.sha256)
        archive.put(key, path, is_checked=result.signed)  # sealed and signed: all of it holds
        state = "verified"
    told = {"store_id": incoming.store_id, "journal": incoming.journal, "state": state}
    bus.publish(Change("journal", incoming.robot, told))
