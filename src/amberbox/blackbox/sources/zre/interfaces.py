"""The network interfaces of this computer that have broadcasts, as the kernel lists them."""

from __future__ import annotations

import fcntl
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Interface

_FLAGS, _ADDRESS, _NETMASK = 0x8913, 0x8915, 0x891B
_UP, _BROADCAST = 1, 2
_REQUEST = struct.Struct("16s24s")
_LONGEST_PREFIX = 30  # a network of one or two computers has no broadcast


@dataclass(frozen=True, slots=True)
class NetworkInterface:
    """An interface with its first IPv4 address, and the address of its broadcasts."""

    name: str
    index: int
    address: str
    broadcast: str


def find_interfaces(wanted: str = "") -> list[NetworkInterface]:
    """Return the interfaces that are up; only the one with this name or address, if given."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        found = list(_found(asked))
    return [one for one in found if wanted in ("", one.name, one.address)]


def _found(asked: socket.socket) -> Iterator[NetworkInterface]:
    for index, name in socket.if_nameindex():
        with suppress(OSError):  # it has no address, or is gone by now
            (flags,) = struct.unpack_from("H", _asked(asked, name, _FLAGS))
            if not (flags & _UP and flags & _BROADCAST):
                continue
            address = socket.inet_ntoa(_asked(asked, name, _ADDRESS)[4:8])
            mask = socket.inet_ntoa(_asked(asked, name, _NETMASK)[4:8])
            network = IPv4Interface(f"{address}/{mask}").network
            if network.prefixlen <= _LONGEST_PREFIX:
                yield NetworkInterface(name, index, address, str(network.broadcast_address))


def _asked(asked: socket.socket, name: str, what: int) -> bytes:
    request = _REQUEST.pack(name.encode()[:15], b"")
    return fcntl.ioctl(asked, what, request)[16:]
