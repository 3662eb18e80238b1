"""Robot folders packed for the server: declarations only, never executable files.

Pictures of experiments, ``experiments/NAME.png``, go along to servers that say that they take them.
A packed folder is msgpack of contents by name, compressed with zstd. Both ends apply the same
limits.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import PurePosixPath

import msgspec
import zstandard

from amberbox.core.errors import UsageError
from amberbox.link.limits import PATH

# Suffixes of the files that are sent
SUFFIXES = frozenset({".yaml", ".yml", ".pl", ".bpmn", ".md", ".txt", ".csv", ".xml"})
# Pictures, directly in this folder; PICTURE_BYTES of one, PICTURES_BYTES of all
PICTURES = "experiments"
PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".svg"})
PICTURE_BYTES = 5_000_000
PICTURES_BYTES = 16 << 20
PACKED_BYTES = 8 << 20
UNPACKED_BYTES = 32 << 20
# What a server takes at most, with pictures
TAKEN_BYTES = PACKED_BYTES + PICTURES_BYTES
FILES = 2000
_NAME_LENGTH = 512
_PART_BYTES = 255
_DEPTH = 16
_WINDOW_BYTES = 64 << 20
_UNSAFE = re.compile(r'[\x00-\x1f\x7f\\:*?"<>|]')
_HASH = re.compile(r"[0-9a-f]{64}")
_LEVEL = 9


class FolderError(UsageError):
    """Invalid data of a packed folder, or a folder beyond a limit."""


def is_config_hash(text: str) -> bool:
    """Return whether a text has the form of a configuration hash."""
    return _HASH.fullmatch(text) is not None


def address(config_hash: str) -> str:
    """Return the path of a folder on the server."""
    return f"{PATH}/folders/{config_hash}"


def travels(name: str) -> bool:
    """Return whether a file is sent to every server, by its name relative to the folder."""
    path = PurePosixPath(name)
    return path.suffix.lower() in SUFFIXES and not _complaint(name)


def is_picture(name: str) -> bool:
    """Return whether a file is a picture of an experiment, by its name relative to the folder."""
    path = PurePosixPath(name)
    is_one = path.suffix.lower() in PICTURE_SUFFIXES and str(path.parent) == PICTURES
    return is_one and not _complaint(name)


def pack(files: Mapping[str, bytes], *, pictures: bool = False) -> bytes:
    """Pack the files of a folder that may be sent, with ``pictures`` those, too.

    Others are left out. Raises FolderError beyond the limits.
    """
    chosen = {
        name: files[name]
        for name in sorted(files)
        if travels(name) or (pictures and is_picture(name))
    }
    _check(chosen)
    packed = zstandard.ZstdCompressor(level=_LEVEL).compress(msgspec.msgpack.encode(chosen))
    most = TAKEN_BYTES if pictures else PACKED_BYTES
    if len(packed) > most:
        raise FolderError(f"the folder has {len(packed)} bytes, packed: {most} are taken")
    return packed


def unpack(data: bytes) -> dict[str, bytes]:
    """Return the files of a packed folder by name; the names are safe as relative paths.

    Raises FolderError for a damaged or too large folder, or one with a file that may not be sent.
    """
    try:
        files = msgspec.msgpack.decode(_decompressed(data), type=dict[str, bytes])
    except (msgspec.MsgspecError, zstandard.ZstdError, RecursionError) as error:
        raise FolderError("this is no packed folder, or it is damaged") from error
    for name in files:
        wrong = _complaint(name) or _no_declaration(name)
        if wrong:
            raise FolderError(f"the file {name[:80]!r} is not taken: {wrong}")
    _check(files)
    return files


def _decompressed(data: bytes) -> bytes:
    """Decompress data that states its size, if that is within the limit."""
    if len(data) > TAKEN_BYTES:
        raise FolderError(f"a packed folder has at most {TAKEN_BYTES} bytes")
    most = UNPACKED_BYTES + PICTURES_BYTES
    if not 0 <= zstandard.frame_content_size(data) <= most + (1 << 20):
        raise FolderError(f"a folder has at most {most} bytes, and says how many")
    opener = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
    return opener.decompress(data, allow_extra_data=False)


def _check(files: Mapping[str, bytes]) -> None:
    if len(files) > FILES:
        raise FolderError(f"the folder has {len(files)} files: {FILES} are taken")
    drawn = {name: len(data) for name, data in files.items() if is_picture(name)}
    total = sum(len(data) for name, data in files.items() if name not in drawn)
    if total > UNPACKED_BYTES:
        raise FolderError(f"the files have {total} bytes: {UNPACKED_BYTES} are taken")
    if sum(drawn.values()) > PICTURES_BYTES or any(size > PICTURE_BYTES for size in drawn.values()):
        raise FolderError(
            f"pictures have {PICTURE_BYTES} bytes at most, all of them {PICTURES_BYTES}"
        )
    for name in _in_the_way(files):
        raise FolderError(f"{name!r} is a file, and a folder of others")


def _complaint(name: str) -> str:
    """Return why a name is no safe path below a folder; empty for one that is."""
    parts = name.split("/")
    if len(name) > _NAME_LENGTH or len(parts) > _DEPTH:
        return "its name is too long"
    if _UNSAFE.search(name):
        return "its name has signs that are not allowed"
    if any(part in ("", "..") or part.startswith(".") for part in parts):
        return "it is hidden, or not below the folder"
    if any(len(part.encode("utf-8", "surrogatepass")) > _PART_BYTES for part in parts):
        return "its name is too long"
    if any(part != part.strip() or part.endswith(".") for part in parts):
        return "its name begins or ends with a blank or a dot"
    return ""


def _no_declaration(name: str) -> str:
    if PurePosixPath(name).suffix.lower() in SUFFIXES or is_picture(name):
        return ""
    return f"only {', '.join(sorted(SUFFIXES))} travel, and pictures of {PICTURES}/"


def _in_the_way(names: Collection[str]) -> Iterator[str]:
    """Yield names that are both a file and a folder."""
    above = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    yield from (name for name in names if name in above)
