"""ROS 2 bags: a folder of SQLite or MCAP files with or without metadata.yaml, or one such file."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml
import zstandard

from amberbox.blackbox.columns.ros2_types import DISTRIBUTIONS
from amberbox.blackbox.formats import _mcap_storage, _sqlite_storage
from amberbox.blackbox.formats._recording import (
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReader,
    RecordingReport,
    TopicTable,
    cannot_open,
    unpack_message,
    write_unpacked,
)
from amberbox.blackbox.formats._ros2_types import Ros2Definitions
from amberbox.core.errors import AmberboxError

METADATA = "metadata.yaml"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_STORAGE = re.compile(r".*\.(db3|mcap)(\.zstd)?$")


@dataclass
class _Bag:
    """State while the files of a bag are opened."""

    report: RecordingReport
    definitions: Ros2Definitions
    compressed_messages: bool | None
    table: TopicTable = field(default_factory=TopicTable)
    parts: list[RecordingPart] = field(default_factory=list)
    stack: ExitStack = field(default_factory=ExitStack)


def open_ros2_folder(path: Path) -> RecordingReader:
    """Open the folder of a ROS 2 bag."""
    report = RecordingReport("ROS 2 bag")
    metadata = _read_metadata(path / METADATA, report)
    files = _files(path, metadata, report)
    if not files:
        raise AmberboxError(
            f"{path} holds no recording", "pass a ROS bag, an MCAP file or a ROS 2 bag's folder"
        )
    mode = str(metadata.get("compression_mode", "")).lower() if metadata else None
    compressed = None if mode is None else mode == "message"
    distribution = str(metadata.get("ros_distro") or "").lower()
    bag = _Bag(report, Ros2Definitions(report, distribution), compressed)
    return _open_files(path, files, bag)


def open_storage(path: Path) -> RecordingReader:
    """Open one file: plain MCAP, .db3 or either of them in zstd."""
    report = RecordingReport("MCAP file" if ".mcap" in path.name else "ROS 2 bag file")
    return _open_files(path, [path], _Bag(report, Ros2Definitions(report), None))


def _open_files(path: Path, files: Sequence[Path], bag: _Bag) -> RecordingReader:
    with bag.stack as stack:
        for file in files:
            _open_file(file, bag)
        close = stack.pop_all().close
    return RecordingReader(path, bag.table.topics, bag.parts, bag.report, close, bag.table.origins)


def _open_file(path: Path, bag: _Bag) -> None:
    magic = _magic(path)
    if magic.startswith(ZSTD_MAGIC):
        path = _decompress_file(path, bag)
        magic = _magic(path)
    if magic.startswith(_sqlite_storage.MAGIC):
        database = _sqlite_storage.open_database(path, bag.report)
        bag.stack.callback(database.close)
        if bag.definitions.distribution not in DISTRIBUTIONS:
            bag.definitions.distribution = _sqlite_storage.distribution_of(database)
        topic_of = _sqlite_storage.add_topics(database, bag.table, bag.definitions)
        bag.parts += _unpacking(_sqlite_storage.find_parts(database, topic_of), path, bag)
    elif magic.startswith(_mcap_storage.MAGIC):
        file = _mcap_storage.open_mcap(path, bag.report)
        bag.stack.callback(file.close)
        _mcap_storage.add_topics(file, bag.table, bag.definitions)
        bag.parts += _unpacking(_mcap_storage.find_parts(file), path, bag)
    elif magic:
        raise AmberboxError(
            f"{path} is neither an SQLite nor an MCAP file", "pass the recording itself"
        )
    else:
        bag.report.add_damage(RecordingDamage(path.name, 0, 0, "the file is empty"))


def _magic(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise cannot_open(path, error) from None


def _unpacking(parts: list[RecordingPart], path: Path, bag: _Bag) -> list[RecordingPart]:
    """Make parts unpack messages that are compressed one by one."""
    if bag.compressed_messages is False:
        return parts
    return [replace(p, load=partial(_load_unpacked, p.load, path, bag)) for p in parts]


def _load_unpacked(
    load: Callable[[], list[RecordedMessage]], path: Path, bag: _Bag
) -> list[RecordedMessage]:
    messages, broken = load(), 0
    for place, message in enumerate(messages):
        if message.data[:4] == ZSTD_MAGIC and (
            bag.table.topics[message.topic_index].message_encoding == "cdr"
        ):
            data = unpack_message(message.data)
            if data is None:
                broken += 1
            else:
                messages[place] = message._replace(data=data)
    if broken:
        reason = f"{broken} messages cannot be unpacked and are kept as they are"
        bag.report.add_damage(RecordingDamage(path.name, 0, 0, reason))
    return messages


def _decompress_file(path: Path, bag: _Bag) -> Path:
    """Unpack a whole file into a temporary folder, as far as possible."""
    folder = bag.stack.enter_context(tempfile.TemporaryDirectory(prefix="amberbox-"))
    target = Path(folder) / path.name.removesuffix(".zstd")
    with path.open("rb") as packed:
        try:
            problem = write_unpacked(zstandard.ZstdDecompressor().read_to_iter(packed), target)
        except zstandard.ZstdError as error:
            problem = str(error)
    if problem:
        size = path.stat().st_size
        bag.report.add_damage(
            RecordingDamage(path.name, 0, size, f"unpacked in part only ({problem})")
        )
    return target


def _read_metadata(path: Path, report: RecordingReport) -> Mapping[str, Any]:
    """Read metadata.yaml; return an empty mapping and add a note if it is missing or invalid."""
    try:
        content = yaml.safe_load(path.read_text(errors="replace"))["rosbag2_bagfile_information"]
    except FileNotFoundError:
        report.add_note(f"there is no {METADATA}; the files are read without it")
        return {}
    except (OSError, yaml.YAMLError, KeyError, TypeError) as error:
        why = (str(error) or type(error).__name__).splitlines()[0]
        report.add_note(f"{METADATA} cannot be read ({why}); read without it")
        return {}
    return content if isinstance(content, dict) else {}


def _files(path: Path, metadata: Mapping[str, Any], report: RecordingReport) -> list[Path]:
    """Find the storage files: those in the metadata, by name only, and any other."""
    present = {p.name: p for p in path.iterdir() if _STORAGE.match(p.name) and p.is_file()}
    named = [Path(str(name)).name for name in metadata.get("relative_file_paths") or ()]
    for name in named:
        if name not in present:
            report.add_damage(RecordingDamage(name, 0, 0, f"named in {METADATA} but missing"))
    others = sorted(present.keys() - set(named), key=_by_number)
    if named and others:
        report.add_note(f"not named in {METADATA} but read: {', '.join(others)}")
    return [present[name] for name in named if name in present] + [present[n] for n in others]


def _by_number(name: str) -> list[tuple[int, str]]:
    """Sort ``bag_10`` behind ``bag_9``."""
    return [(int(piece or 0), text) for text, piece in re.findall(r"(\D+)(\d*)", name)]
