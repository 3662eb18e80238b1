"""Folders that mongodump made of a ROPOD black box: one collection is one topic.

Collections whose message type is known become ROS 1 messages again, as they once came over the
wire; everything else is kept as MessagePack, whose columns are inferred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from amberbox.blackbox.formats import bson_file
from amberbox.blackbox.formats.bytesource import FileBytes
from amberbox.blackbox.formats.kept import Converted, Kept
from amberbox.blackbox.formats.message_types import FoundType, MessageTypes
from amberbox.blackbox.formats.mongo_document import (
    as_msgpack,
    content_of,
    log_time_ns,
    time_of_id_ns,
)
from amberbox.blackbox.formats.options import ReadOptions
from amberbox.blackbox.formats.recording import (
    Account,
    Damage,
    Origin,
    Part,
    RecordedMessage,
    Recording,
    Report,
)
from amberbox.blackbox.formats.ros1_encode import MisfitError, compile_encoder
from amberbox.blackbox.unroll.definition import parse_definition
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Topic

METADATA = "black_box_metadata"
UNFIT = "/unfit"
"""Ending of the topic for the documents of a typed collection that are no such message."""
_SUFFIXES = (".bson", ".bson.gz")
_TYPED, _INFERRED = 0, 1


def is_mongodump(path: Path) -> bool:
    """Tell whether a folder holds collections as mongodump writes them."""
    return bool(collections(path))


def collections(folder: Path) -> dict[str, Path]:
    """Return the files of a dump by the names of their collections."""
    found = (path for path in sorted(folder.iterdir()) if path.name.endswith(_SUFFIXES))
    return {path.name.partition(".bson")[0]: path for path in found}


@dataclass(frozen=True, slots=True)
class _Described:
    """What the black box wrote down about a collection."""

    topic: str = ""
    type: str = ""


@dataclass
class _Collection:
    """One collection while it is read."""

    name: str
    file: FileBytes
    account: Account
    described: _Described
    found: FoundType | None = None
    encode: Callable[[Any], bytes] | None = None
    problem: str = ""
    counts: dict[int, int] = field(default_factory=lambda: {_TYPED: 0, _INFERRED: 0})
    times_of_ids: int = 0
    first_misfit: str = ""
    topic_of: tuple[int, int] = (-1, -1)


@dataclass
class _Dump:
    """What is gathered while a folder is read."""

    report: Report
    types: MessageTypes
    kept: Kept = field(default_factory=Kept)
    topics: list[Topic] = field(default_factory=list)
    origins: list[Origin] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    stack: ExitStack = field(default_factory=ExitStack)


def open_mongodump(path: Path, options: ReadOptions) -> Recording:
    """Open a folder of collections; every document is converted once to see what fits."""
    bson_file.bson_package()
    dump = _Dump(Report("mongodump folder"), MessageTypes(options.messages))
    files = collections(path)
    try:
        described = _describe(files.pop(METADATA, None), dump)
        for name in sorted(described.keys() - files.keys()):
            dump.report.add_note(f"{name} is described in {METADATA}, but its file is missing")
        for name, file in files.items():
            if name.startswith("system."):
                dump.report.add_note(f"{file.name} is MongoDB's own and left out")
            else:
                _add(name, file, described.get(name), dump)
    except BaseException:
        dump.stack.close()
        raise
    return Recording(path, dump.topics, dump.parts, dump.report, dump.stack.close, dump.origins)


# -- what the black box says about its collections


def _describe(path: Path | None, dump: _Dump) -> dict[str, _Described]:
    if path is None:
        dump.report.add_note(f"there is no {METADATA}.bson, so no types are known")
        return {}
    described: dict[str, _Described] = {}
    for document in _documents(path, dump):
        name, ros = str(document.get("collection_name", "")), document.get("ros")
        if name and isinstance(ros, Mapping):
            _take(described, name, ros, dump.report)
        elif name:
            described.setdefault(name, _Described())
        elif document.get("type") == "database":
            dump.report.add_note(f"a merged dump: database {document.get('name')} is in it")
    return described


def _documents(path: Path, dump: _Dump) -> Iterator[Mapping[str, Any]]:
    file = bson_file.open_bson(path, dump.report, dump.stack)
    for stretch in bson_file.stretches(file, partial(_note_damage, dump.report, path.name)):
        for document in stretch.documents:
            try:
                yield bson_file.decode(document)
            except ValueError as error:
                _note_damage(dump.report, path.name, stretch.offset, len(document), str(error))


def _take(
    described: dict[str, _Described], name: str, ros: Mapping[str, Any], report: Report
) -> None:
    new = _Described(str(ros.get("topic_name") or ""), str(ros.get("msg_type") or ""))
    known = described.setdefault(name, new)
    if known != new:
        report.add_note(f"{name} is described twice; {known.topic} {known.type} counts")


def _note_damage(report: Report, name: str, offset: int, length: int, reason: str) -> None:
    report.add_damage(Damage(name, offset, length, reason))


# -- the documents of one collection


def _add(name: str, path: Path, described: _Described | None, dump: _Dump) -> None:
    if described is None:
        dump.report.add_note(f"{name} is not described in {METADATA}")
    account = Account(path.name, "documents")
    dump.report.accounts.append(account)
    file = bson_file.open_bson(path, dump.report, dump.stack)
    collection = _Collection(name, file, account, described or _Described())
    _find_type(collection, dump.types)
    loads = _convert_all(collection, dump)
    _add_topics(collection, dump)
    dump.parts += [_part(messages, load, collection) for messages, load in loads]
    _tell(collection, dump.report)


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


_Load = Callable[[], Sequence[Converted]]


def _convert_all(collection: _Collection, dump: _Dump) -> list[tuple[tuple[int, int, int], _Load]]:
    """Convert all documents once; returns first and last time and count of each stretch."""
    on_damage = partial(_note_damage, dump.report, collection.account.name)
    loads = []
    for stretch in bson_file.stretches(collection.file, on_damage):
        collection.account.total += len(stretch.documents)
        messages = list(_converted(collection, stretch, dump.report))
        if messages:
            times = [time_ns for _, time_ns, _ in messages]
            again = partial(_convert_again, collection, stretch.offset)
            load = dump.kept.keep(messages, again)
            loads.append(((min(times), max(times), len(times)), load))
    return loads


def _converted(
    collection: _Collection, stretch: bson_file.Stretch, report: Report
) -> Iterator[Converted]:
    """Convert the documents of a stretch, counting what becomes of each."""
    at = stretch.offset
    for raw in stretch.documents:
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


def _message(collection: _Collection, raw: bytes) -> Converted:
    document = bson_file.decode(raw)
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


def _convert_again(collection: _Collection, offset: int) -> list[Converted]:
    messages = []
    for raw in bson_file.read_stretch(collection.file, offset).documents:
        try:
            messages.append(_message(collection, raw))
        except ValueError:  # counted when the folder was opened
            continue
    return messages


def _part(span: tuple[int, int, int], load: _Load, collection: _Collection) -> Part:
    first, last, count = span
    return Part(first, last, count, partial(_load, load, collection.topic_of))


def _load(load: _Load, topic_of: tuple[int, int]) -> list[RecordedMessage]:
    return [RecordedMessage(topic_of[kind], time_ns, None, data) for kind, time_ns, data in load()]


# -- what becomes a topic


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
        places[_TYPED] = _add_topic(dump, topic, Origin(source, kind=kind))
    if inferred:
        name += UNFIT if typed else ""
        topic = Topic(name, "msgpack")
        origin = Origin(source, kind=_why_inferred(collection))
        places[_INFERRED] = _add_topic(dump, topic, origin)
    collection.topic_of = (places[_TYPED], places[_INFERRED])
    collection.account.topics = tuple(place for place in places if place >= 0)


def _add_topic(dump: _Dump, topic: Topic, origin: Origin) -> int:
    dump.topics.append(topic)
    dump.origins.append(origin)
    return len(dump.topics) - 1


def _why_inferred(collection: _Collection) -> str:
    if collection.problem:
        return f"inferred ({collection.problem})"
    if collection.found is not None:
        return f"inferred (does not fit {collection.found.schema.name})"
    return "inferred"


def _tell(collection: _Collection, report: Report) -> None:
    if collection.first_misfit and collection.found is not None:
        count, name = collection.counts[_INFERRED], collection.found.schema.name
        text = f"{collection.name}: {count} documents do not fit {name}"
        report.add_note(f"{text} (the first: {collection.first_misfit})")
    if collection.times_of_ids:
        text = f"{collection.times_of_ids} documents have no timestamp"
        report.add_note(f"{collection.name}: {text}; the second that their id was made is taken")
