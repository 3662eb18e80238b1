"""Where journals come in: how much is held, the next piece, and at the end the verdict.

It knows nothing of HTTP servers: a route hands over what the request says, already authenticated as
a robot, and sends the answer. Everything here blocks; call it in a thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from sqlalchemy import ColumnElement, Connection, and_

from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.files import sync_folder
from amberbox.fleet.database.database import Database
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.linkend.events import note
from amberbox.fleet.linkend.signingkeys import key_state, waiting_reason
from amberbox.fleet.uploads import pieces
from amberbox.fleet.uploads.holdings import is_held, known_uploads
from amberbox.fleet.uploads.pieces import Incoming, PieceError
from amberbox.fleet.uploads.tables import UPLOAD, is_other_history
from amberbox.fleet.uploads.verifying import Claim, Result, Verifier
from amberbox.link.limits import PIECE_BYTES
from amberbox.link.proof import signing_key
from amberbox.link.uploads import JOURNAL_BYTES, Proof, State, Verdict

_KEY = ("robot", "store_id", "journal", "sha256")
_TOO_MUCH = "too much of this robot waits here already"
_KEPT_S = 7 * 86_400.0


@dataclass(frozen=True, slots=True)
class Answer:
    """An HTTP status, how much is held, what became of the file, and a word about it."""

    status: int
    offset: int = 0
    state: State = "incoming"
    text: str = ""


PublicKey = Callable[[str, str], str]
"""Gives the public key (hex) of a robot's store; empty where it has none."""
OnVerified = Callable[[Incoming, Result, Path], None]


def _ignore(incoming: Incoming, result: Result, path: Path) -> None:
    return None


@dataclass(slots=True)
class Desk:
    """Takes journals into the folder ``root`` of the server.

    ``quota`` is how many bytes of a robot may wait unverified. ``verified`` is told of each new
    journal.
    """

    root: Path
    database: Database
    public_key: PublicKey
    clock: Clock = field(default_factory=SystemClock)
    quota: int = JOURNAL_BYTES
    verified: OnVerified = _ignore
    verifier: Verifier = field(default_factory=Verifier)
    _busy: dict[Path, threading.Lock] = field(default_factory=dict)
    _guard: threading.Lock = field(default_factory=threading.Lock)

    def head(self, incoming: Incoming) -> Answer:
        """Tell how much of a file is held, and what became of it."""
        refused = self._refused(incoming)
        return refused or self._known(incoming) or self._coming(incoming)

    def patch(self, incoming: Incoming, offset: int, piece: bytes, crc: int) -> Answer:
        """Take a piece of a file."""
        known = self._refused(incoming) or self._known(incoming)
        if known is not None:
            return known
        if len(piece) > PIECE_BYTES:
            return Answer(413, text=f"a piece has at most {PIECE_BYTES} bytes")
        if self._waiting_bytes(incoming.robot) + len(piece) > self.quota:
            return Answer(507, text=_TOO_MUCH)
        with self._lock(incoming):
            try:
                return Answer(204, pieces.add(self.root, incoming, offset, piece, crc))
            except PieceError as error:
                return Answer(409, error.offset, text=str(error))
            except OSError as error:
                return Answer(507, text=f"the server cannot keep it: {error.strerror}")

    def post(self, incoming: Incoming, proof: Proof | None) -> Answer:
        """End a file: it is verified, and then part of the record, aside, or quarantined."""
        known = self._refused(incoming) or self._known(incoming)
        if known is not None:
            return known
        with self._lock(incoming):
            return self._known(incoming) or self._finish(incoming, proof)

    def close(self) -> None:
        """End the verification's worker."""
        self.verifier.close()

    def _refused(self, incoming: Incoming) -> Answer | None:
        wrong = incoming.problem()
        if wrong:
            return Answer(400, text=wrong)
        if incoming.size > JOURNAL_BYTES:
            return Answer(413, text=f"a journal has at most {JOURNAL_BYTES} bytes")
        return None

    def _known(self, incoming: Incoming) -> Answer | None:
        """Answer for a file whose fate is known; one that the disk has lost may come again."""
        with self.database.reading() as connection:
            row = connection.execute(known_uploads().where(_is(incoming))).first()
        if row is None or not is_held(self.root, row):
            return None
        return Answer(200, incoming.size, row.state, row.reason)

    def _coming(self, incoming: Incoming) -> Answer:
        at = pieces.held(self.root, incoming)
        if not at and self._waiting_bytes(incoming.robot) + incoming.size > self.quota:
            self._drop_old(incoming.robot)
            if self._waiting_bytes(incoming.robot) + incoming.size > self.quota:
                return Answer(507, text=_TOO_MUCH)
        return Answer(200, at)

    def _waiting_bytes(self, robot: str) -> int:
        return sum(path.stat().st_size for path in pieces.parts(self.root, robot))

    def _drop_old(self, robot: str) -> None:
        """Forget pieces of which none came for long: their robot may not have the file any more."""
        oldest_s = self.clock.wall_ns() / NS - _KEPT_S
        for path in pieces.parts(self.root, robot):
            if path.stat().st_mtime < oldest_s:
                path.unlink(missing_ok=True)

    def _lock(self, incoming: Incoming) -> threading.Lock:
        """Let one request at a time work on a file, whatever is sent twice."""
        with self._guard:
            if len(self._busy) > 1000:
                self._busy = {path: lock for path, lock in self._busy.items() if lock.locked()}
            return self._busy.setdefault(incoming.part, threading.Lock())

    def _finish(self, incoming: Incoming, proof: Proof | None) -> Answer:
        at = pieces.held(self.root, incoming)
        if at != incoming.size:
            return Answer(409, at, text=f"{incoming.size - at} bytes are missing")
        signed_by = "" if proof is None else signing_key(proof)
        with self.database.reading() as connection:
            new = key_state(connection, incoming.robot, signed_by) if signed_by else None
        is_trusted = new in ("pending", "confirmed")
        key = signed_by if is_trusted else self.public_key(incoming.robot, incoming.store_id)
        if not key and new is None and proof is not None and ',"kind":"signed",' in proof.lines:
            return Answer(503, at, text="the robot has to say first with which key it signs")
        path = self.root / incoming.part
        result = self.verifier.check(
            Claim(path, incoming.robot, incoming.store_id, incoming.journal, incoming.sha256,
                  proof, key)
        )  # fmt: skip
        if result is None:
            result = Result("to read it takes more memory than it may")
        if result.unread:
            pieces.drop(self.root, incoming)
            return Answer(409, 0, text=result.reason)
        sealed = proof is not None and bool(proof.lines)
        if not result.reason and sealed and not result.signed:
            reason = "it is not signed, and this server takes signed journals only"
            result = replace(result, reason=reason)
        if new == "refused":
            result = replace(result, reason="it is signed with a key that an admin refused")
        if new == "pending" and not result.reason:
            return self._place(incoming, replace(result, reason=waiting_reason(key)), waits=True)
        return self._place(incoming, result)

    def _place(self, incoming: Incoming, result: Result, *, waits: bool = False) -> Answer:
        """Move a file to where it belongs, enter it, and tell; it ``waits`` for its key aside."""
        with self.database.reading() as connection:
            state = "aside" if waits else _state(connection, incoming, result)
        path = _home(incoming, state)
        _move(self.root / incoming.part, self.root / path)
        now_ns = self.clock.wall_ns()
        with self.database.begin() as connection:
            connection.execute(
                upsert(connection.dialect, UPLOAD, _KEY, ()),
                [_row(incoming, result, state, path, now_ns)],
            )
            if state != "verified":
                note(connection, incoming.robot, now_ns, state, _told(incoming, state, result))
        if state != "quarantined":
            self.verified(incoming, result, self.root / path)
        return Answer(200, incoming.size, state, result.reason)


def verdict(answer: Answer) -> Verdict:
    """Return what the robot is told of a file's end."""
    return Verdict(answer.state, answer.text)


def _is(incoming: Incoming) -> ColumnElement[bool]:
    return and_(
        UPLOAD.c.robot == incoming.robot, UPLOAD.c.store_id == incoming.store_id,
        UPLOAD.c.journal == incoming.journal, UPLOAD.c.sha256 == incoming.sha256,
    )  # fmt: skip


def _state(connection: Connection, incoming: Incoming, result: Result) -> State:
    """Decide what becomes of a file: one name of a store has one content in its record.

    Another one, or rows at positions that are held already, come from a disk on which an old image
    was restored: two histories of one store.
    """
    if result.reason:
        return "quarantined"
    keys = incoming.robot, incoming.store_id, incoming.journal, incoming.sha256
    held = result.writer, result.run, result.first_seq, result.end_seq
    return "aside" if is_other_history(connection, keys, held) else "verified"


def _told(incoming: Incoming, state: State, result: Result) -> str:
    if state == "aside" and result.reason:
        return f"{incoming.journal} is kept aside: {result.reason}"
    if state == "quarantined":
        return f"{incoming.journal} is not taken: {result.reason}"
    return f"{incoming.journal} is of another history of its store than what is held: kept aside"


def _home(incoming: Incoming, state: State) -> Path:
    place = Path(incoming.robot, incoming.store_id, incoming.journal)
    if state == "verified":
        return "journals" / place
    kind = "aside" if state == "aside" else "quarantine"
    return kind / place.with_name(f"{place.stem}.{incoming.sha256[:16]}{place.suffix}")


def _move(source: Path, target: Path) -> None:
    """Give a file its name for good; what was verified is not written any more."""
    target.parent.mkdir(parents=True, exist_ok=True)
    source.chmod(0o440)
    source.replace(target)
    sync_folder(target.parent)


def _row(
    incoming: Incoming, result: Result, state: State, path: Path, now_ns: int
) -> dict[str, object]:
    return {
        "robot": incoming.robot, "store_id": incoming.store_id, "journal": incoming.journal,
        "sha256": incoming.sha256, "bytes": incoming.size, "state": state,
        "reason": result.reason, "path": str(path), "signed": result.signed,
        "writer": result.writer, "run": result.run, "number": result.number,
        "first_seq": result.first_seq, "end_seq": result.end_seq, "start_ns": result.start_ns,
        "end_ns": result.end_ns, "began_ns": now_ns, "ended_ns": now_ns,
    }  # fmt: skip
