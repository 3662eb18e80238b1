"""Notices that a robot folder was changed, waits until it rests, and has it judged."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from amberbox.robot.supervisor.footprint import Footprint, footprint
from amberbox.robot.supervisor.judgement import Judgement, Judging

POLL_S = 2.0
PAUSE_S = 10.0
"""A folder that changes all the time is not judged more often."""


class Question(Protocol):
    """A judgement under way."""

    def answer(self, now_s: float) -> Judgement | None:
        """Return the judgement once it is there."""

    def close(self) -> None:
        """Give it up."""


class Changes:
    """Looks at a folder now and then; ``step`` returns a judgement when there is a new one."""

    def __init__(
        self, folder: Path, store: Path, judge: Callable[[Path, float], Question] = Judging
    ) -> None:
        self._folder, self._store, self._judge = folder, store, judge
        self._judged = self._seen = self._look()
        self._question: Question | None = None
        self._due_s = self._not_before_s = -math.inf
        self._asked = False

    def ask(self) -> None:
        """Have it judged now, changed or not."""
        self._asked = True

    def step(self, now_s: float) -> Judgement | None:
        """Look, if it is time to."""
        if self._question is not None:
            return self._answer(self._question, now_s)
        if self._asked:
            self._asked = False
            self._begin(self._look(), now_s)
        elif now_s >= self._due_s:
            self._due_s = now_s + POLL_S
            self._compare(self._look(), now_s)
        return None

    def close(self) -> None:
        """Give up a judgement under way."""
        if self._question is not None:
            self._question.close()

    def _look(self) -> Footprint:
        return footprint(self._folder, self._store)

    def _compare(self, found: Footprint, now_s: float) -> None:
        """Have it judged if it was changed, and has been at rest since the last look."""
        rests, self._seen = found == self._seen, found
        if rests and found != self._judged and now_s >= self._not_before_s:
            self._begin(found, now_s)

    def _begin(self, found: Footprint, now_s: float) -> None:
        self._judged, self._not_before_s = found, now_s + PAUSE_S
        self._question = self._judge(self._folder, now_s)

    def _answer(self, question: Question, now_s: float) -> Judgement | None:
        answer = question.answer(now_s)
        if answer is not None:
            self._question = None
        return answer
