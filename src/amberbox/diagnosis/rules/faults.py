"""What can go wrong with rules: in a file, at a goal, or by taking too long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.core.errors import AmberboxError, UsageError

TOO_DEEP = "a term is nested too deeply", "use lists, not f(f(f(...)))"
"""What is wrong with a term whose parts are nested too deeply to go through, and the hint."""


class RuleFault(Exception):  # noqa: N818  # not an error yet: it becomes one with its place
    """Something is wrong; ``at`` is the place in the text being read, -1 where there is none."""

    def __init__(self, what: str, hint: str = "", at: int = -1) -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint
        self.at = at


class StopFault(Exception):  # noqa: N818  # as above
    """The budget is used up."""


class RuleError(UsageError):
    """A goal cannot be asked, or fails with an error rather than with no."""


class StoppedError(AmberboxError):
    """The search was ended by its budget; ``answers`` were found until then."""

    def __init__(self, what: str, hint: str, answers: Sequence[object] = ()) -> None:
        super().__init__(what, hint)
        self.answers = tuple(answers)


@dataclass(frozen=True, slots=True)
class Place:
    """Where something stands: lines and columns count from 1."""

    file: str
    line: int
    column: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"
