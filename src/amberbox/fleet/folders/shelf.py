"""Where robots' folders stand on the server: ``DIR/folders/<robot>/<config hash>/``."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from amberbox.core.errors import UsageError
from amberbox.core.files import sync_folder
from amberbox.core.ids import is_id
from amberbox.link.folders import is_config_hash, travels

FOLDERS = "folders"
_COMING = "coming-"


@dataclass(frozen=True, slots=True)
class FileInfo:
    """A file of a robot's folder."""

    name: str
    bytes: int


@dataclass(frozen=True, slots=True)
class Shelf:
    """The folders below a server's data folder. One that stands there never changes."""

    root: Path

    def place(self, robot: str, config_hash: str) -> Path:
        """Return where a folder stands, or would; raises UsageError for names that are none."""
        if not is_id(robot) or not is_config_hash(config_hash):
            raise UsageError("this is no robot, or no hash of a folder")
        return self.root / FOLDERS / robot / config_hash

    def keep(self, robot: str, config_hash: str, files: Mapping[str, bytes]) -> bool:
        """Put a folder up, whole or not at all; False if it stands there already."""
        place = self.place(robot, config_hash)
        if place.exists():
            return False
        place.parent.mkdir(parents=True, exist_ok=True)
        coming = Path(tempfile.mkdtemp(prefix=_COMING, dir=place.parent))
        try:
            for name, data in files.items():
                _write(coming / name, data)
            for name in files:  # all at once: the first takes the others along
                _sync(coming / name)
            coming.chmod(0o755)
            coming.rename(place)
        except OSError:
            if place.exists():  # the same folder came twice at the same time
                return False
            raise
        finally:
            shutil.rmtree(coming, ignore_errors=True)
        sync_folder(place.parent)
        return True

    def files(self, robot: str, config_hash: str) -> list[FileInfo]:
        """List the files of a folder, by name; nothing that would not have travelled."""
        place = self.place(robot, config_hash)
        found = (path for path in sorted(place.rglob("*")) if path.is_file())
        named = ((path.relative_to(place).as_posix(), path) for path in found)
        return [FileInfo(name, path.stat().st_size) for name, path in named if travels(name)]

    def read(self, robot: str, config_hash: str, name: str) -> bytes | None:
        """Return a file of a folder; None if it has none of that name."""
        place = self.place(robot, config_hash)
        path = place / PurePosixPath(name)
        if not travels(name) or path.is_symlink() or not path.is_file():
            return None
        return path.read_bytes()

    def remove(self, robot: str, config_hash: str) -> None:
        """Take a folder down."""
        shutil.rmtree(self.place(robot, config_hash), ignore_errors=True)

    def tidy(self) -> None:
        """Remove what was on its way when the server ended."""
        for left in (self.root / FOLDERS).glob(f"*/{_COMING}*"):
            shutil.rmtree(left, ignore_errors=True)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("xb") as file:
        file.write(data)


def _sync(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
