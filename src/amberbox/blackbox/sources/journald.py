"""The journal of systemd: entries of services, the kernel and programs, read by journalctl."""

from __future__ import annotations

import os
import re
import select
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import msgspec

from amberbox.core.options import option
from amberbox.core.pacing import Backoff
from amberbox.core.rejects import RejectCounter
from amberbox.core.safe_text import one_line
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import unknown_topics
from amberbox.core.types import Schema, Topic

SAMPLE = """\
- journald:
    units: [rosbridge.service, NetworkManager.service]
    priority: info
    fields: [CODE_FILE]
    topics:
      - topic: {name: entries, keep: bulk}
"""
PASSIVE = "starts journalctl, which reads the journal's files and writes nothing"

ENTRIES = "entries"
LEVELS = ("emerg", "alert", "crit", "err", "warning", "notice", "info", "debug")
_POLL_S = 0.2
_LINE_BYTES = 4 << 20  # an entry as JSON; four characters for each byte of a binary field
_READ_BYTES = 1 << 20
_SAVE_S = 10.0
_MATCH = re.compile(r"[A-Z_][A-Z0-9_]{0,63}=[^\0]{0,1000}")
_FIELD = re.compile(r"[A-Z_][A-Z0-9_]{0,63}")
_CURSOR = re.compile(r"s=[0-9a-f]+;i=[0-9a-f]+;b=[0-9a-f]+;m=[0-9a-f]+;t=([0-9a-f]+);x=[0-9a-f]+")
_TEXTS = {
    "message": ("MESSAGE",),
    "unit": ("_SYSTEMD_UNIT", "UNIT"),
    "user_unit": ("_SYSTEMD_USER_UNIT", "USER_UNIT"),
    "identifier": ("SYSLOG_IDENTIFIER", "_COMM"),
    "transport": ("_TRANSPORT",),
    "hostname": ("_HOSTNAME",),
    "boot": ("_BOOT_ID",),
    "cursor": ("__CURSOR",),
}
"""Columns of text, and the fields of an entry that they are taken from, the first that is there."""
_NUMBERS = {"priority": "PRIORITY", "pid": "_PID", "uid": "_UID"}
_decode = msgspec.json.Decoder(dict[str, Any]).decode


@dataclass(frozen=True)
class JournaldOptions:
    """The ``journald`` block."""

    units: Sequence[str] = option((), "units to record, with * as a pattern; all when absent")
    identifiers: Sequence[str] = option((), "identifiers of syslog to record; all when absent")
    priority: Literal["emerg", "alert", "crit", "err", "warning", "notice", "info", "debug"] = (
        option("debug", "least important level that is recorded")
    )
    matches: Sequence[str] = option((), "further conditions, such as _TRANSPORT=kernel")
    fields: Sequence[str] = option((), "further fields to record, as columns in lower case")
    directory: str = option("", "folder of a journal elsewhere; this computer's when absent")
    files: Sequence[str] = option((), "journal files instead, by path or pattern")
    back_s: float = option(3600.0, "read at most this far back at the start", unit="s")
    longest_bytes: int = option(65536, "a longer text is cut here", unit="bytes")
    topics: Sequence[TopicOptions] = option((), "options of the only topic, entries")

    @property
    def place(self) -> str:
        """Return which journal is read, in a word."""
        return self.directory or ", ".join(self.files) or "the journal"

    def in_folder(self, folder: Path) -> JournaldOptions:
        """Return the same with paths seen from a folder."""
        directory = str(folder / Path(self.directory).expanduser()) if self.directory else ""
        files = [str(folder / Path(name).expanduser()) for name in self.files]
        return replace(self, directory=directory, files=files)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; starts nothing."""
        for match in self.matches:
            if not _MATCH.fullmatch(match):
                yield "matches", f"'{match}' is no condition; write _TRANSPORT=kernel"
        for name in self.fields:
            if not _FIELD.fullmatch(name):
                yield "fields", f"'{name}' is no field; write CODE_FILE (see journalctl -o verbose)"
            elif name.lower() in _COLUMNS:
                yield "fields", f"there is a column '{name.lower()}' already"
        names = {"units": self.units, "identifiers": self.identifiers}
        yield from ((key, "holds an empty name") for key in names if "" in names[key])
        if self.directory and self.files:
            yield "files", "does not go together with 'directory'; leave out one"
        if not 0 <= self.back_s < float("inf"):
            yield "back_s", "must be 0 or more"
        if not 16 <= self.longest_bytes <= 1 << 20:
            yield "longest_bytes", "must be between 16 and 1048576"
        yield from unknown_topics(self.topics, (ENTRIES,))

    def command(self, position: str) -> list[str]:
        """Return the call of journalctl that follows the journal from a position on."""
        where = [f"--directory={self.directory}"] if self.directory else []
        where += [f"--file={name}" for name in self.files]
        fields = {name for names in _TEXTS.values() for name in names if name[:2] != "__"}
        fields |= {*_NUMBERS.values(), *self.fields}
        return [
            *("journalctl", "--output=json", "--all", "--follow", "--no-tail", "--quiet"),
            "--merge",  # else --follow reads this boot only, without what led to a restart
            f"--output-fields={','.join(sorted(fields))}",
            # any level keeps entries that have none
            *([f"--priority={self.priority}"] if self.priority != "debug" else []),
            *where,
            *(f"--unit={name}" for name in self.units),
            *(f"--identifier={name}" for name in self.identifiers),
            position,
            *self.matches,
        ]


Config = JournaldOptions
_COLUMNS = (*_TEXTS, *_NUMBERS, "stamp", "cut")


def known_topics(config: JournaldOptions) -> Sequence[Topic]:
    """Return the only topic; its last recorded entry is where reading goes on."""
    texts: dict[str, Any] = {name: {"type": "string"} for name in _TEXTS}
    numbers: dict[str, Any] = {name: {"type": "integer"} for name in _NUMBERS}
    numbers["priority"] = {"type": "integer", "labels": dict(enumerate(LEVELS))}
    more = {name.lower(): {"type": "string"} for name in config.fields}
    properties = {
        "stamp": {"type": "integer", "unit": "ns"},
        **numbers,
        **texts,
        **more,
        "cut": {"type": "integer", "unit": "bytes"},
    }
    document = msgspec.json.encode({"type": "object", "properties": properties})
    schema = Schema("amberbox/journald_entry", "jsonschema", document)
    return [Topic(ENTRIES, "json", schema, latched=True)]


class JournaldSource:
    """Follows the journal with journalctl."""

    lossless = False

    def __init__(self, config: JournaldOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics or [TopicOptions(ENTRIES)]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Follow until ``stop`` is set; journalctl is started again when it ends."""
        follower = _Follower(self.config, sink)
        try:
            follower.run(stop)
        finally:
            follower.end()


Source = JournaldSource


@dataclass
class _Follower:
    """The position in the journal, and what is known of its present reader."""

    config: JournaldOptions
    sink: Sink
    _cursor: str = ""
    _since_us: int = 0
    _is_up: bool = False
    _told: str = ""
    _pending: str = ""
    _saved_s: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self._stream = self.sink.topic(known_topics(self.config)[0])
        self._rejected = RejectCounter(self.sink, ENTRIES, self.config.place)
        self._find_position()

    def run(self, stop: threading.Event) -> None:
        """Start journalctl again and again until ``stop`` is set."""
        backoff = Backoff()
        while not stop.is_set():
            began_cursor = self._cursor
            reason = self._follow(stop)
            if stop.is_set():
                return
            self._down(reason)
            if reason != self._told:
                self.sink.event("journald_ended", f"{reason}; it is started again")
                self._told = reason
            if self._cursor != began_cursor:
                backoff.succeeded()
            stop.wait(backoff.failed())

    def end(self) -> None:
        """Report what is left to report."""
        self._rejected.report(now=True)
        self._down("stopped")

    # -- the position

    def _find_position(self) -> None:
        """Find the entry that was recorded last, or the one saved where the record has none."""
        saved = self.sink.state().get("cursor", "")
        last = _cursor_in(self.sink.last_latched(ENTRIES)) or str(saved)
        if _CURSOR.fullmatch(last):
            self._cursor = self._pending = last
        back_us = time.time_ns() // 1000 - round(self.config.back_s * 1e6)
        self._since_us = back_us
        if self._cursor and (was_us := _time_us(self._cursor)) < back_us:
            self._cursor = self._pending = ""
            text = (
                f"the journal of more than {self.config.back_s:g} s ago is left out (back_s); "
                f"it was read until {(back_us - was_us) / 1e6:.0f} s before that"
            )
            self.sink.event("journald_skipped", text, cursor=last)

    def _save(self) -> None:
        """Save a position that is recorded, for a record whose entries have been deleted."""
        self.sink.save_state({"cursor": self._pending})
        self._pending = self._cursor  # recorded by the next time
        self._saved_s = time.monotonic()

    # -- journalctl

    def _follow(self, stop: threading.Event) -> str:
        """Read what journalctl prints until it ends; return why it has."""
        self._expected = self._cursor
        position = (
            f"--cursor={self._cursor}"
            if self._cursor
            else f"--since=@{self._since_us // 1_000_000}.{self._since_us % 1_000_000:06}"
        )
        try:
            process = subprocess.Popen(
                self.config.command(position),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, "LC_ALL": "C", "TZ": "UTC"},
            )
        except OSError as error:
            missing = isinstance(error, FileNotFoundError)
            why = "it is not installed (Debian: systemd)" if missing else error.strerror
            return f"journalctl cannot be started: {why}"
        try:
            errors = self._read(process, stop)
        finally:
            process.kill()
            status = process.wait()
            for pipe in (process.stdout, process.stderr):
                if pipe is not None:
                    pipe.close()
        said = one_line(errors.decode(errors="replace").strip().rpartition("\n")[2][:200])
        ended = f"by signal {-status}" if status < 0 else f"with status {status}"
        return f"journalctl has ended {ended}{': ' if said else ''}{said}"

    def _read(self, process: subprocess.Popen[bytes], stop: threading.Event) -> bytes:
        """Pass entries on until ``stop`` or the end; return the last words on stderr."""
        assert process.stdout is not None and process.stderr is not None
        out, err = process.stdout.fileno(), process.stderr.fileno()
        rest, errors, is_too_long, open_ends = b"", b"", False, {out, err}
        while not stop.is_set() and out in open_ends:
            ready = select.select(open_ends, (), (), _POLL_S)[0]
            if not self._is_up and not ready:
                self._up()
            if err in ready:
                data = os.read(err, 4096)
                errors = (errors + data)[-2000:]
                open_ends -= set() if data else {err}
            if out in ready:
                data = os.read(out, _READ_BYTES)
                open_ends -= set() if data else {out}
                *lines, rest = (rest + data).split(b"\n")
                if lines and is_too_long:
                    lines, is_too_long = lines[1:], False
                for line in lines:
                    self._entry(line)
                if len(rest) > _LINE_BYTES:
                    if not is_too_long:
                        self._rejected.add(f"an entry of more than {_LINE_BYTES} bytes", rest[:99])
                    rest, is_too_long = b"", True
            self._rejected.report()
            if time.monotonic() - self._saved_s >= _SAVE_S and self._cursor != self._pending:
                self._save()
        return errors

    def _entry(self, line: bytes) -> None:
        try:
            entry = _decode(line)
        except (msgspec.DecodeError, RecursionError):
            self._rejected.add("an entry that is no JSON", line[:99])
            return
        cursor = entry.get("__CURSOR")
        if not isinstance(cursor, str) or not _CURSOR.fullmatch(cursor):
            self._rejected.add("an entry without a cursor", line[:99])
            return
        expected, self._expected = self._expected, ""
        self._cursor = cursor
        if expected:
            if _same_entry(expected, cursor):
                return
            text = "the entry that was read last is not in the journal any more, or is not chosen"
            self.sink.event("journald_gone", f"{text}; entries behind it may be missing")
        row = self._row(entry)
        if not self._is_up:
            self._up()
        self.sink.message(self._stream, msgspec.json.encode(row), self.sink.now_ns())

    def _row(self, entry: Mapping[str, Any]) -> Mapping[str, Any]:
        longest = self.config.longest_bytes
        texts = {
            name: next((text for key in keys if (text := _text(entry.get(key)))), "")
            for name, keys in _TEXTS.items()
        }
        texts |= {name.lower(): _text(entry.get(name)) for name in self.config.fields}
        cut = 0
        for name, text in texts.items():
            data = text.encode(errors="backslashreplace") if len(text) * 4 > longest else b""
            if len(data) > longest:
                texts[name] = data[:longest].decode(errors="ignore")
                cut += len(data) - longest
        numbers = {name: _number(entry.get(key)) for name, key in _NUMBERS.items()}
        realtime = _number(entry.get("__REALTIME_TIMESTAMP"))
        stamp_ns = (realtime if realtime is not None else _time_us(texts["cursor"])) * 1000
        return {"stamp": stamp_ns, **numbers, **texts, "cut": cut}

    # -- the link

    def _up(self) -> None:
        self._is_up, self._told = True, ""
        self.sink.link_up(ENTRIES, self.config.place)

    def _down(self, reason: str) -> None:
        if self._is_up:
            self._is_up = False
            self.sink.link_down(ENTRIES, self.config.place, reason)


def _cursor_in(message: bytes | None) -> str:
    """Return the cursor of a recorded entry; empty without one."""
    if message is None:
        return ""
    try:
        return str(_decode(message).get("cursor", ""))
    except msgspec.DecodeError:
        return ""


def _time_us(cursor: str) -> int:
    """Return the wall time of the entry of a cursor, us since the epoch."""
    found = _CURSOR.fullmatch(cursor)
    return int(found[1], 16) if found else 0


def _same_entry(one: str, other: str) -> bool:
    """Return whether two cursors are of the same entry, be it in another file."""
    return one.split(";")[2:] == other.split(";")[2:]


def _text(value: Any) -> str:
    """Return a field as text: binary ones are lists of bytes, repeated ones lists of these."""
    if isinstance(value, str):
        return value
    if not isinstance(value, list):
        return ""
    if all(isinstance(part, int) for part in value):
        return bytes(part & 0xFF for part in value).decode(errors="backslashreplace")
    return "\n".join(_text(part) for part in value)


def _number(value: Any) -> int | None:
    """Return a field as a number below 2**63; None if it is none."""
    text = _text(value)
    is_number = text.isascii() and text.isdecimal() and len(text) < 19
    return int(text) if is_number else None
