"""Entries of the manifest about journals: sealed, signed, confirmed elsewhere, gone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import msgspec

from amberbox.core.types import Gap

What = Literal["raw", "columns", "both"]


@dataclass(frozen=True, slots=True)
class Hole:
    """Rows that were written and could not be read any more when the journal was sealed."""

    from_seq: int
    to_seq: int
    from_ns: int
    to_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class Sealed:
    """A journal file that nobody writes any more, as it was when the keeper sealed it.

    ``chain`` is the last link of its hash chain, ``start_chain`` the one it began with; ``tail`` is
    the SHA-256 of the ``bytes - tail_from`` bytes that follow the last link (the summary). Times
    are corrected times of receipt, inclusive. ``clock`` are (log time, wall minus log time) pairs,
    ``boot_base_ns`` is log time minus boot time, None where the file does not say.
    """

    journal: str
    writer: str
    run: int
    number: int
    first_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    bytes: int
    start_chain: str
    chain: str
    tail_from: int
    tail: str
    boot_id: str = ""
    boot_base_ns: int | None = None
    clock: tuple[tuple[int, int], ...] = ()
    synchronised: bool | None = None
    config_hash: str = ""
    holes: tuple[Hole, ...] = ()

    def gaps(self) -> tuple[Gap, ...]:
        """Return the holes as gaps of the record."""
        return tuple(
            Gap(self.writer, self.run, h.from_ns, h.to_ns, h.reason, "", h.to_seq - h.from_seq,
                h.from_seq, h.to_seq)
            for h in self.holes
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tombstone:
    """What was deleted on purpose: a stretch of one writer's run, raw, columns or both.

    ``journals`` are the files (one, or several once the manifest has been condensed), ``chain`` the
    last link of the last of them, so that the chain goes on over the hole.
    """

    journals: tuple[str, ...]
    what: What
    writer: str
    run: int
    first_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    chain: str
    reason: str
    confirmed: bool
    at_ns: int

    def gap(self) -> Gap:
        """Return what is missing as a gap of the record."""
        count = self.end_seq - self.first_seq
        return Gap(self.writer, self.run, self.start_ns, self.end_ns + 1,
                   f"deleted: {self.reason}", "", count, self.first_seq, self.end_seq)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Signature:
    """The robot's word for everything in the manifest up to the line with hash ``head``.

    ``key`` is the public key (hex), ``signature`` Ed25519 over store_id, head and at_ns.
    """

    head: str
    at_ns: int
    key: str
    signature: str


_KINDS: dict[str, type] = {"sealed": Sealed, "gone": Tombstone, "signed": Signature}
_NAMES = {cls: kind for kind, cls in _KINDS.items()}


def to_record(entry: Sealed | Tombstone | Signature) -> dict[str, Any]:
    """Return an entry as a line of the manifest."""
    return {"kind": _NAMES[type(entry)], "entry": msgspec.to_builtins(entry)}


def confirmed_record(journals: tuple[str, ...], by: str, at_ns: int) -> dict[str, Any]:
    """Say that a server holds these journals, verified."""
    return {"kind": "confirmed", "journals": list(journals), "by": by, "at_ns": at_ns}


def unconfirmed_record(journals: tuple[str, ...], by: str, at_ns: int) -> dict[str, Any]:
    """Say that a server does not hold these journals any more, though it had confirmed them."""
    return {"kind": "unconfirmed", "journals": list(journals), "by": by, "at_ns": at_ns}


def from_record(record: Mapping[str, Any]) -> Sealed | Tombstone | Signature | None:
    """Read what ``to_record`` returned; None for a line of another kind."""
    cls = _KINDS.get(record["kind"])
    if cls is None:
        return None
    entry: Sealed | Tombstone | Signature = msgspec.convert(record["entry"], cls)
    return entry
