"""A packet socket with a ring shared with the kernel (TPACKET_V3); it only receives."""

from __future__ import annotations

import ctypes
import errno
import mmap
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from struct import Struct
from typing import NamedTuple

_SOL_PACKET = 263
_ADD_MEMBERSHIP, _RX_RING, _STATISTICS, _VERSION = 1, 5, 6, 10
_PROMISCUOUS, _TPACKET_V3 = 1, 2
_SO_ATTACH_FILTER = 26
_ETH_P_ALL = 3
_LOOPBACK = 772  # ARPHRD_LOOPBACK
_SIOCGIFFLAGS, _IFF_UP = 0x8913, 1

BLOCKS = 256
RETIRE_MS = 50
"""A block is handed over when it is full, or after one to two times this long."""

_RING = Struct("7I")
_BLOCK = Struct("II")  # status, number of frames, and below: offset of the first
_FIRST = Struct("I")
_FRAME = Struct("IIIIIIH")  # next, s, ns, length here, length, status, offset of the data
_ADDRESS_AT = 48
_ADDRESS = Struct("=HHiHB")  # of sockaddr_ll, up to the type of the packet
_USER, _KERNEL = 1, 0
_COUNTS = Struct("III")

# EtherCAT, also with a VLAN tag: ldh [12]; jeq 0x88a4; jeq 0x8100; ldh [16]; jeq 0x88a4
_FILTER = ((0x28, 0, 0, 12), (0x15, 3, 0, 0x88A4), (0x15, 0, 3, 0x8100), (0x28, 0, 0, 16),
           (0x15, 0, 1, 0x88A4), (0x06, 0, 0, 0x40000), (0x06, 0, 0, 0))  # fmt: skip


class RingFrame(NamedTuple):
    """A frame, its time of receipt by CLOCK_REALTIME, and whether this computer sent it.

    ``sent`` is None on the loopback interface, where every frame is sent and received.
    """

    stamp_ns: int
    data: bytes
    is_whole: bool
    sent: bool | None


class FrameRing:
    """Receives the EtherCAT frames of an interface; raises OSError if that cannot be opened."""

    def __init__(self, interface: str, size: int) -> None:
        page = mmap.PAGESIZE
        self._block = max(1, size // BLOCKS // page) * page
        self._place = 0
        self.is_loopback = False
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)  # not bound: no frames
        try:
            self._open(interface)
        except BaseException:
            self._socket.close()
            raise

    def _open(self, interface: str) -> None:
        index = socket.if_nametoindex(interface)
        _require_up(interface, self._socket)
        _set_filter(self._socket)
        self._socket.setsockopt(_SOL_PACKET, _VERSION, _TPACKET_V3)
        frame = 2048
        request = _RING.pack(
            self._block, BLOCKS, frame, self._block // frame * BLOCKS, RETIRE_MS, 0, 0
        )
        self._socket.setsockopt(_SOL_PACKET, _RX_RING, request)
        self._map = mmap.mmap(self._socket.fileno(), self._block * BLOCKS)
        try:
            self._socket.bind((interface, _ETH_P_ALL))
            wanted = struct.pack("iHH8s", index, _PROMISCUOUS, 0, b"")
            self._socket.setsockopt(_SOL_PACKET, _ADD_MEMBERSHIP, wanted)
            self.is_loopback = self._socket.getsockname()[3] == _LOOPBACK
        except BaseException:
            self._map.close()
            raise

    def fileno(self) -> int:
        """Return the file that is readable when a block is ready."""
        return self._socket.fileno()

    def block(self) -> list[RingFrame] | None:
        """Return the frames of the next block; None if none is ready."""
        view, begin = self._map, self._place * self._block
        status, count = _BLOCK.unpack_from(view, begin + 8)
        if not status & _USER:
            return None
        (first,) = _FIRST.unpack_from(view, begin + 16)
        found = []
        place = begin + first
        for _ in range(count):
            step, s, ns, length, whole, _, data_at = _FRAME.unpack_from(view, place)
            address = _ADDRESS.unpack_from(view, place + _ADDRESS_AT)
            sent = address[4] == socket.PACKET_OUTGOING
            if not (sent and self.is_loopback):
                data = view[place + data_at : place + data_at + length]
                found.append(
                    RingFrame(
                        s * 1_000_000_000 + ns, data, length == whole,
                        None if self.is_loopback else sent,
                    )
                )  # fmt: skip
            place += step
        _FIRST.pack_into(view, begin + 8, _KERNEL)
        self._place = (self._place + 1) % BLOCKS
        return found

    def blocks(self) -> Iterator[list[RingFrame]]:
        """Yield the blocks that are ready, at most once round the ring."""
        for _ in range(BLOCKS):
            block = self.block()
            if block is None:
                return
            yield block

    def dropped(self) -> int:
        """Return how many frames have found no room since the last call."""
        data = self._socket.getsockopt(_SOL_PACKET, _STATISTICS, _COUNTS.size)
        return int(_COUNTS.unpack(data)[1])

    def failure(self) -> OSError | None:
        """Return why no more frames arrive, such as an interface that is down."""
        number = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        return OSError(number, errno.errorcode.get(number, "")) if number else None

    def close(self) -> None:
        """Close the socket."""
        with suppress(BufferError):
            self._map.close()
        self._socket.close()


def _require_up(interface: str, any_socket: socket.socket) -> None:
    """Raise OSError for an interface that is down: a socket bound to it receives nothing."""
    import fcntl

    request = struct.pack("16sH14x", interface.encode()[:15], 0)
    answer = fcntl.ioctl(any_socket, _SIOCGIFFLAGS, request)
    if not struct.unpack_from("H", answer, 16)[0] & _IFF_UP:
        raise OSError(errno.ENETDOWN, "the interface is down")


def _set_filter(wanted: socket.socket) -> None:
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *one) for one in _FILTER))
    program = struct.pack("HL", len(_FILTER), ctypes.addressof(code))
    wanted.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
