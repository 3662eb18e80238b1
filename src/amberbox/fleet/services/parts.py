"""What a running server has: made once, handed to every route."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from amberbox.core.clock import Clock
from amberbox.fleet.accounts.passwords import Passwords
from amberbox.fleet.alarms.alarms import Alarms
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.keeping import Keeping
from amberbox.fleet.asking.asking import Asking
from amberbox.fleet.bus import Bus
from amberbox.fleet.database.database import Database
from amberbox.fleet.demonstration import Demonstration
from amberbox.fleet.feed.feed import Feed
from amberbox.fleet.fetches.fetches import Fetches
from amberbox.fleet.folders.folders import Folders
from amberbox.fleet.jobs.jobs import Jobs
from amberbox.fleet.knowledge.explained import Explained
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.serving.doorkeeper import Doorkeeper
from amberbox.fleet.serving.settings import Settings
from amberbox.fleet.serving.threads import Threads
from amberbox.fleet.system.system import SystemLevel
from amberbox.fleet.uploads.desk import Desk


@dataclass(slots=True, eq=False)
class Services:
    """The parts of the server, by what they are for; ``assembly.py`` puts them together."""

    folder: Path
    settings: Settings
    clock: Clock
    database: Database
    passwords: Passwords
    bus: Bus
    archive: FolderArchive
    links: LinkServer
    desk: Desk
    folders: Folders
    asking: Asking
    """Answers people."""
    preparing: Asking
    """Unpacks and reads what robots send, and explains it before anybody asks."""
    explained: Explained
    jobs: Jobs
    fetches: Fetches
    alarms: Alarms
    feed: Feed
    system: SystemLevel
    keeping: Keeping
    doors: Doorkeeper
    threads: Threads
    demo: Demonstration | None = None
    """Set where the server is part of a demonstration: ``amberbox demo``, and nothing else."""
