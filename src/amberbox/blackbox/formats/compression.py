"""Unpack compressed pieces of recordings as far as they go."""

from __future__ import annotations

import bz2
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import zstandard

MOST_BYTES = 512 << 20
"""A piece of a recording that unpacks to more is refused: a few bytes may say so."""
DISK_LEFT_BYTES = 1 << 30
"""A whole file is unpacked beside the recording until the disk has no more than this left."""
_LOOK_BYTES = 32 << 20
_PIECE = 1 << 16
_ZSTD_PIECE = 1 << 11
"""zstd has no limit of its own; each 4 bytes can become a block of 128 KiB."""
_MAGIC = {"bz2": b"BZh", "lz4": b"\x04\x22\x4d\x18", "zstd": b"\x28\xb5\x2f\xfd"}
_BELIEVED = 16 << 20
"""What may be unpacked though less was promised: the promise may be what is damaged."""


def unpack(compression: str, data: bytes, size: int) -> tuple[bytes, str]:
    """Unpack ``size`` bytes or what there is; the second value says what went wrong, if anything.

    ``compression`` is ``none`` (or empty), ``bz2``, ``lz4`` or ``zstd``.
    """
    if compression in ("", "none"):
        return data, ""
    decompressor = _decompressor(compression)
    if decompressor is None:
        return b"", f"compression {compression!r} is not known"
    # one byte more than promised, to notice data that would unpack to more
    room = max(size if size <= MOST_BYTES else 0, _BELIEVED) + 1
    unpacked, problem = _unpack_pieces(decompressor, data, room)
    if size > MOST_BYTES:
        problem = f"says that it unpacks to {size} bytes, {MOST_BYTES} are allowed"
    if not problem and len(unpacked) != size:
        problem = f"unpacks to {len(unpacked)} bytes instead of {size}"
    return unpacked[: room - 1], problem


def compression_of(data: bytes) -> str:
    """Tell by its first bytes how a piece is compressed; ``none`` if it is not."""
    return next((name for name, magic in _MAGIC.items() if data.startswith(magic)), "none")


def unpack_message(data: bytes) -> bytes | None:
    """Unpack a message in zstd; None if it cannot be, or is larger than allowed."""
    unpacked, problem = _unpack_pieces(_Zstd(), data, MOST_BYTES)
    return None if problem or len(unpacked) > MOST_BYTES else unpacked


def write_unpacked(pieces: Iterable[bytes], target: Path) -> str:
    """Write a file as it is unpacked, while its disk has room; say why it ends early, if so."""
    free, written = _free_bytes(target), 0
    with target.open("wb") as unpacked:
        for piece in pieces:
            written += len(piece)
            if written > _LOOK_BYTES:
                free, written = _free_bytes(target), 0
            if free - written < DISK_LEFT_BYTES:
                return f"less than {DISK_LEFT_BYTES >> 20} MiB are left in {target.parent}"
            unpacked.write(piece)
    return ""


def _free_bytes(target: Path) -> int:
    return shutil.disk_usage(target.parent).free


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]  # the package has no type hints

        return lz4.frame.LZ4FrameDecompressor()
    return _Zstd() if compression == "zstd" else None


class _Zstd:
    """zstandard's streaming decompressor with the interface of the other two."""

    def __init__(self) -> None:
        self._stream = zstandard.ZstdDecompressor().decompressobj()

    @property
    def eof(self) -> bool:
        return self._stream.eof

    def decompress(self, data: bytes, _room: int) -> bytes:
        return self._stream.decompress(data)


def _unpack_pieces(decompressor: Any, data: bytes, room: int) -> tuple[bytes, str]:
    # in pieces, so that what lies before a broken byte is not lost
    unpacked: list[bytes] = []
    step = _ZSTD_PIECE if isinstance(decompressor, _Zstd) else _PIECE
    for start in range(0, len(data), step):
        try:
            unpacked.append(decompressor.decompress(data[start : start + step], room))
        except (OSError, EOFError, RuntimeError, ValueError, zstandard.ZstdError) as error:
            return b"".join(unpacked), f"cannot be unpacked from byte {start} on ({error})"
        room -= len(unpacked[-1])
        if decompressor.eof or room <= 0:
            return b"".join(unpacked), ""
    return b"".join(unpacked), "compressed data end too early"
