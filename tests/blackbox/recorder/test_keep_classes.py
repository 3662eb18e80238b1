"""Keeping classes: which journal an item goes to, and latched messages in every file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.source import Keep, TopicOptions
from amberbox.core.types import Batch, Topic
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, last_counters, number, raw_messages

MAP = Topic("/map", COUNT.message_encoding, COUNT.schema, latched=True)
WHERE: list[tuple[Keep, list[str]]] = [
    ("all", ["journal"]),
    ("ring", ["ring"]),
    ("incident", ["ring"]),
    ("none", []),
]


@pytest.mark.parametrize(("keep", "folders"), WHERE)
def test_the_class_decides_on_the_journal(tmp_path: Path, keep: Keep, folders: list[str]) -> None:
    box = ManualBox(tmp_path / "store", [TopicOptions("/count", keep=keep)])
    for n in range(10):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    holding = [
        j.name.split("/")[0] for j in journal_reader.journals(box.store) if j.items.get("ros_count")
    ]
    assert holding == folders
    counters = last_counters(box.store)["ros_count"]
    assert (counters["received"], counters["kept"]) == (10, 10 if folders else 0)


def test_follow_delivers_both_journals(tmp_path: Path) -> None:
    other = Topic("/other", COUNT.message_encoding, COUNT.schema)
    box = ManualBox(tmp_path / "store", [TopicOptions("/other", keep="ring")])
    for n in range(10):
        box.hear(COUNT, number(n))
        box.hear(other, number(100 + n))
        box.write()
    found: dict[str, list[int]] = {}
    for delivery in follow(box.store, ["ros_count", "ros_other"], live=False):
        if isinstance(delivery, Batch):
            values = np.asarray(delivery.columns["data"]).tolist()
            found.setdefault(f"{delivery.writer} {delivery.item}", []).extend(values)
    assert found == {
        "main ros_count": list(range(10)),
        "ring ros_other": list(range(100, 110)),
    }
    box.close()


@pytest.mark.parametrize("keep", ["all", "ring"])
def test_each_file_repeats_the_latched_message_and_queries_hide_that(
    tmp_path: Path, keep: Keep
) -> None:
    options = PipelineOptions(rotate_ns=2 * NS, ring_rotate_ns=2 * NS)
    topics = [TopicOptions("/map", keep=keep), TopicOptions("/count", keep=keep)]
    box = ManualBox(tmp_path / "store", topics, options=options)
    box.hear(MAP, number(1))
    for n in range(55):
        if n == 30:
            box.hear(MAP, number(2))
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    folder = "ring" if keep == "ring" else "journal"
    files = [
        journal for journal in journal_reader.journals(box.store) if journal.name.startswith(folder)
    ]
    assert len(files) == 3
    assert raw_messages(box.store, "/map") == [number(1), number(2)]
    assert raw_messages(box.store, "/map", repeated=True) == [number(1), number(1), number(2)]
    assert amberbox.open(box.store).query("ros_map").values("data") == [1, 2]
    followed = [d for d in follow(box.store, ["ros_map"], live=False) if isinstance(d, Batch)]
    assert sum(map(len, followed)) == 2
    assert {item.name: item.rows for item in amberbox.open(box.store).items()}["ros_map"] == 2


@pytest.mark.parametrize("crashes", [False, True])
def test_the_last_latched_message_is_known_in_the_next_run(tmp_path: Path, crashes: bool) -> None:
    clock = ManualClock()
    options = PipelineOptions(rotate_ns=NS)
    box = ManualBox(tmp_path / "store", clock=clock, options=options)
    box.hear(MAP, number(1))
    box.write()
    box.hear(MAP, number(2))
    for n in range(30):
        box.hear(COUNT, number(n))
        box.write()
    box.crash() if crashes else box.close()
    again = ManualBox(tmp_path / "store", clock=clock, options=options)
    assert again.sink.last_latched("/nothing") is None
    assert again.sink.last_latched("/map") == number(2)
    again.sink.topic(MAP)  # the publisher says the same again: the source leaves it out
    for n in range(30):
        again.hear(COUNT, number(n))
        again.write()
    again.close()
    assert amberbox.open(again.store).query("ros_map").values("data") == [1, 2]
    last = journal_reader.journals(again.store)[-1]
    repeated = [s for s in last.streams.values() if s.repeated and s.item == "ros_map"]
    assert repeated, "the newest file must say what is latched although nothing was heard anew"
