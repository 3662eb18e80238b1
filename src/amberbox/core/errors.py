"""Errors with what happened and a hint for the next step; suggestions for misspelt words."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence
from dataclasses import dataclass


class AmberboxError(Exception):
    """One line of what happened and one line of what to do about it.

    ``exit_code`` follows the command line's rule: 1 a problem found in the data or the robot,
    2 wrong usage or configuration.
    """

    exit_code = 1

    def __init__(self, what: str, hint: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.what}\nhint: {self.hint}" if self.hint else self.what


class UsageError(AmberboxError):
    """The command or the call was wrong, the data are fine."""

    exit_code = 2


class NotStartedError(AmberboxError):
    """An action failed before the robot was told anything: nothing has to be stopped."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One finding about a file: ``file:line: where: what; did you mean ...``."""

    file: str
    line: int
    where: str
    what: str
    hint: str = ""
    is_error: bool = True

    def __str__(self) -> str:
        kind = "" if self.is_error else "note: "
        text = f"{self.file}:{self.line}: {kind}{self.where}: {self.what}"
        return f"{text}\n  hint: {self.hint}" if self.hint else text


class ConfigurationError(UsageError):
    """All problems of a configuration at once."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in problems))


def did_you_mean(word: str, known: Collection[str]) -> str:
    """Return ``; did you mean 'x'?`` for the nearest other word that is known, or nothing."""
    near = nearest_word(word, known)
    return f"; did you mean '{near}'?" if near is not None else ""


def nearest_word(word: str, known: Collection[str]) -> str | None:
    lower = {name.lower(): name for name in known if name != word}
    near = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.6)
    return lower[near[0]] if near else None
