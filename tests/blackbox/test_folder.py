"""Robot folders: what loads, what is noted, what is refused, and at which line."""

from __future__ import annotations

import shutil
from pathlib import Path
from textwrap import dedent

import pytest

from amberbox.blackbox.robot_folder.folder import (
    RobotFolder,
    inspect_folder,
    load_folder,
    planned_items,
)
from amberbox.blackbox.robot_folder.robot_yaml import RobotConfig
from amberbox.blackbox.store.store import create_store
from amberbox.core.errors import ConfigurationError, Problem, UsageError
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import event_texts, recording

CONFIGS = Path(__file__).parent / "configs"
MINIMAL = "- ros: {topics: [{name: /odom}]}\n"


def folder(place: Path, black_box: str = MINIMAL, robot: str = "id: r1\n") -> Path:
    (place / "black_box.yaml").write_text(dedent(black_box))
    if robot:
        (place / "robot.yaml").write_text(dedent(robot))
    return place


def errors(place: Path) -> str:
    with pytest.raises(ConfigurationError) as caught:
        load_folder(place)
    return str(caught.value)


def recorded(place: Path, file: Path) -> RobotFolder:
    """Load a file as the black box of a folder that has recorded."""
    shutil.copy(file, place / "black_box.yaml")
    create_store(place / "store").next_run()
    return load_folder(place)


def marks(path: Path, mark: str) -> dict[int, str]:
    """Return the texts of the comments ``mark words`` by line."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return {i: line.split(mark)[1] for i, line in enumerate(lines, 1) if mark in line}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.bad.yaml")), ids=lambda path: path.name)
def test_every_error_is_at_its_line_and_all_come_at_once(path: Path) -> None:
    built, problems = inspect_folder(path)
    found = [p for p in problems if p.is_error]
    expected = marks(path, "#! ")
    assert built is None
    assert {p.line for p in found} == set(expected), [str(p) for p in found]
    for line, words in expected.items():
        assert any(words in str(p) for p in found if p.line == line), [str(p) for p in found]


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.good.yaml")), ids=lambda path: path.name)
def test_good_files_load_with_their_notes(path: Path, tmp_path: Path) -> None:
    notes = {note.line: str(note) for note in recorded(tmp_path, path).notes if note.line > 1}
    for line, words in marks(path, "#? ").items():
        assert words in notes.pop(line)
    assert all("is not built yet" in note for note in notes.values())


def test_a_block_without_a_source_is_an_error_until_the_folder_has_recorded(
    tmp_path: Path,
) -> None:
    text = """\
        - ros: {ros_master_uri: "http://127.0.0.1:1", topics: [{name: /odom}]}
        - opcua: {}
        - foxglove: {}
        - zyer: {}
        """
    found = errors(folder(tmp_path, text))
    assert "black_box.yaml:2: opcua: source 'opcua' is not built yet" in found
    assert "hint: take the block out" in found
    assert "black_box.yaml:3: foxglove: 'foxglove' is no source" in found
    assert "hint: write - ros2: {via: bridge}" in found
    assert "black_box.yaml:4: zyer: there is no source 'zyer'; did you mean 'zyre'?" in found
    folder(tmp_path, text.replace("        - zyer: {}\n", ""))
    store = create_store(tmp_path / "store")
    assert "source 'opcua' is not built yet" in errors(tmp_path), "an empty store is no record"
    store.next_run()
    built = load_folder(tmp_path)
    assert built.not_built == ("opcua", "foxglove")
    assert [block.name for block in built.blocks] == ["ros"]
    assert "source 'opcua' is not built yet: the block is not recorded" in str(built.notes[0])
    with recording(tmp_path) as recorder:
        wait_until(lambda: event_texts(recorder.store.path, "started"), "the recorder runs")
    assert event_texts(recorder.store.path, "source_missing") == [
        f"there is no source '{name}': its block of black_box.yaml is not recorded"
        for name in ("opcua", "foxglove")
    ]


def test_the_papers_listing(tmp_path: Path) -> None:
    built = recorded(tmp_path, CONFIGS / "paper.good.yaml")
    ros, ethercat, zyre = built.blocks
    assert (ros.plugin, ros.name, ros.line) == ("ros", "ros", 3)
    assert (zyre.plugin, zyre.config.name, zyre.config.groups) == ("zyre", "black_box", ("ROPOD",))
    assert zyre.config.message_types == ("TASK",)
    (odom,) = ros.config.topics
    assert odom.name == "/ropod/odom"
    assert odom.type == "nav_msgs/Odometry"
    assert odom.variable_names == ("pose/pose/position/x", "pose/pose/position/y")
    assert odom.max_frequency == 5
    assert [topic.name for topic in ethercat.config.listed()[:2]] == ["commands", "sensors"]
    assert built.not_built == ()


@pytest.mark.needs_data
def test_the_ropod_files_load_once_they_have_recorded(shared_data: Path, tmp_path: Path) -> None:
    paths = sorted((shared_data / "ropod" / "black_box_configs").glob("*.yaml"))
    assert len(paths) == 5
    for path in paths:
        _, problems = inspect_folder(path)
        wrong = {problem.what for problem in problems if problem.is_error}
        assert wrong == set()
        built = recorded(tmp_path, path)
        whats = {note.what for note in built.notes}
        assert "ignored, use robot.yaml store.quota" in whats
        assert "ignored, use robot.yaml store.rotate_mb" in whats
        with_topics = [b.config for b in built.blocks if b.plugin != "ethercat"]
        assert all(topic.max_frequency for config in with_topics for topic in config.topics)
        zyre = [block.config for block in built.blocks if block.plugin == "zyre"]
        assert all(config.groups == ("ROPOD",) and config.message_types for config in zyre)
        assert built.not_built == ()
    first = recorded(tmp_path, paths[0])
    assert [block.name for block in first.blocks] == ["ros", "zmq", "zyre", "ethercat"]


@pytest.mark.needs_data
def test_every_metadata_key_of_the_ropod_files_is_noted(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "ropod" / "black_box_configs" / "data_sources.yaml"
    noted = [note for note in recorded(tmp_path, path).notes if note.where.endswith(".metadata")]
    written = path.read_text().splitlines()
    assert [note.line for note in noted] == [
        i for i, line in enumerate(written, 1) if line.strip() == "metadata:"
    ]


def test_default_frequency_is_for_topics_without_their_own(tmp_path: Path) -> None:
    text = """\
        - ros:
            topics:
              - topic: {name: /a}
              - {name: /b}
              - topic: {name: /c, max_frequency: 2}
              - {name: /d, max_frequency: ~}
        - default_parameters: {max_frequency: 7 Hz}
        """
    (ros,) = load_folder(folder(tmp_path, text)).blocks
    assert [topic.max_frequency for topic in ros.config.topics] == [7, 7, 2, None]


def test_blocks_may_be_keys_of_one_mapping(tmp_path: Path) -> None:
    text = """\
        default_parameters: {max_frequency: 7}
        ros: {topics: [{name: /a}]}
        """
    built = load_folder(folder(tmp_path, text))
    assert [block.name for block in built.blocks] == ["ros"]
    assert built.blocks[0].config.topics[0].max_frequency == 7


def test_several_blocks_of_a_source_need_names(tmp_path: Path) -> None:
    text = """\
        - ros: {topics: [{name: /a}]}
        - ros: {name: Arm 2, topics: [{name: /a}]}
        """
    built = load_folder(folder(tmp_path, text))
    assert [block.name for block in built.blocks] == ["ros", "arm_2"]
    assert "ros.name: is 'arm_2' here" in str(built.notes[0])


def test_name_of_a_single_block_is_not_its_items_name(tmp_path: Path) -> None:
    built = load_folder(folder(tmp_path, "- ros: {name: arm, topics: [{name: /a}]}\n"))
    assert built.blocks[0].name == "ros"
    assert "not used: the only 'ros' block" in str(built.notes[0])


def test_robot_yaml(tmp_path: Path) -> None:
    robot = """\
        id: ropod_001
        model: ROPOD
        software_version: 1.10
        store: {path: /data/store, quota: 20 GB, write_s: 200 ms, ring_s: 10 min, queue: 1 MiB}
        server: {url: https://fleet.example, token: swordfish}
        """
    config = load_folder(folder(tmp_path, robot=robot)).robot
    assert config.software_version == "1.10"
    assert (config.store.write_s, config.store.ring_s, config.store.queue) == (0.2, 600, 2**20)
    assert config.store.quota == 20_000_000_000
    assert config.server is not None
    assert config.server.token == "swordfish"


def test_defaults_without_robot_yaml(tmp_path: Path) -> None:
    place = tmp_path / "Ropod 7"
    place.mkdir()
    built = load_folder(folder(place, robot=""))
    assert built.robot == RobotConfig(id="ropod_7")
    assert built.store_path == place / "store"
    assert "is not there; defaults are used and the robot is called 'ropod_7'" in str(
        built.notes[0]
    )


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ("id: Ropod 1", "robot.yaml:1: id: 'Ropod 1' is no id (a-z 0-9 _ . -); 'ropod_1' would"),
        ("store: {write_s: 0}", "store.write_s: must be above 0"),
        ("store: {write_s: 2}", "store.sync_s: must not be below write_s (2 s)") ,
        ("store: {quota_percent: 120 %}", "store.quota_percent: must be above 0 and at most 100"),
        ("store: {quota: 0}", "store.quota: must be above 0"),
        ("store: {min_free: -1}", "store.min_free: must not be below 0"),
        ("store: {qouta: 1}", "did you mean 'quota'?"),
        ("server: {url: fleet}", "server.url: must start with https:// or http://"),
        ("server: {}", "server: the key 'url' is missing"),
        ("[1]", "expected a mapping"),
        ("id: [", "syntax"),
    ],
)  # fmt: skip
def test_wrong_robot_yaml(tmp_path: Path, robot: str, message: str) -> None:
    assert message in errors(folder(tmp_path, robot=robot))


def test_errors_of_both_files_come_at_once(tmp_path: Path) -> None:
    text = errors(folder(tmp_path, "- rso: {}\n", "idd: x\n"))
    assert "robot.yaml:1" in text
    assert "black_box.yaml:1" in text


def test_missing_files(tmp_path: Path) -> None:
    assert "black_box.yaml:1: file: is not there" in errors(tmp_path)
    with pytest.raises(UsageError, match="there is no folder or file"):
        load_folder(tmp_path / "absent")


def test_single_file_uses_the_robot_yaml_beside_it(tmp_path: Path) -> None:
    place = folder(tmp_path)
    (place / "other.yaml").write_text(MINIMAL)
    built = load_folder(place / "other.yaml")
    assert built.robot.id == "r1"
    assert built.path == place


def hash_of(place: Path) -> str:
    return load_folder(place).config_hash


def test_config_hash_is_of_names_and_contents(tmp_path: Path) -> None:
    first = tmp_path / "a"
    first.mkdir()
    folder(first)
    before = hash_of(first)
    assert len(before) == 64
    second = shutil.copytree(first, tmp_path / "b")
    assert hash_of(second) == before, "the place of the folder does not count"
    (second / "components").mkdir()
    (second / "components" / "laser.yaml").write_text("x: 1\n")
    with_component = hash_of(second)
    assert with_component != before
    (second / "components" / "laser.yaml").rename(second / "components" / "lidar.yaml")
    assert hash_of(second) != with_component
    (first / "robot.yaml").write_text("id: r1 \n")
    assert hash_of(first) != before


def test_config_hash_leaves_out_what_sources_are_told_while_they_run(tmp_path: Path) -> None:
    orders = tmp_path / "state" / "orders"
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text(f"- sim: {{orders: {orders}}}\n")
    before = load_folder(tmp_path).config_hash
    orders.parent.mkdir()
    orders.write_text("fault laser_front_silent\n")
    assert load_folder(tmp_path).config_hash == before
    (tmp_path / "state" / "other").write_text("x")
    assert load_folder(tmp_path).config_hash != before


def test_config_hash_leaves_out_the_record_and_hidden_files(tmp_path: Path) -> None:
    place = folder(tmp_path, robot="id: r1\nstore: {path: data/rec}\n")
    before = hash_of(place)
    (place / "data" / "rec" / "journal").mkdir(parents=True)
    (place / "data" / "rec" / "journal" / "x.mcap").write_text("x")
    (place / ".git").mkdir()
    (place / ".git" / "HEAD").write_text("x")
    assert hash_of(place) == before
    (place / "data" / "notes.txt").write_text("x")
    assert hash_of(place) != before


FAKE = '''\
"""Listens to nothing."""
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from amberbox.core.options import option
from amberbox.core.source import TopicOptions

SAMPLE = "- fake: {port: 1}"

@dataclass(frozen=True)
class Config:
    port: int = option(doc="port")
    name: str = option("", "own name on the bus")
    topics: Sequence[TopicOptions] = option((), "topics")

    def check(self):
        if self.port == 13:
            yield "port", "brings bad luck"

class Source:
    lossless = False
    def __init__(self, config, name): ...
    def topics(self): return ()
    def run(self, sink, stop): ...
'''


@pytest.fixture
def fake_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A package with a source ``fake`` and one, ``zyre``, that cannot be imported."""
    name = f"fakes_{abs(hash(tmp_path))}"
    package = tmp_path / "path" / name
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "fake.py").write_text(FAKE)
    (package / "zyre.py").write_text(f"import no_such_library\n{FAKE}")
    monkeypatch.syspath_prepend(str(package.parent))
    return name


def load(place: Path, sources: str) -> RobotFolder:
    return load_folder(place, sources)


def test_a_source_may_have_a_name_of_its_own(tmp_path: Path, fake_sources: str) -> None:
    built = load(folder(tmp_path, "- fake: {port: 1, name: me}\n"), fake_sources)
    assert (built.blocks[0].name, built.blocks[0].config.name) == ("fake", "me")
    text = "- fake: {port: 1, name: a}\n- fake: {port: 2, name: b}\n"
    two = load(folder(tmp_path, text), fake_sources)
    assert [(block.name, block.config.name) for block in two.blocks] == [("a", "a"), ("b", "b")]


def test_the_sources_own_check_names_the_line(tmp_path: Path, fake_sources: str) -> None:
    with pytest.raises(ConfigurationError, match=r"black_box.yaml:2: fake.port: brings bad luck"):
        load(folder(tmp_path, "- fake:\n    port: 13\n"), fake_sources)


def test_a_source_that_is_there_is_no_longer_to_come(tmp_path: Path, fake_sources: str) -> None:
    with pytest.raises(ConfigurationError, match="cannot be loaded: No module named 'no_such_libr"):
        load(folder(tmp_path, "- zyre: {port: 1}\n"), fake_sources)


def test_no_empty_value_needs_a_crash(tmp_path: Path, fake_sources: str) -> None:
    with pytest.raises(ConfigurationError, match="fake: the key 'port' is missing"):
        load(folder(tmp_path, "- fake:\n"), fake_sources)


def test_a_source_that_refuses_becomes_a_problem_of_the_plan(
    tmp_path: Path, fake_sources: str
) -> None:
    fake = tmp_path / "path" / fake_sources / "fake.py"
    refusal = "raise UsageError('no such bus', 'plug it in')"
    text = fake.read_text().replace("def topics(self): return ()", f"def topics(self): {refusal}")
    fake.write_text(
        text.replace("class Source:", "from amberbox.core.errors import UsageError\nclass Source:")
    )
    built = load(folder(tmp_path, "# one\n- fake: {port: 1}\n"), fake_sources)
    problems: list[Problem] = []
    assert planned_items(built, problems, fake_sources) == []
    assert str(problems[0]).startswith(f"{tmp_path / 'black_box.yaml'}:2: fake: no such bus")


def test_journals_and_reserve_fit_into_a_small_quota(tmp_path: Path) -> None:
    path = folder(tmp_path, "- ros: {topics: [{name: /a}]}")
    (path / "robot.yaml").write_text("id: small\nstore: {quota: 80 MB}\n")
    store = load_folder(path).robot.store
    assert (store.rotate_bytes, store.reserve_bytes) == (5_000_000, 10_000_000)
    (path / "robot.yaml").write_text("id: small\nstore: {quota: 80 MB, rotate_mb: 4, reserve: 0}\n")
    store = load_folder(path).robot.store
    assert (store.rotate_bytes, store.reserve_bytes) == (4_000_000, 0)


def test_what_was_set_to_more_than_its_share_of_the_quota_is_refused(tmp_path: Path) -> None:
    path = folder(tmp_path, "- ros: {topics: [{name: /a}]}")
    (path / "robot.yaml").write_text(
        "id: small\nstore: {quota: 80 MB, rotate_mb: 11, reserve: 12 MB}\n"
    )
    with pytest.raises(ConfigurationError) as raised:
        load_folder(path)
    assert "rotate_mb: must be at most 10, an eighth of the quota" in str(raised.value)
    assert "reserve: must be at most 10 MB, an eighth of the quota" in str(raised.value)
