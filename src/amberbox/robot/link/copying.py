"""Copy sealed journals to the server in pieces, resumable; confirmed once it has verified them.

A file is confirmed in the store only after the server has checked its hash, chain and signature.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import ssl
import threading
import time
import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

import msgspec

from amberbox.blackbox.deletion.confirm import confirm, unconfirm
from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.incidents.incident import Incident, load_all
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store import FOLDERS, INCIDENTS, Store, is_locked, run_and_number
from amberbox.link import uploads
from amberbox.link.bucket import TokenBucket
from amberbox.link.limits import PIECE_BYTES
from amberbox.link.proof import proof_of
from amberbox.link.uploads import Proof, Verdict
from amberbox.robot.link.copyrule import Situation, due, may_copy
from amberbox.robot.link.dialing import authorization
from amberbox.robot.link.options import LinkOptions
from amberbox.robot.link.remarks import Remarks

_TIMEOUT_S = 30.0
_VERIFY_S = 300.0
_READ_BYTES = 1 << 20
_ANSWER_BYTES = 4 << 20
_TRIES = 5
"""How often one piece is begun anew before the file waits for another time."""
SIGNATURE_S = 900.0
"""A seal is signed within moments, those of a whole disk after minutes; then it is not to come."""
_NAMED = 5
LEAST_BYTES = 16 << 10
"""Pieces get no smaller than this, however bad the network is."""


class CopyError(Exception):
    """The copy did not work out this time; what was sent stays on the server."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What the server answered."""

    status: int
    offset: int
    state: str
    body: bytes


class Sending(Protocol):
    """Sends one request about a journal to the server; raises CopyError when it cannot."""

    def __call__(
        self, method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> Reply: ...


@dataclass(slots=True)
class HttpSending:
    """Requests over one connection that is kept open, and made anew after trouble."""

    options: LinkOptions
    context: Callable[[], ssl.SSLContext | None]
    _connection: http.client.HTTPConnection | None = None

    def __call__(
        self, method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> Reply:
        """Send a request and read the whole answer."""
        base = urlsplit(self.options.url).path.rstrip("/")
        length = {"Content-Length": str(len(body))} if method != "HEAD" else {}
        try:
            connection = self._connection = self._connection or self._connect()
            if connection.sock is not None:
                connection.sock.settimeout(_VERIFY_S if method == "POST" else _TIMEOUT_S)
            everything = authorization(self.options) | headers | length
            connection.request(method, base + path, body or None, everything)
            answer = connection.getresponse()
            content = answer.read(_ANSWER_BYTES)
            offset = int(answer.headers.get(uploads.OFFSET) or 0)
        except (OSError, http.client.HTTPException, ValueError) as error:
            self.close()
            raise CopyError(f"{type(error).__name__}: {error}") from error
        return Reply(answer.status, offset, answer.headers.get(uploads.STATE, ""), content)

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _connect(self) -> http.client.HTTPConnection:
        parts = urlsplit(self.options.url)
        host, context = parts.hostname or "", self.context()
        if context is None:
            return http.client.HTTPConnection(host, parts.port or 80, timeout=_TIMEOUT_S)
        return http.client.HTTPSConnection(
            host, parts.port or 443, timeout=_TIMEOUT_S, context=context
        )


@dataclass(slots=True)
class Copier:
    """Copies what the rule names, one journal after another; blocks, for a thread of its own."""

    store: Store
    options: LinkOptions
    send: Sending
    situation: Callable[[], Situation] = Situation
    bucket: TokenBucket = field(default_factory=lambda: TokenBucket(0.0))
    stop: threading.Event = field(default_factory=threading.Event)
    remarks: Remarks | None = None
    backlog_bytes: int = 0
    """How much is to be copied, as of the last step."""
    lacking: set[str] = field(default_factory=set)
    """Journals that were confirmed and that the server lacks, as it said since."""
    quarantined: set[str] = field(default_factory=set)
    """Journals that the server was sent and does not take."""
    _refused: set[str] = field(default_factory=set)
    _unsigned_since: float | None = None
    _piece_bytes: int = PIECE_BYTES

    def waiting(self) -> list[str]:
        """Name the journals that the rule wants copied now, in order."""
        found = manifest.read(self.store.path)
        pins = [incident for incident in load_all(self.store) if incident.is_pinned]
        sealed = [s for s in found.sealed.values() if s.journal not in found.raw_gone]
        rule = self.options.copy
        confirmed = found.confirmed - self.lacking
        now = self.situation()
        asked_for = now.requested | self.lacking | (found.unconfirmed - confirmed)
        now = replace(now, requested=asked_for)  # what a server had it gets under any rule
        ordered = due(sealed, confirmed, pins, rule, now)
        held = _held_by(self.store, pins) if may_copy(rule, now) else []
        names = [s.journal for s in ordered]
        known = {*names, *confirmed}
        names = [*(name for name in held if name not in known), *names]
        asked = _of_ring(self.store, now.requested - known)
        names = [*asked, *(name for name in names if name not in asked)]
        awaited = self._awaited(found.unsigned)
        return [name for name in names if name not in self._refused and name not in awaited]

    def _awaited(self, unsigned: Collection[str]) -> Collection[str]:
        """Return the journals whose signature is about to come: without it they are refused."""
        if not unsigned or public_key(self.store.path) is None:
            self._unsigned_since = None
            return ()
        now_s = time.monotonic()
        self._unsigned_since = now_s if self._unsigned_since is None else self._unsigned_since
        return unsigned if now_s - self._unsigned_since < SIGNATURE_S else ()

    def is_settled(self, name: str) -> bool:
        """Tell whether nothing more will be done about a journal by this copier."""
        return name in self._refused

    def copy_again(self, journals: Collection[str]) -> None:
        """Note that the server lacks journals that it had confirmed, or had refused."""
        again = frozenset(journals)
        self._refused -= again
        lost = again - self.quarantined
        self.quarantined -= again
        if not lost:
            return
        self.lacking |= lost
        host = urlsplit(self.options.url).netloc
        if self.remarks is not None:
            self.remarks.over("server_lacks")  # the same ones may be lost twice
            self.remarks.say("server_lacks", _lost_text(host, sorted(lost)))
        unconfirm(self.store, sorted(lost), host)

    def step(self) -> bool:
        """Copy the next journal; tell whether there was one. Raises CopyError for another time."""
        names = self.waiting()
        self.backlog_bytes = sum(map(self._size, names))
        if not names or self.stop.is_set():
            return False
        name = names[0]
        verdict = self.copy(name)
        if verdict is None:
            self._refused.add(name)  # it is gone meanwhile
        elif verdict.state == "quarantined":
            self._refused.add(name)
            self.quarantined.add(name)
            if self.remarks is not None:
                self.remarks.say("copy_refused", f"the server refuses {name}: {verdict.reason}")
        else:
            self._confirm(name)
        return True

    def _size(self, name: str) -> int:
        try:
            return self.store.journal_path(name).stat().st_size
        except FileNotFoundError:
            return 0

    def copy(self, name: str) -> Verdict | None:
        """Send a journal, or the rest of it; return the server's verdict, None if it is gone."""
        path = self.store.journal_path(name)
        try:
            about = _about(path)
        except FileNotFoundError:
            return None
        proof = proof_of(self.store.path, name) or Proof()
        address = uploads.address(self.store.id, name)
        for _ in range(_TRIES):
            self._pieces(path, address, about)
            reply = self.send("POST", address, about, msgspec.json.encode(proof))
            if reply.status == 200:
                return _verdict(reply)
            if reply.status != 409:
                raise CopyError(f"the server answers {reply.status} {reply.body[:200]!r}")
        raise CopyError("the file does not arrive as it is sent")

    def _pieces(self, path: Path, address: str, about: dict[str, str]) -> None:
        """Send what the server has not got yet."""
        reply = self.send("HEAD", address, about, b"")
        at, end, tries = reply.offset, int(about[uploads.BYTES]), 0
        if reply.status != 200:
            raise CopyError(f"the server answers {reply.status}")
        if reply.state not in ("", "incoming"):
            return  # its fate is known: the end of it is asked for
        with path.open("rb") as file:
            while at < end:
                piece = self._next(file.fileno(), at)
                headers = {**about, uploads.OFFSET: str(at), uploads.CRC: str(zlib.crc32(piece))}
                reply = self._patch(address, headers, piece)
                if reply.status not in (200, 204, 409):
                    raise CopyError(f"the server answers {reply.status} {reply.body[:200]!r}")
                tries = tries + 1 if reply.offset <= at else 0
                if tries >= _TRIES:
                    raise CopyError("pieces do not arrive as they are sent")
                at = reply.offset

    def _patch(self, address: str, headers: dict[str, str], piece: bytes) -> Reply:
        """Send a piece; after trouble the next ones are smaller, so that some get through."""
        try:
            reply = self.send("PATCH", address, headers, piece)
        except CopyError:
            self._piece_bytes = max(self._piece_bytes // 4, LEAST_BYTES)
            raise
        self._piece_bytes = min(self._piece_bytes * 2, PIECE_BYTES)
        return reply

    def _next(self, descriptor: int, at: int) -> bytes:
        """Read a piece when it is its turn; raises CopyError when the copy is to end."""
        rate = self.bucket.rate
        most = min(self._piece_bytes, max(int(rate / 2), LEAST_BYTES)) if rate else PIECE_BYTES
        piece = os.pread(descriptor, min(self._piece_bytes, most), at)
        if self.stop.wait(self.bucket.take(len(piece), time.monotonic())) or self.stop.is_set():
            raise CopyError("the copy was stopped")
        return piece

    def _confirm(self, name: str) -> None:
        """Note that the server holds a journal: it is the first to go when room is needed."""
        host = urlsplit(self.options.url).netloc
        confirm(self.store, [name], host)
        self.lacking.discard(name)
        self._refused.add(name)  # the keeper may take a while to write it down


def _lost_text(host: str, names: Sequence[str]) -> str:
    """Say in a line which journals a server lacks."""
    which = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
    count = "1 journal" if len(names) == 1 else f"{len(names)} journals"
    return f"{host} lacks {count} that it had confirmed: copied again ({which})"


def _verdict(reply: Reply) -> Verdict:
    try:
        return msgspec.json.decode(reply.body, type=Verdict)
    except msgspec.DecodeError as error:
        raise CopyError(f"the server's verdict cannot be read: {error}") from error


def _about(path: Path) -> dict[str, str]:
    """Return what tells a file from every other: its size and hash."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while part := file.read(_READ_BYTES):
            digest.update(part)
            size += len(part)
    return {uploads.BYTES: str(size), uploads.SHA256: digest.hexdigest()}


def _of_ring(store: Store, names: Collection[str]) -> list[str]:
    """Return which of these are journals of the ring that nobody writes; they are not sealed."""
    folder, writing = FOLDERS["ring"], is_locked(store, "main")
    paths = {name: store.journal_path(name) for name in sorted(names) if name.startswith(folder)}
    there = {name: path for name, path in paths.items() if path.exists()}
    return [n for n, path in there.items() if not writing or journal_file(path).finished]


def _held_by(store: Store, pins: Sequence[Incident]) -> list[str]:
    """Name the journals of the ring that incidents hold and nobody writes; they are not sealed."""
    names: dict[str, None] = {}
    writing = is_locked(store, "main")  # the recorder's lock is for its ring, too
    for incident in pins:
        ring = store.path / INCIDENTS / incident.id / FOLDERS["ring"]
        for path in sorted(ring.glob("*.mcap"), key=run_and_number):
            if incident.state == "complete" and (not writing or journal_file(path).finished):
                names[f"{path.parent.name}/{path.name}"] = None
    return list(names)
