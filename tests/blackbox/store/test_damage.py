"""Damage of derived files costs only time, is reported, and verify names it."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import amberbox
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.retention.pins import PinRequest, pin
from amberbox.blackbox.robot_folder.robot_yaml import Lifetime, RetentionOptions
from amberbox.blackbox.signing.verify import verify
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import manifest_lines
from amberbox.blackbox.store.incident import load_all
from amberbox.blackbox.store.store import IDENTITY, create_store, open_store, request_event
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Gap, Topic
from amberbox.testing.clock import ManualClock
from tests.fuzzing import examples, fuzz
from tests.support.manual_recorder import COUNT, ManualBox, events, number

pytest.importorskip("cryptography", reason="signatures need it; pip install 'amberbox[keep]'")
pytest.importorskip("pyarrow", reason="segments are Parquet files; pip install 'amberbox[keep]'")

RING = Topic("/ring", COUNT.message_encoding, COUNT.schema)
DAY_S = 86_400.0
_SHOWN = ("data", "received", "seq")
KEEP = RetentionOptions(quota=10**9, min_free=0, ring_s=9e9)
LATER = 100_000
"""Numbers from here on are received after the damage."""


def record(store: Path, clock: ManualClock, first: int, *, crash: bool = False) -> None:
    """Record a run of numbered messages in two files, half of them in the ring."""
    options = PipelineOptions(boot_id=clock.boot_id(), rotate_ns=2 * NS, ring_rotate_ns=2 * NS)
    box = ManualBox(store, [TopicOptions("/ring", keep="ring")], clock=clock, options=options)
    for write in range(25):
        for topic in (COUNT, RING):
            box.hear(topic, number(first + 2 * write), number(first + 2 * write + 1))
        box.write()
    for mark in box.pipeline.mark_sync():
        mark.wait()
    box.crash() if crash else box.close()


def keep(store: Path, clock: ManualClock, options: RetentionOptions = KEEP) -> None:
    keeper = RetentionService(open_store(store), options, clock=clock)
    keeper.step(threading.Event())
    keeper.close()


@dataclass(frozen=True)
class Answers:
    """The answers of a store: rows of each item by number, missing data, events."""

    rows: Mapping[str, frozenset[tuple[int, ...]]]
    gaps: list[Gap]
    kinds: list[str]
    notes: list[str]


def answers(store: Path) -> Answers:
    opened = amberbox.open(store)
    rows, notes = {}, list(opened.notes)
    for info in opened.items():
        if info.name.startswith("ros_"):
            table = opened.query(info.name, _SHOWN)
            found = (tuple(int(row[name]) for name in _SHOWN) for row in table.rows())
            rows[info.name] = frozenset(row for row in found if row[0] < LATER)
            notes += table.notes
    kinds = [row["kind"] for row in opened.events().rows()]
    return Answers(rows, opened.gaps(), kinds, notes)


def clock_after() -> ManualClock:
    clock = ManualClock()
    clock.advance(40 * DAY_S)
    return clock


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs without columns and raw, without raw, with an incident, and one cut by a crash."""
    store, clock = tmp_path_factory.mktemp("damage") / "store", ManualClock()
    for first in (0, 1000):
        record(store, clock, first)
        keep(store, clock)
        clock.advance(10 * DAY_S)
    record(store, clock, 2000)
    pin(open_store(store), PinRequest(2.0, 0.0, "looked odd"), KEEP)
    lifetime = Lifetime(raw_s=5 * DAY_S, columns_s=15 * DAY_S)
    old = RetentionOptions(quota=10**9, min_free=0, keep_min_s=0, ring_s=9e9, lifetime=lifetime)
    keep(store, clock, old)
    record(store, clock, 3000, crash=True)
    request_event(open_store(store), "note", "said by somebody", "test")
    return store


@pytest.fixture(scope="module")
def before(whole: Path) -> Answers:
    found = answers(whole)
    assert found.rows["ros_count"] and len(found.gaps) == 1, "the first run was deleted"
    assert not found.notes
    return found


@pytest.fixture
def store(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "store"))


def content_of(store: Path) -> dict[str, bytes]:
    files = (path for path in store.rglob("*") if path.is_file())
    return {path.relative_to(store).as_posix(): path.read_bytes() for path in files}


def named(store: Path) -> set[str]:
    """Return the files in the findings of verify."""
    report = verify(store)
    return {finding.file for finding in report.findings} | report.uncovered.keys()


def restart(store: Path) -> None:
    """Record and keep once more."""
    record(store, clock_after(), LATER)
    keep(store, clock_after())


def change(path: Path, how: Callable[[bytearray], object]) -> None:
    content = bytearray(path.read_bytes())
    how(content)
    path.write_bytes(content)


def spoil(path: Path, mark: bytes) -> int:
    """Damage all lines with a mark beyond repair; return how many there were."""
    found = path.read_bytes().split(b"\n")
    hit = [line for line in found if mark in line]
    path.write_bytes(b"\n".join(b"#" * len(n) if mark in n else n for n in found))
    return len(hit)


_DERIVED = ("manifest", "heads.json", IDENTITY, "names.json", "head", "run", "room", "key",
            "key.pub", "incident.json")  # fmt: skip


@fuzz
@settings(
    max_examples=examples(6),
    phases=[Phase.generate],  # each takes a second: what fails is short enough as it is
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(data=st.data())
def test_whatever_is_damaged_nothing_raises_or_is_invented(
    whole: Path, before: Answers, tmp_path: Path, data: st.DataObject
) -> None:
    shutil.rmtree(tmp_path / "store", ignore_errors=True)
    store = Path(shutil.copytree(whole, tmp_path / "store"))
    files = content_of(store)
    kinds = sorted({name.partition("/")[0] for name in files if not name.startswith("lock")})
    kind = data.draw(st.sampled_from([*kinds, "manifest", "manifest"]))
    name = data.draw(st.sampled_from(sorted(n for n in files if n.partition("/")[0] == kind)))
    damaged(store / name, data)
    left = content_of(store)
    if left == files:
        return
    now = answers(store)
    assert content_of(store) == left, "who reads does not write"
    for item, rows in before.rows.items():
        assert now.rows.get(item, frozenset()) <= rows, "a row was invented"
        if Path(name).name in _DERIVED:
            assert now.rows.get(item) == rows, "damage of a derived file cost rows"
        elif kind == "segments" and now.rows.get(item) != rows:
            assert any(name in note for note in now.notes), "lost, and nothing is said"
    assert name in named(store) or not (kind in _NAMED or name.endswith("/head"))
    restart(store)
    again = answers(store)
    for item, rows in before.rows.items():
        assert again.rows.get(item, frozenset()) <= rows
        if Path(name).name in _DERIVED:
            assert again.rows.get(item) == rows, "a restart lost rows"
    verify(store)


_NAMED = ("manifest", "segments", "heads.json", IDENTITY, "names.json", "key.pub")
"""Files that verify names in any case; damage of others may show elsewhere."""


def damaged(path: Path, data: st.DataObject) -> None:
    """Flip a bit, cut the end, zero a piece, or remove a file."""
    content = bytearray(path.read_bytes())
    way = data.draw(st.sampled_from(["flip", "flip", "flip", "cut", "zero", "remove"]))
    place = data.draw(st.integers(0, max(len(content) - 1, 0)))
    if way == "remove" or not content:
        path.unlink()
        return
    if way == "flip":
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    elif way == "cut":
        del content[place:]
    else:
        end = min(place + data.draw(st.integers(1, 4096)), len(content))
        content[place:end] = bytes(end - place)
    path.write_bytes(content)


@pytest.mark.parametrize("kind", ["schema", "segment", "journal", "sealed", "gone"])
def test_lost_lines_of_the_manifest_are_made_up_for(
    store: Path, before: Answers, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert spoil(store / mf.NAME, b'"kind":"%s"' % kind.encode())
    left = content_of(store)
    now = answers(store)
    assert now.rows == before.rows
    assert content_of(store) == left
    assert any(mf.NAME in note for note in now.notes)
    assert main(["items", str(store)]) == 0
    assert "manifest is damaged" in capsys.readouterr().err
    assert mf.NAME in {finding.file for finding in verify(store).findings}
    keep(store, clock_after())
    assert [e for e in events(store, "restored") if mf.NAME in e["text"] or "line" in e["text"]]
    kept = answers(store)
    assert kept.rows == before.rows
    assert not mf.read(store).open_damage
    for gap in before.gaps:  # what was deleted stays a gap, whatever its reason is now
        for found in (now, kept):
            assert any(g.from_ns < gap.to_ns and g.to_ns > gap.from_ns for g in found.gaps)
    keep(store, clock_after())
    assert len(events(store, "restored")) == 1, "it is told once"


def test_a_flipped_bit_of_the_manifest_is_undone_by_the_keeper(store: Path) -> None:
    path = store / mf.NAME
    was = path.read_bytes()
    newline = was.index(b"\n")
    for place in (newline, newline + 30, newline + 300):
        change(path, lambda c, p=place: c.__setitem__(p, c[p] ^ 4))  # type: ignore[misc]  # a lambda for one statement
        assert mf.read(store).mended
        keep(store, clock_after())
        assert path.read_bytes().startswith(was)
        assert not mf.read(store).mended


def test_without_a_manifest_segments_and_journals_tell(store: Path, before: Answers) -> None:
    (store / mf.NAME).unlink()
    assert answers(store).rows == before.rows
    restart(store)
    assert answers(store).rows == before.rows
    assert not amberbox.open(store).notes


def segments_of(store: Path, item: str, *, with_raw: bool) -> list[Path]:
    found = mf.read(store).segments[item]
    chosen = [s for s in found if all((store / p.journal).exists() for p in s.parts) == with_raw]
    assert chosen
    return [store / segment.path for segment in chosen]


def test_a_lost_segment_is_read_and_built_again_from_its_journal(
    store: Path, before: Answers
) -> None:
    record(store, clock_after(), LATER)
    keep(store, clock_after())
    paths = segments_of(store, "ros_count", with_raw=True)
    for path in paths:
        path.unlink()
    assert answers(store).rows == before.rows
    for _ in range(2):
        keep(store, clock_after())
    assert all(path.exists() for path in paths)
    assert not [f for f in verify(store).findings if f.state == "missing"]
    assert len(events(store, "restored")) == 1


def test_lost_columns_whose_raw_is_gone_are_gaps(store: Path, before: Answers) -> None:
    path = segments_of(store, "ros_count", with_raw=False)[0]
    path.unlink()
    now = answers(store)
    lost = before.rows["ros_count"] - now.rows["ros_count"]
    told = [gap for gap in now.gaps if gap.item == "ros_count"]
    assert {gap.reason for gap in told} == {f"{path.relative_to(store)} is gone"}
    assert lost
    assert all(any(g.from_ns <= row[1] < g.to_ns for g in told) for row in lost)
    opened = amberbox.open(store)
    counted = opened.sql("select count(*) as n from ros_count")
    assert int(counted.columns["n"][0]) == len(before.rows["ros_count"]) - len(lost)
    assert any("rows are lost" in note for note in counted.notes)


def test_sql_reads_no_page_that_was_changed(store: Path) -> None:
    path = segments_of(store, "ros_count", with_raw=False)[0]
    asked = "select data from ros_count"
    known = {row["data"] for row in amberbox.open(store).sql(asked).rows()}
    for place in range(20, 600, 97):
        was = path.read_bytes()
        change(path, lambda c, p=place: c.__setitem__(p, c[p] ^ 16))  # type: ignore[misc]  # a lambda for one statement
        found = amberbox.open(store).sql(asked)
        assert {row["data"] for row in found.rows()} < known
        assert found.notes
        path.write_bytes(was)


_GARBAGE = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["path", "item", "parts", "id", "journals"]), inner)
    ),
    max_leaves=6,
)
_KEYS = ("segment", "schema", "id", "entry", "journals", "incident", "names", "replaces",
         "columns_gone", "damage", "undone", "gone", "journal", "gaps")  # fmt: skip
_KINDS = ("segment", "schema", "journal", "confirmed", "incident", "names", "restored",
          "checkpoint", "sealed", "gone", "signed", "new")  # fmt: skip


@fuzz
@settings(
    max_examples=examples(60),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(kind=st.sampled_from(_KINDS), fields=st.dictionaries(st.sampled_from(_KEYS), _GARBAGE))
def test_lines_that_hold_and_say_nonsense_are_named(
    tmp_path: Path, kind: str, fields: dict[str, Any]
) -> None:
    (tmp_path / mf.NAME).unlink(missing_ok=True)
    mf.append(tmp_path, [{"kind": kind, **fields}, mf.names_record({"ros a": "ros_a"})])
    known = mf.read(tmp_path)
    assert known.names["ros a"] == "ros_a"
    assert all(text.endswith(manifest_lines.NONSENSE) for text in known.damage)


@pytest.mark.parametrize("path", ["../outside", "/etc/hosts", "segments/../../x", ""])
def test_no_line_of_the_manifest_leads_out_of_the_store(
    store: Path, path: str, tmp_path: Path
) -> None:
    outside = tmp_path / "outside"
    outside.write_text("not ours")
    known = mf.read(store)
    line = json.loads(json.dumps(mf.segment_record(next(iter(known.segments.values()))[0])))
    line["segment"]["path"] = path
    stone = {"kind": "gone", "entry": {**_stone(known), "journals": [path]}}
    mf.append(store, [line, stone])
    assert len(mf.read(store).damage) == 2
    keep(store, clock_after())
    assert outside.read_text() == "not ours"


def _stone(known: mf.Manifest) -> dict[str, Any]:
    stone = known.tombstones[0]
    return {name: getattr(stone, name) for name in stone.__slots__}


@pytest.mark.parametrize("damage", ["flip", "empty", "remove"])
def test_the_identity_is_what_the_journals_state(store: Path, before: Answers, damage: str) -> None:
    identity = open_store(store).id
    path = store / IDENTITY
    if damage == "remove":
        path.unlink()
    else:
        change(path, lambda c: c.clear() if damage == "empty" else c.__setitem__(15, c[15] ^ 1))
    assert answers(store).rows == before.rows
    report = verify(store)
    assert {f.file for f in report.findings if f.state != "unsigned"} == {IDENTITY}
    assert create_store(store).id == identity == open_store(store).id
    restart(store)
    assert any(IDENTITY in event["text"] for event in events(store, "restored"))
    assert not [f for f in verify(store).findings if f.state in ("altered", "damaged", "missing")]


@pytest.mark.parametrize("how", ["value", "key", "removed", "empty"])
def test_a_damaged_name_splits_no_item(store: Path, before: Answers, how: str) -> None:
    path = store / "names.json"
    text = path.read_text()
    new = {
        "value": text.replace('"ros_count"', '"ros_cotnt"'),
        "key": text.replace("ros count", "ros cotnt"),
        "empty": "",
    }
    path.unlink() if how == "removed" else path.write_text(new[how])
    assert "names.json" in {finding.file for finding in verify(store).findings}
    restart(store)
    assert json.loads(path.read_text()) == json.loads(text)
    assert {info.name for info in amberbox.open(store).items() if info.name[:4] == "ros_"} == {
        "ros_count", "ros_ring",
    }  # fmt: skip
    assert any("ros_count" in event["text"] for event in events(store, "restored"))
    assert answers(store).rows == before.rows


def test_an_incident_is_what_the_manifest_says(store: Path) -> None:
    (made,) = load_all(open_store(store))
    path = store / "incidents" / made.id / "incident.json"
    text = path.read_text()
    wrongs = [text.replace(*pair) for pair in (
        ('"after_ns": 0', '"after_ns": 4'), ('"bytes"', '"bxtes"'), ('"told"', '"tolt"'),
    )]  # fmt: skip
    for wrong in (*wrongs, ""):
        assert wrong != text
        path.write_text(wrong)
        found = {f.file: f.state for f in verify(store).findings}
        assert found[f"incidents/{made.id}/incident.json"] in ("altered", "damaged")
    path.unlink()
    assert load_all(open_store(store)) == [made], "what it holds stays"
    keep(store, clock_after())
    assert load_all(open_store(store)) == [made]
    assert path.read_text() == text
    assert events(store, "incident_unreadable")


def test_verify_names_damaged_heads_and_lists_what_nothing_vouches_for(store: Path) -> None:
    report = verify(store)
    assert set(content_of(store)) <= report.files.keys() | report.uncovered.keys() | {
        name for name in content_of(store) if "/ring/" in name
    }
    assert {"room", "lock.main"} <= report.uncovered.keys()
    change(store / "journal" / "head", lambda c: c.__setitem__(40, c[40] ^ 1))
    change(store / "keep" / "head", lambda c: c.__setitem__(-3, ord("x")))
    (store / "run").write_text("1")
    change(store / "key", lambda c: c.__setitem__(50, c[50] ^ 1))
    bad = {f.file for f in verify(store).findings if f.state != "unsigned"}
    assert bad == {"journal/head", "keep/head", "run", "key"}


def test_a_store_that_signed_no_names_verifies(store: Path) -> None:
    found = [
        record for _, record in manifest_lines.LineReader().take((store / mf.NAME).read_bytes())
    ]
    at = next(n for n, record in enumerate(found) if record["kind"] == "names")
    old = (store / mf.NAME).read_bytes().split(b"\n")[:at]
    (store / mf.NAME).write_bytes(b"\n".join([*old, b""]))
    report = verify(store)
    assert report.uncovered["names.json"] == "not covered by what this store signed"
    assert "names.json" not in {finding.file for finding in report.findings}


def test_a_request_that_cannot_be_read_is_told_of(store: Path) -> None:
    (path,) = (store / "requests").glob("*.json")
    path.write_text("{")
    for _ in range(2):
        keep(store, clock_after())
    assert events(store, "request_refused")
