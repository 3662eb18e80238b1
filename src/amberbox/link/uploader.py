"""Upload sealed journals in pieces, resumable; confirmed once the server has verified them.

A file is confirmed in the store only after the server has checked its hash, chain and signature. On
each connection the server is asked whether it still holds the confirmed journals. Fetch requests
are stored on disk, so that they survive a restart of the link; their journals are uploaded first.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import ssl
import threading
import time
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

import msgspec
from msgspec import Struct

from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.incident import StoredIncident, load_all
from amberbox.blackbox.store.journal_reader import extent, journal_file
from amberbox.blackbox.store.manifest import Manifest, confirm, unconfirm
from amberbox.blackbox.store.store import (
    FOLDERS,
    INCIDENTS,
    Store,
    finish,
    is_locked,
    pending,
    run_and_number,
)
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.files import replace_file
from amberbox.core.pacing import Backoff, TokenBucket
from amberbox.link import uploads
from amberbox.link.client import FetchAnswer
from amberbox.link.connection import LinkOptions, authorization
from amberbox.link.frames import FetchFrame
from amberbox.link.limits import PIECE_BYTES
from amberbox.link.policy import CopySituation, journals_to_copy, may_copy
from amberbox.link.record_reader import LinkEvents
from amberbox.link.uploads import (
    HoldingsAnswer,
    HoldingsQuestion,
    JournalCopy,
    JournalRange,
    Proof,
    Verdict,
    proof_of,
)

REQUESTS_FILE = "link-requests.json"
# Kind of the store's requests to send a journal again
COPY_KIND = "copy"
_WRITERS = ("main", "bulk", "ring", "watch", "keep", "act", "experiment", "detect")
# Corrected times may differ from those in a journal by smaller steps of the wall clock
_MARGIN_NS = 2 * NS
# Largest number of stored requests; the oldest are dropped, as the server repeats requests
_MOST_REQUESTS = 200


class FetchRequest(Struct, frozen=True):
    """A requested window, by receive time; ``item`` is empty for all."""

    id: str
    item: str
    from_ns: int
    to_ns: int


class FetchRequests:
    """Open fetch requests; ``add`` from any thread, ``step`` from one."""

    def __init__(
        self,
        store: Store,
        answer: Callable[[FetchAnswer], None],
        wall_ns: Callable[[], int],
        is_settled: Callable[[str], bool] = lambda name: False,
        lacks: Callable[[str], bool] = lambda name: False,
        left_out: Callable[[], Collection[str]] = frozenset,
    ) -> None:
        self._store, self._answer = store, answer
        self._wall_ns, self._is_settled, self._lacks = wall_ns, is_settled, lacks
        self._left_out = left_out
        self._lock = threading.Lock()
        self._open: dict[str, FetchRequest] = {
            r.id: r for r in _read_requests(store.path / REQUESTS_FILE)
        }
        self._answered: dict[str, tuple[tuple[str, int], ...]] = {}
        self._requested_again: set[str] = set()
        self.journals: frozenset[str] = frozenset()
        """Journals to copy regardless of the rule for copying."""

    def add(self, frame: FetchFrame) -> None:
        """Add a request; it is answered at the next step."""
        with self._lock:
            self._open[frame.id] = FetchRequest(frame.id, frame.item, frame.from_ns, frame.to_ns)
            for old in list(self._open)[:-_MOST_REQUESTS]:
                del self._open[old]
            self._requested_again.add(frame.id)

    def step(self) -> None:
        """Find the journals of open requests, answer, and close finished requests.

        Raises OSError when the disk refuses the file of open requests.
        """
        with self._lock:
            again, self._requested_again = self._requested_again, set()
            requests = list(self._open.values())
        if again:
            self._write(requests)
        known = manifest.read(self._store.path)
        wanted: set[str] = set()
        for request in requests:
            files = self._find(request, known, is_news=request.id in again)
            wanted |= {name for name, _ in files}
            if self._is_done(request, files, known):
                self._close(request)
        self.journals = frozenset(wanted)

    def _find(
        self, request: FetchRequest, known: Manifest, *, is_news: bool
    ) -> tuple[tuple[str, int], ...]:
        left_out = self._left_out()
        files = tuple(
            file for file in journals_of(self._store, request, known)
            if _folder(file[0]) not in left_out
        )  # fmt: skip
        answered = {name for name, _ in self._answered.get(request.id, ())}
        if is_news or {name for name, _ in files} != answered:
            self._answered[request.id] = files
            self._answer(FetchAnswer(request.id, files))
        return files

    def _is_done(
        self, request: FetchRequest, files: tuple[tuple[str, int], ...], known: Manifest
    ) -> bool:
        """Return whether the window has passed and all of its journals are copied or refused."""
        if request.to_ns + _MARGIN_NS > self._wall_ns() and is_locked(self._store, "main"):
            return False
        return all(
            (name in known.confirmed and not self._lacks(name)) or self._is_settled(name)
            for name, _ in files
        )

    def _close(self, request: FetchRequest) -> None:
        with self._lock:
            if request.id in self._requested_again:
                return
            self._open.pop(request.id, None)
            requests = list(self._open.values())
        self._answered.pop(request.id, None)
        self._write(requests)

    def _write(self, requests: list[FetchRequest]) -> None:
        replace_file(self._store.path / REQUESTS_FILE, msgspec.json.encode(requests).decode())


def journals_of(store: Store, request: FetchRequest, known: Manifest) -> Iterator[tuple[str, int]]:
    """Yield the journals (name and bytes) that may hold rows of a window, open ones included."""
    item = request.item.partition("__")[0]
    for writer in _WRITERS:
        for path in store.journal_files(writer):
            name = f"{path.parent.name}/{path.name}"
            span = _span(path, name, known)
            meets = span is not None and span[0] <= request.to_ns and span[1] >= request.from_ns
            if meets and (not item or item in _items(path, name)):
                yield name, size_of(path)


def _folder(journal: str) -> str:
    return journal.partition("/")[0]


def _span(path: Path, name: str, known: Manifest) -> tuple[int, int] | None:
    """Return the receive times that a journal covers, with a margin; None without rows."""
    sealed = known.sealed.get(name)
    if sealed is not None:
        return sealed.start_ns - _MARGIN_NS, sealed.end_ns + _MARGIN_NS
    found = extent(path)
    if found is None:
        return None
    offset_ns = found.offset_ns
    return found.start_ns + offset_ns - _MARGIN_NS, found.end_ns + offset_ns + _MARGIN_NS


def _items(path: Path, name: str) -> frozenset[str]:
    try:
        return frozenset(journal_file(path, name).items)
    except FileNotFoundError:  # deleted meanwhile
        return frozenset()


def size_of(path: Path) -> int:
    """Return the bytes of a file; 0 where it is gone."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _read_requests(path: Path) -> list[FetchRequest]:
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[FetchRequest])
    except (OSError, msgspec.MsgspecError):
        return []


_TIMEOUT_S = 30.0
_VERIFY_S = 300.0
_READ_BYTES = 1 << 20
_ANSWER_BYTES = 4 << 20
# Tries of one piece before the file is postponed
_TRIES = 5
# A seal is signed within moments, those of a whole disk within minutes; none is expected later
SIGNATURE_S = 900.0
_NAMED = 5
# Least size of a piece, however bad the network is
LEAST_BYTES = 16 << 10


class CopyError(Exception):
    """The copy failed this time; uploaded pieces stay on the server."""


@dataclass(frozen=True, slots=True)
class UploadReply:
    """The server's answer."""

    status: int
    offset: int
    state: str
    body: bytes


class UploadTransport(Protocol):
    """Sends one request about a journal to the server; raises CopyError when it cannot."""

    def __call__(
        self, method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> UploadReply: ...


@dataclass(slots=True)
class HttpTransport:
    """Sends requests over one kept-open connection, replaced after errors."""

    options: LinkOptions
    context: Callable[[], ssl.SSLContext | None]
    most_bytes: int = _ANSWER_BYTES
    """How much of an answer is read."""
    _connection: http.client.HTTPConnection | None = None

    def __call__(
        self, method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> UploadReply:
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
            content = answer.read(self.most_bytes)
            offset = int(answer.headers.get(uploads.OFFSET) or 0)
        except (OSError, http.client.HTTPException, ValueError) as error:
            self.close()
            raise CopyError(f"{type(error).__name__}: {error}") from error
        return UploadReply(answer.status, offset, answer.headers.get(uploads.STATE, ""), content)

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
class JournalCopier:
    """Copies the journals chosen by the rule, one by one; blocks, for a thread of its own."""

    store: Store
    options: LinkOptions
    send: UploadTransport
    situation: Callable[[], CopySituation] = CopySituation
    bucket: TokenBucket = field(default_factory=lambda: TokenBucket(0.0))
    stop: threading.Event = field(default_factory=threading.Event)
    link_events: LinkEvents | None = None
    backlog_bytes: int = 0
    """How much is to be copied, as of the last step."""
    lacking: set[str] = field(default_factory=set)
    """Confirmed journals that the server has since stated to lack."""
    quarantined: set[str] = field(default_factory=set)
    """Journals that the server was sent and does not take."""
    _refused: set[str] = field(default_factory=set)
    _unsigned_since: float | None = None
    _piece_bytes: int = PIECE_BYTES

    def waiting(self) -> list[str]:
        """Return the names of the journals to copy now, in order."""
        found = manifest.read(self.store.path)
        pins = [incident for incident in load_all(self.store) if incident.is_pinned]
        sealed = [s for s in found.sealed.values() if s.journal not in found.raw_gone]
        rule = self.options.copy
        confirmed = found.confirmed - self.lacking
        now = self.situation()
        asked_for = now.requested | self.lacking | (found.unconfirmed - confirmed)
        now = replace(now, requested=asked_for)  # copied again under any rule
        ordered = journals_to_copy(sealed, confirmed, pins, rule, now)
        held = _held_by(self.store, pins) if may_copy(rule, now) else []
        names = [s.journal for s in ordered]
        known = {*names, *confirmed}
        names = [*(name for name in held if name not in known), *names]
        asked = _of_ring(self.store, now.requested - known)
        names = [*asked, *(name for name in names if name not in asked)]
        names = [name for name in names if _folder(name) not in now.left_out]
        awaited = self._awaited(found.unsigned)
        return [name for name in names if name not in self._refused and name not in awaited]

    def _awaited(self, unsigned: Collection[str]) -> Collection[str]:
        """Return the journals whose signature is imminent; unsigned they would be refused."""
        if not unsigned or public_key(self.store.path) is None:
            self._unsigned_since = None
            return ()
        now_s = time.monotonic()
        self._unsigned_since = now_s if self._unsigned_since is None else self._unsigned_since
        return unsigned if now_s - self._unsigned_since < SIGNATURE_S else ()

    def is_settled(self, name: str) -> bool:
        """Return whether this copier will do nothing more about a journal."""
        return name in self._refused

    def copy_again(self, journals: Collection[str], *, is_lost: bool = True) -> None:
        """Mark journals for another copy that the server confirmed or refused.

        ``is_lost``: it lacks them now, which is an event; else somebody wants a better copy.
        """
        again = frozenset(journals)
        self._refused -= again
        lost = again - self.quarantined
        self.quarantined -= again
        if not lost:
            return
        self.lacking |= lost
        host = urlsplit(self.options.url).netloc
        if self.link_events is not None and is_lost:
            self.link_events.clear("server_lacks")  # the same journals may be lost twice
            self.link_events.emit("server_lacks", _lost_text(host, sorted(lost)))
        unconfirm(self.store, sorted(lost), host)

    def take_requests(self) -> None:
        """Mark the journals that another process asks to send again."""
        asked = [one for one in pending(self.store) if one.kind == COPY_KIND]
        if asked:
            self.copy_again({str(one.values.get("journal")) for one in asked}, is_lost=False)
        for request in asked:
            finish(request)

    def step(self) -> bool:
        """Copy the next journal; return whether there was one. Raises CopyError to retry later."""
        names = self.waiting()
        self.backlog_bytes = sum(size_of(self.store.journal_path(name)) for name in names)
        if not names or self.stop.is_set():
            return False
        name = names[0]
        verdict = self.copy(name)
        if verdict is None:
            self._refused.add(name)  # deleted meanwhile
        elif verdict.state == "quarantined":
            self._refused.add(name)
            self.quarantined.add(name)
            if self.link_events is not None:
                self.link_events.emit(
                    "copy_refused", f"the server refuses {name}: {verdict.reason}"
                )
        else:
            host = urlsplit(self.options.url).netloc
            confirm(self.store, [name], host)
            self.lacking.discard(name)
            self._refused.add(name)  # the keeper may take a while to record the confirmation
        return True

    def copy(self, name: str) -> Verdict | None:
        """Send a journal, or its rest; return the server's verdict, None if the file is gone."""
        path = self.store.journal_path(name)
        try:
            about = upload_headers(path)
        except FileNotFoundError:
            return None
        proof = proof_of(self.store.path, name) or Proof()
        address = uploads.address(self.store.id, name)
        for _ in range(_TRIES):
            self._pieces(path, address, about)
            reply = self.send("POST", address, about, msgspec.json.encode(proof))
            if reply.status == 200:
                try:
                    return msgspec.json.decode(reply.body, type=Verdict)
                except msgspec.DecodeError as error:
                    raise CopyError(f"the server's verdict cannot be read: {error}") from error
            if reply.status != 409:
                raise CopyError(f"the server answers {reply.status} {reply.body[:200]!r}")
        raise CopyError("the file does not arrive as it is sent")

    def _pieces(self, path: Path, address: str, about: dict[str, str]) -> None:
        """Send the pieces that the server lacks."""
        reply = self.send("HEAD", address, about, b"")
        at, end, tries = reply.offset, int(about[uploads.BYTES]), 0
        if reply.status != 200:
            raise CopyError(f"the server answers {reply.status}")
        if reply.state not in ("", "incoming"):
            return  # already decided: POST returns the verdict
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

    def _patch(self, address: str, headers: dict[str, str], piece: bytes) -> UploadReply:
        """Send a piece; shrink later pieces after a failure, so that some get through."""
        try:
            reply = self.send("PATCH", address, headers, piece)
        except CopyError:
            self._piece_bytes = max(self._piece_bytes // 4, LEAST_BYTES)
            raise
        self._piece_bytes = min(self._piece_bytes * 2, PIECE_BYTES)
        return reply

    def _next(self, descriptor: int, at: int) -> bytes:
        """Read the next piece, within the rate limit; raises CopyError when the copy is to end."""
        rate = self.bucket.rate
        most = min(self._piece_bytes, max(int(rate / 2), LEAST_BYTES)) if rate else PIECE_BYTES
        piece = os.pread(descriptor, min(self._piece_bytes, most), at)
        if self.stop.wait(self.bucket.take(len(piece), time.monotonic())) or self.stop.is_set():
            raise CopyError("the copy was stopped")
        return piece


def _lost_text(host: str, names: Sequence[str]) -> str:
    """Return a line that names the journals that a server lacks."""
    which = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
    count = "1 journal" if len(names) == 1 else f"{len(names)} journals"
    return f"{host} lacks {count} that it had confirmed: copied again ({which})"


def upload_headers(path: Path) -> dict[str, str]:
    """Return the headers that identify a file: its size and hash."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while part := file.read(_READ_BYTES):
            digest.update(part)
            size += len(part)
    return {uploads.BYTES: str(size), uploads.SHA256: digest.hexdigest()}


def _of_ring(store: Store, names: Collection[str]) -> list[str]:
    """Return which of these are closed journals of the ring, which are not sealed."""
    folder, writing = FOLDERS["ring"], is_locked(store, "main")
    paths = {name: store.journal_path(name) for name in sorted(names) if name.startswith(folder)}
    there = {name: path for name, path in paths.items() if path.exists()}
    return [n for n, path in there.items() if not writing or journal_file(path).finished]


def _held_by(store: Store, pins: Sequence[StoredIncident]) -> list[str]:
    """Return the closed journals of the ring that incidents hold; they are not sealed."""
    names: dict[str, None] = {}
    writing = is_locked(store, "main")  # the recorder's lock is also for its ring
    for incident in pins:
        ring = store.path / INCIDENTS / incident.id / FOLDERS["ring"]
        for path in sorted(ring.glob("*.mcap"), key=run_and_number):
            if incident.state == "complete" and (not writing or journal_file(path).finished):
                names[f"{path.parent.name}/{path.name}"] = None
    return list(names)


# Answers of an older server, which lacks this route
_UNKNOWN = (404, 405)


class HoldingsCheck:
    """Finds journals that the server lacks, and marks them to be copied again.

    ``contact`` numbers the connections, None while there is none. ``step`` is for the copying
    thread; other methods are thread-safe.
    """

    def __init__(self, copier: JournalCopier, contact: Callable[[], int | None]) -> None:
        self._copier = copier
        self._contact = contact
        self._queried: int | None = None

    def look_again(self) -> None:
        """Ask once more, after a fetch request."""
        self._queried = None

    def may_lack(self, name: str) -> bool:
        """Return whether a confirmed journal is, or may be, missing on the server."""
        return self._queried is None or name in self._copier.lacking

    def step(self) -> None:
        """Ask once per connection which journals the server lacks.

        Raises CopyError to retry later, OSError when the disk refuses the result.
        """
        contact = self._contact()
        if contact is None or contact == self._queried:
            return
        self._queried = contact  # set first, since look_again may be called meanwhile
        try:
            for asked in uploads.questions(uploads.journal_ranges(self._counted_on())):
                answer = self._query(asked)
                if answer is None:
                    return
                lacking = uploads.missing_copies(asked, answer)
                if lacking:
                    self._copier.copy_again(lacking)
        except BaseException:
            self._queried = None
            raise

    def _counted_on(self) -> Iterator[JournalCopy]:
        """Yield the robot's journals that the server has confirmed or refused."""
        copier = self._copier
        confirmed = manifest.read(copier.store.path).confirmed - copier.lacking
        for writer in FOLDERS:
            for path in copier.store.journal_files(writer):
                name = f"{path.parent.name}/{path.name}"
                if name in confirmed or name in copier.quarantined:
                    try:
                        yield JournalCopy(name, path.stat().st_size, name in confirmed)
                    except FileNotFoundError:  # deleted meanwhile
                        continue

    def _query(
        self, asked: Sequence[tuple[JournalRange, list[JournalCopy]]]
    ) -> HoldingsAnswer | None:
        """Ask about some ranges; None from a server that lacks this route."""
        copier = self._copier
        question = HoldingsQuestion([one for one, _ in asked])
        headers = {"Content-Type": "application/x-msgpack"}
        address = uploads.holdings_address(copier.store.id)
        reply = copier.send("POST", address, headers, msgspec.msgpack.encode(question))
        if reply.status in _UNKNOWN:
            return None
        if reply.status != 200:
            raise CopyError(f"the server answers {reply.status} {reply.body[:200]!r}")
        try:
            return msgspec.msgpack.decode(reply.body, type=HoldingsAnswer)
        except msgspec.MsgspecError as error:
            raise CopyError(f"what the server holds cannot be read: {error}") from error


POLL_S = 2.0
# Interval of looks whether something was sealed
_LOOK_S = 0.2


@dataclass(slots=True)
class CopyLoop:
    """Copies pending journals; ``before`` is called first each time, for other uploads by HTTP.

    ``may_copy`` returns whether anything may be copied now.
    """

    copier: JournalCopier
    requests: FetchRequests
    before: Callable[[], None]
    may_copy: Callable[[], bool]
    holdings: HoldingsCheck | None = None
    backoff: Backoff = field(default_factory=Backoff)
    trouble: str = ""
    copied: int = 0
    wake: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Work until the copier's ``stop`` is set."""
        stop = self.copier.stop
        while not stop.is_set():
            known = self._manifest_bytes()
            try:
                worked = self.step()
            except (CopyError, AmberboxError, OSError) as error:
                self.trouble = str(error).splitlines()[0]
                stop.wait(self.backoff.failed())
            else:
                self.backoff.succeeded()
                self.trouble = ""
                if not worked:
                    self._wait(known)

    def _wait(self, known_bytes: int) -> None:
        """Wait for the next poll, or until something has been sealed since, or is asked for."""
        end_s = time.monotonic() + POLL_S
        while time.monotonic() < end_s and self._manifest_bytes() == known_bytes:
            if self.wake.wait(_LOOK_S):
                break
        self.wake.clear()

    def _manifest_bytes(self) -> int:
        return size_of(self.copier.store.path / manifest.NAME)

    def step(self) -> bool:
        """Do the next job; return whether there was one. Raises errors that may be temporary."""
        self.requests.step()
        self.copier.take_requests()
        trouble: CopyError | None = None
        try:
            if self.holdings is not None:
                self.holdings.step()
        except CopyError as error:
            trouble = error
        worked = False
        if self.may_copy():
            self.before()
            worked = self.copier.step()
            self.copied += worked
        if trouble is not None:
            raise trouble  # raised after a copy, so that failing questions do not block copies
        return worked
