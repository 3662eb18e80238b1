"""Writes of many connections in one transaction: one sync of the disk for all that wait."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from sqlalchemy import Connection

from amberbox.fleet.database.database import Database

T = TypeVar("T")
Work = Callable[[Connection], T]

_MOST = 256
"""Pieces of work in one transaction."""


class GroupedWrites:
    """Does pieces of work in the order they come, each whole or not at all.

    What it returns is known when it is durable. ``close`` finishes what was submitted.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._queue: queue.SimpleQueue[tuple[Work[Any], Future[Any]] | None] = queue.SimpleQueue()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="link writes", daemon=True)
        self._thread.start()

    def submit(self, work: Work[T]) -> Future[T]:
        """Queue a piece of work; its result, or what it raised, comes once that is durable."""
        future: Future[T] = Future()
        if self._closed:
            future.set_exception(RuntimeError("the server is stopping"))
        else:
            self._queue.put((work, future))
        return future

    def close(self) -> None:
        """Finish what was submitted, then stop."""
        self._closed = True
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        while True:
            group = [self._queue.get()]
            while len(group) < _MOST and not self._queue.empty():
                group.append(self._queue.get())
            self._do([one for one in group if one is not None])
            if None in group:
                return

    def _do(self, group: list[tuple[Work[Any], Future[Any]]]) -> None:
        outcomes: list[tuple[Future[Any], Any, BaseException | None]] = []
        try:
            with self._database.begin() as connection:
                for work, future in group:
                    outcomes.append((future, *_tried(connection, work)))
        except Exception as error:  # the transaction itself: nothing of it is kept
            outcomes = [(future, None, error) for _, future in group]
        for future, result, trouble in outcomes:
            if not future.set_running_or_notify_cancel():
                continue
            if trouble is None:
                future.set_result(result)
            else:
                future.set_exception(trouble)


def _tried(connection: Connection, work: Work[Any]) -> tuple[Any, BaseException | None]:
    """Do one piece; when it fails, only that is undone."""
    point = connection.begin_nested()
    try:
        result = work(connection)
    except Exception as error:  # told to whoever asked; the others go on
        point.rollback()
        return None, error
    point.commit()
    return result, None
