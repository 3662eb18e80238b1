"""The box's account of itself: every message received is kept, filtered on purpose, or dropped."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.core.clock import NS
from amberbox.core.source import ChangeOptions, TopicOptions
from amberbox.core.types import Schema, Topic
from tests.support.manual_recorder import (
    ManualBox,
    events,
    last_counters,
    number,
    own_records,
    raw_messages,
)

SCHEMA = Schema("std_msgs/Int64", "ros1msg", b"int64 data\n")
CHANGE = ChangeOptions(absolute=2.0, heartbeat_s=1.0)
OPTIONS = (
    TopicOptions("/plain"),
    TopicOptions("/limited", max_frequency=20.0),
    TopicOptions("/changed", change=CHANGE),
    TopicOptions("/both", max_frequency=30.0, change=CHANGE, keep="ring"),
    TopicOptions("/json", change=CHANGE),
)


def topic(name: str) -> Topic:
    return Topic(name, "json") if name == "/json" else Topic(name, "ros1", SCHEMA)


def message(rng: random.Random, name: str) -> bytes:
    if name != "/json":
        return number(rng.randrange(5))
    return b"no json" if rng.random() < 0.1 else b'{"v":%d}' % rng.randrange(5)


def live(box: ManualBox, rng: random.Random) -> dict[str, int]:
    """Send messages at random times; return the number of each topic."""
    sent = {options.name: 0 for options in OPTIONS}
    for _ in range(rng.randint(5, 40)):
        for _ in range(rng.randint(0, 40)):
            box.clock.advance(rng.choice([0.0, 0.001, 0.02]))
            name = rng.choice(list(sent))
            box.hear(topic(name), message(rng, name))
            sent[name] += 1
        box.write(rng.choice([0.0, 0.1, 1.5]))
    return sent


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32))
def test_the_counters_add_up(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, store = random.Random(seed), tmp_path_factory.mktemp("accounts") / "store"
    queue = rng.choice([1500, 10**6])
    box = ManualBox(store, OPTIONS, options=PipelineOptions(queue_bytes=queue, rotate_bytes=4000))
    sent = live(box, rng)
    box.close()
    counters = last_counters(store)
    dropped: dict[str, int] = {}
    for gap in own_records(store, "amberbox/gap"):
        dropped[gap["item"]] = dropped.get(gap["item"], 0) + gap["count"]
    for name, count in sent.items():
        found = counters.get(f"ros_{name[1:]}") or dict.fromkeys(
            ("received", "kept", "rate_limited", "unchanged", "dropped", "bytes"), 0
        )
        stages = [found[key] for key in ("kept", "rate_limited", "unchanged", "dropped")]
        raw = raw_messages(store, name)
        assert found["received"] == count == sum(stages)
        assert (found["kept"], found["bytes"]) == (len(raw), sum(map(len, raw)))
        assert found["dropped"] == dropped.get(f"ros_{name[1:]}", 0)
        assert found["rate_limited"] == 0 or name in ("/limited", "/both")
        assert found["unchanged"] == 0 or name in ("/changed", "/both", "/json")


def test_counters_come_with_every_write_and_in_silence_once_a_second(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", OPTIONS)
    for n in range(5):
        box.hear(topic("/plain"), number(n))
        box.write()
    for _ in range(50):
        box.write()
    box.close()
    records = own_records(box.store, "amberbox/counters")
    busy = [record["items"][0]["received"] for record in records if record["items"]]
    assert busy == [1, 2, 3, 4, 5]
    assert 4 <= len(records) - len(busy) <= 6
    assert "ros_plain" in last_counters(box.store)
    newest = last_counters(box.store)["ros_plain"]["last_received_ns"]
    assert newest == box.clock.wall - round(5.1 * NS)


def test_every_file_begins_with_what_the_run_is(tmp_path: Path) -> None:
    options = PipelineOptions(
        robot="r1", config_hash="abc", boot_id="b" * 8, rotate_bytes=3000, ring_rotate_ns=NS
    )
    box = ManualBox(tmp_path / "store", OPTIONS, options=options)
    for n in range(200):
        box.hear(topic("/plain"), number(n))
        box.hear(topic("/both"), number(7 * n))
        box.write()
    box.close()
    runs = own_records(box.store, "amberbox/run")
    files = list(box.store.glob("*/*.mcap"))
    assert len(runs) == len(files) > 20
    assert {(run["writer"], run["robot"], run["config_hash"]) for run in runs} == {
        ("main", "r1", "abc"),
        ("ring", "r1", "abc"),
    }
    assert '"max_frequency":30.0' in runs[-1]["items"]
    assert events(box.store, "disk") == []
