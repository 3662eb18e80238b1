"""Proofs of journals: the robot's seal, and the chain of lines that leads to its signature."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.segments.entries import Sealed, Signature, from_record
from amberbox.blackbox.segments.lines import decode
from amberbox.blackbox.segments.manifest import NAME
from amberbox.blackbox.signing.keys import holds
from amberbox.blackbox.signing.signing import signature_message
from amberbox.link.uploads import Proof

_MOST_GONE = 500


class ProofError(ValueError):
    """A proof does not hold."""


@dataclass(frozen=True, slots=True)
class Proven:
    """What a proof says of a journal; ``signed`` tells whether the robot's key vouches for it."""

    sealed: Sealed
    signed: bool


def proof_of(store: Path, journal: str) -> Proof | None:
    """Take a journal's seal and the lines after it up to the first signature; None unsealed.

    Without a signature behind it (a robot that has no key) all lines to the end are given.
    """
    return proofs_of(store, [journal]).get(journal)


def proofs_of(store: Path, journals: Sequence[str]) -> dict[str, Proof]:
    """Take the proofs of several journals in one pass over the manifest."""
    try:
        content = (store / NAME).read_bytes()
    except FileNotFoundError:
        return {}
    lines = [line for line in content.split(b"\n") if line]
    found: dict[str, Proof] = {}
    marks = {name: b'"journal":"%s"' % name.encode() for name in journals}
    gone = b"\n".join(_gone(lines)).decode()
    for at, line in enumerate(lines):
        if b',"kind":"sealed",' not in line:
            continue
        name = next((name for name, mark in marks.items() if mark in line), None)
        if name is not None:
            found[name] = Proof(b"\n".join(_to_signature(lines, at)).decode(errors="replace"), gone)
    return found


def _gone(lines: Sequence[bytes]) -> list[bytes]:
    """Return the lines of what was deleted unconfirmed, the newest when there are very many."""
    found = [n for n in lines if b',"kind":"gone",' in n and b'"confirmed":false' in n]
    return [line for line in found[-_MOST_GONE:] if decode(line) is not None]


def _to_signature(lines: Sequence[bytes], at: int) -> list[bytes]:
    taken = []
    for line in lines[at:]:
        taken.append(line)
        if b',"kind":"signed",' in line[:200]:
            break
    return taken


def signing_key(proof: Proof) -> str:
    """Return the key (hex) that a proof says it is signed with; empty where it says none."""
    record = decode(proof.lines.rpartition("\n")[2].encode())
    with suppress(ProofError):
        found = _entry(record) if record is not None else None
        return found.key if isinstance(found, Signature) else ""
    return ""


def prove(proof: Proof, store_id: str, journal: str, public_key: str) -> Proven:
    """Check a proof with the robot's public key (hex; empty where it has none).

    Raises ProofError when a line was changed, is missing, or is signed by another key.
    """
    records = _records(proof.lines)
    sealed = _entry(records[0])
    if not isinstance(sealed, Sealed) or sealed.journal != journal:
        raise ProofError(f"the first line is not the seal of {journal}")
    signature = _entry(records[-1])
    if not isinstance(signature, Signature):
        if public_key:
            raise ProofError("no signature follows the seal")
        return Proven(sealed, signed=False)
    if public_key and signature.key != public_key:
        raise ProofError(f"it is signed by another key ({signature.key}) than this robot's")
    if len(records) > 1 and signature.head != records[-2]["hash"]:
        raise ProofError("the signature is of another line than the one before it")
    message = signature_message(store_id, signature.head, signature.at_ns)
    if not holds(signature.key, signature.signature, message):
        raise ProofError("the signature does not hold")
    return Proven(sealed, signed=bool(public_key))


def _records(text: str) -> list[dict[str, Any]]:
    """Read lines and see that each follows the one before."""
    records: list[dict[str, Any]] = []
    for number, line in enumerate(text.encode().split(b"\n"), 1):
        record = decode(line)
        if record is None:
            raise ProofError(f"line {number} was changed")
        if records and record.get("prev") != records[-1]["hash"]:
            raise ProofError(f"line {number} does not follow the line before")
        records.append(record)
    return records


def _entry(record: dict[str, Any]) -> object:
    try:
        return from_record(record)
    except (msgspec.ValidationError, KeyError, TypeError) as error:
        raise ProofError(f"a line says nothing that can be read: {error}") from error
