"""Texts of rule files: lines and columns, and problems with a picture of the line."""

from __future__ import annotations

from bisect import bisect_right
from pathlib import Path

from amberbox.core.errors import Problem
from amberbox.diagnosis.rules.faults import Place, RuleFault

_WIDEST = 100


class SourceText:
    """A text with the name of its file in messages."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.text = text
        starts = [0]
        for line in text.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self.starts = starts

    def place(self, at: int) -> Place:
        """Return line and column of a character."""
        line = min(bisect_right(self.starts, at), max(1, len(self.starts) - 1))
        return Place(self.file, line, at - self.starts[line - 1] + 1)

    def problem(self, fault: RuleFault, at: int, *, is_error: bool = True) -> Problem:
        """Say what is wrong where, and show the line."""
        place = self.place(fault.at if fault.at >= 0 else at)
        what = fault.what + self.picture(place)
        where = f"column {place.column}"
        return Problem(self.file, place.line, where, what, fault.hint, is_error)

    def picture(self, place: Place) -> str:
        """Return the line of a place with a mark below its column."""
        if not self.text:
            return ""
        start, end = self.starts[place.line - 1], self.starts[place.line]
        line = self.text[start:end].rstrip().expandtabs(1)
        left = max(0, place.column - _WIDEST)
        return f"\n    {line[left : left + _WIDEST + 20]}\n    {' ' * (place.column - 1 - left)}^"


def read_source(path: Path, problems: list[Problem]) -> SourceText | None:
    """Read a file; None and a problem if it cannot be read."""
    try:
        return SourceText(str(path), path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        what = f"cannot be read: {error.strerror}"
        problems.append(Problem(str(path), 1, "file", what))
    except UnicodeDecodeError:
        problems.append(Problem(str(path), 1, "file", "is not UTF-8 text", "save it as UTF-8"))
    return None
