"""Load probes, run each periodically in a thread of its own, and publish their results over ZeroMQ.

A probe that hangs delays no other one; its results are checked against its declaration.
"""

from __future__ import annotations

import json
import math
import re
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

from amberbox.core import plugins
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import PERIOD_S, TIMEOUT_S, Measured, ProbeOrder, sorted_orders
from amberbox.monitoring.component_files import PROBE_DEFINES, PROBES
from amberbox.monitoring.findings import valid_text

# ``subject``, ``ok``, ``error`` and what the probe measures; null is unknown
Row: TypeAlias = Mapping[str, Any]

_TYPES: Mapping[str, Callable[[Any], Any]] = {
    "bool": bool,
    "int": int,
    "float": float,
    "string": str,
}


_WHOLE = 1 << 63  # whole numbers are below this
_INFINITE = (math.inf, -math.inf)


class ProbeDefectError(Exception):
    """A probe returned a value that its contract does not allow."""


@dataclass(frozen=True, slots=True)
class Probe:
    """The definitions of a probe's file; see ``core.probe``."""

    kind: str
    measure: Callable[[str], Measured]
    measures: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    period_s: float = PERIOD_S
    timeout_s: float = TIMEOUT_S

    def measure_once(self, subject: str) -> Row:
        """Measure once and return a row; every failure becomes its error."""
        try:
            return self._row(subject, self.measure(subject))
        except AmberboxError as error:
            return self.unknown(subject, error.what)
        except OSError as error:
            return self.unknown(subject, os_error_text(error))
        except (Exception, SystemExit) as error:  # a defect of the probe: its row says so
            return self.unknown(subject, f"crashed: {type(error).__name__}: {error}")

    def unknown(self, subject: str, error: str) -> Row:
        """Return the row of a measurement that failed."""
        unknown = dict.fromkeys(self.measures)
        return {"subject": valid_text(subject), "ok": None, "error": valid_text(error), **unknown}

    def _row(self, subject: str, measured: Measured) -> Row:
        extra = sorted(set(measured) - set(self.measures) - {"ok", "error"})
        if extra:
            raise ProbeDefectError(f"it gives '{extra[0]}', which its MEASURES do not name")
        values = {
            name: _as_type(kind, measured.get(name)) for name, (kind, _, _) in self.measures.items()
        }
        ok, error = _as_type("bool", measured["ok"]), str(measured.get("error", ""))
        return {"subject": valid_text(subject), "ok": ok, "error": valid_text(error), **values}


def load_probe(kind: str, extra_dirs: Sequence[Path] = ()) -> Probe:
    """Load a probe by its kind; raise AmberboxError if there is none or it cannot be loaded."""
    plugin = plugins.get(PROBES, kind, extra_dirs, PROBE_DEFINES)
    try:
        module = plugin.load()
    except AmberboxError:
        raise
    except (Exception, SystemExit) as error:  # a robot's own probe may fail in any way
        what = f"probe '{kind}' cannot be loaded: {type(error).__name__}: {error}"
        raise AmberboxError(what, f"look at {plugin.path}") from error
    period_s = float(getattr(module, "PERIOD_S", PERIOD_S))
    timeout_s = float(getattr(module, "TIMEOUT_S", TIMEOUT_S))
    return Probe(kind, module.measure, module.MEASURES, period_s, timeout_s)


def known_probes(extra_dirs: Sequence[Path] = ()) -> Mapping[str, plugins.Plugin]:
    """Find all probes, ours and those of a robot folder; none of them is imported."""
    return plugins.find(PROBES, extra_dirs, PROBE_DEFINES)


def probes_for(kinds: Iterable[str], extra_dirs: Sequence[Path] = ()) -> Mapping[str, Probe]:
    """Load probes, each once; one that cannot be loaded gives its error with every row."""
    probes: dict[str, Probe] = {}
    for kind in sorted(set(kinds)):
        try:
            probes[kind] = load_probe(kind, extra_dirs)
        except AmberboxError as error:
            probes[kind] = broken_probe(kind, error)
    return probes


def broken_probe(kind: str, error: AmberboxError) -> Probe:
    """Return a probe whose measurements all fail with an error."""

    def measure(subject: str) -> Measured:
        raise AmberboxError(error.what, error.hint)

    return Probe(kind, measure)


def os_error_text(error: OSError) -> str:
    """Return the text of a system error, with the file it is about."""
    place = f"{error.filename}: " if error.filename else ""
    return f"{place}{error.strerror or error or type(error).__name__}"


def _as_type(kind: str, value: Any) -> Any:
    """Return a value converted to its declared type, so that columns never change theirs.

    A number that JSON cannot hold becomes None; invalid characters of a text are replaced.
    """
    if value is None or (kind != "string" and (value != value or value in _INFINITE)):
        return None
    made = _TYPES[kind](value)
    if kind == "string":
        return valid_text(made)
    fits = math.isfinite(made) if kind == "float" else -_WHOLE <= made < _WHOLE
    return made if fits else None


# takes a row, from many threads; rows of one order come in order of time
Put: TypeAlias = Callable[[ProbeOrder, Row], None]

_CLOSE_S = 2.0


@dataclass(slots=True, eq=False)
class _Post:
    """One probe and its subject: since when it measures, and when it last counted as hanging."""

    order: ProbeOrder
    probe: Probe
    lock: threading.Lock = field(default_factory=threading.Lock)
    since_s: float | None = None
    reported_s: float | None = None

    def hangs_in_s(self, now_s: float) -> float:
        """Return in how many seconds it counts as hanging; 0 or less is now."""
        if self.since_s is None:
            return self.probe.timeout_s
        if self.reported_s is None:
            return self.since_s + self.probe.timeout_s - now_s
        return self.reported_s + self.probe.period_s - now_s


class ProbeRunner:
    """Runs probes from ``start`` to ``close`` and passes each row to ``put``.

    A measurement that takes longer than the probe's ``TIMEOUT_S`` gives a row with that error,
    another one each period until it ends; its result is then too old and is dropped. Missed
    measurements are not repeated. After ``close``, ``put`` is not called any more.
    """

    def __init__(
        self, orders: Sequence[ProbeOrder], put: Put, extra_dirs: Sequence[Path] = ()
    ) -> None:
        self._put = put
        probes = probes_for({order.kind for order in orders}, extra_dirs)
        self._posts = [_Post(order, probes[order.kind]) for order in sorted_orders(orders)]
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self.failure: Exception | None = None
        """What ``put`` raised: then no probe runs any more, and ``close`` raises it again."""

    def start(self) -> None:
        """Start: every probe measures at once, then by its period."""
        start_s = time.monotonic()
        for post in self._posts:
            self._run(f"probe {post.order.kind} {post.order.subject}", self._work, post, start_s)
        if self._posts:
            self._run("probes that hang", self._watch)

    def close(self) -> None:
        """Stop; measurements under way are abandoned. Raise the error that ``put`` raised."""
        self._stop.set()
        end_s = time.monotonic() + _CLOSE_S
        for post, thread in zip(self._posts, self._threads, strict=False):
            with post.lock:  # a row that is being put is finished first
                is_looking = post.since_s is not None
            if not is_looking:
                thread.join(max(0.0, end_s - time.monotonic()))
        if self.failure is not None:
            raise self.failure

    def _run(self, name: str, work: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=work, args=arguments, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _work(self, post: _Post, due_s: float) -> None:
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            with post.lock:
                post.since_s, post.reported_s = time.monotonic(), None
            row = post.probe.measure_once(post.order.subject)
            with post.lock:
                is_late = post.reported_s is not None
                post.since_s = None
                if not is_late:
                    self._hand_over(post, row)
            due_s = next_due_s(due_s, post.probe.period_s, time.monotonic())

    def _watch(self) -> None:
        wait_s = 0.0
        while not self._stop.wait(wait_s):
            wait_s = min(self._report_if_hanging(post) for post in self._posts)

    def _report_if_hanging(self, post: _Post) -> float:
        """Put the row of a hanging measurement; return when to check again, in seconds."""
        with post.lock:
            now_s = time.monotonic()
            left_s = post.hangs_in_s(now_s)
            if left_s > 0:
                return left_s
            post.reported_s = now_s
            text = f"hangs for {post.probe.timeout_s:g} s or longer"
            self._hand_over(post, post.probe.unknown(post.order.subject, text))
            return post.probe.period_s

    def _hand_over(self, post: _Post, row: Row) -> None:
        if self._stop.is_set():
            return
        try:
            self._put(post.order, row)
        except Exception as error:  # kept for close(): a thread has no caller to raise it to
            self.failure = self.failure or error
            self._stop.set()


def next_due_s(due_s: float, period_s: float, now_s: float) -> float:
    """Return the next instant after ``now_s`` of the schedule that ``due_s`` belongs to."""
    missed = max(0, int((now_s - due_s) // period_s))
    return due_s + (missed + 1) * period_s


PORT = 5561
HERE = f"tcp://127.0.0.1:{PORT}"  # default: only this computer can read it

_ENDPOINT = re.compile(r"tcp://(?P<host>\*|[\w.-]+|\[[0-9A-Fa-f:]+\]):(?P<port>\d{1,5})|ipc://.+")


def is_open(endpoint: str) -> bool:
    """Return whether other computers can read what is published at an address.

    Raises UsageError if the address is invalid.
    """
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or (found["port"] and not int(found["port"]) < 65536):
        raise UsageError(f"'{endpoint}' is no address to publish at", f"such as tcp://*:{PORT}")
    host = found["host"]
    return host is not None and host != "localhost" and not host.startswith(("127.", "[::1]"))


class ProbePublisher:
    """Publishes each row as two frames, its topic and JSON, as the source ``zmq`` reads them."""

    def __init__(self, endpoint: str) -> None:
        """Bind the address; raise AmberboxError if that fails."""
        import zmq

        is_open(endpoint)
        self._lock = threading.Lock()  # a socket is for one thread at a time
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.ipv6 = "[" in endpoint
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            hint = "is another 'amberbox probe' running? choose another port"
            raise AmberboxError(f"cannot publish at {endpoint}: {error.strerror}", hint) from error

    @property
    def endpoint(self) -> str:
        """Return the address that is bound, with the port that was chosen for ``:0``."""
        import zmq

        return self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def put(self, order: ProbeOrder, row: Row) -> None:
        """Publish a row; never waits, and a reader that is too slow misses rows."""
        frames = [order.topic.encode(), encode(row)]
        with self._lock:
            if not self._socket.closed:
                self._socket.send_multipart(frames)

    def close(self) -> None:
        """Stop publishing."""
        with self._lock:
            self._socket.close(linger=100)
        self._context.term()

    def __enter__(self) -> ProbePublisher:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def encode(row: Row) -> bytes:
    """Write a row as JSON on one line."""
    return json.dumps(row, ensure_ascii=False, allow_nan=False).encode()
