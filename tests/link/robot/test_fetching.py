"""Requested windows: their journals, the answers, and the stored requests."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.manifest import confirm
from amberbox.blackbox.store.store import Store, open_store
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.link.client import FetchAnswer
from amberbox.link.connection import LinkOptions
from amberbox.link.frames import FetchFrame
from amberbox.link.policy import CopySituation
from amberbox.link.uploader import FetchRequests, JournalCopier, UploadReply
from tests.link.robot.rig import Watcher
from tests.support.manual_recorder import COUNT, ManualBox, number

RING = Topic("/ring", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))
ITEM = "ros_count"


class Scene:
    """A store with six files of 10 s, the last one open; answers are collected."""

    def __init__(self, path: Path) -> None:
        topics = [TopicOptions("/count"), TopicOptions("/ring", keep="ring")]
        options = PipelineOptions(rotate_ns=10 * NS, ring_rotate_ns=10 * NS)
        self.box = ManualBox(path, topics, options=options)
        self.store: Store = open_store(path)
        self.start_ns = self.box.clock.wall
        self.record(110)
        keeper = RetentionService(self.store, RetentionOptions(quota_percent=100.0, min_free=0))
        keeper._with_segments = False  # columns are of no interest here
        keeper.step(threading.Event())
        self.keeper = keeper
        self.told: list[FetchAnswer] = []

    def record(self, steps: int) -> None:
        for step in range(steps):
            self.box.hear(COUNT, number(step))
            self.box.hear(RING, number(step))
            self.box.write(0.5)

    def requests(self) -> FetchRequests:
        return FetchRequests(self.store, self.told.append, lambda: self.box.clock.wall)

    def fetch(self, id_: str, from_s: float, to_s: float, item: str = ITEM) -> FetchFrame:
        at = self.start_ns
        return FetchFrame(id_, item, at + round(from_s * NS), at + round(to_s * NS))

    def names(self, place: int = -1) -> list[str]:
        return [name for name, _ in self.told[place].files]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path / "store")


def refuse(method: str, path: str, headers: dict[str, str], body: object) -> UploadReply:
    raise AssertionError


def test_the_journals_of_a_window_are_named_with_their_size(scene: Scene) -> None:
    requests = scene.requests()
    requests.add(scene.fetch("one", 24, 26))
    requests.step()
    [name] = scene.names()
    assert name.startswith("journal/") and name.endswith("-0002.mcap")
    assert scene.told[0].id == "one"
    assert scene.told[0].files[0][1] == (scene.store.path / name).stat().st_size
    assert requests.journals == {name}
    requests.step()
    assert len(scene.told) == 1, "the same is not told again"


def test_an_item_of_the_ring_is_in_the_ring_s_files(scene: Scene) -> None:
    requests = scene.requests()
    requests.add(scene.fetch("ring", 44, 46, "ros_ring"))
    requests.step()
    assert scene.names() and all(name.startswith("ring/") for name in scene.names())


def test_without_an_item_everything_of_the_window_is_meant(scene: Scene) -> None:
    requests = scene.requests()
    requests.add(scene.fetch("all", 44, 46, ""))
    requests.step()
    assert {name.partition("/")[0] for name in scene.names()} >= {"journal", "ring"}


@pytest.mark.parametrize(("from_s", "item"), [(-500.0, ITEM), (24.0, "no_such_item")])
def test_nothing_there_is_told_at_once(scene: Scene, from_s: float, item: str) -> None:
    requests = scene.requests()
    requests.add(scene.fetch("none", from_s, from_s + 2, item))
    requests.step()
    assert scene.told == [FetchAnswer("none", ())]
    assert not requests.journals


def test_a_request_outlives_the_link_until_its_journals_are_confirmed(scene: Scene) -> None:
    requests = scene.requests()
    requests.add(scene.fetch("one", 24, 26))
    requests.step()
    [name] = scene.names()
    again = scene.requests()
    again.step()
    assert again.journals == {name}
    confirm(scene.store, [name], "server")
    again.step()
    assert not scene.requests()._open


def test_a_window_that_is_not_over_goes_on_and_tells_what_comes(scene: Scene) -> None:
    requests = scene.requests()
    requests.add(scene.fetch("live", 48, 70))
    requests.step()
    before = scene.names()
    assert before[-1].endswith("-0005.mcap"), "the file that is being written is named, too"
    scene.record(24)
    requests.step()
    assert set(before) < set(scene.names())
    scene.box.close()


def test_journals_that_an_older_server_does_not_know_are_neither_named_nor_copied(
    scene: Scene,
) -> None:
    act = Watcher(scene.store.path, writer="act")
    act.report()
    act.close()
    left_out = frozenset[str]()
    requests = FetchRequests(
        scene.store, scene.told.append, act.journal.now_ns, left_out=lambda: left_out
    )
    now_ns = act.journal.now_ns()
    wanted = FetchFrame("one", "", now_ns - 60 * NS, now_ns)
    requests.add(wanted)
    requests.step()
    [name] = requests.journals
    assert name.startswith("act/")
    scene.keeper.step(threading.Event())
    options = LinkOptions("http://127.0.0.1:1", "r1", "k")
    copier = JournalCopier(scene.store, options, refuse, lambda: CopySituation(left_out=left_out))
    assert name in copier.waiting()
    left_out = frozenset({"act"})
    requests.add(wanted)
    requests.step()
    assert not requests.journals and scene.names() == []
    waiting = copier.waiting()
    assert waiting and name not in waiting


def test_what_was_asked_for_goes_under_any_rule_the_ring_included(scene: Scene) -> None:
    requests = scene.requests()
    requests.add(scene.fetch("one", 24, 26))
    requests.add(scene.fetch("ring", 24, 26, "ros_ring"))
    requests.step()

    options = LinkOptions("http://127.0.0.1:1", "r1", "k", copy="on_request")
    copier = JournalCopier(
        scene.store, options, refuse, lambda: CopySituation(requested=requests.journals)
    )
    assert set(copier.waiting()) == requests.journals
    assert {name.partition("/")[0] for name in copier.waiting()} == {"journal", "ring"}
    requests.journals = frozenset()
    assert copier.waiting() == []
