"""Names of a store's items: assigned once, unique, never changed."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.journal_reader import journal_file
from amberbox.blackbox.store.store import FOLDERS, Store
from amberbox.core.files import replace_file
from amberbox.core.names import extend_names, item_name, readable_identifier

NAMES = "names.json"
# Key of the entry for the alphabet of variable names; all other keys are a source and a topic
_LETTERS = ""
_WRITERS = ("main", "bulk", "ring")
_NOT_NAMED = ("", channels.SOURCE)
# How many of each writer's journals without columns are read for the names of their items
_NEWEST = 3


class ItemNames:
    """The item name of each topic of each source, the same in every run of a store.

    ``restored`` describes the damaged parts of the file that were restored from the record.
    """

    def __init__(self, store: Path, *, is_new: bool = False) -> None:
        """``is_new``: the store holds no record yet."""
        self._path = store / NAMES
        self._lock = threading.Lock()
        self.restored = ""
        self._names = stated_names(store) or {}
        wrong = wrong_names(self._names, recorded_names(store))
        if wrong:
            taken = set(wrong.values())  # a damaged line may give the name to another topic
            self._names = {k: v for k, v in self._names.items() if v not in taken} | wrong
            self._save()
            self.restored = f"{NAMES} was damaged: {', '.join(sorted(wrong.values()))} restored"
        if is_new:
            self._names[_LETTERS] = "latin"

    @property
    def letters(self) -> bool:
        """Return whether variable names transliterate other scripts; not in older stores."""
        return _LETTERS in self._names

    def name(self, source: str, topic: str) -> str:
        """Return the item name of a topic; one that would collide gets a suffix of its own."""
        key = _key(source, topic)
        with self._lock:
            if key not in self._names:
                self._names = self._extended(key, item_name(source, topic))
                self._save()
            return self._names[key]

    def _save(self) -> None:
        with suppress(OSError):  # a full disk: it is written with the next name
            replace_file(self._path, names_text(self._names))

    def _extended(self, key: str, plain: str) -> dict[str, str]:
        """Return names with one for the key: the plain name if it is free, else one by its path."""
        if plain.casefold() not in {name.casefold() for name in self._names.values()}:
            return {**self._names, key: plain}
        return extend_names(self._names, [key], lambda name: False, readable_identifier)


def names_text(names: Mapping[str, str]) -> str:
    """Write names as their file has them."""
    return json.dumps(names, indent=0)


def stated_names(store: Path) -> dict[str, str] | None:
    """Read the names by source and topic that a store's file states; None if it cannot be read."""
    try:
        return msgspec.json.decode((store / NAMES).read_bytes(), type=dict[str, str])
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
        return None


def recorded_names(store: Path) -> dict[str, list[str]]:
    """Return the names that each topic of each source has in the record, the likeliest last."""
    known, found = mf.read(store), dict[str, list[str]]()
    for schema in known.schemas.values():
        if not schema.parent and schema.source not in _NOT_NAMED:
            found.setdefault(_key(schema.source, schema.topic), []).append(schema.item)
    for writer in _WRITERS:
        files = Store(store, "").journal_files(writer) if (store / FOLDERS[writer]).exists() else []
        later = [path for path in files if f"{path.parent.name}/{path.name}" not in known.journals]
        for path in later[-_NEWEST:]:
            with suppress(OSError):  # deleted or unreadable: the other journals have to do
                for stream in journal_file(path).streams.values():
                    if stream.source not in _NOT_NAMED:
                        key = _key(stream.source, stream.topic.name)
                        found.setdefault(key, []).append(stream.item)
    for key, name in known.names.items():
        found.setdefault(key, []).append(name)
    return found


def wrong_names(stated: Mapping[str, str], recorded: Mapping[str, list[str]]) -> dict[str, str]:
    """Return the names that the record has and the file does not state, by source and topic."""
    return {key: names[-1] for key, names in recorded.items() if stated.get(key) not in names}


def new_names(stated: Mapping[str, str], known: Mapping[str, str]) -> dict[str, str]:
    """Return the names that were given since; a name that another topic has is a damaged line."""
    taken = set(known.values())
    return {k: name for k, name in stated.items() if k not in known and name not in taken}


def _key(source: str, topic: str) -> str:
    return f"{source} {topic.strip('/')}"
