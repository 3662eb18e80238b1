"""Open a recording of any supported format, which is recognised by its content."""

from __future__ import annotations

from pathlib import Path

from amberbox.blackbox.formats import (
    _mcap_storage,
    _sqlite_storage,
    can_log,
    csv,
    ethercat_capture,
    mongodump,
    ros1_bag,
    ros2_bag,
    ulog,
)
from amberbox.blackbox.formats._recording import (
    ReadOptions,
    RecordingReader,
    cannot_open,
)
from amberbox.core.errors import AmberboxError

_KNOWN = (
    "known are ROS 1 bags (.bag), folders of ROS 2 bags, .db3, MCAP, ULog and CSV files, "
    "logs of CAN buses (candump, ASC, BLF, TRC), captures of EtherCAT (pcap, pcapng), "
    "and folders of mongodump"
)
_STORAGES = (_sqlite_storage.MAGIC, _mcap_storage.MAGIC, ros2_bag.ZSTD_MAGIC)
_NO_OPTIONS = ReadOptions()


def open_recording(path: str | Path, options: ReadOptions = _NO_OPTIONS) -> RecordingReader:
    """Open a recording for reading; raises AmberboxError if it is none."""
    path = Path(path).expanduser()
    if path.is_dir():
        dump = find_dump(path)
        if dump is not None:
            return mongodump.open_mongodump(dump, options)
        bags = sorted(p.name for p in path.iterdir() if p.suffix in (".bag", ".active"))
        if bags and not (path / ros2_bag.METADATA).exists():
            raise AmberboxError(
                f"{path} is a folder of {len(bags)} ROS 1 bags",
                f"pass the files, such as {path / bags[0]}",
            )
        return ros2_bag.open_ros2_folder(path)
    magic = _read_magic(path)
    if magic.startswith(ros1_bag.MAGIC):
        return ros1_bag.open_ros1_bag(path)
    if magic.startswith(_STORAGES):
        return ros2_bag.open_storage(path)
    if magic.startswith(ulog.MAGIC):
        return ulog.open_ulog(path, options)
    if ethercat_capture.is_capture(magic):
        return ethercat_capture.open_ethercat_capture(path, options)
    can = can_log.kind_of(path, magic)
    if can:
        return can_log.open_can_log(path, can, options)
    if csv.is_csv(path, magic):
        return csv.open_csv(path, options)
    raise _unknown(path, magic)


def find_dump(path: Path) -> Path | None:
    """Return the folder of a database: this one, or the only one below it."""
    if mongodump.is_mongodump(path):
        return path
    below = [p for p in sorted(path.iterdir()) if p.is_dir() and mongodump.is_mongodump(p)]
    if len(below) > 1:
        raise AmberboxError(
            f"{path} is a dump of {len(below)} databases", f"pass one of them, such as {below[0]}"
        )
    return below[0] if below else None


def _read_magic(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(32)
    except FileNotFoundError:
        raise AmberboxError(f"{path} does not exist", "check the path") from None
    except OSError as error:
        raise cannot_open(path, error) from None


def _unknown(path: Path, magic: bytes) -> AmberboxError:
    if not magic:
        return AmberboxError(f"{path} is empty", "the recorder wrote nothing before it ended")
    if path.name == ros2_bag.METADATA:
        return AmberboxError(
            f"{path} only describes a recording", f"did you mean the folder {path.parent}?"
        )
    if magic.startswith(b"#ROSBAG V1"):
        return AmberboxError(
            f"{path} is a bag of the old format 1", "convert it with: rosbag fix OLD.bag NEW.bag"
        )
    return AmberboxError(f"{path} is not a recording in a format that can be read", _KNOWN)
