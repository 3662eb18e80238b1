"""The catalogue: every text that people read on pages, by name, in files of one language.

A file ``strings/en/robot.yaml`` holds what its keys name: ``tree: {title: Components}`` is
``robot.tree.title``. Fields in braces are filled in. What stands below ``js`` goes to the browser.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parent / "strings"
LANGUAGE = "en"


class MissingTextError(KeyError):
    """A text that the catalogue does not have: a mistake in a page."""


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Texts by name."""

    texts: Mapping[str, str]

    def text(self, name: str, /, **fields: Any) -> str:
        """Return a text with its fields filled in; raises MissingTextError."""
        found = self.texts.get(name)
        if found is None:
            raise MissingTextError(f"no text '{name}' in strings/{LANGUAGE}")
        return found.format_map(fields) if fields else found


@lru_cache
def catalogue(folder: Path = FOLDER / LANGUAGE) -> Catalogue:
    """Read the catalogue of a language."""
    texts: dict[str, str] = {}
    for file in sorted(folder.glob("*.yaml")):
        texts.update(_flat(yaml.safe_load(file.read_text(encoding="utf-8")), file.stem))
    return Catalogue(texts)


@lru_cache
def for_browser(parts: Sequence[str]) -> Mapping[str, str]:
    """Return what the browser needs of some parts: ``robot.js.x`` is ``robot.x`` there."""
    heads = tuple(f"{part}.js." for part in parts)
    texts = catalogue().texts
    return {name.replace(".js.", ".", 1): text for name, text in texts.items()
            if name.startswith(heads)}  # fmt: skip


def _flat(found: Any, name: str) -> Iterator[tuple[str, str]]:
    if isinstance(found, dict):
        for key, value in found.items():
            if not isinstance(key, str):
                raise MissingTextError(f"{name}: {key!r} is no text in YAML: write it in quotes")
            yield from _flat(value, f"{name}.{key}")
    else:
        yield name, str(found)
