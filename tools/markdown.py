"""Read the few things of Markdown that checks need: fences, links, headings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tools.findings import ROOT

_LINK = re.compile(r"\[[^\]\n]*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)")
_HEADING = re.compile(r"#{1,6}\s+(.*?)\s*#*")
_CODE = re.compile(r"`[^`\n]*`")


class Fence(NamedTuple):
    """A fenced block of code: the line it begins at, what follows the backticks, its text."""

    line: int
    info: str
    text: str


class Link(NamedTuple):
    """A link and the line it stands in."""

    line: int
    target: str


def pages(root: Path = ROOT) -> list[Path]:
    """Return the Markdown files of the project."""
    return sorted([*root.glob("*.md"), *(root / "docs").rglob("*.md")])


def fences(text: str) -> Iterator[Fence]:
    """Yield the fenced blocks of a page."""
    begin, info, body = 0, "", list[str]()
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("```"):
            body.append(line)
        elif begin:
            yield Fence(begin, info, "\n".join(body) + "\n")
            begin = 0
        else:
            begin, info, body = number, line[3:].strip(), []


def links(text: str) -> Iterator[Link]:
    """Yield the links of a page, without what stands in code."""
    for number, line in _prose(text):
        for match in _LINK.finditer(_CODE.sub("", line)):
            yield Link(number, match[1])


def anchors(text: str) -> set[str]:
    """Return the names by which headings can be linked, as GitHub makes them."""
    names: set[str] = set()
    for _, line in _prose(text):
        match = _HEADING.fullmatch(line)
        if match:
            plain = re.sub(r"[^\w\- ]", "", match[1].lower())
            names.add(plain.replace(" ", "-"))
    return names


def _prose(text: str) -> Iterator[tuple[int, str]]:
    inside = False
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("```"):
            inside = not inside
        elif not inside:
            yield number, line
