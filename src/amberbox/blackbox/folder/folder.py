"""The robot folder: read ``robot.yaml`` and ``black_box.yaml``, and judge them without a device."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.folder.blocks import Blocks, SourceBlock, read_blocks
from amberbox.blackbox.folder.monitoring import disclosures
from amberbox.blackbox.folder.robot import RobotConfig
from amberbox.blackbox.folder.server import KEY_FILE, key_notes
from amberbox.core.config import build, load_yaml, refuse
from amberbox.core.errors import Problem, UsageError
from amberbox.core.ids import derive_id

SOURCES = "amberbox.blackbox.sources"
ROBOT_FILE = "robot.yaml"
BLACK_BOX_FILE = "black_box.yaml"


@dataclass(frozen=True)
class RobotFolder:
    """What a robot folder says, checked.

    ``config_hash`` is the SHA-256 over the folder's files; ``notes`` are findings that stop
    nothing: legacy keys, blocks whose source is not built yet (named in ``not_built``).
    """

    path: Path
    robot: RobotConfig
    blocks: tuple[SourceBlock, ...]
    config_hash: str
    notes: tuple[Problem, ...] = field(default=())
    not_built: tuple[str, ...] = field(default=())

    @property
    def store_path(self) -> Path:
        """Folder of the record."""
        return self.path / Path(self.robot.store.path).expanduser()


def load_folder(path: str | Path, sources: str = SOURCES) -> RobotFolder:
    """Read a robot folder, or a single ``black_box.yaml`` (and the ``robot.yaml`` beside it).

    ``sources`` is the package whose files are the source plugins. Raises ConfigurationError with
    everything that is wrong, UsageError if there is nothing at ``path``. Opens no device.
    """
    folder, problems = inspect_folder(path, sources)
    refuse(problems)
    assert folder is not None, "a folder without errors has been read"
    return folder


def store_of(path: Path) -> Path | None:
    """Return where a robot folder keeps its record, by ``robot.yaml`` only; None if it is none.

    What has been recorded can be read whatever happened to the rest of the folder since.
    """
    if not any((path / name).is_file() for name in (ROBOT_FILE, BLACK_BOX_FILE)):
        return None
    problems: list[Problem] = []
    robot = _read_robot(path, problems)
    refuse(problems)
    assert robot is not None, "a robot.yaml without errors has been read"
    return path / Path(robot.store.path).expanduser()


def inspect_folder(
    path: str | Path, sources: str = SOURCES
) -> tuple[RobotFolder | None, list[Problem]]:
    """Read a robot folder and return it with all findings; None if there is an error."""
    path = Path(path)
    if not path.exists():
        raise UsageError(f"there is no folder or file '{path}'", "amberbox new FOLDER makes one")
    place = path if path.is_dir() else path.parent
    problems: list[Problem] = []
    robot = _read_robot(place, problems)
    blocks = _read_black_box(place / BLACK_BOX_FILE if path.is_dir() else path, sources, problems)
    problems.sort(key=lambda problem: (problem.file, problem.line))
    if robot is None or any(problem.is_error for problem in problems):
        return None, problems
    files = [path, *_existing(place / ROBOT_FILE)]
    if path.is_dir():
        files = _files(place, robot, blocks.sources)
    digest = hash_files({_relative(file, place): file for file in files})
    notes = tuple(problem for problem in problems if not problem.is_error)
    folder = RobotFolder(place, robot, blocks.sources, digest, notes, blocks.not_built)
    return folder, problems


def configuration_files(folder: RobotFolder) -> dict[str, Path]:
    """Return the files that make a folder's ``config_hash``, by name relative to it."""
    files = _files(folder.path, folder.robot, folder.blocks)
    return {_relative(path, folder.path): path for path in files}


def hash_files(files: Mapping[str, Path]) -> str:
    """Return the SHA-256 over names and contents of files, sorted by name."""
    total = hashlib.sha256()
    for name, path in sorted(files.items()):
        with path.open("rb") as file:
            size = file.seek(0, 2)
            total.update(f"{name}\0{size}\0".encode("utf-8", "surrogateescape"))
            file.seek(0)
            while block := file.read(1 << 20):
                total.update(block)
    return total.hexdigest()


def _read_robot(place: Path, problems: list[Problem]) -> RobotConfig | None:
    path = place / ROBOT_FILE
    derived = derive_id(place.resolve().name)
    if not path.exists():
        what = f"is not there; defaults are used and the robot is called '{derived}'"
        problems.append(Problem(str(path), 1, "file", what, is_error=False))
        return RobotConfig(id=derived)
    node = load_yaml(path, problems)
    robot = build(RobotConfig, node, problems) if node else None
    problems.extend(disclosures(node, robot.monitoring) if node and robot else ())
    server = (node.mapping or {}).get("server") if node else None
    if robot is not None and robot.server is not None and server is not None:
        problems.extend(key_notes(server, place, robot.server))
    return dataclasses.replace(robot, id=robot.id or derived) if robot else None


def _read_black_box(path: Path, sources: str, problems: list[Problem]) -> Blocks:
    if not path.exists():
        hint = f"it says what to listen to; 'amberbox new' shows how a {BLACK_BOX_FILE} looks"
        problems.append(Problem(str(path), 1, "file", "is not there", hint))
        return Blocks()
    node = load_yaml(path, problems)
    return read_blocks(node, sources, problems) if node else Blocks()


def _files(place: Path, robot: RobotConfig, blocks: Sequence[SourceBlock]) -> list[Path]:
    """List the configuration: all files but those that are none.

    These are the store's, hidden ones, compiled Python, the key to the server, and the files in
    which sources keep state, or are told what to do, while they run (``state_files``).
    """
    store = (place / Path(robot.store.path).expanduser()).resolve()
    named = (name for block in blocks for name in getattr(block.config, "state_files", ()))
    left_out = {(place / KEY_FILE).resolve(), *(Path(name).resolve() for name in named)}
    found = ((path, path.resolve()) for path in _walk(place))
    return [p for p, at in found if at not in left_out and not at.is_relative_to(store)]


def _walk(place: Path) -> Iterator[Path]:
    for path in place.iterdir():
        if path.name.startswith(".") or path.name == "__pycache__":
            continue
        if path.is_dir() and not path.is_symlink():
            yield from _walk(path)
        elif path.is_file():
            yield path


def _existing(path: Path) -> list[Path]:
    return [path] if path.exists() else []


def _relative(path: Path, place: Path) -> str:
    return path.relative_to(place).as_posix()
