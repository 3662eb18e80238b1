"""Log, and refuse, every attempt of a Python process to connect beyond this machine.

It is copied as ``sitecustomize.py`` to Python's path, so that workers are watched, too.
"""

import ipaddress
import os
import socket
import sys

LOG = os.environ.get("AMBERBOX_OFFLINE_LOG", "")
NAMES = ("socket.getaddrinfo", "socket.gethostbyname", "socket.gethostbyaddr", "socket.getnameinfo")


def is_here(host: object) -> bool:
    """Return whether a name or address is this machine."""
    if host in (None, "", "localhost", b"localhost"):
        return True
    text = host.decode("ascii", "replace") if isinstance(host, bytes) else str(host)
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return False
    return address.is_loopback or address.is_unspecified


def watch(event: str, arguments: tuple[object, ...]) -> None:
    """Raise OSError over what would leave the machine."""
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        peer, address = arguments
        is_network = getattr(peer, "family", None) in (socket.AF_INET, socket.AF_INET6)
        host = address[0] if is_network and isinstance(address, tuple) else None
    elif event in NAMES:
        host = arguments[0][0] if isinstance(arguments[0], tuple) else arguments[0]
    else:
        return
    if not is_here(host):
        with open(LOG, "a") as file:  # noqa: PTH123 -- pathlib may not be imported this early
            file.write(f"{event} {host!r} {sys.argv}\n")
        raise OSError(f"{event} of {host!r}: beyond this machine")


if LOG:
    sys.addaudithook(watch)
