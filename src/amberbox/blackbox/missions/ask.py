"""Begin and end missions from outside: through the keeper, or in its place where none runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from amberbox.blackbox.follow.chain import previous_chain
from amberbox.blackbox.keeper.missions import KIND, MissionKeeper
from amberbox.blackbox.keeper.missiontracker import id_of
from amberbox.blackbox.keeper.ownjournal import OwnJournal
from amberbox.blackbox.missions.mission import Mission, load
from amberbox.blackbox.requests import submit
from amberbox.blackbox.store import Store, WriterLock, open_store
from amberbox.blackbox.where import store_path
from amberbox.core.clock import SystemClock
from amberbox.core.config import did_you_mean
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.ids import is_id

PATIENCE_S = 5.0
_POLL_S = 0.05


def start(
    where: str | Path,
    name: str,
    *,
    mission_id: str = "",
    parameters: Mapping[str, Any] | None = None,
    who: str = "",
    patience_s: float = PATIENCE_S,
) -> Mission:
    """Begin a mission now; one of the same name that still lasts ends.

    Raises UsageError for a name or id that is none or is taken, AmberboxError when the keeper
    does not answer.
    """
    for text in (name, mission_id or name):
        if not is_id(text):
            raise UsageError(f"'{text}' is no id", "use a-z 0-9 _ . - , at most 64 of them")
    store = open_store(store_path(where))
    if mission_id and any(m.id == mission_id for m in load(store.path)):
        raise UsageError(f"there is a mission '{mission_id}' already", "choose another id")
    chosen = mission_id or id_of(name, time.time_ns())
    values = {"name": name, "id": chosen, "parameters": dict(parameters or {}), "who": who}
    return _ask(store, {"action": "start", **values}, chosen, patience_s)


def end(
    where: str | Path,
    mission_id: str = "",
    *,
    outcome: str = "",
    failed: bool | None = None,
    who: str = "",
    patience_s: float = PATIENCE_S,
) -> Mission:
    """End a mission now: the one of this id, else the one that began last.

    Raises UsageError when none like that lasts, AmberboxError when the keeper does not answer.
    """
    store = open_store(store_path(where))
    lasting = [mission for mission in load(store.path) if mission.to_ns is None]
    wanted = [m for m in lasting if mission_id in ("", m.id)]
    if not wanted:
        what = f"no mission '{mission_id}' lasts" if mission_id else "no mission lasts"
        raise UsageError(
            what + did_you_mean(mission_id, [m.id for m in lasting]),
            "amberbox mission list WHERE shows them all",
        )
    chosen = wanted[-1].id
    values = {"id": chosen, "outcome": outcome, "failed": failed, "who": who}
    return _ask(store, {"action": "end", **values}, chosen, patience_s)


def _ask(store: Store, values: dict[str, Any], mission_id: str, patience_s: float) -> Mission:
    """Leave a request, see that it is done, and return the mission as it is then."""
    path = submit(store, KIND, {**values, "boot_id": SystemClock().boot_id()})
    until = time.monotonic() + patience_s
    while path.exists():
        if as_keeper(store, lambda keeper: keeper.step()):
            continue
        if time.monotonic() > until:
            path.unlink(missing_ok=True)
            raise AmberboxError(
                "the keeper of this record does not answer; nothing was written down",
                "see whether it is busy or stuck: amberbox doctor FOLDER",
            )
        time.sleep(_POLL_S)
    found = next((m for m in load(store.path) if m.id == mission_id), None)
    if found is None or (values["action"] == "end" and found.end is None):
        raise AmberboxError(
            f"the keeper refused to {values['action']} the mission '{mission_id}'",
            "amberbox events WHERE says why",
        )
    return found


def as_keeper(store: Store, work: Callable[[MissionKeeper], object]) -> bool:
    """Do something in the keeper's place; False if there is a keeper."""
    try:
        lock = WriterLock(store, "keeper")
    except UsageError:
        return False
    journal = OwnJournal(store, "keep", chain=lambda: previous_chain(store, "keep"))
    try:
        work(MissionKeeper(store, (), journal))
    finally:
        journal.close()
        lock.release()
    return True


def write(store: Store, missions: list[Mission]) -> None:
    """Write down missions that were found later; raises AmberboxError while a keeper runs."""

    def add(keeper: MissionKeeper) -> None:
        for mission in missions:
            began = replace(mission, end=None, outcome="", failed=False)
            keeper.note([began] if mission.end is None else [began, mission])

    if missions and not as_keeper(store, add):
        raise AmberboxError(
            "a keeper runs on this store", "stop the recorder first, or put the rules in robot.yaml"
        )
