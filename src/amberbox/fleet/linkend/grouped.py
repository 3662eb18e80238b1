"""Writes of many connections in one transaction: one sync of the disk for all that wait."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any, TypeAlias, TypeVar

from sqlalchemy import Connection

from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.together import Taking, store_all
from amberbox.link.ledger import StaleEpochError

T = TypeVar("T")
Work = Callable[[Connection], T]
_Piece: TypeAlias = "tuple[Work[Any], Future[Any]]"
_Result: TypeAlias = tuple[Any, BaseException | None]
_Outcome: TypeAlias = "tuple[Future[Any], _Result]"

_MOST = 256
"""Pieces of work in one transaction."""
GATHER_S = 0.05
"""Transactions lie at least so far apart: under load each does more, and others get to write."""


class GroupedWrites:
    """Does pieces of work in the order they come, each whole or not at all.

    What robots say (``Taking``) is done first and together. What a piece returns is known when it
    is durable. ``close`` finishes what was submitted.
    """

    def __init__(self, database: Database, gather_s: float = GATHER_S) -> None:
        self._database = database
        self._queue: queue.SimpleQueue[_Piece | None] = queue.SimpleQueue()
        self._gather_s = gather_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link writes", daemon=True)
        self._thread.start()

    def submit(self, work: Work[T]) -> Future[T]:
        """Queue a piece of work; its result, or what it raised, comes once that is durable."""
        future: Future[T] = Future()
        if self._closing.is_set():
            future.set_exception(RuntimeError("the server is stopping"))
        else:
            self._queue.put((work, future))
        return future

    def close(self) -> None:
        """Finish what was submitted, then stop."""
        self._closing.set()
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        ended_s = -self._gather_s
        while True:
            group = [self._queue.get()]
            self._closing.wait(max(ended_s + self._gather_s - time.monotonic(), 0.0))
            while len(group) < _MOST and not self._queue.empty():
                group.append(self._queue.get())
            self._do([one for one in group if one is not None])
            ended_s = time.monotonic()
            if None in group:
                return

    def _do(self, group: Sequence[_Piece]) -> None:
        said = [(work, future) for work, future in group if isinstance(work, Taking)]
        others = [(work, future) for work, future in group if not isinstance(work, Taking)]
        outcomes: list[_Outcome] = []
        try:
            with self._database.begin() as connection:
                outcomes += zip((f for _, f in said), _taken(connection, said), strict=True)
                outcomes += ((future, _tried(connection, work)) for work, future in others)
        except Exception as error:  # the transaction itself: nothing of it is kept
            outcomes = [(future, (None, error)) for _, future in group]
        for future, (result, trouble) in outcomes:
            if not future.set_running_or_notify_cancel():
                continue
            if trouble is None:
                future.set_result(result)
            else:
                future.set_exception(trouble)


def _taken(connection: Connection, said: Sequence[tuple[Taking, Future[Any]]]) -> list[_Result]:
    """Take what robots say, as much as can be together; when that fails, each by itself."""
    takings = [taking for taking, _ in said]
    done: list[_Result] = []
    together = len(takings) > 1
    while len(done) < len(takings):
        if together:
            found, _ = _tried(connection, partial(store_all, takings=takings[len(done) :]))
            together = found is not None
            done += map(_result, found or ())
        if len(done) < len(takings):
            done.append(_tried(connection, takings[len(done)]))
    return done


def _result(found: object) -> _Result:
    return (None, found) if isinstance(found, StaleEpochError) else (found, None)


def _tried(connection: Connection, work: Work[Any]) -> _Result:
    """Do one piece; when it fails, only that is undone."""
    point = connection.begin_nested()
    try:
        result = work(connection)
    except Exception as error:  # told to whoever asked; the others go on
        point.rollback()
        return None, error
    point.commit()
    return result, None
