"""Addresses of servers: ``https://host:port``, optionally with a robot and a pinned authority."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeGuard
from urllib.parse import quote, unquote, urlsplit

from amberbox.core.errors import UsageError
from amberbox.core.names import is_id

_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_ROBOTS = "/robots/"
_HINT = "such as https://fleet.example:8443/robots/ropod_001"


@dataclass(frozen=True, slots=True)
class Address:
    """A server and, if named, one of its robots.

    ``pin`` is the SHA-256 of the server's authority (64 hex digits), empty if none is named.
    """

    url: str
    robot: str = ""
    pin: str = ""

    def __str__(self) -> str:
        return f"{self.url}{_ROBOTS}{quote(self.robot)}" if self.robot else self.url


def is_url(where: object) -> TypeGuard[str]:
    """Return whether WHERE is a URL of a server."""
    return isinstance(where, str) and where.startswith(("https://", "http://"))


def read_address(text: str) -> Address:
    """Return the address in a text, such as the URL of a robot's page.

    ``#ca=sha256:...`` at its end pins the authority. Raises UsageError for an invalid address, and
    for one without TLS on another machine.
    """
    try:
        parts = urlsplit(text.strip())
        _ = parts.port  # raises ValueError for an invalid port
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
    """Return an address with a robot; raises UsageError when it names another one."""
    address = read_address(where)
    if address.robot not in ("", robot):
        raise UsageError(f"{where} is {address.robot}, and --robot is {robot}", "leave out one")
    pin = f"#ca=sha256:{address.pin}" if address.pin else ""
    return f"{Address(address.url, robot)}{pin}"


def _robot(path: str) -> tuple[str, str]:
    """Return base path and robot of a path; a server behind a proxy may have a base path."""
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
    from amberbox.core.tls import normal_fingerprint

    return normal_fingerprint(fragment.removeprefix("ca="))
