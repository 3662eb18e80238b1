"""The socket of the command process: messages on it, and the ends that other processes use.

A Unix socket in the store, for processes of the same user and of root. The link process passes the
frames of the server through it and gets those for the server; ``amberbox confirm`` asks what waits
for a confirmation, and gives it; ``amberbox action run`` orders an action. A message is its length,
4 bytes big-endian, and MessagePack.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import msgspec
from msgspec import Struct

from amberbox.core.command import CommandAnswer, CommandId, LeaseState, new_command_id
from amberbox.core.errors import AmberboxError
from amberbox.core.files import wait_readable
from amberbox.link import limits
from amberbox.link.command_port import (
    ActionAnnouncement,
    GateAnswers,
    GateReport,
    MintedChallenge,
)
from amberbox.link.frames import (
    AbortFrame,
    AnsweredFrame,
    CommandsFrame,
    ConfirmFrame,
    LeaseFrame,
    RevokedFrame,
)

SOCKET = "commands.sock"
_MOST_BYTES = 4 << 20
_READ = 1 << 16
# Read from one process before the others have their turn
_MOST_READ = 1 << 20
# Reports that wait for the server; with more of them the command process is connected anew
_MOST_REPORTS = 2000
_AGAIN_S = 0.5
_SEND_S = 2.0
_CREDENTIALS = struct.Struct("3i")


class LinkBegins(Struct, frozen=True, tag="begin"):
    """The link process has a connection to a server."""

    server_id: str


class LinkEnds(Struct, frozen=True, tag="end"):
    """The connection has ended."""


class SiteConfirms(Struct, frozen=True, tag="confirm"):
    """Somebody at the robot confirms the motion that waits, or enters its code."""

    code: str = ""
    on_site: bool = False


class SiteAborts(Struct, frozen=True, tag="site_abort"):
    """Somebody at the robot stops a command, a run, or everything (empty)."""

    target: str = ""
    who: str = ""


class SiteAsks(Struct, frozen=True, tag="ask"):
    """Somebody at the robot asks for ``SiteState``."""


class SiteOrders(Struct, frozen=True, tag="order"):
    """Somebody at the robot orders an action; ``parameters`` is the JSON text of an object.

    The connection has to renew it, once a second, and gets its reports and its outcome.
    ``confirmed``: whoever ordered a motion sees that its way is free.
    """

    id: CommandId
    action: str
    parameters: str = "{}"
    who: str = ""
    confirmed: bool = False


class SiteRenews(Struct, frozen=True, tag="renew"):
    """Somebody at the robot still wants what they have ordered."""

    id: CommandId


class Challenge(Struct, frozen=True, tag="challenge"):
    """A challenge for signatures, who holds the robot, and which motion waits."""

    challenge: bytes
    lease: LeaseState
    waiting: str = ""
    by_code: bool = False
    tries: int = 0


class Announcement(Struct, frozen=True, tag="actions"):
    """What the robot can do, as JSON."""

    actions: bytes


class Answers(Struct, frozen=True, tag="answers"):
    """Answers to commands, in the order of their numbers."""

    answers: list[CommandAnswer]


class WaitingMotion(Struct, frozen=True):
    """A motion that waits for its confirmation; ``code`` is empty where a button gives it."""

    id: str
    action: str
    parameters: str
    person: str
    code: str
    left_s: float


class RunningAction(Struct, frozen=True):
    """An action that is being carried out; ``report`` is the last that it has reported."""

    id: str
    action: str
    person: str
    for_s: float
    report: str = ""


class OrderReport(Struct, frozen=True, tag="report"):
    """What an ordered action reports."""

    id: str
    text: str


class OrderOutcome(Struct, frozen=True, tag="outcome"):
    """How an order has ended, or why it was refused; ``result`` is JSON text of an object."""

    id: str
    state: str
    reason: str = ""
    hint: str = ""
    result: str = ""
    printed: str = ""


class SiteState(Struct, frozen=True, tag="state"):
    """What concerns commands at the robot now."""

    lease: LeaseState
    waiting: WaitingMotion | None
    running: list[RunningAction]
    linked: bool


ToGate: TypeAlias = (
    LinkBegins | LinkEnds | CommandsFrame | AnsweredFrame | RevokedFrame | LeaseFrame | AbortFrame
    | ConfirmFrame | SiteConfirms | SiteAborts | SiteAsks | SiteOrders | SiteRenews
)  # fmt: skip
FromGate: TypeAlias = (
    Challenge | Announcement | Answers | SiteState | OrderReport | OrderOutcome
)  # fmt: skip

_ENCODER = msgspec.msgpack.Encoder()
_TO_GATE: msgspec.msgpack.Decoder[ToGate] = msgspec.msgpack.Decoder(ToGate)
_FROM_GATE: msgspec.msgpack.Decoder[FromGate] = msgspec.msgpack.Decoder(FromGate)


def packed(message: ToGate | FromGate) -> bytes:
    """Encode a message with its length."""
    data = _ENCODER.encode(message)
    return len(data).to_bytes(4, "big") + data


class MessageBuffer:
    """Cuts received bytes into messages. Raises ValueError for what no end of ours sends."""

    def __init__(self) -> None:
        self._data = bytearray()

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Add received bytes; yield the messages that are complete."""
        self._data += data
        while len(self._data) >= 4:
            size = int.from_bytes(self._data[:4], "big")
            if size > _MOST_BYTES:
                raise ValueError(f"a message of {size} bytes")
            if len(self._data) < 4 + size:
                return
            message = bytes(self._data[4 : 4 + size])
            del self._data[: 4 + size]
            yield message


@contextlib.contextmanager
def _address(store: Path) -> Iterator[str]:
    """Yield a short path of the socket: that of a store may be longer than an address can be."""
    folder = os.open(store, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{SOCKET}"
    finally:
        os.close(folder)


class SocketServer:
    """The listening end, in the command process; nothing here waits."""

    def __init__(self, store: Path) -> None:
        self._path = store / SOCKET
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._listener.setblocking(False)
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()  # of a process that was killed: the lock says that it is gone
        before = os.umask(0o177)
        try:
            with _address(store) as address:
                self._listener.bind(address)
        finally:
            os.umask(before)
        self._listener.listen(8)
        self.clients: list[SocketClient] = []

    def filenos(self) -> list[int]:
        """Return the file descriptors to wait for."""
        there = (client for client in self.clients if not client.is_closed)
        return [self._listener.fileno(), *(client.fileno() for client in there)]

    def received(self) -> list[tuple[SocketClient, ToGate]]:
        """Accept who came; return all messages that can be read now, with their senders."""
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                accepted = self._listener.accept()[0]
                if _is_ours(accepted):
                    self.clients.append(SocketClient(accepted))
                else:
                    accepted.close()
        found = [(client, message) for client in self.clients for message in client.received()]
        self.clients = [client for client in self.clients if not client.is_closed]
        return found

    def close(self) -> None:
        """Close everything and remove the socket."""
        for client in self.clients:
            client.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)


def _is_ours(accepted: socket.socket) -> bool:
    """Return whether the other process is of this user or root."""
    size = _CREDENTIALS.size
    credentials = accepted.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    return _CREDENTIALS.unpack(credentials)[1] in (0, os.geteuid())


class SocketClient:
    """One process that is connected to the command process."""

    def __init__(self, accepted: socket.socket) -> None:
        self._socket = accepted
        self._socket.setblocking(False)
        self._buffer = MessageBuffer()
        self._waiting = bytearray()
        self.is_closed = False

    def fileno(self) -> int:
        """Return the file descriptor to wait for."""
        return self._socket.fileno()

    def received(self) -> list[ToGate]:
        """Return messages that can be read now, a megabyte of them; close it at its end or for bad
        data.
        """
        found: list[ToGate] = []
        size = 0
        try:
            while not self.is_closed and size < _MOST_READ:
                data = self._socket.recv(_READ)
                size += len(data)
                if not data:
                    self.close()
                found += map(_TO_GATE.decode, self._buffer.feed(data))
        except BlockingIOError:
            pass
        except (OSError, ValueError, msgspec.MsgspecError):
            self.close()
        self._flush()
        return found

    def send(self, message: FromGate) -> None:
        """Send a message; one that does not read is closed instead of waited for."""
        self._waiting += packed(message)
        self._flush()
        if len(self._waiting) > _MOST_BYTES:
            self.close()

    def _flush(self) -> None:
        try:
            while self._waiting and not self.is_closed:
                del self._waiting[: self._socket.send(self._waiting)]
        except BlockingIOError:
            return
        except OSError:
            self.close()

    def close(self) -> None:
        """Close the connection."""
        self.is_closed = True
        self._socket.close()


def orders_at(folder: Path) -> Path | None:
    """Return the store of a robot folder whose command process takes orders; None without one."""
    # other ends of the socket begin without them
    from amberbox.blackbox.robot_folder.folder import store_of
    from amberbox.blackbox.store.store import is_locked, is_store, open_store

    store = store_of(folder)
    is_taken = store is not None and is_store(store) and is_locked(open_store(store), "act")
    return store if is_taken else None


class SiteConnection:
    """The end of a person at the robot; raises AmberboxError where no command process answers."""

    def __init__(self, store: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._socket.settimeout(_SEND_S)
        self._buffer = MessageBuffer()
        try:
            with _address(store) as address:
                self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise AmberboxError(
                f"no process takes commands for {store}: {error.strerror}",
                "amberbox run FOLDER starts it, for the same user",
            ) from error

    def ask(self, message: SiteConfirms | SiteAborts | SiteAsks) -> SiteState:
        """Send a message; return what holds after it."""
        self.send(message)
        end_s = time.monotonic() + _SEND_S
        while time.monotonic() < end_s:
            for found in self.received(_SEND_S):
                if isinstance(found, SiteState):
                    return found
        raise AmberboxError("the command process does not answer", "amberbox doctor FOLDER")

    def fileno(self) -> int:
        """Return the file descriptor to wait for."""
        return self._socket.fileno()

    def send(self, message: ToGate) -> None:
        """Send a message."""
        try:
            self._socket.sendall(packed(message))
        except OSError as error:
            raise AmberboxError(f"the command process does not answer: {error}") from error

    def received(self, wait_s: float) -> list[FromGate]:
        """Return what has come, after waiting for it at most so long."""
        try:
            if not wait_readable([self._socket], wait_s):
                return []
            data = self._socket.recv(_READ)
            if not data:
                raise AmberboxError("the command process has ended", "amberbox doctor FOLDER")
            return [_FROM_GATE.decode(encoded) for encoded in self._buffer.feed(data)]
        except (OSError, ValueError, msgspec.MsgspecError) as error:
            raise AmberboxError(f"the command process does not answer: {error}") from error

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class SiteOrder:
    """An action that the command process carries out for somebody at the robot.

    Call ``renew`` at least once a second, and ``wait`` until it returns the outcome. Raises
    AmberboxError where no command process answers, or it ends.
    """

    def __init__(
        self, store: Path, action: str, parameters: str, *, who: str = "", confirmed: bool = False,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:  # fmt: skip
        self._connection, self._who, self._report = SiteConnection(store), who, report
        self.id = new_command_id()
        self._connection.send(SiteOrders(self.id, action, parameters, who, confirmed))

    def filenos(self) -> Sequence[int]:
        """Return the file descriptors to wait for."""
        return (self._connection.fileno(),)

    def renew(self) -> None:
        """State that it is still wanted."""
        self._connection.send(SiteRenews(self.id))

    def abort(self, reason: str) -> None:
        """Have it stopped; its outcome comes all the same."""
        self._connection.send(SiteAborts(self.id, f"{self._who}: {reason}"))

    def wait(self, seconds: float) -> OrderOutcome | None:
        """Wait until there is something new, or so long; return the outcome, if any."""
        for found in self._connection.received(seconds):
            if isinstance(found, OrderReport) and found.id == self.id:
                self._report(found.text)
            elif isinstance(found, OrderOutcome) and found.id == self.id:
                return found
        return None

    def close(self) -> None:
        """Close the connection; what still runs for it is stopped."""
        self._connection.close()


class SocketPort:
    """The link's port to the command process (``link.command_port.CommandPort``).

    While that process is away, what the server sends is dropped: it sends commands again. Revoked
    keys, which it sends once, are passed on again.
    """

    capabilities: Sequence[str] = (limits.COMMANDS,)

    def __init__(self, store: Path) -> None:
        self._store = store
        self._server_id: str | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None
        self._reports: asyncio.Queue[GateReport] = asyncio.Queue(_MOST_REPORTS)
        self._revoked: dict[str, None] = {}

    def begin(self, server_id: str) -> None:
        """Begin a connection to a server."""
        self._server_id, self._reports = server_id, asyncio.Queue(_MOST_REPORTS)
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._serve())
        self._send(LinkBegins(server_id))

    def end(self) -> None:
        """End the connection to the server."""
        self._server_id = None
        self._send(LinkEnds())

    async def report(self) -> GateReport:
        """Wait for what to send next."""
        return await self._reports.get()

    def commands(self, commands: Sequence[bytes]) -> None:
        """Pass commands on."""
        self._send(CommandsFrame(list(commands)))

    def answered(self, number: int) -> None:
        """Pass on how far answers are stored."""
        self._send(AnsweredFrame(number))

    def revoked(self, keys: Sequence[str]) -> None:
        """Pass revoked keys on."""
        self._revoked.update(dict.fromkeys(keys))
        self._send(RevokedFrame(list(keys)))

    def lease(self, frame: LeaseFrame) -> None:
        """Pass a request for the lease on."""
        self._send(frame)

    def abort(self, frame: AbortFrame) -> None:
        """Pass an abort on."""
        self._send(frame)

    def confirm(self, frame: ConfirmFrame) -> None:
        """Pass a code on."""
        self._send(frame)

    def _send(self, message: ToGate) -> None:
        if self._writer is not None and not self._writer.is_closing():
            if self._writer.transport.get_write_buffer_size() > _MOST_BYTES:
                self._writer.transport.abort()  # it does not read: it begins anew
            else:
                self._writer.write(packed(message))

    async def _serve(self) -> None:
        """Keep a connection to the command process."""
        while True:
            try:
                with _address(self._store) as address:
                    reader, self._writer = await asyncio.open_unix_connection(address)
                self._send(RevokedFrame(list(self._revoked)))
                if self._server_id is not None:
                    self._send(LinkBegins(self._server_id))
                await self._read(reader)
            except (OSError, ValueError, msgspec.MsgspecError, asyncio.QueueFull):
                pass
            finally:
                if self._writer is not None:
                    self._writer.close()
                self._writer = None
            await asyncio.sleep(_AGAIN_S)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        buffer = MessageBuffer()
        while data := await reader.read(_READ):
            for encoded in buffer.feed(data):
                message = _FROM_GATE.decode(encoded)
                if isinstance(message, Challenge):
                    minted = MintedChallenge(*msgspec.structs.astuple(message))
                    self._reports.put_nowait(minted)
                elif isinstance(message, Announcement):
                    self._reports.put_nowait(ActionAnnouncement(message.actions))
                elif isinstance(message, Answers):
                    self._reports.put_nowait(GateAnswers(message.answers))

    def close(self) -> None:
        """Stop for good."""
        if self._task is not None:
            self._task.cancel()
