"""What is known of robots from their folders: read once for each folder, then remembered."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import msgspec

from amberbox.core.errors import AmberboxError
from amberbox.fleet.asking.asking import Asking
from amberbox.fleet.asking.errors import BrokenError, BusyError, CancelledError, LimitError
from amberbox.fleet.folders.folders import Folders

OP = "amberbox.fleet.state.worker:facts"
_LIMIT_S = 20.0
_MEMORY_BYTES = 512 << 20
_REMEMBERED = 2000
AGAIN_S = 60.0
"""After so long a folder is read again where time, memory or a worker was lacking."""
_PASSING = (LimitError, BrokenError, CancelledError)
_Key = tuple[str, str]
_T = TypeVar("_T")


class NeedFacts(msgspec.Struct, frozen=True):
    """What a component needs; judged by a component's mode, or nothing where that is empty."""

    name: str
    component: str = ""
    mode: str = ""


class OutputFacts(msgspec.Struct, frozen=True):
    """What is expected of an output."""

    name: str
    expected: str = ""
    severity: str = ""
    description: str = ""
    hint: str = ""
    unit: str = ""


class ComponentFacts(msgspec.Struct, frozen=True):
    """One component as its file has it; ``depth`` is how deep it stands in the tree."""

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


class Facts(msgspec.Struct, frozen=True):
    """A robot's model and components in the order of the tree; ``note`` says what is missing."""

    model: str = ""
    components: list[ComponentFacts] = []
    note: str = ""


@dataclass(frozen=True, slots=True)
class _Failed:
    """Why a folder was not read, and when it is tried again."""

    facts: Facts
    again_s: float


class FactsBook:
    """Facts by robot and hash of its folder; threads may share it.

    A folder that is wrong stays so. What could not be read for lack of time, memory or a worker is
    asked for again after ``AGAIN_S``; until then the facts say why nothing is known.
    """

    def __init__(
        self, folders: Folders, asking: Asking, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._folders = folders
        self._asking = asking
        self._now_s = now_s
        self._lock = threading.Lock()
        self._known: OrderedDict[_Key, Facts] = OrderedDict()
        self._failed: OrderedDict[_Key, _Failed] = OrderedDict()
        self._turns: dict[_Key, threading.Lock] = {}

    def known(self, robot: str, config_hash: str) -> Facts | None:
        """Return what was read before; never waits."""
        return self._known.get((robot, config_hash))

    def at_once(self, robot: str, config_hash: str) -> Facts | None:
        """Return what is known, or why nothing is; None where ``read`` would ask a worker."""
        known = self.known(robot, config_hash)
        if known is not None:
            return known
        if not config_hash or self._folders.wants(robot, config_hash):
            return Facts(note="the robot's folder is not here yet")
        failed = self._failed.get((robot, config_hash))
        return failed.facts if failed and self._now_s() < failed.again_s else None

    def read(self, robot: str, config_hash: str) -> Facts:
        """Return what a folder says; blocks the first time. Without one, facts with a note."""
        found = self.at_once(robot, config_hash)
        if found is not None:
            return found
        key = robot, config_hash
        with self._lock:
            turn = self._turns.setdefault(key, threading.Lock())
        with turn:  # one asks, the others wait for its answer
            found = self.at_once(robot, config_hash) or self._ask(robot, config_hash)
        with self._lock:
            self._turns.pop(key, None)
        return found

    def _ask(self, robot: str, config_hash: str) -> Facts:
        arguments = {"robot": robot, "config_hash": config_hash}
        key = robot, config_hash
        try:
            answer = self._asking.ask_now(OP, arguments, _LIMIT_S, _MEMORY_BYTES, asker=robot)
            found = msgspec.json.decode(answer, type=Facts)
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


def _unread(error: AmberboxError) -> Facts:
    return Facts(note=f"the robot's folder cannot be read: {error.what.splitlines()[0]}")


def _enter(known: OrderedDict[_Key, _T], key: _Key, value: _T) -> None:
    known[key] = value
    while len(known) > _REMEMBERED:
        known.popitem(last=False)
