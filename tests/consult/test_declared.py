"""Copies of robots' folders: declarative files are read; code and files elsewhere are not."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from amberbox import sim
from amberbox.consult.folder_knowledge import read_declared_robot
from amberbox.core.errors import Problem, UsageError
from amberbox.core.yaml_nodes import load_yaml, only_below

HASH = "ab" * 32
MODE = """\
name: own
monitor: {monitor}
mappings: [mapping: {{inputs: [a.b], outputs: [output: {{name: fine, type: bool}}]}}]
"""
FMEA = """\
types: {laser: {failure_modes: {silent: {probability: 0.01, symptoms: [<component>/own/fine]}}}}
instances: {laser: [laser]}
"""


def _folder(place: Path, **files: str) -> Path:
    known = {
        "components/laser.yaml": "component_name: laser\nmodes: [laser/own.yaml]\n",
        "components/laser/own.yaml": MODE.format(monitor="mine"),
        "fmea.yaml": FMEA,
    }
    for name, text in {**known, **files}.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text, encoding="utf-8")
    return place


def test_a_folder_without_its_python_has_all_its_outputs_and_faults(tmp_path: Path) -> None:
    found = read_declared_robot(_folder(tmp_path), "ropod_001", HASH)
    assert found.known.outputs == {"laser/own/fine"}
    assert list(found.faults().modes) == ["laser#silent"]
    assert found.knowledge().config_hash == HASH


def test_python_that_was_planted_is_not_imported(tmp_path: Path) -> None:
    run = f"open({str(tmp_path / 'ran')!r}, 'w').close()\n"
    own = f"{run}Config = None\ndef evaluate(): pass\ndef measure(): pass\nMEASURES = SUBJECT = 1\n"
    files = {"modes/mine.py": own, "probes/mine.py": own, "sources/mine.py": own}
    folder = _folder(tmp_path / "copy", **files, **{"black_box.yaml": "- mine: {}\n"})
    before = set(sys.modules)
    found = read_declared_robot(folder, "ropod_001", HASH)
    assert found.fmea is not None
    assert not (tmp_path / "ran").exists()
    assert [name for name in set(sys.modules) - before if "mine" in name] == []


def test_the_simulated_robots_folder_is_read_whole(tmp_path: Path) -> None:
    shutil.copytree(Path(sim.__file__).parent / "folder", tmp_path / "copy")
    found = read_declared_robot(tmp_path / "copy", "ropod_001", HASH)
    assert (found.problems, len(found.rules())) == ([], 2)
    assert len(found.faults().modes) > 40


def test_files_elsewhere_are_not_read(tmp_path: Path) -> None:
    """Not by the modes that a component names, nor by the members of a team."""
    secret = tmp_path / "other" / "secret.yaml"
    secret.parent.mkdir()
    secret.write_text(MODE.format(monitor="heartbeat").replace("fine", "hunter2"), encoding="utf-8")
    (tmp_path / "other" / "fmea.yaml").write_text("functions: {hunter2: {}}\n", encoding="utf-8")
    for path in ("../../other/secret.yaml", str(secret)):
        laser = f"component_name: laser\nmodes: [laser/own.yaml, {path}]\n"
        team = "robots: {a: {where: ../other, functions: {hunter: {probability: 0.1, "
        files = {"components/laser.yaml": laser, "fmea.yaml": f"{FMEA}{team}symptoms: []}}}}}}}}\n"}
        found = read_declared_robot(_folder(tmp_path / "copy", **files), "ropod_001", HASH)
        assert found.known.outputs == {"laser/own/fine"}
        assert "hunter2" not in str(found)


def test_a_place_that_the_robot_names_for_its_store_is_not_looked_at(tmp_path: Path) -> None:
    folder = _folder(tmp_path, **{"robot.yaml": "id: other\nstore: {path: /proc/self}\n"})
    found = read_declared_robot(folder, "ropod_001", HASH)
    assert found.folder.robot.id == "ropod_001"
    assert found.folder.store_path == tmp_path / "store"


def test_what_is_wrong_is_told_when_somebody_asks(tmp_path: Path) -> None:
    found = read_declared_robot(
        _folder(tmp_path, **{"fmea.yaml": "types: {laser: {failur_modes: {}}}\n"}),
        "ropod_001",
        HASH,
    )
    with pytest.raises(UsageError, match=r"fmea\.yaml of ropod_001 is wrong: types\.laser"):
        found.faults()
    (tmp_path / "fmea.yaml").unlink()
    with pytest.raises(UsageError, match="nobody has said what can fail"):
        read_declared_robot(tmp_path, "ropod_001", HASH).knowledge()


def test_the_fence_is_taken_down_again(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: 1\n", encoding="utf-8")
    problems: list[Problem] = []
    with only_below(tmp_path / "in"):
        assert load_yaml(tmp_path / "in" / ".." / "a.yaml", problems) is None
    assert "lies outside" in problems[0].what
    assert load_yaml(tmp_path / "a.yaml", problems) is not None
