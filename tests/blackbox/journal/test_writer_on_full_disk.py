"""The writer on a disk that fills up: the chain, the schemas and the end stay right."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from amberbox.blackbox.journal import writer as module
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.mcap import CHAIN_METADATA
from amberbox.blackbox.journal.scan import JournalWalk, MetadataRecord
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.core import files as core_files
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic

START_NS = 1_700_000_000 * NS
COUNT = Topic("/count", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))


@pytest.fixture
def refuse(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Give a switch for the disk."""
    full = [False]
    write_all = core_files.write_all

    def write(fd: int, data: bytes) -> None:
        if full[0]:
            os.write(fd, data[:7])
            raise OSError(28, "No space left on device")
        write_all(fd, data)

    monkeypatch.setattr(module, "write_all", write)
    return lambda is_full: full.__setitem__(0, is_full)


def open_files(folder: Path) -> list[Path]:
    """List the files of a folder that this process holds open."""
    links = [Path(f"/proc/self/fd/{fd.name}") for fd in Path("/proc/self/fd").iterdir()]
    files = [link.readlink() for link in links if link.is_symlink()]
    return [file for file in files if file.is_relative_to(folder)]


def writer_in(folder: Path) -> tuple[JournalWriter, int]:
    journal = JournalWriter(JournalOptions(folder, "5c0fe1e2-0000", "main", 1, "b007b007"))
    return journal, journal.channel(COUNT, {"item": "count"})


def write(journal: JournalWriter, channel: int, second: int) -> None:
    at_ns = START_NS + second * NS
    journal.write([channel], [at_ns], [at_ns], [second.to_bytes(8, "little")])


def test_the_chain_holds_over_a_sync_on_a_full_disk(
    tmp_path: Path, refuse: Callable[[bool], None]
) -> None:
    journal, channel = writer_in(tmp_path)
    for second in range(4):
        write(journal, channel, second)
        refuse(second == 1)
        journal.mark_sync().wait()
        refuse(False)
        assert journal.durable_seq == second + 1
    journal.close()
    data = next(tmp_path.glob("*.mcap")).read_bytes()
    links = [
        m for m in JournalWalk(data) if isinstance(m, MetadataRecord) and m.name == CHAIN_METADATA
    ]
    chain, end = bytes(32), 0
    for link in links:
        block = hashlib.sha256(data[int(link.values["from"]) : int(link.values["to"])]).digest()
        chain = hashlib.sha256(chain + block).digest()
        assert int(link.values["from"]) == end
        assert link.values["chain"] == chain.hex()
        end = int(link.values["to"])
    assert len(links) == 4


def test_a_schema_that_the_disk_refused_is_written_with_the_next_chunk(
    tmp_path: Path, refuse: Callable[[bool], None]
) -> None:
    journal, channel = writer_in(tmp_path)
    other = journal.channel(Topic("/other", "json"), {"item": "other"})
    journal.write([other], [START_NS], [START_NS], [b"{}"])
    refuse(True)
    with pytest.raises(OSError, match="No space"):
        write(journal, channel, 0)
    refuse(False)
    write(journal, channel, 0)
    data = next(tmp_path.glob("*.mcap")).read_bytes()
    chunks = [found for found in JournalWalk(data) if isinstance(found, Chunk)]
    assert [len(chunk) for chunk in chunks] == [1, 1]
    assert list(chunks[1].schemas.values()) == [COUNT.schema]
    journal.close()


def test_a_full_disk_at_the_end_leaves_a_file_without_its_end(
    tmp_path: Path, refuse: Callable[[bool], None]
) -> None:
    journal, channel = writer_in(tmp_path)
    write(journal, channel, 0)
    opened = open_files(tmp_path)
    refuse(True)
    journal.close()
    assert (len(opened), open_files(tmp_path)) == (2, [])
    data = next(tmp_path.glob("*.mcap")).read_bytes()
    assert sum(len(found) for found in JournalWalk(data) if isinstance(found, Chunk)) == 1
    assert not JournalWalk(data).finished
