"""Collect and run the unit tests of a robot folder, in a process that supervises them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TypeAlias

import msgspec

from amberbox.core.command import Risk
from amberbox.core.errors import AmberboxError, ConfigurationError, Problem
from amberbox.core.files import wait_readable
from amberbox.core.safe_text import one_line
from amberbox.experiments.unit_tests import (
    FOLDER,
    CollectionProblem,
    TestCollection,
    UnitTestResult,
    files_digest,
    files_of,
    read_cached,
    write_cached,
)

COMMAND = (sys.executable, "-P", "-m", "amberbox.agent.unit_test_process")
COLLECTION_S = 60.0
"""Longest collection of all files, and longest pause between two tests."""
_END_S = 15.0


class RunTask(msgspec.Struct, frozen=True):
    """What to do with the tests of a folder: collect them only, or run those of ``names``.

    ``names`` None means all. Actions above ``most_risk`` are refused whatever a test declares.
    ``is_commanded``: the command process runs the test, so that its actions are under the lease of
    the command; else they are ordered from that process where one runs.
    """

    folder: str
    run: bool = True
    names: tuple[str, ...] | None = None
    keyword: str = ""
    simulated: bool = False
    most_risk: Risk = "moves"
    is_commanded: bool = False


class Found(msgspec.Struct, frozen=True, tag="found"):
    """The tests that were collected; ``chosen`` are the names of those that run."""

    collection: TestCollection
    chosen: tuple[str, ...] = ()


class Progress(msgspec.Struct, frozen=True, tag="progress"):
    """A test has come to a phase, or reports what an action does."""

    name: str
    text: str


class Result(msgspec.Struct, frozen=True, tag="result"):
    """A test has ended."""

    result: UnitTestResult


class Over(msgspec.Struct, frozen=True, tag="over"):
    """The run has ended; ``reason`` is why before its time."""

    reason: str = ""


RunEvent: TypeAlias = Found | Progress | Result | Over


class UnitTestRun:
    """A run of unit tests: call ``wait`` until ``is_over``."""

    def __init__(self, task: RunTask) -> None:
        self._process = subprocess.Popen(
            COMMAND, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            start_new_session=True,
        )  # fmt: skip
        assert self._process.stdin and self._process.stdout, "they are pipes"
        self._orders, self._events = self._process.stdin, self._process.stdout
        self._line = b""
        self.is_over = False
        self._order(msgspec.json.encode(task))

    def wait(self, seconds: float) -> Sequence[RunEvent]:
        """Return what is new, after at most so many seconds.

        Raises AmberboxError when the supervising process ends before the run does.
        """
        if self.is_over or not wait_readable([self._events], seconds):
            return ()
        block = os.read(self._events.fileno(), 1 << 20)
        *lines, self._line = (self._line + block).split(b"\n")
        found: list[RunEvent] = [msgspec.json.decode(line, type=RunEvent) for line in lines]
        self.is_over = any(isinstance(event, Over) for event in found)
        if not block and not self.is_over:
            self.is_over = True
            raise AmberboxError("the process that supervises the unit tests has ended")
        return found

    def abort(self, reason: str) -> None:
        """End the run: the test that runs is killed, an action that it has begun is stopped."""
        self._order(f"abort {one_line(reason)}".encode())

    def _order(self, line: bytes) -> None:
        with suppress(BrokenPipeError):
            self._orders.write(line + b"\n")

    def close(self) -> None:
        """Abort what runs, and wait for the end of the supervising process."""
        self._orders.close()
        self._events.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)


def collect(folder: Path) -> TestCollection:
    """Return the tests of a robot folder; their files are imported, no test runs.

    What was found in the same files before is kept in the store, if there is one.
    """
    if not files_of(folder):
        return TestCollection()
    missing = missing_pytest()
    if missing is not None:
        return TestCollection(problems=(missing,))
    digest, store = files_digest(folder), _store(folder)
    cached = read_cached(store, digest) if store else None
    if cached is not None:
        return cached
    run = UnitTestRun(RunTask(str(folder.absolute()), run=False))
    found = TestCollection()
    try:
        while not run.is_over:
            for event in run.wait(1.0):
                found = event.collection if isinstance(event, Found) else found
    finally:
        run.close()
    if store:
        write_cached(store, digest, found)
    return found


def known_tests(folder: Path) -> TestCollection | None:
    """Return the tests as they were collected before; None if the files have changed since."""
    store = _store(folder)
    return read_cached(store, files_digest(folder)) if store else None


def missing_pytest() -> CollectionProblem | None:
    """Return a problem if pytest is not installed."""
    if find_spec("pytest") is not None:
        return None
    what = "pytest is not installed, so the unit tests cannot run"
    return CollectionProblem("", 1, what, "pip install 'amberbox[experiments]'")


def problems_of(folder: Path, collection: TestCollection) -> list[Problem]:
    """Return what is wrong with the tests of a folder; without pytest this is only a note."""
    return [
        Problem(
            str(folder / (found.file or FOLDER)), found.line, "unit tests", found.what, found.hint,
            is_error=not found.hint,
        )
        for found in collection.problems
    ]  # fmt: skip


def _store(folder: Path) -> Path | None:
    """Return the folder of the record where there is one."""
    from amberbox.blackbox.robot_folder.folder import store_of  # an actor begins without it

    try:
        store = store_of(folder)
    except ConfigurationError:
        return None
    return store if store is not None and store.is_dir() else None
