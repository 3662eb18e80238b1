"""Models of teams that follow their robots: run over what these hand in, alarms kept as found."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.files import replace_file
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.learning import models
from amberbox.server.learning.models import FOLDER, StoredModel
from amberbox.server.workers.pool import WorkerPool

FILE = "follow.json"
"""Beside a model's file, as long as the model follows its robots."""
MOST_ALARMS = 1000
STEP_NS = 600 * NS
"""So much of a record is read at once."""

_OP = "amberbox.server.learning.worker:follow"
_LOOK_S = 60.0
_LIMIT_S = 120.0  # of a step, for which nobody waits


class FollowState(msgspec.Struct, frozen=True):
    """How far a model has followed its robots, and what it has found.

    All times before ``until_ns``, of the server's clock, are done; ``ahead_ns`` is how far that was
    ahead of each robot's clock in the beginning. ``snapshot`` is the state of the detectors.
    ``alarms`` are those of ``alarm_to_json``, the newest ones, in order of confirmation.
    """

    from_ns: int
    until_ns: int
    ahead_ns: dict[str, int]
    snapshot: dict[str, Any] | None = None
    alarms: list[dict[str, Any]] = []
    error: str = ""


class FollowService:
    """Lets the models that follow their robots go on whenever journals have come.

    The state is a file beside the model's, so that it ends with it, and an interrupted step is
    done again.
    """

    def __init__(
        self, folder: Path, database: ServerDatabase, bus: EventBus, pool: WorkerPool
    ) -> None:
        self._folder = folder / FOLDER
        self._database = database
        self._bus = bus
        self._pool = pool
        self._lock = threading.Lock()
        self._wake = asyncio.Event()
        for kind in ("journal", "job"):
            bus.on(kind, lambda change: self._wake.set())

    def start(
        self, model: StoredModel, from_ns: int, ahead_ns: Mapping[str, int]
    ) -> tuple[FollowState, bool]:
        """Let a finished model follow from a time of the server's clock on.

        Returns its state, and whether it has begun now.
        """
        with self._lock:
            state = self.state(model.id)
            if state is not None:
                return state, False
            state = FollowState(from_ns, from_ns, dict(ahead_ns))
            replace_file(self._path(model.id), msgspec.json.encode(state))
        return state, True

    def stop(self, model_id: str) -> None:
        """Let a model follow no longer, and forget what it has found."""
        with self._lock:
            self._path(model_id).unlink(missing_ok=True)

    def state(self, model_id: str) -> FollowState | None:
        """Return how far a model is; None if it does not follow."""
        try:
            return msgspec.json.decode(self._path(model_id).read_bytes(), type=FollowState)
        except FileNotFoundError:
            return None

    async def run(self) -> None:
        """Work until cancelled."""
        self._wake = asyncio.Event()  # belongs to this event loop
        while True:
            for model in await asyncio.to_thread(self._following):
                while await self._step(model):
                    pass
            with suppress(TimeoutError):
                async with asyncio.timeout(_LOOK_S):
                    await self._wake.wait()
            self._wake.clear()

    def close(self) -> None:
        """Do nothing: the workers are the server's."""

    def _path(self, model_id: str) -> Path:
        return self._folder / model_id / FILE

    def _following(self) -> list[StoredModel]:
        with self._database.reading() as connection:
            found = models.listed(connection)
        return [one for one in found if one.state == "done" and self._path(one.id).is_file()]

    async def _step(self, model: StoredModel) -> bool:
        """Let a model go on; return whether there may be more to read."""
        before = await asyncio.to_thread(self.state, model.id)
        if before is None:
            return False
        arguments = {"id": model.id, "file": model.file, "robots": model.wanted.robots}
        try:
            answer = await self._pool.ask(_OP, arguments, _LIMIT_S)
            after = msgspec.json.decode(answer, type=FollowState)
        except Exception as error:  # only this model does not go on, until the next journal comes
            text = error.what if isinstance(error, AmberboxError) else type(error).__name__
            logging.getLogger(__name__).warning("%s does not follow", model.id, exc_info=error)
            after = msgspec.structs.replace(before, error=text)
        if after == before or not await asyncio.to_thread(self._replace, model.id, before, after):
            return False
        self._bus.publish(ServerChange("job", "", {"id": model.id, "owner": model.owner}))
        return after.until_ns > before.until_ns

    def _replace(self, model_id: str, before: FollowState, after: FollowState) -> bool:
        """Keep a new state, unless the model was stopped, or begun anew, meanwhile."""
        with self._lock:
            is_same = self.state(model_id) == before
            if is_same:
                replace_file(self._path(model_id), msgspec.json.encode(after))
        return is_same


def with_changes(
    alarms: list[dict[str, Any]], changes: Iterator[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return alarms with those that have begun or ended since, the newest ``MOST_ALARMS``."""
    found = [dict(alarm) for alarm in alarms]
    for change in changes:
        key = change["detector"], change["series"], change["confirmed_ns"]
        at = [n for n, one in enumerate(found)
              if (one["detector"], one["series"], one["confirmed_ns"]) == key]  # fmt: skip
        if at:
            found[at[-1]] = dict(change)
        else:
            found.append(dict(change))
    return sorted(found, key=lambda alarm: int(alarm["confirmed_ns"]))[-MOST_ALARMS:]
