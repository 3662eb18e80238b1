"""The second wall: what still looks like a secret in a robot's files is masked before it is kept.

Robots mask their secrets before they send anything. This is for those that did not: an older
version, a key in a file that nobody expected one in.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from amberbox.core.errors import Problem
from amberbox.core.nodes import parse_yaml
from amberbox.core.redaction import MASK, SOUNDS_SECRET, likely_secrets, redact

_YAML = (".yaml", ".yml")
_MASKS = (MASK, "(masked)")
_KEY_BLOCK = re.compile(r"-----BEGIN ([A-Z ]*PRIVATE KEY)-----.*?(-----END \1-----|\Z)", re.DOTALL)
_LOGIN = re.compile(r"(?<=://)([^\s:/?#@\"']*):([^\s/?#\"']+)@")
_SAID = re.compile(
    rf"(?im)^(?P<key>[\s\-#\"'<]*[\w.\-]*{SOUNDS_SECRET}[\w.\-]*[\"']?\s*[:=>]\s*)"
    r"(?P<value>[^\s{\[|>&*].*)$"
)


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
    return _SAID.sub(_hidden, text)


def _hidden(found: re.Match[str]) -> str:
    """Mask a value, unless the robot has done so; what its mask is followed by is no value."""
    written: str = found[0]
    is_masked = found["value"].strip("\"' ,;<").startswith(_MASKS)
    return written if is_masked else f"{found['key']}'{MASK}'"
