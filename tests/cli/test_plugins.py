"""``amberbox plugins``: sources, what they lack, and all their keys."""

from __future__ import annotations

import json

import pytest

from amberbox.blackbox.folder.folder import SOURCES
from amberbox.cli import plugins as verb
from amberbox.cli.main import main
from amberbox.core.config import build, parse_yaml
from amberbox.core.describe import describe
from amberbox.core.plugins import find, get
from amberbox.core.source import TopicOptions

ALL = sorted(find(SOURCES, defines=("Config", "Source")))


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins"]) == 0
    text = capsys.readouterr().out
    assert "  ros" in text
    assert "ROS 1: topics of a robot" in text
    assert main(["plugins", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert set(rows) == set(ALL)
    assert rows["ros"]["missing"] == []


def test_missing_package_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(verb, "missing_packages", lambda plugin: ["zmq"] * (plugin.name == "zmq"))
    assert main(["plugins"]) == 0
    expected = "'zmq' lacks zmq. pip install 'amberbox[zmq]'"
    assert (expected in capsys.readouterr().out) == ("zmq" in ALL)


@pytest.mark.parametrize("name", ALL)
def test_every_source_shows_a_sample_that_is_right_and_its_keys(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plugins", name]) == 0
    text = capsys.readouterr().out
    module = get(SOURCES, name).load()
    assert module.SAMPLE.rstrip() in text
    for row in describe(module.Config):
        assert f"  {row.key} " in text
        assert row.doc, f"{name}: {row.key} has no documentation"
    root = parse_yaml(module.SAMPLE, "sample", [])
    assert root is not None
    assert root.items is not None
    (block,) = (root.items[0].mapping or {}).values()
    problems: list[object] = []
    assert build(module.Config, block, problems) is not None, problems  # type: ignore[arg-type]  # only shown


def test_json_of_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins", "ros", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    keys = {row["key"]: row for row in shown["options"]}
    assert keys["topics[].max_frequency"]["unit"] == "Hz"
    assert keys["topics[].name"]["default"] is None


def test_unknown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins", "roz"]) == 2
    assert "there is no source 'roz'; did you mean 'ros'?" in capsys.readouterr().err


def test_describe_reaches_nested_keys() -> None:
    rows = {row.key: row for row in describe(TopicOptions)}
    assert rows["change.heartbeat_s"].default == "5"
    assert rows["keep"].type == "one of all, bulk, ring, incident, none"
    assert rows["change.bands"].type == "a mapping to a number"
