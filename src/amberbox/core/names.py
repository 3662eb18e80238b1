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


def identifier(text: str) -> str:
    """Replace every character outside ``[A-Za-z0-9_]`` by ``_``; digits never come first."""
    name = _NOT_IN_A_NAME.sub("_", text)
    return name if name[:1] and not name[0].isdigit() else f"_{name}"


def readable(text: str) -> str:
    """Make an identifier that keeps what words of other scripts say, and is not too long.

    A longer one ends in 8 hex digits of the text's SHA-256 instead.
    """
    name = identifier(latin(text))
    if len(name) <= LONGEST:
        return name
    return f"{name[: LONGEST - 9]}_{_digest(text)[:8]}"


def item_name(source: str, topic: str) -> str:
    """Name the data item of a topic: ``/ropod/odom`` on ``ros`` is ``ros_ropod_odom``.

    Without a source the topic alone is the name.
    """
    return readable("_".join(part for part in (source, topic.strip("/")) if part))


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
    if not reserved(plain) and plain.casefold() not in taken:
        return plain
    digest = _digest(path)
    candidates = (f"{plain}_{digest[:count]}" for count in range(4, len(digest) + 1))
    # parent_... stays reserved whatever is appended, so such names step aside with a "_" first
    free = (f"_{name}" if reserved(name) else name for name in candidates)
    return next(name for name in free if name.casefold() not in taken)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
