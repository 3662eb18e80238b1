"""The trust file: all that is wrong in it at once, and never one that others may write."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from amberbox.agent.command_trust import read_trust, trust_path
from amberbox.agent.folder_upload import packed_folder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.core.errors import AmberboxError, ConfigurationError
from amberbox.link.folders import unpack
from tests.support.commands import ANNA, BEN

KEYS = {"anna": ANNA.trusted("moves").key, "ben": BEN.trusted("state").key}
GOOD = f"""\
server: 9f3c
people:
  anna: {{key: "{KEYS["anna"]}", risk: moves, actions: ["drive_*", dock]}}
  ben: {{key: "{KEYS["ben"]}", risk: state}}
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "commands.yaml"
    path.write_text(text)
    path.chmod(0o640)
    return path


def test_who_may_what(tmp_path: Path) -> None:
    trust = read_trust(write(tmp_path, GOOD))
    assert (trust.server, trust.confirm) == ("9f3c", "code")
    name, public, rights = trust.person(ANNA.key_id) or ("", b"", None)
    assert (name, public) == ("anna", ANNA.public) and rights is not None
    assert rights.may("drive_linear", "moves") and rights.may("dock", "record")
    assert not rights.may("undock", "moves") and not rights.may("dock_all", "state")
    ben = trust.people["ben"]
    assert ben.may("anything", "state") and not ben.may("anything", "moves")
    assert trust.person("0" * 16) is None


def test_all_problems_at_once_with_their_lines(tmp_path: Path) -> None:
    text = GOOD.replace("risk: moves", "risk: movs")
    text = text.replace('"drive_*"', '"drive *"').replace("server:", "sever:") + "confirm: shout\n"
    with pytest.raises(ConfigurationError) as error:
        read_trust(write(tmp_path, text))
    said = str(error.value)
    assert "commands.yaml:1: file: unknown key 'sever'" in said and "did you mean 'server'" in said
    assert re.search(r"commands\.yaml:3: .*risk.*movs", said)
    assert re.search(r"commands\.yaml:5: confirm.*shout", said)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ((KEYS["ben"], KEYS["anna"]), "the same key"),
        ((KEYS["ben"], "ed25519:AAAA"), "32 bytes"),
        (("9f3c", '"a b"'), "no id of a server"),
        (("people:", "folk:"), "people"),
        (('"drive_*"', '"a/b"'), "no name of an action"),
    ],
)
def test_each_problem_is_named(tmp_path: Path, change: tuple[str, str], what: str) -> None:
    with pytest.raises(ConfigurationError, match=what):
        read_trust(write(tmp_path, GOOD.replace(*change)))


@pytest.mark.parametrize("mode", [0o660, 0o606, 0o666])
def test_a_file_that_others_may_write_is_not_used(tmp_path: Path, mode: int) -> None:
    path = write(tmp_path, GOOD)
    path.chmod(mode)
    with pytest.raises(AmberboxError, match="others may write") as error:
        read_trust(path)
    assert "chmod go-w" in error.value.hint


def test_nor_one_in_a_folder_that_others_may_write(tmp_path: Path) -> None:
    folder = tmp_path / "open"
    folder.mkdir()
    path = write(folder, GOOD)
    folder.chmod(0o777)
    with pytest.raises(AmberboxError, match="others may write"):
        read_trust(path)
    link = tmp_path / "link.yaml"
    link.symlink_to(path)
    with pytest.raises(AmberboxError, match="others may write"):
        read_trust(link)
    folder.chmod(0o1777)  # as /tmp: only the owner replaces a file
    assert read_trust(path).server == "9f3c"


def test_what_is_no_file_or_too_large_or_not_there(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for path in (tmp_path / "pipe", tmp_path, tmp_path / "missing"):
        with pytest.raises(AmberboxError, match=re.escape(str(path))):
            read_trust(path)
    with pytest.raises(AmberboxError, match="bytes"):
        read_trust(write(tmp_path, "#" * (1 << 20) + GOOD))


def test_the_documented_file_is_right(tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / "docs" / "robot" / "configuration.md"
    sample = page.read_text().partition("### Trust file")[2].partition("```yaml\n")[2]
    trust = read_trust(write(tmp_path, sample.partition("```")[0]))
    assert set(trust.people) == {"anna", "ben"}


def test_it_is_no_part_of_the_folder(tmp_path: Path) -> None:
    robot = tmp_path / "mira"
    robot.mkdir()
    (robot / "robot.yaml").write_text("id: mira\ncommands: trusted.yaml\n")
    (robot / "black_box.yaml").write_text("- sim: {}\n")
    before = load_folder(robot)
    assert trust_path(before) == robot / "trusted.yaml"
    (robot / "trusted.yaml").write_text(GOOD)
    folder = load_folder(robot)
    assert folder.config_hash == before.config_hash
    assert set(unpack(packed_folder(folder))) == {"robot.yaml", "black_box.yaml"}
