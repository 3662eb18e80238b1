"""What the words mean that people read: the help of each term, and docs/words.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby

from amberbox.fleet.pages.strings import catalogue

EXPERTS = "experts"
"""Words of this group stand under "Details" and on the pages about knowledge only."""
_PART = "words."


@dataclass(frozen=True, slots=True)
class Word:
    """A word, as it is shown and what it means; ``group`` is the heading it stands below."""

    id: str
    group: str
    name: str
    text: str


@lru_cache
def words() -> Mapping[str, Word]:
    """Return all words by id, in the order of the catalogue."""
    texts = catalogue().texts
    ids = dict.fromkeys(name.split(".")[1] for name in texts if name.startswith(_PART))
    return {one: Word(one, *(texts[f"{_PART}{one}.{key}"] for key in ("group", "name", "text")))
            for one in ids}  # fmt: skip


def groups() -> Iterator[tuple[str, list[Word]]]:
    """Yield each group's heading with its words."""
    for group, found in groupby(words().values(), lambda word: word.group):
        yield catalogue().text(f"help.group.{group}"), list(found)


def as_markdown() -> str:
    """Return all of it as docs/words.md has it."""
    lines = [f"# {catalogue().text('help.title')}", "", catalogue().text("help.intro")]
    for heading, found in groups():
        lines += ["", f"## {heading}", "", "| word | meaning |", "|---|---|"]
        lines += [f"| {word.name} | {word.text} |" for word in found]
    return "\n".join(lines) + "\n"
