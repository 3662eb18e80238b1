"""A disk in memory for what promises durability: kills, power cuts, and failures at every call.

It offers the few system calls that ``CommandLogFile`` makes. What was written survives a kill;
a power cut leaves what was synced, and any part of what was not.
"""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass, field
from random import Random


class KilledError(BaseException):
    """Stands for ``kill -9`` or a power cut during a system call."""


@dataclass(eq=False)
class Inode:
    """A file: its content, what of it is on the disk, and what a failed sync has lost."""

    content: bytearray = field(default_factory=bytearray)
    durable: bytes = b""
    lost: tuple[int, int] = (0, 0)


@dataclass
class SimulatedDisk:
    """One folder of files.

    ``die_in`` counts system calls down, and the process dies in the last one. ``failures`` are
    error numbers by call, which fails with them as long as they stand there.
    """

    random: Random
    names: dict[str, Inode] = field(default_factory=dict)
    durable_names: dict[str, Inode] = field(default_factory=dict)
    renames: list[dict[str, Inode]] = field(default_factory=list)
    opened: dict[int, Inode | None] = field(default_factory=dict)
    offsets: dict[int, int] = field(default_factory=dict)
    die_in: int = 0
    calls: int = 0
    failures: dict[str, int] = field(default_factory=dict)

    def open(self, path: str, flags: int, mode: int = 0o777, /) -> int:
        self._call("open")
        fd = max(self.opened, default=2) + 1
        if flags & os.O_DIRECTORY:
            self.opened[fd] = None
            return fd
        if path not in self.names:
            assert flags & os.O_CREAT, f"{path} is not there"
            self._rename({**self.names, path: Inode()})
        if flags & os.O_TRUNC:
            self.names[path].content.clear()
            self.names[path].lost = (0, 0)
        self.opened[fd], self.offsets[fd] = self.names[path], 0
        return fd

    def read(self, fd: int, size: int, /) -> bytes:
        at = self.offsets[fd]
        found = bytes(self._inode(fd).content[at : at + size])
        self.offsets[fd] += len(found)
        return found

    def write(self, fd: int, data: bytes, /) -> int:
        inode = self._inode(fd)
        part = data[: self.random.randint(0, len(data))]
        if self._dies():
            inode.content += part
            raise KilledError
        if "write" in self.failures:
            inode.content += part
            raise OSError(self.failures["write"], os.strerror(self.failures["write"]))
        if len(data) > 1 and self.random.random() < 0.1:  # the system may take a part
            inode.content += data[: len(data) // 2]
            return len(data) // 2
        inode.content += data
        return len(data)

    def fsync(self, fd: int, /) -> None:
        inode = self.opened[fd]
        if "fsync" in self.failures and inode is not None:
            # the system takes these pages as written from now on
            inode.lost = (len(inode.durable), len(inode.content))
        self._call("fsync")
        if inode is None:
            self.durable_names, self.renames = dict(self.names), []
        else:
            start, end = inode.lost
            start, end = min(start, len(inode.content)), min(end, len(inode.content))
            inode.durable = bytes(inode.content)
            if start < end:
                inode.durable = inode.durable[:start] + bytes(end - start) + inode.durable[end:]
        self._die_after()

    def ftruncate(self, fd: int, size: int, /) -> None:
        self._call("ftruncate")
        inode = self._inode(fd)
        del inode.content[size:]
        inode.lost = (min(inode.lost[0], size), min(inode.lost[1], size))

    def close(self, fd: int, /) -> None:
        del self.opened[fd]

    def replace(self, source: str, target: str, /) -> None:
        self._call("replace")
        names = {**self.names, target: self.names[source]}
        del names[source]
        self._rename(names)
        self._die_after()

    def _rename(self, names: dict[str, Inode]) -> None:
        self.names = names
        self.renames.append(dict(names))

    def _inode(self, fd: int) -> Inode:
        inode = self.opened[fd]
        assert inode is not None
        return inode

    def _dies(self) -> bool:
        self.calls += 1
        if self.die_in:
            self.die_in -= 1
            return self.die_in == 0
        return False

    def _call(self, name: str) -> None:
        if self._dies():
            raise KilledError
        if name in self.failures:
            raise OSError(self.failures[name], os.strerror(self.failures[name]))

    def _die_after(self) -> None:
        """Die with the effect done, and the answer of the call lost."""
        if self._dies():
            raise KilledError

    def fill(self) -> None:
        """Have no room left."""
        self.failures = {"write": errno.ENOSPC}

    def damage(self) -> None:
        """Fail to sync."""
        self.failures = {"fsync": errno.EIO}

    def kill(self) -> None:
        """End the process: what it wrote stays."""
        self.opened.clear()
        self.offsets.clear()
        self.die_in = 0

    def cut_power(self) -> None:
        """Leave what was synced, and a part of what was not."""
        self.kill()
        kept = self.random.randint(0, len(self.renames))
        self.names = dict([self.durable_names, *self.renames][kept])
        self.durable_names, self.renames = dict(self.names), []
        for inode in set(self.names.values()):
            inode.content = bytearray(self._survives(inode))
            inode.durable, inode.lost = bytes(inode.content), (0, 0)

    def _survives(self, inode: Inode) -> bytes:
        durable, content = inode.durable, bytes(inode.content)
        if not content.startswith(durable):
            return self.random.choice([durable, content])
        tail = content[len(durable) :]
        kept = tail[: self.random.randint(0, len(tail))] if self.random.random() < 0.7 else b""
        zeros = self.random.randint(0, len(kept)) if self.random.random() < 0.3 else 0
        return durable + kept[: len(kept) - zeros] + bytes(zeros)
