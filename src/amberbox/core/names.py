"""Names: ids of robots and components, names of items and columns, short names people type.

Ids are short, lower case and safe in file names. Names of items and columns are derived from
topics and paths, unique, and never changed again; letters of other scripts are transliterated. A
person may give a whole id, its title, or the end of it.
"""
# ruff: noqa: RUF001  # letters of other scripts that look like Latin ones are spelled here

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

from amberbox.core.errors import UsageError, did_you_mean

# spelling of Cyrillic, of Greek, and of Latin letters that are no letter with a mark
_TABLES = (
    "а a б b в v г g д d е e ё yo ж zh з z и i й y к k л l м m н n о o п p р r с s т t у u ф f х "
    "kh ц ts ч ch ш sh щ shch ы y э e ю yu я ya є ye і i ї yi ґ g ў u ј j љ lj њ nj ћ c ђ dj џ dz",
    "α a β b γ g δ d ε e ζ z η i θ th ι i κ k λ l μ m ν n ξ x ο o π p ρ r σ s ς s τ t υ y φ f χ ch "
    "ψ ps ω o",
    "ß ss æ ae œ oe ø o đ d ð d þ th ł l \u0131 i",
)

_HANGUL = frozenset(map(chr, range(0xAC00, 0xD7A4)))
_SPELLINGS = " ".join(_TABLES).split()
_KNOWN = {**dict(zip(_SPELLINGS[::2], _SPELLINGS[1::2], strict=True)), "ъ": "", "ь": ""}


def to_latin(text: str) -> str:
    """Write every letter and digit in ASCII: é as e, ж as zh, ب as beh, 温 as u6e29.

    Letters of alphabets without a table are spelled by their Unicode names, ideographs by their
    numbers. Other characters are not changed.
    """
    if text.isascii():
        return text
    return "".join(map(_latin, unicodedata.normalize("NFC", text)))


def _latin(letter: str) -> str:
    known = _KNOWN.get(letter.lower())
    if known is not None:
        return known.capitalize() if letter.isupper() else known
    if letter in _HANGUL:
        return unicodedata.name(letter).rpartition(" ")[2].lower()
    return "".join(map(_plain, unicodedata.normalize("NFKD", letter)))


def _plain(letter: str) -> str:
    if letter.isascii() or not (letter.isalnum() or unicodedata.combining(letter)):
        return letter
    if unicodedata.combining(letter):
        return ""
    if letter.isdecimal():
        return str(unicodedata.decimal(letter))
    known = _KNOWN.get(letter.lower())
    if known is not None:
        return known.capitalize() if letter.isupper() else known
    name = unicodedata.name(letter, "").rpartition(" ")[2]
    return f"{name.lower()}_" if name.isalpha() and len(name) > 2 else _short(name, letter)


def _short(name: str, letter: str) -> str:
    return name.lower() if name.isalpha() else f"u{ord(letter):x}"


_ID = re.compile(r"[a-z0-9_.-]{1,64}")
_LONGEST_ID = 64


def is_id(text: str) -> bool:
    """Return whether ``text`` is ``[a-z0-9_.-]{1,64}`` and no name of a folder such as ``..``."""
    return bool(_ID.fullmatch(text)) and text.strip(".") != ""


def derive_id(text: str) -> str:
    """Make an id of any name: the name itself if it is one, else a readable id close to it.

    A name that had to be cut gets 4 hex digits of its SHA-256, so that long names stay apart.
    """
    if is_id(text):
        return text
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    readable = re.sub(r"[^a-z0-9_.-]+", "_", ascii_text).strip("_.-")
    digits = hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:4]
    if not readable:
        return f"id_{digits}"
    return readable if len(readable) <= _LONGEST_ID else f"{readable[: _LONGEST_ID - 5]}_{digits}"


_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9_]")
LONGEST = 128  # characters of a name made of words of any length and script
_RESERVED = frozenset({"timestamp", "received", "seq", "index"})
_TABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_LONGEST = 200  # bytes of an item's name: with an ending it is still a file name
_LONGEST_FILE = 255


def identifier(text: str) -> str:
    """Replace every character outside ``[A-Za-z0-9_]`` by ``_``; digits never come first."""
    name = _NOT_IN_A_NAME.sub("_", text)
    return name if name[:1] and not name[0].isdigit() else f"_{name}"


def readable_identifier(text: str) -> str:
    """Make a readable identifier of limited length, other scripts transliterated.

    A longer one ends in 8 hex digits of the text's SHA-256 instead.
    """
    return shortened(identifier(to_latin(text)), LONGEST, text)


def item_name(source: str, topic: str) -> str:
    """Name the data item of a topic: ``/ropod/odom`` on ``ros`` is ``ros_ropod_odom``.

    Without a source the topic alone is the name. A long one is cut (see ``fitted``).
    """
    return readable_identifier("_".join(part for part in (source, topic.strip("/")) if part))


def with_parents(item: str) -> Iterator[str]:
    """Name an item and the items that it may be a child table of."""
    yield item
    while "__" in item:
        item = item.rpartition("__")[0]
        yield item


def child_name(table: str, path: str) -> str:
    """Name the child table of a table: ``table__path``, cut if it is long."""
    return shortened(f"{table}__{identifier(path)}")


def shortened(name: str, longest: int = _LONGEST, text: str = "") -> str:
    """Cut a long name of an item, so that it can be the name of a file or of a database column.

    A cut name ends in 8 hex digits of the SHA-256 of the text, or of the whole name.
    """
    if len(name) <= longest:
        return name
    return f"{name[: longest - 9]}_{_digest(text or name)[:8]}"


def is_item(name: str) -> bool:
    """Return whether this is a name of an item or child table: ``[A-Za-z_][A-Za-z0-9_]*``.

    255 characters at most: names are those of folders, too.
    """
    return len(name) <= _LONGEST_FILE and has_item_form(name)


def has_item_form(name: str) -> bool:
    """Return whether a name has the characters of an item's, however long it is."""
    return _TABLE.fullmatch(name) is not None


def is_reserved(name: str) -> bool:
    """Return whether a column name is reserved: time, place and parent of a row."""
    folded = name.casefold()
    return folded in _RESERVED or folded.startswith("parent_")


def unique_names(
    paths: Iterable[str],
    reserved: Callable[[str], bool] = is_reserved,
    plain: Callable[[str], str] = identifier,
) -> dict[str, str]:
    """Return a unique name for each path, compared without case.

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
    plain = shortened(plain)
    if not reserved(plain) and plain.casefold() not in taken:
        return plain
    digest = _digest(path)
    candidates = (f"{plain}_{digest[:count]}" for count in range(4, len(digest) + 1))
    # parent_... stays reserved whatever is appended, so such names get a leading "_"
    free = (f"_{name}" if reserved(name) else name for name in candidates)
    return next(name for name in free if name.casefold() not in taken)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


_PARTS = re.compile(r"[/.#]")
_WORDS = re.compile(r"[/.#_\s-]")
_SHOWN = 4


def full_id(name: str, known: Collection[str], kind: str, *, hint: str = "") -> str:
    """Return the id that equals a name or ends with it: ``stuck`` is ``fan/motor#stuck``.

    Raises UsageError when there is none, or when there are several.
    """
    if name in known:
        return name
    return _one(name, _ending(name, known, _PARTS), known, kind, hint)


def component_id(
    name: str,
    known: Collection[str],
    titles: Mapping[str, str] | None = None,
    *,
    kind: str = "component",
    hint: str = "",
) -> str:
    """Return the id of a component by its id, its title, or its last words.

    ``front`` is ``laser_front`` if no other id has this ending. ``titles`` are those of ids. Raises
    UsageError when there is no such component, or more than one.
    """
    if name in known:
        return name
    wanted = name.casefold()
    found = [id_ for id_, title in (titles or {}).items() if title.casefold() == wanted]
    found = found or ids_ending_in(name, known)
    return _one(name, found, known, kind, hint or f"known: {', '.join(known)}")


def ids_ending_in(name: str, known: Collection[str]) -> list[str]:
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


def some_names(names: Sequence[str], most: int) -> str:
    """Return at most ``most`` names joined with commas, and the number of further names."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
