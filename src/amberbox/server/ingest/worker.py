"""Worker operations on data of robots: verify a journal, mask and store a folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from amberbox.core.errors import Problem
from amberbox.core.redaction import MASK, SECRET_WORDS, SOUNDS_SECRET, redact, secrets_by_name
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.link.folders import is_picture, unpack
from amberbox.server.ingest.folders import FolderContents, FolderStore
from amberbox.server.ingest.verification import verify_arguments
from amberbox.server.workers.process import leave_with_server
from amberbox.server.workers.protocol import be_first_to_go

_YAML = (".yaml", ".yml")
_MASKS = (MASK, "(masked)")
_KEY_BLOCK = re.compile(r"-----BEGIN ([A-Z ]*PRIVATE KEY)-----.*?(-----END \1-----|\Z)", re.DOTALL)
_LOGIN = re.compile(r"(?<=://)([^\s:/?#@\"']*):([^\s/?#\"']+)@")
_LEAD = re.compile(r"[\s\-#\"'<]*")
_WORD = re.compile(r"[\w.\-]*")
_SECRET = re.compile(SOUNDS_SECRET, re.IGNORECASE)
# Lengths of what precedes the space in a secret's name such as ``API key``
_BEYOND = tuple(len(word.partition("_")[0]) for word in SECRET_WORDS if "_" in word)
_VALUE = re.compile(r"[\"']?\s*[:=>]\s*(?P<value>[^\s{\[|>&*].*)")


def masked(files: Mapping[str, bytes]) -> tuple[dict[str, bytes], list[str]]:
    """Return the files with secrets masked, and the names of those that had any."""
    found = {n: data if is_picture(n) else _masked(n, data) for n, data in files.items()}
    return found, [name for name in files if found[name] != files[name]]


def _masked(name: str, data: bytes) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    text = _LOGIN.sub(rf"\1:{MASK}@", _KEY_BLOCK.sub(MASK, text))
    read = _read(name, text)
    return (mask_lines(text) if read is None else read).encode("utf-8", "surrogateescape")


def _read(name: str, text: str) -> str | None:
    """Return a text with YAML values of secret-sounding keys masked; None for invalid YAML."""
    if not name.lower().endswith(_YAML):
        return None
    problems: list[Problem] = []
    node = parse_yaml(text, name, problems)
    return None if node is None or problems else redact(text, secrets_by_name(node))


def mask_lines(text: str) -> str:
    """Mask values after a secret-sounding key at the start of a line, or on the lines after it.

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
            if not value["value"].strip("\"' ,;<").startswith(_MASKS):  # masked by the robot
                parts += [text[at : value.start("value")], f"'{MASK}'"]
                at = end
        line = text.find("\n", end) + 1 or len(text)
    return "".join([*parts, text[at:]])


def _value_of(text: str, line: int, lead_end: int) -> re.Match[str] | None:
    """Return the value after a secret-sounding key at the start of a line; None without one."""
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


def keep(folder: Path, arguments: dict[str, Any]) -> bytes:
    """Unpack a folder, mask its secrets, and store it; raises FolderError."""
    files, hidden = masked(unpack(arguments["data"]))
    FolderStore(folder).keep(arguments["robot"], arguments["config_hash"], files)
    size = sum(map(len, files.values()))
    return msgspec.msgpack.encode(FolderContents(len(files), size, hidden))


def verify(folder: Path, arguments: dict[str, Any]) -> bytes:
    """Verify an uploaded journal; return the result as msgpack."""
    leave_with_server()
    be_first_to_go()
    return verify_arguments(arguments)
