"""Ask a server over HTTP and WebSocket as somebody, and write each exchange into a file."""

from __future__ import annotations

import csv
import http.client
import io
import json
import re
import time
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow.ipc
import pyarrow.parquet
import websockets.sync.client

NORMALISED: list[tuple[str, str, str, str]] = [
    ("key", r"\bab([rt])_[A-Za-z0-9_-]+", r"ab\1_<key>",
     "a server draws keys, sessions and ids from one stream while threads run beside each other"),
    ("id", r"(?<![0-9a-z])[0-9a-f]{12}(?![0-9a-z])", "<id>", "as with keys"),
    ("long-id", r"(?<![0-9a-z])([a-z]|server)-(?:[0-9a-f]{24}|[0-9a-f]{16})(?![0-9a-z])",
     r"\1-<id>", "as with keys"),
    ("password", r"\b[a-z0-9]{5}(?:-[a-z0-9]{5}){3}\b", "<password>", "as with keys"),
    ("audit-hash", r'("hash": |"?head"?[^\n]{0,40}|\b\d+ |,)"?(?!(?:ab){32})[0-9a-f]{64}\b',
     r"\1<hash>", "a row's hash follows from random ids in rows before it"),
    ("static-digest", r"/static/[0-9a-f]{8,64}/", "/static/<digest>/",
     "static files are listed with their hashes in static.txt"),
    ("requests", r"(?m)^amberbox_request(?:s_total|_seconds\w*)\{.*\n", "",
     "roles ask beside each other, and what waits for something asks as often as it takes"),
    ("pid", r"\bprocess \d+ on\b", "process <pid> on", "the system numbers processes"),
    ("fingerprint", r"(fingerprint: sha256:)[0-9a-f]{64}", r"\1<fingerprint>",
     "the library that makes keys of certificates has randomness of its own"),
    ("file-time", r'(?m)^etag: "[0-9a-f]{32}"\nlast-modified: [^\n]+ GMT$',
     "etag: <file>\\nlast-modified: <file>",
     "a file is made when it is made; its etag follows from its time and size"),
    ("health-figures",
     r"(<dt>(?:Database|Memory of the server|Open files and connections)</dt><dd>)[^<]*",
     r"\1<number>", "as with the figures of the process"),
    ("process-figures", r"(?m)^(process_\w+|amberbox_database_bytes|amberbox_feed_\w+) \S+$",
     r"\1 <number>", "use of processor, memory, files of the machine at hand"),
]  # fmt: skip
"""Name, pattern, replacement and reason of what cannot be frozen in answers of the server."""
_PATTERNS = [(re.compile(pattern), to) for _, pattern, to, _ in NORMALISED]
_HEADERS_LEFT_OUT = ("date", "content-length", "connection", "transfer-encoding")
_PATIENCE_S = 60.0
_BUSY_S = 0.1


@dataclass(frozen=True)
class Answer:
    """What came back."""

    status: int
    headers: list[tuple[str, str]]
    body: bytes

    def header(self, name: str) -> str:
        """Return the first header of a name, or nothing."""
        return next((value for key, value in self.headers if key == name), "")

    def json(self) -> Any:
        """Return the body as JSON."""
        return json.loads(self.body)


@dataclass
class Book:
    """Where exchanges are written; it replaces names that differ from run to run."""

    out: Path
    learned: dict[str, str] = field(default_factory=dict)
    count: int = 0
    statuses: dict[str, dict[str, int]] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)

    def learn(self, text: str, name: str) -> str:
        """Replace a text by ``<name>`` wherever it is written from now on; return the text."""
        if text:
            self.learned[text] = f"<{name}>"
        return text

    def clean(self, text: str) -> str:
        """Replace what cannot be frozen."""
        for found in sorted(self.learned, key=len, reverse=True):
            text = text.replace(found, self.learned[found])
        for pattern, to in _PATTERNS:
            text = pattern.sub(to, text)
        return text

    def write(self, room: str, name: str, text: str) -> None:
        """Write one file, by a name that is a path no longer."""
        plain = re.sub(r"[^\w.,=+-]+", "_", self.clean(name)).strip("_")[:150]
        folder = self.out / room
        folder.mkdir(parents=True, exist_ok=True)
        path, number = folder / f"{plain}.txt", 2
        while path.exists():
            path, number = folder / f"{plain}~{number}.txt", number + 1
        path.write_text(self.clean(text), encoding="utf-8", errors="surrogateescape")

    def exchange(self, room: str, name: str, asked: str, answer: Answer) -> None:
        """Write what was asked and answered."""
        self.count += 1
        headers = sorted(pair for pair in answer.headers if pair[0] not in _HEADERS_LEFT_OUT)
        lines = [asked, str(answer.status), *(f"{key}: {value}" for key, value in headers), ""]
        self.write(room, name, "\n".join(lines) + "\n" + readable(answer) + "\n")


def readable(answer: Answer) -> str:
    """Return a body so that a difference in it can be read: lines of JSON, rows of tables."""
    kind = answer.header("content-type").partition(";")[0]
    body = answer.body
    if not body:
        return ""
    if answer.status == 206:
        return body.hex()
    if kind == "application/json":
        return json.dumps(json.loads(body), indent=1, ensure_ascii=False)
    if kind == "application/vnd.apache.arrow.stream":
        return arrow_rows(body)
    if kind == "application/zip" or body[:4] == b"PK\x03\x04":
        return zip_rows(body)
    if body[:4] == b"PAR1":
        return table_rows(pyarrow.parquet.read_table(io.BytesIO(body)))
    if kind.startswith("text/") or kind in ("application/x-ndjson", "application/jsonl", ""):
        return body.decode("utf-8", "replace")
    return f"{len(body)} bytes {body.hex()}"


def arrow_rows(body: bytes) -> str:
    """Return an Arrow stream as its schema, metadata and rows."""
    return table_rows(pyarrow.ipc.open_stream(body).read_all())


def table_rows(table: Any) -> str:
    """Return a table as its fields with their metadata, and rows as CSV."""
    text = io.StringIO()
    for one in table.schema:
        said = {key.decode(): value.decode() for key, value in (one.metadata or {}).items()}
        text.write(f"{one.name}: {one.type} {said}\n")
    rows = csv.writer(text)
    rows.writerows(zip(*(column.to_pylist() for column in table.columns), strict=True))
    return text.getvalue()


def zip_rows(body: bytes) -> str:
    """Return a ZIP as what its members hold."""
    parts = []
    with zipfile.ZipFile(io.BytesIO(body)) as packed:
        for name in packed.namelist():
            kind = "text/plain" if name.endswith((".csv", ".json", ".txt")) else "?"
            inner = Answer(200, [("content-type", kind)], packed.read(name))
            parts.append(f"== {name}\n{readable(inner)}")
    return "\n".join(parts)


@dataclass
class Person:
    """Somebody who asks: a role's session, a token, a robot's key, or nobody."""

    name: str
    port: int
    book: Book
    headers: dict[str, str] = field(default_factory=dict)
    _kept: http.client.HTTPConnection | None = None

    @property
    def origin(self) -> str:
        """The server as pages name it."""
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self,
        method: str,
        path: str,
        body: object = None,
        headers: Mapping[str, str] | None = None,
    ) -> Answer:
        """Send a request; ask again while the server says that it is asked too often."""
        ends = time.monotonic() + _PATIENCE_S
        sent = {**self.headers, **(headers or {})}
        data = body if isinstance(body, bytes) else None
        if body is not None and data is None:
            data = json.dumps(body).encode()
            sent.setdefault("Content-Type", "application/json")
        while True:
            answer = self._once(method, path, data, sent)
            busy = answer.status == 429 or (answer.status == 503 and b'"busy"' in answer.body)
            if not busy or time.monotonic() > ends:
                return answer
            time.sleep(_BUSY_S)

    def record(
        self,
        room: str,
        method: str,
        path: str,
        body: object = None,
        headers: Mapping[str, str] | None = None,
        note: str = "",
    ) -> Answer:
        """Send a request and write the exchange down."""
        answer = self.ask(method, path, body, headers)
        said = (
            ""
            if body is None
            else f" {json.dumps(body) if not isinstance(body, bytes) else body!r}"
        )
        name = f"{method}_{path}_{note}_{self.name}"
        self.book.exchange(room, name, f"{method} {path}{said} as {self.name} {note}", answer)
        return answer

    def sign_in(self, password: str) -> None:
        """Begin a session; changes carry its token from then on."""
        answer = self.ask("POST", "/api/v1/session", {"name": self.name, "password": password})
        if answer.status != 200:
            raise RuntimeError(f"{self.name} cannot sign in: {answer.status} {answer.body!r}")
        cookie = answer.header("set-cookie").partition(";")[0]
        self.book.learn(cookie.partition("=")[2], f"session of {self.name}")
        csrf = self.book.learn(answer.json()["csrf"], f"csrf of {self.name}")
        self.headers = {"Cookie": cookie, "X-CSRF-Token": csrf}

    def copy(self) -> Person:
        """Return the same person on a connection of their own."""
        return Person(self.name, self.port, self.book, dict(self.headers))

    def socket(self, path: str, *, page: bool = True) -> websockets.sync.client.ClientConnection:
        """Open a WebSocket; ``page`` names the origin, as browsers do."""
        return websockets.sync.client.connect(
            f"ws://127.0.0.1:{self.port}{path}", additional_headers=self.headers,
            origin=self.origin if page else None,  # type: ignore[arg-type]  # a plain text will do
            max_size=None, proxy=None,
        )  # fmt: skip

    def close(self) -> None:
        """Close the connection."""
        if self._kept is not None:
            self._kept.close()
            self._kept = None

    def _once(self, method: str, path: str, data: bytes | None, sent: Mapping[str, str]) -> Answer:
        for last in (False, True):
            if self._kept is None:
                self._kept = http.client.HTTPConnection("127.0.0.1", self.port, timeout=_PATIENCE_S)
            try:
                self._kept.request(method, path, body=data, headers=dict(sent))
                got = self._kept.getresponse()
                body = got.read()
            except (http.client.HTTPException, ConnectionError):
                self.close()
                if last:
                    raise
                continue
            headers = [(key.lower(), value) for key, value in got.getheaders()]
            if got.will_close:
                self.close()
            return Answer(got.status, headers, body)
        raise AssertionError("not reached")
