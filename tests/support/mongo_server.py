"""A small MongoDB on the loopback interface: its wire protocol (OP_MSG) in front of a dictionary.

It knows the commands that a writing client and a simple reader need. It stands in for a real
server: it shows what goes over the wire, not how MongoDB behaves otherwise.
"""

from __future__ import annotations

import socket
import socketserver
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import bson
from bson.raw_bson import RawBSONDocument

_HEADER = struct.Struct("<iiii")
_OP_REPLY, _OP_QUERY, _OP_MSG = 1, 2004, 2013
_LARGEST = 16 << 20
_HELLO = {
    "isWritablePrimary": True, "ismaster": True, "helloOk": True, "maxBsonObjectSize": _LARGEST,
    "maxMessageSizeBytes": 48_000_000, "maxWriteBatchSize": 100_000, "minWireVersion": 0,
    "maxWireVersion": 21, "readOnly": False, "ok": 1.0,
}  # fmt: skip

Refusal = tuple[int, str]


class MongoServer:
    """Serves until it is stopped; its content outlives a restart at the same port.

    ``refuse`` returns code and text of a write error for a document, or None. While ``is_frozen``
    it answers nothing. After ``die_after`` further inserts it carries one out, answers nothing and
    cuts all connections.
    """

    def __init__(self) -> None:
        self.collections: dict[str, dict[Any, bytes]] = {}
        self.indexes: dict[str, list[Any]] = {}
        self.inserts = 0
        self.largest_insert = 0
        self.refuse: Callable[[Mapping[str, Any]], Refusal | None] = lambda document: None
        self.fail: Refusal | None = None  # the answer to every insert
        self.is_frozen = False
        self.garbage = b""  # sent instead of every answer
        self.die_after: int | None = None
        self._thawed = threading.Event()
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._server: _Listener | None = None
        self.port = 0
        self.start()

    @property
    def url(self) -> str:
        return f"mongodb://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Listen, at the port of before if there was one."""
        self._server = _Listener(("127.0.0.1", self.port), self)
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def stop(self) -> None:
        """Stop listening and cut all connections, as a crash does."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None
        self.cut()

    def cut(self) -> None:
        for connection in list(self._open):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def freeze(self) -> None:
        self._thawed.clear()
        self.is_frozen = True

    def thaw(self) -> None:
        self.is_frozen = False
        self._thawed.set()

    def documents(self, name: str) -> list[dict[str, Any]]:
        with self._lock:
            return [bson.decode(raw) for raw in self.collections.get(name, {}).values()]

    def count(self, name: str) -> int:
        with self._lock:
            return len(self.collections.get(name, {}))

    def dump(self, folder: Path) -> Path:
        """Write what mongodump would."""
        folder.mkdir()
        for name, documents in self.collections.items():
            (folder / f"{name}.bson").write_bytes(b"".join(documents.values()))
        return folder

    # -- one connection

    def serve(self, connection: socket.socket) -> None:
        try:
            while True:
                _, request, _, kind = _HEADER.unpack(head := _read(connection, _HEADER.size))
                body = _read(connection, _HEADER.unpack(head)[0] - _HEADER.size)
                if self.is_frozen:
                    self._thawed.wait()
                if self.garbage:
                    connection.sendall(self.garbage)
                    continue
                if kind == _OP_QUERY:
                    answer = struct.pack("<iqii", 8, 0, 0, 1) + bson.encode(_HELLO)
                    _send(connection, request, _OP_REPLY, answer)
                    continue
                reply = self._answer(_command(body))
                if reply is None:
                    return self.cut()
                _send(connection, request, _OP_MSG, struct.pack("<iB", 0, 0) + bson.encode(reply))
        except OSError:
            return None
        finally:
            self._open.discard(connection)

    def _answer(self, command: Mapping[str, Any]) -> dict[str, Any] | None:
        name = next(iter(command))
        if name.lower() in ("hello", "ismaster"):
            return _HELLO
        answers = {
            "ping": lambda _: {}, "endSessions": lambda _: {}, "insert": self._insert,
            "update": self._update, "createIndexes": self._create_indexes, "find": self._find,
        }  # fmt: skip
        if name not in answers:
            return {"ok": 0.0, "code": 59, "errmsg": f"no such command: '{name}'"}
        with self._lock:
            result = answers[name](command)
        return None if result is None else {"ok": 1.0, **result}

    def _insert(self, command: Mapping[str, Any]) -> dict[str, Any] | None:
        if self.fail is not None:
            return {"ok": 0.0, "code": self.fail[0], "errmsg": self.fail[1]}
        documents: list[RawBSONDocument] = command["documents"]
        known = self.collections.setdefault(command["insert"], {})
        errors = []
        for number, document in enumerate(documents):
            key, refused = document["_id"], self.refuse(document)
            if key in known:
                refused = (11000, f"E11000 duplicate key error: {key}")
            if refused:
                errors.append({"index": number, "code": refused[0], "errmsg": refused[1]})
            else:
                known[key] = bytes(document.raw)
        self.inserts += 1
        self.largest_insert = max(self.largest_insert, sum(len(d.raw) for d in documents))
        if self.die_after is not None:
            self.die_after -= 1
            if self.die_after < 0:
                self.die_after = None
                return None
        return {"n": len(documents) - len(errors), **({"writeErrors": errors} if errors else {})}

    def _update(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out upserts with equality and ``$setOnInsert``."""
        known = self.collections.setdefault(command["update"], {})
        made = []
        for number, update in enumerate(command["updates"]):
            wanted = bson.decode(update["q"].raw)
            if any(wanted.items() <= bson.decode(raw).items() for raw in known.values()):
                continue
            key = bson.ObjectId()
            fields = bson.decode(update["u"].raw)["$setOnInsert"]
            known[key] = bson.encode({"_id": key, **wanted, **fields})
            made.append({"index": number, "_id": key})
        answer = {"n": len(command["updates"]), "nModified": 0}
        return {**answer, "upserted": made} if made else answer

    def _create_indexes(self, command: Mapping[str, Any]) -> dict[str, Any]:
        wanted = [bson.decode(index["key"].raw) for index in command["indexes"]]
        known = self.indexes.setdefault(command["createIndexes"], [])
        known += [index for index in wanted if index not in known]
        return {}

    def _find(self, command: Mapping[str, Any]) -> dict[str, Any]:
        found = list(self.collections.get(command["find"], {}).values())
        cursor = {"id": bson.Int64(0), "ns": f"x.{command['find']}"}
        return {"cursor": {**cursor, "firstBatch": [RawBSONDocument(raw) for raw in found]}}


class _Listener(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, address: tuple[str, int], mongo: MongoServer) -> None:
        self.mongo = mongo
        super().__init__(address, _Connection)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Note a connection before its thread begins, so that none outlives a cut."""
        self.mongo._open.add(request)
        super().process_request(request, client_address)


class _Connection(socketserver.BaseRequestHandler):
    server: _Listener

    def handle(self) -> None:
        self.server.mongo.serve(self.request)


def _read(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise ConnectionResetError
        data += part
    return data


def _send(connection: socket.socket, request: int, kind: int, body: bytes) -> None:
    connection.sendall(_HEADER.pack(_HEADER.size + len(body), 0, request, kind) + body)


def _command(body: bytes) -> dict[str, Any]:
    """Join the sections of an OP_MSG: the command, and its sequences of documents."""
    sections = list(_sections(body))
    command = dict(next(value for name, value in sections if not name))
    return command | {name: value for name, value in sections if name}


def _sections(body: bytes) -> Iterator[tuple[str, Any]]:
    at = 4
    while at < len(body):
        kind, at = body[at], at + 1
        (size,) = struct.unpack_from("<i", body, at)
        if kind == 0:
            yield "", RawBSONDocument(body[at : at + size])
        else:
            end = body.index(b"\0", at + 4)
            yield body[at + 4 : end].decode(), list(_documents(body[end + 1 : at + size]))
        at += size


def _documents(data: bytes) -> Iterator[RawBSONDocument]:
    at = 0
    while at < len(data):
        (size,) = struct.unpack_from("<i", data, at)
        yield RawBSONDocument(data[at : at + size])
        at += size
