"""Names of data items and columns: derived from topics and paths, unique, never changed again."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Mapping

from amberbox.core.letters import latin

_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9_]")
LONGEST = 128
"""Characters of a name made of words that may be of any length and script."""
_RESERVED = frozenset({"timestamp", "received", "seq", "index"})
_TABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_LONGEST = 200
"""Bytes of an item's name that this box gives: with an ending it is still a file name."""
_LONGEST_FILE = 255


def identifier(text: str) -> str:
    """Replace every character outside ``[A-Za-z0-9_]`` by ``_``; digits never come first."""
    name = _NOT_IN_A_NAME.sub("_", text)
    return name if name[:1] and not name[0].isdigit() else f"_{name}"


def readable(text: str) -> str:
    """Make an identifier that keeps what words of other scripts say, and is not too long.

    A longer one ends in 8 hex digits of the text's SHA-256 instead.
    """
    return fitted(identifier(latin(text)), LONGEST, text)


def item_name(source: str, topic: str) -> str:
    """Name the data item of a topic: ``/ropod/odom`` on ``ros`` is ``ros_ropod_odom``.

    Without a source the topic alone is the name. A long one is cut (see ``fitted``).
    """
    return readable("_".join(part for part in (source, topic.strip("/")) if part))


def child_name(table: str, path: str) -> str:
    """Name the child table of a table: ``table__path``, cut if it is long."""
    return fitted(f"{table}__{identifier(path)}")


def fitted(name: str, longest: int = _LONGEST, text: str = "") -> str:
    """Cut a long name of an item, so that it can be the name of a file or of a database column.

    What was cut is told apart by 8 hex digits of the SHA-256 of the text, or of the whole name.
    """
    if len(name) <= longest:
        return name
    return f"{name[: longest - 9]}_{_digest(text or name)[:8]}"


def is_item(name: str) -> bool:
    """Tell whether this is how an item or child table is called: ``[A-Za-z_][A-Za-z0-9_]*``.

    255 characters at most: names are those of folders, too.
    """
    return len(name) <= _LONGEST_FILE and has_item_form(name)


def has_item_form(name: str) -> bool:
    """Tell whether a name has the characters of an item's, however long it is."""
    return _TABLE.fullmatch(name) is not None


def is_reserved(name: str) -> bool:
    """Tell whether a column name belongs to us: time, place and parent of a row."""
    folded = name.casefold()
    return folded in _RESERVED or folded.startswith("parent_")


def unique_names(
    paths: Iterable[str],
    reserved: Callable[[str], bool] = is_reserved,
    plain: Callable[[str], str] = identifier,
) -> dict[str, str]:
    """Give each path a name of its own, compared without case.

    The first path keeps the plain name; others, and those whose name is reserved, get ``_`` and
    the first 4 hex digits of the path's SHA-256 (more, should those be taken as well).
    """
    return extend_names({}, paths, reserved, plain)


def extend_names(
    names: Mapping[str, str],
    paths: Iterable[str],
    reserved: Callable[[str], bool] = is_reserved,
    plain: Callable[[str], str] = identifier,
) -> dict[str, str]:
    """Name further paths, each by ``plain``, without changing a name that was given before."""
    extended = dict(names)
    taken = {name.casefold() for name in extended.values()}
    for path in paths:
        if path not in extended:
            extended[path] = _free_name(path, plain(path), taken, reserved)
            taken.add(extended[path].casefold())
    return extended


def _free_name(path: str, plain: str, taken: set[str], reserved: Callable[[str], bool]) -> str:
    plain = fitted(plain)
    if not reserved(plain) and plain.casefold() not in taken:
        return plain
    digest = _digest(path)
    candidates = (f"{plain}_{digest[:count]}" for count in range(4, len(digest) + 1))
    # parent_... stays reserved whatever is appended, so such names step aside with a "_" first
    free = (f"_{name}" if reserved(name) else name for name in candidates)
    return next(name for name in free if name.casefold() not in taken)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
