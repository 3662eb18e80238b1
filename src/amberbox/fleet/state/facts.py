"""What is known of robots from their folders: read once for each folder, then remembered."""

from __future__ import annotations

import threading
from collections import OrderedDict

import msgspec

from amberbox.core.errors import AmberboxError
from amberbox.fleet.asking.asking import Asking
from amberbox.fleet.asking.errors import BusyError
from amberbox.fleet.folders.folders import Folders

OP = "amberbox.fleet.state.worker:facts"
_LIMIT_S = 20.0
_MEMORY_BYTES = 512 << 20
_REMEMBERED = 2000


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


class FactsBook:
    """Facts by robot and hash of its folder; threads may share it."""

    def __init__(self, folders: Folders, asking: Asking) -> None:
        self._folders = folders
        self._asking = asking
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[str, str], Facts] = OrderedDict()

    def known(self, robot: str, config_hash: str) -> Facts | None:
        """Return what was read before; never waits."""
        return self._known.get((robot, config_hash))

    def read(self, robot: str, config_hash: str) -> Facts:
        """Return what a folder says; blocks the first time. Without one, facts with a note."""
        known = self.known(robot, config_hash)
        if known is not None:
            return known
        if not config_hash or self._folders.wants(robot, config_hash):
            return Facts(note="the robot's folder is not here yet")
        found, is_lasting = self._asked(robot, config_hash)
        if is_lasting:
            with self._lock:
                self._known[robot, config_hash] = found
                while len(self._known) > _REMEMBERED:
                    self._known.popitem(last=False)
        return found

    def _asked(self, robot: str, config_hash: str) -> tuple[Facts, bool]:
        arguments = {"robot": robot, "config_hash": config_hash}
        try:
            answer = self._asking.ask_now(OP, arguments, _LIMIT_S, _MEMORY_BYTES, asker=robot)
            return msgspec.json.decode(answer, type=Facts), True
        except AmberboxError as error:
            first = error.what.splitlines()[0]
            note = f"the robot's folder cannot be read: {first}"
            return Facts(note=note), not isinstance(error, BusyError)
