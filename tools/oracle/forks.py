"""Run commands of the console script in forks of one process, which saves most of their start.

It runs in the interpreter of a side, with the frozen environment. Each line on stdin is a JSON
list: arguments, working folder, files for stdin, stdout and stderr, seed. It answers with the
process id of the fork, then with its exit code.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import entry_points
from typing import Any

_AHEAD = ("numpy", "yaml", "msgspec", "zstandard", "pyarrow.parquet", "rosbags.typesys", "uuid",
          "cryptography.hazmat.primitives.asymmetric.ed25519")  # fmt: skip
"""Packages of others that most commands load."""


def serve() -> None:
    """Answer requests until stdin ends."""
    for name in _AHEAD:
        with suppress(ImportError):
            importlib.import_module(name)
    (script,) = entry_points(group="console_scripts", name="amberbox")
    main = script.load()
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if not child:
            _become(request, main)
        print(child, flush=True)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _become(request: list[Any], main: Callable[[], int | None]) -> None:
    """Be the command: its files, arguments, randomness; never return."""
    arguments, folder, stdin, stdout, stderr, seed = request
    os.setpgid(0, 0)
    os.chdir(folder)
    writing = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    for number, path, flags in (
        (0, stdin, os.O_RDONLY),
        (1, stdout, writing),
        (2, stderr, writing),
    ):
        opened = os.open(path, flags, 0o600)
        os.dup2(opened, number)
        os.close(opened)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - stays open
    sys.argv = ["amberbox", *arguments]
    sys.orig_argv = [sys.executable, "-m", "amberbox", *arguments]
    importlib.import_module("sitecustomize").reseed(seed)
    sys.exit(main())


if __name__ == "__main__":
    serve()
