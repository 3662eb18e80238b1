"""One row of the audit log, and the hash that ties it to the row before."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from amberbox.core.redaction import MASK, sounds_secret

Result = Literal["ok", "refused", "failed"]
START = "0" * 64
"""What the first row follows on."""

_LONGEST = {"principal": 140, "address": 64, "action": 64, "object": 300}
_LONGEST_DETAILS = 8_000
_SECRET_HERE = ("csrf", "cookie", "private")
"""What requests have besides, that opens something."""


@dataclass(frozen=True, slots=True)
class Entry:
    """What somebody did: ``principal`` from ``address`` did ``action`` to ``object``.

    ``details`` is what JSON can hold; values whose key sounds secret are masked, and what is too
    long is cut, so that nobody can fill the disk through the log.
    """

    principal: str
    address: str
    action: str
    object: str = ""
    result: Result = "ok"
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Row:
    """A row as it is kept; ``details`` is JSON text, ``hash`` 64 hex digits."""

    seq: int
    time_ns: int
    principal: str
    address: str
    action: str
    object: str
    result: str
    details: str
    hash: str


def row_after(previous_seq: int, previous_hash: str, now_ns: int, entry: Entry) -> Row:
    """Make the row that follows on the one with this number and hash."""
    cut = {name: _plain(getattr(entry, name))[:most] for name, most in _LONGEST.items()}
    row = Row(
        previous_seq + 1,
        now_ns,
        cut["principal"],
        cut["address"],
        cut["action"],
        cut["object"],
        entry.result,
        _details(entry.details),
        "",
    )
    return Row(*_contents(row), link(previous_hash, row))


def link(previous_hash: str, row: Row) -> str:
    """Return the hash that a row has after another: SHA-256 of that hash and of the row as JSON."""
    text = json.dumps([previous_hash, *_contents(row)], ensure_ascii=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def _contents(row: Row) -> tuple[int, int, str, str, str, str, str, str]:
    return (
        row.seq,
        row.time_ns,
        row.principal,
        row.address,
        row.action,
        row.object,
        row.result,
        row.details,
    )


def _plain(text: str) -> str:
    """Replace what a database may refuse in a text: NUL and halves of surrogate pairs."""
    return (
        text.encode("utf-8", "replace").decode("utf-8").replace("\0", "\N{REPLACEMENT CHARACTER}")
    )


def _details(details: Mapping[str, Any]) -> str:
    text = json.dumps(_masked(details), sort_keys=True, default=str)
    if len(text) <= _LONGEST_DETAILS:
        return text
    return json.dumps({"cut": text[: _LONGEST_DETAILS // 2], "characters": len(text)})


def _masked(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(_masked_pairs(value))
    if isinstance(value, list | tuple | set | frozenset):
        return [_masked(inner) for inner in value]
    return value


def _masked_pairs(pairs: Mapping[Any, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in pairs.items():
        secret = isinstance(value, str) and _is_secret(str(key))
        yield str(key), MASK if secret else _masked(value)


def _is_secret(key: str) -> bool:
    return sounds_secret(key) or any(word in key.lower() for word in _SECRET_HERE)
