"""Check a store against heads: hashes noted earlier, or the robot's signed statement."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import Sealed
from amberbox.blackbox.signing.keys import can_sign
from amberbox.blackbox.signing.signing import HEADS, STATED, Reach, SignedHeads, parse_heads
from amberbox.blackbox.verify.continuity import Graves, place_of
from amberbox.blackbox.verify.findings import Finding
from amberbox.blackbox.verify.journal import Checked
from amberbox.blackbox.verify.manifest import CheckedManifest
from amberbox.blackbox.verify.mended import without_one_bit
from amberbox.core.errors import AmberboxError, UsageError

SHORTEST = 16
_HINT = "give 16 to 64 hex digits of a head that verify printed, or a copy of heads.json"
_MOST_BYTES = 3_000


@dataclass(frozen=True, slots=True)
class Noted:
    """What somebody gave with ``--head``: (the beginning of) a hash, or a whole statement."""

    given: str
    hash: str = ""
    heads: SignedHeads | None = None


def read_noted(text: str) -> Noted:
    """Read what was noted; raises UsageError when it is no head."""
    plain = text.strip().lower()
    if SHORTEST <= len(plain) <= 64 and set(plain) <= set("0123456789abcdef"):
        return Noted(text, hash=plain)
    try:
        content = text if plain.startswith("{") else Path(text).read_text()
        return Noted("--head" if plain.startswith("{") else text, heads=parse_heads(content))
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsageError(f"no head in {text}: {why}", _HINT) from None


@dataclass(frozen=True)
class Known:
    """What of a store a head can be looked up in."""

    store_id: str
    manifest: CheckedManifest
    files: Mapping[str, Checked]
    sealed: Mapping[str, Sealed]
    graves: Graves

    def where(self, digits: str) -> str:
        """Say where a hash that begins like this stands; empty where it does not."""
        for hash_, number in self.manifest.hashes.items():
            if hash_.startswith(digits):
                return f"line {number} of the manifest"
        if self.manifest.checkpoint.startswith(digits):
            return "the manifest as it was before it was condensed"
        for name, checked in self.files.items():
            if any(link.chain.startswith(digits) for link in checked.noted):
                return name
        for entry in self.sealed.values():
            if entry.chain.startswith(digits):
                return f"{entry.journal}, as it was sealed"
        gone = any(
            chain.startswith(digits) for writer in STATED for chain in self.graves.chains(writer)
        )
        return "a journal that was deleted on purpose since" if gone else ""


def check_noted(noted: Noted, known: Known, key: str) -> tuple[list[Finding], str]:
    """Look a noted head up; return what is missing, and what can be said of it.

    Raises AmberboxError when it is a statement whose signature does not hold.
    """
    if noted.heads is not None:
        refuse_forged(noted.heads, known.store_id, key)
        found = list(check_heads(noted.heads, known, noted.given))
        return found, "" if found else "the head holds: everything up to it is as it was"
    where = known.where(noted.hash)
    if where:
        return [], f"head {noted.hash[:SHORTEST]} stands in {where}: all before it is as it was"
    text = f"the head {noted.hash[:SHORTEST]} is nowhere in this store: its newest part was cut"
    text += " off or altered after the head was noted"
    return [Finding("missing", noted.given, text)], ""


def refuse_forged(heads: SignedHeads, store_id: str, key: str) -> None:
    """Raise AmberboxError when a statement is not this robot's word."""
    hint = "take the copy that was made from heads.json at the last contact"
    if heads.store_id != store_id:
        raise AmberboxError(f"the head is that of another store ({heads.store_id})", hint)
    if key and not heads.signature:
        raise AmberboxError("the head is not signed", hint)
    if heads.signature and can_sign() and not heads.holds():
        raise AmberboxError("the signature of the head does not hold", hint)
    if key and heads.key != key:
        raise AmberboxError(f"the head is signed with another key ({heads.key})", hint)


def check_heads(heads: SignedHeads, known: Known, file: str) -> Iterator[Finding]:
    """Compare a statement with what is there: name what is missing of each journal."""
    lines = known.manifest
    stands = heads.manifest in lines.hashes or heads.manifest == lines.checkpoint
    condensed = lines.checkpoint and heads.since != lines.first_hash  # after it was stated
    if not stands and heads.manifest != "0" * 64 and not condensed:
        text = f"the line that {file} names is gone: the newest lines were cut off or changed"
        yield Finding("missing", mf.NAME, text, to_ns=heads.at_ns)
    for writer, reach in heads.writers.items():
        yield from _check_reach(writer, reach, known, heads.at_ns)


def _check_reach(writer: str, reach: Reach, known: Known, at_ns: int) -> Iterator[Finding]:
    checked = known.files.get(reach.file)
    if checked is None:
        graves = known.graves.holds(writer, place_of(reach.file))
        if not graves and reach.file not in known.sealed:  # else its seal has named it
            text = f"is gone: run {reach.run} of {writer} reached position {reach.next_seq}"
            yield Finding("missing", reach.file, text, None, 0, reach.bytes, to_ns=at_ns)
    elif not any(link.chain == reach.chain for link in checked.noted):
        yield from _not_reached(writer, reach, checked, at_ns)


def _not_reached(writer: str, reach: Reach, checked: Checked, at_ns: int) -> Iterator[Finding]:
    """Name what is missing of a file that does not reach as far as was stated."""
    if any(f.state in ("altered", "damaged", "missing") for f in checked.findings):
        return  # what was found explains it
    name, last = checked.target.name, checked.last
    if checked.tail_from >= reach.bytes:
        text = "the file is sound in itself, but not the one that was stated: it was written anew"
        yield Finding("altered", name, text, None, 0, reach.bytes, to_ns=at_ns)
        return
    first = last.next_seq if last is not None else 0
    text = f"ends too early: positions {first} to {reach.next_seq} of run {reach.run} of"
    text += f" {writer} are gone"
    from_ns = checked.places.end_ns(checked.tail_from)
    yield Finding("missing", name, text, None, checked.tail_from, reach.bytes, from_ns, at_ns)


@dataclass(frozen=True, slots=True)
class OwnHeads:
    """The statement that lies in a store: its bytes, and what they say if they can be read."""

    content: bytes | None = None
    heads: SignedHeads | None = None


def read_own(store: Path) -> OwnHeads:
    """Read the statement before anything else: all that is read later reaches further."""
    try:
        content = (store / HEADS).read_bytes()
    except OSError:
        return OwnHeads()
    try:
        return OwnHeads(content, parse_heads(content))
    except ValueError:
        return OwnHeads(content)


def check_own_heads(
    own: OwnHeads, known: Known, key: str
) -> tuple[list[Finding], SignedHeads | None]:
    """Check the statement that lies in the store; None where there is none to go by."""
    heads = own.heads
    if own.content is None:
        text = "there is none: nobody states how far the journals reach"
        return list(_unstated(known, text)), None
    if heads is None:
        return [_bad_heads(own.content, "cannot be read")], None
    if not heads.signature and not _is_plain(own.content):
        return [_bad_heads(own.content, "is not as it was written")], None
    if heads.signature and key and (heads.key != key or not heads.holds()):
        return [_bad_heads(own.content, "is not signed with the robot's key")], None
    if heads.store_id != known.store_id:
        return [Finding("altered", HEADS, f"is that of another store ({heads.store_id})")], None
    unsigned = _unstated(known, "is not signed") if not heads.signature else ()
    return [*unsigned, *check_heads(heads, known, HEADS)], heads


def _is_plain(content: bytes) -> bool:
    """Tell whether a statement has no other keys than those that are written."""
    known = {field.name for field in fields(SignedHeads)}
    return set(json.loads(content)) <= known


def _unstated(known: Known, text: str) -> Iterator[Finding]:
    """Say that a statement is missing in a store that has signatures."""
    if known.manifest.signatures:
        yield Finding("unsigned", HEADS, text)


def _bad_heads(content: bytes, text: str) -> Finding:
    may_mend = len(content) <= _MOST_BYTES and not _is_signed(content)
    if may_mend and without_one_bit(content, _is_signed) is not None:
        return Finding("damaged", HEADS, "one bit is flipped")
    return Finding("altered", HEADS, text)


def _is_signed(content: bytes) -> bool:
    try:
        heads = parse_heads(content)
    except ValueError:
        return False
    return can_sign() and bool(heads.signature) and heads.holds()


def links_of(noted: Sequence[Noted], own: OwnHeads) -> tuple[str, ...]:
    """Return the links that the journals are to be searched for."""
    statements = [heads for heads in (own.heads, *(n.heads for n in noted)) if heads is not None]
    wanted = {entry.hash for entry in noted if entry.hash}
    wanted |= {reach.chain for heads in statements for reach in heads.writers.values()}
    return tuple(sorted(wanted))
