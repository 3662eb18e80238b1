"""Commands for tests: people with keys, a trust file's content, actions, signed commands."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from amberbox.agent.command_trust import CommandTrust, TrustedPerson
from amberbox.core import ed25519
from amberbox.core.command import Command, Risk, key_id, key_text, sign_command

ROBOT = "mira"
SERVER = "9f3c"


@dataclass(frozen=True)
class Person:
    """Somebody with a key; the same name has the same key each time."""

    name: str

    @property
    def private(self) -> bytes:
        return self.name.encode().ljust(32, b"-")

    @property
    def public(self) -> bytes:
        return ed25519.public_key_of(self.private)

    @property
    def key_id(self) -> str:
        return key_id(self.public)

    def trusted(self, risk: Risk, *actions: str) -> TrustedPerson:
        return TrustedPerson(key_text(self.public), risk, actions or ("*",))


ANNA, BEN, EVE = Person("anna"), Person("ben"), Person("eve")


def trust(confirm: str = "code") -> CommandTrust:
    """Return a trust file: anna may do all, ben only change states, eve nothing."""
    people = {"anna": ANNA.trusted("moves"), "ben": BEN.trusted("state", "lamp")}
    return CommandTrust(SERVER, people, "button" if confirm == "button" else "code")


@dataclass
class FakeActions:
    """Three actions, one of each risk; ``{"bad": ...}`` is beyond their limits."""

    risks: dict[str, Risk] = field(
        default_factory=lambda: {"journal.rotate": "record", "lamp": "state", "drive": "moves"}
    )

    def risk(self, action: str, /) -> Risk | None:
        return self.risks.get(action)

    def problem(self, action: str, parameters: str, /) -> str:
        wrong = "bad" in msgspec.json.decode(parameters)
        return f"{action} takes no parameter bad" if wrong else ""


def order(number: int, action: str = "journal.rotate", risk: Risk = "record") -> Command:
    """Return an unsigned command for the robot of the tests."""
    return Command(f"{number:032x}", ROBOT, action, "{}", "anna", risk)


def signed(
    command: Command,
    person: Person,
    challenge: bytes,
    lease: int,
    ttl_s: int = 30,
    server: str = SERVER,
) -> Command:
    """Return a command with a person's signature."""
    return sign_command(
        command, person.private, lease=lease, challenge=challenge, ttl_s=ttl_s, server=server
    )
