"""Uploads of journals: names, pieces, proofs of a journal's content, and the server's holdings.

``HEAD`` returns how much is held, ``PATCH`` adds a piece at an offset, ``POST`` ends with the
proof: the robot's seal, and the chain of manifest lines that leads to its signature.

A server that was restored from a backup lacks journals that its robots take as confirmed. On each
connection a robot states what it takes as held, as ranges of files with consecutive numbers and a
digest of each; the server lists what it holds in the ranges whose digest differs.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta, Struct

from amberbox.blackbox.signing.keys import holds
from amberbox.blackbox.signing.signatures import signature_message
from amberbox.blackbox.store.manifest import NAME
from amberbox.blackbox.store.manifest_entries import ManifestSignature, SealedJournal, from_record
from amberbox.blackbox.store.manifest_lines import decode
from amberbox.blackbox.store.store import FOLDERS
from amberbox.link.limits import PATH

State = Literal["incoming", "verified", "aside", "quarantined"]
OFFSET = "Upload-Offset"
BYTES = "Upload-Bytes"
SHA256 = "Upload-Sha256"
STATE = "Upload-State"
CRC = "Piece-Crc32"

# Largest size of a journal
JOURNAL_BYTES = 4 << 30
PROOF_BYTES = 16 << 20

_FOLDERS = "|".join(FOLDERS.values())
_NAME = re.compile(rf"({_FOLDERS})/[0-9]{{1,12}}-[0-9a-z]{{1,16}}-[0-9]{{1,12}}\.mcap")
_STORE = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_DIGEST = re.compile(r"[0-9a-f]{64}")


class Proof(Struct, frozen=True):
    """The lines of the robot's manifest about a journal, from its seal to a signature.

    Without a seal (journals of the ring, which only an incident keeps) there are no lines. ``gone``
    are the lines of all deletions before a server had the data, wherever they are: deletions while
    the robot was offline follow seals of journals that never arrive.
    """

    lines: str = ""
    gone: str = ""


class Verdict(Struct, frozen=True):
    """The state of a journal on the server; ``reason`` is why it was refused."""

    state: State
    reason: str = ""


def is_journal_name(text: str) -> bool:
    """Return whether a text is the ``folder/file`` name of a journal."""
    return _NAME.fullmatch(text) is not None


def is_store_id(text: str) -> bool:
    """Return whether a text is a store id."""
    return _STORE.fullmatch(text) is not None


def is_digest(text: str) -> bool:
    """Return whether a text is a SHA-256 as hex digits."""
    return _DIGEST.fullmatch(text) is not None


def address(store_id: str, journal: str) -> str:
    """Return the path of a journal on the server."""
    return f"{PATH}/journals/{store_id}/{journal}"


_MOST_GONE = 500


class ProofError(ValueError):
    """A proof is invalid."""


@dataclass(frozen=True, slots=True)
class ProvenSeal:
    """The seal in a proof; ``signed``: the robot's key has signed it."""

    sealed: SealedJournal
    signed: bool


def proof_of(store: Path, journal: str) -> Proof | None:
    """Return a journal's seal and the lines up to the first signature; None if it is unsealed.

    Without a later signature (a robot without a key) all lines to the end are included.
    """
    return proofs_of(store, [journal]).get(journal)


def proofs_of(store: Path, journals: Sequence[str]) -> dict[str, Proof]:
    """Return the proofs of several journals in one pass over the manifest."""
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
    """Return the lines of unconfirmed deletions, only the newest if there are very many."""
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
    """Return the signer's key (hex) that a proof names; empty where it names none."""
    record = decode(proof.lines.rpartition("\n")[2].encode())
    with suppress(ProofError):
        found = _entry(record) if record is not None else None
        return found.key if isinstance(found, ManifestSignature) else ""
    return ""


def check_proof(proof: Proof, store_id: str, journal: str, public_key: str) -> ProvenSeal:
    """Check a proof with the robot's public key (hex; empty where it has none).

    Raises ProofError when a line was changed, is missing, or is signed by another key.
    """
    records = _records(proof.lines)
    sealed = _entry(records[0])
    if not isinstance(sealed, SealedJournal) or sealed.journal != journal:
        raise ProofError(f"the first line is not the seal of {journal}")
    signature = _entry(records[-1])
    if not isinstance(signature, ManifestSignature):
        if public_key:
            raise ProofError("no signature follows the seal")
        return ProvenSeal(sealed, signed=False)
    if public_key and signature.key != public_key:
        raise ProofError(f"it is signed by another key ({signature.key}) than this robot's")
    if len(records) > 1 and signature.head != records[-2]["hash"]:
        raise ProofError("the signature is of another line than the one before it")
    message = signature_message(store_id, signature.head, signature.at_ns)
    if not holds(signature.key, signature.signature, message):
        raise ProofError("the signature does not hold")
    return ProvenSeal(sealed, signed=bool(public_key))


def _records(text: str) -> list[dict[str, Any]]:
    """Return the decoded lines; raises ProofError where one does not follow the one before."""
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


# Largest number of files in a range, which bounds the list when one of them is missing
RANGE_FILES = 128
# Most ranges in one question
MOST_RANGES = 500
QUESTION_BYTES = 256 << 10

_PARTS_OF_NAME = re.compile(r"([a-z]+/[0-9]{1,12}-[0-9a-z]{1,16})-([0-9]{1,12})\.mcap")
_Number = Annotated[int, Meta(ge=0, lt=10**12)]


class JournalCopy(NamedTuple):
    """A journal as identified by both ends: name, bytes, and whether it was found valid."""

    name: str
    bytes: int
    holds: bool = True


class JournalRange(Struct, frozen=True, array_like=True):
    """Files of one run of a writer, by ``folder/run-boot`` and number, both ends inclusive."""

    run: Annotated[str, Meta(max_length=64)]
    first: _Number
    last: _Number
    count: _Number
    digest: Annotated[bytes, Meta(max_length=16)]


class HoldingsQuestion(Struct, frozen=True):
    """The files of one store that a robot assumes the server to hold."""

    stretches: Annotated[list[JournalRange], Meta(max_length=MOST_RANGES)]


# A copy within a range: its number, bytes, and whether it was found valid
Listed = tuple[int, int, bool]


class HoldingsAnswer(Struct, frozen=True):
    """The files that the server holds in the ranges that differ, by their index in the question."""

    differing: dict[int, list[Listed]]


def holdings_address(store_id: str) -> str:
    """Return the path of this question about a store on the server."""
    return f"{PATH}/held/{store_id}"


def journal_ranges(
    counted_on: Iterable[JournalCopy],
) -> list[tuple[JournalRange, list[JournalCopy]]]:
    """Divide copies into ranges, each with its copies; invalid names are left out."""
    found = []
    for run, copies in sorted(_by_run(counted_on).items()):
        for part in _consecutive(sorted(copies.items())):
            listed = [copy for _, copy in part]
            first, last = part[0][0], part[-1][0]
            found.append((JournalRange(run, first, last, len(listed), digest(listed)), listed))
    return found


def questions(
    ranges: Sequence[tuple[JournalRange, list[JournalCopy]]],
) -> Iterator[Sequence[tuple[JournalRange, list[JournalCopy]]]]:
    """Yield the ranges in parts that fit in one question each."""
    for start in range(0, len(ranges), MOST_RANGES):
        yield ranges[start : start + MOST_RANGES]


def compare_holdings(question: HoldingsQuestion, held: Iterable[JournalCopy]) -> HoldingsAnswer:
    """Return the copies that are held in each range whose digest differs."""
    runs: dict[str, list[tuple[int, JournalCopy]]] = {}
    for copy in held:
        run, number = _run_and_number(copy.name)
        runs.setdefault(run, []).append((number, copy))
    differing = {}
    for place, one_range in enumerate(question.stretches):
        inside = [
            one
            for one in runs.get(one_range.run, ())
            if one_range.first <= one[0] <= one_range.last
        ]
        if (len(inside), digest(copy for _, copy in inside)) != (one_range.count, one_range.digest):
            differing[place] = [(number, copy.bytes, copy.holds) for number, copy in inside]
    return HoldingsAnswer(differing)


def missing_copies(
    asked: Sequence[tuple[JournalRange, Collection[JournalCopy]]], answer: HoldingsAnswer
) -> list[str]:
    """Return the names of expected copies that are not held."""
    found = []
    for place, held in answer.differing.items():
        if place < len(asked):
            there = set(held)
            copies = ((_run_and_number(copy.name)[1], copy) for copy in asked[place][1])
            found += [copy.name for n, copy in copies if (n, copy.bytes, copy.holds) not in there]
    return found


def digest(copies: Iterable[JournalCopy]) -> bytes:
    """Return a digest of copies, independent of their order (16 bytes)."""
    lines = sorted(f"{copy.name} {copy.bytes} {int(copy.holds)}" for copy in copies)
    return hashlib.sha256("\n".join(lines).encode()).digest()[:16]


def _by_run(copies: Iterable[JournalCopy]) -> Mapping[str, dict[int, JournalCopy]]:
    runs: dict[str, dict[int, JournalCopy]] = {}
    for copy in copies:
        run, number = _run_and_number(copy.name)
        if run:
            runs.setdefault(run, {})[number] = copy
    return runs


def _consecutive(
    copies: Sequence[tuple[int, JournalCopy]],
) -> Iterator[list[tuple[int, JournalCopy]]]:
    part: list[tuple[int, JournalCopy]] = []
    for number, copy in copies:
        if part and (number != part[-1][0] + 1 or len(part) == RANGE_FILES):
            yield part
            part = []
        part.append((number, copy))
    if part:
        yield part


def _run_and_number(name: str) -> tuple[str, int]:
    """Return ``folder/run-boot`` and number of a journal file; an empty run for no journal."""
    found = _PARTS_OF_NAME.fullmatch(name)
    return (found[1], int(found[2])) if found else ("", 0)
