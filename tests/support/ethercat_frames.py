"""EtherCAT frames and captures of them, made by hand."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

MASTER = bytes.fromhex("101010101010")


class Part(NamedTuple):
    """A datagram to put into a frame."""

    command: int
    address: int
    data: bytes
    counter: int = 0
    number: int = 1


def frame(*parts: Part, returned: bool = False, marks: bool = True, pad: int = 60) -> bytes:
    """Return an Ethernet frame; ``marks``: slaves mark a returned one in its source address."""
    body = b""
    for number, part in enumerate(parts):
        length = len(part.data) | (0x8000 if number + 1 < len(parts) else 0)
        body += struct.pack("<BBIHH", part.command, part.number, part.address, length, 0)
        body += part.data + struct.pack("<H", part.counter)
    source = bytes([MASTER[0] | 2 * (returned and marks)]) + MASTER[1:]
    head = b"\xff" * 6 + source + b"\x88\xa4" + struct.pack("<H", len(body) | 0x1000)
    return (head + body).ljust(pad, b"\0")


def cycle(sent: bytes, received: bytes, counter: int, index: int = 1) -> tuple[bytes, bytes]:
    """Return the frames out and back of an LRW with what the master and the slaves send."""
    out = Part(12, 0, sent + bytes(len(received)), 0, index)
    back = Part(12, 0, sent + received, counter, index)
    return frame(out), frame(back, returned=True)


Stamped = Sequence[tuple[int, bytes]]


def pcap(path: Path, frames: Stamped, order: str = "<", nanoseconds: bool = False) -> Path:
    """Write a pcap file."""
    magic, unit = (0xA1B23C4D, 1) if nanoseconds else (0xA1B2C3D4, 1000)
    data = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)
    for time_ns, one in frames:
        seconds, rest = divmod(time_ns, 10**9)
        data += struct.pack(order + "IIII", seconds, rest // unit, len(one), len(one)) + one
    path.write_bytes(data)
    return path


def _block(order: str, kind: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    length = struct.pack(order + "I", len(body) + 12)
    return struct.pack(order + "I", kind) + length + body + length


def pcapng(path: Path, frames: Stamped, order: str = "<", flags: Sequence[int] = ()) -> Path:
    """Write a pcapng file with times in ns; ``flags`` are those of each frame."""
    data = _block(order, 0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    options = struct.pack(order + "HH", 2, 4) + b"eth1" + struct.pack(order + "HHB3x", 9, 1, 9)
    data += _block(order, 1, struct.pack(order + "HHI", 1, 0, 0) + options)
    for number, (time_ns, one) in enumerate(frames):
        head = struct.pack(order + "IIIII", 0, time_ns >> 32, time_ns & 0xFFFFFFFF, len(one),
                           len(one))  # fmt: skip
        body = head + one + bytes(-len(one) % 4)
        if flags:
            body += struct.pack(order + "HHII", 2, 4, flags[number], 0)
        data += _block(order, 6, body)
    path.write_bytes(data)
    return path
