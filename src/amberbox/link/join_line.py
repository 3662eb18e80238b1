"""The line by which a robot joins a server, and the form of the secrets that a server makes.

A secret is a prefix for its purpose, an id, and random letters. Robots know the form too: to see
that a pasted key is whole, and to mask keys in what they send. The join line is

    amberbox+https://ropod_001:abr_...@fleet.example:8443/?ca=sha256:3f5a...

The key is in it, so it is shown once and pasted, never mailed. The fingerprint is the SHA-256 of
the certificate authority that signed the server's certificate: the robot trusts no other.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal
from urllib.parse import SplitResult, parse_qs, urlsplit

from amberbox.blackbox.robot_folder.robot_yaml import LOOPBACK
from amberbox.core.errors import UsageError
from amberbox.core.names import is_id

Kind = Literal["session", "token", "robot"]

MARKS: Mapping[Kind, str] = {"session": "abs", "token": "abt", "robot": "abr"}
# Finds secrets within a text, also truncated ones, for masking
LOOKS_LIKE_ONE = re.compile(r"ab[str]_[0-9a-f]{12}_[A-Za-z0-9_-]{20,}")

_FORM = re.compile(r"(ab[str])_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")


def is_secret(text: str, kind: Kind) -> bool:
    """Return whether a text has the form of a secret of this kind, before any look-up."""
    found = _FORM.fullmatch(text)
    return found is not None and found[1] == MARKS[kind]


_SCHEMES = {"amberbox+https": "https", "amberbox+http": "http"}
_DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class JoinLine:
    """The data a robot needs to connect.

    ``url`` is the server's address, ``https://host:port/path``; plain ``http`` on this machine
    only. ``ca`` is the SHA-256 of the certificate authority, 64 hex digits, or empty for a server
    whose certificate the robot's system trusts.
    """

    url: str
    robot: str
    key: str = field(repr=False)
    ca: str = ""

    def __str__(self) -> str:
        parts = urlsplit(self.url)
        ca = f"?ca=sha256:{self.ca}" if self.ca else ""
        path = parts.path.rstrip("/") + "/"
        return f"amberbox+{parts.scheme}://{self.robot}:{self.key}@{parts.netloc}{path}{ca}"


def join_line(url: str, robot: str, key: str, ca: str = "") -> JoinLine:
    """Return the join line; raises UsageError for an invalid URL or fingerprint."""
    line = JoinLine(url, robot, key, ca.lower().replace(":", ""))
    return read_join_line(str(line))


def read_join_line(text: str) -> JoinLine:
    """Parse a pasted line; raises UsageError, which never repeats the key."""
    parts = _split(text.strip())
    scheme = _SCHEMES.get(parts.scheme)
    robot, key = parts.username or "", parts.password or ""
    if scheme is None or not parts.hostname:
        raise _refused("it does not begin with amberbox+https://")
    if not is_id(robot) or not is_secret(key, "robot"):
        raise _refused("its robot or its key is cut off or changed")
    if scheme == "http" and parts.hostname not in LOOPBACK:
        raise _refused("only a server on this machine is reached without TLS")
    place = parts.netloc.rpartition("@")[2]
    return JoinLine(f"{scheme}://{place}{parts.path.rstrip('/')}", robot, key, _fingerprint(parts))


def _split(text: str) -> SplitResult:
    try:
        parts = urlsplit(text)
        _ = parts.port  # raises ValueError for an invalid port
    except ValueError:
        raise _refused("its address cannot be read") from None
    if re.search(r"\s", text) or parts.fragment:
        raise _refused("it has a space, a line break or a # in it")
    return parts


def _fingerprint(parts: SplitResult) -> str:
    """Return the fingerprint; raises UsageError for unknown parameters."""
    if not parts.query:
        return ""
    found = parse_qs(parts.query, keep_blank_values=True)
    kind, _, digest = found.get("ca", [""])[0].partition(":")
    if set(found) != {"ca"} or len(found["ca"]) != 1 or kind != "sha256":
        raise _refused("what follows the ? is not ca=sha256:...")
    if not _DIGEST.fullmatch(digest):
        raise _refused("its fingerprint is cut off or changed")
    return digest


def _refused(why: str) -> UsageError:
    return UsageError(
        f"this is not a line that a server gave to a robot: {why}",
        "paste the whole line that was shown when the robot was added",
    )
