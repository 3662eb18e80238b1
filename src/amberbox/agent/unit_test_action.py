"""Unit tests as actions: announced to the server, and run on its command as ``test.NAME``."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.agent.unit_tests import (
    COLLECTION_S,
    Progress,
    Result,
    RunTask,
    UnitTestRun,
    collect,
    known_tests,
)
from amberbox.core.command import Risk
from amberbox.core.errors import AmberboxError, NotStartedError, UsageError, did_you_mean
from amberbox.experiments.action import ActionOptions, DeclaredAction
from amberbox.experiments.unit_tests import (
    ACTION_PREFIX,
    FOLDER,
    TestCollection,
    UnitTest,
    UnitTestResult,
    files_of,
    within_bytes,
)

if TYPE_CHECKING:
    from amberbox.core.contracts import ActionContext

RESULT_BYTES = 16_000
"""Largest result, JSON: what an actor passes on."""
_END_S = 30.0
_LOOK_S = 0.1


@dataclass(frozen=True)
class Config:
    """Which test of which folder, and what its actions may do at most."""

    folder: str
    test: str
    risk: Risk


def is_unit_test(action: str) -> bool:
    """Return whether the name of an action is that of a unit test."""
    return action.startswith(ACTION_PREFIX)


def load_unit_test(folder: Path, action: str) -> DeclaredAction:
    """Return a unit test as an action; raises UsageError if it was not collected as it is now."""
    found = known_tests(folder)
    if found is None:
        raise UsageError(f"the files in {FOLDER}/ have changed since they were announced")
    names = {ACTION_PREFIX + test.name: test for test in found.tests}
    if action not in names:
        raise UsageError(f"this robot has no '{action[:64]}'{did_you_mean(action, names)}")
    return _as_action(folder, names[action])


def _as_action(folder: Path, test: UnitTest) -> DeclaredAction:
    options = ActionOptions(
        kind="unit_test", risk=test.commanded_risk, description=test.description,
        timeout=test.timeout_s + COLLECTION_S + _END_S,
    )  # fmt: skip
    config = Config(str(folder), test.name, test.risk)
    module = sys.modules[__name__]
    name = ACTION_PREFIX + test.name
    return DeclaredAction(name, options, config, module, str(folder / test.file), test.line)


def run(config: Config, context: ActionContext) -> Mapping[str, Any]:
    """Run the test and return its ``UnitTestResult``, also when it has failed."""
    task = RunTask(
        config.folder, names=(config.test,), most_risk=config.risk, is_commanded=True
    )  # fmt: skip
    tests = UnitTestRun(task)
    result: UnitTestResult | None = None
    try:
        while not tests.is_over:
            for event in tests.wait(_LOOK_S):
                if isinstance(event, Progress):
                    context.report(event.text)
                elif isinstance(event, Result):
                    result = event.result
            if context.stopped():
                tests.abort("the command was aborted")
    finally:
        tests.close()
    if result is None:
        raise NotStartedError(f"there is no test '{config.test}' any more")
    found: dict[str, Any] = msgspec.to_builtins(within_bytes(result, RESULT_BYTES))
    return found


class FolderTests:
    """The unit tests that a robot announces, collected in the background when files change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stamp: Any = None
        self._new: TestCollection | None = None
        self._thread: threading.Thread | None = None
        self.found = TestCollection()

    def changed(self) -> bool:
        """Begin to collect if files have changed; return whether other tests were found since."""
        new, self._new = self._new, None
        if self._thread is None or not self._thread.is_alive():
            stamp = _stamps(self._folder)
            if stamp != self._stamp:
                self._stamp = stamp
                self._thread = threading.Thread(target=self._collect, name="tests", daemon=True)
                self._thread.start()
        if new is None or new == self.found:
            return False
        self.found = new
        return True

    def get(self, action: str) -> DeclaredAction | None:
        """Return a test by the name of its action; None if it is none."""
        for test in self.found.tests:
            if ACTION_PREFIX + test.name == action:
                return _as_action(self._folder, test)
        return None

    def _collect(self) -> None:
        try:
            self._new = collect(self._folder)
        except (AmberboxError, OSError):  # no memory for one more process: later again
            self._stamp = None


def _stamps(folder: Path) -> list[tuple[str, int, int]]:
    found = []
    for path in files_of(folder):
        try:
            about = path.stat()
        except OSError:
            continue
        found.append((path.as_posix(), about.st_mtime_ns, about.st_size))
    return found
