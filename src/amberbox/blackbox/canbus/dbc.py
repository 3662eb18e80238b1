"""DBC files: the messages of a CAN bus and their signals, as layouts of frames."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from amberbox.blackbox.canbus.definition import CanDefinition
from amberbox.blackbox.columns.frame_layout import FrameField, FrameLayout, Switch
from amberbox.core.errors import AmberboxError

_LINE = re.compile(r"at line (\d+), column \d+: (.*)", re.DOTALL)
_HINT = "docs/robot/sources.md names the parts of a DBC file that are used"
_NO_MESSAGE = "VECTOR__INDEPENDENT_SIG_MSG"  # where editors keep signals of no message
_MOST_BITS = 64 * 8


def read_dbc(path: Path, text: str) -> Sequence[CanDefinition]:
    """Return the messages of a DBC file that have signals; raises AmberboxError."""
    from cantools import database

    logging.getLogger("cantools").setLevel(logging.ERROR)  # what it warns of is checked here
    try:
        found: Any = database.load_string(text, database_format="dbc", strict=False)
    except Exception as error:  # the parser raises all kinds of errors for hostile files
        raise _unreadable(path, error) from error
    return [
        CanDefinition.of(
            message.frame_id,
            message.is_extended_frame,
            message.name,
            FrameLayout(tuple(_fields(path, text, message))),
            f"{path}:{_line(text, message.name)}",
        )
        for message in found.messages
        if message.signals and message.name != _NO_MESSAGE
    ]


def _unreadable(path: Path, error: Exception) -> AmberboxError:
    match = _LINE.search(str(error))
    if match is not None:
        place = re.sub(r"\s+", " ", match[2]).strip('" ')
        return AmberboxError(f"{path}:{match[1]}: not understood from >>!<< on: {place}", _HINT)
    what = " ".join(str(error).split())[:200] or type(error).__name__
    return AmberboxError(f"{path}:1: cannot be read as a DBC file: {what}", _HINT)


def _line(text: str, message: str, signal: str = "") -> int:
    """Return the line of a message, or of a signal of it."""
    found = re.search(rf"^\s*BO_\s+\d+\s+{re.escape(message)}\s*:", text, re.MULTILINE)
    at = found.end() if found else 0
    if signal:
        inside = re.compile(rf"\bSG_\s+{re.escape(signal)}\b").search(text, at)
        at = inside.end() if inside else at
    return text.count("\n", 0, at) + 1


def _fields(path: Path, text: str, message: Any) -> Iterator[FrameField]:
    """Yield the signals of a message; a multiplexer comes before those that depend on it."""
    waiting, done = list(message.signals), set[str]()
    while waiting:
        ready = [s for s in waiting if not s.multiplexer_signal or s.multiplexer_signal in done]
        for signal in ready:
            wrong = _wrong_with(signal)
            if wrong:
                line = _line(text, message.name, signal.name)
                raise AmberboxError(
                    f"{path}:{line}: signal {signal.name} of {message.name} {wrong}", _HINT
                )
            yield _field(signal)
        done |= {signal.name for signal in ready}
        waiting = [signal for signal in waiting if signal.name not in done]
        if waiting and not ready:
            line = _line(text, message.name, waiting[0].name)
            raise AmberboxError(
                f"{path}:{line}: signal {waiting[0].name} depends on "
                f"{waiting[0].multiplexer_signal}, which is no multiplexer of {message.name}",
                _HINT,
            )


def _wrong_with(signal: Any) -> str:
    if signal.conversion.is_float and signal.length not in (16, 32, 64):
        return f"is a float of {signal.length} bits"
    if not 1 <= signal.length <= 64:
        return f"has {signal.length} bits; signals have 1 to 64"
    if not 0 <= signal.start < _MOST_BITS:
        return f"begins at bit {signal.start}; frames have {_MOST_BITS} at most"
    if not all(map(math.isfinite, (signal.scale, signal.offset))):
        return "has a scale or an offset that is no number"
    return ""


def _field(signal: Any) -> FrameField:
    is_big = signal.byte_order == "big_endian"
    start = signal.start
    kind = "float" if signal.conversion.is_float else "int" if signal.is_signed else "uint"
    when = None
    if signal.multiplexer_signal:
        when = Switch(signal.multiplexer_signal, tuple(signal.multiplexer_ids or ()))
    return FrameField(
        signal.name,
        start // 8 * 8 + 7 - start % 8 if is_big else start,
        signal.length,
        kind,  # type: ignore[arg-type]  # a conditional expression has the type str
        "big" if is_big else "little",
        float(signal.scale),
        float(signal.offset),
        signal.unit or "",
        {int(number): str(label) for number, label in (signal.choices or {}).items()},
        when,
    )
