"""The worker's program with operations that tests need: slow, greedy, wrong, talkative."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.workers.process import main

MODULE = "amberbox.server.trial.worker"


def echo(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Return the argument, after a while."""
    time.sleep(arguments.get("wait_s", 0.0))
    return str(arguments["text"]).encode()


def parts(folder: Path, arguments: Mapping[str, Any]) -> Iterator[bytes]:
    """Give so many parts of so many bytes."""
    for number in range(arguments["count"]):
        yield bytes([number % 256]) * arguments["size"]


def spin(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Never end."""
    while True:
        pass


def hoard(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Take more and more memory."""
    held = []
    while True:
        held.append(bytearray(16 << 20))


def talk(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Print what does not belong into the answer."""
    print("this is not the answer")
    return b"the answer"


def usage(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Complain about the question."""
    raise UsageError("there is no such thing", "there are others")


def known(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Complain about the data."""
    raise AmberboxError("the data are bad", "get better ones")


def wrong(folder: Path, arguments: Mapping[str, Any]) -> bytes:
    """Make a mistake."""
    raise KeyError("a mistake")


if __name__ == "__main__":
    trial = ModuleType(MODULE)
    vars(trial).update(globals())
    sys.modules[MODULE] = trial
    main()
