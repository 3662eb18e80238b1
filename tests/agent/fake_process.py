"""A process that is moved by hand, and what starts it."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from amberbox.agent.process import ChildProcess


@dataclass
class FakeProcess:
    """A process that does nothing; ``obeys`` decides whether it ends when it is stopped."""

    pid: int
    obeys: bool = True
    status: int | None = None
    sent: list[int] = field(default_factory=list)
    words: str = ""
    _told: list[tuple[str, str]] = field(default_factory=list)
    is_closed: bool = False

    def tell(self, *messages: tuple[str, str]) -> None:
        self._told += messages

    def poll(self) -> int | None:
        return self.status

    def received(self) -> Iterable[tuple[str, str]]:
        told, self._told = self._told, []
        return told

    def send(self, number: int) -> None:
        self.sent.append(number)
        if number == signal.SIGKILL:
            self.status = -number
        elif self.obeys:
            self.status = 0

    def filenos(self) -> Sequence[int]:
        return ()

    def error(self) -> str:
        return self.words

    def close(self) -> None:
        self.is_closed = True


@dataclass
class FakeLauncher:
    """Starts fake processes, or fails to; keeps all of them, and the commands given."""

    started: list[FakeProcess] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    told: list[tuple[str, str]] = field(default_factory=list)
    trouble: OSError | None = None

    def launch(self, child: ChildProcess) -> FakeProcess:
        if self.trouble is not None:
            raise self.trouble
        self.started.append(FakeProcess(len(self.started) + 1))
        self.names.append(child.name)
        return self.started[-1]

    def tell(self, kind: str, text: str, **_: Any) -> None:
        self.told.append((kind, text))

    @property
    def last(self) -> FakeProcess:
        return self.started[-1]

    def of(self, name: str) -> FakeProcess:
        """Return the newest process of a child."""
        return [p for p, n in zip(self.started, self.names, strict=True) if n == name][-1]
