"""Columns are read from the archive unchanged, whatever their type and name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.store.store import create_store
from amberbox.core.types import Schema, Topic
from amberbox.server.archive.catalogue import ArchiveCatalogue, RobotStore
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.journals import LOST, MissingRows
from amberbox.server.schema import JOURNALS
from amberbox.testing.clock import ManualClock
from amberbox.testing.records import T0_NS, FakeRun
from tests.server.archive.recordings import Robot
from tests.server.database.portable import portable_database

_DEFINITION = b"""uint8 u8
uint16 u16
uint32 u32
uint64 u64
int8 i8
int64 i64
float32 f32
bool robot
time day
duration run
uint64[] many
uint8[] raw
time[] times
string store_id
"""
_LARGEST = 2**64 - 1


def _message(number: int) -> bytes:
    values = (255 - number, 65535, 2**32 - 1, _LARGEST - number, -128, -(2**63), -0.0)
    kinds = ("<u1", "<u2", "<u4", "<u8", "<i1", "<i8", "<f4")
    plain = b"".join(np.array(v, k).tobytes() for v, k in zip(values, kinds, strict=True))
    stamps = np.array([1, 1790000000, 5, -3, 7], "<i4").astype("<u4").tobytes()
    lists = np.array([2], "<u4").tobytes() + np.array([_LARGEST, 0], "<u8").tobytes()
    raw = np.array([3], "<u4").tobytes() + b"\x00\xff\x01"
    times = np.array([1, 1790000000, 9], "<u4").tobytes()
    return plain + stamps[:1] + stamps[4:] + lists + raw + times + b"\x02\x00\x00\x00me"


@pytest.fixture
def robot(archive: FolderArchive, tmp_path: Path) -> Robot:
    """A robot with one item of every type, committed."""
    made = Robot("r1", tmp_path)
    create_store(made.store)
    run = FakeRun(made.store)
    topic = Topic("/all", "ros1", Schema("test/All", "ros1msg", _DEFINITION))
    channel = run.journal.channel(topic, {"item": "all", "source": "ros"})
    for number in range(4):
        at_ns = T0_NS + number
        run.journal.write([channel], [at_ns], [at_ns], [_message(number)])
    run.close()
    made.hand_in_all(archive)
    archive.commit()
    return made


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def test_every_type_comes_back(archive: FolderArchive, robot: Robot) -> None:
    ours, theirs = (record.query("all") for record in (archive.robot(), LocalRecord(robot.store)))
    assert ours.fields == theirs.fields
    assert len(ours) == 4
    for name in theirs.names:
        mine, known = ours[name], theirs[name]
        assert type(mine) is type(known)
        assert getattr(mine, "dtype", None) == getattr(known, "dtype", None), name
        assert list(map(_plain, ours.values(name))) == list(map(_plain, theirs.values(name)))
    assert ours.values("u64") == [_LARGEST - number for number in range(4)]
    assert np.signbit(ours["f32"]).all()  # type: ignore[arg-type]  # a plain column


def test_sql_gives_the_same_values(archive: FolderArchive, robot: Robot) -> None:
    names = ["u8", "u64", "i64", "f32", "robot", "day", "run", "times", "many", "store_id"]
    shown = ", ".join(f'"{name}"' for name in names)
    select = f'select {shown} from "all" order by seq'
    theirs, ours = LocalRecord(robot.store).sql(select), archive.robot().sql(select)
    for name in names:
        assert list(map(_plain, ours.values(name))) == list(map(_plain, theirs.values(name))), name


def test_the_catalogue_speaks_what_other_databases_speak(tmp_path: Path) -> None:
    with portable_database(tmp_path, ManualClock()) as database:
        archive = FolderArchive(tmp_path, database)
        robot = Robot("r1", tmp_path)
        robot.record(0, files=2, rows=5)
        robot.hand_in_all(archive)
        lost = MissingRows("main", 9, 0, 5, T0_NS, T0_NS, LOST)
        archive.note_missing("r1", robot.store_id, [lost, lost])
        assert archive.commit(0.0).journals == 2
        source = RobotStore("r1", robot.store_id)
        catalogue = ArchiveCatalogue(database)
        assert catalogue.missing(source) == [lost]
        assert catalogue.revision() == 1
        with database.reading() as connection:
            states = connection.scalars(sa.select(JOURNALS.c.state)).all()
        assert states == ["committed", "committed"]
