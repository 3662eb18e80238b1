"""The one line that a robot is given: where its server is, who it is, its key, whom to trust.

    amberbox+https://ropod_001:abr_...@fleet.example:8443/?ca=sha256:3f5a...

The key is in it, so it is shown once and pasted, never mailed. The fingerprint is the SHA-256 of
the certificate authority that signed the server's certificate: the robot trusts no other.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from urllib.parse import SplitResult, parse_qs, urlsplit

from amberbox.blackbox.folder.server import LOOPBACK
from amberbox.core.errors import UsageError
from amberbox.core.ids import is_id
from amberbox.link.keys import is_secret

_SCHEMES = {"amberbox+https": "https", "amberbox+http": "http"}
_DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class JoinLine:
    """What a robot needs to connect.

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
    """Make the line; raises UsageError for an address or a fingerprint that would not work."""
    line = JoinLine(url, robot, key, ca.lower().replace(":", ""))
    return read_join_line(str(line))


def read_join_line(text: str) -> JoinLine:
    """Read the line as it was pasted; raises UsageError, which never repeats the key."""
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
        _ = parts.port  # looks at it: a port may be no number
    except ValueError:
        raise _refused("its address cannot be read") from None
    if re.search(r"\s", text) or parts.fragment:
        raise _refused("it has a space, a line break or a # in it")
    return parts


def _fingerprint(parts: SplitResult) -> str:
    """Return the fingerprint; what is not understood is refused, for it is about trust."""
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
