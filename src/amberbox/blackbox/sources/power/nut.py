"""A UPS behind Network UPS Tools: asks upsd for its variables, never logs in, sets nothing."""

from __future__ import annotations

import shlex
import socket
import time
from collections.abc import Iterator, Mapping

from amberbox.blackbox.sources.power.reading import Reading, UnreadableError, number
from amberbox.core.source import Power

PORT = 3493
_PATIENCE_S = 0.7
"""For connecting and all answers; a source has to stop within a second."""
_LONGEST_BYTES = 1 << 20


class Nut:
    """A connection to upsd that is made when needed and kept."""

    def __init__(self, host: str, port: int, ups: str) -> None:
        self._address = (host, port)
        self._ups = ups
        self._link: socket.socket | None = None
        self._deadline = 0.0

    def read(self) -> Reading:
        """Ask for all variables of the UPS; raise UnreadableError if they cannot be had."""
        self._deadline = time.monotonic() + _PATIENCE_S
        try:
            if not self._ups:
                self._ups = _only(self._ask("LIST UPS"))
            return reading(dict(_variables(self._ask(f"LIST VAR {self._ups}"))))
        except OSError as error:
            self.close()
            host, port = self._address
            what = error.strerror or str(error) or "no answer"
            raise UnreadableError(f"upsd at {host}:{port}: {what}") from None

    def close(self) -> None:
        """Hang up."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _ask(self, question: str) -> list[str]:
        """Return the lines between ``BEGIN`` and ``END`` of an answer."""
        if self._link is None:
            self._link = socket.create_connection(self._address, self._left_s())
        self._link.sendall(f"{question}\n".encode())
        end = f"END {question}\n"
        answer = self._receive(self._link, end)
        if answer.startswith("ERR"):
            raise UnreadableError(f"upsd says {answer.strip()} to {question}")
        return answer.splitlines()[1:-1]

    def _receive(self, link: socket.socket, end: str) -> str:
        answer = b""
        while not answer.endswith(end.encode()) and not _is_refusal(answer):
            link.settimeout(self._left_s())
            more = link.recv(65536)
            if not more:
                raise ConnectionResetError("the connection was closed")
            answer += more
            if len(answer) > _LONGEST_BYTES:
                raise ConnectionAbortedError("an answer without end")
        return answer.decode(errors="replace")

    def _left_s(self) -> float:
        return max(0.001, self._deadline - time.monotonic())


def reading(variables: Mapping[str, str]) -> Reading:
    """Read state and battery from a UPS' variables."""
    return Reading(
        _state(variables.get("ups.status", "")),
        _number(variables, "battery.charge"),
        _number(variables, "battery.voltage"),
        _number(variables, "battery.current"),
        _number(variables, "battery.runtime", 1 / 60),
    )


def _state(status: str) -> Power:
    """Read ``OL CHRG`` and the like; LB counts on battery only, FSD (it will be cut) always."""
    words = set(status.split())
    if "FSD" in words or {"OB", "LB"} <= words:
        return "low"
    if "OB" in words:
        return "battery"
    if words & {"OL", "BYPASS"}:
        return "mains"
    raise UnreadableError(f"the UPS says '{status}', which tells nothing about its power")


def _variables(lines: list[str]) -> Iterator[tuple[str, str]]:
    """Yield names and values of lines such as ``VAR ups battery.charge "100"``."""
    for words in map(_words, lines):
        if len(words) == 4 and words[0] == "VAR":
            yield words[2], words[3]


def _only(lines: list[str]) -> str:
    """Return the UPS if there is one; several have to be told apart by whoever configures."""
    names = [words[1] for words in map(_words, lines) if len(words) > 1 and words[0] == "UPS"]
    if len(names) != 1:
        has = f"{len(names)} UPS ({', '.join(names)})" if names else "no UPS"
        raise UnreadableError(f"upsd has {has}; name one with 'ups:'")
    return names[0]


def _words(line: str) -> list[str]:
    try:
        return shlex.split(line)
    except ValueError:  # an open quotation mark
        return []


def _is_refusal(answer: bytes) -> bool:
    return answer.startswith(b"ERR") and answer.endswith(b"\n")


def _number(variables: Mapping[str, str], name: str, scale: float = 1.0) -> float | None:
    try:
        return number(variables[name], name) * scale
    except (KeyError, UnreadableError):
        return None
