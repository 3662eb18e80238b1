"""Streams of a terminal made harmless: nothing in a record or from a server acts as an escape.

Sequences of our own are written with ``OWN`` in place of ESC.
"""

from __future__ import annotations

import os
from typing import IO, Any, cast

from amberbox.core.showing import visible

OWN = f"\x1b{os.urandom(8).hex()}\x1b"
"""Stands for ESC in sequences of our own: other text cannot know it."""
BACK = f"{OWN}\r"
"""Goes back to the beginning of the line."""


class _Harmless:
    """A stream that writes hidden characters out; all else is that of the stream below."""

    def __init__(self, below: IO[str]) -> None:
        self.below = below

    def __getattr__(self, name: str) -> Any:
        return getattr(self.below, name)

    def write(self, text: str) -> int:
        """Write a text."""
        shown = visible(text) if OWN not in text else _with_own(text)
        self.below.write(shown)
        return len(text)

    def writelines(self, lines: list[str]) -> None:
        """Write texts."""
        for line in lines:
            self.write(line)


def _with_own(text: str) -> str:
    first, *others = text.split(OWN)
    parts = [visible(first)]
    for part in others:
        is_back = part.startswith("\r")
        parts.append(("\r" if is_back else "\x1b") + visible(part[is_back:]))
    return "".join(parts)


def harmless(stream: IO[str]) -> IO[str]:
    """Return a stream that shows the same without doing anything to a terminal."""
    return stream if isinstance(stream, _Harmless) else cast("IO[str]", _Harmless(stream))


def for_data(stream: IO[str]) -> IO[str]:
    """Return where data go: into files and pipes as they are, into a terminal harmless."""
    if isinstance(stream, _Harmless) and not stream.below.isatty():
        return stream.below
    return stream
