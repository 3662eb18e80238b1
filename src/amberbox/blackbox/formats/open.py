"""Open a recording of any known format; what it is decides its content, not its name."""

from __future__ import annotations

from pathlib import Path

from amberbox.blackbox.formats import mcap_storage, ros1_bag, ros2_bag, sqlite_storage
from amberbox.blackbox.formats.recording import Recording
from amberbox.core.errors import AmberboxError

_KNOWN = "known are ROS 1 bags (.bag), folders of ROS 2 bags, .db3 and MCAP files"
_STORAGES = (sqlite_storage.MAGIC, mcap_storage.MAGIC, ros2_bag.ZSTD_MAGIC)


def open_recording(path: str | Path) -> Recording:
    """Open a recording for reading; raises AmberboxError if it is none."""
    path = Path(path).expanduser()
    if path.is_dir():
        return _open_folder(path)
    magic = _read_magic(path)
    if magic.startswith(ros1_bag.MAGIC):
        return ros1_bag.open_ros1_bag(path)
    if magic.startswith(_STORAGES):
        return ros2_bag.open_storage(path)
    raise _unknown(path, magic)


def _open_folder(path: Path) -> Recording:
    bags = sorted(p.name for p in path.iterdir() if p.suffix in (".bag", ".active"))
    if bags and not (path / ros2_bag.METADATA).exists():
        raise AmberboxError(
            f"{path} is a folder of {len(bags)} ROS 1 bags",
            f"pass the files, such as {path / bags[0]}",
        )
    return ros2_bag.open_ros2_folder(path)


def _read_magic(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(32)
    except FileNotFoundError:
        raise AmberboxError(f"{path} does not exist", "check the path") from None
    except OSError as error:
        raise AmberboxError(
            f"cannot open {path}: {error.strerror}", "check the path and its permissions"
        ) from None


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
