"""A server that was restored from a backup: robots detect which journals it lacks, and
send them.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from sqlalchemy import select

from amberbox.blackbox.retention.maintenance import seal
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store import store as store_store
from amberbox.blackbox.store.manifest import condense, confirm
from amberbox.blackbox.store.manifest_entries import confirmed_record, unconfirmed_record
from amberbox.blackbox.store.store import Store, WriterLock, open_store
from amberbox.link import uploads
from amberbox.link.connection import LinkOptions
from amberbox.link.frames import FetchFrame
from amberbox.link.record_reader import LinkEvents
from amberbox.link.uploader import (
    CopyError,
    CopyLoop,
    FetchRequests,
    HoldingsCheck,
    JournalCopier,
    UploadReply,
)
from amberbox.link.uploads import HoldingsQuestion, Proof, compare_holdings
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import uploads as held
from amberbox.server.ingest.uploads import IncomingJournal, UploadService, verdict
from amberbox.server.ingest.verification import Verifier
from amberbox.server.schema import JOURNALS, UPLOAD
from amberbox.testing.records import T0_NS, FakeRun, pose_rows

ALWAYS = 2**62


class Backend:
    """A server's folder and upload service, called without a network; ``old`` ones lack the
    comparison.
    """

    def __init__(self, folder: Path, verifier: Verifier, store: Store, *, old: bool = False):
        self.folder, self.old, self.asked = folder, old, 0
        folder.mkdir(exist_ok=True)
        self.database = ServerDatabase(folder / "server.db")
        self.upload_service = UploadService(
            folder, self.database, lambda robot, store_id: public_key(store.path) or "",
            verifier=verifier,
        )  # fmt: skip

    def __call__(
        self, method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> UploadReply:
        """Answer as the server's routes do."""
        if path.startswith("/link/v1/held/"):
            self.asked += 1
            if self.old:
                return UploadReply(404, 0, "", b"")
            question = msgspec.msgpack.decode(body, type=HoldingsQuestion)
            found = compare_holdings(
                question, held.held_journals(self.database, self.folder, "r1", path[14:])
            )
            return UploadReply(200, 0, "", msgspec.msgpack.encode(found))
        store_id, _, journal = path.removeprefix("/link/v1/journals/").partition("/")
        size = int(headers[uploads.BYTES])
        incoming = IncomingJournal("r1", store_id, journal, headers[uploads.SHA256], size)
        if method == "HEAD":
            answer = self.upload_service.head(incoming)
        elif method == "PATCH":
            offset, crc = int(headers[uploads.OFFSET]), int(headers[uploads.CRC])
            answer = self.upload_service.patch(incoming, offset, bytes(body), crc)
        else:
            answer = self.upload_service.post(incoming, msgspec.json.decode(body, type=Proof))
        state = "" if method == "HEAD" and answer.state == "incoming" else answer.state
        told = msgspec.json.encode(verdict(answer))
        return UploadReply(answer.status, answer.offset, state, told)

    def states(self) -> dict[str, str]:
        """Return what became of each journal."""
        with self.database.reading() as connection:
            return {row.journal: row.state for row in connection.execute(select(UPLOAD))}

    def backup(self, target: Path) -> None:
        """Copy the folder, as an admin does after stopping the server."""
        self.database.close()
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(self.folder, target)
        self.database = self.upload_service.database = ServerDatabase(self.folder / "server.db")

    def restore(self, source: Path) -> None:
        """Put a copy in place of the folder."""
        self.database.close()
        shutil.rmtree(self.folder)
        shutil.copytree(source, self.folder)
        self.database = self.upload_service.database = ServerDatabase(self.folder / "server.db")


class Robot:
    """A robot's copying thread, step by step."""

    def __init__(
        self, store: Store, send: Callable[..., UploadReply], copy: str = "always"
    ) -> None:
        options = LinkOptions("http://server:1", "r1", "key", copy=copy)
        self.store, self.contact = store, 1
        self.copier = JournalCopier(store, options, send, link_events=LinkEvents(store))
        self.holdings = HoldingsCheck(self.copier, lambda: self.contact)
        self.requests = FetchRequests(
            store, lambda found: None, lambda: ALWAYS, self.copier.is_settled,
            self.holdings.may_lack,
        )  # fmt: skip
        self.loop = CopyLoop(self.copier, self.requests, lambda: None, lambda: True, self.holdings)

    def run(self) -> int:
        """Copy until nothing is due; return how many journals went."""
        before = self.loop.copied
        while self.loop.step():
            pass
        return self.loop.copied - before

    def connect(self) -> int:
        """Connect again with a new connection."""
        self.contact += 1
        return self.run()


def events(store: Store) -> list[str]:
    """Return what the link has left for the keeper to write down."""
    return [
        str(one.values["text"])
        for one in store_store.pending(store)
        if one.kind == "event" and one.values["kind"] == "server_lacks"
    ]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with four sealed and signed journals."""
    path = tmp_path_factory.mktemp("original") / "store"
    run = FakeRun(path)
    run.start(T0_NS - 1)
    for start in (0, 100, 200, 300):
        run.write(pose_rows(start, start + 100))
        run.rotate()
    run.close()
    seal(open_store(path))
    return path


@pytest.fixture(scope="module")
def verifier() -> Iterator[Verifier]:
    """One worker that verifies for all tests."""
    found = Verifier()
    yield found
    found.close()


@pytest.fixture
def store(tmp_path: Path, original: Path) -> Store:
    shutil.copytree(original, tmp_path / "store")
    return open_store(tmp_path / "store")


@pytest.fixture
def server(tmp_path: Path, verifier: Verifier, store: Store) -> Iterator[Backend]:
    found = Backend(tmp_path / "server", verifier, store)
    yield found
    found.database.close()


def in_two_halves(store: Store, server: Backend, backup: Path) -> tuple[Robot, list[str]]:
    """Copy one journal, make a backup, copy the others; return the names of these."""
    robot = Robot(store, server)
    assert robot.loop.step()
    server.backup(backup)
    assert robot.run() == 3
    with_backup = next(iter(manifest.read(store.path).confirmed - set(server.states())), None)
    assert with_backup is None
    first = {path.name for path in (backup / "journals").rglob("*.mcap")}
    return robot, sorted(n for n in server.states() if n.rpartition("/")[2] not in first)


def test_what_a_restored_server_lacks_comes_again_with_an_event(
    store: Store, server: Backend, tmp_path: Path
) -> None:
    robot, later = in_two_halves(store, server, tmp_path / "backup")
    server.restore(tmp_path / "backup")
    assert len(server.states()) == 1
    robot.contact += 1
    robot.holdings.step()
    known = manifest.read(store.path)
    assert sorted(known.unconfirmed) == later and not known.confirmed & set(later)
    assert robot.run() == 3
    assert len(server.states()) == 4 and set(server.states().values()) == {"verified"}
    assert manifest.read(store.path).confirmed >= set(later)
    assert not manifest.read(store.path).unconfirmed
    [text] = events(store)
    assert text.startswith("server:1 lacks 3 journals") and later[0] in text
    for name in later:
        copy = server.folder / "journals" / "r1" / store.id / name
        assert copy.read_bytes() == (store.path / name).read_bytes()
    assert robot.connect() == 0 and len(events(store)) == 1


def test_restored_twice_to_the_same_point_everything_comes_twice(
    store: Store, server: Backend, tmp_path: Path
) -> None:
    robot, later = in_two_halves(store, server, tmp_path / "backup")
    for times in (1, 2):
        server.restore(tmp_path / "backup")
        assert robot.connect() == len(later)
        assert len(events(store)) == times
    assert len(server.states()) == 4


def test_a_server_that_knows_nothing_any_more_gets_everything(
    store: Store, server: Backend, tmp_path: Path
) -> None:
    """Restored to before the robot was added, or another server in its place."""
    server.backup(tmp_path / "backup")
    assert Robot(store, server).run() == 4
    server.restore(tmp_path / "backup")
    assert Robot(store, server, copy="on_request").run() == 4  # what it had, under any rule
    assert set(server.states().values()) == {"verified"}


def test_a_robot_that_is_killed_in_between_does_the_rest_after_its_restart(
    store: Store, server: Backend, tmp_path: Path
) -> None:
    robot, later = in_two_halves(store, server, tmp_path / "backup")
    server.restore(tmp_path / "backup")
    robot.contact += 1
    robot.holdings.step()  # here it dies
    again = Robot(store, server, copy="on_request")
    assert again.copier.waiting() == later
    server.restore(tmp_path / "backup")  # and the server is restored again meanwhile
    assert again.run() == len(later)


def test_a_server_of_before_the_question_is_left_alone(store: Store, server: Backend) -> None:
    server.old = True
    robot = Robot(store, server)
    assert robot.run() == 4 and server.asked == 0, "there is nothing yet that could be missing"
    assert robot.connect() == 0 and server.asked == 1
    assert robot.run() == 0 and server.asked == 1, "once in a connection"
    assert not events(store)


def test_a_question_that_is_not_answered_does_not_stop_the_copies(
    store: Store, server: Backend
) -> None:
    def failing(
        method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> UploadReply:
        if "/held/" in path:
            return UploadReply(500, 0, "", b"")
        return server(method, path, headers, body)

    confirm(store, sorted(manifest.read(store.path).sealed)[:1], "server:1")
    robot = Robot(store, failing)
    for _ in range(3):
        with pytest.raises(CopyError):
            robot.loop.step()
    assert len(server.states()) == 3


def test_what_retention_deleted_is_not_sent_again(store: Store, server: Backend) -> None:
    robot = Robot(store, server)
    robot.run()
    gone = sorted(server.states())[1]
    _enter_in_archive(server, gone, raw_gone=True)
    (server.folder / "journals" / "r1" / store.id / gone).unlink()
    assert robot.connect() == 0 and not events(store)


def test_what_only_the_database_still_names_comes_again(store: Store, server: Backend) -> None:
    """The disk was restored from an older copy than the database."""
    robot = Robot(store, server)
    robot.run()
    gone = sorted(server.states())[1]
    path = server.folder / "journals" / "r1" / store.id / gone
    path.unlink()
    assert robot.connect() == 1
    assert path.read_bytes() == (store.path / gone).read_bytes()
    assert set(server.states().values()) == {"verified"}, "it is not taken for another history"


def test_an_upload_in_flight_goes_on_from_what_the_backup_has_of_it(
    store: Store, server: Backend, tmp_path: Path
) -> None:
    robot = Robot(store, server)
    robot.holdings.step()
    name = robot.copier.waiting()[0]
    content = (store.path / name).read_bytes()
    sent: list[str] = []

    def half(
        method: str, path: str, headers: dict[str, str], body: bytes | memoryview
    ) -> UploadReply:
        if method == "PATCH" and not sent:
            sent.append(path)
            server.backup(tmp_path / "backup")
            server(method, path, headers, body)
            server.restore(tmp_path / "backup")  # the piece that was acknowledged is gone
        return server(method, path, headers, body)

    robot.copier.send = half
    assert robot.loop.step() and sent
    assert (server.folder / "journals" / "r1" / store.id / name).read_bytes() == content


def test_what_was_refused_is_refused_again(store: Store, server: Backend, tmp_path: Path) -> None:
    server.backup(tmp_path / "backup")
    victim = sorted(manifest.read(store.path).sealed)[1]
    data = bytearray((store.path / victim).read_bytes())
    data[len(data) // 2] ^= 1
    (store.path / victim).write_bytes(data)
    robot = Robot(store, server)
    robot.run()
    assert server.states()[victim] == "quarantined"
    assert robot.connect() == 0
    server.restore(tmp_path / "backup")
    robot.connect()
    assert server.states()[victim] == "quarantined" and len(server.states()) == 4
    assert victim not in manifest.read(store.path).confirmed


def test_a_fetch_of_what_the_server_lost_does_not_hang(store: Store, server: Backend) -> None:
    """Also when it is lost while the connection holds."""
    robot = Robot(store, server)
    robot.run()
    lost = sorted(server.states())[1]
    path = server.folder / "journals" / "r1" / store.id / lost
    path.unlink()
    robot.holdings.look_again()
    robot.requests.add(FetchFrame("one", "", 0, ALWAYS))
    assert robot.run() == 1 and path.exists()
    robot.loop.step()
    assert not robot.requests._open, "everything has arrived"


def test_a_keeper_at_work_enters_it_and_what_is_lacking_is_not_the_first_to_go(
    store: Store, server: Backend, tmp_path: Path
) -> None:
    robot, later = in_two_halves(store, server, tmp_path / "backup")
    server.restore(tmp_path / "backup")
    lock = WriterLock(store, "keeper")
    robot.connect()
    assert len(server.states()) == 4, "it does not wait for the keeper"
    assert manifest.read(store.path).confirmed >= set(later), "nothing was entered yet"
    kinds = [one.kind for one in store_store.pending(store) if one.kind != "event"]
    assert kinds == ["unconfirm", "confirm", "confirm", "confirm"]
    manifest.take_confirmations(store)
    lock.release()
    assert manifest.read(store.path).confirmed >= set(later)
    assert [r.kind for r in store_store.pending(store)] == ["event"]


def test_a_manifest_that_is_written_anew_still_says_so(store: Store) -> None:
    names = sorted(manifest.read(store.path).sealed)
    each = tuple(names)
    said = [confirmed_record(each, "a", 1), unconfirmed_record(each, "a", 2)]
    manifest.append(store.path, [*said * 100, confirmed_record(each[:1], "a", 3)])
    assert condense(store.path, lambda name: True, lambda head: None, 1)
    known = manifest.read(store.path)
    assert sorted(known.unconfirmed) == names[1:]
    assert known.confirmed == {names[0]}


def _enter_in_archive(server: Backend, journal: str, *, raw_gone: bool) -> None:
    """Enter a journal as the archive has it."""
    with server.database.begin() as connection:
        row = connection.execute(select(UPLOAD).where(UPLOAD.c.journal == journal)).one()
        connection.execute(JOURNALS.insert().values(
            robot=row.robot, store_id=row.store_id, file=journal, sha256=row.sha256,
            bytes=row.bytes, keeping="main", writer=row.writer, run=row.run,
            first_seq=row.first_seq, end_seq=row.end_seq, start_ns=row.start_ns, end_ns=row.end_ns,
            facts="", put_ns=0, batch=1, state="committed", rows=1, raw_gone=raw_gone,
            columns_gone=False, own_gone=False,
        ))  # fmt: skip
