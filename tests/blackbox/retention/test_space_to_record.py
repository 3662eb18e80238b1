"""For any configuration of a robot, and any incidents, recording continues."""

from __future__ import annotations

import random
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.recorder.disk_room import DiskRoom
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.retention.pins import PinRefusal, PinRequest, pin
from amberbox.blackbox.retention.usage import DiskUse
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions, StoreOptions
from amberbox.blackbox.store.incident import StoredIncident, load_all
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import ManualClock
from tests.fuzzing import examples, fuzz
from tests.support.manual_recorder import ManualBox, events, own_records

pytest.importorskip("pyarrow", reason="columns take as much room as journals")

_SCHEMA = Schema("test/Noise", "ros1msg", b"uint8[] data\n")
TOPICS = {name: Topic(f"/{name}", "ros1", _SCHEMA) for name in ("all", "bulk", "ring")}
KEEP = [TopicOptions("/bulk", keep="bulk"), TopicOptions("/ring", keep="ring")]
WRITE_S = 0.5


class Robot:
    """A recorder with its keeper on a small disk, with time moved by hand."""

    def __init__(
        self, path: Path, store: StoreOptions, classes: Sequence[str], rate: int, share: float
    ) -> None:
        assert not list(store.check()), "only what check accepts"
        self.options = RetentionOptions(
            quota=store.quota, min_free=0, keep_min_s=store.keep_min, ring_s=store.ring_s,
            headroom=store.rotate_bytes, reserve=store.reserve_bytes, incident_share=share,
        )  # fmt: skip
        self.room = DiskRoom(path, store.reserve_bytes)
        self.classes, self.rate, self.noise = classes, rate, random.Random(rate)
        pipeline = PipelineOptions(rotate_bytes=store.rotate_bytes, ring_rotate_ns=5 * NS)
        self.box = ManualBox(path, KEEP, ManualClock(), pipeline, room=self.room)
        self.room.begin()
        self.store = open_store(path)
        self.keeper = RetentionService(self.store, self.options, clock=self.box.clock)

    def record(self, seconds: float) -> int:
        """Record for a while, with a keeper that runs every two seconds; return bytes used."""
        taken = 0
        for step in range(round(seconds / WRITE_S)):
            for name in self.classes:
                size = int(self.rate * WRITE_S / len(self.classes))
                message = size.to_bytes(4, "little") + self.noise.randbytes(size)
                self.box.hear(TOPICS[name], message)
                taken += 0 if self.room.reason else size
            self.box.write(WRITE_S)
            self.keeper.make_room_if_due()
            if step % 4 == 0:
                self.keeper.step(threading.Event())
        return taken

    def pin(self, before_s: float, after_s: float) -> StoredIncident | PinRefusal:
        return pin(self.store, PinRequest(before_s, after_s, "bump"), self.options)

    def close(self) -> None:
        self.box.close()
        self.keeper.close()


@contextmanager
def robot(
    store: StoreOptions,
    classes: Sequence[str] = ("all",),
    rate: int = 1_000_000,
    share: float = 0.5,
) -> Iterator[Robot]:
    with tempfile.TemporaryDirectory(prefix="amberbox-room-", ignore_cleanup_errors=True) as folder:
        made = Robot(Path(folder) / "store", store, classes, rate, share)
        try:
            yield made
        finally:
            made.close()


def test_an_incident_that_is_accepted_stops_no_recorder() -> None:
    with robot(StoreOptions(quota=12_000_000, keep_min=5.0), rate=500_000) as one:
        one.record(20)
        made = one.pin(5, 0)
        assert isinstance(made, StoredIncident)
        one.record(12)
        assert one.record(6) > 2_000_000
        assert load_all(one.store)[0].state == "complete"
        assert not (one.store.path / "full").exists()


def test_a_window_that_would_hold_too_much_ends_early() -> None:
    with robot(StoreOptions(quota=10_000_000, keep_min=0.0), rate=250_000) as one:
        one.record(10)
        assert isinstance(one.pin(1, 3600), StoredIncident)
        one.record(25)
        assert one.record(10) > 2_000_000
        (held,) = load_all(one.store)
        assert (held.state, held.cut) == ("complete", True)
        assert 5 * NS < held.to_ns - held.from_ns < 20 * NS
        (told,) = events(one.store.path, "incident_complete")
        assert "ends early" in told["text"]


def test_what_is_recorded_while_nothing_else_is_makes_the_rest_old_enough() -> None:
    with robot(StoreOptions(quota=10_000_000, keep_min=60.0), rate=500_000) as one:
        assert one.record(25) < 10_000_000
        assert one.room.reason
        one.record(40)
        assert one.record(10) > 1_000_000, "it became old enough to go while only events were"


@st.composite
def stores(draw: st.DrawFn) -> StoreOptions:
    quota = draw(st.integers(10_000_000, 16_000_000))
    largest = quota / 8 / 1e6
    return StoreOptions(
        quota=quota,
        keep_min=draw(st.sampled_from([0.0, 2.0, 8.0])),
        ring_s=draw(st.sampled_from([5.0, 300.0])),
        rotate_mb=draw(st.sampled_from([StoreOptions.rotate_mb, largest, largest / 5])),
        reserve=draw(st.sampled_from([StoreOptions.reserve, 0])),
    )


WISHES = st.lists(
    st.tuples(st.sampled_from([0.0, 3.0, 60.0]), st.sampled_from([0.0, 5.0, 600.0])), max_size=3
)
CLASSES = st.sampled_from([("all",), ("all", "bulk"), ("all", "ring"), ("all", "bulk", "ring")])


@fuzz
@settings(
    max_examples=examples(4),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)  # fmt: skip
@example(  # what is recorded just after a window that fills the budget is not held with it
    StoreOptions(quota=10_000_000, keep_min=0.0, ring_s=5.0), ("all",), 1_463_417, 1.0, [(3.0, 0.0)]
)
@given(stores(), CLASSES, st.integers(100_000, 1_500_000), st.floats(0.0, 1.0), WISHES)
def test_there_is_always_room_to_record(
    store: StoreOptions, classes: Sequence[str], rate: int, share: float,
    wishes: list[tuple[float, float]],
) -> None:  # fmt: skip
    assert store.quota is not None
    with robot(store, classes, rate, share) as one:
        one.record(min(20.0, 1.5 * store.quota / rate))
        for before_s, after_s in wishes:
            one.pin(before_s, after_s)
            one.record(3)
        one.record(2 * store.keep_min + 8)
        assert one.record(store.keep_min + 8) > 0, own_records(one.store.path, "amberbox/event")
        used = DiskUse(one.store.path).measure()
        assert used <= store.quota + store.rotate_bytes
