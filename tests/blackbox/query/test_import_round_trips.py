"""Exported data are imported again with equal columns; data without columns stay unchanged."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

import amberbox
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import View
from amberbox.blackbox.query.importing import import_recordings
from amberbox.blackbox.query.record import Record
from amberbox.core.types import Schema, Topic
from tests.blackbox.formats.test_mongodump import comparable, write_dump
from tests.support.manual_recorder import ManualBox, raw_messages

NS = 10**9
START_NS = 1_544_443_200 * NS
FLAT = Topic(
    "/flat", "ros1",
    Schema("own/Flat", "ros1msg", b"time stamp\nfloat64 x\nint32 n\nbool on\nstring word\n"),
)  # fmt: skip


def flat(n: int) -> bytes:
    """Make a message of ``FLAT`` whose own stamp is 2 s before its receipt."""
    values = np.array([(START_NS // NS + n, n, n / 7, -n, n % 2)],
                      "<u4,<u4,<f8,<i4,u1").tobytes()  # fmt: skip
    word = f"word {n}".encode()
    return values + len(word).to_bytes(4, "little") + word


def exported(record: Record, folder: Path, form: str) -> list[Path]:
    target = folder / {"csv": "tables", "bag": "out.bag"}.get(form, "out.mcap")
    export(record, View(), target, form)
    return sorted(target.glob("*.csv")) if form == "csv" else [target]


def differing(one: Record, other: Record, item: str) -> list[str]:
    """Name the columns of an item that are not the same in both records."""
    first, second = comparable(one.query(item)), comparable(other.query(item))
    return sorted({c[0] for c in set(first) ^ set(second)} - {"parent_seq"})


@pytest.fixture
def dump(tmp_path: Path) -> Record:
    import_recordings([write_dump(tmp_path / "dump", 20)], tmp_path / "original")
    return amberbox.open(tmp_path / "original")


@pytest.mark.parametrize("form", ["mcap", "bag"])
def test_messages_that_were_exported_come_back_whole(
    dump: Record, tmp_path: Path, form: str
) -> None:
    import_recordings(exported(dump, tmp_path, form), tmp_path / "again")
    again = amberbox.open(tmp_path / "again")
    infos, others = ({i.name: i for i in r.items()} for r in (dump, again))
    assert infos.keys() == others.keys()
    for name in infos:
        if name.startswith("ros_"):
            assert differing(dump, again, name) == []
            assert infos[name].stamp_offset_s == others[name].stamp_offset_s


def test_tables_that_were_exported_come_back_with_their_values(
    dump: Record, tmp_path: Path
) -> None:
    import_recordings(exported(dump, tmp_path, "csv"), tmp_path / "again")
    again = amberbox.open(tmp_path / "again")
    for name in ("ros_ropod_odom", "ros_joy"):
        first, second = dump.query(name), again.query(name)
        assert first.names == second.names
        for field in first.fields:
            if field.type == "time" and field.name != "timestamp":
                continue  # times are texts in a table
            assert str(first.values(field.name)) == str(second.values(field.name))


def test_flat_columns_in_json_come_back_as_columns(dump: Record, tmp_path: Path) -> None:
    paths = exported(dump, tmp_path, "mcap-json")
    (report,) = import_recordings(paths, tmp_path / "again")
    again = amberbox.open(tmp_path / "again")
    assert report.kinds["ros_joy"] == "flat columns of an export"
    infos, others = ({i.name: i for i in r.items()} for r in (dump, again))
    for name in ("ros_ropod_odom", "ros_joy", "ros_ropod_laser_scan"):
        assert infos[name].stamp_offset_s == others[name].stamp_offset_s
        first, second = dump.query(name), again.query(name)
        for column in set(first.names) & set(second.names) - {"ranges"}:
            assert str(first.values(column)) == str(second.values(column)), column
        empty = {"intensities"}  # a list that is empty in every row is no column
        assert set(first.names) - set(second.names) <= empty
        assert set(second.names) <= set(first.names)
    ranges = np.concatenate(dump.query("ros_ropod_laser_scan").values("ranges"))
    found = np.concatenate(again.query("ros_ropod_laser_scan").values("ranges"))
    finite = np.isfinite(ranges)
    np.testing.assert_array_equal(ranges[finite], found[finite])
    assert np.isnan(found[~finite]).all()  # JSON has neither NaN nor infinities


def test_flat_columns_keep_stamps_that_no_variable_has(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "original")
    for n in range(10):
        box.hear(FLAT, flat(n))
        box.write()
    box.close()
    record = amberbox.open(tmp_path / "original")
    target = tmp_path / "some.mcap"
    export(record, View(variables={"ros_flat": ["x", "word", "on"]}), target, "mcap-json")
    import_recordings([target], tmp_path / "again")
    again = amberbox.open(tmp_path / "again")
    names = ["timestamp", "received", "x", "word", "on"]
    one, other = record.query("ros_flat", names), again.query("ros_flat", names)
    assert comparable(one) == comparable(other)
    assert again.query("ros_flat").names == ["timestamp", "x", "word", "on", "stamp"]


def test_rows_that_are_no_json_are_kept_and_told(tmp_path: Path) -> None:
    columns = {"timestamp": {"type": "object", "title": "time"}, "x": {"type": "number"}}
    schema = {"title": "odd", "type": "object", "properties": columns}
    rows = [b'{"timestamp": {"sec": 1, "nsec": 2}, "x": null}', b"{", b'{"x": 1}', b"[]"]
    marks = {"item": "odd", "source": "ros"}
    path = write_mcap(tmp_path / "odd.mcap", "json", rows, json.dumps(schema).encode(), marks)
    (report,) = import_recordings([path], tmp_path / "store")
    assert report.items == {"thing": 4}
    (damage,) = report.damage
    assert "3 rows are damaged and kept as 'malformed'" in damage
    table = amberbox.open(tmp_path / "store").query("thing")
    assert math.isnan(table.values("x")[0])
    assert table.values("malformed") == [None, b"{", b'{"x": 1}', b"[]"]


# -- MCAP files of others


def write_mcap(
    path: Path,
    encoding: str,
    messages: list[bytes],
    schema: bytes = b"",
    metadata: dict[str, str] | None = None,
    schema_encoding: str = "jsonschema",
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        number = writer.register_schema("own.Thing", schema_encoding, schema) if schema else 0
        channel = writer.register_channel("/thing", encoding, number, metadata or {})
        for n, message in enumerate(messages):
            writer.add_message(channel, START_NS + n * NS, message, START_NS + n * NS)
        writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped
    return path


@pytest.mark.parametrize(
    ("encoding", "schema", "schema_encoding"),
    [
        ("protobuf", b"\x0a\x05x.prot", "protobuf"),
        ("flatbuffer", b"\0\1", "flatbuffer"),
        ("own", b"", ""),
        ("cdr", b"struct X {};", "omgidl"),
        ("ros1", b"float64 x\nOther y\n", "ros1msg"),
    ],
)
def test_messages_that_have_no_columns_are_kept_with_a_note(
    tmp_path: Path, encoding: str, schema: bytes, schema_encoding: str
) -> None:
    messages = [bytes([n, 255 - n, 0]) for n in range(20)]
    path = write_mcap(
        tmp_path / "of_others.mcap", encoding, messages, schema, schema_encoding=schema_encoding
    )
    (report,) = import_recordings([path], tmp_path / "store")
    assert (report.messages, report.damage) == (20, [])
    assert any("ros_thing" in note and "raw messages are kept" in note for note in report.notes)
    assert raw_messages(tmp_path / "store", "/thing") == messages


@pytest.mark.parametrize(
    "schema",
    [b"", b'{"type": "object", "properties": {"x": {"type": "string"}}}', b"no schema at all"],
)
def test_json_of_others_counts_by_its_messages(tmp_path: Path, schema: bytes) -> None:
    rows: list[Any] = [{"x": n / 2, "who": {"name": f"n{n}"}, "list": [n]} for n in range(9)]
    messages = [json.dumps(row).encode() for row in rows]
    path = write_mcap(tmp_path / "of_others.mcap", "json", messages, schema)
    (report,) = import_recordings([path], tmp_path / "store")
    assert report.items == {"ros_thing": 9}
    table = amberbox.open(tmp_path / "store").query("ros_thing")
    assert table.names == ["timestamp", "x", "who_name", "list"]
    assert table.values("x") == [n / 2 for n in range(9)]
