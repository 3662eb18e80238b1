"""Questions that wait: bounded, and shared fairly between those who ask."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict, deque

from amberbox.fleet.asking.errors import BusyError
from amberbox.fleet.asking.question import Question

_HINT = "ask again in a moment"


class Waiting:
    """Whoever asks a hundred questions makes others wait for one of them, not for all.

    With ``at_once`` no asker has more than so many questions worked on: others find a worker free.
    """

    def __init__(self, most: int, each: int, at_once: int | None = None) -> None:
        self._most = most
        self._each = each
        self._at_once = at_once
        self._at_work: Counter[str] = Counter()
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
        """Wait for the next question: the oldest of who waits longest; None when closed.

        Call ``done`` with it when it is over.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._next() is not None)
            asker = self._next()
            if self._closed or asker is None:
                return None
            mine = self._askers.pop(asker)
            question = mine.popleft()
            if mine:
                self._askers[asker] = mine
            self._at_work[asker] += 1
            return question

    def done(self, question: Question) -> None:
        """Note that nobody works on a question any more."""
        with self._changed:
            self._at_work[question.asker] -= 1
            self._at_work += Counter()  # forgets those of which there are none
            self._changed.notify()

    def _next(self) -> str | None:
        """Return whose turn it is."""
        most = self._at_once
        free = (one for one in self._askers if most is None or self._at_work[one] < most)
        return next(free, None)

    def close(self) -> list[Question]:
        """Let those go who wait for a question; return the questions that nobody will answer."""
        with self._changed:
            self._closed = True
            left = [question for mine in self._askers.values() for question in mine]
            self._askers.clear()
            self._changed.notify_all()
            return left
