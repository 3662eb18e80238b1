"""Lines of a serial port: as text, JSON, comma-separated values or by a regular expression."""

from __future__ import annotations

import csv
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Literal

import msgspec

from amberbox.core.errors import AmberboxError
from amberbox.core.names import identifier
from amberbox.core.options import option
from amberbox.core.pacing import Backoff
from amberbox.core.rejects import RejectCounter
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import unknown_topics
from amberbox.core.types import Schema, Topic

SAMPLE = """\
- serial:
    port: /dev/serial/by-id/usb-Bosch_scale-if00
    baudrate: 115200
    regex: '^W=(?P<weight_kg>[-0-9.]+) T=(?P<celsius>[-0-9.]+)$'
    topics:
      - topic: {name: lines, max_frequency: 10}
"""
PASSIVE = (
    "reads {config.port} and never writes to it; the kernel raises DTR and RTS when it is opened"
)

LINES = "lines"
_INSTALL = "pip install 'amberbox[serial]'"
_POLL_S = 0.1
_MOST_DELIMITER = 16
_NUMBER = re.compile(r"\s*[+-]?([0-9]{1,18}|[0-9]{1,40}\.?[0-9]{0,40}([eE][+-]?[0-9]{1,3})?)\s*")
_PARITIES = {"none": "N", "even": "E", "odd": "O", "mark": "M", "space": "S"}
_decode = msgspec.json.Decoder(dict[str, Any]).decode


@dataclass(frozen=True)
class SerialOptions:
    """The ``serial`` block: one port."""

    port: str = option(doc="the port, best by a name that stays, as in /dev/serial/by-id")
    baudrate: int = option(9600, "bits per second on the wire", unit="bit/s")
    data_bits: Literal[5, 6, 7, 8] = option(8, "bits of a character")
    parity: Literal["none", "even", "odd", "mark", "space"] = option("none", "parity bit")
    stop_bits: Literal[1, 2] = option(1, "stop bits of a character")
    encoding: str = option("utf-8", "encoding of the text; one that extends ASCII")
    delimiter: str = option("\n", "what ends a line; a carriage return before it is left out")
    longest_bytes: int = option(4096, "a longer line is left out, counted", unit="bytes")
    regex: str = option("", "regular expression whose named groups become columns")
    csv: Sequence[str] = option((), "names of comma-separated values")
    separator: str = option(",", "character between these values; a space stands for several")
    json: bool = option(False, "lines are JSON objects")
    topics: Sequence[TopicOptions] = option((), "options of the only topic, lines")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if not self.port:
            yield "port", "names no port; write /dev/ttyUSB0"
        if not 0 < self.baudrate <= 20_000_000:
            yield "baudrate", "must be above 0"
        if not 1 <= len(self.delimiter) <= _MOST_DELIMITER:
            yield "delimiter", f"must have 1 to {_MOST_DELIMITER} characters"
        if not 1 <= self.longest_bytes <= 1 << 20:
            yield "longest_bytes", "must be between 1 and 1048576"
        if not _extends_ascii(self.encoding):
            yield "encoding", f"'{self.encoding}' is no encoding that extends ASCII"
        if len(self.separator) != 1:
            yield "separator", "must be one character"
        if sum(map(bool, (self.regex, self.csv, self.json))) > 1:
            yield "regex", "only one of regex, csv and json describes the lines"
        yield from self._wrong_columns()
        yield from unknown_topics(self.topics, (LINES,))

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield a note where pyserial is missing."""
        if find_spec("serial") is None:
            yield "port", f"pyserial is missing: {_INSTALL}"

    def _wrong_columns(self) -> Iterator[tuple[str, str]]:
        for name in self.csv:
            if identifier(name) != name:
                yield "csv", f"'{name}' is no name of a column; write {identifier(name)}"
        if len(set(self.csv)) < len(self.csv):
            yield "csv", "names a column twice"
        try:
            groups = re.compile(self.regex).groupindex
        except (re.error, OverflowError, RecursionError) as error:
            yield "regex", f"is no regular expression: {error}"
        else:
            if self.regex and not groups:
                yield "regex", "has no named group; write (?P<weight_kg>[0-9.]+)"


Config = SerialOptions


def _extends_ascii(encoding: str) -> bool:
    try:
        return "a\n".encode(encoding) == b"a\n"
    except (LookupError, UnicodeError):
        return False


def needs_process(config: SerialOptions) -> bool:
    """Return whether a line may take for ever: a regular expression can, and stops all threads."""
    return bool(config.regex)


def known_topics(config: SerialOptions) -> Sequence[Topic]:
    """Return the only topic; the types of its columns are only known for lines of text."""
    if config.json or config.csv or config.regex:
        return [Topic(LINES, "json")]
    document = {"type": "object", "properties": {"text": {"type": "string"}}}
    schema = Schema("amberbox/serial_line", "jsonschema", msgspec.json.encode(document))
    return [Topic(LINES, "json", schema)]


class SerialSource:
    """Reads the lines of one port."""

    lossless = False

    def __init__(self, config: SerialOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics or [TopicOptions(LINES)]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Read until ``stop`` is set; a port that is missing or fails is opened again."""
        reader = _Reader(self.config, sink)
        backoff, told = Backoff(), ""
        while not stop.is_set():
            try:
                port = _open(self.config)
            except ImportError as error:
                raise AmberboxError("pyserial is missing", _INSTALL) from error
            except Exception as error:  # drivers raise all kinds of errors
                why = f"cannot open {self.config.port}: {_one_line(error)}"
                if why != told:
                    sink.event("serial_missing", why, port=self.config.port)
                told = why
            else:
                told = ""
                backoff.succeeded()
                reader.read(port, stop)
            stop.wait(backoff.failed())


Source = SerialSource


def _open(config: SerialOptions) -> Any:
    """Open the port. DTR and RTS stay as the kernel sets them, also when it is closed."""
    import termios

    import serial  # type: ignore[import-untyped]  # has no types

    class QuietSerial(serial.Serial):  # type: ignore[misc]  # of Any
        """A port whose control lines are never set by us."""

        def _update_dtr_state(self) -> None:
            """Leave DTR alone."""

        def _update_rts_state(self) -> None:
            """Leave RTS alone."""

    port = QuietSerial(
        config.port,
        config.baudrate,
        config.data_bits,
        _PARITIES[config.parity],
        config.stop_bits,
        timeout=_POLL_S,
        exclusive=True,
    )
    with suppress(OSError, termios.error):
        settings = termios.tcgetattr(port.fd)
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fd, termios.TCSANOW, settings)
    return port


@dataclass
class _Reader:
    """Makes rows of lines."""

    config: SerialOptions
    sink: Sink
    _rest: bytes = b""
    _is_too_long: bool = False
    _delimiter: bytes = field(init=False)

    def __post_init__(self) -> None:
        config = self.config
        self._stream = self.sink.topic(known_topics(config)[0])
        self._rejected = RejectCounter(self.sink, LINES, config.port)
        self._delimiter = config.delimiter.encode(config.encoding)
        self._pattern = re.compile(config.regex)

    def read(self, port: Any, stop: threading.Event) -> None:
        """Read until ``stop`` is set or the port fails."""
        name = self.config.port
        self.sink.event("serial_open", f"listening on {name}", port=name)
        self.sink.link_up(LINES, name)
        reason = "stopped"
        while not stop.is_set():
            try:
                data = port.read(port.in_waiting or 1)
            except Exception as error:  # drivers raise all kinds of errors
                reason = _one_line(error)
                self.sink.event("serial_lost", f"{name}: {reason}", port=name)
                break
            if data:
                self._feed(data)
            self._rejected.report()
        if self._rest:
            self._rejected.add("a line that does not end", self._rest)
        self._rest, self._is_too_long = b"", False
        self._rejected.report(now=True)
        self.sink.link_down(LINES, name, reason)
        with suppress(Exception):
            port.close()

    def _feed(self, data: bytes) -> None:
        received_ns = self.sink.now_ns()
        *lines, rest = (self._rest + data).split(self._delimiter)
        longest = self.config.longest_bytes
        for line in lines:
            if self._is_too_long:  # its end
                self._is_too_long = False
            elif len(line) > longest:
                self._reject_long(line)
            elif line := line.removesuffix(b"\r"):
                self._line(line, received_ns)
        if len(rest) > longest + len(self._delimiter):
            if not self._is_too_long:
                self._reject_long(rest)
            self._is_too_long = True
            rest = rest[-len(self._delimiter) :]  # it may hold the first part of a delimiter
        self._rest = rest

    def _reject_long(self, line: bytes) -> None:
        self._rejected.add(f"a line of more than {self.config.longest_bytes} bytes", line[:99])

    def _line(self, line: bytes, received_ns: int) -> None:
        text = line.decode(self.config.encoding, errors="backslashreplace")
        row = self._row(text)
        if row is None:
            self._rejected.add("a line that does not fit", line)
        else:
            self.sink.message(self._stream, msgspec.json.encode(row), received_ns)

    def _row(self, text: str) -> Mapping[str, Any] | None:
        """Return the columns of a line; None if it does not fit its description."""
        config = self.config
        if config.json:
            try:
                return _decode(text)
            except (msgspec.DecodeError, UnicodeEncodeError, RecursionError):
                return None
        if config.csv:
            parts = _split(text, config.separator)
            if parts is None or len(parts) != len(config.csv):
                return None
            return {name: _value(part) for name, part in zip(config.csv, parts, strict=True)}
        if config.regex:
            found = self._pattern.search(text)
            return found and {name: _value(part) for name, part in found.groupdict().items()}
        return {"text": text}


def _split(text: str, separator: str) -> list[str] | None:
    if separator == " ":
        return text.split()
    try:
        return next(csv.reader([text], delimiter=separator), None)
    except csv.Error:
        return None


def _value(text: str | None) -> int | float | str | None:
    """Return a number where a text is one, None where it is empty."""
    if not text:
        return None
    found = _NUMBER.fullmatch(text)
    if found is None:
        return text
    is_whole = found[1].isdecimal() and len(found[1]) <= 18
    number = int(text) if is_whole else float(text)
    return number if abs(number) < float("inf") else text


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
