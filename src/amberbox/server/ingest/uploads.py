"""The upload service: journals arrive in resumable pieces, each made durable, then verified."""

from __future__ import annotations

import os
import threading
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Row, Select, and_, delete, select

from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.files import sync_folder
from amberbox.link.limits import PIECE_BYTES
from amberbox.link.uploads import (
    JOURNAL_BYTES,
    JournalCopy,
    Proof,
    State,
    Verdict,
    is_digest,
    is_journal_name,
    is_store_id,
    signing_key,
)
from amberbox.server import record_orders
from amberbox.server.database import ServerDatabase, upsert_rows
from amberbox.server.ingest.link_state import is_other_history, key_state, log_event, waiting_reason
from amberbox.server.ingest.verification import UploadClaim, VerificationResult, Verifier
from amberbox.server.journals import sha256_of
from amberbox.server.record_orders import RecordOrder
from amberbox.server.schema import JOURNALS, UPLOAD


class PieceError(ValueError):
    """A piece that cannot be accepted; ``offset`` is where the next one has to begin."""

    def __init__(self, text: str, offset: int) -> None:
        super().__init__(text)
        self.offset = offset


@dataclass(frozen=True, slots=True)
class IncomingJournal:
    """A journal being uploaded, identified by its content, since names may recur."""

    robot: str
    store_id: str
    journal: str
    sha256: str
    size: int

    def problem(self) -> str:
        """Return the problem with its names or size; empty if there is none."""
        if not is_store_id(self.store_id):
            return "no store has this id"
        if not is_journal_name(self.journal):
            return "no journal has this name"
        return "" if is_digest(self.sha256) and self.size > 0 else "without size or SHA-256"

    @property
    def part(self) -> Path:
        """The path of its partial file, below the server's folder."""
        folder, _, file = self.journal.partition("/")
        name = f"{folder}-{file}-{self.sha256[:16]}.part"
        return Path("incoming", self.robot, self.store_id, name)


def part_files(root: Path, robot: str) -> list[Path]:
    """Return the partial files of a robot."""
    return list((root / "incoming" / robot).glob("*/*.part"))


def received_bytes(root: Path, incoming: IncomingJournal) -> int:
    """Return how many bytes of it have been received."""
    try:
        return min((root / incoming.part).stat().st_size, incoming.size)
    except FileNotFoundError:
        return 0


def append_piece(root: Path, incoming: IncomingJournal, offset: int, piece: bytes, crc: int) -> int:
    """Append a piece; return the offset of the next one.

    Raises PieceError when it does not begin where the last one ended, is damaged or too long;
    OSError when the disk refuses it.
    """
    at = received_bytes(root, incoming)
    if offset != at:
        raise PieceError(f"the next piece begins at {at}", at)
    if zlib.crc32(piece) != crc:
        raise PieceError("the piece was damaged on its way", at)
    if at + len(piece) > incoming.size:
        raise PieceError("the piece goes beyond the end", at)
    path = root / incoming.part
    is_new = not path.exists()
    if is_new:
        path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o640)
    try:
        _write(descriptor, piece, at)
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)
    if is_new:
        sync_folder(path.parent)
    return at + len(piece)


def _write(descriptor: int, piece: bytes, at: int) -> None:
    """Write a whole piece; on an error restore the length of the file."""
    view, to = memoryview(piece), at
    try:
        while view:
            count = os.pwrite(descriptor, view, to)
            view, to = view[count:], to + count
    except OSError:
        os.ftruncate(descriptor, at)
        raise


def discard_pieces(root: Path, incoming: IncomingJournal) -> None:
    """Delete the pieces, so that the upload starts again."""
    (root / incoming.part).unlink(missing_ok=True)


def held_journals(
    database: ServerDatabase, root: Path, robot: str, store_id: str
) -> Iterator[JournalCopy]:
    """Yield the journals of a store whose file exists, or was deleted on purpose. Blocks.

    Files that the database names and the disk lacks are left out: the disk may have been restored
    from an older backup than the database.
    """
    u = UPLOAD.c
    mine = and_(u.robot == robot, u.store_id == store_id, u.state != "incoming")
    with database.reading() as connection:
        rows = connection.execute(known_uploads().where(mine)).all()
    sizes: dict[str, dict[str, int]] = {}
    for row in rows:
        folder, _, name = row.path.rpartition("/")
        if folder not in sizes:
            sizes[folder] = _sizes(root / folder)
        if row.raw_gone or sizes[folder].get(name) == row.bytes:
            yield JournalCopy(row.journal, row.bytes, row.state != "quarantined")


def known_uploads() -> Select[Any]:
    """Select uploads with ``raw_gone``: whether the archive has deleted the file on purpose."""
    u, j = UPLOAD.c, JOURNALS.c
    same = and_(j.robot == u.robot, j.store_id == u.store_id, j.file == u.journal,
                j.sha256 == u.sha256)  # fmt: skip
    return select(UPLOAD, j.raw_gone).select_from(UPLOAD.outerjoin(JOURNALS, same))


def is_held(root: Path, row: Row[Any]) -> bool:
    """Return whether the file of one of ``known_uploads`` exists, or was deleted on purpose."""
    if row.raw_gone or row.state == "incoming":
        return True
    try:
        return (root / str(row.path)).stat().st_size == int(row.bytes)
    except FileNotFoundError:
        return False


def copies_of(
    connection: Connection, robot: str, store_id: str, journal: str
) -> Sequence[Row[Any]]:
    """Return the ``known_uploads`` of a journal, by whichever content."""
    u = UPLOAD.c
    same = and_(u.robot == robot, u.store_id == store_id, u.journal == journal)
    return connection.execute(known_uploads().where(same, u.state != "incoming")).all()


def is_sound(root: Path, row: Row[Any]) -> bool:
    """Return whether the file of one of ``known_uploads`` has the content that was verified."""
    try:
        return sha256_of(root / str(row.path)) == str(row.sha256)
    except OSError:
        return False


def copy_matter(store_id: str, journal: str) -> str:
    """Return the matter of the order to send a journal again (``record_orders``)."""
    return f"journal:{store_id}/{journal}"


def _wanted_again(connection: Connection, incoming: IncomingJournal) -> RecordOrder | None:
    """Return the order to send a journal again that its robot may still follow; None without."""
    about = copy_matter(incoming.store_id, incoming.journal)
    order = record_orders.find(connection, incoming.robot, about)
    return order if order is not None and order.is_under_way else None


def _sizes(folder: Path) -> dict[str, int]:
    try:
        with os.scandir(folder) as entries:
            return {entry.name: entry.stat().st_size for entry in entries}
    except FileNotFoundError:
        return {}


_TOO_MUCH = "too much of this robot waits here already"
_KEPT_S = 7 * 86_400.0
_KEYS = ("robot", "store_id", "journal", "sha256")
# What a copy changes that replaces a damaged one, or one that was not taken
_CHANGED = ("state", "reason", "path", "signed", "ended_ns")


@dataclass(frozen=True, slots=True)
class UploadAnswer:
    """An HTTP status, how many bytes are held, the state of the file, and the reason."""

    status: int
    offset: int = 0
    state: State = "incoming"
    text: str = ""


# Returns the public key (hex) of a robot's store; empty where it has none
PublicKey = Callable[[str, str], str]
OnVerified = Callable[[IncomingJournal, VerificationResult, Path], None]


@dataclass(slots=True)
class UploadService:
    """Receives journals into the folder ``root`` of the server.

    ``quota`` limits the unverified bytes per robot. ``verified`` is called for each new journal.
    """

    root: Path
    database: ServerDatabase
    public_key: PublicKey
    clock: Clock = field(default_factory=SystemClock)
    quota: int = JOURNAL_BYTES
    verified: OnVerified = lambda incoming, result, path: None
    verifier: Verifier = field(default_factory=Verifier)
    _busy: dict[Path, threading.Lock] = field(default_factory=dict)
    _guard: threading.Lock = field(default_factory=threading.Lock)

    def head(self, incoming: IncomingJournal) -> UploadAnswer:
        """Return how much of a file is held, and its state."""
        found = self._refused(incoming) or self._known(incoming)
        if found is not None:
            return found
        at = received_bytes(self.root, incoming)
        if not at and self._waiting_bytes(incoming.robot) + incoming.size > self.quota:
            self._drop_old(incoming.robot)
            if self._waiting_bytes(incoming.robot) + incoming.size > self.quota:
                return UploadAnswer(507, text=_TOO_MUCH)
        return UploadAnswer(200, at)

    def patch(self, incoming: IncomingJournal, offset: int, piece: bytes, crc: int) -> UploadAnswer:
        """Append a piece of a file."""
        known = self._refused(incoming) or self._known(incoming)
        if known is not None:
            return known
        if len(piece) > PIECE_BYTES:
            return UploadAnswer(413, text=f"a piece has at most {PIECE_BYTES} bytes")
        if self._waiting_bytes(incoming.robot) + len(piece) > self.quota:
            return UploadAnswer(507, text=_TOO_MUCH)
        with self._lock(incoming):
            try:
                return UploadAnswer(204, append_piece(self.root, incoming, offset, piece, crc))
            except PieceError as error:
                return UploadAnswer(409, error.offset, text=str(error))
            except OSError as error:
                return UploadAnswer(507, text=f"the server cannot keep it: {error.strerror}")

    def post(self, incoming: IncomingJournal, proof: Proof | None) -> UploadAnswer:
        """Verify a complete file, and make it part of the record, set it aside or quarantine it."""
        known = self._refused(incoming) or self._known(incoming)
        if known is not None:
            return known
        with self._lock(incoming):
            return self._known(incoming) or self._finish(incoming, proof)

    def close(self) -> None:
        """End the verification's worker."""
        self.verifier.close()

    def _refused(self, incoming: IncomingJournal) -> UploadAnswer | None:
        wrong = incoming.problem()
        if wrong:
            return UploadAnswer(400, text=wrong)
        if incoming.size > JOURNAL_BYTES:
            return UploadAnswer(413, text=f"a journal has at most {JOURNAL_BYTES} bytes")
        return None

    def _known(self, incoming: IncomingJournal) -> UploadAnswer | None:
        """Return the answer for a file whose state is final; None if it is unknown or lost."""
        same = and_(
            UPLOAD.c.robot == incoming.robot, UPLOAD.c.store_id == incoming.store_id,
            UPLOAD.c.journal == incoming.journal, UPLOAD.c.sha256 == incoming.sha256,
        )  # fmt: skip
        with self.database.reading() as connection:
            row = connection.execute(known_uploads().where(same)).first()
            again = row is not None and _wanted_again(connection, incoming) is not None
        if row is None or not is_held(self.root, row):
            return None
        if again and not (row.state == "verified" and is_sound(self.root, row)):
            return None  # the copy that is held is damaged, or was not taken
        return UploadAnswer(200, incoming.size, row.state, row.reason)

    def _waiting_bytes(self, robot: str) -> int:
        return sum(path.stat().st_size for path in part_files(self.root, robot))

    def _drop_old(self, robot: str) -> None:
        """Delete partial files that have not grown for long: the robot may lack them by now."""
        oldest_s = self.clock.wall_ns() / NS - _KEPT_S
        for path in part_files(self.root, robot):
            if path.stat().st_mtime < oldest_s:
                path.unlink(missing_ok=True)

    def _lock(self, incoming: IncomingJournal) -> threading.Lock:
        """Return the lock of a file, so that one request at a time works on it."""
        with self._guard:
            if len(self._busy) > 1000:
                self._busy = {path: lock for path, lock in self._busy.items() if lock.locked()}
            return self._busy.setdefault(incoming.part, threading.Lock())

    def _finish(self, incoming: IncomingJournal, proof: Proof | None) -> UploadAnswer:
        at = received_bytes(self.root, incoming)
        if at != incoming.size:
            return UploadAnswer(409, at, text=f"{incoming.size - at} bytes are missing")
        signed_by = "" if proof is None else signing_key(proof)
        with self.database.reading() as connection:
            new = key_state(connection, incoming.robot, signed_by) if signed_by else None
        is_trusted = new in ("pending", "confirmed")
        key = signed_by if is_trusted else self.public_key(incoming.robot, incoming.store_id)
        if not key and new is None and proof is not None and ',"kind":"signed",' in proof.lines:
            return UploadAnswer(503, at, text="the robot has to say first with which key it signs")
        path = self.root / incoming.part
        result = self.verifier.check(
            UploadClaim(path, incoming.robot, incoming.store_id, incoming.journal, incoming.sha256,
                  proof, key)
        )  # fmt: skip
        if result is None:
            result = VerificationResult("to read it takes more memory than it may")
        if result.unread:
            discard_pieces(self.root, incoming)
            return UploadAnswer(409, 0, text=result.reason)
        sealed = proof is not None and bool(proof.lines)
        if not result.reason and sealed and not result.signed:
            reason = "it is not signed, and this server takes signed journals only"
            result = replace(result, reason=reason)
        if new == "refused":
            result = replace(result, reason="it is signed with a key that an admin refused")
        if new == "pending" and not result.reason:
            return self._place(incoming, replace(result, reason=waiting_reason(key)), waits=True)
        return self._place(incoming, result)

    def _place(
        self, incoming: IncomingJournal, result: VerificationResult, *, waits: bool = False
    ) -> UploadAnswer:
        """Move a file to its place, store its state, and publish it; ``waits``: set aside for its
        key.
        """
        with self.database.reading() as connection:
            state = "aside" if waits else _state(connection, incoming, result)
        path = _home(incoming, state)
        target = self.root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        (self.root / incoming.part).chmod(0o440)  # verified files are not written any more
        (self.root / incoming.part).replace(target)
        sync_folder(target.parent)
        now_ns = self.clock.wall_ns()
        with self.database.begin() as connection:
            row = {
                "robot": incoming.robot, "store_id": incoming.store_id,
                "journal": incoming.journal, "sha256": incoming.sha256, "bytes": incoming.size,
                "state": state, "reason": result.reason, "path": str(path),
                "signed": result.signed, "writer": result.writer, "run": result.run,
                "number": result.number, "first_seq": result.first_seq,
                "end_seq": result.end_seq, "start_ns": result.start_ns, "end_ns": result.end_ns,
                "began_ns": now_ns, "ended_ns": now_ns,
            }  # fmt: skip
            order = _wanted_again(connection, incoming)
            upsert_rows(connection, UPLOAD, [row], () if order is None else _CHANGED)
            if order is not None:
                record_orders.see(connection, incoming.robot, order.about, order.command)
                self._drop_quarantined(connection, incoming, state)
            if state != "verified":
                log_event(
                    connection, incoming.robot, now_ns, state, _event_text(incoming, state, result)
                )
        if state != "quarantined":
            self.verified(incoming, result, target)
        return UploadAnswer(200, incoming.size, state, result.reason)

    def _drop_quarantined(
        self, connection: Connection, incoming: IncomingJournal, state: State
    ) -> None:
        """Drop what was quarantined of a journal, once a sound copy has come."""
        if state != "verified":
            return
        for row in copies_of(connection, incoming.robot, incoming.store_id, incoming.journal):
            if row.state == "quarantined":
                (self.root / row.path).unlink(missing_ok=True)
                keys = [getattr(UPLOAD.c, key) == getattr(row, key) for key in _KEYS]
                connection.execute(delete(UPLOAD).where(*keys))


def verdict(answer: UploadAnswer) -> Verdict:
    """Return the verdict for the robot on a file."""
    return Verdict(answer.state, answer.text)


def _state(connection: Connection, incoming: IncomingJournal, result: VerificationResult) -> State:
    """Return the state of a verified file: a name in a store has one content in its record.

    A file with other content, or with rows at positions that are already held, comes from a disk on
    which an old image was restored: two histories of one store.
    """
    if result.reason:
        return "quarantined"
    keys = incoming.robot, incoming.store_id, incoming.journal, incoming.sha256
    held = result.writer, result.run, result.first_seq, result.end_seq
    return "aside" if is_other_history(connection, keys, held) else "verified"


def _event_text(incoming: IncomingJournal, state: State, result: VerificationResult) -> str:
    if state == "aside" and result.reason:
        return f"{incoming.journal} is kept aside: {result.reason}"
    if state == "quarantined":
        return f"{incoming.journal} is not taken: {result.reason}"
    return f"{incoming.journal} is of another history of its store than what is held: kept aside"


def _home(incoming: IncomingJournal, state: State) -> Path:
    place = Path(incoming.robot, incoming.store_id, incoming.journal)
    if state == "verified":
        return "journals" / place
    kind = "aside" if state == "aside" else "quarantine"
    return kind / place.with_name(f"{place.stem}.{incoming.sha256[:16]}{place.suffix}")
