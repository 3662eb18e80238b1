"""What a robot folder promises: paths, dead bands, and a server's key."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import inspect_folder, load_folder


def folder(place: Path, black_box: str, robot: str = "id: r1\n") -> Path:
    (place / "black_box.yaml").write_text(black_box)
    (place / "robot.yaml").write_text(robot)
    return place


def test_recordings_are_seen_from_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "robot"
    place.mkdir()
    monkeypatch.chdir(tmp_path)
    folder(place, "- recording: {path: [bags/*.bag, /data/a.mcap, ../b.bag]}\n")
    (block,) = load_folder("robot").blocks
    assert list(block.config.patterns) == ["robot/bags/*.bag", "/data/a.mcap", "robot/../b.bag"]


def test_a_server_without_a_key_is_noted(tmp_path: Path) -> None:
    robot = "id: r1\nstore:\n  quota: 5 GB\n  write_s: 0.1\nserver: {url: https://fleet.example}\n"
    built = load_folder(folder(tmp_path, "- ros: {topics: [{name: /odom}]}\n", robot))
    notes = [(note.line, note.where) for note in built.notes]
    assert notes == [(5, "server")]
    assert "no key" in built.notes[0].what and "amberbox join" in built.notes[0].what


@pytest.mark.parametrize(
    ("change", "key"),
    [("absolute: -0.1", "absolute"), ("heartbeat_s: -1", "heartbeat_s"), ("bands: {x: -2}", "x")],
)
def test_dead_bands_below_zero_are_refused(tmp_path: Path, change: str, key: str) -> None:
    black_box = f"- ros:\n    topics:\n      - name: /odom\n        change: {{{change}}}\n"
    built, problems = inspect_folder(folder(tmp_path, black_box))
    assert built is None
    (problem,) = (p for p in problems if p.is_error)
    assert problem.line == 4
    assert problem.where.endswith(key)
    assert problem.what == "must be 0 or more"
