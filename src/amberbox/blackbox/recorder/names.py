"""Names of a store's items: given once, unique, kept for good."""

from __future__ import annotations

import json
import threading
from contextlib import suppress
from pathlib import Path

from amberbox.core.files import replace_file
from amberbox.core.names import extend_names, item_name, readable

_FILE = "names.json"
_LETTERS = ""
"""Entry that says how the store names variables; all others are a source and a topic."""


class ItemNames:
    """Gives each topic of each source its item name, the same in every run of a store."""

    def __init__(self, store: Path, *, is_new: bool) -> None:
        """``is_new`` says that the store holds no record yet."""
        self._path = store / _FILE
        self._lock = threading.Lock()
        self._names: dict[str, str] = {}
        try:
            self._names = json.loads(self._path.read_text())
        except (OSError, ValueError):  # a new store, or a file that is made again from topics
            self._names = {}
        if is_new:
            self._names[_LETTERS] = "latin"

    @property
    def letters(self) -> bool:
        """Whether variables keep what words of other scripts say; not so in older stores."""
        return _LETTERS in self._names

    def name(self, source: str, topic: str) -> str:
        """Return the item name of a topic; one that would collide gets a suffix of its own."""
        key = f"{source} {topic.strip('/')}"
        with self._lock:
            if key not in self._names:
                self._names = self._extended(key, item_name(source, topic))
                with suppress(OSError):  # a full disk: it is written with the next name
                    replace_file(self._path, json.dumps(self._names, indent=0))
            return self._names[key]

    def _extended(self, key: str, plain: str) -> dict[str, str]:
        """Let the plain name stand if it is free, else name the key by its path."""
        if plain.casefold() not in {name.casefold() for name in self._names.values()}:
            return {**self._names, key: plain}
        return extend_names(self._names, [key], lambda name: False, readable)
