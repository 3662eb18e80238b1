"""Unpack compressed pieces of recordings as far as they go."""

from __future__ import annotations

import bz2
from typing import Any

import zstandard

_PIECE = 1 << 16


def unpack(compression: str, data: bytes, size: int) -> tuple[bytes, str]:
    """Unpack at most ``size`` bytes; the second value says what went wrong, if anything.

    ``compression`` is ``none`` (or empty), ``bz2``, ``lz4`` or ``zstd``.
    """
    if compression in ("", "none"):
        return data, ""
    decompressor = _decompressor(compression)
    if decompressor is None:
        return b"", f"compression {compression!r} is not known"
    # one byte more than promised, to notice data that would unpack to more
    unpacked, problem = _unpack_pieces(decompressor, data, size + 1)
    if not problem and len(unpacked) != size:
        problem = f"unpacks to {len(unpacked)} bytes instead of {size}"
    return unpacked[:size], problem


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
