"""Write documents to MongoDB: acknowledged, in bounded batches, each at most once by its id."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from amberbox.blackbox.mirror.documents import (
    TIMESTAMP,
    Document,
    Layout,
    documents,
    id_bytes,
    metadata,
    slices_of,
)
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Batch, Position

METADATA = "black_box_metadata"
BATCH_ROWS = 500
BATCH_BYTES = 4 << 20
LARGEST_BYTES = 16 << 20  # of a document, by MongoDB
_CONNECT_MS = 5_000
_ANSWER_MS = 10_000
_DUPLICATE = 11000
# errors of a single write that say nothing about its document: it is written again later
_TEMPORARY = frozenset({
    13, 18, 24, 50, 64, 89, 91, 112, 189, 262, 8000, 9001, 10107, 11600, 11602, 13435, 13436, 14031,
})  # fmt: skip
# errors of a whole request that are about a document in it
_OF_DOCUMENTS = frozenset({2, 9, 14, 15, 22, 52, 57, 121, 10334, 17280, 17419, 17420})


class UnreachableError(AmberboxError):
    """The database took nothing, or not everything; the same rows have to be written again."""


@dataclass
class Written:
    """What became of documents: taken now, there before, refused."""

    taken: int = 0
    known: int = 0
    refused: int = 0
    refusal: str = ""

    def refuse(self, reason: str) -> None:
        """Count a document that the database does not take."""
        self.refused += 1
        self.refusal = " ".join(reason.split())[:300]


@dataclass(frozen=True)
class MongoTarget:
    """Address of a database, with its login; ``password`` never appears in a text."""

    url: str
    database: str
    user: str = ""
    password: str = field(default="", repr=False)
    layout: Layout = "nested"


class MongoMirror:
    """The collections of a database: rows are added, then written; ``written`` counts them.

    A connection is made when something is written. Raises UsageError where pymongo is missing, or
    for an address that it does not understand.
    """

    def __init__(self, target: MongoTarget, store_id: str) -> None:
        try:
            import bson.raw_bson
            import pymongo
            import pymongo.errors
        except ImportError:
            raise UsageError(
                "the mirror needs pymongo, which is not installed here",
                "pip install 'amberbox[formats]'",
            ) from None
        self._bson, self._errors = bson, pymongo.errors
        self._target, self._store_id = target, store_id
        login: dict[str, Any] = (
            {"username": target.user, "password": target.password} if target.user else {}
        )
        try:
            self._client: Any = pymongo.MongoClient(
                target.url, **login, appname="amberbox", maxPoolSize=1, connect=False,
                connectTimeoutMS=_CONNECT_MS, serverSelectionTimeoutMS=_CONNECT_MS,
                socketTimeoutMS=_ANSWER_MS, waitQueueTimeoutMS=_ANSWER_MS,
            )  # fmt: skip
        except (pymongo.errors.PyMongoError, ValueError) as error:
            raise UsageError(f"mongodb.url: {error}", "mongodb://HOST:27017") from None
        concern = self._client.write_concern
        if concern.is_server_default:
            concern = pymongo.WriteConcern(w=1, j=True)
        self._database = self._client.get_database(target.database, write_concern=concern)
        self._prepared: set[str] = set()
        self._described: dict[str, Document] = {}
        self._waiting: dict[str, deque[bytes]] = {}
        self.waiting_bytes = 0
        self.written = Written()

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def add(self, batch: Batch) -> None:
        """Encode the rows of an item, to be written with the next ``flush``."""
        if batch.item not in self._described:
            self._described[batch.item] = metadata(batch)
        waiting = self._waiting.setdefault(batch.item, deque())
        for part in slices_of(batch, BATCH_ROWS):
            for data in self._encoded(part):
                waiting.append(data)
                self.waiting_bytes += len(data)

    def flush(self, alive: Callable[[], None]) -> None:
        """Write all rows added, to a collection per item; ``alive`` is called after each request.

        Raises UnreachableError when not all were acknowledged: the next call writes the rest. A row
        that is written again gives no second document.
        """
        try:
            for item, waiting in self._waiting.items():
                if waiting:
                    self._prepare(item)
                    alive()
                while waiting:
                    group = _first_group(waiting)
                    self._insert(self._database[item], group, alive)
                    for _ in group:
                        self.waiting_bytes -= len(waiting.popleft())
        except UnreachableError:
            raise
        except Exception as error:  # pymongo meets answers that make no sense with any error
            self._prepared.clear()  # the server that returns may be another one
            raise _unreachable(error) from None

    def ping(self) -> None:
        """Ask whether the database is there and lets us in; raises UnreachableError."""
        try:
            self._database.command("ping")
        except self._errors.PyMongoError as error:
            raise _unreachable(error) from None

    def _encoded(self, batch: Batch) -> Iterator[bytes]:
        found = documents(batch, self._target.layout)
        places = zip(batch.seq.tolist(), batch.log_time_ns.tolist(), strict=True)
        for content, (seq, log_time_ns) in zip(found, places, strict=True):
            position = Position(self._store_id, batch.writer, batch.run, seq)
            made = self._bson.ObjectId(id_bytes(position, log_time_ns))
            data = self._encode({"_id": made, **content})
            if data is not None:
                yield data

    def _encode(self, document: Document) -> bytes | None:
        try:
            data: bytes = self._bson.encode(document)
        except Exception as error:  # bson raises many kinds of errors for what it cannot hold
            self.written.refuse(str(error))
            return None
        if len(data) > LARGEST_BYTES:
            self.written.refuse(f"{len(data)} bytes are more than a document of MongoDB may have")
            return None
        return data

    def _prepare(self, item: str) -> None:
        """Describe a new collection, and index its times."""
        if item in self._prepared:
            return
        named = {"collection_name": item}
        described = {k: v for k, v in self._described[item].items() if k not in named}
        self._database[METADATA].update_one(named, {"$setOnInsert": described}, upsert=True)
        self._database[item].create_index(TIMESTAMP)
        self._prepared.add(item)

    def _insert(self, collection: Any, group: Sequence[bytes], alive: Callable[[], None]) -> None:
        raw = [self._bson.raw_bson.RawBSONDocument(data) for data in group]
        try:
            collection.insert_many(raw, ordered=False)
        except self._errors.BulkWriteError as error:
            self._sort(error.details, len(group))
        except self._errors.PyMongoError as error:
            if not _is_about_documents(error):
                raise
            if len(group) == 1:
                self.written.refuse(str(error))
                return
            for data in group:
                self._insert(collection, [data], alive)
        else:
            self.written.taken += len(group)
        alive()

    def _sort(self, details: Any, count: int) -> None:
        """Sort errors of single documents: known before, refused, or to be written again."""
        failed = details.get("writeErrors", ())
        again = [one for one in failed if one.get("code") in _TEMPORARY]
        again += details.get("writeConcernErrors", ())
        if again:
            raise UnreachableError(f"not written: {again[0].get('errmsg', 'no reason')}"[:300])
        self.written.taken += count - len(failed)
        for one in failed:
            if one.get("code") == _DUPLICATE:
                self.written.known += 1
            else:
                self.written.refuse(str(one.get("errmsg", "no reason")))


def _unreachable(error: Exception) -> UnreachableError:
    text = " ".join(str(error).split()).partition(", Timeout:")[0]
    return UnreachableError(text[:300] or type(error).__name__)


def _is_about_documents(error: Exception) -> bool:
    """Return whether a whole request was refused because of a document in it."""
    names = {kind.__name__ for kind in type(error).__mro__}
    return bool(names & {"DocumentTooLarge", "InvalidDocument"}) or (
        getattr(error, "code", None) in _OF_DOCUMENTS
    )


def _first_group(waiting: deque[bytes]) -> list[bytes]:
    """Return the first documents, of limited number and size."""
    group: list[bytes] = []
    size = 0
    for data in islice(waiting, BATCH_ROWS):
        size += len(data)
        if group and size > BATCH_BYTES:
            break
        group.append(data)
    return group
