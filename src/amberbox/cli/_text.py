"""Text in columns, and lines that fit a terminal, for verbs that list things."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterable, Sequence

from amberbox.core.terminal import OWN

_COLOUR = re.compile(f"{OWN}\\[[0-9;]*m")
_GAP = re.compile(r"(?<=[^ ])  +")


def print_lines(lines: Iterable[str]) -> None:
    """Print lines of text; in a terminal, those that are too long are folded."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    for text in lines:
        for line in text.split("\n"):
            print(line if width is None else "\n".join(fold(line, width)))


def fold(line: str, width: int) -> list[str]:
    """Break a line between words into lines of a width; colours take no room.

    What follows begins below the last column, or 2 further in where there are no columns or the
    last one is too narrow.
    """
    if len(_COLOUR.sub("", line)) <= width:
        return [line]
    shown = _COLOUR.sub("", line)
    indent = len(shown) - len(shown.lstrip(" ")) + 2
    columns = [gap.end() for gap in _GAP.finditer(shown) if gap.end() <= width // 2]
    hang = " " * min(columns[-1] if columns else indent, width // 2)
    words, folded = re.findall(r" *[^ ]+ *$| *[^ ]+", line), [""]
    for word in words:
        room = width - len(_COLOUR.sub("", folded[-1]))
        if len(_COLOUR.sub("", word)) > room and folded[-1].strip():
            folded.append(hang)
            word, room = word.lstrip(" "), width - len(hang)
        while len(word) > room and OWN not in word:  # a path, a hash: longer than a line
            folded[-1] += word[:room]
            word, room = word[room:], width - len(hang)
            folded.append(hang)
        folded[-1] += word
    return [text.rstrip() for text in folded]


def in_columns(rows: Iterable[Sequence[str]], indent: str = "  ") -> list[str]:
    """Align cells to the left; the last column may be as long as it likes."""
    table = [list(row) for row in rows]
    if not table:
        return []
    widths = [max(len(cell) for cell in column) for column in zip(*table, strict=True)]
    return [
        (indent + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True))).rstrip()
        for row in table
    ]
