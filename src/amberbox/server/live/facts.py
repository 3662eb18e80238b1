"""Declared components of robots, read from their folders once per folder version and cached."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import msgspec

from amberbox.core.errors import AmberboxError
from amberbox.server.ingest.folders import FolderService
from amberbox.server.workers.pool import WorkerPool
from amberbox.server.workers.protocol import BrokenError, BusyError, CancelledError, LimitError

OP = "amberbox.server.live.worker:facts"
_LIMIT_S = 20.0
_MEMORY_BYTES = 512 << 20
_REMEMBERED = 2000
# Time after which reading is retried that failed for lack of time, memory or a worker
AGAIN_S = 60.0
_PASSING = (LimitError, BrokenError, CancelledError)
_Key = tuple[str, str]
_T = TypeVar("_T")


class NeedFacts(msgspec.Struct, frozen=True):
    """A dependency of a component, and the component and mode that give its state; empty if there
    is none.
    """

    name: str
    component: str = ""
    mode: str = ""


class OutputFacts(msgspec.Struct, frozen=True):
    """The expected values of an output."""

    name: str
    expected: str = ""
    severity: str = ""
    description: str = ""
    hint: str = ""
    unit: str = ""


class ComponentFacts(msgspec.Struct, frozen=True):
    """One component as declared in its file; ``depth`` is its depth in the tree."""

    id: str
    name: str = ""
    depth: int = 0
    description: str = ""
    part_of: str = ""
    rule: str = ""
    needs: list[NeedFacts] = []
    outputs: dict[str, list[OutputFacts]] = {}
    names: dict[str, str] = {}
    recovery_actions: list[str] = []


class FolderFacts(msgspec.Struct, frozen=True):
    """A robot's model and components in tree order; ``note`` is why they are unknown."""

    model: str = ""
    components: list[ComponentFacts] = []
    note: str = ""


@dataclass(frozen=True, slots=True)
class _Failed:
    """Why a folder was not read, and when it is tried again."""

    facts: FolderFacts
    again_s: float


class FactsCache:
    """Folder facts by robot and configuration hash; threads may share it.

    Errors in a folder are final. A reading that failed for lack of time, memory or a worker is
    retried after ``AGAIN_S``; until then the facts carry the reason.
    """

    def __init__(
        self,
        folders: FolderService,
        worker_pool: WorkerPool,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folders = folders
        self._worker_pool = worker_pool
        self._now_s = now_s
        self._lock = threading.Lock()
        self._known: OrderedDict[_Key, FolderFacts] = OrderedDict()
        self._failed: OrderedDict[_Key, _Failed] = OrderedDict()
        self._turns: dict[_Key, threading.Lock] = {}

    def known(self, robot: str, config_hash: str) -> FolderFacts | None:
        """Return the cached facts, or None; never blocks."""
        return self._known.get((robot, config_hash))

    def at_once(self, robot: str, config_hash: str) -> FolderFacts | None:
        """Return known facts, or facts with a note; None where ``read`` would ask a worker."""
        known = self.known(robot, config_hash)
        if known is not None:
            return known
        if not config_hash or self._folders.wants(robot, config_hash):
            return FolderFacts(note="the robot's folder is not here yet")
        failed = self._failed.get((robot, config_hash))
        return failed.facts if failed and self._now_s() < failed.again_s else None

    def read(self, robot: str, config_hash: str) -> FolderFacts:
        """Return the facts of a folder; blocks the first time. Without one, facts with a note."""
        found = self.at_once(robot, config_hash)
        if found is not None:
            return found
        key = robot, config_hash
        with self._lock:
            turn = self._turns.setdefault(key, threading.Lock())
        with turn:  # one thread asks, the others wait for its answer
            found = self.at_once(robot, config_hash) or self._read_in_worker(robot, config_hash)
        with self._lock:
            self._turns.pop(key, None)
        return found

    def _read_in_worker(self, robot: str, config_hash: str) -> FolderFacts:
        arguments = {"robot": robot, "config_hash": config_hash}
        key = robot, config_hash
        try:
            answer = self._worker_pool.ask_now(OP, arguments, _LIMIT_S, _MEMORY_BYTES, origin=robot)
            found = msgspec.json.decode(answer, type=FolderFacts)
        except BusyError as error:
            return _unread(error)
        except _PASSING as error:
            found = _unread(error)
            with self._lock:
                _enter(self._failed, key, _Failed(found, self._now_s() + AGAIN_S))
            return found
        except AmberboxError as error:
            found = _unread(error)
        with self._lock:
            self._failed.pop(key, None)
            _enter(self._known, key, found)
        return found


def _unread(error: AmberboxError) -> FolderFacts:
    return FolderFacts(note=f"the robot's folder cannot be read: {error.what.splitlines()[0]}")


def _enter(known: OrderedDict[_Key, _T], key: _Key, value: _T) -> None:
    known[key] = value
    while len(known) > _REMEMBERED:
        known.popitem(last=False)
