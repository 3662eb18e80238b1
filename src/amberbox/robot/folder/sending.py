"""Send the robot's folder to the server: packed, by its hash, without secrets."""

from __future__ import annotations

from pathlib import Path

from amberbox.blackbox.folder.folder import RobotFolder, configuration_files, hash_files
from amberbox.blackbox.folder.server import KEY_FILE
from amberbox.core.errors import AmberboxError
from amberbox.link.folders import FILES, UNPACKED_BYTES, address, pack, travels
from amberbox.robot.folder.masking import masked
from amberbox.robot.link.copying import CopyError, Sending

_FILE_BYTES = 4 << 20
"""Larger files stay: what declares is written by people."""


def packed_folder(folder: RobotFolder) -> bytes:
    """Return a folder as it may leave the robot.

    Raises AmberboxError when it is no more what its hash says, or is too large.
    """
    files = configuration_files(folder)
    if hash_files(files) != folder.config_hash:
        raise AmberboxError(
            "the folder has changed since it was read", "it is sent once it is read anew"
        )
    chosen = [name for name in sorted(files) if travels(name) and _is_declaration(files[name])]
    read = {name: files[name].read_bytes() for name in chosen[:FILES]}
    if sum(map(len, read.values())) > UNPACKED_BYTES:
        raise AmberboxError(f"the folder has more than {UNPACKED_BYTES} bytes", "move data out")
    return pack(masked(read, _own_keys(folder)))


def send_folder(folder: RobotFolder, send: Sending) -> None:
    """Send a folder; raises CopyError for another time, AmberboxError when it cannot go."""
    packed = packed_folder(folder)
    headers = {"Content-Type": "application/octet-stream"}
    reply = send("PUT", address(folder.config_hash), headers, packed)
    if not 200 <= reply.status < 300:
        raise CopyError(f"the server answers {reply.status} {reply.body[:200]!r}")


def _is_declaration(path: Path) -> bool:
    return path.stat().st_size <= _FILE_BYTES


def _own_keys(folder: RobotFolder) -> list[str]:
    """Return the robot's key, whole and without its mark."""
    try:
        key = (folder.path / KEY_FILE).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return []
    return [key, key.rpartition("_")[2]]
