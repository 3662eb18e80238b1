"""The ``ros`` block: valid values, and the errors that are found before anything is opened."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from amberbox.blackbox.sources.ros import SAMPLE, Config, Source, settings
from amberbox.core.config import build
from amberbox.core.errors import Problem, UsageError
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import parse_yaml


def configure(text: str) -> tuple[Config | None, list[str]]:
    problems: list[Problem] = []
    node = parse_yaml(text, "black_box.yaml", problems)
    assert node is not None
    config = build(Config, node, problems)
    return config, [problem.what for problem in problems]


def test_the_sample_is_accepted() -> None:
    block: Any = yaml.safe_load(SAMPLE)
    config, problems = configure(yaml.safe_dump(block[0]["ros"]))
    assert problems == []
    assert config is not None
    assert [topic.name for topic in config.topics] == ["/odom", "/scan", "/cam/**"]


def test_topics_get_their_slash_and_keep_their_options() -> None:
    config = Config(topics=[TopicOptions("ropod/odom", max_frequency=5), TopicOptions("/scan")])
    assert [(t.name, t.max_frequency) for t in Source(config, "ros").topics()] == [
        ("/ropod/odom", 5),
        ("/scan", None),
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ros_master_uri: ftp://x\ntopics: [{name: a}]", "'ftp' is not a protocol ROS masters"),
        ("topics: []", "names no topic; list them, or write 'all_topics: true'"),
        ("{}", "names no topic"),
        ("topics: [{name: odom}, {name: /odom}]", "'odom' and '/odom' are the same topic"),
        ("topics: [{name: 'a b'}]", "'a b' is not a name ROS allows for a topic"),
        ("topics: [{name: a}]\npoll_s: 0", "must be between 0.05 and 3600 seconds"),
        ("topics: [{name: a}]\nmax_message_mb: 5000", "must be above 0, and TCPROS allows"),
        ("topics: [{name: a}]\ndead_after_s: 1", "must be between 4 seconds and a day"),
        ("topics: [{name: a}]\ncaller_id: 'my box'", "'my box' is not a name ROS allows"),
        ("topics: [{name: a}]\ninvisble: true", "unknown key 'invisble'; did you mean"),
    ],
)
def test_what_cannot_work_is_said(text: str, expected: str) -> None:
    config, problems = configure(text)
    assert config is None
    assert len(problems) == 1 and expected in problems[0]


def test_no_topic_is_fine_when_all_are_wanted() -> None:
    assert configure("all_topics: true")[1] == []


def test_the_environment_completes_the_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "http://robot:11311")
    assert settings(Config(), 900).master_uri == "http://robot:11311/"
    assert settings(Config(ros_master_uri="localhost"), 900).master_uri == "http://localhost:11311/"
    monkeypatch.delenv("ROS_MASTER_URI")
    assert settings(Config(caller_id="box"), 900).caller_id == "/box"
    assert settings(Config(max_message_mb=2), 900).message_limit == 2_000_000
    assert settings(Config(), 900).message_limit == 900
    monkeypatch.setenv("ROS_MASTER_URI", "ftp://robot")
    with pytest.raises(UsageError, match="'ftp' is not a protocol"):
        settings(Config(), 900)
