"""What must not be committed is found where it is planted, and is not here."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tools.check_files import LARGEST_BYTES, check


def repository(folder: Path, text: str) -> Path:
    subprocess.run(["git", "init", "--quiet", folder], check=True)
    (folder / "page.md").write_text(text)
    return folder


INDEX, HOME, WORK = (
    "py" + "pi.org",
    "/" + "root",
    "/" + "work",
)  # in pieces, so that nobody finds them here


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"one\npip install -i https://{INDEX}/simple x", "package index"),
        ("one\npip install --extra-index-url=file:///x y", "package index"),
        (f"one\nopen('{HOME}/robot/x.bag')", "path of one machine"),
        ("one\nopen('/home/anna/x.bag')", "path of one machine"),
        ("one\nsee ../shared/facts/recording.md", "beside the project"),
        ("one\n# TODO: think", "unfinished"),
        ("one\n<<<<<<< HEAD", "merge mark"),
    ],
)
def test_a_planted_violation_is_found(tmp_path: Path, text: str, complaint: str) -> None:
    (found,) = check(repository(tmp_path, text))
    assert (found.path, found.line) == ("page.md", 2)
    assert complaint in found.what


def test_a_recording_is_found(tmp_path: Path) -> None:
    repository(tmp_path, "fine")
    (tmp_path / "robot.bag").write_bytes(bytes(LARGEST_BYTES + 1))
    (found,) = check(tmp_path)
    assert "not committed" in found.what


def test_ordinary_words_are_fine(tmp_path: Path) -> None:
    text = f"../shared/data/x, ~{WORK}/x, /opt/ros, https://example.org{HOME}/x, /ropod/odom"
    assert check(repository(tmp_path, text)) == []


def test_an_ignored_file_does_not_count(tmp_path: Path) -> None:
    repository(tmp_path, "fine")
    (tmp_path / ".gitignore").write_text("mine\n")
    (tmp_path / "mine").write_text(f"{HOME}/x/")
    assert check(tmp_path) == []
