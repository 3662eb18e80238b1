"""The ``sim`` source: configuration, speeds, times and messages."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest

from amberbox.blackbox.sources import sim
from amberbox.blackbox.sources.sim import Config, FaultOptions, RealTimePacer, Source
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.sim.disturbances import Disturbance
from amberbox.sim.robot import START_NS
from amberbox.sim.topics import TOPICS
from amberbox.testing.contract import MemorySink


def _run(config: Config) -> MemorySink:
    sink = MemorySink()
    Source(config, "sim").run(sink, threading.Event())
    return sink


def test_at_full_speed_the_stream_is_the_robots_own_in_virtual_time() -> None:
    config = Config(seed=5, speed="max", duration_s=2.0)
    sink, again = _run(config), _run(config)
    assert sink.messages == again.messages
    assert sink.messages[0][2] >= START_NS
    assert sink.messages[-1][2] < START_NS + 2_000_000_000
    assert [topic.name for topic in sink.topics] == [spec.name for spec in TOPICS]
    assert len(sink.of("imu")) == pytest.approx(200, abs=2)


def test_topics_carry_a_json_schema_and_the_stamp_of_the_start() -> None:
    sink = _run(Config(speed="max", duration_s=0.5, start="2026-03-01T00:00:00Z"))
    odom = next(topic for topic in sink.topics if topic.name == "odom")
    assert odom.schema is not None and odom.schema.encoding == "jsonschema"
    shape = json.loads(odom.schema.data)
    assert shape["properties"]["twist"]["properties"]["linear"]["properties"]["x"] == {
        "type": "number",
        "unit": "m/s",
    }
    assert json.loads(sink.of("odom")[0])["header"]["stamp"]["sec"] == 1_772_323_200


def test_only_the_topics_asked_for_come() -> None:
    sink = _run(Config(speed="max", duration_s=1.0, topics=(TopicOptions("wifi"),)))
    assert [topic.name for topic in sink.topics] == ["wifi"]
    assert {stream for stream, _, _ in sink.messages} == {0}
    assert [link[:2] for link in sink.links] == [("up", "wifi"), ("down", "wifi")]


def test_a_limited_speed_is_kept_and_stamps_by_the_box() -> None:
    config = Config(speed=4.0, duration_s=1.0)
    sink = _run(config)
    assert Source(config, "sim").lossless
    assert not Source(Config(), "sim").lossless
    took_ns = sink.messages[-1][2] - sink.messages[0][2]
    assert took_ns > 200_000_000
    assert abs(sink.messages[0][2] - sink.links[0][4]) < 2_000_000_000


def test_disturbances_change_what_is_received() -> None:
    late = Disturbance("delay", "wifi", amount=0.7)
    wrong = Disturbance("offset", "battery", "temperature", amount=100.0, at_s=1.0)
    usual = _run(Config(speed="max", duration_s=2.0))
    sink = _run(Config(speed="max", duration_s=2.0, disturbances=(late, wrong)))
    hot = [json.loads(data)["temperature"] > 100 for data in sink.of("battery")]
    assert hot == [False, False, True, True]
    wifi = next(n for n, topic in enumerate(sink.topics) if topic.name == "wifi")
    times_ns, late_ns = ([m[2] for m in each.messages if m[0] == wifi] for each in (usual, sink))
    assert late_ns == [time_ns + 700_000_000 for time_ns in times_ns]
    assert sink.of("odom") == usual.of("odom")


@pytest.mark.parametrize(
    ("entry", "part"),
    [
        ("{kind: drop, item: odum}", "did you mean 'odom'"),
        ("{kind: sign, item: battery, variable: curent}", "did you mean 'current'"),
        ("{kind: sign, item: battery}", "sign needs a variable"),
    ],
)
def test_wrong_disturbances_are_reported(entry: str, part: str) -> None:
    problems: list[Problem] = []
    node = parse_yaml(f"disturbances: [{entry}]", "black_box.yaml", problems)
    assert node is not None and build(Config, node, problems) is None
    assert len(problems) == 1 and part in str(problems[0])


class _Clock(threading.Event):
    """A clock that advances only while a thread waits."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = 5_000_000_000

    def monotonic_ns(self) -> int:
        return self.now_ns

    def wait(self, timeout: float | None = None) -> bool:
        self.now_ns += round((timeout or 0.0) * 1e9)
        return False


def test_a_robot_that_was_held_up_makes_up_for_it_gently(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = _Clock()
    monkeypatch.setattr(sim, "time", clock)
    pace = RealTimePacer(1.0, START_NS, clock)
    went_s = []
    for number in range(200):  # 100 messages a second
        pace.wait(START_NS + number * 10_000_000)
        went_s.append(clock.now_ns / 1e9 - 5.0)
        clock.now_ns += 600_000_000 if number == 19 else 0
    assert went_s[19] == pytest.approx(0.19)
    assert went_s[20] == pytest.approx(0.79)
    took_s = [went_s[number] - went_s[20] for number in (25, 50, 80)]
    assert took_s == pytest.approx([0.0, 0.3 / 1.4 - 0.06, 0.6 / 1.4 - 0.06], abs=0.01)
    assert went_s[-1] < 2.2, "less late than it was"


def test_a_machine_that_wakes_up_late_makes_no_robot_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = _Clock()
    monkeypatch.setattr(sim, "time", clock)
    pace = RealTimePacer(1.0, START_NS, clock)
    for number in range(500):  # 100 messages a second
        before_ns = clock.now_ns
        pace.wait(START_NS + number * 10_000_000)
        clock.now_ns += 20_000_000 if clock.now_ns > before_ns else 0
    assert clock.now_ns / 1e9 - 5.0 == pytest.approx(5.0, abs=0.05)


def test_stop_ends_an_endless_robot() -> None:
    class _Stopping(MemorySink):
        def message(self, stream: int, data: bytes, received_ns: int) -> None:
            super().message(stream, data, received_ns)
            if len(self.messages) == 30:
                stop.set()

    stop, sink = threading.Event(), _Stopping()
    Source(Config(speed="max"), "sim").run(sink, stop)
    assert len(sink.messages) == 30
    assert sink.links[-1][3] == "stopped"


def test_configured_faults_act_from_their_time_on() -> None:
    fault = FaultOptions("wifi_weak", at_s=2.0, magnitude=50.0)
    nominal = _run(Config(speed="max", duration_s=5.0))
    faulty = _run(Config(speed="max", duration_s=5.0, faults=(fault,)))
    assert nominal.of("wifi")[:2] == faulty.of("wifi")[:2]
    assert not json.loads(faulty.of("wifi")[-1])["connected"]


def _configure(text: str) -> tuple[Any, str]:
    problems: list[Problem] = []
    node = parse_yaml(text, "black_box.yaml", problems)
    assert node is not None
    config = build(Config, node, problems)
    return config, "\n".join(map(str, problems))


def test_the_sample_loads() -> None:
    body = "\n".join(line[4:] for line in sim.SAMPLE.splitlines()[1:])
    config, problems = _configure(body)
    assert problems == ""
    assert config.faults[0] == FaultOptions("wheel_front_left_motor_weak", 60.0, None, 0.6)
    assert [topic.name for topic in config.topics] == ["odom", "wheels"]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("speed: 0", "must be above 0, or max"),
        ("scenario: transprt", "did you mean 'transport'"),
        ("duration_s: -1", "must be above 0"),
        ("{times: virtual, speed: 2}", "virtual goes with speed max only"),
        ("topics: [{name: odometry}]", "no topic 'odometry'"),
        ("start: yesterday", "start"),
        ("faults: [{id: wifi_week}]", "did you mean 'wifi_weak'"),
        ("faults: [{id: wifi_weak, magnitude: 99}]", "5 to 50 dB"),
        ("faults: [{id: wifi_weak, at_s: -2}]", "must not be negative"),
        ("faults: [{id: wifi_weak, at_s: 5, until_s: 4}]", "later than at_s"),
    ],
)
def test_wrong_values_are_named(text: str, part: str) -> None:
    config, problems = _configure(text)
    assert config is None
    assert part in problems
