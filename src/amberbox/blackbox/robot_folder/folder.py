"""Load a robot folder: read ``robot.yaml`` and ``black_box.yaml`` and check them without a
device.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from amberbox.blackbox.robot_folder.black_box_yaml import Blocks, SourceBlock, read_blocks
from amberbox.blackbox.robot_folder.robot_yaml import (
    KEY_FILE,
    Lifetime,
    RetentionOptions,
    RobotConfig,
    StoreOptions,
    Trigger,
    TriggerOptions,
    disclosures,
    key_notes,
    mirror_notes,
    silence_of,
)
from amberbox.core.config import build, raise_errors
from amberbox.core.errors import AmberboxError, Problem, UsageError
from amberbox.core.names import derive_id, extend_names, item_name, readable_identifier
from amberbox.core.plugins import get
from amberbox.core.topic_selection import is_pattern
from amberbox.core.yaml_nodes import load_yaml

SOURCES = "amberbox.blackbox.sources"
ROBOT_FILE = "robot.yaml"
BLACK_BOX_FILE = "black_box.yaml"


@dataclass(frozen=True)
class RobotFolder:
    """The checked configuration in a robot folder.

    ``config_hash`` is the SHA-256 over the folder's files; ``notes`` are findings that stop
    nothing: legacy keys, blocks whose source is not built yet (named in ``not_built``) where the
    folder has recorded without them.
    """

    path: Path
    robot: RobotConfig
    blocks: tuple[SourceBlock, ...]
    config_hash: str
    notes: tuple[Problem, ...] = field(default=())
    not_built: tuple[str, ...] = field(default=())

    @property
    def store_path(self) -> Path:
        """Return the folder of the record."""
        return self.path / Path(self.robot.store.path).expanduser()


def load_folder(path: str | Path, sources: str = SOURCES) -> RobotFolder:
    """Read a robot folder, or a single ``black_box.yaml`` (and the ``robot.yaml`` beside it).

    ``sources`` is the package whose files are the source plugins. Raises ConfigurationError with
    everything that is wrong, UsageError if there is nothing at ``path``. Opens no device.
    """
    folder, problems = inspect_folder(path, sources)
    raise_errors(problems)
    assert folder is not None, "a folder without errors has been read"
    return folder


def store_of(path: Path) -> Path | None:
    """Return the store of a robot folder by its ``robot.yaml`` only; None if it is no such folder.

    So a record can be read even if the rest of the folder has become invalid.
    """
    if not any((path / name).is_file() for name in (ROBOT_FILE, BLACK_BOX_FILE)):
        return None
    problems: list[Problem] = []
    robot = _read_robot(path, problems)
    raise_errors(problems)
    assert robot is not None, "a robot.yaml without errors has been read"
    return path / Path(robot.store.path).expanduser()


def inspect_folder(
    path: str | Path, sources: str = SOURCES
) -> tuple[RobotFolder | None, list[Problem]]:
    """Read a robot folder; return it with all problems, None in its place if one is an error."""
    path = Path(path)
    if not path.exists():
        raise UsageError(f"there is no folder or file '{path}'", "amberbox new FOLDER makes one")
    place = path if path.is_dir() else path.parent
    problems: list[Problem] = []
    robot = _read_robot(place, problems)
    black_box = place / BLACK_BOX_FILE if path.is_dir() else path
    blocks = _read_black_box(black_box, sources, problems, _has_recorded(place, robot))
    problems.sort(key=lambda problem: (problem.file, problem.line))
    if robot is None or any(problem.is_error for problem in problems):
        return None, problems
    files = [file for file in (path, place / ROBOT_FILE) if file.exists()]
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
    mongodb = (node.mapping or {}).get("mongodb") if node else None
    if robot is not None and robot.mongodb is not None and mongodb is not None:
        problems.extend(mirror_notes(mongodb, robot.mongodb))
    return dataclasses.replace(robot, id=robot.id or derived) if robot else None


def _has_recorded(place: Path, robot: RobotConfig | None) -> bool:
    """Return whether the store has counted a run; the counter outlives all journals."""
    store = None if robot is None else place / Path(robot.store.path).expanduser()
    return store is not None and ((store / "run").is_file() or (store / "journal").is_dir())


def _read_black_box(
    path: Path, sources: str, problems: list[Problem], has_recorded: bool
) -> Blocks:
    if not path.exists():
        hint = f"it says what to listen to; 'amberbox new' shows how a {BLACK_BOX_FILE} looks"
        problems.append(Problem(str(path), 1, "file", "is not there", hint))
        return Blocks()
    node = load_yaml(path, problems)
    if node is None:
        return Blocks()
    return read_blocks(node, sources, problems, has_recorded=has_recorded)


def _files(place: Path, robot: RobotConfig, blocks: Sequence[SourceBlock]) -> list[Path]:
    """Return the configuration files of a folder.

    Left out are the store, hidden files, compiled Python, the key to the server, the trust file
    (``commands``), the model of detectors, and files through which sources keep state or get orders
    while they run (``state_files``).
    """
    store = (place / Path(robot.store.path).expanduser()).resolve()
    named = (name for block in blocks for name in getattr(block.config, "state_files", ()))
    left_out = {(place / KEY_FILE).resolve(), *(Path(name).resolve() for name in named)}
    if robot.commands:
        left_out.add((place / Path(robot.commands).expanduser()).resolve())
    if robot.detection is not None:
        left_out.add(robot.detection.file(place).resolve())
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


def _relative(path: Path, place: Path) -> str:
    return path.relative_to(place).as_posix()


def retention_options_of(folder: RobotFolder) -> RetentionOptions:
    """Return the options of the retention service from ``robot.yaml``."""
    robot, store = folder.robot, folder.robot.store
    return RetentionOptions(
        robot=robot.id,
        software_version=robot.software_version,
        config_hash=folder.config_hash,
        ring_s=store.ring_s,
        quota=store.quota,
        quota_percent=store.quota_percent,
        min_free=store.min_free,
        keep_min_s=store.keep_min,
        when_full=store.when_full,
        lifetime=Lifetime(store.lifetime.raw, store.lifetime.columns),
        headroom=store.rotate_bytes,
        reserve=store.reserve_bytes,
        incident_share=robot.incidents.share / 100,
        incidents_per_hour=robot.incidents.per_hour,
        triggers=tuple(map(_trigger, robot.triggers)),
        missions=tuple(mission.rule() for mission in robot.missions),
    )


def _trigger(options: TriggerOptions) -> Trigger:
    item, silence_s = silence_of(options.silence) if options.silence else ("", 0.0)
    return Trigger(
        name=options.name,
        when=options.when,
        event=options.event,
        silence=item,
        silence_s=silence_s,
        before_s=options.before,
        after_s=options.after,
        hold_off_s=options.hold_off,
        reason=options.reason,
    )


@dataclass(frozen=True)
class PlannedItem:
    """A configured data item; ``type`` is empty if it is known only once it is received.

    Those of a pattern of topics are one, named by a pattern as well: ``ros_cam_*``.
    """

    item: str
    source: str
    topic: str
    type: str
    max_frequency: float | None
    keep: str
    variables: tuple[str, ...]


def planned_items(
    folder: RobotFolder, problems: list[Problem], sources: str = SOURCES
) -> list[PlannedItem]:
    """Return the topics named in the configuration; a source that names none records everything.

    Sources are made but not run, so nothing is opened; one that fails becomes a problem.
    """
    items = [item for block in folder.blocks for item in _items(block, problems, sources)]
    names: dict[str, str] = {}
    return [_named(item, names) for item in items]


def _named(item: PlannedItem, names: dict[str, str]) -> PlannedItem:
    """Return an item named as in a new store: a name in use gets a suffix."""
    if is_pattern(item.topic):
        return item
    key = f"{item.source} {item.topic.strip('/')}"
    if item.item.casefold() in {name.casefold() for name in names.values()}:
        names.update(extend_names(names, [key], lambda name: False, readable_identifier))
        return replace(item, item=names[key])
    names[key] = item.item
    return item


def _items(block: SourceBlock, problems: list[Problem], sources: str) -> Iterator[PlannedItem]:
    try:
        source = get(sources, block.plugin).load().Source(block.config, block.name)
        topics = source.topics()
    except AmberboxError as error:
        problems.append(Problem(block.file, block.line, block.name, error.what, error.hint))
        return
    for topic in topics:
        yield PlannedItem(
            _item_of(block.name, topic.name),
            block.name,
            topic.name,
            topic.type,
            topic.max_frequency,
            topic.keep,
            tuple(topic.variable_names),
        )


def _item_of(source: str, topic: str) -> str:
    """Return the name of a topic's item, or a pattern that fits each item of a pattern's topics."""
    if not is_pattern(topic):
        return item_name(source, topic)
    text = topic.strip("/").replace("**/", "*").replace("**", "*")
    return f"{source}_{re.sub('[^A-Za-z0-9_*]', '_', text)}"


def declared_folder(place: Path, robot: str, config_hash: str) -> tuple[RobotFolder, list[Problem]]:
    """Return an uploaded copy of a robot folder, without sources and store, and its problems.

    A copy is incomplete, so a missing file is no error. No source is loaded, and the path of the
    store is not accessed.
    """
    problems: list[Problem] = []
    path = place / ROBOT_FILE
    node = load_yaml(path, problems) if path.is_file() else None
    config = build(RobotConfig, node, problems) if node is not None else None
    config = replace(
        config or RobotConfig(), id=robot, store=StoreOptions(), server=None, commands=""
    )
    return RobotFolder(place, config, (), config_hash), problems
