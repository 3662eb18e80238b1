"""Folders that mongodump made of a ROPOD black box: one collection is one topic.

Collections whose message type is known become ROS 1 messages again, as they once came over the
wire; everything else is kept as MessagePack, whose columns are inferred. A .bson file that is cut
short or damaged gives the documents that are whole.
"""

from __future__ import annotations

import datetime
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from struct import Struct, error, pack
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import IO, Any, TypeAlias

import msgspec

from amberbox.blackbox.columns.ros_definition import (
    SIZES,
    FieldType,
    RosDefinition,
    parse_definition,
    with_current_names,
)
from amberbox.blackbox.formats._recording import (
    ByteSource,
    ConversionCache,
    ConvertedBlock,
    ConvertedMessage,
    FileBytes,
    PieceCounts,
    ReadOptions,
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReader,
    RecordingReport,
    TopicOrigin,
    write_unpacked,
)
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timestamps import stamp_of, time_of
from amberbox.core.types import Schema, Topic

_SEPARATOR = "=" * 80 + "\n"
_FIELD = re.compile(r"^[ \t]*([A-Za-z][\w/]*)(?:[ \t]*+\[\d*\])?[ \t]++\w+[ \t]*(?:#.*)?$", re.M)
_PRIMITIVES = {*SIZES, "byte", "char", "string"}


@dataclass(frozen=True, slots=True)
class FoundDefinition:
    """A complete definition; ``place`` is where its first text comes from."""

    schema: Schema
    place: str


class MessageTypes:
    """Finds definitions; those of the folder come before the built-in ones of ROS 1.

    The folder holds ``package/msg/Name.msg`` or ``package/Name.msg`` at any depth. Files that lie
    in it directly are taken for any package whose type is not known otherwise.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._files: dict[str, Path] = {}
        self._flat: dict[str, Path] = {}
        if folder is not None:
            self._index(folder)

    def _index(self, folder: Path) -> None:
        if not folder.is_dir():
            raise UsageError(f"there is no folder {folder}", "--msg names a folder of .msg files")
        for path in sorted(folder.rglob("*.msg")):
            parents = [p.name for p in path.parents if p != folder and folder in p.parents]
            package = next((name for name in parents if name != "msg"), "")
            if package:
                self._files.setdefault(f"{package}/{path.stem}", path)
            else:
                self._flat[path.stem] = path
        if not self._files and not self._flat:
            raise UsageError(f"{folder} holds no .msg file", "--msg names a folder of .msg files")

    def find(self, type_name: str) -> FoundDefinition | None:
        """Return the definition of a type with all it needs; None if one of them is not known.

        Raises AmberboxError when a file cannot be read.
        """
        root = with_current_names(type_name).replace("/msg/", "/")
        texts: dict[str, str] = {}
        places: list[str] = []
        missing = [root]
        while missing:
            name = missing.pop(0)
            found = self._text(name)
            if found is None:
                return None
            texts[name] = found[0]
            places.append(found[1])
            missing += [n for n in _needed(name, found[0]) if n not in texts and n not in missing]
        return FoundDefinition(Schema(root, "ros1msg", _joined(texts).encode()), places[0])

    def _text(self, name: str) -> tuple[str, str] | None:
        path = self._files.get(name)
        built_in = _built_in(name) if path is None else None
        if built_in is not None:
            return built_in, "built in"
        path = path or self._flat.get(name.partition("/")[2])
        return None if path is None else (_read(path), f"from {self._folder}")


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").replace("\r\n", "\n")
    except OSError as error:
        raise AmberboxError(
            f"cannot read {path}: {error.strerror}", "check the path and its permissions"
        ) from None


def _needed(name: str, text: str) -> Iterator[str]:
    """Yield the full names of the structures in a definition; constants are left out."""
    package = name.partition("/")[0]
    for base in map(with_current_names, _FIELD.findall(text)):
        if base == "Header":
            yield "std_msgs/Header"
        elif base not in _PRIMITIVES:
            yield base.replace("/msg/", "/") if "/" in base else f"{package}/{base}"


def _joined(texts: dict[str, str]) -> str:
    """Join definitions in the form of ROS 1 bags."""
    (_, first), *others = texts.items()
    ended = [f"MSG: {name}\n{_line_end(text)}" for name, text in others]
    return _SEPARATOR.join([_line_end(first), *ended])


def _line_end(text: str) -> str:
    return text if text.endswith("\n") or not text else f"{text}\n"


@cache  # takes 0.1 s to build and never changes
def _built_in_types() -> Any:
    """Return the message types of ROS 1 noetic that rosbags knows."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)


def _built_in(name: str) -> str | None:
    """Return the built-in definition of a type without those it needs; None if unknown."""
    full, types = name.replace("/", "/msg/"), _built_in_types()
    if full not in types.fielddefs:
        return None
    text, _ = types.generate_msgdef(full, ros_version=1)
    return str(text).partition(_SEPARATOR)[0]


_CODES = {
    "int8": "b", "byte": "b", "uint8": "B", "char": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_BYTES = {"int8", "byte", "uint8", "char"}
_REFUSED = (error, OverflowError, TypeError, ValueError)

# appends the bytes of a value; raises MisfitError if it cannot be one of the type
Write: TypeAlias = Callable[[Any, list[bytes]], None]


class MisfitError(Exception):
    """A document that does not fit a message type; the text states the place and the reason."""


def compile_encoder(definition: RosDefinition) -> Callable[[Any], bytes]:
    """Return a function that encodes a document as a ROS 1 message.

    A document fits if it has all fields of the type and no others, and each value is one of its
    field's type. It raises MisfitError for those that do not. Whole numbers are accepted for floats
    and the other way round where nothing is lost.
    """
    write = _structure(definition, definition.root)

    def encode(document: Any) -> bytes:
        pieces: list[bytes] = []
        write(document, pieces)
        return b"".join(pieces)

    return encode


def _structure(definition: RosDefinition, name: str) -> Write:
    fields = definition.structures[name].fields
    names = {field for field, _ in fields}
    steps: list[Write] = []
    for plain, group in groupby(fields, key=lambda item: _is_number(item[1])):
        if plain:
            steps.append(_numbers(list(group)))
        else:
            steps += [_field(field, _value(definition, kind)) for field, kind in group]

    def write(value: Any, pieces: list[bytes]) -> None:
        if not isinstance(value, dict):
            raise MisfitError(f"is no structure but {_named(value)}")
        if value.keys() != names:
            raise MisfitError(_difference(names, value))
        for step in steps:
            step(value, pieces)

    return write


def _is_number(kind: FieldType) -> bool:
    return kind.count is None and kind.base in _CODES


def _difference(names: set[str], value: Mapping[str, Any]) -> str:
    lacking, unknown = sorted(names - value.keys()), sorted(map(str, value.keys() - names))
    parts = [f"lacks {', '.join(lacking)}"] if lacking else []
    return " and ".join([*parts, f"has {', '.join(unknown)} too"] if unknown else parts)


def _numbers(fields: Sequence[tuple[str, FieldType]]) -> Write:
    """Write neighbouring numbers of a structure at once."""
    names = [name for name, _ in fields]
    codes = [_CODES[kind.base] for _, kind in fields]
    packed = Struct("<" + "".join(codes)).pack
    get: Callable[[Any], tuple[Any, ...]] = (
        itemgetter(*names) if len(names) > 1 else lambda value: (value[names[0]],)
    )

    def write(value: Any, pieces: list[bytes]) -> None:
        try:
            pieces.append(packed(*get(value)))
        except _REFUSED:  # one by one: a whole number may be stored as a float
            for name, code in zip(names, codes, strict=True):
                pieces.append(_number(name, code, value[name]))

    return write


def _number(name: str, code: str, value: Any) -> bytes:
    try:
        return pack("<" + code, _as_number(code, value))
    except _REFUSED:
        raise MisfitError(f"{name} is {_named(value)}") from None


def _as_number(code: str, value: Any) -> Any:
    """Convert 3.0 to 3 where a whole number is needed, and decimals of MongoDB."""
    if hasattr(value, "to_decimal"):
        return int(value.to_decimal())
    whole = isinstance(value, float) and code not in "fd" and value.is_integer()
    return int(value) if whole else value


def _field(name: str, write: Write) -> Write:
    def write_field(value: Any, pieces: list[bytes]) -> None:
        try:
            write(value[name], pieces)
        except MisfitError as misfit:
            text = str(misfit)
            inner = text.startswith(("is ", "has ", "lacks "))
            raise MisfitError(f"{name}{' ' if inner else '/'}{text}") from None

    return write_field


def _value(definition: RosDefinition, kind: FieldType) -> Write:
    if kind.count is None:
        return _single(definition, kind.base)
    if kind.base in _CODES:
        return _number_array(kind)
    write = _single(definition, kind.base)

    def write_array(value: Any, pieces: list[bytes]) -> None:
        _begin(kind, value, pieces)
        for element in value:
            write(element, pieces)

    return write_array


def _single(definition: RosDefinition, base: str) -> Write:
    return _SIMPLE[base] if base in _SIMPLE else _structure(definition, base)


def _begin(kind: FieldType, value: Any, pieces: list[bytes]) -> None:
    if not isinstance(value, list):
        raise MisfitError(f"is no list but {_named(value)}")
    _begin_counted(kind, len(value), pieces)


def _begin_counted(kind: FieldType, count: int, pieces: list[bytes]) -> None:
    if kind.count == FieldType.SEQUENCE:
        pieces.append(count.to_bytes(4, "little"))
    elif count != kind.count:
        raise MisfitError(f"has {count} elements instead of {kind.count}")


def _number_array(kind: FieldType) -> Write:
    code = _CODES[kind.base]

    def write(value: Any, pieces: list[bytes]) -> None:
        if isinstance(value, bytes) and kind.base in _BYTES:
            _begin_counted(kind, len(value), pieces)
            pieces.append(value)
            return
        _begin(kind, value, pieces)
        try:
            pieces.append(pack(f"<{len(value)}{code}", *value))
        except _REFUSED:
            pieces += [_number(f"element {n}", code, item) for n, item in enumerate(value)]

    return write


def _write_bool(value: Any, pieces: list[bytes]) -> None:
    if not isinstance(value, int | float) or value not in (0, 1):
        raise MisfitError(f"is {_named(value)} and not true or false")
    pieces.append(b"\1" if value else b"\0")


def _write_text(value: Any, pieces: list[bytes]) -> None:
    if not isinstance(value, str | bytes):
        raise MisfitError(f"is no text but {_named(value)}")
    data = value.encode() if isinstance(value, str) else value
    pieces += [len(data).to_bytes(4, "little"), data]


def _write_time(value: Any, pieces: list[bytes]) -> None:
    try:
        if isinstance(value, dict):
            pieces.append(pack("<II", *_pair(value)))
        else:
            pieces.append(pack("<II", *divmod(_epoch_ns(value), NS)))
    except _REFUSED:
        raise MisfitError(f"is no time but {_named(value)}") from None


def _epoch_ns(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    stamp_ns = time_of(value)
    if value and not stamp_ns:
        raise ValueError
    return stamp_ns


def _write_duration(value: Any, pieces: list[bytes]) -> None:
    try:
        if not isinstance(value, dict):
            raise TypeError
        pieces.append(pack("<ii", *_pair(value)))
    except _REFUSED:
        raise MisfitError(f"is no duration but {_named(value)}") from None


def _pair(value: Mapping[str, Any]) -> tuple[Any, Any]:
    if value.keys() == {"secs", "nsecs"}:
        return _as_number("i", value["secs"]), _as_number("i", value["nsecs"])
    if value.keys() == {"sec", "nsec"}:
        return _as_number("i", value["sec"]), _as_number("i", value["nsec"])
    raise ValueError


_SIMPLE: Mapping[str, Write] = {
    "bool": _write_bool,
    "string": _write_text,
    "time": _write_time,
    "duration": _write_duration,
}


def _named(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


STRETCH_BYTES = 1 << 20
_LARGEST = 48 << 20
_SMALLEST = 5
_GZIP = 31
_PIECE = 1 << 14
_OBJECT_ID = b"\x07_id\0"  # the bytes after the length of a document in a collection


@dataclass(frozen=True, slots=True)
class DocumentBlock:
    """Neighbouring documents, and their place in the file."""

    offset: int
    documents: list[bytes]
    size: int


def open_bson(path: Path, report: RecordingReport, stack: ExitStack) -> FileBytes:
    """Open a .bson file, unpacking a .gz one into a scratch folder first."""
    if path.suffix == ".gz":
        target = Path(stack.enter_context(TemporaryDirectory())) / path.stem
        try:
            with path.open("rb") as packed:
                problem = write_unpacked(_pieces(packed), target)
        except (zlib.error, EOFError) as error:
            problem = str(error)
        if problem:
            damage = RecordingDamage(
                path.name, 0, path.stat().st_size, f"unpacked in part only ({problem})"
            )
            report.add_damage(damage)
        path = target
    file = FileBytes(path)
    stack.callback(file.close)
    return file


def _pieces(packed: IO[bytes]) -> Iterator[bytes]:
    """Unpack gzip, never more than a piece at once; raise zlib.error, or EOFError at its end."""
    unpacking = zlib.decompressobj(wbits=_GZIP)
    while not unpacking.eof:
        data = unpacking.unconsumed_tail or packed.read(_PIECE)
        if not data:
            raise EOFError("it is cut short")
        yield unpacking.decompress(data, _PIECE)


def document_blocks(
    source: ByteSource, on_damage: Callable[[int, int, str], None]
) -> Iterator[DocumentBlock]:
    """Yield all complete documents; ``on_damage`` is called for the bytes between them."""
    at = 0
    while at < source.size:
        found = read_document_block(source, at)
        if found.documents:
            yield found
            at += found.size
        else:
            end = _next_document(source, at + 1)
            cut = end == source.size and _length(source.read(at, 4)) > source.size - at
            on_damage(at, end - at, "the file is cut short" if cut else "no document begins here")
            at = end


def read_document_block(source: ByteSource, offset: int) -> DocumentBlock:
    """Read about a megabyte of documents, at least one if there is one at this offset."""
    block = source.read(offset, STRETCH_BYTES)
    length = _length(block[:4])
    if len(block) < length <= _LARGEST:
        block = source.read(offset, length)
    documents, at = [], 0
    while (length := _length(block[at : at + 4])) and _is_document(block, at, length):
        documents.append(block[at : at + length])
        at += length
    return DocumentBlock(offset, documents, at)


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
            if read_document_block(source, at + place - 4).documents:
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


_TIME = "timestamp"
_ID = "_id"
_MS = 1_000_000
_EPOCH = datetime.datetime(1970, 1, 1)
_MILLISECOND = datetime.timedelta(milliseconds=1)


def log_time_ns(document: Mapping[str, Any]) -> int:
    """Return when the black box logged a document; 0 if unknown.

    That is its ``timestamp``: seconds as a float (with a resolution of 0.24 us), or a time in
    another form.
    """
    value = document.get(_TIME)
    if isinstance(value, datetime.datetime):
        return (value.replace(tzinfo=None) - _EPOCH) // _MILLISECOND * _MS
    return stamp_of(value)


def time_of_id_ns(document: Mapping[str, Any]) -> int:
    """Return when a document's id was made, to the second; 0 if it is no ObjectId."""
    made = getattr(document.get(_ID), "generation_time", None)
    return int(made.timestamp()) * 1000 * _MS if made is not None else 0


def content_of(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document without the fields added by the black box: its id and its log time.

    Variables that the box had unrolled (``pose/position/x``) are put together again.
    """
    content = {key: value for key, value in document.items() if key not in (_ID, _TIME)}
    if any("/" in key for key in content):
        return _rolled_up(content)
    return content


def _rolled_up(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Nest paths; the document stays unchanged when a path is a value and a structure at once."""
    nested: dict[str, Any] = {}
    for path, value in flat.items():
        *parents, name = path.strip("/").split("/")
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
            if not isinstance(place, dict):
                return dict(flat)
        if name in place:
            return dict(flat)
        place[name] = value
    return nested


def as_msgpack(content: Mapping[str, Any]) -> bytes:
    """Encode any document as MessagePack, which keeps NaN, infinities and binary.

    Raises ValueError for a value that MessagePack cannot hold.
    """
    try:
        return _encode(content)
    except (TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"cannot be kept: {error}") from None


def _plain(value: Any) -> Any:
    """Convert types that only MongoDB has to plain ones."""
    match value:
        case int():
            return int(value)
        case bytes():
            return bytes(value)
        case str():
            return str(value)
        case Mapping():
            return dict(value)
    return str(value)


_encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode


METADATA = "black_box_metadata"
# ending of the topic for the documents of a typed collection that are no such message
UNFIT = "/unfit"
_SUFFIXES = (".bson", ".bson.gz")
_TYPED, _INFERRED = 0, 1


def is_mongodump(path: Path) -> bool:
    """Return whether a folder holds collections of mongodump."""
    return bool(collections(path))


def collections(folder: Path) -> dict[str, Path]:
    """Return the files of a dump by the names of their collections."""
    found = (path for path in sorted(folder.iterdir()) if path.name.endswith(_SUFFIXES))
    return {path.name.partition(".bson")[0]: path for path in found}


@dataclass(frozen=True, slots=True)
class _Described:
    """Topic and type of a collection, from the metadata of the black box."""

    topic: str = ""
    type: str = ""


@dataclass
class _Collection:
    """One collection while it is read."""

    name: str
    file: FileBytes
    account: PieceCounts
    described: _Described
    found: FoundDefinition | None = None
    encode: Callable[[Any], bytes] | None = None
    problem: str = ""
    counts: dict[int, int] = field(default_factory=lambda: {_TYPED: 0, _INFERRED: 0})
    times_of_ids: int = 0
    first_misfit: str = ""
    topic_of: tuple[int, int] = (-1, -1)


@dataclass
class _Dump:
    """State while a folder is read."""

    report: RecordingReport
    types: MessageTypes
    kept: ConversionCache = field(default_factory=ConversionCache)
    topics: list[Topic] = field(default_factory=list)
    origins: list[TopicOrigin] = field(default_factory=list)
    parts: list[RecordingPart] = field(default_factory=list)
    stack: ExitStack = field(default_factory=ExitStack)


def open_mongodump(path: Path, options: ReadOptions) -> RecordingReader:
    """Open a folder of collections; every document is converted once to find its type."""
    bson_package()
    dump = _Dump(RecordingReport("mongodump folder"), MessageTypes(options.messages))
    files = collections(path)
    with dump.stack as stack:
        described = _describe(files.pop(METADATA, None), dump)
        for name in sorted(described.keys() - files.keys()):
            dump.report.add_note(f"{name} is described in {METADATA}, but its file is missing")
        for name, file in files.items():
            if name.startswith("system."):
                dump.report.add_note(f"{file.name} is MongoDB's own and left out")
            else:
                _add(name, file, described.get(name), dump)
        close = stack.pop_all().close
    return RecordingReader(path, dump.topics, dump.parts, dump.report, close, dump.origins)


# -- the metadata of the black box


def _describe(path: Path | None, dump: _Dump) -> dict[str, _Described]:
    if path is None:
        dump.report.add_note(f"there is no {METADATA}.bson, so no types are known")
        return {}
    described: dict[str, _Described] = {}
    for document in _documents(path, dump):
        name, ros = str(document.get("collection_name", "")), document.get("ros")
        if name and isinstance(ros, Mapping):
            new = _Described(str(ros.get("topic_name") or ""), str(ros.get("msg_type") or ""))
            known = described.setdefault(name, new)
            if known != new:
                dump.report.add_note(
                    f"{name} is described twice; {known.topic} {known.type} counts"
                )
        elif name:
            described.setdefault(name, _Described())
        elif document.get("type") == "database":
            dump.report.add_note(f"a merged dump: database {document.get('name')} is in it")
    return described


def _documents(path: Path, dump: _Dump) -> Iterator[Mapping[str, Any]]:
    file = open_bson(path, dump.report, dump.stack)
    for found in document_blocks(file, partial(_note_damage, dump.report, path.name)):
        for document in found.documents:
            try:
                yield decode(document)
            except ValueError as error:
                _note_damage(dump.report, path.name, found.offset, len(document), str(error))


def _note_damage(report: RecordingReport, name: str, offset: int, length: int, reason: str) -> None:
    report.add_damage(RecordingDamage(name, offset, length, reason))


# -- the documents of one collection


def _add(name: str, path: Path, described: _Described | None, dump: _Dump) -> None:
    if described is None:
        dump.report.add_note(f"{name} is not described in {METADATA}")
    account = PieceCounts(path.name, "documents")
    dump.report.accounts.append(account)
    file = open_bson(path, dump.report, dump.stack)
    collection = _Collection(name, file, account, described or _Described())
    _find_type(collection, dump.types)
    blocks = _convert_all(collection, dump)
    _add_topics(collection, dump)
    dump.parts += [
        RecordingPart(b.first, b.last, b.number, partial(_load, b, collection.topic_of))
        for b in blocks
    ]
    _report_oddities(collection, dump.report)


def _find_type(collection: _Collection, types: MessageTypes) -> None:
    type_name = collection.described.type
    if not type_name:
        return
    try:
        collection.found = types.find(type_name)
        if collection.found is not None:
            collection.encode = compile_encoder(parse_definition(collection.found.schema))
        else:
            collection.problem = f"{type_name} is not known; --msg DIR names its definition"
    except AmberboxError as error:
        collection.problem = error.what


def _convert_all(collection: _Collection, dump: _Dump) -> list[ConvertedBlock]:
    """Convert all documents once."""
    on_damage = partial(_note_damage, dump.report, collection.account.name)
    blocks = []
    for found in document_blocks(collection.file, on_damage):
        collection.account.total += len(found.documents)
        messages = list(_converted(collection, found, dump.report))
        if messages:
            again = partial(_convert_again, collection, found.offset)
            blocks.append(dump.kept.keep(messages, again))
    return blocks


def _converted(
    collection: _Collection, found: DocumentBlock, report: RecordingReport
) -> Iterator[ConvertedMessage]:
    """Convert the documents of a block and count the result of each."""
    at = found.offset
    for raw in found.documents:
        try:
            kind, time_ns, data = _message(collection, raw)
            collection.counts[kind] += 1
            yield kind, time_ns, data
        except ValueError as error:
            collection.account.refused[str(error).partition(":")[0]] += 1
            if str(error) != _NO_TIME:
                _note_damage(report, collection.account.name, at, len(raw), str(error))
        at += len(raw)


_NO_TIME = "has no time"


def _message(collection: _Collection, raw: bytes) -> ConvertedMessage:
    document = decode(raw)
    time_ns = log_time_ns(document)
    if not time_ns:
        time_ns = time_of_id_ns(document)
        collection.times_of_ids += bool(time_ns)
    if not time_ns:
        raise ValueError(_NO_TIME)
    content = content_of(document)
    if collection.encode is not None:
        try:
            return _TYPED, time_ns, collection.encode(content)
        except MisfitError as misfit:
            collection.first_misfit = collection.first_misfit or str(misfit)
    return _INFERRED, time_ns, as_msgpack(content)


def _convert_again(collection: _Collection, offset: int) -> list[ConvertedMessage]:
    messages = []
    for raw in read_document_block(collection.file, offset).documents:
        try:
            messages.append(_message(collection, raw))
        except ValueError:  # counted when the folder was opened
            continue
    return messages


def _load(block: ConvertedBlock, topic_of: tuple[int, int]) -> list[RecordedMessage]:
    return [
        RecordedMessage(topic_of[kind], time_ns, None, data) for kind, time_ns, data in block.load()
    ]


# -- which collections become topics


def _add_topics(collection: _Collection, dump: _Dump) -> None:
    """Add the topics that have messages; documents that do not fit get one of their own."""
    typed, inferred = collection.counts[_TYPED], collection.counts[_INFERRED]
    ros = collection.described.topic
    name, source = (ros, "ros") if ros else (f"/{collection.name}", "")
    places = [-1, -1]
    if typed and collection.found is not None:
        place = collection.found.place
        kind = f"typed ({collection.found.schema.name}, {place})"
        topic = Topic(name, "ros1", collection.found.schema)
        places[_TYPED] = _add_topic(dump, topic, TopicOrigin(source, kind=kind))
    if inferred:
        name += UNFIT if typed else ""
        topic = Topic(name, "msgpack")
        origin = TopicOrigin(source, kind=_why_inferred(collection))
        places[_INFERRED] = _add_topic(dump, topic, origin)
    collection.topic_of = (places[_TYPED], places[_INFERRED])
    collection.account.topics = tuple(place for place in places if place >= 0)


def _add_topic(dump: _Dump, topic: Topic, origin: TopicOrigin) -> int:
    dump.topics.append(topic)
    dump.origins.append(origin)
    return len(dump.topics) - 1


def _why_inferred(collection: _Collection) -> str:
    if collection.problem:
        return f"inferred ({collection.problem})"
    if collection.found is not None:
        return f"inferred (does not fit {collection.found.schema.name})"
    return "inferred"


def _report_oddities(collection: _Collection, report: RecordingReport) -> None:
    if collection.first_misfit and collection.found is not None:
        count, name = collection.counts[_INFERRED], collection.found.schema.name
        text = f"{collection.name}: {count} documents do not fit {name}"
        report.add_note(f"{text} (the first: {collection.first_misfit})")
    if collection.times_of_ids:
        text = f"{collection.times_of_ids} documents have no timestamp"
        report.add_note(f"{collection.name}: {text}; the second that their id was made is taken")
