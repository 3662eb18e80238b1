"""Journals are uploaded in pieces over bad networks; confirmed ones are stored byte for byte."""

from __future__ import annotations

import hashlib
import os
import shutil
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import select

from amberbox.blackbox.retention.maintenance import seal
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.store import Store, open_store
from amberbox.link.connection import LinkOptions
from amberbox.link.limits import PIECE_BYTES
from amberbox.link.policy import CopySituation
from amberbox.link.uploader import CopyError, HttpTransport, JournalCopier
from amberbox.link.uploads import Proof, is_journal_name, proof_of
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.uploads import IncomingJournal, UploadService
from amberbox.server.schema import EVENT, UPLOAD
from amberbox.testing.fault_proxy import Faults, Proxy
from amberbox.testing.records import T0_NS, FakeRun, pose_rows
from tests.server.offline.served import served


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with three sealed and signed journals."""
    path = tmp_path_factory.mktemp("original") / "store"
    run = FakeRun(path)
    run.start(T0_NS - 1)
    for start in (0, 1000, 2000):
        run.write(pose_rows(start, start + 1000))
        run.rotate()
    run.close()
    seal(open_store(path))
    return path


@pytest.fixture
def store(tmp_path: Path, original: Path) -> Store:
    """A copy of it, for one test."""
    shutil.copytree(original, tmp_path / "store")
    return open_store(tmp_path / "store")


@pytest.fixture
def upload_service(tmp_path: Path, store: Store) -> Iterator[UploadService]:
    database = ServerDatabase(tmp_path / "server.db")
    yield UploadService(
        tmp_path / "server", database, lambda robot, store_id: public_key(store.path) or ""
    )
    database.close()


def copier_of(store: Store, port: int, copy: str = "always") -> JournalCopier:
    options = LinkOptions(f"http://127.0.0.1:{port}", "r1", "key-r1", copy=copy)
    return JournalCopier(store, options, HttpTransport(options, lambda: None))


def incoming_of(store: Store, name: str, content: bytes | None = None) -> IncomingJournal:
    content = (store.path / name).read_bytes() if content is None else content
    return IncomingJournal("r1", store.id, name, hashlib.sha256(content).hexdigest(), len(content))


def states(upload_service: UploadService) -> dict[str, str]:
    with upload_service.database.reading() as connection:
        return {row.journal: row.state for row in connection.execute(select(UPLOAD))}


def bring(
    upload_service: UploadService, incoming: IncomingJournal, content: bytes, proof: Proof | None
) -> tuple[str, str]:
    """Bring a file in one piece."""
    assert upload_service.patch(incoming, 0, content, zlib.crc32(content)).status == 204
    answer = upload_service.post(incoming, proof)
    return answer.state, answer.text


def test_journals_are_copied_verified_and_confirmed(
    store: Store, upload_service: UploadService
) -> None:
    with served(upload_service) as port:
        copier = copier_of(store, port)
        names = copier.waiting()
        while copier.step():
            pass
    assert len(names) >= 3 and set(states(upload_service).values()) == {"verified"}
    for name in names:
        here = upload_service.root / "journals" / "r1" / store.id / name
        assert here.read_bytes() == (store.path / name).read_bytes()
    assert set(manifest.read(store.path).confirmed) >= set(names)
    assert not list((upload_service.root / "incoming").rglob("*.part"))
    assert not copier_of(store, 1).waiting()


@pytest.mark.parametrize("seed", range(3))
def test_a_bad_network_only_takes_longer(
    store: Store, upload_service: UploadService, seed: int
) -> None:
    faults = Faults(("cut", "mid_frame"), after_bytes=(200, 100_000))
    with served(upload_service) as port, Proxy(port, faults, seed) as proxy:
        copier = copier_of(store, proxy.port)
        names, tries = copier.waiting(), 0
        while copier.waiting():
            tries += 1
            assert tries < 200
            try:
                copier.step()
            except CopyError:
                continue
    assert proxy.struck
    for name in names:
        here = upload_service.root / "journals" / "r1" / store.id / name
        assert here.read_bytes() == (store.path / name).read_bytes()


def test_a_file_that_was_changed_on_the_robot_is_quarantined(
    store: Store, upload_service: UploadService
) -> None:
    name = store.journal_files("main")[0].relative_to(store.path).as_posix()
    path = store.path / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with served(upload_service) as port:
        copier = copier_of(store, port)
        while copier.step():
            pass
    assert states(upload_service)[name] == "quarantined"
    assert name not in manifest.read(store.path).confirmed
    with upload_service.database.reading() as connection:
        [told] = connection.execute(select(EVENT).where(EVENT.c.robot == "r1"))
    assert told.kind == "quarantined" and name in told.text
    [kept] = (upload_service.root / "quarantine").rglob("*.mcap")
    assert kept.read_bytes() == bytes(content)


def test_a_seal_that_was_written_anew_is_no_proof(
    store: Store, upload_service: UploadService
) -> None:
    name = store.journal_files("main")[0].relative_to(store.path).as_posix()
    content = (store.path / name).read_bytes()
    proof = proof_of(store.path, name)
    assert proof is not None
    incoming = incoming_of(store, name)
    forged = Proof(proof.lines.replace('"bytes":', '"bytes": '))
    assert bring(upload_service, incoming, content, forged)[0] == "quarantined"


def test_another_key_and_no_proof_are_refused(
    store: Store, upload_service: UploadService, tmp_path: Path
) -> None:
    first, second = (p.relative_to(store.path).as_posix() for p in store.journal_files("main")[:2])
    upload_service.public_key = lambda robot, store_id: "00" * 32
    content = (store.path / first).read_bytes()
    state, why = bring(
        upload_service, incoming_of(store, first), content, proof_of(store.path, first)
    )
    assert state == "quarantined" and "another key" in why
    content = (store.path / second).read_bytes()
    state, why = bring(upload_service, incoming_of(store, second), content, None)
    assert state == "quarantined" and "not sealed" in why


def test_an_old_image_that_went_on_is_kept_aside(
    store: Store, upload_service: UploadService, tmp_path: Path
) -> None:
    """The card is restored from an image; the run that follows has the same number again."""
    image = tmp_path / "image"
    shutil.copytree(store.path, image)
    for path, start in ((store.path, 3000), (image, 5000)):
        run = FakeRun(path)
        run.write(pose_rows(start, start + 50))
        run.close()
        seal(open_store(path))
    with served(upload_service) as port:
        for path in (store.path, image):
            copier = copier_of(open_store(path), port)
            while copier.step():
                pass
    with upload_service.database.reading() as connection:
        rows = connection.execute(select(UPLOAD).where(UPLOAD.c.writer == "main")).all()
        kinds = set(connection.scalars(select(EVENT.c.kind).where(EVENT.c.robot == "r1")))
    assert sorted(row.state for row in rows).count("aside") == 1
    assert kinds == {"aside"}
    for row in rows:
        found = hashlib.sha256((upload_service.root / row.path).read_bytes()).hexdigest()
        assert found == row.sha256


def test_pieces_out_of_place_change_nothing(store: Store, upload_service: UploadService) -> None:
    name = store.journal_files("main")[0].relative_to(store.path).as_posix()
    content = (store.path / name).read_bytes()
    incoming = incoming_of(store, name)
    half = content[: len(content) // 2]
    assert upload_service.patch(incoming, 5, half, zlib.crc32(half)).status == 409
    assert upload_service.patch(incoming, 0, half, zlib.crc32(half) ^ 1).status == 409
    assert upload_service.patch(incoming, 0, half, zlib.crc32(half)).offset == len(half)
    again = upload_service.patch(incoming, 0, half, zlib.crc32(half))
    assert (again.status, again.offset) == (409, len(half))
    assert upload_service.post(incoming, None).status == 409
    long = content + b"x"
    assert upload_service.patch(incoming, len(half), long, zlib.crc32(long)).status == 409
    big = bytes(PIECE_BYTES + 1)
    assert upload_service.patch(incoming, len(half), big, zlib.crc32(big)).status == 413
    assert upload_service.head(incoming).offset == len(half)


def test_what_waits_of_a_robot_has_an_end_and_does_not_wait_for_ever(
    store: Store, upload_service: UploadService
) -> None:
    one, other = (
        replace(incoming_of(store, name, b"x"), size=100)
        for name in ("journal/000001-aaaa-0001.mcap", "journal/000001-aaaa-0002.mcap")
    )
    upload_service.quota, piece = 100, bytes(60)
    assert upload_service.patch(one, 0, piece, zlib.crc32(piece)).status == 204
    assert upload_service.patch(other, 0, piece, zlib.crc32(piece)).status == 507, (
        "it did not ask first"
    )
    assert upload_service.head(other).status == 507
    os.utime(upload_service.root / one.part, (0, 0))
    assert upload_service.head(other).status == 200
    assert upload_service.head(one).offset == 0


def test_another_content_than_was_announced_begins_anew(
    store: Store, upload_service: UploadService
) -> None:
    name = store.journal_files("main")[0].relative_to(store.path).as_posix()
    content = (store.path / name).read_bytes()
    incoming = incoming_of(store, name)
    wrong = bytes(len(content))
    upload_service.patch(incoming, 0, wrong, zlib.crc32(wrong))
    assert (upload_service.post(incoming, None).status, upload_service.head(incoming).offset) == (
        409,
        0,
    )


@pytest.mark.parametrize(
    "name",
    ["../../etc/passwd", "journal/../../x.mcap", "journal/1-a-0.mcap\n", "journal//1-a-0.mcap",
     "other/1-a-0.mcap", "journal/1-a-0.mcap.part", "/journal/1-a-0.mcap", ""],
)  # fmt: skip
def test_no_path_leads_elsewhere(upload_service: UploadService, store: Store, name: str) -> None:
    assert not is_journal_name(name)
    assert upload_service.head(IncomingJournal("r1", store.id, name, "0" * 64, 5)).status == 400
    assert (
        upload_service.head(
            IncomingJournal("r1", "../..", "journal/1-a-0.mcap", "0" * 64, 5)
        ).status
        == 400
    )


def test_what_nobody_asked_for_waits_for_the_dock(store: Store) -> None:
    copier = copier_of(store, 1, "docked")
    assert not copier.waiting()
    copier.situation = lambda: CopySituation(docked=True)
    assert len(copier.waiting()) >= 3
    wanted = store.journal_files("main")[1].relative_to(store.path).as_posix()
    copier.situation = lambda: CopySituation(requested=frozenset({wanted}))
    assert copier.waiting() == [wanted]
