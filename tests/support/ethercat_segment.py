"""A segment of EtherCAT without hardware: a veth pair, and what is on it, frame by frame."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ETHERTYPE = 0x88A4
_EVERY_PROTOCOL = 3
_SO_RCVBUFFORCE = 33
_ROOM_BYTES = 64 << 20


@dataclass(frozen=True)
class Datagram:
    """One datagram of a frame: its command, index, address, data and working counter."""

    command: int
    index: int
    address: int
    data: bytes
    counter: int


@contextmanager
def veth_pair() -> Iterator[tuple[str, str]]:
    """Join two interfaces of this computer by a cable; their names are those of this process."""
    near, far = f"se{os.getpid()}"[:15], f"re{os.getpid()}"[:15]
    subprocess.run(["ip", "link", "add", near, "type", "veth", "peer", "name", far], check=True)
    try:
        for name in (near, far):
            Path(f"/proc/sys/net/ipv6/conf/{name}/disable_ipv6").write_text("1")
            subprocess.run(["ip", "link", "set", name, "up"], check=True)
        yield near, far
    finally:
        subprocess.run(["ip", "link", "del", near], check=True)


@contextmanager
def listening(interface: str) -> Iterator[socket.socket]:
    """Open a socket that receives every frame of an interface."""
    found = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_EVERY_PROTOCOL))
    with found as receiver:
        give_room(receiver)
        receiver.bind((interface, _EVERY_PROTOCOL))
        yield receiver


def give_room(receiver: socket.socket) -> None:
    """Let a socket hold everything of a short test; only root may."""
    receiver.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _ROOM_BYTES)


def received(receiver: socket.socket) -> list[bytes]:
    """Return the frames that wait."""
    receiver.setblocking(False)
    found = []
    while True:
        try:
            found.append(receiver.recv(2048))
        except BlockingIOError:
            return found


def datagrams(frame: bytes) -> list[Datagram]:
    """Take a frame apart by the standard."""
    assert int.from_bytes(frame[12:14], "big") == ETHERTYPE
    length = int.from_bytes(frame[14:16], "little")
    assert length >> 12 == 1
    body, found = frame[16 : 16 + (length & 0x7FF)], []
    while body:
        command, index, address, size, _ = struct.unpack_from("<BBIHH", body)
        end = 10 + (size & 0x7FF)
        counter = int.from_bytes(body[end : end + 2], "little")
        found.append(Datagram(command, index, address, body[10:end], counter))
        assert bool(size & 0x8000) == (len(body) > end + 2)
        body = body[end + 2 :]
    return found


def write_pcap(path: Path, frames: list[bytes]) -> None:
    """Write frames as a capture file, a microsecond apart."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 1 << 16, 1))
        for number, frame in enumerate(frames):
            file.write(
                struct.pack("<IIII", number // 10**6, number % 10**6, len(frame), len(frame))
            )
            file.write(frame)
