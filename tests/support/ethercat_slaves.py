"""Simulated EtherCAT slaves on an interface: registers, SII, FMMUs, AL states, all commands.

``python -m tests.support.ethercat_slaves INTERFACE NUMBER`` prints ``ready``, then takes lines:
``lost N`` (the last N slaves are not there) and ``mute`` or ``speak`` (frames do not return).
What a slave sends counts the cycles in which it took part: ``truth`` prints these numbers.
"""

from __future__ import annotations

import select
import socket
import struct
import sys
from dataclasses import dataclass, field

OUTPUT_BYTES, INPUT_BYTES = 12, 8  # what a slave sends, what it receives
FROM_MASTER_AT, TO_MASTER_AT = 0x1000, 0x1100
_AL_CONTROL, _AL_STATUS = 0x120, 0x130
_SII_CONTROL, _SII_DATA = 0x502, 0x508
_FMMU, _FMMUS = 0x600, 4
_STATION = 0x10
_OP, _SAFEOP = 8, 4
_READS, _WRITES = (1, 3, 4, 6, 7, 9), (2, 3, 5, 6, 8, 9)


def _sii() -> bytes:
    """Return the EEPROM: header, FMMU use, sync managers, a PDO each way."""
    head = bytearray(128)
    struct.pack_into("<IIII", head, 16, 0x00000A3B, 0x00000001, 1, 1)
    pdo = b""
    for kind, entries, size in ((50, 3, OUTPUT_BYTES), (51, 2, INPUT_BYTES)):
        index = 0x1A00 if kind == 50 else 0x1600
        body = struct.pack("<HBBBBH", index, entries, 3 if kind == 50 else 2, 0, 0, 0)
        for number in range(entries):
            bits = 8 * size // entries
            body += struct.pack("<HBBBBH", 0x6000 + number, 1, 0, 4, bits, 0)
        pdo += struct.pack("<HH", kind, len(body) // 2) + body
    fmmu = struct.pack("<HH", 40, 1) + bytes((1, 2))
    managers = b"".join(
        struct.pack("<HHBBBB", at, size, control, 0, 1, use)
        for at, size, control, use in (
            (0x1400, 0, 0x26, 0), (0x1500, 0, 0x22, 0),
            (FROM_MASTER_AT, INPUT_BYTES, 0x64, 3), (TO_MASTER_AT, OUTPUT_BYTES, 0x20, 4),
        )
    )  # fmt: skip
    sync = struct.pack("<HH", 41, len(managers) // 2) + managers
    return bytes(head) + fmmu + sync + pdo + b"\xff\xff" * 4


@dataclass
class Slave:
    """A slave: its memory, and in how many cycles it took part."""

    sii: bytes = field(default_factory=_sii)
    cycles: int = 0

    def __post_init__(self) -> None:
        self.memory = bytearray(0x2000)
        self.memory[0:10] = bytes((0x11, 0, 0, 0, 8, 8, 8, 0x0F, 0x0C, 0))
        self.memory[0x110:0x112] = struct.pack("<H", 0x0030)
        self.memory[_AL_STATUS] = 1

    @property
    def state(self) -> int:
        return self.memory[_AL_STATUS] & 15

    def process(self, datagram: bytearray) -> None:
        """Take part in a datagram, as a slave controller does while it passes."""
        command, _, slave, register, length = struct.unpack_from("<BBHHH", datagram)
        length &= 0x7FF
        if command in (10, 11, 12):
            self._logical(command, slave | register << 16, length, datagram)
            return
        mine = command in (7, 8, 9)
        if command in (1, 2, 3, 13):
            mine = slave == 0
            struct.pack_into("<H", datagram, 2, slave + 1 & 0xFFFF)
        elif command in (4, 5, 6, 14):
            mine = slave == struct.unpack_from("<H", self.memory, _STATION)[0]
        elif command in (7, 8, 9):
            struct.pack_into("<H", datagram, 2, slave + 1 & 0xFFFF)
        if command in (13, 14):
            command = command - 12 if mine else command - 11
            mine = True
            command = {1: 1, 2: 2, 3: 5}.get(command, command)
        if mine and register + length <= len(self.memory):
            self._physical(command, register, length, datagram)

    def _physical(self, command: int, register: int, length: int, datagram: bytearray) -> None:
        sent = bytes(datagram[10 : 10 + length])
        counter = 0
        if command in _READS:
            held = self.memory[register : register + length]
            if command in (7, 9):
                held = bytearray(a | b for a, b in zip(held, sent, strict=True))
            datagram[10 : 10 + length] = held
            counter += 1
        if command in _WRITES:
            self._write(register, sent)
            counter += 2 if command in _READS else 1
        _add(datagram, length, counter)

    def _write(self, register: int, data: bytes) -> None:
        if register <= _AL_STATUS < register + len(data):
            return
        self.memory[register : register + len(data)] = data
        if register == _AL_CONTROL:
            self.memory[_AL_STATUS] = data[0] & 15
        if register <= _SII_CONTROL < register + len(data) and len(data) >= 6:
            (word,) = struct.unpack_from("<I", self.memory, _SII_CONTROL + 2)
            part = self.sii[2 * word : 2 * word + 8].ljust(8, b"\xff")
            self.memory[_SII_DATA : _SII_DATA + 8] = part
            self.memory[_SII_CONTROL : _SII_CONTROL + 2] = b"\x40\x00"

    def _logical(self, command: int, address: int, length: int, datagram: bytearray) -> None:
        counter = 0
        for number in range(_FMMUS):
            unit = struct.unpack_from("<IHBBHBBB", self.memory, _FMMU + 16 * number)
            start, size, _, _, physical, _, kind, active = unit
            place = start - address
            if not active or place < 0 or place + size > length:
                continue
            part = slice(10 + place, 10 + place + size)
            if kind & 1 and command in (10, 12) and self.state in (_SAFEOP, _OP):
                datagram[part] = self.memory[physical : physical + size]
                counter += 1
            elif kind & 2 and command in (11, 12) and self.state == _OP:
                self.memory[physical : physical + size] = datagram[part]
                counter += 2 if command == 12 else 1
        if counter:
            self.cycles += 1
            sent = self.memory[FROM_MASTER_AT : FROM_MASTER_AT + 4]
            struct.pack_into("<If", self.memory, TO_MASTER_AT, self.cycles, self.cycles / 4)
            self.memory[TO_MASTER_AT + 8 : TO_MASTER_AT + 12] = sent
        _add(datagram, length, counter)


def _add(datagram: bytearray, length: int, counter: int) -> None:
    (now,) = struct.unpack_from("<H", datagram, 10 + length)
    struct.pack_into("<H", datagram, 10 + length, now + counter & 0xFFFF)


def returned(frame: bytes, slaves: list[Slave]) -> bytes:
    """Return a frame after it has passed the slaves."""
    made = bytearray(frame)
    made[6] |= 2
    place, more = 16, True
    while more:
        (length,) = struct.unpack_from("<H", made, place + 6)
        more = bool(length & 0x8000)
        end = place + 12 + (length & 0x7FF)
        datagram = made[place:end]
        for slave in slaves:
            slave.process(datagram)
        made[place:end] = datagram
        place = end
    return bytes(made)


def main(interface: str, number: int) -> None:
    """Answer frames until the input ends."""
    line = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x88A4))
    line.bind((interface, 0x88A4))
    slaves = [Slave() for _ in range(number)]
    there, speaks = number, True
    print("ready", flush=True)
    while True:
        ready, _, _ = select.select([line, sys.stdin], [], [])
        if sys.stdin in ready:
            words = sys.stdin.readline().split()
            if not words:
                return
            if words[0] == "lost":
                there = number - int(words[1])
            speaks = {"mute": False, "speak": True}.get(words[0], speaks)
            print("done", flush=True)
        if line in ready:
            frame, address = line.recvfrom(2000)
            if address[2] != socket.PACKET_OUTGOING and speaks:
                line.send(returned(frame, slaves[:there]))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
