"""What a journal may hold: names that lead elsewhere and bombs are seen while it is verified."""

from __future__ import annotations

import hashlib
import re
import resource
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]  # it ships no types
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import select

from amberbox.blackbox.journal import chunk, mcap, scan, writer
from amberbox.blackbox.retention.maintenance import seal
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store.journal_reader import journal_file
from amberbox.blackbox.store.store import open_store
from amberbox.core.names import has_item_form
from amberbox.core.types import Schema, Topic
from amberbox.link.uploads import proof_of
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import verification
from amberbox.server.ingest.uploads import UploadService
from amberbox.server.ingest.verification import UploadClaim, VerificationResult, verify
from amberbox.server.schema import EVENT
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.fuzzing import examples, fuzz
from tests.server.ingest.test_uploads import bring, incoming_of

ELSEWHERE = ["../../pwned", "/tmp/pwned", ".", "..", "a/b/c", "a\0b", "a\nb", "a b", "a.b", 'a"b',
             "%2e%2e", "\u202eodom", "od\u00f6m", "-rf", "0x"]  # fmt: skip
MB = 1 << 20


def journal_with(store: Path, items: list[FakeItem], messages: list[bytes]) -> Path:
    """Record a journal of the ring, which has no seal."""
    run = FakeRun(store, writer="ring", items=items)
    rows: list[Any] = [(T0_NS + n, items[n % len(items)], m) for n, m in enumerate(messages)]
    run.write(rows)
    run.close()
    (path,) = open_store(store).journal_files("ring")
    return path


def verified(store: Path, path: Path) -> VerificationResult:
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    claim = UploadClaim(path, "r1", open_store(store).id, f"ring/{path.name}", digest, None, "")
    return verify(claim)


@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_name_that_is_none_is_refused(tmp_path: Path, name: str) -> None:
    path = journal_with(tmp_path, [FakeItem(name, [{"a": 1}], topic="/odom")], [b'{"a":1}'])
    assert "it names an item" in verified(tmp_path, path).reason


def test_long_names_and_names_of_other_scripts_from_topics_are_taken(tmp_path: Path) -> None:
    items = [FakeItem("a" * 300, [{"a": 1}]), FakeItem("", [{"a": 1}], topic="/../../od\u00f6m")]
    path = journal_with(tmp_path, items, [b'{"a":1}'] * 2)
    assert verified(tmp_path, path).reason == ""
    long, derived = sorted(journal_file(path).items)
    assert len(long) == 200 and long.startswith("aaa")
    assert derived == "test_______odom"


@fuzz
@settings(
    max_examples=examples(25),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=12) | st.from_regex(r"[./a]+"))
def test_no_name_passes_that_is_no_name(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    store = tmp_path_factory.mktemp("robot")
    path = journal_with(store, [FakeItem(name, [{"a": 1}], topic="/odom")], [b'{"a":1}'])
    reason = verified(store, path).reason
    assert bool(reason) == bool(name and not has_item_form(name)), (name, reason)


def test_a_signed_journal_with_such_a_name_is_quarantined_and_told(tmp_path: Path) -> None:
    store = tmp_path / "store"
    run = FakeRun(store)
    item = FakeItem("../../pwned", [{"a": 1}])
    run.write([(T0_NS, item, {"a": 1})])
    run.close()
    seal(open_store(store))
    (path,) = open_store(store).journal_files("main")
    name = f"journal/{path.name}"
    database = ServerDatabase(tmp_path / "server.db")
    upload_service = UploadService(
        tmp_path / "server", database, lambda *_: public_key(store) or ""
    )
    incoming = incoming_of(open_store(store), name)
    state, why = bring(upload_service, incoming, path.read_bytes(), proof_of(store, name))
    upload_service.close()
    with database.reading() as connection:
        (event,) = connection.execute(select(EVENT)).all()
    database.close()
    assert state == "quarantined" and "'../../pwned'" in why
    assert event.robot == "r1" and name in event.text and "letters, digits and _" in event.text
    assert {path.name.partition(".")[0] for path in tmp_path.iterdir()} == {"store", "server"}
    assert not list((tmp_path / "server").rglob("*pwned*"))


@pytest.fixture
def packs_all(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the writer compress chunks that it would leave uncompressed."""
    monkeypatch.setattr(writer, "CHUNK_BYTES", 1 << 40)
    yield


def test_a_chunk_that_unpacks_to_much_is_refused(tmp_path: Path, packs_all: None) -> None:
    item = FakeItem("odom", [{"a": "x"}])
    path = journal_with(tmp_path, [item], [b'{"a":"%s"}' % (b" " * 65 * MB)])
    assert path.stat().st_size < MB
    assert "unpacks to more than 64 MB" in verified(tmp_path, path).reason


def test_a_journal_that_unpacks_to_much_in_all_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verification, "MOST_BYTES", 1000)
    path = journal_with(tmp_path, [FakeItem("odom", [{"a": 1}])], [b'{"a":1}'] * 100)
    assert "it unpacks to more than" in verified(tmp_path, path).reason


@pytest.mark.parametrize("limit", ["MOST_CHANNELS", "MOST_MESSAGES", "MOST_DAYS"])
def test_more_than_a_server_can_keep_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    monkeypatch.setattr(verification, limit, 1)
    items = [FakeItem(f"odom{n}", [{"a": n}]) for n in range(2)]
    run = FakeRun(tmp_path, writer="ring", items=items)
    run.write([(T0_NS + n * verification._DAY_NS, items[n], {"a": 1}) for n in range(2)])
    run.close()
    (path,) = open_store(tmp_path).journal_files("ring")
    assert re.search("it has .*more than 1 ", verified(tmp_path, path).reason)


def test_a_schema_that_is_none_is_refused(tmp_path: Path) -> None:
    topic = Topic("/a", "json", Schema("x", "jsonschema", bytes(2 * MB)))
    run = FakeRun(tmp_path, writer="ring")
    number = run.journal.channel(topic, {"item": "a"})
    run.journal.write([number], [T0_NS], [T0_NS], [b"{}"])
    run.close()
    (path,) = open_store(tmp_path).journal_files("ring")
    assert "a schema has more than 1 MB" in verified(tmp_path, path).reason


def test_a_time_that_no_clock_shows_is_refused() -> None:
    message = mcap.record(mcap.MESSAGE, struct.pack("<HIQQ", 0, 0, 2**63 + 5, 0) + b"{}")
    opened = chunk.open_chunk(message, 0, len(message))
    assert opened is not None
    with pytest.raises(verification.ContentError, match="no clock shows"):
        verification._check_chunks(iter([opened]))


@pytest.mark.parametrize(
    "start", [{"writer": "../../x"}, {"run": "7"}, {"store_id": "x"}, {"file": "9"}, {}]
)
def test_a_journal_says_of_itself_what_its_name_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: dict[str, str]
) -> None:
    """Also one whose chain is sound, and whose start leaves out what could be compared."""
    told = writer.JournalWriter._start_values
    keep = () if start else ("chain",)

    def lying(self: Any, file: Any) -> dict[str, str]:
        values = {**told(self, file), **start}
        return {name: values[name] for name in keep or values if name != "store_id" or start}

    monkeypatch.setattr(writer.JournalWriter, "_start_values", lying)
    path = journal_with(tmp_path, [FakeItem("odom", [{"a": 1}])], [b'{"a":1}'])
    assert verified(tmp_path, path).reason != ""


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def bomb(kind: str, size: int) -> bytes:
    """Pack zeros without ever having them all."""
    part = bytes(MB)
    if kind == "zstd":
        packing = zstandard.ZstdCompressor().compressobj(size=size)
        return b"".join(packing.compress(part) for _ in range(size // MB)) + packing.flush()
    packing = lz4.frame.LZ4FrameCompressor()
    parts = [packing.begin(size), *(packing.compress(part) for _ in range(size // MB))]
    return b"".join([*parts, packing.flush()])


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_a_chunk_never_unpacks_to_more_than_it_announced(kind: str) -> None:
    """Neither the chunk nor the compressed frame in it decides how much memory is used."""
    record = mcap.chunk_record(0, 0, 1000, 0, kind, bomb(kind, 1000 * MB))
    head = mcap.parse_chunk_head(record, 0)
    assert head is not None
    before = _peak()
    assert chunk.decompress(head, record) is None
    assert scan.chunk_at(record, 0) is None
    assert _peak() - before < 100 * MB
    large = mcap.chunk_record(0, 0, 2000 * MB, 0, kind, bomb(kind, MB))
    assert scan.chunk_at(large, 0) is None, "no chunk is that large"


@pytest.mark.parametrize("kind", ["zstd", "lz4", ""])
def test_sound_chunks_of_others_are_read(kind: str) -> None:
    """Frames with and without their size, up to their last byte."""
    body = struct.pack("<BQ", mcap.HEADER, 5) + b"about"
    packers: dict[str, list[Callable[[bytes], bytes]]] = {
        "zstd": [zstandard.ZstdCompressor(write_content_size=n).compress for n in (False, True)],
        "lz4": [partial(lz4.frame.compress, store_size=n) for n in (False, True)],
        "": [bytes],
    }
    for pack in packers[kind]:
        record = mcap.chunk_record(0, 0, len(body), zlib.crc32(body), kind, pack(body))
        head = mcap.parse_chunk_head(record, 0)
        assert head is not None and chunk.decompress(head, record) == body
        short = mcap.parse_chunk_head(record[:-1], 0)
        assert short is None or chunk.decompress(short, record[:-1]) is None
