"""``server:`` of ``robot.yaml``: which server the robot reports to, what goes there, and when."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from amberbox.blackbox.folder.triggers import expression_problem
from amberbox.core.errors import Problem
from amberbox.core.nodes import Node
from amberbox.core.options import option
from amberbox.core.standins import Finding

KEY_FILE = "server.key"
"""The robot's key, beside ``robot.yaml``: no part of the configuration, never sent on."""
RULES = ("always", "docked", "on_request")
NETWORK = "network "
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})

MeteredSends = Literal["urgent", "statuses"]


@dataclass(frozen=True)
class ServerOptions:
    """The fleet server this robot reports to."""

    url: str = option(doc="address of the fleet server, https://...")
    ca: str = option("", "SHA-256 of the authority that signed its certificate, sha256:...")
    token: str = option("", "the robot's key, where server.key does not hold it", secret=True)
    copy: str = option(
        "always", "when journals are copied: always, docked, on_request, network NAME"
    )
    docked: str = option("", "expression over recorded variables that is true in the dock")
    rate: float = option(0.0, "most that is sent in a second; 0 for as fast as it goes", unit="B")
    metered: Sequence[str] = option((), "networks that cost money, by name or interface: wwan*")
    metered_sends: MeteredSends = option("statuses", "what goes there: urgent, or statuses, too")
    live: bool = option(True, "whether somebody on the server may look at values as they come")

    def check(self) -> Iterator[Finding]:
        """Say which values cannot work."""
        yield from ((key, what) for key, what in self._wrong() if what)
        problem = expression_problem(self.docked) if self.docked else None
        if problem is not None:
            yield "docked", problem.what, problem.hint

    def _wrong(self) -> Iterator[tuple[str, str]]:
        yield "url", url_problem(self.url)
        yield "ca", _ca_problem(self.ca)
        yield "copy", rule_problem(self.copy)
        if self.copy == "docked" and not self.docked:
            yield "docked", "is needed by 'copy: docked': an expression that is true in the dock"
        yield "rate", "must not be below 0" if self.rate < 0 else ""


def url_problem(url: str) -> str:
    """Say what is wrong with a server's address; empty if nothing is."""
    if not url.startswith(("https://", "http://")):
        return "must start with https:// or http://"
    try:
        parts = urlsplit(url)
        _ = parts.port  # looks at it: a port may be no number
    except ValueError:
        return "is no address; write https://fleet.example.org:8443"
    if not parts.hostname or parts.query or parts.fragment:
        return "is no address; write https://fleet.example.org:8443"
    if parts.username or parts.password:
        return "must not hold a key: 'amberbox join' puts it where it belongs"
    if parts.scheme == "http" and parts.hostname not in LOOPBACK:
        return "must start with https://: only a server on this computer is reached without TLS"
    return ""


def rule_problem(rule: str) -> str:
    """Say what is wrong with a rule for copies; empty if nothing is."""
    if rule in RULES or (rule.startswith(NETWORK) and rule[len(NETWORK) :].strip()):
        return ""
    return f"'{rule}' is not one of {', '.join(RULES)}, network NAME"


def _ca_problem(ca: str) -> str:
    digits = ca.lower().removeprefix("sha256:").replace(":", "")
    if not ca or (len(digits) == 64 and not set(digits) - set("0123456789abcdef")):
        return ""
    return "is no fingerprint: sha256: and 64 hex digits, as the server shows them"


def read_key(folder: Path, options: ServerOptions) -> str:
    """Return the robot's key to its server; empty where there is none."""
    try:
        return (folder / KEY_FILE).read_text(encoding="utf-8").strip() or options.token
    except (OSError, UnicodeDecodeError):
        return options.token


def key_notes(node: Node, folder: Path, options: ServerOptions) -> Iterator[Problem]:
    """Note what is to be said of the key; ``node`` is that of ``server``."""
    keys = node.mapping or {}
    if "token" in keys:
        what = f"the key belongs into {KEY_FILE}: 'amberbox join' with a new line puts it there"
        yield keys["token"].problem("server.token", what, is_error=False)
    if not read_key(folder, options):
        what = "there is no key to it, so nothing is sent: 'amberbox join' with the server's line"
        yield node.problem("server", what, is_error=False)
    file = folder / KEY_FILE
    if file.exists() and stat.S_IMODE(file.stat().st_mode) & 0o077:
        what = f"{KEY_FILE} can be read by others: chmod 600 {KEY_FILE}"
        yield node.problem("server", what, is_error=False)
