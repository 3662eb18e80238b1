"""The condensed manifest: much smaller, on the same chain, with the same content."""

from __future__ import annotations

import json
from pathlib import Path

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import manifest_entries as entries
from amberbox.blackbox.store.manifest import condense
from amberbox.blackbox.store.manifest_entries import Tombstone, confirmed_record, to_record
from amberbox.core.types import Column

DATA = TableSchema("odom", "odom", (Column("x", "x", "float64"),), source="ros")
OWN = TableSchema(
    "amberbox_event", "e", (Column("kind", "kind", "string"),), topic="amberbox/event",
    source="amberbox",
)  # fmt: skip


def name(number: int) -> str:
    return f"journal/000001-00000000-{number:04d}.mcap"


def records_of(number: int) -> list[dict[str, object]]:
    part = entries.SegmentPart(name(number), "head", "main", 1, 10 * number, 10 * number + 9, 10,
                   100 * number, 100 * number + 90, 100 * number, 100 * number + 90)  # fmt: skip
    journal = mf.ManifestJournal(name(number), "head", "main", 1, 10 * number, 10 * number + 10,
                         100 * number, 100 * number + 90)  # fmt: skip
    segments = [
        entries.Segment(f"segments/{s.item}/{number}.parquet", s.item, s.id, 10, 99, "ab", (part,))
        for s in (DATA, OWN)
    ]
    return [*map(mf.segment_record, segments), mf.journal_record(journal)]


def stone(number: int) -> dict[str, object]:
    return to_record(
        Tombstone((name(number),), "both", "main", 1, 10 * number, 10 * number + 10,
                  100 * number, 100 * number + 90, f"link {number}", "for room", False, number)
    )  # fmt: skip


def filled(store: Path, count: int, deleted: int) -> None:
    mf.append(store, [mf.schema_record(DATA), mf.schema_record(OWN)])
    for number in range(count):
        mf.append(store, records_of(number))
    own = mf.read(store).segments["amberbox_event"]
    merged = entries.Segment("segments/amberbox_event/0+9.parquet", "amberbox_event", OWN.id,
                        10 * count, 99, "cd", tuple(s.parts[0] for s in own))  # fmt: skip
    mf.append(store, [mf.segment_record(merged, [s.path for s in own])])
    mf.append(store, [confirmed_record((name(0), name(count - 1)), "server", 1)])
    for number in range(deleted):
        mf.append(store, [stone(number)])


def test_it_says_the_same_in_fewer_lines_on_the_same_chain(tmp_path: Path) -> None:
    filled(tmp_path, 30, 28)
    before, size = mf.read(tmp_path), (tmp_path / mf.NAME).stat().st_size
    assert condense(tmp_path, lambda n: n >= name(28), lambda head: {"kind": "signed?"}, 1000)
    after = mf.read(tmp_path)
    first, second = [json.loads(t) for t in (tmp_path / mf.NAME).read_text().splitlines()[:2]]
    assert (first["kind"], first["prev"], second["kind"]) == (
        "checkpoint", before.last_hash, "signed?",
    )  # fmt: skip
    assert (tmp_path / mf.NAME).stat().st_size < size / 3
    assert not after.damage
    assert after.segments["odom"] == before.segments["odom"]
    assert after.journals == before.journals
    assert after.confirmed == {name(29)}
    (joined,) = after.tombstones
    assert (joined.first_seq, joined.end_seq, joined.journals) == (0, 280, (name(0), name(27)))
    assert joined.chain == "link 27"
    (own,) = after.segments["amberbox_event"]
    assert [(p.first_seq, p.last_seq, p.rows) for p in own.parts] == [
        (0, 279, 280), (280, 289, 10), (290, 299, 10),
    ]  # fmt: skip


def test_deletion_goes_on_after_it(tmp_path: Path) -> None:
    filled(tmp_path, 30, 28)
    condense(tmp_path, lambda n: n >= name(28), lambda head: None, 1000)
    mf.append(tmp_path, [stone(28)])
    known = mf.read(tmp_path)
    assert [s.path for s in known.segments["odom"]] == ["segments/odom/29.parquet"]
    assert known.gone_segments == {"segments/odom/28.parquet"}
    assert len(known.segments["amberbox_event"]) == 1


def test_a_manifest_that_is_small_or_all_needed_stays(tmp_path: Path) -> None:
    filled(tmp_path, 10, 0)
    assert not condense(tmp_path, lambda n: True, lambda head: None)
    assert not condense(tmp_path, lambda n: True, lambda head: None, 1000)
