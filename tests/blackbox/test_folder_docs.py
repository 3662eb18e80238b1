"""docs/robot/configuration.md names every key, and its examples load."""

from __future__ import annotations

import re
from pathlib import Path

from amberbox.agent.command_trust import read_trust
from amberbox.blackbox.robot_folder.black_box_yaml import LEGACY_KEYS, DefaultParameters
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.robot_folder.robot_yaml import RobotConfig
from amberbox.core.options import describe
from amberbox.core.source import TopicOptions

PAGE = Path(__file__).resolve().parents[2] / "docs" / "robot" / "configuration.md"


def test_every_key_is_documented() -> None:
    page = PAGE.read_text(encoding="utf-8")
    general = [row.key for row in describe(DefaultParameters, "default_parameters.")]
    groups = ("store", "store.lifetime", "server", "incidents", "monitoring", "mongodb",
              "detection")  # fmt: skip
    rows = [row.key for row in describe(RobotConfig) if row.key not in groups]
    # keys of the rules of recovery are on the page of actions
    robot = [key for key in rows if not key.startswith("recovery[].")]
    topic = [row.key for row in describe(TopicOptions)]
    for key in (*general, *robot, *topic):
        assert f"| `{key}` |" in page, key
    for key, note in LEGACY_KEYS.items():
        assert f"`{key}`" in page
        assert note in page


def test_examples_load(tmp_path: Path) -> None:
    robot, trust, black_box, patterns = re.findall(
        r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
    )
    (tmp_path / "robot.yaml").write_text(robot)
    (tmp_path / "black_box.yaml").write_text(black_box)
    (tmp_path / "trust.yaml").write_text(trust)
    (tmp_path / "trust.yaml").chmod(0o600)
    assert set(read_trust(tmp_path / "trust.yaml").people) == {"anna", "ben"}
    built = load_folder(tmp_path)
    assert {note.where for note in built.notes} == {"server"}
    assert ["no key" in note.what for note in built.notes] == [True]
    assert [topic.max_frequency for topic in built.blocks[0].config.topics] == [5, 10]
    (tmp_path / "black_box.yaml").write_text(patterns)
    built = load_folder(tmp_path)
    assert {note.where for note in built.notes} == {"server"}
    topics = built.blocks[0].config.full_topics()
    assert [topic.name for topic in topics] == ["/robot1/odom", "/cam/*", "/**"]
