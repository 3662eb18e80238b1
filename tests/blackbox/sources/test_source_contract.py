"""Every built-in source keeps the contract; the kit finds a source that does not."""

from __future__ import annotations

import threading
import time
import types
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from amberbox.core.options import option
from amberbox.core.plugins import Plugin, find
from amberbox.core.robot_graph import GraphService, GraphTopic, RobotGraph
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.types import Topic
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import (
    assert_source_contract,
    graph_problems,
    module_problems,
    observe,
    observe_in_process,
    source_problems,
)
from tests.support import planted_source, stamped_source
from tests.support.processes import free_port

PLUGINS = find("amberbox.blackbox.sources", defines=("Config", "Source"))


def test_sources_are_found() -> None:
    assert {"recording", "zmq"} <= PLUGINS.keys()


@pytest.mark.parametrize("plugin", PLUGINS.values(), ids=lambda plugin: plugin.name)
def test_built_source_keeps_the_contract(plugin: Plugin) -> None:
    assert_source_contract(plugin.load(), plugin.name)


@dataclass(frozen=True)
class Config:
    """A configuration for sources that do something wrong."""

    device: str = option("/dev/null", "what to read")


def module(**changes: Any) -> types.ModuleType:
    made = types.ModuleType("bad", "A source.")
    vars(made).update(Config=Config, Source=Faulty, SAMPLE="- bad: {device: x}\n")
    vars(made).update(changes)
    return made


class Faulty:
    """A source that calls the sink with given arguments."""

    lossless: Any = False

    def __init__(self, config: object = None, name: str = "", act: Any = None) -> None:
        self.act = act

    def topics(self) -> Sequence[TopicOptions]:
        return [TopicOptions(name="/odom")]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        if self.act:
            self.act(sink)


@dataclass
class Thawed:
    """Not frozen."""


@dataclass(frozen=True)
class Undocumented:
    """A key without a word about it."""

    device: str = option("x")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"__doc__": ""}, "no docstring"),
        ({"Config": Thawed}, "not a frozen dataclass"),
        ({"Config": Undocumented}, "has no doc"),
        ({"SAMPLE": "- other: {}"}, "one block '- bad:'"),
        ({"SAMPLE": "- bad: {devise: x}"}, "did you mean 'device'"),
        ({"SAMPLE": "- bad: ["}, "one block"),
    ],
)
def test_kit_finds_faulty_modules(changes: dict[str, Any], words: str) -> None:
    assert module_problems(module(), "bad") == []
    assert words in "\n".join(module_problems(module(**changes), "bad"))


def test_kit_finds_missing_names() -> None:
    bare = types.ModuleType("bad", "A source.")
    assert len(module_problems(bare, "bad")) == 3
    with pytest.raises(AssertionError, match="does not define Config"):
        assert_source_contract(bare, "bad")


def test_kit_finds_faulty_sources() -> None:
    source = Faulty()
    assert source_problems(source) == []
    source.lossless = "yes"
    assert source_problems(source) == ["'lossless' must be True or False"]


def say(topic: Topic, *messages: tuple[Any, int]) -> Any:
    def act(sink: Sink) -> None:
        stream = sink.topic(topic)
        for data, received_ns in messages:
            sink.message(stream, data, received_ns)

    return act


def lose(from_ns: int, to_ns: int, count: int) -> Any:
    def act(sink: Sink) -> None:
        sink.topic(Topic("/odom", "json"))
        sink.lost("/odom", "x", from_ns, to_ns, count, "sequence")

    return act


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (say(Topic("/odom", "json"), (b"1", 5), (b"2", 4)), "before the one before"),
        (say(Topic("/odom", "json"), (bytearray(b"1"), 5)), "instead of bytes"),
        (say(Topic("/odom", "json"), (b"1", 1 << 62)), "in the future"),
        (say(Topic("/odom", "cdr")), "without a schema"),
        (lambda sink: sink.topic("/odom"), "not a Topic"),
        (lambda sink: sink.message(7, b"", 1), "never returned"),
        (lambda sink: sink.link_up("/scan", "x"), "was not asked for"),
        (lambda sink: sink.link_up("/odom", "x"), "left up"),
        (lambda sink: sink.link_down("/odom", "x", "gone"), "never up"),
        (lambda sink: sink.link_down("/odom", "x", ""), "without a reason"),
        (lambda sink: sink.event("Bad Kind", "text"), "no short identifier"),
        (lambda sink: sink.event("good", "two\nlines"), "one line"),
        (lambda sink: sink.lost("/odom", "x", 1, 2, 1, "gone"), "was never given"),
        (lose(from_ns=1, to_ns=2, count=0), "needs a count"),
        (lose(from_ns=2, to_ns=1, count=1), "the earlier one first"),
        (lose(from_ns=1, to_ns=1 << 62, count=1), "the earlier one first"),
        (lambda sink: sink.complete(1), "without 'late_s'"),
        (lambda sink: 1 / 0, "nothing but AmberboxError"),
    ],
)
def test_kit_finds_faulty_runs(act: Any, words: str) -> None:
    with pytest.raises(AssertionError, match=words), observe(Faulty(act=act)) as sink:
        assert sink.ended.wait(PATIENCE_S)


def test_kit_finds_a_source_that_does_not_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amberbox.testing.contract.STOP_S", 0.05)
    source = Faulty(act=lambda sink: time.sleep(0.5))
    with pytest.raises(AssertionError, match="did not return"), observe(source):
        pass


class LateSource(Faulty):
    """A source whose messages may come late."""

    late_s = 2.0


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (None, "never called"),
        (lambda sink: sink.complete(1 << 62), "in the future"),
        (lambda sink: (sink.complete(9), say(Topic("/odom", "json"), (b"1", 5))(sink)), "before a"),
    ],
)
def test_kit_finds_faulty_late_sources(act: Any, words: str) -> None:
    with pytest.raises(AssertionError, match=words), observe(LateSource(act=act)) as sink:
        assert sink.ended.wait(PATIENCE_S)


def test_kit_limits_how_late_a_source_may_be() -> None:
    source = LateSource()
    source.late_s = 3600.0
    assert source_problems(source) == ["'late_s' must be between 0 and 60 s"]


def test_kit_runs_a_source_in_a_process() -> None:
    with observe_in_process(planted_source, "- planted: {after: 10}") as sink:
        assert len(sink.wait_for("/count", 10)) == 10
        assert sink.open_links() == {("/count", "counter")}
    with observe_in_process(stamped_source, f"- stamped: {{port: {free_port()}}}") as sink:
        wait_until(lambda: sink.saved, "it listens")
    with (
        pytest.raises(AssertionError, match="must not die"),
        observe_in_process(planted_source, "- planted: {death: abort}") as sink,
    ):
        assert sink.ended.wait(PATIENCE_S)


NODES = ("/a", "/b")


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        ({"nodes": []}, "instead of a RobotGraph"),
        (RobotGraph(("/b", "/a")), "nodes are not sorted"),
        (RobotGraph(NODES, (GraphTopic("/t"), GraphTopic("/s"))), "topics are not sorted"),
        (RobotGraph(NODES, (GraphTopic("/t", publishers=("/c",)),)), "/c is not among the nodes"),
        (RobotGraph(NODES, (GraphTopic("/t", subscribers=("",)),)), "must be names"),
        (RobotGraph(NODES, (), (GraphService("/s", "", "/d"),)), "/d is not among the nodes"),
    ],
)
def test_kit_finds_faulty_graphs(graph: Any, words: str) -> None:
    assert any(words in problem for problem in graph_problems(graph))


def test_kit_accepts_a_graph() -> None:
    topics = (GraphTopic("/t", "a/msg/B", ("/a",), NODES),)
    assert graph_problems(RobotGraph(NODES, topics, (GraphService("/s", "a/srv/S", "/b"),))) == []
