"""Signatures: the robot's word for its manifest, and for how far each of its journals reaches."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.journal.head import read_head
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import Sealed, Signature, to_record
from amberbox.blackbox.segments.lines import first_hash
from amberbox.blackbox.signing.keys import SigningKey, holds
from amberbox.blackbox.store import Store, is_locked, run_and_number
from amberbox.blackbox.verify.links import Link, links
from amberbox.core.files import replace_file

HEADS = "heads.json"
STATED = ("main", "bulk", "keep", "kept", "watch")
"""Writers whose journals are vouched for; those of the ring go by themselves."""
LOCKS = {"keep": "keeper", "kept": "keeper"}
"""Lock that is held while a writer is at work, where it has another name."""
_LINE_BYTES = 1024
"""More than a line with a signature has."""


@dataclass(frozen=True, slots=True)
class Reach:
    """How far a writer's journal reaches: the last link of its chain, and where it stands.

    ``bytes`` is the end of what the link speaks for, ``next_seq`` the position after it.
    """

    run: int
    file: str
    chain: str
    next_seq: int
    bytes: int


@dataclass(frozen=True, slots=True)
class SignedHeads:
    """The robot's statement of how far everything reaches; without a key it is not signed.

    ``manifest`` is the hash of the last line, ``since`` that of the first: it is another one once
    the manifest has been condensed.
    """

    store_id: str
    at_ns: int
    manifest: str
    writers: Mapping[str, Reach] = field(default_factory=dict)
    key: str = ""
    signature: str = ""
    since: str = ""

    def message(self) -> bytes:
        """Return the bytes that are signed: all but the signature, in one way of writing."""
        values = msgspec.to_builtins(self)
        del values["signature"]
        text = json.dumps(values, sort_keys=True, separators=(",", ":"))
        return b"amberbox heads 1\n" + text.encode()

    def holds(self) -> bool:
        """Tell whether the signature is that of its key."""
        return holds(self.key, self.signature, self.message())

    def to_json(self) -> str:
        """Write the statement as a document for people and servers."""
        return json.dumps(msgspec.to_builtins(self), indent=1) + "\n"


def parse_heads(content: str | bytes) -> SignedHeads:
    """Read a statement; raises ValueError when it is none."""
    try:
        return msgspec.json.decode(content, type=SignedHeads)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error


def load_heads(store: Path) -> SignedHeads | None:
    """Read the newest statement of a store; None without one that can be read."""
    try:
        return parse_heads((store / HEADS).read_bytes())
    except (OSError, ValueError):
        return None


def signature_message(store_id: str, head: str, at_ns: int) -> bytes:
    """Compose what is signed for a line of the manifest."""
    return f"amberbox manifest 1\n{store_id}\n{head}\n{at_ns}\n".encode()


def signature_of(store: Store, key: SigningKey, head: str, at_ns: int) -> Signature:
    """Sign everything in the manifest up to the line with hash ``head``."""
    signed = key.sign(signature_message(store.id, head, at_ns))
    return Signature(head, at_ns, key.public, signed)


def signature_record(store: Store, key: SigningKey | None, head: str) -> dict[str, Any] | None:
    """Compose the line that signs a head; None without a key."""
    if key is None:
        return None
    return to_record(signature_of(store, key, head, time.time_ns()))


def sign_manifest(
    store: Store, key: SigningKey | None, now_ns: int | None = None, *, again: bool = False
) -> bool:
    """Sign what was appended since the last signature; tell whether there was anything.

    With ``again`` what is signed already is signed once more, as by a new key.
    """
    with mf.CHANGING:
        last = _last_line(store.path / mf.NAME)
        if key is None or not last or (b',"kind":"signed",' in last and not again):
            return False
        at_ns = time.time_ns() if now_ns is None else now_ns
        signature = signature_of(store, key, mf.read(store.path).last_hash, at_ns)
        mf.append(store.path, [to_record(signature)])
        return True


def _last_line(path: Path) -> bytes:
    """Return the end of the manifest's last line; empty when there is none."""
    try:
        with path.open("rb") as file:
            file.seek(-min(file.seek(0, os.SEEK_END), _LINE_BYTES), os.SEEK_END)
            return file.read().rstrip(b"\n").rpartition(b"\n")[2]
    except FileNotFoundError:
        return b""


def write_heads(store: Store, key: SigningKey | None, now_ns: int | None = None) -> SignedHeads:
    """Say how far everything reaches, durably and signed, in place of what was said before.

    Raises OSError when the disk does not take it.
    """
    heads = signed_heads(store, key, now_ns)
    replace_file(store.path / HEADS, heads.to_json())
    return heads


def signed_heads(store: Store, key: SigningKey | None, now_ns: int | None = None) -> SignedHeads:
    """Compose the statement of how far everything reaches; only what is durable counts."""
    with mf.CHANGING:  # it is not condensed in between
        since, known = first_hash(store.path / mf.NAME), mf.read(store.path)
    found = {writer: reach_of(store, writer, known.sealed) for writer in STATED}
    heads = SignedHeads(
        store.id,
        time.time_ns() if now_ns is None else now_ns,
        known.last_hash,
        {writer: reach for writer, reach in found.items() if reach is not None},
        "" if key is None else key.public,
        since=since,
    )
    return heads if key is None else replace(heads, signature=key.sign(heads.message()))


def reach_of(store: Store, writer: str, sealed: Mapping[str, Sealed]) -> Reach | None:
    """Find the newest link of a writer's journal that a power cut cannot take back."""
    last = _last_sealed(writer, sealed)
    for path in reversed(store.journal_files(writer)):
        name = f"{path.parent.name}/{path.name}"
        if name in sealed:
            break
        link = _durable_link(store, writer, path)
        if link is not None:
            return Reach(run_and_number(path)[0], name, link.chain, link.next_seq, link.to)
    if last is None:
        return None
    return Reach(last.run, last.journal, last.chain, last.end_seq, last.tail_from)


def _last_sealed(writer: str, sealed: Mapping[str, Sealed]) -> Sealed | None:
    """Return the newest sealed file that has a link of its own."""
    found = [s for s in sealed.values() if s.writer == writer and s.tail_from]
    return max(found, key=lambda s: (s.run, s.number), default=None)


def _durable_link(store: Store, writer: str, path: Path) -> Link | None:
    """Return the last link that was synced, or None where nobody knows yet."""
    head = read_head(path.parent)
    if head is None or head.run != run_and_number(path)[0]:
        return None
    if not is_locked(store, LOCKS.get(writer, writer)):
        return None  # an end that nobody writes any more is synced when it is sealed
    try:
        with open_buffer(path) as data:
            found = links(data)
    except FileNotFoundError:
        return None
    synced = [link for link in found if link.next_seq <= head.durable_seq]
    return next((link for link in synced if link.next_seq == synced[-1].next_seq), None)
