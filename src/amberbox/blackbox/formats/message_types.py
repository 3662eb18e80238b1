"""Definitions of ROS 1 messages by their type's name: from a folder of .msg files, or built in."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from amberbox.blackbox.unroll.definition import SIZES, current_names
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Schema

_SEPARATOR = "=" * 80 + "\n"
_FIELD = re.compile(r"^[ \t]*([A-Za-z][\w/]*)(?:[ \t]*+\[\d*\])?[ \t]++\w+[ \t]*(?:#.*)?$", re.M)
_PRIMITIVES = {*SIZES, "byte", "char", "string"}


@dataclass(frozen=True, slots=True)
class FoundType:
    """A complete definition; ``place`` is where its first text comes from, for a person."""

    schema: Schema
    place: str


class MessageTypes:
    """Finds definitions; those of the folder come before the built-in ones of ROS 1.

    The folder holds ``package/msg/Name.msg`` or ``package/Name.msg`` at any depth. Files that lie
    in it directly are taken for any package whose type is not known otherwise.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._files: dict[str, Path] = {}
        self._flat: dict[str, Path] = {}
        if folder is not None:
            self._index(folder)

    def _index(self, folder: Path) -> None:
        if not folder.is_dir():
            raise UsageError(f"there is no folder {folder}", "--msg names a folder of .msg files")
        for path in sorted(folder.rglob("*.msg")):
            parents = [p.name for p in path.parents if p != folder and folder in p.parents]
            package = next((name for name in parents if name != "msg"), "")
            if package:
                self._files.setdefault(f"{package}/{path.stem}", path)
            else:
                self._flat[path.stem] = path
        if not self._files and not self._flat:
            raise UsageError(f"{folder} holds no .msg file", "--msg names a folder of .msg files")

    def find(self, type_name: str) -> FoundType | None:
        """Return the definition of a type with all it needs; None if one of them is not known.

        Raises AmberboxError when a file cannot be read.
        """
        root = current_names(type_name).replace("/msg/", "/")
        texts: dict[str, str] = {}
        places: list[str] = []
        missing = [root]
        while missing:
            name = missing.pop(0)
            found = self._text(name)
            if found is None:
                return None
            texts[name] = found[0]
            places.append(found[1])
            missing += [n for n in _needed(name, found[0]) if n not in texts and n not in missing]
        return FoundType(Schema(root, "ros1msg", _joined(texts).encode()), places[0])

    def _text(self, name: str) -> tuple[str, str] | None:
        path = self._files.get(name)
        if path is None and name not in _built_in().names:
            path = self._flat.get(name.partition("/")[2])
        if path is not None:
            return _read(path), f"from {self._folder}"
        built_in = _built_in().text(name)
        return None if built_in is None else (built_in, "built in")


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").replace("\r\n", "\n")
    except OSError as error:
        raise AmberboxError(
            f"cannot read {path}: {error.strerror}", "check the path and its permissions"
        ) from None


def _needed(name: str, text: str) -> Iterator[str]:
    """Give the full names of the structures in a definition; constants are no fields."""
    package = name.partition("/")[0]
    for base in map(current_names, _FIELD.findall(text)):
        if base == "Header":
            yield "std_msgs/Header"
        elif base not in _PRIMITIVES:
            yield base.replace("/msg/", "/") if "/" in base else f"{package}/{base}"


def _joined(texts: dict[str, str]) -> str:
    """Write definitions one after the other, as ROS 1 bags have them."""
    (_, first), *others = texts.items()
    ended = [f"MSG: {name}\n{_line_end(text)}" for name, text in others]
    return _SEPARATOR.join([_line_end(first), *ended])


def _line_end(text: str) -> str:
    return text if text.endswith("\n") or not text else f"{text}\n"


class _BuiltIn:
    """The message types of ROS 1 noetic that rosbags knows."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._types: Any = get_typestore(Stores.ROS1_NOETIC)
        self.names = {name.replace("/msg/", "/") for name in self._types.fielddefs}

    def text(self, name: str) -> str | None:
        """Return the definition of a type without those it needs."""
        if name not in self.names:
            return None
        text, _ = self._types.generate_msgdef(name.replace("/", "/msg/"), ros_version=1)
        return str(text).partition(_SEPARATOR)[0]


@cache  # takes 0.1 s to build and never changes
def _built_in() -> _BuiltIn:
    return _BuiltIn()
