"""Destinations of notifications: e-mail addresses and webhooks, quiet hours, the mail server."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime, time, timedelta, tzinfo
from typing import Final, Literal, TypeAlias
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo

import msgspec

from amberbox.core.clock import NS
from amberbox.core.redaction import MASK
from amberbox.core.robot_status import Severity
from amberbox.server.settings import LOST

NAME: Final = "notifications"
"""Under this name it is kept among the settings."""

LOST_HINT: Final = (
    "the file secrets.key of the server's folder is missing, or another one; put it back, or enter "
    "them again in the settings"
)

Also: TypeAlias = Literal["acknowledged", "resolved"]
"""Further events about which a destination is notified, for alarms it was notified of."""

_ADDRESS = re.compile(r"[^\s@<>,;:\"]{1,64}@[A-Za-z0-9.-]{1,190}")
_HOST = re.compile(r"[A-Za-z0-9.:_-]{1,253}")


@dataclass(frozen=True, slots=True)
class Smtp:
    """The mail server. A login needs TLS; the password is never shown again."""

    host: str
    port: int = 587
    security: Literal["starttls", "tls", "none"] = "starttls"
    sender: str = ""
    user: str = ""
    password: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        """Raise ValueError for an invalid server, or a login that would expose the password."""
        if not _HOST.fullmatch(self.host) or not 0 < self.port < 65536:
            raise ValueError(f"host: {self.host!r} port {self.port} is no mail server")
        if not _ADDRESS.fullmatch(self.sender):
            raise ValueError(f"sender: {self.sender!r} is no address")
        if self.password == MASK:
            raise ValueError("password: enter it again: it goes to another host now")
        if self.user and self.security == "none":
            raise ValueError("security: a login without TLS shows the password to everybody")


class Quiet(msgspec.Struct, frozen=True, rename={"from_": "from"}):
    """Hours of the day in which only ``but`` and what is worse is told; the rest comes after."""

    from_: str
    to: str
    zone: str = "UTC"
    but: Severity = "fatal"

    def __post_init__(self) -> None:
        """Raise ValueError for invalid times or an unknown time zone."""
        if any(time.fromisoformat(one).tzinfo is not None for one in (self.from_, self.to)):
            raise ValueError("zone: from and to are without an offset; zone says where they hold")
        try:
            _zone(self.zone)
        except (OSError, ValueError, KeyError) as error:
            raise ValueError(f"zone: there is no time zone {self.zone!r}") from error

    def until_ns(self, now_ns: int) -> int | None:
        """Return when (ns) the quiet hours end; None outside of them."""
        now = datetime.fromtimestamp(now_ns / NS, UTC).astimezone(_zone(self.zone))
        begin, end = time.fromisoformat(self.from_), time.fromisoformat(self.to)
        at = now.time()
        inside = begin <= at < end if begin <= end else at >= begin or at < end
        if not inside:
            return None
        over = now.replace(hour=end.hour, minute=end.minute, second=0, microsecond=0)
        over += timedelta(days=0 if over > now else 1)
        return int(over.timestamp()) * NS


@dataclass(frozen=True, slots=True)
class Email:
    """Somebody who gets mails about alarms of ``groups`` (none: all) from ``least`` on.

    ``also`` asks for messages when such an alarm is acknowledged or resolved.
    """

    name: str
    to: tuple[str, ...]
    least: Severity = "urgent"
    groups: tuple[str, ...] = ()
    quiet: Quiet | None = None
    also: tuple[Also, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError for invalid addresses."""
        _check_name(self.name)
        _check_also(self.also)
        for address in self.to:
            if not _ADDRESS.fullmatch(address):
                raise ValueError(f"to: {address!r} is no address")
        if not 0 < len(self.to) <= 50:
            raise ValueError("to: name one address at least, and 50 at most")


@dataclass(frozen=True, slots=True)
class Webhook:
    """A program that is told by HTTP; ``secret`` signs what it gets, and is never shown again."""

    name: str
    url: str
    secret: str = field(repr=False)
    least: Severity = "warning"
    groups: tuple[str, ...] = ()
    quiet: Quiet | None = None
    also: tuple[Also, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError for an invalid URL or a secret of fewer than 16 characters."""
        _check_name(self.name)
        _check_also(self.also)
        check_url(self.url)
        if len(self.secret) < 16:
            raise ValueError("secret: 16 characters at least; enter it again for another address")


Destination: TypeAlias = Email | Webhook


@dataclass(frozen=True, slots=True)
class Notifications:
    """Who is told. Above ``digest_above`` messages in ``digest_s`` the rest comes as one."""

    smtp: Smtp | None = None
    emails: tuple[Email, ...] = ()
    webhooks: tuple[Webhook, ...] = ()
    digest_above: int = 5
    digest_s: float = 600.0

    def __post_init__(self) -> None:
        """Raise ValueError for settings that contradict each other."""
        names = [one.name for one in self.destinations()]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"name: {min(twice)!r} is there twice")
        if self.emails and self.smtp is None:
            raise ValueError("smtp: mails need a mail server")
        if len(names) > 100 or self.digest_above < 1 or not 1 <= self.digest_s <= 86_400:
            raise ValueError("digest_above is 1 at least, digest_s is 1 to 86400, names are 100")

    def destinations(self) -> tuple[Destination, ...]:
        """Return all destinations."""
        return (*self.emails, *self.webhooks)

    @property
    def has_lost_secrets(self) -> bool:
        """Whether a secret in it could not be read."""
        password = "" if self.smtp is None else self.smtp.password
        return LOST in (password, *(one.secret for one in self.webhooks))

    def destination(self, name: str) -> Destination | None:
        """Return the destination of this name; None if there is none."""
        return next((one for one in self.destinations() if one.name == name), None)


def _zone(name: str) -> tzinfo:
    """Return a time zone; UTC also on computers without a time zone database."""
    return UTC if name == "UTC" else ZoneInfo(name)


def check_url(url: str) -> None:
    """Raise ValueError for a URL that is no webhook; plain HTTP is only for private networks."""
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname or "", parts.port
    except ValueError as error:
        raise ValueError(f"url: {error}") from error
    if parts.scheme not in ("https", "http") or not _HOST.fullmatch(host) or len(url) > 2000:
        raise ValueError("url: it begins with https:// and a host")
    plain = url.isascii() and url.isprintable() and " " not in url
    if parts.username is not None or parts.fragment or not plain:
        raise ValueError("url: no user, no fragment, no spaces")
    address = _literal(host)
    if address is not None and _is_odd(address):
        raise ValueError(f"url: {host} is no address of a program")
    near = host == "localhost" or (address is not None and address.is_private)
    if parts.scheme == "http" and not near:
        raise ValueError("url: plain http:// is for addresses in your own network; take https://")


def _literal(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _is_odd(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Return whether an address is unspecified, multicast, or link-local (metadata services)."""
    plain = getattr(address, "ipv4_mapped", None) or address
    return bool(plain.is_unspecified or plain.is_multicast or plain.is_link_local)


def _check_also(also: tuple[Also, ...]) -> None:
    if len(set(also)) != len(also):
        raise ValueError("also: each of acknowledged and resolved once at most")


def _check_name(name: str) -> None:
    if not name.strip() or len(name) > 64 or not name.isprintable():
        raise ValueError("name: 1 to 64 characters")
