"""One side of a comparison: an installed Amberbox and how its commands are run, frozen."""

from __future__ import annotations

import json
import os
import select
import signal
import struct
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

NS = 1_000_000_000
NOW_NS = 1_767_603_600 * NS
"""Wall time in every child process: 2026-01-05T09:00:00Z, an hour after simulated robots start."""
FREEZE = Path(__file__).with_name("freeze")
_GRACE_S = 10.0


class Clock:
    """A wall clock that child processes read from a file and that is moved by hand."""

    def __init__(self, path: Path, now_ns: int = NOW_NS) -> None:
        self.path = path
        self.set_ns(now_ns)

    def set_ns(self, now_ns: int) -> None:
        """Set wall time (and with it time since boot) of all processes that follow this clock."""
        self.now_ns = now_ns
        with self.path.open("r+b" if self.path.exists() else "w+b") as file:
            file.write(struct.pack("<q", now_ns))

    def advance_s(self, seconds: float) -> None:
        """Go on by so many seconds."""
        self.set_ns(self.now_ns + round(seconds * NS))


@dataclass(frozen=True)
class Completed:
    """A command that has ended."""

    args: Sequence[str]
    code: int
    stdout: bytes
    stderr: bytes


@dataclass(frozen=True)
class Running:
    """A command that was started and runs on; its output goes to two files."""

    process: subprocess.Popen[bytes]
    stdout: Path
    stderr: Path

    def stop(self, number: int = signal.SIGTERM, timeout_s: float = _GRACE_S) -> int:
        """Signal the process, wait, kill its group if it stays; return the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout_s)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        return self.process.wait()


@dataclass
class Side:
    """An installed Amberbox, a folder of its own for what it makes, and a frozen environment.

    ``place`` has the same path on both sides of a comparison (they run one after the other), so
    paths in the output need no care. Leaving the context kills what ``start`` started.
    """

    python: Path
    scratch: Path
    more: Mapping[str, str] = field(default_factory=dict)
    """Further environment variables."""
    forks: bool = True
    """Run commands in forks of one process, which is quicker."""
    _calls: int = 0
    _server: subprocess.Popen[str] | None = None
    _running: list[Running] = field(default_factory=list)

    def __enter__(self) -> Side:
        self.scratch.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def script(self) -> Path:
        """The console script ``amberbox`` of this side."""
        return self.python.with_name("amberbox")

    def clock(self, name: str = "clock", now_ns: int = NOW_NS) -> Clock:
        """Return a clock that is moved by hand; give it to ``run`` or ``start``."""
        return Clock(self.scratch / name, now_ns)

    def env(self, now_ns: int = NOW_NS, clock: Clock | None = None) -> dict[str, str]:
        """Return the whole environment of a child: frozen clock, seed of this call, no user's."""
        home = self.scratch / "home"
        temporary = self.scratch / "tmp"
        for folder in (home, temporary):
            folder.mkdir(parents=True, exist_ok=True)
        found = {
            "PATH": os.pathsep.join(
                [str(self.python.parent), "/usr/local/bin", "/usr/bin", "/bin"]
            ),
            "PYTHONPATH": str(FREEZE),
            "PYTHONHASHSEED": "0",
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONWARNINGS": "ignore",
            "HOME": str(home),
            "TMPDIR": str(temporary),
            "XDG_RUNTIME_DIR": str(temporary),
            "MPLCONFIGDIR": str(self.scratch.parent / "matplotlib"),
            "MPLBACKEND": "Agg",
            "SOURCE_DATE_EPOCH": str(now_ns // NS),
            "LOGNAME": "oracle",
            "USER": "oracle",
            "TZ": "UTC",
            "LC_ALL": "C.UTF-8",
            "COLUMNS": "100",
            "LINES": "40",
            "TERM": "dumb",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "ORACLE_NOW_NS": str(now_ns),
            "ORACLE_START_NS": str(NOW_NS),
            "ORACLE_SEED": str(self._calls),
        }
        if clock is not None:
            found["ORACLE_CLOCK"] = str(clock.path)
        return {**found, **self.more}

    def run(
        self,
        args: Sequence[str | Path],
        *,
        stdin: bytes | None = None,
        cwd: Path | None = None,
        timeout: float = 120.0,
        now_ns: int = NOW_NS,
        clock: Clock | None = None,
        module: str = "amberbox",
        ordered: bool = False,
    ) -> Completed:
        """Run ``python -m amberbox ARGS`` to its end (``module`` "" runs ``python ARGS``).

        ``ordered``: each thread runs until it waits before another one starts, so that what a
        recording makes is the same byte for byte.
        """
        command = self._command(args, module)
        environment = self._next_env(now_ns, clock)
        if (
            self.forks
            and module == "amberbox"
            and not ordered
            and (now_ns, clock) == (NOW_NS, None)
        ):
            return self._forked(args, stdin or b"", cwd or self.scratch, timeout)
        if ordered:
            environment["ORACLE_ORDER"] = "1"
        done = subprocess.run(
            command, input=b"" if stdin is None else stdin, cwd=cwd or self.scratch,
            env=environment, capture_output=True, timeout=timeout, check=False,
        )  # fmt: skip
        return Completed(command[1:], done.returncode, done.stdout, done.stderr)

    def _forked(
        self, args: Sequence[str | Path], stdin: bytes, folder: Path, timeout: float
    ) -> Completed:
        """Run a command in a fork of a process that has loaded what most commands need."""
        if self._server is None:
            self._server = subprocess.Popen(
                [self.python, FREEZE.with_name("forks.py")], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, env=self.env(), cwd=self.scratch, text=True,
                start_new_session=True,
            )  # fmt: skip
        paths = [self.scratch / f".{name}" for name in ("stdin", "stdout", "stderr")]
        paths[0].write_bytes(stdin)
        words = list(map(str, args))
        request = [words, str(folder), *map(str, paths), str(self._calls)]
        assert self._server.stdin is not None and self._server.stdout is not None
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        child = int(self._server.stdout.readline())
        if not select.select([self._server.stdout], [], [], timeout)[0]:
            os.killpg(child, signal.SIGKILL)
            self._server.stdout.readline()
            raise subprocess.TimeoutExpired(words, timeout)
        code = int(self._server.stdout.readline())
        done = Completed(["-m", "amberbox", *words], code, *(p.read_bytes() for p in paths[1:]))
        for path in paths:
            path.unlink()
        return done

    def start(
        self,
        args: Sequence[str | Path],
        *,
        cwd: Path | None = None,
        now_ns: int = NOW_NS,
        clock: Clock | None = None,
        module: str = "amberbox",
        stdin: int = subprocess.DEVNULL,
    ) -> Running:
        """Start ``python -m amberbox ARGS`` in a process group of its own; it is ended at last."""
        number = len(self._running)
        paths = [self.scratch / f"started-{number}.{kind}" for kind in ("stdout", "stderr")]
        environment = self._next_env(now_ns, clock)
        with paths[0].open("wb") as stdout, paths[1].open("wb") as stderr:
            process = subprocess.Popen(
                self._command(args, module), stdin=stdin, stdout=stdout, stderr=stderr,
                cwd=cwd or self.scratch, env=environment, start_new_session=True,
            )  # fmt: skip
        running = Running(process, *paths)
        self._running.append(running)
        return running

    def close(self) -> None:
        """End everything that was started, last first."""
        while self._running:
            self._running.pop().stop()
        if self._server is not None:
            assert self._server.stdin is not None
            self._server.stdin.close()
            self._server.wait()
            self._server = None

    def _command(self, args: Sequence[str | Path], module: str) -> list[str]:
        return [str(self.python), *(["-m", module] if module else []), *map(str, args)]

    def _next_env(self, now_ns: int, clock: Clock | None) -> dict[str, str]:
        self._calls += 1
        return self.env(now_ns, clock)
