"""The second wall: what still looks like a secret in a robot's files is masked before it is kept.

Robots mask their secrets before they send anything. This is for those that did not: an older
version, a key in a file that nobody expected one in.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from amberbox.core.errors import Problem
from amberbox.core.nodes import parse_yaml
from amberbox.core.redaction import MASK, SECRET_WORDS, SOUNDS_SECRET, likely_secrets, redact

_YAML = (".yaml", ".yml")
_MASKS = (MASK, "(masked)")
_KEY_BLOCK = re.compile(r"-----BEGIN ([A-Z ]*PRIVATE KEY)-----.*?(-----END \1-----|\Z)", re.DOTALL)
_LOGIN = re.compile(r"(?<=://)([^\s:/?#@\"']*):([^\s/?#\"']+)@")
_LEAD = re.compile(r"[\s\-#\"'<]*")
_WORD = re.compile(r"[\w.\-]*")
_SECRET = re.compile(SOUNDS_SECRET, re.IGNORECASE)
_BEYOND = tuple(len(word.partition("_")[0]) for word in SECRET_WORDS if "_" in word)
"""Lengths of what stands before the space in a secret's name such as ``API key``."""
_VALUE = re.compile(r"[\"']?\s*[:=>]\s*(?P<value>[^\s{\[|>&*].*)")


def masked(files: Mapping[str, bytes]) -> tuple[dict[str, bytes], list[str]]:
    """Return the files without what looks like a secret, and the names of those that had any."""
    found = {name: _masked(name, data) for name, data in files.items()}
    return found, [name for name in files if found[name] != files[name]]


def _masked(name: str, data: bytes) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    text = _LOGIN.sub(rf"\1:{MASK}@", _KEY_BLOCK.sub(MASK, text))
    read = _read(name, text)
    return (_by_lines(text) if read is None else read).encode("utf-8", "surrogateescape")


def _read(name: str, text: str) -> str | None:
    """Mask the values of telling keys in YAML; None for what cannot be read as that."""
    if not name.lower().endswith(_YAML):
        return None
    problems: list[Problem] = []
    node = parse_yaml(text, name, problems)
    return None if node is None or problems else redact(text, likely_secrets(node))


def _by_lines(text: str) -> str:
    """Mask what stands behind a telling key at the start of a line, or on the lines after it.

    Linear in the length of the text, blank lines and words of any length included.
    """
    parts, at, line = [], 0, 0
    while line < len(text):
        lead = _LEAD.match(text, line)
        assert lead is not None
        value = _value_of(text, line, lead.end())
        if value is None:
            end = lead.end()
        else:
            end = value.end()
            if not value["value"].strip("\"' ,;<").startswith(_MASKS):  # the robot has done so
                parts += [text[at : value.start("value")], f"'{MASK}'"]
                at = end
        line = text.find("\n", end) + 1 or len(text)
    return "".join([*parts, text[at:]])


def _value_of(text: str, line: int, lead_end: int) -> re.Match[str] | None:
    """Find the value behind the key that follows the lead of a line; None for no telling key."""
    start = line + len(text[line:lead_end].rstrip("-"))  # hyphens may belong to the key
    end = _end_of_word(text, start)
    if _SECRET.search(text, start, end):
        found = _VALUE.match(text, end)
        if found is not None:
            return found
    for length in _BEYOND:
        spaced = _SECRET.match(text, end - length) if end - length >= start else None
        if spaced is not None and spaced.end() > end:
            return _VALUE.match(text, _end_of_word(text, spaced.end()))
    return None


def _end_of_word(text: str, start: int) -> int:
    word = _WORD.match(text, start)
    assert word is not None
    return word.end()
