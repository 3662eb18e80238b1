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
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.types import Topic
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.contract import (
    assert_source_contract,
    module_problems,
    observe,
    source_problems,
)

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
