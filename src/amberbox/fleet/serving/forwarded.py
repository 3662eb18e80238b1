"""Where a request comes from: what a trusted proxy says of it counts, and nothing else does."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from ipaddress import IPv4Address, IPv6Address

from amberbox.fleet.serving.settings import Network

Address = IPv4Address | IPv6Address


def client_address(peer: str, forwarded: Sequence[str], proxies: Sequence[Network]) -> str:
    """Return the address of who asks.

    ``forwarded`` are the values of ``X-Forwarded-For``. They are read from the right, as each proxy
    adds whom it heard: the first that is no trusted proxy has asked. What stands left of it anybody
    may have written.
    """
    found = read(peer)
    if found is None or not is_trusted(found, proxies):
        return peer if found is None else str(found)
    for entry in reversed(",".join(forwarded).split(",")):
        said = read(entry)
        if said is None:
            break
        found = said
        if not is_trusted(found, proxies):
            break
    return str(found)


def is_trusted(address: Address, proxies: Sequence[Network]) -> bool:
    """Tell whether an address is one of the proxies."""
    return any(address in network for network in proxies)


def read(text: str) -> Address | None:
    """Read an address as peers and proxies write them, with a port or without."""
    plain = text.strip().strip('"')
    if plain.startswith("["):
        plain = plain[1:].partition("]")[0]
    elif plain.count(":") == 1:
        plain = plain.partition(":")[0]
    try:
        found = ipaddress.ip_address(plain.partition("%")[0])
    except ValueError:
        return None
    mapped = found.ipv4_mapped if isinstance(found, IPv6Address) else None
    return mapped or found


def is_loopback(text: str) -> bool:
    """Tell whether an address is this machine."""
    found = read(text)
    return found is not None and found.is_loopback
