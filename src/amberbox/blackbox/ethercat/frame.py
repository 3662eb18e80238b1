"""EtherCAT frames: their datagrams (IEC 61158-4-12), and how datagrams are recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from struct import Struct
from typing import NamedTuple

from amberbox.blackbox.columns.frame_layout import (
    FrameField,
    FrameLayout,
    Switch,
)
from amberbox.core.types import Schema

ETHERTYPE = 0x88A4
_COMMANDS_TYPE = 1

LRD, LWR, LRW = 10, 11, 12
LOGICAL = (LRD, LWR, LRW)
COMMANDS: Mapping[int, str] = dict(
    enumerate(
        (
            *("NOP", "APRD", "APWR", "APRW", "FPRD", "FPWR", "FPRW", "BRD", "BWR", "BRW"),
            *("LRD", "LWR", "LRW", "ARMW", "FRMW"),
        )
    )
)
BY_POSITION, BY_STATION, BROADCAST = (1, 2, 3, 13), (4, 5, 6, 14), (7, 8, 9)
READS = (1, 3, 4, 6, 7, 9, 13, 14)
AL_STATUS, AL_STATUS_CODE = 0x130, 0x134

_SHORT = Struct("<H")
_HEAD = Struct("<BBIHH")
_LENGTH = 0x7FF
_MORE = 1 << 15


class NotEtherCatError(Exception):
    """A frame of another protocol."""


class MalformedFrameError(Exception):
    """A frame whose datagrams do not fit into it."""


class Datagram(NamedTuple):
    """A datagram; ``number`` is its index field, ``length`` the length with its flags."""

    command: int
    number: int
    address: int
    length: int
    irq: int
    data: bytes
    working_counter: int

    @property
    def slave(self) -> int:
        """Return the address of the slave; of a logical address its lower half."""
        return self.address & 0xFFFF

    @property
    def register(self) -> int:
        """Return the address within the slave."""
        return self.address >> 16


def read_frame(data: bytes) -> Sequence[Datagram]:
    """Return the datagrams of an Ethernet frame, at least one.

    Raises NotEtherCatError and MalformedFrameError.
    """
    start, size = 14, len(data)
    if size < start:
        raise MalformedFrameError
    kind = data[12:14]
    if kind == b"\x81\x00":
        start, kind = 18, data[16:18]
    if kind != b"\x88\xa4":
        raise NotEtherCatError
    if size < start + 2:
        raise MalformedFrameError
    (header,) = _SHORT.unpack_from(data, start)
    if header >> 12 != _COMMANDS_TYPE:
        raise NotEtherCatError
    place = start + 2
    end = place + (header & _LENGTH)
    if end > size:
        raise MalformedFrameError
    found = []
    more = True
    while more:
        if place + 12 > end:
            raise MalformedFrameError
        command, index, address, length, irq = _HEAD.unpack_from(data, place)
        begin = place + 10
        place = begin + (length & _LENGTH)
        if place + 2 > end:
            raise MalformedFrameError
        (counter,) = _SHORT.unpack_from(data, place)
        found.append(Datagram(command, index, address, length, irq, data[begin:place], counter))
        place += 2
        more = bool(length & _MORE)
    return found


_RECORD = Struct("<BBBxIHHH")
_DATA_BIT = 8 * _RECORD.size
_PHYSICAL = Switch("command", tuple(n for n in COMMANDS if n and n not in LOGICAL))


def pack_datagram(datagram: Datagram, returned: bool) -> bytes:
    """Return a datagram as it is recorded."""
    head = _RECORD.pack(
        returned,
        datagram.command,
        datagram.number,
        datagram.address,
        datagram.length,
        datagram.irq,
        datagram.working_counter,
    )
    return head + datagram.data


def datagram_schema() -> Schema:
    """Return the columns of recorded datagrams."""
    return FrameLayout(
        (
            FrameField("returned", 0, 8, "bool"),
            FrameField("command", 8, 8, labels=COMMANDS),
            FrameField("datagram_index", 16, 8),
            FrameField("slave", 32, 16, when=_PHYSICAL),
            FrameField("register", 48, 16, when=_PHYSICAL),
            FrameField("logical_address", 32, 32, when=Switch("command", LOGICAL)),
            FrameField("length", 64, 11),
            FrameField("circulating", 78, 1, "bool"),
            FrameField("irq", 80, 16),
            FrameField("working_counter", 96, 16),
            FrameField("data", _DATA_BIT, 0, "bytes"),
        )
    ).to_schema("ethercat/Datagram")


_CYCLE = Struct("<BBHHxxIIIIIIff")


class BusRow(NamedTuple):
    """A row of the topic ``bus``; counts are of the time since the row before it.

    ``cycles`` is 1 in the row of a cycle; in a row without one, the fields up to ``address`` and
    the times (seconds) do not apply.
    """

    cycles: int = 0
    incomplete: bool = False
    working_counter: int = 0
    expected_counter: int = 0
    address: int = 0
    frames: int = 0
    lost: int = 0
    malformed: int = 0
    other: int = 0
    dropped: int = 0
    cycle_time: float = float("nan")
    round_trip: float = float("nan")

    def pack(self) -> bytes:
        """Return the row as it is recorded."""
        return _CYCLE.pack(*self)


def bus_schema() -> Schema:
    """Return the columns of the topic ``bus``."""
    cycle = Switch("cycles", (1,))
    counts = ("frames", "lost", "malformed", "other", "dropped")
    return FrameLayout(
        (
            FrameField("cycles", 0, 8),
            FrameField("incomplete", 8, 8, "bool", when=cycle),
            FrameField("working_counter", 16, 16, when=cycle),
            FrameField("expected_counter", 32, 16, when=cycle),
            FrameField("address", 64, 32, when=cycle),
            *(FrameField(name, 96 + 32 * n, 32) for n, name in enumerate(counts)),
            FrameField("cycle_time", 256, 32, "float", unit="s", when=cycle),
            FrameField("round_trip", 288, 32, "float", unit="s", when=cycle),
        )
    ).to_schema("ethercat/Bus")


_STATUS = Struct("<BBH")
_STATES = {1: "INIT", 2: "PREOP", 3: "BOOT", 4: "SAFEOP", 8: "OP"}
_ADDRESSED = {0: "all", 1: "position", 2: "station"}


def pack_al_status(addressed: int, slave: int, status: int, code: int | None) -> bytes:
    """Return a row of ``al_status``; ``addressed`` is 0 for all slaves, 1 by position (0 is the
    first), 2 by station address.
    """
    row = _STATUS.pack(addressed, status & 0x1F, slave)
    return row if code is None else row + _SHORT.pack(code)


def al_status_schema() -> Schema:
    """Return the columns of the topic ``al_status``."""
    return FrameLayout(
        (
            FrameField("addressed", 0, 8, labels=_ADDRESSED),
            FrameField("state", 8, 4, labels=_STATES),
            FrameField("error", 12, 1, "bool"),
            FrameField("slave", 16, 16, when=Switch("addressed", (1, 2))),
            FrameField("code", 32, 16),
        )
    ).to_schema("ethercat/AlStatus")
