"""The words for classes of failure modes that published taxonomies use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from amberbox.core.config import build, did_you_mean, load_yaml, refuse
from amberbox.core.errors import Problem
from amberbox.core.options import option


@dataclass(frozen=True)
class Vocabulary:
    """One taxonomy: where it comes from, and what each word means, in our own words."""

    source: str = option(doc="publication that the words come from")
    words: Mapping[str, str] = option(doc="meaning of each word")


@cache
def vocabularies() -> Mapping[str, Vocabulary]:
    """Return the taxonomies by name."""
    problems: list[Problem] = []
    node = load_yaml(Path(__file__).with_name("vocabulary.yaml"), problems)
    entries = (node.mapping if node else None) or {}
    built = {name: build(Vocabulary, entry, problems, name) for name, entry in entries.items()}
    refuse(problems)
    return {name: entry for name, entry in built.items() if entry is not None}


def resolve(word: str) -> str:
    """Return a class in full (``steinbauer.hardware``); a word of one taxonomy needs no more.

    Raises ValueError with a sentence for the person who wrote it.
    """
    full = [f"{name}.{entry}" for name, of in vocabularies().items() for entry in of.words]
    if word in full:
        return word
    matches = [name for name in full if name.endswith(f".{word}")]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise ValueError(f"'{word}' is ambiguous: {' or '.join(matches)}")
    short = [name.partition(".")[2] for name in full]
    raise ValueError(f"there is no class '{word}'{did_you_mean(word, [*full, *short])}")
