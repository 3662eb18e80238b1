"""For any history of a box, its answers equal a simple model of the written data."""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    initialize,
    precondition,
    rule,
)

from amberbox.blackbox.journal.writer import JournalWriter
from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.retention.pins import PinRequest, advance, pin, release
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import manifest_lines
from amberbox.blackbox.store.catalogue import read_catalogue
from amberbox.blackbox.store.incident import StoredIncident, load, save
from amberbox.blackbox.store.manifest import confirm
from amberbox.blackbox.store.segment_file import SegmentWriter
from amberbox.blackbox.store.store import Store, open_store
from amberbox.blackbox.store.table_reader import RowRequest, gather
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.source import TopicOptions
from amberbox.core.types import Batch, Gap, Topic
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, number

pytest.importorskip("pyarrow", reason="the model covers segments, which are Parquet files")

BULKY = Topic("/bulky", COUNT.message_encoding, COUNT.schema)
RING = Topic("/ring", COUNT.message_encoding, COUNT.schema)
TOPICS = [TopicOptions("/bulky", keep="bulk"), TopicOptions("/ring", keep="ring")]
ITEMS = {"ros_count": COUNT, "ros_bulky": BULKY, "ros_ring": RING}
RING_S = 120.0
SOAKING = os.environ.get("HYPOTHESIS_PROFILE") == "soak"
ROOMY = 50_000_000
TIGHT = 200_000


class KilledError(BaseException):
    """Simulates ``kill -9`` at any moment."""


ACTS: list[tuple[Any, str]] = [
    (manifest_lines, "append_durably"),
    (Path, "unlink"),
    (Path, "rename"),
    (Path, "replace"),
    (SegmentWriter, "finish"),
    (JournalWriter, "write"),
]
"""What a keeper does that outlives it."""


@dataclass
class Model:
    """The written data: for each item the time of receipt of each value; marks in order."""

    rows: dict[str, dict[int, int]] = field(default_factory=lambda: {i: {} for i in ITEMS})
    waiting: dict[str, dict[int, int]] = field(default_factory=lambda: {i: {} for i in ITEMS})
    marks: list[str] = field(default_factory=list)

    def written(self) -> None:
        for item, rows in self.waiting.items():
            self.rows[item].update(rows)
            rows.clear()


class World:
    """A store with a recorder and a keeper on it, and the model beside them."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="amberbox-model-")) / "store"
        self.clock = ManualClock()
        self.model = Model()
        self.next = 0
        self.options = RetentionOptions(
            quota=2 * TIGHT, min_free=0, keep_min_s=0.0, headroom=8_000, ring_s=RING_S
        )
        self.start()
        self.keeper: RetentionService | None = None

    def start(self) -> None:
        options = PipelineOptions(rotate_bytes=2_500, rotate_ns=600 * NS, ring_rotate_ns=20 * NS)
        self.box = ManualBox(self.path, TOPICS, self.clock, options)
        self.store: Store = open_store(self.path)

    def end(self) -> None:
        with suppress(Exception):
            self.box.close()
        if self.keeper is not None:
            self.keeper.close()
        shutil.rmtree(self.path.parent)

    def record(self, writes: int, pause_s: float) -> None:
        for _ in range(writes):
            for item, topic in ITEMS.items():
                for _ in range(4):
                    self.next += 1
                    self.box.hear(topic, number(self.next))
                    self.model.waiting[item][self.next] = self.clock.wall_ns()
            self.box.write(pause_s)
            self.model.written()

    def mark(self) -> None:
        text = f"mark {len(self.model.marks)}"
        self.box.pipeline.event("mark", text)
        self.box.write()
        self.model.written()
        self.model.marks.append(text)

    def keep(self) -> None:
        if self.keeper is None:
            self.keeper = RetentionService(self.store, self.options, clock=self.clock)
        self.keeper.step(threading.Event())

    def forget_keeper(self) -> None:
        """Simulate ``kill -9``: nothing is closed; the next keeper finds the files as they are."""
        self.keeper = None

    # -- what the box says

    def query(self, item: str) -> list[int]:
        with suppress(UsageError):
            values = LocalRecord(self.path).query(item, ["data"]).columns["data"]
            return list(np.asarray(values).tolist())
        return []

    def query_journals(self, item: str) -> list[int]:
        catalogue = read_catalogue(self.path, with_segments=False)
        pieces = gather(catalogue, RowRequest(item, ["data"])).pieces
        return [v for piece in pieces for v in np.asarray(piece.columns["data"]).tolist()]

    def followed(self) -> tuple[dict[str, list[int]], list[Gap]]:
        found: dict[str, list[int]] = {item: [] for item in ITEMS}
        gaps = []
        for delivery in follow(self.path, list(ITEMS), live=False):
            if isinstance(delivery, Batch):
                found[delivery.item] += np.asarray(delivery.columns["data"]).tolist()
            elif isinstance(delivery, Gap):
                gaps.append(delivery)
        return found, gaps

    # -- what has to be so

    def check(self, pinned: dict[str, dict[str, set[int]]]) -> None:
        gaps = LocalRecord(self.path).gaps()
        followed, told = self.followed()
        for item, rows in self.model.rows.items():
            answer = self.query(item)
            assert len(answer) == len(set(answer)), "a row comes once"
            assert set(answer) <= rows.keys(), "no row is made up"
            assert answer == sorted(answer), "rows come in order"
            assert sorted(followed[item]) == answer, "follow gives the same rows"
            missing = rows.keys() - set(answer)
            assert all(_explained(rows[v], item, gaps) for v in missing), (item, gaps)
            assert all(_explained(rows[v], item, told) for v in missing), (item, told)
            for held in pinned.values():
                assert held[item] <= set(answer), "no pinned row is lost"
            assert set(self.query_journals(item)) <= set(answer)
            assert self.untouched(item) <= set(answer), "what has no tombstone is there"
        self.check_events()
        assert not mf.read(self.path).damage

    def untouched(self, item: str) -> set[int]:
        """Return the rows without any deletion."""
        rows = self.model.rows[item]
        if item == "ros_ring":
            newest_ns = max(rows.values(), default=0)
            return {v for v, at_ns in rows.items() if newest_ns - at_ns < 15 * NS and self.roomy}
        stones = mf.read(self.path).tombstones
        writer = "bulk" if item == "ros_bulky" else "main"
        spans = [(s.start_ns, s.end_ns) for s in stones if s.writer == writer]
        return {v for v, at in rows.items() if not any(a <= at <= b for a, b in spans)}

    def told_gone(self, item: str) -> set[int]:
        """Return the rows well inside the deleted ranges, raw and columns."""
        stones = mf.read(self.path).tombstones
        writer = {"ros_bulky": "bulk", "ros_ring": "ring"}.get(item, "main")
        spans = [
            (s.start_ns + NS, s.end_ns - NS)
            for s in stones
            if s.writer == writer and s.what == "both"
        ]
        rows = self.model.rows[item]
        return {v for v, at in rows.items() if any(a <= at <= b for a, b in spans)}

    @property
    def roomy(self) -> bool:
        return not any(s.writer == "ring" for s in mf.read(self.path).tombstones)

    def check_events(self) -> None:
        events = LocalRecord(self.path).events().rows()
        assert [e["text"] for e in events if e["kind"] == "mark"] == self.model.marks


def _explained(at_ns: int, item: str, gaps: list[Gap]) -> bool:
    margin_ns = NS  # rows are stamped when heard, files begin with the write after that
    writer = {"ros_bulky": "bulk", "ros_ring": "ring"}.get(item, "main")
    return any(
        g.writer == writer and g.from_ns - margin_ns <= at_ns <= g.to_ns + margin_ns for g in gaps
    )


@contextmanager
def killed_at(act: int) -> Iterator[None]:
    """Let the keeper die before its n-th act from now on that lasts: write, rename, unlink."""
    done = itertools.count(1)

    def or_die(function: Callable[..., Any]) -> Callable[..., Any]:
        def acting(*args: Any, **options: Any) -> Any:
            if next(done) >= act:
                raise KilledError
            return function(*args, **options)

        return acting

    with ExitStack() as patches, suppress(KilledError):
        for owner, name in ACTS:
            patches.enter_context(mock.patch.object(owner, name, or_die(getattr(owner, name))))
        yield


class BoxMachine(RuleBasedStateMachine):
    """Random histories of a box."""

    incidents: Bundle[str] = Bundle("incidents")

    @initialize()
    def begin(self) -> None:
        self.world = World()
        self.pinned: dict[str, dict[str, set[int]]] = {}
        self.world.mark()
        self.world.record(60, 0.5)

    def teardown(self) -> None:
        if hasattr(self, "world"):
            self.world.check(self.pinned)
            self.world.end()

    @rule(writes=st.integers(5, 60), pause_s=st.sampled_from([0.1, 1.0]), keeps=st.booleans())
    def record(self, writes: int, pause_s: float, keeps: bool) -> None:
        self.world.record(writes, pause_s)
        if keeps:
            self.world.keep()

    @rule()
    def mark(self) -> None:
        self.world.mark()

    @rule(hours=st.integers(1, 48))
    def pass_time(self, hours: int) -> None:
        self.world.box.write(hours * 3600.0)

    @rule(clean=st.booleans())
    def restart(self, clean: bool) -> None:
        self.world.box.close() if clean else self.world.box.crash()
        self.world.start()

    @rule()
    def keep(self) -> None:
        self.world.keep()

    @rule(act=st.integers(1, 30))
    def keeper_dies(self, act: int) -> None:
        with killed_at(act):
            self.world.keep()
        self.world.forget_keeper()

    @rule()
    def settle(self) -> None:
        """Run the keeper until nothing more is deleted: then no data with a tombstone are left."""
        stones = -1
        while stones != (stones := len(mf.read(self.world.path).tombstones)):
            self.world.keep()
        for item in ITEMS:
            assert self.world.told_gone(item).isdisjoint(self.world.query(item))

    @rule(quota=st.sampled_from([TIGHT, 2 * TIGHT, ROOMY]))
    def change_quota(self, quota: int) -> None:
        self.world.options = replace(self.world.options, quota=quota)
        if self.world.keeper is not None:
            self.world.keeper.close()
        self.world.forget_keeper()

    @rule(keep_min_s=st.sampled_from([0.0, 30.0]), stop=st.booleans())
    def change_rule(self, keep_min_s: float, stop: bool) -> None:
        self.world.options = replace(
            self.world.options,
            keep_min_s=keep_min_s,
            when_full="stop" if stop else "overwrite",
        )
        self.world.forget_keeper()

    @rule(share=st.floats(0.0, 1.0))
    def confirm_some(self, share: float) -> None:
        names = list(mf.read(self.world.path).journals)
        confirm(self.world.store, names[: int(share * len(names))], "server")

    @precondition(lambda self: self.world.next > 0)
    @rule(target=incidents, before_s=st.sampled_from([1.0, 10.0, 60.0]))
    def pin(self, before_s: float) -> str:
        world = self.world
        world.mark()
        found = pin(world.store, PinRequest(before_s, 0.0, "looked odd"), world.options)
        if not isinstance(found, StoredIncident):
            return ""
        done = advance(world.store, found)
        held = self.pinned.setdefault(done.id, {item: set() for item in ITEMS})
        for item in ITEMS:
            rows = world.model.rows[item]
            held[item] |= {v for v in world.query(item) if done.from_ns <= rows[v] < done.to_ns}
        return done.id

    @rule(incident=consumes(incidents))
    def release(self, incident: str) -> None:
        if incident in self.pinned:
            del self.pinned[incident]
            release(self.world.store, load(self.world.store, incident))

    @rule(incident=consumes(incidents))
    def confirm_incident(self, incident: str) -> None:
        """A server holds it: it may go, when there is nothing else to go for room."""
        if incident in self.pinned:
            del self.pinned[incident]
            save(self.world.store, replace(load(self.world.store, incident), confirmed=True))

    @rule()
    def check(self) -> None:
        self.world.check(self.pinned)


TestBox = BoxMachine.TestCase
TestBox.settings = settings(
    max_examples=settings().max_examples if SOAKING else 5,
    stateful_step_count=15,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)


@pytest.mark.parametrize("act", [3, 10, 20])
def test_an_event_whose_journal_is_being_deleted_is_there_once(act: int) -> None:
    """Its copy is written first; the keeper dies before the journal is gone."""
    machine = BoxMachine()
    machine.begin()
    machine.keeper_dies(act=1)
    machine.keeper_dies(act=22)
    machine.change_quota(quota=TIGHT)
    machine.keeper_dies(act=act)
    assert list((machine.world.path / "kept").glob("*.mcap"))
    machine.teardown()
