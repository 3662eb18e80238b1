"""Replay of recordings: messages, their order and pace, and the end of the replay."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from amberbox.blackbox.sources.recording import Config, Source, find_paths
from amberbox.core.errors import AmberboxError
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.contract import MemorySink, observe

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000


def write_recording(path: Path, times_ms: Sequence[int]) -> None:
    """Write alternating messages of two JSON topics."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        channels = [writer.register_channel(name, "json", 0) for name in ("/a", "/b")]
        for number, at_ms in enumerate(times_ms):
            at_ns = START_NS + at_ms * MS
            writer.add_message(channels[number % 2], at_ns, str(number).encode(), at_ns)
        writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped


def run(config: Config, stop: threading.Event | None = None) -> MemorySink:
    sink = MemorySink()
    Source(config, "recording").run(sink, stop or threading.Event())
    return sink


def numbers(sink: MemorySink) -> list[int]:
    return [int(data) for _, data, _ in sink.messages]


def test_as_fast_as_possible(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.mcap", range(0, 100_000, 10))
    source = Source(Config(path=str(tmp_path / "one.mcap"), speed="max"), "recording")
    before = time.monotonic()
    with observe(source) as sink:
        assert sink.ended.wait(PATIENCE_S)
    assert time.monotonic() - before < PATIENCE_S  # a hundred seconds of messages
    assert numbers(sink) == list(range(10_000))
    assert source.progress == 1.0
    assert [(way, topic, peer, reason) for way, topic, peer, reason, _ in sink.links] == [
        ("up", "/a", "one.mcap", ""),
        ("up", "/b", "one.mcap", ""),
        ("down", "/a", "one.mcap", "end of recording"),
        ("down", "/b", "one.mcap", "end of recording"),
    ]


def test_messages_are_stamped_when_they_are_replayed(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.mcap", [0, 100])
    before = time.time_ns()
    sink = run(Config(path=str(tmp_path / "one.mcap"), speed=10))
    first, last = sink.messages[0][2], sink.messages[1][2]
    assert before <= first < last <= time.time_ns()


@pytest.mark.parametrize(("speed", "expected_s"), [(1.0, 0.3), (3.0, 0.1)])
def test_pace(tmp_path: Path, speed: float, expected_s: float) -> None:
    write_recording(tmp_path / "one.mcap", [0, 100, 200, 300])
    sink = run(Config(path=str(tmp_path / "one.mcap"), speed=speed))
    stamps = [ns for _, _, ns in sink.messages]
    for place, stamp in enumerate(stamps):
        due_s = expected_s * place / 3
        assert due_s - 0.001 <= (stamp - stamps[0]) / 1e9


def test_stop_is_heard_while_waiting(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.mcap", [0, 3_600_000])
    source = Source(Config(path=str(tmp_path / "one.mcap")), "recording")
    with observe(source) as sink:
        sink.wait_for("/a", 1)
        before = time.monotonic()
    assert time.monotonic() - before < PATIENCE_S  # an hour of messages
    assert numbers(sink) == [0]
    assert [reason for way, _, _, reason, _ in sink.links if way == "down"] == ["stopped"] * 2
    assert source.progress < 1.0 or len(sink.messages) == 1


def test_chosen_topics_only(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.mcap", range(10))
    topics = [TopicOptions(name="/b"), TopicOptions(name="/c")]
    sink = run(Config(path=str(tmp_path / "one.mcap"), speed="max", topics=topics))
    assert numbers(sink) == [1, 3, 5, 7, 9]
    assert [topic.name for topic in sink.topics] == ["/b"]
    assert [(kind, text) for kind, text, _ in sink.events] == [
        ("topic_missing", "one.mcap has no topic /c")
    ]


def test_topics_are_chosen_by_pattern_and_type(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        kinds = {"/a/x": "sensor_msgs/Image", "/a/y": "std_msgs/Int8", "/b": "std_msgs/Int8"}
        for name, kind in kinds.items():
            schema = writer.register_schema(kind, "jsonschema", b"{}")
            channel = writer.register_channel(name, "json", schema)
            writer.add_message(channel, START_NS, b"1", START_NS)
        writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped

    def chosen(*topics: str, **choice: Any) -> list[str]:
        options = [TopicOptions(name=name) for name in topics]
        sink = run(Config(path=str(path), speed="max", topics=options, **choice))
        assert [text for kind, text, _ in sink.events if kind == "topic_missing"] == [
            f"one.mcap has no topic {name}" for name in topics if name == "/c/*"
        ]
        return [topic.name for topic in sink.topics]

    assert chosen("/a/*", "/c/*") == ["/a/x", "/a/y"]
    assert chosen(exclude=["/a/*"]) == ["/b"]
    assert chosen(exclude_types=["sensor_msgs/*"]) == ["/a/y", "/b"]
    assert chosen("/**", types=["sensor_msgs/*"]) == ["/a/x"]


def test_a_part_of_it(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.mcap", range(0, 1000, 100))
    config = Config(path=str(tmp_path / "*.mcap"), speed="max", start_s=0.3, duration_s=0.4)
    assert numbers(run(config)) == [3, 4, 5, 6]


def test_several_files_one_after_the_other(tmp_path: Path) -> None:
    write_recording(tmp_path / "b.mcap", [0, 1, 2])
    write_recording(tmp_path / "a.mcap", [0, 1])
    source = Source(Config(path=[str(tmp_path / "*.mcap")], speed="max"), "recording")
    sink = MemorySink()
    source.run(sink, threading.Event())
    assert numbers(sink) == [0, 1, 0, 1, 2]
    assert source.progress == 1.0
    assert [peer for way, topic, peer, _, _ in sink.links if way == "up" and topic == "/a"] == [
        "a.mcap",
        "b.mcap",
    ]


def test_loop_plays_until_stopped(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.mcap", [0, 1, 2])
    config = Config(path=str(tmp_path / "one.mcap"), speed="max", loop=True)
    with observe(Source(config, "recording")) as sink:
        sink.wait_for("/a", 20)
    assert numbers(sink)[:7] == [0, 1, 2, 0, 1, 2, 0]


def test_damage_becomes_an_event(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.mcap", range(500))
    content = (tmp_path / "one.mcap").read_bytes()
    (tmp_path / "torn.mcap").write_bytes(content[: len(content) // 2])
    sink = run(Config(path=str(tmp_path / "torn.mcap"), speed="max"))
    kinds = [kind for kind, _, _ in sink.events]
    assert "recording_damaged" in kinds
    assert "recording_note" in kinds


def test_no_recording_there(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match="no recording at"):
        run(Config(path=str(tmp_path / "*.bag")))


def test_a_name_with_brackets_is_a_name(tmp_path: Path) -> None:
    odd = tmp_path / "run[1].mcap"
    write_recording(odd, [0])
    assert find_paths([str(odd)]) == [odd]


def test_relative_paths_are_seen_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_recording(tmp_path / "one.mcap", [0])
    monkeypatch.chdir(tmp_path)
    assert find_paths(["*.mcap"]) == [Path("one.mcap")]


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"path": ""}, "path"),
        ({"path": []}, "path"),
        ({"path": "a", "speed": 0}, "speed"),
        ({"path": "a", "speed": float("inf")}, "speed"),
        ({"path": "a", "start_s": -1}, "start_s"),
        ({"path": "a", "duration_s": 0}, "duration_s"),
    ],
)
def test_what_cannot_work_is_said(options: dict[str, Any], key: str) -> None:
    assert [found for found, _ in Config(**options).check()] == [key]


@pytest.mark.needs_data
def test_real_bag_replays_whole(shared_data: Path) -> None:
    path = shared_data / "recordings" / "plotjuggler_tilt_laser.bag"
    sink = run(Config(path=str(path), speed="max"))
    assert len(sink.messages) == 4093
    assert len(sink.of("/scan")) == 178
