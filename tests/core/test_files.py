"""Files that are for their owner only: at no moment more, and never half written."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from amberbox.core.files import open_to_all, write_private


def test_a_file_is_replaced_and_nothing_is_left_over(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_text("old")
    path.chmod(0o644)
    write_private(path, "ü\n")
    assert path.read_bytes() == "ü\n".encode()
    assert path.stat().st_mode & 0o777 == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_it_is_never_open_to_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[int] = []
    sync = os.fsync

    def look(descriptor: int) -> None:
        modes.extend(file.stat().st_mode & 0o077 for file in tmp_path.iterdir())
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", look)
    write_private(tmp_path / "key", "secret")
    assert modes == [0, 0], "while it is written, and at its place"


def test_what_others_may_read_says_so(tmp_path: Path) -> None:
    write_private(tmp_path / "certificate", "public", mode=0o644)
    assert (tmp_path / "certificate").stat().st_mode & 0o077 == 0o044 & ~_umask()


def test_a_link_is_replaced_not_followed(tmp_path: Path) -> None:
    victim, path = tmp_path / "victim", tmp_path / "key"
    victim.write_text("mine")
    path.symlink_to(victim)
    (tmp_path / f".key.{os.getpid()}.part").symlink_to(victim)
    write_private(path, "secret")
    assert victim.read_text() == "mine"
    assert not path.is_symlink() and path.read_text() == "secret"


def test_what_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "key"
    path.write_text("old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_private(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_what_a_process_creates_is_for_its_group_at_most(tmp_path: Path) -> None:
    for before, after in ((0o022, 0o027), (0o002, 0o027), (0o077, 0o077)):
        code = f"""
import os, sys
from pathlib import Path
from amberbox.core.files import keep_to_group
os.umask({before})
keep_to_group()
folder = Path(sys.argv[1])
(folder / "d").mkdir()
(folder / "f").write_text("")
"""
        folder = tmp_path / f"{before:o}"
        folder.mkdir()
        subprocess.run([sys.executable, "-c", code, folder], check=True)
        assert stat.S_IMODE((folder / "d").stat().st_mode) == 0o777 & ~after
        assert stat.S_IMODE((folder / "f").stat().st_mode) == 0o666 & ~after


@pytest.mark.parametrize(("mode", "is_open"), [(0o700, False), (0o750, False), (0o755, True)])
def test_folders_that_everybody_can_read_are_told(tmp_path: Path, mode: int, is_open: bool) -> None:
    folder = tmp_path / "store"
    assert open_to_all(folder) == "", "what is not there cannot be read"
    folder.mkdir()
    folder.chmod(mode)
    assert bool(open_to_all(folder)) is is_open
