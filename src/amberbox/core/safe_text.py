"""Foreign text made safe to show on pages, in terminals, mails, logs and CSV.

Controls (C0, C1, terminal escapes), marks that reorder text, and characters that cannot be seen are
written out as ``\\u202e``, so that a text is only shown and has no other effect. JSON uses the same
notation. Streams of a terminal are wrapped so that no text in a record or from a server acts as an
escape; our own sequences are written with ``OWN_ESCAPE`` in place of ESC. Cells of a CSV file are
written so that a spreadsheet does not run them as formulas.
"""

from __future__ import annotations

import os
import re
from typing import IO, Any, cast

_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"
    "\ufeff\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]"
    "|(?<![^\x00-\x7f])[\u200c\u200d]"  # joiners belong to scripts and emoji: not behind ASCII
)


def escape_hidden(text: str) -> str:
    """Return a text in which nothing is hidden; line ends and tabs stay."""
    return text if text.isprintable() else _HIDDEN.sub(_written, text)


def one_line(text: str) -> str:
    """Return the same without line ends and tabs."""
    if text.isprintable():
        return text
    return escape_hidden("".join(" " if char.isspace() else char for char in text))


def _written(match: re.Match[str]) -> str:
    code = ord(match.group())
    if code < 0x10000:
        return f"\\u{code:04x}"
    high, low = divmod(code - 0x10000, 0x400)
    return f"\\u{0xD800 + high:04x}\\u{0xDC00 + low:04x}"


_FORMULA = tuple("=+-@\t\r\n|%＝＋－＠")  # noqa: RUF001 -- full-width signs start formulas, too


def spreadsheet_safe(text: str) -> str:
    """Put ``'`` before a text that a spreadsheet would take for a formula or a command."""
    return f"'{text}" if text.lstrip(" ").startswith(_FORMULA) else text


# stands for ESC in our own sequences; other text cannot contain it
OWN_ESCAPE = f"\x1b{os.urandom(8).hex()}\x1b"
LINE_START = f"{OWN_ESCAPE}\r"


class _Harmless:
    """A text stream that writes hidden characters as escapes; all else is delegated."""

    def __init__(self, below: IO[str]) -> None:
        self.below = below

    def __getattr__(self, name: str) -> Any:
        return getattr(self.below, name)

    def write(self, text: str) -> int:
        """Write a text."""
        shown = escape_hidden(text) if OWN_ESCAPE not in text else _with_own(text)
        self.below.write(shown)
        return len(text)

    def writelines(self, lines: list[str]) -> None:
        """Write texts."""
        for line in lines:
            self.write(line)


def _with_own(text: str) -> str:
    first, *others = text.split(OWN_ESCAPE)
    parts = [escape_hidden(first)]
    for part in others:
        is_back = part.startswith("\r")
        parts.append(("\r" if is_back else "\x1b") + escape_hidden(part[is_back:]))
    return "".join(parts)


def terminal_safe(stream: IO[str]) -> IO[str]:
    """Return a stream whose text cannot control a terminal."""
    return stream if isinstance(stream, _Harmless) else cast("IO[str]", _Harmless(stream))


def data_stream(stream: IO[str]) -> IO[str]:
    """Return a stream for data: unchanged to files and pipes, escaped to a terminal."""
    if isinstance(stream, _Harmless) and not stream.below.isatty():
        return stream.below
    return stream
