"""Find what a person means by a short name: a whole id, its title, or the end of it."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError

_PARTS = re.compile(r"[/.#]")
_WORDS = re.compile(r"[/.#_\s-]")
_SHOWN = 4


def named(name: str, known: Collection[str], kind: str, *, hint: str = "") -> str:
    """Return the id that a name is, or is the end of: ``stuck`` is ``fan/motor#stuck``.

    Raises UsageError when there is none, or when it is the end of several.
    """
    if name in known:
        return name
    return _one(name, _ending(name, known, _PARTS), known, kind, hint)


def component_named(
    name: str,
    known: Collection[str],
    titles: Mapping[str, str] | None = None,
    *,
    kind: str = "component",
    hint: str = "",
) -> str:
    """Return the id of a component by its id, its title, or its last words.

    ``front`` is ``laser_front`` where no other id ends so. ``titles`` are those of ids.
    Raises UsageError when there is none, or several are meant.
    """
    if name in known:
        return name
    wanted = name.casefold()
    found = [id_ for id_, title in (titles or {}).items() if title.casefold() == wanted]
    found = found or endings(name, known)
    return _one(name, found, known, kind, hint or f"known: {', '.join(known)}")


def endings(name: str, known: Collection[str]) -> list[str]:
    """Return the ids whose last words a name is, itself among them."""
    return _ending(name.casefold(), known, _WORDS)


def _ending(name: str, known: Collection[str], between: re.Pattern[str]) -> list[str]:
    parts = _parts(name, between)
    return [entry for entry in known if parts and _parts(entry, between)[-len(parts) :] == parts]


def _parts(name: str, between: re.Pattern[str]) -> list[str]:
    return [part for part in between.split(name) if part]


def _one(name: str, found: list[str], known: Collection[str], kind: str, hint: str) -> str:
    if len(found) == 1:
        return found[0]
    if not found:
        raise UsageError(f"there is no {kind} '{name}'{did_you_mean(name, known)}", hint)
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    what = f"'{name}' is the end of {len(found)} {kind}s"
    raise UsageError(what, f"name one of {', '.join(found[:_SHOWN])}{more}")
