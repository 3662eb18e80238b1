"""Detection of changes in the robot folder, and their check before children are restarted.

``amberbox check`` runs in a separate process.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from amberbox.agent.process import amberbox_command
from amberbox.blackbox.robot_folder.folder import BLACK_BOX_FILE, ROBOT_FILE
from amberbox.blackbox.robot_folder.robot_yaml import KEY_FILE

FolderSnapshot = frozenset[tuple[str, int, int]]


def folder_snapshot(folder: Path, store: Path) -> FolderSnapshot:
    """Return name, size and modification time of each file, without the store and hidden files."""
    return frozenset(_files(folder, store.resolve()))


def _files(folder: Path, store: Path) -> Iterator[tuple[str, int, int]]:
    with suppress(OSError):  # a folder removed while it is read counts as changed next time
        for path in folder.iterdir():
            if path.name.startswith(".") or path.name == "__pycache__" or path.resolve() == store:
                continue
            if path.is_dir() and not path.is_symlink():
                yield from _files(path, store)
            else:
                about = path.stat()
                yield str(path), about.st_size, about.st_mtime_ns


def read_server_key(folder: Path) -> bytes:
    """Return the key to the server, which is no part of the configuration's hash."""
    with suppress(OSError):
        return (folder / KEY_FILE).read_bytes()
    return b""


def recorder_config_hash(folder: Path) -> str:
    """Return a hash of the recorder's configuration; changes need a new recorder process."""
    total = hashlib.sha256()
    for name in (ROBOT_FILE, BLACK_BOX_FILE):
        with suppress(OSError):
            total.update(name.encode() + b"\0" + (folder / name).read_bytes())
    return total.hexdigest()


LIMIT_S = 120.0
_NICE = 10


@dataclass(frozen=True, slots=True)
class FolderVerdict:
    """Result of checking a folder; ``trouble`` is the first error and the count of the others."""

    is_right: bool
    trouble: str = ""
    config_hash: str = ""
    store: str = ""


class FolderCheck:
    """One running check; ``answer`` returns None until it has finished."""

    def __init__(self, folder: Path, now_s: float, command: Sequence[str] = ()) -> None:
        self._output = os.memfd_create("check")
        self._until_s = now_s + LIMIT_S
        asked = [
            "nice",
            "-n",
            str(_NICE),
            *(command or amberbox_command("check", "--json", str(folder))),
        ]
        self._process = subprocess.Popen(
            asked, stdin=subprocess.DEVNULL, stdout=self._output, stderr=subprocess.DEVNULL,
            process_group=0,
        )  # fmt: skip

    def answer(self, now_s: float) -> FolderVerdict | None:
        """Return the result of the check, None while it runs; a check that takes too long fails."""
        if self._process.poll() is None:
            if now_s < self._until_s:
                return None
            self.close()
            return FolderVerdict(False, f"amberbox check gave no answer within {LIMIT_S:.0f} s")
        size = os.fstat(self._output).st_size
        text = os.pread(self._output, size, 0)
        self.close()
        return read_verdict(text)

    def close(self) -> None:
        """Cancel the check, if it still runs."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if self._output >= 0:
            os.close(self._output)
            self._output = -1


def read_verdict(text: bytes) -> FolderVerdict:
    """Parse the output of ``amberbox check --json``."""
    try:
        report: Mapping[str, Any] = json.loads(text)
    except ValueError:
        return FolderVerdict(False, "amberbox check gave no answer")
    errors = [problem for problem in report.get("problems", ()) if problem["is_error"]]
    if not report["ok"]:
        return FolderVerdict(False, _first_of(errors))
    return FolderVerdict(True, "", str(report["config_hash"]), str(report["store"]))


def _first_of(errors: Sequence[Mapping[str, Any]]) -> str:
    if not errors:
        return "amberbox check names no error"
    first = "{file}:{line}: {where}: {what}".format_map(errors[0])
    return first if len(errors) == 1 else f"{first}; {len(errors) - 1} more"


POLL_S = 2.0
PAUSE_S = 10.0  # least time between two checks of a folder that keeps changing


class RunningCheck(Protocol):
    """A running check."""

    def answer(self, now_s: float) -> FolderVerdict | None:
        """Return the result of the check, None while it runs."""

    def close(self) -> None:
        """Cancel it."""


class FolderWatch:
    """Polls a folder; ``step`` returns a result when there is a new one."""

    def __init__(
        self, folder: Path, store: Path, judge: Callable[[Path, float], RunningCheck] = FolderCheck
    ) -> None:
        self._folder, self._store, self._judge = folder, store, judge
        self._judged = self._seen = self._look()
        self._question: RunningCheck | None = None
        self._due_s = self._not_before_s = -math.inf
        self._requested = False

    def ask(self) -> None:
        """Request a check now, changed or not."""
        self._requested = True

    def step(self, now_s: float) -> FolderVerdict | None:
        """Check for changes, if the polling interval has passed."""
        if self._question is not None:
            answer = self._question.answer(now_s)
            if answer is not None:
                self._question = None
            return answer
        if self._requested:
            self._requested = False
            self._begin(self._look(), now_s)
        elif now_s >= self._due_s:
            self._due_s = now_s + POLL_S
            found = self._look()
            rests, self._seen = found == self._seen, found
            if rests and found != self._judged and now_s >= self._not_before_s:
                self._begin(found, now_s)
        return None

    def close(self) -> None:
        """Cancel a running check."""
        if self._question is not None:
            self._question.close()

    def _look(self) -> FolderSnapshot:
        return folder_snapshot(self._folder, self._store)

    def _begin(self, found: FolderSnapshot, now_s: float) -> None:
        self._judged, self._not_before_s = found, now_s + PAUSE_S
        self._question = self._judge(self._folder, now_s)
