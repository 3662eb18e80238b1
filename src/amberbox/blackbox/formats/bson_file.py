"""The documents of a .bson file as mongodump writes it: one after the other, each with its length.

A file that is cut short or damaged gives the documents that are whole.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import IO, Any

from amberbox.blackbox.formats.bytesource import ByteSource, FileBytes
from amberbox.blackbox.formats.compression import write_unpacked
from amberbox.blackbox.formats.recording import Damage, Report
from amberbox.core.errors import UsageError

STRETCH_BYTES = 1 << 20
_LARGEST = 48 << 20
_SMALLEST = 5
_GZIP = 31
_PIECE = 1 << 14
_OBJECT_ID = b"\x07_id\0"
"""How a document of a collection goes on behind its length."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Neighbouring documents, and where they stand in their file."""

    offset: int
    documents: list[bytes]
    size: int


def open_bson(path: Path, report: Report, stack: ExitStack) -> FileBytes:
    """Open a .bson file, unpacking a .gz one into a scratch folder first."""
    if path.suffix == ".gz":
        path = _unpacked(path, report, Path(stack.enter_context(TemporaryDirectory())))
    file = FileBytes(path)
    stack.callback(file.close)
    return file


def _unpacked(path: Path, report: Report, folder: Path) -> Path:
    """Unpack a file as far as it goes."""
    target = folder / path.stem
    try:
        with path.open("rb") as packed:
            problem = write_unpacked(_pieces(packed), target)
    except (zlib.error, EOFError) as error:
        problem = str(error)
    if problem:
        damage = Damage(path.name, 0, path.stat().st_size, f"unpacked in part only ({problem})")
        report.add_damage(damage)
    return target


def _pieces(packed: IO[bytes]) -> Iterator[bytes]:
    """Unpack gzip, never more than a piece at once; raise zlib.error, or EOFError at its end."""
    unpacking = zlib.decompressobj(wbits=_GZIP)
    while not unpacking.eof:
        data = unpacking.unconsumed_tail or packed.read(_PIECE)
        if not data:
            raise EOFError("it is cut short")
        yield unpacking.decompress(data, _PIECE)


def stretches(source: ByteSource, on_damage: Callable[[int, int, str], None]) -> Iterator[Stretch]:
    """Give all documents that are whole; what lies between them is told to ``on_damage``."""
    at = 0
    while at < source.size:
        found = read_stretch(source, at)
        if found.documents:
            yield found
            at += found.size
        else:
            end = _next_document(source, at + 1)
            cut = end == source.size and _length(source.read(at, 4)) > source.size - at
            on_damage(at, end - at, "the file is cut short" if cut else "no document begins here")
            at = end


def read_stretch(source: ByteSource, offset: int) -> Stretch:
    """Read about a megabyte of documents, at least one if there is one at this place."""
    block = source.read(offset, STRETCH_BYTES)
    length = _length(block[:4])
    if len(block) < length <= _LARGEST:
        block = source.read(offset, length)
    documents, at = [], 0
    while (length := _length(block[at : at + 4])) and _is_document(block, at, length):
        documents.append(block[at : at + length])
        at += length
    return Stretch(offset, documents, at)


def _length(head: bytes) -> int:
    return int.from_bytes(head, "little") if len(head) == 4 else 0


def _is_document(block: bytes, at: int, length: int) -> bool:
    end = at + length
    return _SMALLEST <= length <= _LARGEST and end <= len(block) and block[end - 1] == 0


def _next_document(source: ByteSource, start: int) -> int:
    """Find the next place where a document of a collection begins, else the end of the file."""
    at = start
    while at < source.size:
        block = source.read(at, STRETCH_BYTES + len(_OBJECT_ID) + 4)
        place = block.find(_OBJECT_ID, 4)
        while place >= 0:
            if read_stretch(source, at + place - 4).documents:
                return at + place - 4
            place = block.find(_OBJECT_ID, place + 1)
        at += STRETCH_BYTES
    return source.size


@cache
def bson_package() -> ModuleType:
    """Return the ``bson`` package of pymongo; raises UsageError when it is not installed."""
    try:
        import bson
    except ImportError:
        bson = None  # type: ignore[assignment]  # the same as an older package of that name
    if not hasattr(bson, "decode_file_iter"):
        raise UsageError(
            "mongodump folders need pymongo, which is not installed here",
            "pip install amberbox[formats]",
        )
    return bson


@cache
def _codec() -> Any:
    bson_package()
    from bson.codec_options import CodecOptions, DatetimeConversion

    return CodecOptions(datetime_conversion=DatetimeConversion.DATETIME_AUTO)


def decode(document: bytes) -> dict[str, Any]:
    """Decode a document; raises ValueError if its bytes make no sense."""
    package = bson_package()
    try:
        decoded: dict[str, Any] = package.decode(document, _codec())
    except Exception as error:  # bson raises whatever it meets in bytes that make no sense
        raise ValueError(f"cannot be decoded: {error}") from None
    return decoded
