"""What lines of the manifest claim, and what became of incidents, is checked against each other."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

from amberbox.blackbox.retention.pins import PinRequest, pin, release
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.keys import open_keys
from amberbox.blackbox.signing.signatures import HEADS, signature_record, write_heads
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import manifest_lines
from amberbox.blackbox.store.incident import StoredIncident
from amberbox.blackbox.store.manifest import live_records
from amberbox.blackbox.store.manifest_entries import Tombstone, to_record
from amberbox.blackbox.store.store import open_store
from amberbox.core.source import TopicOptions
from tests.blackbox.signing.conftest import Robot, keep
from tests.support.manual_recorder import COUNT, ManualBox, number


def test_what_only_unsigned_lines_say_of_files_is_named(robot: Robot) -> None:
    keep(robot.path)
    name, head = robot.journals(1)[0], (robot.path / HEADS).read_text()
    seal = mf.read(robot.path).sealed[name]
    about = (seal.writer, seal.run, seal.first_seq, seal.end_seq, seal.start_ns, seal.end_ns)
    stone = Tombstone((name,), "raw", *about, seal.chain, "age", False, seal.end_ns)
    (segment, *_) = (s for found in mf.read(robot.path).segments.values() for s in found)
    robot.change(segment.path, lambda c: c.append(0))
    content = (robot.path / segment.path).read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    forged = replace(segment, bytes=len(content), sha256=digest)
    mf.append(robot.path, [to_record(stone), mf.segment_record(forged)])
    (robot.path / name).unlink()
    report = robot.verify(head)
    assert not report.is_good(strict=True)
    named = {f.file for f in report.findings if "which is not signed" in f.text}
    assert named == {name, segment.path}


def test_a_condensed_manifest_that_was_cut_is_missing_its_end(robot: Robot) -> None:
    store = open_store(robot.path)
    known, key = mf.read(robot.path), open_keys(store).key
    signed = signature_record(store, key, known.last_hash)
    first = {"kind": manifest_lines.CHECKPOINT, "columns_gone": [], "damage": []}
    before = (robot.path / HEADS).read_text()
    records = [first, *([signed] if signed else []), *live_records(known, lambda name: True)]
    mf.rewrite(robot.path, records, known.last_hash)
    assert robot.bad() == [] and robot.bad(before) == []
    write_heads(store, key)
    head = (robot.path / HEADS).read_text()
    content = (robot.path / mf.NAME).read_bytes().splitlines(keepends=True)
    (robot.path / mf.NAME).write_bytes(b"".join(content[:-4]))
    assert ("missing", mf.NAME) in robot.states()
    (robot.path / HEADS).unlink()
    assert ("unsigned", HEADS) in {(f.state, f.file) for f in robot.verify().findings}
    report = robot.verify(head)
    assert ("missing", mf.NAME) in {(f.state, f.file) for f in report.findings}
    assert not any("everything up to it is as it was" in note for note in report.notes)


# -- incidents


def test_incidents_that_were_changed_damaged_or_dropped_are_named(robot: Robot) -> None:
    made = pin(open_store(robot.path), PinRequest(3, 0, "bump", "me"), RetentionOptions())
    assert isinstance(made, StoredIncident)
    name = f"incidents/{made.id}/incident.json"
    assert [f.file for f in robot.verify().findings if "speaks of it yet" in f.text] == [name]
    keep(robot.path)
    assert robot.verify().findings == []
    content = (robot.path / name).read_bytes()
    (robot.path / name).write_bytes(content.replace(b'"me"', b'"yo"'))
    assert robot.states() == [("altered", name)]
    (robot.path / name).write_bytes(content.replace(b'"told": "complete"', b'"told": ""'))
    assert robot.bad() == [] and [f.file for f in robot.verify().findings] == [name]
    (robot.path / name).write_bytes(content[1:])
    assert robot.states() == [("damaged", name)]
    shutil.rmtree((robot.path / name).parent)
    assert robot.states() == [("missing", name)]


def test_a_copy_of_the_ring_that_is_gone_is_missing_until_it_is_released(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", [TopicOptions("/count", keep="ring")])
    for n in range(20):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    robot, store = Robot(box.store), open_store(box.store)
    made = pin(store, PinRequest(1, 0), RetentionOptions())
    assert isinstance(made, StoredIncident)
    keep(robot.path)
    assert robot.bad() == []
    (copy,) = (robot.path / "incidents" / made.id / "ring").glob("*.mcap")
    copy.unlink()
    assert robot.states() == [("missing", str(copy.relative_to(robot.path)))]
    release(store, made)
    assert robot.bad() == []
