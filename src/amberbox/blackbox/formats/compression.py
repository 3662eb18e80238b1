"""Unpack compressed pieces of recordings as far as they go."""

from __future__ import annotations

import bz2
from typing import Any

import zstandard

_PIECE = 1 << 16
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
    room = max(size, _BELIEVED) + 1
    unpacked, problem = _unpack_pieces(decompressor, data, room)
    if not problem and len(unpacked) != size:
        problem = f"unpacks to {len(unpacked)} bytes instead of {size}"
    return unpacked[: room - 1], problem


def compression_of(data: bytes) -> str:
    """Tell by its first bytes how a piece is compressed; ``none`` if it is not."""
    return next((name for name, magic in _MAGIC.items() if data.startswith(magic)), "none")


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
    for start in range(0, len(data), _PIECE):
        try:
            unpacked.append(decompressor.decompress(data[start : start + _PIECE], room))
        except (OSError, EOFError, RuntimeError, ValueError, zstandard.ZstdError) as error:
            return b"".join(unpacked), f"cannot be unpacked from byte {start} on ({error})"
        room -= len(unpacked[-1])
        if decompressor.eof or room <= 0:
            return b"".join(unpacked), ""
    return b"".join(unpacked), "compressed data end too early"
