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

from amberbox.blackbox.formats import mcap_storage, sqlite_storage
from amberbox.blackbox.formats.compression import unpack_message, write_unpacked
from amberbox.blackbox.formats.definitions import DISTRIBUTIONS, Definitions
from amberbox.blackbox.formats.recording import (
    Damage,
    Part,
    RecordedMessage,
    Recording,
    Report,
    TopicTable,
)
from amberbox.core.errors import AmberboxError

METADATA = "metadata.yaml"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_STORAGE = re.compile(r".*\.(db3|mcap)(\.zstd)?$")


@dataclass
class _Bag:
    """What is gathered while the files of a bag are opened."""

    report: Report
    definitions: Definitions
    compressed_messages: bool | None
    table: TopicTable = field(default_factory=TopicTable)
    parts: list[Part] = field(default_factory=list)
    stack: ExitStack = field(default_factory=ExitStack)


def open_ros2_folder(path: Path) -> Recording:
    """Open the folder of a ROS 2 bag."""
    report = Report("ROS 2 bag")
    metadata = _read_metadata(path / METADATA, report)
    files = _files(path, metadata, report)
    if not files:
        raise AmberboxError(
            f"{path} holds no recording", "pass a ROS bag, an MCAP file or a ROS 2 bag's folder"
        )
    mode = str(metadata.get("compression_mode", "")).lower() if metadata else None
    compressed = None if mode is None else mode == "message"
    distribution = str(metadata.get("ros_distro") or "").lower()
    bag = _Bag(report, Definitions(report, distribution), compressed)
    return _open_files(path, files, bag)


def open_storage(path: Path) -> Recording:
    """Open one file: plain MCAP, .db3 or either of them in zstd."""
    report = Report("MCAP file" if ".mcap" in path.name else "ROS 2 bag file")
    return _open_files(path, [path], _Bag(report, Definitions(report), None))


def _open_files(path: Path, files: Sequence[Path], bag: _Bag) -> Recording:
    try:
        for file in files:
            _open_file(file, bag)
    except BaseException:
        bag.stack.close()
        raise
    table = bag.table
    return Recording(path, table.topics, bag.parts, bag.report, bag.stack.close, table.origins)


def _open_file(path: Path, bag: _Bag) -> None:
    magic = _magic(path)
    if magic.startswith(ZSTD_MAGIC):
        path = _decompress_file(path, bag)
        magic = _magic(path)
    if magic.startswith(sqlite_storage.MAGIC):
        bag.parts += _open_sqlite(path, bag)
    elif magic.startswith(mcap_storage.MAGIC):
        bag.parts += _open_mcap(path, bag)
    elif magic:
        raise AmberboxError(
            f"{path} is neither an SQLite nor an MCAP file", "pass the recording itself"
        )
    else:
        bag.report.add_damage(Damage(path.name, 0, 0, "the file is empty"))


def _magic(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise AmberboxError(
            f"cannot open {path}: {error.strerror}", "check the path and its permissions"
        ) from None


def _open_sqlite(path: Path, bag: _Bag) -> list[Part]:
    database = sqlite_storage.open_database(path, bag.report)
    bag.stack.callback(database.close)
    if bag.definitions.distribution not in DISTRIBUTIONS:
        bag.definitions.distribution = sqlite_storage.distribution_of(database)
    topic_of = sqlite_storage.add_topics(database, bag.table, bag.definitions)
    return _unpacking(sqlite_storage.find_parts(database, topic_of), path, bag)


def _open_mcap(path: Path, bag: _Bag) -> list[Part]:
    file = mcap_storage.open_mcap(path, bag.report)
    bag.stack.callback(file.close)
    mcap_storage.add_topics(file, bag.table, bag.definitions)
    return _unpacking(mcap_storage.find_parts(file), path, bag)


def _unpacking(parts: list[Part], path: Path, bag: _Bag) -> list[Part]:
    """Let parts unpack messages that are compressed one by one."""
    if bag.compressed_messages is False:
        return parts
    return [replace(p, load=partial(_load_unpacked, p.load, path, bag)) for p in parts]


def _load_unpacked(
    load: Callable[[], list[RecordedMessage]], path: Path, bag: _Bag
) -> list[RecordedMessage]:
    messages, broken = load(), 0
    for place, message in enumerate(messages):
        if message.data[:4] == ZSTD_MAGIC and _is_cdr(bag, message):
            data = unpack_message(message.data)
            if data is None:
                broken += 1
            else:
                messages[place] = message._replace(data=data)
    if broken:
        reason = f"{broken} messages cannot be unpacked and are kept as they are"
        bag.report.add_damage(Damage(path.name, 0, 0, reason))
    return messages


def _is_cdr(bag: _Bag, message: RecordedMessage) -> bool:
    return bag.table.topics[message.topic_index].message_encoding == "cdr"


def _decompress_file(path: Path, bag: _Bag) -> Path:
    """Unpack a whole file into a scratch folder, as far as it goes."""
    folder = bag.stack.enter_context(tempfile.TemporaryDirectory(prefix="amberbox-"))
    target = Path(folder) / path.name.removesuffix(".zstd")
    with path.open("rb") as packed:
        try:
            problem = write_unpacked(zstandard.ZstdDecompressor().read_to_iter(packed), target)
        except zstandard.ZstdError as error:
            problem = str(error)
    if problem:
        size = path.stat().st_size
        bag.report.add_damage(Damage(path.name, 0, size, f"unpacked in part only ({problem})"))
    return target


def _read_metadata(path: Path, report: Report) -> Mapping[str, Any]:
    """Read metadata.yaml; empty, and a note, if it is not there or broken."""
    try:
        content = yaml.safe_load(path.read_text(errors="replace"))["rosbag2_bagfile_information"]
    except FileNotFoundError:
        report.add_note(f"there is no {METADATA}; the files are read without it")
        return {}
    except (OSError, yaml.YAMLError, KeyError, TypeError) as error:
        report.add_note(f"{METADATA} cannot be read ({_first_line(error)}); read without it")
        return {}
    return content if isinstance(content, dict) else {}


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def _files(path: Path, metadata: Mapping[str, Any], report: Report) -> list[Path]:
    """Find the storage files: those of the metadata, wherever it says they were, and any other."""
    present = {p.name: p for p in path.iterdir() if _STORAGE.match(p.name) and p.is_file()}
    named = [Path(str(name)).name for name in metadata.get("relative_file_paths") or ()]
    for name in named:
        if name not in present:
            report.add_damage(Damage(name, 0, 0, f"named in {METADATA} but missing"))
    others = sorted(present.keys() - set(named), key=_by_number)
    if named and others:
        report.add_note(f"not named in {METADATA} but read: {', '.join(others)}")
    return [present[name] for name in named if name in present] + [present[n] for n in others]


def _by_number(name: str) -> list[tuple[int, str]]:
    """Sort ``bag_10`` behind ``bag_9``."""
    return [(int(piece or 0), text) for text, piece in re.findall(r"(\D+)(\d*)", name)]
