"""What a technician writes down from the card: read from the text that is visible on the page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_BROKEN, _SURE, _WHY = "What is broken", "How sure", "Why"
_USE, _NEXT = "Can the robot be used?", "Do this next"
_AS_OF, _ONE_OF = "As of ", "One of these "
_SINCE, _MORE = " since ", re.compile(r"and \d+ more\b.*")
_SHARE = re.compile(r"(?:over |under )?\d+\s?%")
_HEADINGS = (_BROKEN, _SURE, _WHY, _USE, _NEXT)


@dataclass(frozen=True, slots=True)
class Notes:
    """What is broken (several where they look alike), why, whether it can be used, what to do."""

    causes: Sequence[str]
    sure: str
    why: Sequence[str]
    use: str
    next: str

    def __str__(self) -> str:
        return "\n".join((*self.causes, self.sure, *self.why, self.use, self.next))


def notes_of(text: str) -> Notes:
    """Read the card; raises ValueError where a part of it is missing."""
    parts = _parts(text)
    lacking = [heading for heading in _HEADINGS if not parts.get(heading)]
    if lacking:
        raise ValueError(f"the page does not say: {', '.join(lacking)}")
    return Notes(
        _causes(parts[_BROKEN]), " ".join(parts[_SURE]), _reasons(parts[_WHY]), parts[_USE][0],
        parts[_NEXT][0],
    )  # fmt: skip


def _parts(text: str) -> dict[str, list[str]]:
    """Return the lines below each heading of the card, without empty ones."""
    parts: dict[str, list[str]] = {}
    below: list[str] | None = None
    for line in filter(None, map(str.strip, text.splitlines())):
        if line in _HEADINGS:
            below = parts.setdefault(line, [])
        elif below is not None:
            below.append(line)
    return parts


def _causes(lines: Sequence[str]) -> list[str]:
    """Return the causes: one, or those of a list, each of which has its share behind it."""
    said = [line for line in lines if not line.startswith(_AS_OF)]
    if not said[0].startswith(_ONE_OF):
        return said[:1]
    return [line for line in said[1:] if not _SHARE.fullmatch(line)]


def _reasons(lines: Sequence[str]) -> list[str]:
    """Return what was seen; since when, and how much more there is, is left out."""
    return [line.partition(_SINCE)[0] for line in lines if not _MORE.fullmatch(line)]
