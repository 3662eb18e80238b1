"""Mark an incident by hand: from the command line, from a program, from the robot's agent."""

from __future__ import annotations

import getpass
from pathlib import Path

from amberbox.blackbox.folder.folder import load_folder
from amberbox.blackbox.folder.keeping import keeper_options
from amberbox.blackbox.incidents.budget import Refusal
from amberbox.blackbox.incidents.incident import Incident, load
from amberbox.blackbox.incidents.pin import Wish, pin, release
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.requests import submit
from amberbox.blackbox.store import is_store, open_store
from amberbox.blackbox.where import store_path
from amberbox.core.errors import AmberboxError, ConfigurationError


def mark(
    where: str | Path,
    *,
    before_s: float = 60.0,
    after_s: float = 20.0,
    reason: str = "",
    who: str = "",
    trigger: str = "",
) -> Incident:
    """Keep all items from ``before_s`` before the end of the record until ``after_s`` from now.

    It is pinned when this returns, also while neither recorder nor keeper run. Raises UsageError
    if there is no record at ``where``, AmberboxError if incidents hold as much as they may.
    """
    store = open_store(store_path(where))
    wish = Wish(before_s, after_s, reason, who or user(), trigger)
    done = pin(store, wish, options_of(where))
    if isinstance(done, Refusal):
        submit(store, "incident", {"refused": done.reason, "reason": reason, "who": wish.who})
        raise AmberboxError(
            f"not pinned: {done.reason}",
            f"amberbox incident list {where}; amberbox incident release {where} ID",
        )
    return done


def release_incident(where: str | Path, incident_id: str) -> Incident:
    """Let go of an incident; raises UsageError when there is none of this id."""
    store = open_store(store_path(where))
    return release(store, load(store, incident_id))


def options_of(where: str | Path) -> KeeperOptions:
    """Return what a robot folder tells its keeper; the defaults for a store alone."""
    if is_store(Path(where)):
        return KeeperOptions()
    try:
        return keeper_options(load_folder(where))
    except ConfigurationError:  # a mistake in the folder must not stand in the way now
        return KeeperOptions()


def user() -> str:
    """Name the person at the keyboard, as far as the computer knows."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no such user: a container, say
        return ""
