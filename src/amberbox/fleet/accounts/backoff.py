"""Who has to wait before another login: longer with each wrong one, over restarts of the server.

Wrong logins are counted per pair of account and address, per address, and per account. The count of
an account never makes anybody wait longer than 30 s, and nobody at an address from which that
account has logged in lately: an attacker elsewhere cannot lock the rightful owner out. A day after
the last wrong login a count is forgotten.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import Connection, delete, select, update

from amberbox.core.clock import NS
from amberbox.fleet.accounts.keys import digest
from amberbox.fleet.accounts.tables import KNOWN_ADDRESSES, LOGIN_ATTEMPTS, USERS
from amberbox.fleet.database.upsert import upsert

_DAY_NS = 24 * 3600 * NS
_KNOWN_NS = 60 * _DAY_NS


@dataclass(frozen=True, slots=True)
class Limit:
    """How many wrong logins are free, and the longest wait; the first wait is one second."""

    free: int
    longest_ns: int

    def wait_ns(self, failures: int) -> int:
        """Return how long to wait after that many wrong logins: 1 s, 2 s, 4 s, ..."""
        if failures < self.free:
            return 0
        return min(NS << min(failures - self.free, 40), self.longest_ns)


LIMITS: Mapping[str, Limit] = {
    "pair": Limit(free=4, longest_ns=15 * 60 * NS),
    "address": Limit(free=20, longest_ns=15 * 60 * NS),
    "account": Limit(free=10, longest_ns=30 * NS),
}


@dataclass(frozen=True, slots=True)
class Wait:
    """How long until the next try; ``first`` says that nobody was told in this wait yet."""

    wait_ns: int
    first: bool

    @property
    def seconds(self) -> int:
        """Return whole seconds, rounded up."""
        return -(-self.wait_ns // NS)


def place(address: str) -> str:
    """Return what counts as one address: an IPv6 network of a site (/64) is one."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address[:64]
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)


def begin_attempt(connection: Connection, now_ns: int, account: str, address: str) -> Wait | None:
    """Count an attempt as wrong before its password is looked at, or say how long to wait.

    So many attempts at the same moment cannot slip through together. Call ``attempt_was_right``
    afterwards. An attempt that has to wait is not counted.
    """
    keys = _keys(account, address)
    if _is_known(connection, now_ns, account, address):
        del keys["account"]
    waits = [_wait(connection, now_ns, kind, key) for kind, key in keys.items()]
    longest = max(waits, key=lambda wait: wait.wait_ns)
    if longest.wait_ns > 0:
        _count_refused(connection, keys)
        return longest
    _forget_old(connection, now_ns)
    for kind, key in _keys(account, address).items():
        _count_failure(connection, now_ns, kind, key)
    return None


def attempt_was_right(
    connection: Connection, now_ns: int, user_id: int, account: str, address: str
) -> None:
    """Take an attempt back: of this account at this address nothing is held against anybody.

    Of the address and the account one is taken back, not all: who has an account of their own
    cannot clear what they did to others.
    """
    keys = _keys(account, address)
    pair = LOGIN_ATTEMPTS.c.key == keys.pop("pair")
    connection.execute(delete(LOGIN_ATTEMPTS).where(pair))
    chosen = update(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.key.in_(keys.values()))
    # No wait was running, or the attempt would not have been let through.
    connection.execute(chosen.values(failures=LOGIN_ATTEMPTS.c.failures - 1, until_ns=now_ns))
    known = upsert(connection.dialect, KNOWN_ADDRESSES, ("user_id", "address"), ("last_ns",))
    row = {"user_id": user_id, "address": place(address), "last_ns": now_ns}
    connection.execute(known, [row])


def _keys(account: str, address: str) -> dict[str, str]:
    """Name what is counted; hashed, so that no text of an attacker's choice is kept."""
    where, who = place(address), account.casefold()
    texts = {"pair": f"pair\0{who}\0{where}", "address": f"at\0{where}", "account": f"of\0{who}"}
    return {kind: digest(text) for kind, text in texts.items()}


def _is_known(connection: Connection, now_ns: int, account: str, address: str) -> bool:
    joined = select(KNOWN_ADDRESSES.c.last_ns).join(USERS)
    chosen = joined.where(USERS.c.name == account.casefold())
    last_ns = connection.execute(chosen.where(KNOWN_ADDRESSES.c.address == place(address))).scalar()
    return last_ns is not None and now_ns - last_ns < _KNOWN_NS


def _wait(connection: Connection, now_ns: int, kind: str, key: str) -> Wait:
    """Return the wait of one count; a clock that was set back cannot make it longer than ever."""
    chosen = select(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.key == key)
    row = connection.execute(chosen).mappings().one_or_none()
    if row is None:
        return Wait(0, first=False)
    longest_ns = LIMITS[kind].wait_ns(row["failures"])
    return Wait(min(row["until_ns"] - now_ns, longest_ns), first=row["refused"] == 0)


def _count_failure(connection: Connection, now_ns: int, kind: str, key: str) -> None:
    chosen = select(LOGIN_ATTEMPTS.c.failures).where(LOGIN_ATTEMPTS.c.key == key)
    failures = (connection.execute(chosen).scalar() or 0) + 1
    row = {
        "kind": kind,
        "key": key,
        "failures": failures,
        "last_ns": now_ns,
        "until_ns": now_ns + LIMITS[kind].wait_ns(failures),
        "refused": 0,
    }
    change = ("failures", "last_ns", "until_ns", "refused")
    connection.execute(upsert(connection.dialect, LOGIN_ATTEMPTS, ("kind", "key"), change), [row])


def _count_refused(connection: Connection, keys: Mapping[str, str]) -> None:
    more = LOGIN_ATTEMPTS.c.refused + 1
    chosen = update(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.key.in_(keys.values()))
    connection.execute(chosen.values(refused=more))


def _forget_old(connection: Connection, now_ns: int) -> None:
    connection.execute(delete(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.last_ns <= now_ns - _DAY_NS))
    old = KNOWN_ADDRESSES.c.last_ns <= now_ns - _KNOWN_NS
    connection.execute(delete(KNOWN_ADDRESSES).where(old))
