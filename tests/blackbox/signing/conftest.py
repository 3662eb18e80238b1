"""A store of a robot, and functions that tamper with it."""

from __future__ import annotations

import shutil
import threading
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import zstandard

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.chunk import decompress
from amberbox.blackbox.journal.mcap import ChunkHead, parse_chunk_head
from amberbox.blackbox.journal.scan import scan
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService, wait_for_lock
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.findings import VerifyFinding, VerifyReport
from amberbox.blackbox.signing.verify import verify
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, number

pytest.importorskip("cryptography", reason="signatures need it; pip install 'amberbox[keep]'")
pytest.importorskip("pyarrow", reason="segments are Parquet files; pip install 'amberbox[keep]'")


def keep(store: Path, *, close: bool = True) -> None:
    """Let a keeper work on a store once."""
    opened = open_store(store)
    lock = wait_for_lock(opened, 0.0, threading.Event())
    keeper = RetentionService(opened, RetentionOptions(quota=10**9, min_free=0))
    keeper.step(threading.Event())
    if close:
        keeper.close()
    lock.release()


def record(store: Path, clock: ManualClock, writes: int = 40, *, crash: bool = False) -> ManualBox:
    """Record a run of numbered messages with a sync every second, a file every two."""
    options = PipelineOptions(boot_id=clock.boot_id(), rotate_ns=2 * NS)
    box = ManualBox(store, clock=clock, options=options)
    for write in range(writes):
        box.hear(COUNT, *(number(write * 10 + n) for n in range(10)))
        box.write()
        if write % 10 == 9:
            for mark in box.pipeline.mark_sync():
                mark.wait()
    box.crash() if crash else box.close()
    return box


@dataclass
class Robot:
    """A store under attack; files are named as in the store."""

    path: Path

    def verify(self, *noted: str, key: str = "") -> VerifyReport:
        return verify(self.path, noted=noted, key=key)

    def bad(self, *noted: str) -> list[VerifyFinding]:
        """Return what verify finds that is not merely unsigned."""
        return [f for f in self.verify(*noted).findings if f.state != "unsigned"]

    def states(self, *noted: str) -> list[tuple[str, str]]:
        return sorted({(finding.state, finding.file) for finding in self.bad(*noted)})

    def journals(self, run: int | None = None) -> list[str]:
        found = sorted((self.path / "journal").glob("*.mcap"))
        names = [f"journal/{path.name}" for path in found]
        return [n for n in names if run is None or n.startswith(f"journal/{run:06d}")]

    def segments(self) -> list[str]:
        found = sorted((self.path / "segments").glob("*/*.parquet"))
        return [str(path.relative_to(self.path)) for path in found]

    def change(self, name: str, change: Callable[[bytearray], object]) -> None:
        content = bytearray((self.path / name).read_bytes())
        change(content)
        (self.path / name).write_bytes(content)

    def flip(self, name: str, bit: int) -> None:
        self.change(name, lambda c: c.__setitem__(bit // 8, c[bit // 8] ^ 1 << bit % 8))

    def chunks(self, name: str) -> list[ChunkHead]:
        path = self.path / name
        content = path.read_bytes()
        heads = [parse_chunk_head(content, place.offset) for place in scan(path).places]
        return [head for head in heads if head is not None]

    def forge(self, name: str, chunk: ChunkHead) -> None:
        """Change a value of the last message in a chunk and repair the chunk's checksum."""
        content = (self.path / name).read_bytes()
        body = decompress(chunk, content)
        assert body is not None
        forged, packed = _forged(body, chunk.data_length)
        record = mcap.chunk_record(
            chunk.start_ns, chunk.end_ns, len(forged), zlib.crc32(forged), "zstd", packed
        )
        end = chunk.offset + chunk.length
        (self.path / name).write_bytes(content[: chunk.offset] + record + content[end:])


def _forged(body: bytes, size: int) -> tuple[bytes, bytes]:
    """Change one byte of the last messages so that they compress to the same size."""
    zstd = zstandard.ZstdCompressor(level=1, write_content_size=True)
    for place in range(len(body) - 1, len(body) - 400, -1):
        for bit in range(8):
            forged = body[:place] + bytes([body[place] ^ 1 << bit]) + body[place + 1 :]
            packed = zstd.compress(forged)
            if len(packed) == size:
                return forged, packed
    pytest.fail("no forged value compresses to the same size")


@pytest.fixture(scope="session")
def _whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs: the first two sealed and in columns, the last one cut by a crash."""
    store, clock = tmp_path_factory.mktemp("verify") / "store", ManualClock()
    record(store, clock)
    record(store, clock)
    keep(store)
    record(store, clock, 25, crash=True)
    return store


@pytest.fixture
def robot(_whole: Path, tmp_path: Path) -> Robot:
    """A fresh copy of the store."""
    return Robot(Path(shutil.copytree(_whole, tmp_path / "store")))
