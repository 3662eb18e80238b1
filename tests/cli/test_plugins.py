"""``amberbox plugins``: all kinds of plugins, their missing packages, and all keys."""

from __future__ import annotations

import json

import pytest

from amberbox.blackbox.robot_folder.folder import SOURCES
from amberbox.cli import plugins as verb
from amberbox.cli.main import main
from amberbox.core.config import build
from amberbox.core.options import describe
from amberbox.core.plugins import find, get
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import parse_yaml

ALL = sorted(find(SOURCES, defines=("Config", "Source")))
MODES = sorted(verb.KINDS["mode"].plugins())
PROBES = sorted(verb.KINDS["probe"].plugins())
ACTIONS = sorted(verb.KINDS["action"].plugins())
DETECTORS = sorted(verb.KINDS["detector"].plugins())


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins"]) == 0
    text = capsys.readouterr().out
    assert "  ros" in text
    assert "ROS 1: topics of a robot" in text
    assert main(["plugins", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == [*ALL, *MODES, *PROBES, *ACTIONS, *DETECTORS]
    ros = next(row for row in rows if row["name"] == "ros")
    assert (ros["kind"], ros["missing"]) == ("source", [])


def test_list_of_one_kind(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins", "--kind", "mode"]) == 0
    text = capsys.readouterr().out
    assert "  heartbeat " in text
    assert "  ros " not in text


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
    assert main(["plugins", name, "--kind", "source"]) == 0
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
    assert "there is no plugin 'roz'; did you mean 'ros'?" in capsys.readouterr().err
    assert main(["plugins", "--kind", "mode", "ros"]) == 2
    assert "there is no mode 'ros'" in capsys.readouterr().err


@pytest.mark.parametrize("name", MODES)
def test_every_mode_shows_a_mode_file_and_all_there_is_to_write(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plugins", name, "--kind", "mode"]) == 0
    text = capsys.readouterr().out
    module = verb.KINDS["mode"].plugins()[name].load()
    assert module.SAMPLE.rstrip() in text
    for word in (*module.ACCEPTS, *(result.name for result in module.RESULTS)):
        assert word in text
    for row in describe(module.Config):
        assert f"  {row.key} " in text


@pytest.mark.parametrize("name", PROBES)
def test_every_probe_shows_its_subject_and_what_it_measures(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plugins", name, "--kind", "probe"]) == 0
    text = capsys.readouterr().out
    module = verb.KINDS["probe"].plugins()[name].load()
    assert module.SUBJECT in text
    for measure in module.MEASURES:
        assert f"  {measure} " in text


def test_json_of_a_mode_and_a_probe(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins", "range", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert [result["name"] for result in shown["results"]] == ["in_range", "value"]
    assert {row["key"] for row in shown["options"]} == {"min", "max", "hysteresis"}
    assert main(["plugins", "wifi", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert {"name", "type", "unit", "doc"} == set(shown["measures"][0])


def test_a_name_that_is_taken_twice_needs_the_kind(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(verb.KINDS, "probe", verb.KINDS["mode"])
    assert main(["plugins", "range"]) == 2
    assert "'range' is a mode and a probe\nhint: say which: --kind mode" in capsys.readouterr().err
    monkeypatch.undo()
    assert main(["plugins", "range"]) == 0


def test_describe_reaches_nested_keys() -> None:
    rows = {row.key: row for row in describe(TopicOptions)}
    assert rows["change.heartbeat_s"].default == "5"
    assert rows["keep"].type == "one of all, bulk, ring, incident, none"
    assert rows["change.bands"].type == "a mapping to a number"


@pytest.mark.parametrize("name", DETECTORS)
def test_every_detector_shows_its_keys(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins", name, "--kind", "detector"]) == 0
    text = capsys.readouterr().out
    module = verb.KINDS["detector"].plugins()[name].load()
    assert getattr(module, "SAMPLE", "").rstrip() in text
    for row in describe(module.Config):
        assert f"  {row.key} " in text
