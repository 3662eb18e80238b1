"""A few worker processes, each with a thread that asks it, and a queue before them."""

from __future__ import annotations

import threading
from pathlib import Path

from amberbox.fleet.asking.child import PROGRAM, Child
from amberbox.fleet.asking.errors import BusyError
from amberbox.fleet.asking.question import Question
from amberbox.fleet.asking.waiting import Waiting


class Pool:
    """Answers questions with ``count`` workers; they start with the first question.

    ``most`` wait: fewer than the server has threads that answer people, or those could all wait.
    ``each`` of them are of one asker, and ``at_once`` of one asker are worked on.
    """

    def __init__(
        self, folder: Path, count: int = 2, *, most: int = 32, each: int = 8, nice: int = 0,
        program: str = PROGRAM, at_once: int | None = None,
    ) -> None:  # fmt: skip
        self._children = [Child(folder, nice, program) for _ in range(count)]
        self._waiting = Waiting(most, each, at_once)
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._now: set[Question] = set()
        self._closing = False

    @property
    def pids(self) -> list[int]:
        """The process ids of the workers that run."""
        return [child.pid for child in self._children if child.pid is not None]

    def put(self, question: Question) -> None:
        """Have a question answered: its future ``done`` tells when. Raises BusyError."""
        self._waiting.add(question)
        with self._lock:
            if not self._threads:
                self._threads = [
                    threading.Thread(target=self._work, args=(child,), name="asking", daemon=True)
                    for child in self._children
                ]
                for thread in self._threads:
                    thread.start()

    def close(self) -> None:
        """Stop the workers, also those that are at a question."""
        self._closing = True
        for question in self._waiting.close():
            if question.done.set_running_or_notify_cancel():
                question.done.set_exception(BusyError("the server is stopping"))
        for question in tuple(self._now):
            question.cancel()
        for thread in self._threads:
            thread.join()

    def _work(self, child: Child) -> None:
        while (question := self._waiting.take()) is not None:
            if question.done.set_running_or_notify_cancel():
                self._now.add(question)
                self._answer(child, question)
                self._now.discard(question)
            self._waiting.done(question)
        child.stop()

    def _answer(self, child: Child, question: Question) -> None:
        try:
            if self._closing:
                raise BusyError("the server is stopping")
            child.answer(question)
        except BaseException as error:  # it is for who asked, in another thread
            question.done.set_exception(error)
        else:
            question.done.set_result(None)
