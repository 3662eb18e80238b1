"""Output that verbs share: tables, JSON, files, folded lines, colours of levels, progress."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NoReturn, TypeVar

from amberbox.core.errors import UsageError
from amberbox.core.files import open_to_all
from amberbox.core.safe_text import LINE_START, OWN_ESCAPE, data_stream
from amberbox.core.types import Level

if TYPE_CHECKING:
    from amberbox.blackbox.columns.table_text import LineWidth

T = TypeVar("T")


def print_json(value: Any) -> None:
    """Print a value as JSON for programs and people."""
    print(json.dumps(value, indent=2, ensure_ascii=False))


def print_grid(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table, in a terminal no wider than it."""
    from amberbox.blackbox.columns.table_text import format_grid  # needs numpy

    print(format_grid(header, list(rows), room=grid_width(sys.stdout, "--json has all")))


def print_listing(
    found: Sequence[T], document: Callable[[T], Any], header: Sequence[str],
    row: Callable[[T], Sequence[Any]], nothing: str, *, as_json: bool,
) -> None:  # fmt: skip
    """Print results as JSON or as a table; ``nothing`` is printed if there are none."""
    if as_json:
        print_json(list(map(document, found)))
    elif found:
        print_grid(header, map(row, found))
    else:
        print(nothing)


def grid_width(file: IO[str], more: str) -> LineWidth | None:
    """Return the width limit of a table: that of a terminal, None in a file or a pipe.

    ``more`` is the note on how to get the omitted columns.
    """
    from amberbox.blackbox.columns.table_text import LineWidth  # as above

    return LineWidth(shutil.get_terminal_size().columns, more) if file.isatty() else None


def secret(question: str) -> str:
    """Read a secret without echo from the terminal, or a line from standard input."""
    if sys.stdin.isatty():
        import getpass  # few verbs need it

        return getpass.getpass(question)
    return sys.stdin.readline().rstrip("\n")


def warn_readable(folder: Path) -> None:
    """Warn on stderr of a folder with data that all users of this computer can read."""
    what = open_to_all(folder)
    if what:
        print(f"warning: {what}\nhint: chmod -R o-rwx {folder}", file=sys.stderr, flush=True)


def print_notes(notes: Iterable[str]) -> None:
    """Print notes to stderr, one line each."""
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


@contextmanager
def text_output(path: str | None) -> Iterator[IO[str]]:
    """Yield the file to write to, or stdout."""
    if path is None:
        yield data_stream(sys.stdout)
        return
    with writable(path).open("w", encoding="utf-8", newline="") as file:
        yield file


def writable(path: str) -> Path:
    """Return a path whose folder exists; raises UsageError when it cannot be written."""
    target = Path(path)
    folder = target.parent
    if not folder.is_dir():
        raise UsageError(f"cannot write {path}: there is no folder {folder}", "make it first")
    if target.is_dir() or not os.access(target if target.exists() else folder, os.W_OK):
        raise UsageError(f"cannot write {path}", "choose a file in a folder that can be written")
    return target


_COLOUR = re.compile(f"{OWN_ESCAPE}\\[[0-9;]*m")
_GAP = re.compile(r"(?<=[^ ])  +")


def terminal_width() -> int | None:
    """Return the width of the terminal (columns); None if stdout is a file or a pipe."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def print_lines(lines: Iterable[str]) -> None:
    """Print lines of text; in a terminal, lines that are too long are wrapped."""
    width = terminal_width()
    for text in lines:
        for line in text.split("\n"):
            print(line if width is None else "\n".join(fold(line, width)))


def fold(line: str, width: int) -> list[str]:
    """Break a line between words into lines of a width; colour codes do not count.

    Further lines are indented to the last column, or by 2 more where there are no columns or the
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
        while len(word) > room and OWN_ESCAPE not in word:  # a path or hash longer than a line
            folded[-1] += word[:room]
            word, room = word[room:], width - len(hang)
            folded.append(hang)
        folded[-1] += word
    return [text.rstrip() for text in folded]


def in_columns(rows: Iterable[Sequence[str]], indent: str = "  ") -> list[str]:
    """Return cells aligned to the left; the width of the last column is not limited."""
    table = [list(row) for row in rows]
    if not table:
        return []
    widths = [max(len(cell) for cell in column) for column in zip(*table, strict=True)]
    return [
        (indent + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True))).rstrip()
        for row in table
    ]


def redraw(draw: Callable[[], None], period_s: float) -> NoReturn:
    """Draw repeatedly until Ctrl-C; a terminal is cleared before."""
    while True:
        if sys.stdout.isatty():
            print(f"{OWN_ESCAPE}[H{OWN_ESCAPE}[J", end="")
        draw()
        sys.stdout.flush()
        time.sleep(period_s)


Paint = Callable[[str, Level], str]

_CODES: Mapping[Level, str] = {
    **{"ok": "32", "warn": "33", "error": "1;31"},
    **{"stale": "35", "unknown": "35"},
}


def painter(file: IO[str]) -> Paint:
    """Return a function that colours text by level; without a terminal or with ``NO_COLOR``
    ``plain``.
    """
    return _paint if file.isatty() and not os.environ.get("NO_COLOR") else plain


def plain(text: str, level: Level) -> str:
    """Return the text unchanged."""
    return text


def _paint(text: str, level: Level) -> str:
    return f"{OWN_ESCAPE}[{_CODES[level]}m{text}{OWN_ESCAPE}[0m"


_BAR = 30


def progress_bar(*, wanted: bool = True) -> Callable[[float], None]:
    """Return a function that draws a fraction as a bar, on a terminal only."""
    if not wanted or not sys.stderr.isatty():
        return lambda fraction: None
    shown = -1

    def draw(fraction: float) -> None:
        nonlocal shown
        percent = round(100 * min(max(fraction, 0.0), 1.0))
        if percent == shown:
            return
        shown = percent
        full = round(percent * _BAR / 100)
        end = "\n" if percent == 100 else ""
        print(
            f"{LINE_START}[{'#' * full}{'.' * (_BAR - full)}] {percent:3d}%",
            end=end,
            file=sys.stderr,
            flush=True,
        )

    return draw
