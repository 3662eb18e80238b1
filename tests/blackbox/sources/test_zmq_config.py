"""Configuration and framing of the zmq source, without a socket."""

from __future__ import annotations

import json
from typing import Any

import msgpack  # type: ignore[import-untyped]  # the package has no type hints
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.payloads.payload import detect_encoding
from amberbox.blackbox.sources.zmq import Config, ZmqTopic
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.yaml_nodes import parse_yaml

KEY = "x" * 40
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


def load(text: str) -> tuple[Config | None, list[str]]:
    problems: list[Problem] = []
    node = parse_yaml(text, "black_box.yaml", problems)
    assert node is not None
    config = build(
        Config, node, problems, "zmq", lambda path: "ignored" if "metadata" in path else None
    )
    return config, [p.what for p in problems if p.is_error]


def test_topic_with_url_and_port_as_robots_of_2018_have_it() -> None:
    config, problems = load(
        """
        topics:
            - topic:
                url: tcp://127.0.0.1
                port: 5555
                name: events
                type: json
                variable_names: [source, user_role, message]
                max_frequency: 30
        """
    )
    assert problems == []
    assert config is not None
    assert [(e, [t.name for t in topics]) for e, topics in config.publishers().items()] == [
        ("tcp://127.0.0.1:5555", ["events"])
    ]
    assert config.topics[0].max_frequency == 30


def test_publisher_of_the_whole_block() -> None:
    config, problems = load(
        """
        publisher_url: tcp://10.0.0.7
        port: 5001
        topics:
            - topic: {name: a, max_frequency: 5, metadata: {x: 1}}
            - topic: {name: b, port: 5002}
            - topic: {name: c, endpoint: "ipc:///tmp/c"}
        """
    )
    assert problems == []
    assert config is not None
    assert {e: [t.name for t in topics] for e, topics in config.publishers().items()} == {
        "tcp://10.0.0.7:5001": ["a"],
        "tcp://10.0.0.7:5002": ["b"],
        "ipc:///tmp/c": ["c"],
    }


def test_two_publishers_of_everything() -> None:
    config, problems = load("endpoint: [tcp://a:1, tcp://b:2]")
    assert problems == []
    assert config is not None
    assert config.publishers() == {"tcp://a:1": [], "tcp://b:2": []}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "names no publisher"),
        ({"topics": [ZmqTopic(name="a")]}, "'a': names no publisher"),
        ({"endpoint": "localhost:5555"}, "no address"),
        ({"endpoint": "tcp://localhost"}, "no port"),
        ({"url": "localhost"}, "no port"),
        ({"endpoint": "tcp://localhost:99999"}, "no port"),
        ({"endpoint": "tcp://*:5555"}, "where a publisher binds"),
        ({"endpoint": "pgm://localhost:5555"}, "no address"),
        ({"endpoint": "tcp://a:1", "topics": [ZmqTopic(name="a", type="xml")]}, "neither json nor"),
        ({"endpoint": "tcp://a:1", "curve_server_key": "short"}, "has 40 characters"),
        ({"endpoint": "tcp://a:1", "curve_public_key": KEY}, "goes together"),
        (
            {"endpoint": "tcp://a:1", "curve_public_key": KEY, "curve_secret_key": KEY},
            "is needed",
        ),
        ({"endpoint": "tcp://a:1", "max_message_mb": 0}, "above 0"),
    ],
)
def test_what_cannot_work_is_said(options: dict[str, Any], words: str) -> None:
    findings = list(Config(**options).check())
    assert len(findings) == 1
    assert words in findings[0][1]


def test_good_configurations_pass() -> None:
    for endpoint in ("tcp://localhost:5555", "tcp://[::1]:5555", "ipc:///run/robot.sock"):
        assert list(Config(endpoint=endpoint).check()) == []


@given(JSON)
def test_json_is_told_from_msgpack(value: Any) -> None:
    assert detect_encoding(json.dumps(value).encode()) == "json"
    assert detect_encoding(b"\xef\xbb\xbf" + json.dumps(value).encode()) == "json"
    if isinstance(value, dict | list):
        assert detect_encoding(msgpack.packb(value)) == "msgpack"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate_hz": 0.0, "stamp": "t"}, "above 0"),
        ({"rate_hz": 10.0}, "goes together with 'stamp'"),
        ({"rate_hz": 10.0, "stamp": "t", "sequence": "n"}, "remove one of them"),
    ],
)
def test_what_cannot_tell_losses_is_said(options: dict[str, Any], words: str) -> None:
    (found,) = ZmqTopic("a", **options).check()
    assert found[0] == "rate_hz" and words in found[1]
