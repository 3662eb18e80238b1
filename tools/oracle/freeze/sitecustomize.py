"""Freeze what makes two runs of one program differ: time, randomness, host, disk room.

Python imports this module by itself in every child process of the oracle, since its folder stands
first on PYTHONPATH. Wall time and boot time stand still, or follow a clock file that the oracle
moves; the monotonic clock goes on, so that timeouts end. It knows nothing of Amberbox.
"""

from __future__ import annotations

import builtins
import ctypes
import gc
import hashlib
import io
import mmap
import os
import re
import shutil
import struct
import sys
import threading
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

_NS = 1_000_000_000
_BOOT_AT_NS = 10 * 86_400 * _NS
"""Time since boot when wall time is what it was at the oracle's start."""
_FILES = {
    "/proc/sys/kernel/random/boot_id": "11111111-2222-4333-8444-555555555555\n",
    "/proc/uptime": "864000.00 1700000.00\n",
    "/proc/loadavg": "0.50 0.40 0.30 1/200 4242\n",
    "/proc/stat": "cpu  100 0 100 9000 10 0 0 0 0 0\ncpu0 100 0 100 9000 10 0 0 0 0 0\n",
    "/proc/meminfo": "MemTotal: 8000000 kB\nMemFree: 4000000 kB\nMemAvailable: 6000000 kB\n"
    "Buffers: 100000 kB\nCached: 900000 kB\nSwapTotal: 0 kB\nSwapFree: 0 kB\n",
    "/proc/net/wireless": "Inter-| sta-|   Quality\n face | tus | link level noise\n",
    "/proc/net/route": "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\n",
}


def _clock() -> Callable[[], int]:
    """Return a function that reads wall time, ns: of the clock file, else the fixed number."""
    path = os.environ.get("ORACLE_CLOCK")
    if not path:
        fixed = int(os.environ["ORACLE_NOW_NS"])
        return lambda: fixed
    with io.open(path, "rb") as file:  # noqa: UP020 - builtins.open is replaced further down
        shown = mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)
    return lambda: int(struct.unpack_from("<q", shown)[0])


def _freeze_time() -> None:
    wall_ns, real = _clock(), time.clock_gettime_ns
    start_ns = int(os.environ["ORACLE_START_NS"])
    boot = {time.CLOCK_BOOTTIME}
    wall = {time.CLOCK_REALTIME, getattr(time, "CLOCK_TAI", -1)}

    def gettime_ns(clock: int) -> int:
        if clock in boot:
            return wall_ns() - start_ns + _BOOT_AT_NS
        return wall_ns() if clock in wall else real(clock)

    def now_by_default(function: Callable[[float], Any]) -> Callable[..., Any]:
        return lambda seconds=None: function(wall_ns() / _NS if seconds is None else seconds)

    localtime = now_by_default(time.localtime)
    strftime, asctime = time.strftime, time.asctime
    _put(
        time,
        time_ns=wall_ns,
        time=lambda: wall_ns() / _NS,
        clock_gettime_ns=gettime_ns,
        clock_gettime=lambda clock: gettime_ns(clock) / _NS,
        localtime=localtime,
        gmtime=now_by_default(time.gmtime),
        ctime=now_by_default(time.ctime),
        strftime=lambda form, at=None: strftime(form, localtime() if at is None else at),
        asctime=lambda at=None: asctime(localtime() if at is None else at),
    )
    _freeze_dates(wall_ns)


def _freeze_dates(wall_ns: Callable[[], int]) -> None:
    """Replace methods in the C types themselves: a subclass would fail other libraries' checks."""
    import datetime

    def now(cls: Any, tz: Any = None) -> Any:
        return cls.fromtimestamp(wall_ns() // 1000 / 1_000_000, tz)

    def utcnow(cls: Any) -> Any:
        return cls.fromtimestamp(wall_ns() // 1000 / 1_000_000, datetime.UTC).replace(tzinfo=None)

    def today(cls: Any) -> Any:
        return cls.fromtimestamp(wall_ns() / _NS)

    moments = gc.get_referents(datetime.datetime.__dict__)[0]
    moments.update(now=classmethod(now), utcnow=classmethod(utcnow), today=classmethod(today))
    gc.get_referents(datetime.date.__dict__)[0]["today"] = classmethod(today)
    for kind in (datetime.datetime, datetime.date):
        ctypes.pythonapi.PyType_Modified(ctypes.py_object(kind))


class _Stream:
    """Random bytes by the seed of the run, the command line, and how often a process forked."""

    def __init__(self, seed: str) -> None:
        self._lock = threading.Lock()
        self._seed, self._count = seed.encode(), 0

    def urandom(self, size: int, /) -> bytes:
        """Return the next ``size`` bytes."""
        data = b""
        with self._lock:
            while len(data) < size:
                data += hashlib.sha256(b"%s/%d" % (self._seed, self._count)).digest()
                self._count += 1
        return data[:size]

    def forked(self) -> None:
        """Go another way than the parent process."""
        self._lock = threading.Lock()
        self._seed += b"/forked/%d" % self._count

    def begin(self, seed: str) -> None:
        """Begin anew for a command line; its numbers are process ids, ports: they do not count."""
        words = re.sub("[0-9]+", "", " ".join(sys.orig_argv[1:]))
        self._seed, self._count = f"{seed} {words}".encode(), 0


_stream = _Stream("")


def reseed(seed: str) -> None:
    """Begin the random numbers anew, in a fork that becomes another command."""
    import random

    _stream.begin(seed)
    random.seed(int.from_bytes(_stream.urandom(32), "big"))


def _freeze_randomness() -> None:
    stream = _stream
    stream.begin(os.environ.get("ORACLE_SEED", ""))
    os.register_at_fork(after_in_child=stream.forked)
    _put(os, urandom=stream.urandom, getrandom=lambda size, flags=0: stream.urandom(size))
    import random

    seed = random.Random.seed

    def seeded(self: random.Random, a: Any = None, version: int = 2) -> None:
        seed(self, int.from_bytes(stream.urandom(32), "big") if a is None else a, version)

    _put(random.Random, seed=seeded)
    random.seed(int.from_bytes(stream.urandom(32), "big"))
    _put(random, _urandom=stream.urandom)
    _when_imported("cryptography.hazmat.primitives.asymmetric.ed25519", _freeze_keys)


def _freeze_keys(module: ModuleType) -> None:
    """Make new Ed25519 keys of the frozen random bytes."""
    key = module.Ed25519PrivateKey
    _put(key, generate=staticmethod(lambda: key.from_private_bytes(os.urandom(32))))


def _when_imported(name: str, change: Callable[[ModuleType], None]) -> None:
    """Have a module changed as soon as something imports it."""

    class Loader:
        def __init__(self, loader: Any) -> None:
            self.loader = loader

        def create_module(self, spec: Any) -> Any:
            return self.loader.create_module(spec)

        def exec_module(self, module: ModuleType) -> None:
            self.loader.exec_module(module)
            change(module)

        def __getattr__(self, attribute: str) -> Any:
            return getattr(self.loader, attribute)

    class Finder:
        def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
            if fullname != name:
                return None
            for finder in sys.meta_path:
                spec = None if finder is self else finder.find_spec(fullname, path, target)
                if spec is not None:
                    _put(spec, loader=Loader(spec.loader))
                    return spec
            return None

    sys.meta_path.insert(0, Finder())


def _freeze_host() -> None:
    import socket

    _put(socket, gethostname=lambda: "oracle-host", getfqdn=lambda name="": name or "oracle-host")
    block, blocks = 4096, 25_000_000  # 102.4 GB, half of it free

    def statvfs(path: Any) -> os.statvfs_result:
        os.stat(path)  # noqa: PTH116 - a missing file is an error as before
        half = blocks // 2
        return os.statvfs_result((block, block, blocks, half, half, 1 << 20, 1 << 19, 1 << 19, 0,
                                  255))  # fmt: skip

    _put(os, statvfs=statvfs, fstatvfs=statvfs)
    usage = type(shutil.disk_usage("/"))  # a tuple with names: some callers unpack it
    _put(shutil, disk_usage=lambda path: usage(
        blocks * block, blocks // 2 * block, statvfs(path).f_bavail * block
    ))  # fmt: skip
    _freeze_files()
    library = ctypes.CDLL.__getattr__

    def symbol(self: ctypes.CDLL, name: str) -> Any:
        return (lambda buffer: 0) if name == "adjtimex" else library(self, name)

    _put(ctypes.CDLL, __getattr__=symbol)


def _freeze_files() -> None:
    """Answer reading a few files of the kernel with fixed texts."""
    real = io.open

    def opened(file: Any, mode: str = "r", *more: Any, **options: Any) -> Any:
        try:
            name = os.fspath(file) if not isinstance(file, int) else ""
        except TypeError:
            name = ""
        text = _FILES.get(name) if isinstance(name, str) else None
        if text is None:
            return real(file, mode, *more, **options)
        return io.BytesIO(text.encode()) if "b" in mode else io.StringIO(text)

    _put(io, open=opened)
    _put(builtins, open=opened)


def _order_threads() -> None:
    """Let each new thread run until it first waits or ends, before its maker goes on.

    What a thread does before it waits is then always done at once, however busy the machine is.
    The monotonic clock goes a thousandth as fast, so that nothing periodic comes due meanwhile.
    """
    began_ns, real_ns = time.monotonic_ns(), time.monotonic_ns
    _put(
        time,
        monotonic_ns=lambda: began_ns + (real_ns() - began_ns) // 1000,
        monotonic=lambda: (began_ns + (real_ns() - began_ns) / 1000) / _NS,
    )
    start, wait, idle = threading.Thread.start, threading.Condition.wait, set[int]()

    def waiting(self: threading.Condition, timeout: float | None = None) -> bool:
        idle.add(threading.get_ident())
        return wait(self, timeout)

    def started(self: threading.Thread) -> None:
        start(self)
        give_up_ns = real_ns() + 60 * _NS
        while self.is_alive() and self.ident not in idle and real_ns() < give_up_ns:
            _nap(0.001)

    _nap = time.sleep
    _put(threading.Condition, wait=waiting)
    _put(threading.Thread, start=started)


def _put(target: Any, **values: Any) -> None:
    for name, value in values.items():
        setattr(target, name, value)


if "ORACLE_START_NS" in os.environ:
    _freeze_time()
    _freeze_randomness()
    _freeze_host()
    if os.environ.get("ORACLE_ORDER"):
        _order_threads()
