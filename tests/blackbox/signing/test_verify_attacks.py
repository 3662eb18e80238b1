"""Changes to a store are reported by file, chunk and time, with the right state."""

from __future__ import annotations

import random
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import zstandard

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.chunk import decompress
from amberbox.blackbox.signing import manifest_check as signed_module
from amberbox.blackbox.signing import verify as verify_module
from amberbox.blackbox.signing.journal_check import check_journal, check_target
from amberbox.blackbox.signing.keys import open_keys, public_key
from amberbox.blackbox.signing.signatures import HEADS, parse_heads, sign_manifest, write_heads
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import manifest_lines
from amberbox.blackbox.store.manifest_entries import Tombstone, to_record
from amberbox.blackbox.store.store import open_store
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.testing.clock import ManualClock
from tests.blackbox.signing.conftest import Robot, keep, record


def test_a_store_as_it_was_left_is_intact_with_an_unsigned_end(robot: Robot) -> None:
    report = robot.verify()
    assert report.is_good() and report.signed
    assert [(f.state, f.file) for f in report.findings] == [("unsigned", robot.journals(3)[0])]
    assert "ends unsigned at" in report.findings[0].text
    assert not report.is_good(strict=True)
    keep(robot.path)
    assert robot.verify().findings == []


@pytest.mark.parametrize("run", [1, 3])
def test_one_flipped_bit_of_a_journal_is_damage_wherever_it_is(robot: Robot, run: int) -> None:
    rng = random.Random(run)
    name = robot.journals(run)[0]
    bits = [rng.randrange((robot.path / name).stat().st_size * 8) for _ in range(40)]
    for bit in bits:
        robot.flip(name, bit)
        found = robot.bad()
        assert {(f.state, f.file) for f in found} == {("damaged", name)}, bit
        robot.flip(name, bit)
    assert robot.bad() == []


def test_a_start_record_that_cannot_be_read_is_damage(robot: Robot) -> None:
    for name in (robot.journals(1)[0], robot.journals(3)[1]):
        robot.flip(name, 67 * 8 + 7)  # no text any more
        assert robot.states() == [("damaged", name)]
        assert "the messages themselves are proven" in robot.bad()[0].text
        robot.flip(name, 67 * 8 + 7)


def test_damage_names_chunk_and_time(robot: Robot) -> None:
    name = robot.journals(1)[1]
    chunk = robot.chunks(name)[5]
    robot.flip(name, (chunk.data_offset + 20) * 8)
    (found,) = robot.bad()
    assert found.state == "damaged" and found.chunk == chunk.offset
    assert found.from_ns is not None and found.to_ns is not None
    assert found.from_ns <= chunk.start_ns <= chunk.end_ns <= found.to_ns
    assert found.to_ns - found.from_ns <= 300_000_000


def test_a_value_with_its_checksum_repaired_is_altered(robot: Robot) -> None:
    for run in (1, 3):
        name = robot.journals(run)[0]
        chunk = robot.chunks(name)[3]
        robot.forge(name, chunk)
        found = [f for f in robot.bad() if f.file == name]
        assert [f.state for f in found] == ["altered"]
        assert found[0].chunk is not None and found[0].chunk <= chunk.offset
        assert found[0].from_byte is not None and found[0].to_byte is not None
        assert found[0].from_byte <= chunk.offset < found[0].to_byte
        assert found[0].from_ns is not None and found[0].to_ns is not None
        assert found[0].from_ns <= chunk.start_ns <= found[0].to_ns


def test_a_forged_chunk_behind_the_last_link_is_altered_once_it_was_sealed(robot: Robot) -> None:
    keep(robot.path)
    name = robot.journals(3)[-1]
    robot.forge(name, robot.chunks(name)[-1])
    assert robot.states() == [("altered", name)]


def test_a_dropped_journal_is_missing(robot: Robot) -> None:
    name = robot.journals(1)[1]
    (robot.path / name).unlink()
    (found,) = robot.bad()
    assert (found.state, found.file) == ("missing", name)
    assert found.from_ns is not None and found.to_ns is not None


def test_a_dropped_file_that_was_never_sealed_is_missing(robot: Robot) -> None:
    first, *_ = robot.journals(3)
    (robot.path / first).unlink()
    (found,) = robot.bad()
    assert found.state == "missing" and "000003" in found.file


def test_a_dropped_run_that_was_never_sealed_is_missing(robot: Robot) -> None:

    record(robot.path, ManualClock(), 5)
    for name in robot.journals(3):
        (robot.path / name).unlink()
    (found,) = robot.bad()
    assert (found.state, found.file) == ("missing", robot.journals(4)[0])


def test_swapped_files_are_named_both(robot: Robot) -> None:
    one, other = robot.journals(1)[0], robot.journals(2)[1]
    _swap(robot.path / one, robot.path / other)
    found = robot.bad()
    assert sorted(f.file for f in found if f.state == "missing") == [one, other]
    assert "under its name lies" in found[0].text


def test_a_journal_of_another_store_is_altered(robot: Robot, tmp_path: Path) -> None:

    record(tmp_path / "other", ManualClock())
    name = robot.journals(3)[0]
    foreign = sorted((tmp_path / "other/journal").glob("*.mcap"))[0]
    shutil.copy(foreign, robot.path / name)
    assert ("altered", name) in robot.states()


@pytest.mark.parametrize("kept", [0.999, 0.7, 0.2, 0.0])
def test_a_cut_of_a_sealed_file_is_missing_its_end(robot: Robot, kept: float) -> None:
    name = robot.journals(2)[0]
    robot.change(name, lambda c: c.__delitem__(slice(int(len(c) * kept), None)))
    states = robot.states()
    assert ("missing", name) in states
    assert all(file == name for _, file in states)


def test_bytes_behind_the_end_are_altered(robot: Robot) -> None:
    name = robot.journals(2)[0]
    robot.change(name, lambda c: c.extend(b"\0" * 100))
    assert robot.states() == [("altered", name)]


def test_a_chunk_taken_out_is_missing(robot: Robot) -> None:
    for name in (robot.journals(1)[0], robot.journals(3)[0]):
        start, end = (chunk.offset for chunk in robot.chunks(name)[2:4])
        robot.change(name, partial(_take_out, start, end))
        found = [f for f in robot.bad() if f.file == name and f.state == "missing"]
        assert any("taken out" in finding.text for finding in found)


def _take_out(start: int, end: int, content: bytearray) -> None:
    del content[start:end]


def test_a_value_that_made_its_chunk_longer_is_altered(robot: Robot) -> None:
    name = robot.journals(3)[0]
    chunk = robot.chunks(name)[3]
    content = (robot.path / name).read_bytes()
    body = decompress(chunk, content)
    assert body is not None
    record = mcap.chunk_record(
        chunk.start_ns, chunk.end_ns, len(body), chunk.crc, "zstd",
        zstandard.ZstdCompressor(level=1, write_checksum=True).compress(body),
    )  # fmt: skip
    end = chunk.offset + chunk.length
    (robot.path / name).write_bytes(content[: chunk.offset] + record + content[end:])
    (found,) = robot.bad()
    assert (found.state, found.file) == ("altered", name)
    assert "longer" in found.text


def test_swapped_chunks_are_altered(robot: Robot) -> None:
    name = robot.journals(1)[0]
    one, two, three = (chunk.offset for chunk in robot.chunks(name)[2:5])

    def swap(content: bytearray) -> None:
        content[one:three] = content[two:three] + content[one:two]

    robot.change(name, swap)
    assert robot.states() == [("altered", name)]


def test_a_chain_made_anew_is_altered_where_it_was_sealed(robot: Robot) -> None:
    """An attacker records the file again, with a valid chain, but has no key."""

    name = robot.journals(2)[0]
    _record_anew(robot, name)
    assert robot.states() == [("altered", name)]


def _record_anew(robot: Robot, name: str) -> None:
    other = robot.path.parent / "forged"
    other.mkdir()
    shutil.copy(robot.path / "store.json", other / "store.json")
    (other / "run").write_text("1")
    record(other, ManualClock(wall=1_700_000_100 * 10**9))
    shutil.copy(other / name, robot.path / name)


# -- the manifest


def test_a_flipped_bit_of_the_manifest_is_damage(robot: Robot) -> None:
    rng = random.Random(3)
    size = (robot.path / mf.NAME).stat().st_size
    for bit in [rng.randrange(size * 8) for _ in range(8)]:
        robot.flip(mf.NAME, bit)
        assert robot.states() == [("damaged", mf.NAME)], bit
        robot.flip(mf.NAME, bit)


def _manifest_lines(robot: Robot) -> list[bytes]:
    return (robot.path / mf.NAME).read_bytes().splitlines(keepends=True)


def _write_lines(robot: Robot, content: list[bytes]) -> None:
    (robot.path / mf.NAME).write_bytes(b"".join(content))


def test_a_line_dropped_from_the_manifest_is_missing(robot: Robot) -> None:
    content = _manifest_lines(robot)
    del content[4]
    _write_lines(robot, content)
    assert ("missing", mf.NAME) in robot.states()


def test_swapped_lines_of_the_manifest_are_altered(robot: Robot) -> None:
    content = _manifest_lines(robot)
    content[4], content[5] = content[5], content[4]
    _write_lines(robot, content)
    assert robot.states() == [("altered", mf.NAME)]


def test_a_changed_line_is_altered(robot: Robot) -> None:
    content = _manifest_lines(robot)
    content[0] = content[0].replace(b"journal/", b"jOUrnal/")
    _write_lines(robot, content)
    assert ("altered", mf.NAME) in robot.states()


def test_a_manifest_chained_anew_without_the_key_is_altered(robot: Robot) -> None:
    records = [manifest_lines.decode(line.rstrip(b"\n")) for line in _manifest_lines(robot)]
    plain = [{k: v for k, v in r.items() if k not in ("hash", "prev")} for r in records if r]
    plain[0]["entry"]["end_seq"] += 1
    (robot.path / mf.NAME).write_bytes(manifest_lines.encode(plain, manifest_lines.FIRST_HASH))
    found = robot.states()
    assert ("missing", mf.NAME) in found  # the line that heads.json names
    report = robot.verify()
    assert not report.signed  # and no signature is about any line that is there


def test_a_cut_manifest_is_missing_its_end(robot: Robot) -> None:
    _write_lines(robot, _manifest_lines(robot)[:6])
    assert ("missing", mf.NAME) in robot.states()


def test_a_forged_signature_is_altered(robot: Robot) -> None:
    records = [manifest_lines.decode(line.rstrip(b"\n")) for line in _manifest_lines(robot)]
    plain = [{k: v for k, v in r.items() if k not in ("hash", "prev")} for r in records if r]
    last = plain[-1]["entry"]
    last["signature"] = ("11" if last["signature"].startswith("00") else "00") + last["signature"][
        2:
    ]
    (robot.path / mf.NAME).write_bytes(manifest_lines.encode(plain, manifest_lines.FIRST_HASH))
    assert ("altered", mf.NAME) in robot.states()


# -- the columns


def test_columns_that_were_flipped_dropped_swapped_or_cut_are_named(robot: Robot) -> None:
    one, two, three, four = robot.segments()[:4]
    robot.flip(one, ((robot.path / one).stat().st_size // 3) * 8)
    _swap(robot.path / two, robot.path / three)
    robot.change(four, lambda c: c.__delitem__(slice(len(c) - 10, None)))
    states = {f.file: f for f in robot.bad()}
    assert states[one].state == "damaged" and states[one].item == one.split("/")[1]
    assert states[two].state == states[three].state == "missing"
    assert three in states[two].text
    assert "cut off" in states[four].text
    (robot.path / one).unlink()
    assert ("missing", one) in robot.states()


def test_columns_written_anew_are_altered(robot: Robot) -> None:
    import pyarrow.parquet as pq

    name = next(n for n in robot.segments() if "ros_count" in n)
    path = robot.path / name
    table = pq.read_table(path)
    changed = table.slice(0, 1).to_pydict()
    key = "data"
    values = [changed[key][0] + 1, *table[key].to_pylist()[1:]]
    place = table.schema.get_field_index(key)
    pq.write_table(table.set_column(place, table.schema.field(key), [values]), path)
    (found,) = robot.bad()
    assert found.file == name and found.state in ("altered", "missing")
    assert found.from_ns is not None


def test_columns_stay_verifiable_after_the_raw_journal_is_gone(robot: Robot) -> None:

    name = robot.journals(1)[0]
    entry = mf.read(robot.path).sealed[name]
    stone = Tombstone((name,), "raw", "main", entry.run, entry.first_seq, entry.end_seq,
                      entry.start_ns, entry.end_ns, entry.chain, "room", False, 0)  # fmt: skip
    mf.append(robot.path, [to_record(stone)])
    (robot.path / name).unlink()
    store = open_store(robot.path)
    sign_manifest(store, open_keys(store).key)
    assert robot.bad() == []
    segment = next(n for n in robot.segments() if "ros_count" in n)
    robot.flip(segment, 8 * 100)
    assert robot.states() == [("damaged", segment)]


# -- heads and keys


def test_without_a_later_head_a_dropped_end_is_not_seen_with_it_it_is_named(robot: Robot) -> None:
    keep(robot.path)
    noted = (robot.path / HEADS).read_text()
    head = next(h.hash for h in robot.verify().heads if h.what == "main")
    assert robot.bad(noted, head, head[:16]) == []
    before = _manifest_lines(robot)
    sealed = next(n for n, line in enumerate(before) if b"journal/000003" in line)
    _write_lines(robot, before[:sealed])
    for name in robot.journals(3):
        (robot.path / name).unlink()
    for path in robot.path.glob("segments/*/000003*"):
        path.unlink()
    (robot.path / HEADS).unlink()
    shutil.rmtree(robot.path / "keep", ignore_errors=True)
    assert robot.bad() == [], "the cut is clean: nothing but a later head can tell"
    states = robot.states(noted)
    assert ("missing", mf.NAME) in states
    assert any(s == "missing" and "000003" in file for s, file in states)
    (found,) = robot.bad(head)
    assert found.state == "missing"


def test_a_head_that_is_forged_foreign_or_none_is_refused(robot: Robot) -> None:
    heads = parse_heads((robot.path / HEADS).read_bytes())
    assert heads is not None and heads.holds()
    forged = heads.to_json().replace(heads.manifest, "0" * 63 + "1")
    with pytest.raises(AmberboxError, match="signature of the head"):
        robot.verify(forged)
    with pytest.raises(AmberboxError, match="another store"):
        robot.verify(heads.to_json().replace(heads.store_id, "somewhere"))
    with pytest.raises(UsageError, match="no head"):
        robot.verify("3f2a")


def test_a_statement_that_was_changed_is_altered(robot: Robot) -> None:
    heads = parse_heads((robot.path / HEADS).read_bytes())
    assert heads is not None
    (robot.path / HEADS).write_text(heads.to_json().replace(heads.manifest, "0" * 64))
    assert robot.states() == [("altered", HEADS)]
    (robot.path / HEADS).write_text(heads.to_json())
    robot.flip(HEADS, 8 * 200)
    assert robot.states() == [("damaged", HEADS)]


def test_whoever_signs_with_another_key_is_found_out_by_the_key_noted(robot: Robot) -> None:

    noted = public_key(robot.path)
    assert noted is not None and robot.verify(key=noted).is_good()
    (robot.path / "key").unlink()
    (robot.path / "key.pub").unlink()
    store = open_store(robot.path)
    key = open_keys(store).key
    sign_manifest(store, key, again=True)
    write_heads(store, key)
    assert robot.verify().is_good()
    states = {(f.state, f.file) for f in robot.verify(key=noted).findings}
    assert ("altered", mf.NAME) in states


def test_without_the_library_hashes_are_checked_and_signatures_are_not(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (signed_module, verify_module):
        monkeypatch.setattr(module, "can_sign", lambda: False)
    noted = (robot.path / HEADS).read_text()
    report = robot.verify(noted)
    assert report.is_good() and not report.signed
    assert any("signatures are not checked" in note for note in report.notes)
    name = robot.journals(1)[0]
    robot.forge(name, robot.chunks(name)[3])
    assert robot.states() == [("altered", name)]


def test_a_flipped_bit_of_key_pub_is_damage(robot: Robot) -> None:
    robot.flip("key.pub", 60 * 8)
    assert robot.states() == [("damaged", "key.pub")]


def _swap(one: Path, other: Path) -> None:
    aside = one.with_suffix(".aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


def test_a_line_that_seals_a_file_again_is_altered(robot: Robot) -> None:
    name = robot.journals(2)[0]
    _record_anew(robot, name)
    checked = check_journal(check_target(open_store(robot.path), robot.path / name))
    seal = replace(mf.read(robot.path).sealed[name], bytes=checked.size, chain=checked.chain)
    seal = replace(seal, tail_from=checked.tail_from, tail=checked.tail)
    mf.append(robot.path, [to_record(seal)])
    assert robot.states() == [("altered", name), ("altered", mf.NAME)]
    keep(robot.path)  # the robot signs what it finds: the first seal still counts
    assert ("altered", name) in robot.states()
