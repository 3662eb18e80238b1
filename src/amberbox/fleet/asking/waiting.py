"""Questions that wait: bounded, and shared fairly between those who ask."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque

from amberbox.fleet.asking.errors import BusyError
from amberbox.fleet.asking.question import Question

_HINT = "ask again in a moment"


class Waiting:
    """Whoever asks a hundred questions makes others wait for one of them, not for all."""

    def __init__(self, most: int, each: int) -> None:
        self._most = most
        self._each = each
        self._askers: OrderedDict[str, deque[Question]] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def add(self, question: Question) -> None:
        """Put a question into the queue. Raises BusyError when it is full."""
        with self._changed:
            mine = self._askers.get(question.asker, ())
            if self._closed or sum(map(len, self._askers.values())) >= self._most:
                raise BusyError("the server has too many questions to answer", _HINT)
            if question.asker and len(mine) >= self._each:
                raise BusyError(f"{len(mine)} of your questions wait already", _HINT)
            self._askers.setdefault(question.asker, deque()).append(question)
            self._changed.notify()

    def take(self) -> Question | None:
        """Wait for the next question: the oldest of who waits longest; None when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._askers)
            if self._closed:
                return None
            asker, mine = self._askers.popitem(last=False)
            question = mine.popleft()
            if mine:
                self._askers[asker] = mine
            return question

    def close(self) -> list[Question]:
        """Let those go who wait for a question; return the questions that nobody will answer."""
        with self._changed:
            self._closed = True
            left = [question for mine in self._askers.values() for question in mine]
            self._askers.clear()
            self._changed.notify_all()
            return left
