"""A server's accounts for tests: short words for what tests do again and again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_group
from amberbox.server.accounts.sessions import NewSession, SignedIn, find_session
from amberbox.server.accounts.signin import LoginOrigin, sign_in
from amberbox.server.accounts.users import User, add_user
from amberbox.server.audit import AuditLogRow, rows
from amberbox.server.database import ServerDatabase
from amberbox.testing.clock import ManualClock

CHEAP = HashCost(passes=1, memory_kib=8, threads=1)
PASSWORD = "four quiet tractors sing"
HOME = "10.0.0.7"
EVIL = "203.0.113.66"


@dataclass(frozen=True)
class Stand:
    database: ServerDatabase
    clock: ManualClock
    passwords: Passwords
    hashed: str

    @property
    def now_ns(self) -> int:
        return self.clock.wall_ns()

    def add_groups(self, *names: str) -> None:
        with self.database.begin() as connection:
            for name in names:
                add_group(connection, self.now_ns, name)

    def add_user(
        self,
        name: str = "anna",
        role: Role = Role.OPERATOR,
        groups: Iterable[str] | None = None,
        *,
        must_change: bool = False,
    ) -> User:
        with self.database.begin() as connection:
            return add_user(
                connection,
                self.now_ns,
                name,
                role,
                self.hashed,
                groups=groups,
                must_change=must_change,
            )

    def sign_in(
        self,
        name: str = "anna",
        password: str = PASSWORD,
        address: str = HOME,
        before: str | None = None,
    ) -> NewSession:
        caller = LoginOrigin(address, "Firefox", before)
        return sign_in(self.database, self.clock, self.passwords, name, password, caller)[1]

    def whose(self, secret: str) -> SignedIn | None:
        with self.database.reading() as connection:
            return find_session(connection, self.now_ns, secret)

    def log(self) -> list[AuditLogRow]:
        with self.database.reading() as connection:
            return list(rows(connection))
