"""Addresses of servers: ``https://host:port``, with a robot, with the authority to be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeGuard
from urllib.parse import quote, unquote, urlsplit

from amberbox.core.errors import UsageError
from amberbox.core.ids import is_id

_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_ROBOTS = "/robots/"
_HINT = "such as https://fleet.example:8443/robots/ropod_001"


@dataclass(frozen=True, slots=True)
class Address:
    """A server and, where one is named, a robot of it.

    ``pin`` is the SHA-256 of the server's authority (64 hex digits), empty where none is named.
    """

    url: str
    robot: str = ""
    pin: str = ""

    def __str__(self) -> str:
        return f"{self.url}{_ROBOTS}{quote(self.robot)}" if self.robot else self.url


def is_url(where: object) -> TypeGuard[str]:
    """Tell whether WHERE is the address of a server."""
    return isinstance(where, str) and where.startswith(("https://", "http://"))


def read_address(text: str) -> Address:
    """Read an address as it stands above a robot's page.

    ``#ca=sha256:...`` at its end names the authority. Raises UsageError for what is no address,
    and for one without TLS that leads to another machine.
    """
    try:
        parts = urlsplit(text.strip())
        _ = parts.port  # looks at it: a port may be no number
    except ValueError:
        raise UsageError(f"{text} is no address", _HINT) from None
    if parts.scheme not in ("https", "http") or not parts.hostname:
        raise UsageError(f"{text} is no address of a server", _HINT)
    if parts.username or parts.password or parts.query:
        raise UsageError("an address has no name, no key and no ? in it", _HINT)
    if parts.scheme == "http" and parts.hostname not in _LOOPBACK:
        raise UsageError(
            f"{parts.netloc} would be asked without TLS", f"https://{parts.netloc}: only this "
            "machine is asked without"
        )  # fmt: skip
    base, robot = _robot(parts.path)
    return Address(f"{parts.scheme}://{parts.netloc}{base}", robot, _pin(parts.fragment))


def with_robot(where: str, robot: str) -> str:
    """Name a robot in an address; raises UsageError when another one stands there."""
    address = read_address(where)
    if address.robot not in ("", robot):
        raise UsageError(f"{where} is {address.robot}, and --robot is {robot}", "leave out one")
    pin = f"#ca=sha256:{address.pin}" if address.pin else ""
    return f"{Address(address.url, robot)}{pin}"


def _robot(path: str) -> tuple[str, str]:
    """Split what stands before the robot's page; a server behind a proxy may have a path."""
    base, found, rest = path.rstrip("/").partition(_ROBOTS)
    if not found:
        return base.removesuffix("/robots"), ""
    robot = unquote(rest.partition("/")[0])
    if not is_id(robot):
        raise UsageError(f"'{robot}' is no robot's id", _HINT)
    return base, robot


def _pin(fragment: str) -> str:
    if not fragment.startswith("ca="):
        return ""
    from amberbox.core.tls import normal

    return normal(fragment.removeprefix("ca="))
