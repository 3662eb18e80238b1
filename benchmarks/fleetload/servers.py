"""A real ``amberbox serve`` with robots that it knows, and what its processes use."""

from __future__ import annotations

import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from sqlalchemy import func, select

from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import add_user
from amberbox.server.archive.catalogue import COMMITTED
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.schema import JOURNALS, ROW
from benchmarks.common import free_port

_TICK = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Usage:
    """CPU seconds and most memory of a process; ``role`` is server or worker."""

    role: str
    cpu_s: float = 0.0
    rss: int = 0


@dataclass
class Server:
    """A server in a process of its own; a context manager that ends it."""

    folder: Path
    names: Sequence[str]
    tls: bool = False
    keys: dict[str, str] = field(default_factory=dict)
    token: str = ""
    start_s: float = 0.0
    port: int = 0
    usage: dict[int, Usage] = field(default_factory=dict)
    rows: list[int] = field(default_factory=list)
    """How many early rows the database held, as time went."""
    sizes_mb: list[float] = field(default_factory=list)
    """How large the database was then."""
    _process: subprocess.Popen[bytes] | None = None
    _stop: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> Server:
        self.folder.mkdir(parents=True)
        self.port = free_port()
        self._enrol()
        words = ["serve", "--data", str(self.folder)]
        if self.tls:
            self._run([*words[:1], "cert", *words[1:], "--host", "localhost"]).wait()
        began = time.perf_counter()
        self._process = self._run([*words, "--port", str(self.port), "--quiet"])
        self._await()
        self.start_s = time.perf_counter() - began
        self._looking = threading.Thread(target=self._look, daemon=True)
        self._looking.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._stop.set()
        self._looking.join()
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(30)

    @property
    def url(self) -> str:
        """Address of the server."""
        return f"{'https' if self.tls else 'http'}://localhost:{self.port}"

    @property
    def context(self) -> ssl.SSLContext | None:
        """What a client needs to trust it."""
        return ssl.create_default_context(cafile=self.folder / "tls/ca.pem") if self.tls else None

    def cpu_s(self, role: str) -> float:
        """CPU seconds that the server or its workers took so far."""
        return sum(one.cpu_s for one in self.usage.values() if one.role == role)

    def memory_mb(self, role: str) -> float:
        """Most memory of the server, or of its workers together."""
        return sum(one.rss for one in self.usage.values() if one.role == role) / 1e6

    def database_mb(self) -> float:
        """Size of the database and of what is not merged into it yet."""
        return sum(p.stat().st_size for p in self.folder.glob(f"{FILE}*")) / 1e6

    def growth_mb_h(self) -> float:
        """How much the database grows an hour, by the second half of the time."""
        half = self.sizes_mb[len(self.sizes_mb) // 2 :]
        return (half[-1] - half[0]) / max(len(half) - 1, 1) * 360 if half else 0.0

    def archive_mb(self) -> float:
        """Size of the tables."""
        found = (p for p in (self.folder / "tables").rglob("*") if p.is_file())
        return sum(path.stat().st_size for path in found) / 1e6

    def waiting(self) -> tuple[int, int]:
        """Count the journals that have come, and those of them that are not in columns yet."""
        database = ServerDatabase(self.folder / FILE, read_only=True)
        with database.reading() as connection:
            states = select(JOURNALS.c.state, func.count()).group_by(JOURNALS.c.state)
            found = {state: int(count) for state, count in connection.execute(states)}
        database.close()
        return sum(found.values()), sum(found.values()) - found.get(COMMITTED, 0)

    def measure_now(self) -> None:
        """Look at the processes once more."""
        assert self._process is not None
        for pid, role in _family(self._process.pid).items():
            _note(self.usage, pid, role)

    def _enrol(self) -> None:
        now_ns, database = time.time_ns(), ServerDatabase(self.folder / FILE)
        with database.begin() as connection:
            hashed = Passwords(HashCost(1, 8, 1)).hash("a long enough passphrase")
            admin = add_user(connection, now_ns, "admin", Role.ADMIN, hashed)
            scopes = ["read:status", "read:data"]
            self.token = add_token(connection, now_ns, admin, "bench", scopes).text
            for name in self.names:
                self.keys[name] = add_robot(connection, now_ns, name, ()).text
        database.close()

    def _run(self, words: Sequence[str]) -> subprocess.Popen[bytes]:
        log = (self.folder / "said.log").open("ab")
        with log:
            return subprocess.Popen(
                [sys.executable, "-m", "amberbox", *words], stdin=subprocess.DEVNULL, stdout=log,
                stderr=log,
            )  # fmt: skip

    def _await(self) -> None:
        assert self._process is not None
        end_s = time.monotonic() + 60
        while time.monotonic() < end_s and self._process.poll() is None:
            try:
                return socket.create_connection(("localhost", self.port), 1.0).close()
            except OSError:
                time.sleep(0.02)
        raise RuntimeError((self.folder / "said.log").read_text()[-3000:])

    def _look(self) -> None:
        """Look at the processes each second, at the rows of the link every ten."""
        database, seconds = ServerDatabase(self.folder / FILE, read_only=True), 0
        while not self._stop.wait(1.0):
            self.measure_now()
            seconds += 1
            if seconds % 10 == 0:
                with database.reading() as connection:
                    count = connection.execute(select(func.count()).select_from(ROW)).scalar()
                self.rows.append(int(count or 0))
                self.sizes_mb.append(self.database_mb())
        database.close()


def _family(pid: int) -> dict[int, str]:
    """Return a process and all that it has started, by what they are."""
    found = {pid: "server"}
    for child in _children(pid):
        found |= dict.fromkeys(_family(child), "worker")
    return found


def _children(pid: int) -> list[int]:
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        return [int(n) for task in tasks for n in (task / "children").read_text().split()]
    except OSError:
        return []


def _note(usage: dict[int, Usage], pid: int, role: str) -> None:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return
    one = usage.setdefault(pid, Usage(role))
    one.cpu_s = (int(fields[11]) + int(fields[12])) / _TICK
    one.rss = max(one.rss, pages * _PAGE)
