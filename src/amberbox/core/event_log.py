"""``amberbox.log``: decisions of the robot's own software, sent to the ``event`` source.

Messages are JSON datagrams on a Unix socket of this computer. The caller only encodes and queues: a
thread sends. Nothing but the standard library is needed, and no error reaches the caller.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import queue
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

VARIABLE = "AMBERBOX_LOG"  # names another socket, for both ends
SYSTEM_SOCKET = "/run/amberbox/log.sock"
LONGEST_BYTES = 32_768  # of one message
_MOST_WAITING = 1000
_LONGEST_NAME = 64
_MOST_NAMES = 200  # of which lost messages are counted apart
_DEEPEST = 16
_RETRY_S = 1.0
_SEND_S = 1.0
_EXIT_S = 1.0


def socket_places(environment: Mapping[str, str]) -> Sequence[str]:
    """Return where the socket of the recorder may be, in the order in which they are tried."""
    named = environment.get(VARIABLE)
    if named:
        return [named]
    return [SYSTEM_SOCKET, str(Path("~/.local/state/amberbox/log.sock").expanduser())]


def log(name: str, /, **values: Any) -> None:
    """Record a decision or observation of this program, with its reasons, as a row of an item.

    ``name`` (letters, digits, ``_ . / -``; 64 at most) becomes the item ``event_NAME``, each value
    a typed column: numbers, texts, booleans, and mappings and lists of them. Anything else is
    recorded as text. The time is that of the call, or a value called ``stamp``.

    Never blocks and never raises. Without a recorder that listens (source ``event``), messages are
    dropped and counted; the count is recorded when it is back.
    """
    global _sender
    with suppress(Exception):
        if _sender is None:
            _sender = _Sender()
        _sender.put(str(name), values)


def flush(timeout_s: float = _EXIT_S) -> bool:
    """Wait until all messages are sent or dropped; return False if time runs out before that.

    A program that ends calls it by itself.
    """
    return _sender is None or _sender.wait_empty(timeout_s)


class _Sender:
    """The queue of one process, and the thread that sends it."""

    def __init__(self) -> None:
        # of messages with their names, and of events that are set when all before them is sent
        self._queue: queue.SimpleQueue[tuple[str, bytes] | threading.Event] = queue.SimpleQueue()
        self._lock = threading.RLock()
        self._lost: Counter[str] = Counter()
        self._lost_from_ns = 0
        self._socket: socket.socket | None = None
        self._not_before_s = 0.0
        threading.Thread(target=self._run, name="amberbox.log", daemon=True).start()

    def put(self, name: str, values: Mapping[str, Any]) -> None:
        stamp_ns = time.time_ns()
        try:
            stamp = _plain(values.get("stamp", stamp_ns))
            rest = _plain({key: values[key] for key in values if key != "stamp"})
            data = _encoded({"name": name, "stamp": stamp, "values": rest})
        except Exception:  # a value whose conversion to text fails
            data = b""
        if not data or len(data) > LONGEST_BYTES or self._queue.qsize() >= _MOST_WAITING:
            self._lose(name, stamp_ns)
        else:
            self._queue.put((name, data))

    def wait_empty(self, timeout_s: float) -> bool:
        empty = threading.Event()
        self._queue.put(empty)
        return empty.wait(timeout_s)

    def _lose(self, name: str, stamp_ns: int) -> None:
        with self._lock:
            self._lost_from_ns = self._lost_from_ns or stamp_ns
            known = name[:_LONGEST_NAME] in self._lost or len(self._lost) < _MOST_NAMES
            self._lost[name[:_LONGEST_NAME] if known else ""] += 1

    def _run(self) -> None:
        while True:
            try:
                entry = self._queue.get(timeout=_RETRY_S if self._lost else None)
            except queue.Empty:
                self._report_lost()
                continue
            if isinstance(entry, threading.Event):
                entry.set()
            elif not (self._report_lost() and self._send(entry[1])):
                self._lose(entry[0], time.time_ns())

    def _report_lost(self) -> bool:
        """Send how many messages were lost; return whether there is nothing left to report."""
        with self._lock:
            lost, from_ns = dict(self._lost), self._lost_from_ns
        if not lost:
            return True
        to_ns = time.time_ns()
        entry = {"lost": lost, "from_ns": from_ns, "to_ns": to_ns}
        if not self._send(_encoded(entry)):
            return False
        with self._lock:
            self._lost = self._lost - Counter(lost)
            self._lost_from_ns = to_ns if self._lost else 0
        return True

    def _send(self, data: bytes) -> bool:
        for _ in range(2):  # the recorder may have been restarted since
            if self._socket is None and not self._connect():
                return False
            assert self._socket is not None
            try:
                self._socket.send(data)
            except OSError:
                self._socket.close()
                self._socket = None
            else:
                return True
        return False

    def _connect(self) -> bool:
        if time.monotonic() < self._not_before_s:
            return False
        for place in socket_places(os.environ):
            made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            made.settimeout(_SEND_S)
            try:
                made.connect(place)
            except OSError:  # nobody listens there
                made.close()
            else:
                self._socket = made
                return True
        self._not_before_s = time.monotonic() + _RETRY_S
        return False


_sender: _Sender | None = None


def _forget() -> None:
    """Begin anew in a child process: the thread exists only in its parent."""
    global _sender
    _sender = None


os.register_at_fork(after_in_child=_forget)
atexit.register(flush)


def _encoded(entry: Mapping[str, Any]) -> bytes:
    return json.dumps(entry, separators=(",", ":"), ensure_ascii=False).encode("utf-8", "replace")


def _plain(value: Any, depth: int = 0) -> Any:
    """Return a value as JSON has it; numbers that are not finite become null."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if depth < _DEEPEST:
        if isinstance(value, Mapping):
            return {str(key): _plain(entry, depth + 1) for key, entry in value.items()}
        if isinstance(value, list | tuple | set | frozenset):
            return [_plain(entry, depth + 1) for entry in value]
        if hasattr(value, "tolist"):  # of NumPy
            return _plain(value.tolist(), depth + 1)
    return str(value)
