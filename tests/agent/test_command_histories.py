"""Whatever happens to robot, link and servers, commands run once, in time, by those who may.

Random histories of a gate on a simulated disk: orders that are lost, come twice, late, changed or
for somebody else; orders of somebody at the robot and of its recovery policy; kills and power cuts
at any system call, reboots, a wall clock that steps by a day, full and failing disks, two servers,
one that was restored and sends everything again. A model that knows what truly happened judges each
decision.

``HYPOTHESIS_PROFILE=soak`` runs many more of them, others each time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import msgspec

from amberbox.agent.command_gate import CommandGate, Decision
from amberbox.agent.command_log import CommandLogFile
from amberbox.agent.command_trust import CommandTrust
from amberbox.core.clock import NS
from amberbox.core.command import (
    FINAL,
    RISKS,
    Command,
    CommandAnswer,
    CommandError,
    LeaseState,
    OrderLimit,
    Risk,
    decode_command,
    encode_command,
    signed_bytes,
)
from amberbox.core.errors import AmberboxError
from amberbox.testing.clock import ManualClock
from tests.support.commands import (
    ANNA,
    BEN,
    EVE,
    ROBOT,
    SERVER,
    FakeActions,
    Person,
    order,
    signed,
    trust,
)
from tests.support.simulated_disk import KilledError, SimulatedDisk

SOAKING = os.environ.get("HYPOTHESIS_PROFILE") == "soak"
HISTORIES = 30_000 if SOAKING else 1000
STEPS = 80
TRAIL = 60
DAY_S = 86_400
RULE = "lamp#broken lamp"
LIMIT = OrderLimit(2, 60.0)
PATH = Path("/store/commands.log")
PEOPLE = {person.key_id: person for person in (ANNA, BEN, EVE)}


@dataclass
class Made:
    """What the model knows of a signed command: by whom, with which challenge."""

    command: Command
    person: Person
    is_genuine: bool = True


@dataclass
class HeldLease:
    """The lease as the model sees it."""

    number: int
    holder: str
    run: str
    renewed_ns: int
    keys: set[str] = field(default_factory=set)
    order: str = ""


@dataclass
class Asked:
    """A motion that waits for its confirmation."""

    command: Command
    code: str
    asked_ns: int
    tries: int = 0


def signed_part(command: Command) -> bytes:
    """Return what of a command nobody but the signer can change."""
    signature = command.signature
    if signature is None:
        return b""
    return signed_bytes(command, signature) + signature.key_id.encode() + signature.signature


class World:
    """A robot's gate, its disk and clocks, a network, two servers, and what truly happened."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)
        self.disk = SimulatedDisk(self.random)
        self.clock = ManualClock()
        self.trust: CommandTrust | None = trust()
        self.is_trust_broken = False
        self.trail: list[str] = []
        self.next_id = 0
        # the network and the servers
        self.frames: list[bytes] = []
        self.sent: list[bytes] = []
        self.made: dict[bytes, Made] = {}
        self.stored_number = 0
        # what truly happened
        self.started: dict[str, Command] = {}
        self.running: dict[str, Command] = {}
        self.ending: dict[str, str] = {}
        self.unsure: set[str] = set()
        self.unknown: set[str] = set()
        self.final: dict[str, str] = {}
        self.numbers: dict[int, tuple[str, str]] = {}
        self.minted: dict[bytes, int] = {}
        self.revoked: set[str] = set()
        self.aborted: set[str] = set()
        self.judged: set[str] = set()
        self.lease: HeldLease | None = None
        self.lease_number = 0
        self.asked: Asked | None = None
        self.is_confirming = False
        self.started_runs = 0
        # orders of the robot itself: who gave them, and when those of the rule began in true time
        self.orders: dict[str, str] = {}
        self.ordering = ""
        self.is_on_site = False
        self.true_ns = 0
        self.attempts: list[int] = []
        self.open()

    # -- the robot's processes

    def open(self) -> None:
        """Start the process that holds the gate, as often as it takes."""
        self.minted, self.lease, self.asked = {}, None, None
        while True:
            try:
                self.log = CommandLogFile(PATH, self.disk, tidy_bytes=2500)
                self.gate = CommandGate(
                    ROBOT,
                    self.log,
                    self.clock,
                    self.read_trust,
                    FakeActions(),
                    self.random.randbytes,
                )
                decisions = self.gate.boot()
            except KilledError:
                self.disk.kill()
                continue
            break
        assert not any("damaged" in note for note in self.log.notes), self.log.notes
        ended = set(self.final) - self.unknown
        interrupted = {*self.running, *self.ending, *self.unsure, *self.unknown}
        self.take(decisions)
        unknown = {a.id for _, a in self.log.running()}  # where the disk does not take the end yet
        for command_id in {*self.running, *self.ending, *self.unsure, *self.final}:
            seen = self.log.seen(command_id)
            if seen is not None and seen[1].state == "outcome_unknown":
                unknown.add(command_id)
        assert set(self.running) <= unknown, "what ran when the process died is unknown"
        assert unknown <= interrupted, "only what ran, or was on its way, is unknown"
        assert not unknown & ended, "what has ended is not unknown"
        self.unknown |= unknown
        self.running, self.ending = {}, {}

    def read_trust(self) -> CommandTrust | None:
        if self.is_trust_broken:
            raise AmberboxError("others may write to the trust file")
        return self.trust

    def act(self, what: str, action: Callable[[], list[Decision]], touched: str = "") -> None:
        """Do something with the gate; where the process dies in it, start it again."""
        self.trail.append(what)
        try:
            found = action()
        except KilledError:
            self.trail.append("   dies in it")
            self.crash(touched)
        else:
            self.take(found)

    def crash(self, touched: str = "", *, power: bool | None = None) -> None:
        if touched:
            self.unsure.add(touched)
        if self.asked is not None:
            self.unsure.add(self.asked.command.id)
        power = self.random.random() < 0.5 if power is None else power
        self.trail.append("   power cut" if power else "   killed")
        if power:
            self.disk.cut_power()
            self.new_boot()
        else:
            self.disk.kill()
        self.disk.failures = {}
        self.open()

    def new_boot(self) -> None:
        self.clock.boot = self.random.randint(5, 200) * NS
        self.true_ns += self.clock.boot
        self.clock.boot_name = f"{self.random.getrandbits(64):x}"
        if self.random.random() < 0.3:
            self.clock.wall = 0  # without a clock of its own it is 1970

    # -- what the gate decided

    def take(self, decisions: list[Decision]) -> None:
        stopped = {d.id for d in decisions if d.kind == "stop"}
        assert stopped <= set(self.running), "only what runs is stopped"
        for decision in decisions:
            self.trail.append(f"   {decision.kind} {decision.id[-3:]} {decision.text}")
            if decision.kind == "run":
                assert decision.command is not None
                self.start(decision.command)
            elif decision.kind == "ask":
                assert decision.command is not None
                self.check_signed(decision.command)
                self.asked = Asked(decision.command, decision.code, self.clock.boot)
            elif decision.kind == "answer":
                assert decision.answer is not None
                assert decision.is_local == (decision.id in self.orders)
                self.answered(decision.answer)

    def answered(self, answer: CommandAnswer) -> None:
        is_asked = self.asked is not None and answer.id == self.asked.command.id
        if is_asked and answer.state in FINAL and "other content" not in answer.reason:
            self.asked = None
        if not answer.number:
            assert answer.state in ("refused", "aborted")
            if "cannot be used" in answer.reason:
                self.unsure.add(answer.id)  # the record of it may be on the disk all the same
            return
        known = self.numbers.setdefault(answer.number, (answer.id, answer.state))
        assert known == (answer.id, answer.state), "one number, one answer"
        if answer.state in FINAL:
            assert self.final.setdefault(answer.id, answer.state) == answer.state
            self.ending.pop(answer.id, None)
        if answer.state == "refused":
            assert answer.id not in self.started, "what was refused did not run"

    def start(self, command: Command) -> None:
        """An action starts: the moment at which everything has to be right."""
        assert command.id not in self.started, "nothing runs twice"
        assert command.id not in self.final, "nothing runs that was answered"
        assert command.robot == ROBOT
        least = FakeActions().risk(command.action)
        assert least is not None and RISKS.index(command.risk) >= RISKS.index(least)
        assert "bad" not in command.parameters
        assert command.id not in self.aborted, "nothing runs that was aborted"
        if command.id in self.orders:
            self.start_order(command)
        elif command.risk != "record":
            self.check_signed(command, is_waiting=self.is_confirming)
        if command.risk == "moves" and command.id not in self.orders:
            assert self.is_confirming, "nothing moves without confirmation"
            assert self.asked is not None and self.asked.command == command
            assert self.clock.boot - self.asked.asked_ns <= 30 * NS, "no late confirmation"
            self.asked = None
        self.started[command.id] = self.running[command.id] = command

    def start_order(self, command: Command) -> None:
        """An order of the robot itself starts: it has the robot, and as often as it may."""
        assert command.id == self.ordering, "it starts when it is given, or never"
        who = self.orders[command.id]
        if who == "policy":
            young = [at for at in self.attempts if self.true_ns - at <= LIMIT.per_s * NS]
            assert len(young) < LIMIT.most, "no rule orders more often than it may"
            self.attempts.append(self.true_ns)
        if command.risk == "record":
            return
        assert self.lease is None, "nothing runs against the lease of another one"
        assert not any(c.risk != "record" for c in self.running.values()), "what runs has stopped"
        assert command.risk != "moves" or (self.is_on_site and who != "policy")
        assert self.log.lease_number > self.lease_number, "the number of a lease only grows"
        self.lease_number = self.log.lease_number
        self.lease = HeldLease(self.lease_number, who, "", self.clock.boot, order=command.id)

    def check_signed(self, command: Command, *, is_waiting: bool = False) -> None:
        why = self.verdict(command, is_waiting=is_waiting)
        assert not why, f"nothing runs without a right: {why}"
        assert command.signature is not None and self.lease is not None
        self.lease.keys.add(command.signature.key_id)

    def verdict(self, command: Command, *, is_waiting: bool = False) -> str:
        """Return why the model would refuse a signed command."""
        made = self.made.get(signed_part(command))
        if made is None or not made.is_genuine:
            return "it was changed"
        signature = command.signature
        if signature is None or self.trust is None or self.is_trust_broken:
            return "no signature, or no trust"
        if signature.server != self.trust.server or made.person.key_id in self.revoked:
            return "another server, or a revoked key"
        rights = self.trust.people.get(made.person.name)
        if rights is None or not rights.may(command.action, command.risk):
            return "no right"
        if not is_waiting:
            minted_ns = self.minted.get(signature.challenge)
            if minted_ns is None or signature.ttl_s > 60:
                return "an unknown challenge, or too long a time to live"
            if self.clock.boot - minted_ns > signature.ttl_s * NS:
                return "late"
        lease = self.lease
        given = (signature.lease, command.run)
        if lease is None or lease.order or (lease.number, lease.run) != given:
            return "no lease"
        return "lost" if self.clock.boot - lease.renewed_ns > 3 * NS else ""

    # -- steps

    def new_order(self) -> None:
        """Somebody orders something, mostly as it should be; the frame goes onto its way."""
        random = self.random
        self.next_id += 1
        usual: list[tuple[str, Risk]] = [
            ("journal.rotate", "record"), ("lamp", "state"), ("drive", "moves"),
        ]  # fmt: skip
        odd: list[tuple[str, Risk]] = [
            ("drive", "record"), ("drive", "state"), ("nothing", "record"), ("lamp", "moves"),
        ]  # fmt: skip
        action, risk = random.choice(usual * 4 + odd)
        lease = self.lease
        run = lease.run if lease is not None and random.random() < 0.95 else "other"
        command = msgspec.structs.replace(order(self.next_id, action, risk), run=run)
        if random.random() < 0.05:
            command = msgspec.structs.replace(command, robot="other")
        if random.random() < 0.05:
            command = msgspec.structs.replace(command, parameters='{"bad": 1}')
        if risk != "record" and random.random() < 0.97:
            command = self.sign(command)
        raw = encode_command(command)
        self.frames.append(raw)
        self.sent.append(raw)

    def sign(self, command: Command) -> Command:
        random = self.random
        person = random.choice([ANNA] * 10 + [BEN] * 3 + [EVE])
        challenges = list(self.minted) or [bytes(32)]
        challenge = challenges[-1] if random.random() < 0.8 else random.choice(challenges)
        if random.random() < 0.03:
            challenge = random.randbytes(32)
        lease = self.lease_number - (random.random() < 0.04)
        ttl_s = random.choice([30, 30, 60, 5, 1]) if random.random() < 0.95 else 365 * DAY_S
        server = SERVER if random.random() < 0.95 else "other"
        made = signed(command, person, challenge, max(lease, 0), ttl_s, server)
        self.made[signed_part(made)] = Made(made, person)
        if random.random() < 0.06:  # a thief changes what was signed
            made = self.forge(made)
            self.made[signed_part(made)] = Made(made, person, is_genuine=False)
        return made

    def forge(self, command: Command) -> Command:
        signature = command.signature
        assert signature is not None
        changes: list[dict[str, object]] = [
            {"id": f"{self.next_id + 10**6:032x}"},
            {"parameters": '{"speed": 9}'},
            {"action": "drive", "risk": "moves"} if command.action == "lamp" else {"step": "2"},
            {"signature": msgspec.structs.replace(signature, ttl_s=signature.ttl_s % 60 + 1)},
            {"signature": msgspec.structs.replace(signature, lease=self.lease_number + 1)},
            {"signature": msgspec.structs.replace(signature, key_id=BEN.key_id)
             if signature.key_id != BEN.key_id else None},
            {"signature": msgspec.structs.replace(signature, challenge=b"?" * 32)},
            {"signature": msgspec.structs.replace(signature, signature=bytes(64))},
        ]  # fmt: skip
        return msgspec.structs.replace(command, **self.random.choice(changes))

    def deliver(self) -> None:
        """A frame arrives: the next one, an old one again, or one with a changed byte."""
        random = self.random
        if self.frames and random.random() < 0.7:
            raw = self.frames.pop(0 if random.random() < 0.8 else -1)
        elif self.sent:
            raw = random.choice(self.sent)
        else:
            return
        if random.random() < 0.05:
            at = random.randrange(len(raw))
            raw = raw[:at] + bytes([raw[at] ^ (1 << random.randrange(8))]) + raw[at + 1 :]
        self.give(raw)

    def give(self, raw: bytes) -> None:
        try:
            command = decode_command(raw)
        except CommandError:
            self.act("receives what is no command", lambda: self.gate.receive(raw))
            return
        must_run = self.must_run(command)
        what = f"receives {command.id[-3:]} {command.action} ({command.risk})"
        before = len(self.trail)
        self.act(what, lambda: self.gate.receive(raw), command.id)
        if must_run and "   dies in it" not in self.trail[before:]:
            is_taken = command.id in self.started or (
                self.asked is not None and self.asked.command.id == command.id
            )
            assert is_taken, "what is right runs"
        self.judged.add(command.id)

    def must_run(self, command: Command) -> bool:
        """Return whether the model would let a command run that comes for the first time."""
        known = (self.judged, self.started, self.final, self.unsure, self.aborted)
        if any(command.id in ids for ids in known) or self.disk.failures or self.disk.die_in:
            return False
        least = FakeActions().risk(command.action)
        if least is None or RISKS.index(command.risk) < RISKS.index(least):
            return False
        if command.robot != ROBOT or "bad" in command.parameters:
            return False
        if command.risk == "record":
            return True
        is_free = command.risk != "moves" or self.asked is None
        return is_free and not self.verdict(command)

    def pass_time(self) -> None:
        """Time passes, mostly with a lease that is renewed."""
        self.renew()
        since_ns = self.clock.boot
        step_s = self.random.choice([0.1, 0.5, 1.0, 1.0, 2.9, 3.0, 3.1, 20.0, 61.0])
        is_renewing = self.random.random() < 0.7
        for _ in range(int(step_s) if is_renewing and step_s > 3 else 1):
            self.clock.advance(1.0 if is_renewing and step_s > 3 else step_s)
            if is_renewing:
                self.renew()
        self.true_ns += self.clock.boot - since_ns
        self.tick()

    def step_wall_clock(self) -> None:
        self.trail.append("the wall clock steps")
        self.clock.step(self.random.choice([-DAY_S, DAY_S, -3600, 5]))

    def tick(self) -> None:
        """Let the gate work off what is due; what has lost its right is stopped."""
        is_lost = self.lease is not None and self.clock.boot - self.lease.renewed_ns > 3 * NS
        signed_ones = {i for i, c in self.running.items() if c.risk != "record"}
        found: list[Decision] = []

        def step() -> list[Decision]:
            found.extend(self.gate.step())
            return found

        number = len(self.trail)
        self.act("step", step)
        if "   dies in it" in self.trail[number:]:
            return
        if is_lost:
            self.lease = None
            assert signed_ones <= {d.id for d in found if d.kind == "stop"}, "no lease, no motion"
        asked = self.asked
        assert asked is None or self.clock.boot - asked.asked_ns <= 30 * NS, "asked for too long"

    def mint(self) -> None:
        self.minted[self.gate.mint()] = self.clock.boot

    def take_lease(self) -> None:
        self.tick()
        self.started_runs += 1
        holder = self.random.choice(["anna", "ben", "second server"])
        run = f"run {self.started_runs}"
        held, busy = self.lease, any(c.risk != "record" for c in self.running.values())
        found: list[LeaseState] = []

        def taking() -> list[Decision]:
            found.append(self.gate.take_lease(holder, run))
            return self.gate.step()

        if held is not None and held.order and self.random.random() < 0.5:
            holder, run = held.holder, ""  # a server that passes for who holds it

        is_sound, before = not self.disk.failures, len(self.trail)
        self.act(f"{holder} takes the lease", taking)
        if "   dies in it" in self.trail[before:]:
            return
        (state,) = found
        if held is not None:
            assert held.holder in state.reason and state.number == held.number
        elif busy:
            assert state.reason
        elif is_sound:
            assert not state.reason, "a free robot is given"
        if held is None and not state.reason:
            assert state.number > self.lease_number, "the number of a lease only grows"
            self.lease_number = state.number
            self.lease = HeldLease(state.number, holder, run, self.clock.boot)

    def give_order(self) -> None:
        """Somebody at the robot, or its policy, orders something."""
        self.tick()
        random = self.random
        self.next_id += 1
        command_id = f"a{self.next_id:031x}"
        who = random.choice(["nico", "policy"])
        action = random.choice(["lamp", "lamp", "drive", "journal.rotate", "nothing"])
        parameters = '{"bad": 1}' if random.random() < 0.05 else "{}"
        self.orders[command_id] = who
        self.ordering, self.is_on_site = command_id, random.random() < 0.8
        is_free = self.lease is None and all(c.risk == "record" for c in self.running.values())
        is_sure = not self.disk.failures and not self.disk.die_in

        def ordering() -> list[Decision]:
            return self.gate.order(
                command_id, action, parameters, who, is_confirmed=self.is_on_site,
                rule=RULE if who == "policy" else "", limit=LIMIT if who == "policy" else None,
            )  # fmt: skip

        self.act(f"{who} orders {action}", ordering, command_id)
        if is_free and is_sure and who == "nico" and action == "lamp" and parameters == "{}":
            assert command_id in self.started, "what is right runs"
        if random.random() < 0.2:
            self.act("orders it again", ordering, command_id)
            self.act("with other content", lambda: self.gate.order(command_id, "lamp", "[]", who))
        self.ordering = ""

    def renew(self) -> None:
        if self.lease is None:
            return
        if self.lease.order:
            self.renew_order(self.lease)
            return
        number = self.lease.number - (self.random.random() < 0.02)
        found: list[LeaseState] = []

        def renewing() -> list[Decision]:
            found.append(self.gate.renew(number))
            return []

        self.act("renews", renewing)
        if found:
            is_good = (
                number == self.lease.number and self.clock.boot - self.lease.renewed_ns <= 3 * NS
            )
            assert (not found[0].reason) == is_good
            if is_good:
                self.lease.renewed_ns = self.clock.boot

    def renew_order(self, held: HeldLease) -> None:
        """Its order renews a lease, and a server that has read its number tries to."""
        renewed: list[bool] = []

        def renewing() -> list[Decision]:
            assert self.gate.renew(held.number).reason, "only the order renews its own lease"
            renewed.append(self.gate.renew_order(held.order))
            return []

        self.act("renews its order", renewing)
        if renewed:
            assert renewed[0] == (self.clock.boot - held.renewed_ns <= 3 * NS)
            held.renewed_ns = self.clock.boot if renewed[0] else held.renewed_ns

    def release(self) -> None:
        if self.lease is None or self.random.random() < 0.5:
            return
        number = self.lease.number
        if not self.lease.order:
            self.lease = None
        self.act("releases", lambda: self.gate.release(number))

    def confirm(self) -> None:
        self.tick()
        asked = self.asked
        if asked is None:
            return
        kind = self.random.choice(["code", "code", "code", "wrong", "button"])
        good = kind == "button" or (kind == "code" and asked.code)
        code = asked.code if kind == "code" else "x23456"
        self.is_confirming = bool(good)
        is_right = not self.verdict(asked.command, is_waiting=True)
        is_sure = not self.disk.failures and not self.disk.die_in
        self.act(
            f"confirms by {kind}",
            lambda: self.gate.confirmed("" if kind == "button" else code, on_site=kind == "button"),
            asked.command.id,
        )
        self.is_confirming = False
        if good and is_right and is_sure:
            assert asked.command.id in self.started, "what was confirmed runs"
        if good and self.asked is asked:
            self.asked = None

    def end(self) -> None:
        """An action ends, or answers twice."""
        if not self.started:
            return
        is_running = bool(self.running) and self.random.random() < 0.9
        chosen = self.random.choice(list(self.running if is_running else self.started))
        state = self.random.choice(["done", "failed", "aborted"])
        if chosen in self.running:
            self.ending[chosen] = state
            del self.running[chosen]
            if self.lease is not None and self.lease.order == chosen:
                self.lease = None
        self.act(f"{chosen[-3:]} ends", lambda: self.gate.ended(chosen, state, "", "{}"))  # type: ignore[arg-type]  # a literal

    def abort(self) -> None:
        ids = [*self.running, *([self.asked.command.id] if self.asked else [])]
        later = [decode_command(raw).id for raw in self.frames]
        runs = [self.lease.run] if self.lease else []
        targets = [*ids, *later, *runs, ""]
        target = self.random.choice(targets)
        meant = {i for i, c in self.running.items() if target in ("", i, c.run)}
        found: list[Decision] = []

        def aborting() -> list[Decision]:
            found.extend(self.gate.abort(target, "anna"))
            return found

        if self.lease is not None and target in ("", self.lease.run):
            self.lease = None
        is_stored = not self.disk.failures
        before = len(self.trail)
        self.act(f"aborts {target[-3:] or 'all'}", aborting)
        if "   dies in it" not in self.trail[before:]:
            assert meant <= {d.id for d in found if d.kind == "stop"}, "an abort always counts"
            assert self.asked is None or target not in ("", self.asked.command.id)
            (self.aborted if is_stored else self.unsure).add(target)
        else:
            self.unsure.add(target)

    def revoke(self) -> None:
        person = self.random.choice([ANNA, BEN, EVE, EVE])
        if person is ANNA and self.random.random() < 0.8:
            return
        self.revoked.add(person.key_id)
        by = {
            i for i, c in self.running.items()
            if c.signature is not None and c.signature.key_id == person.key_id
        }  # fmt: skip
        if self.lease is not None and person.key_id in self.lease.keys:
            self.lease = None
        found: list[Decision] = []

        def revoking() -> list[Decision]:
            found.extend(self.gate.revoke([person.key_id, "no key"]))
            return found

        is_new = person.key_id not in self.log.revoked
        before = len(self.trail)
        self.act(f"revokes {person.name}", revoking)
        if "   dies in it" in self.trail[before:] or self.disk.failures:
            self.act("revokes again on contact", revoking)  # the server does on each contact
            self.contacts_until_revoked(person)
        elif is_new:
            assert by <= {d.id for d in found if d.kind == "stop"}, "a revoked key ends its run"

    def contacts_until_revoked(self, person: Person) -> None:
        """A disk that failed takes the revocation later; until then a kill may lose it."""
        self.disk.failures, self.disk.die_in = {}, 0
        self.act("revokes on contact", lambda: self.gate.revoke([person.key_id]))

    def change_trust(self) -> None:
        self.trail.append("the trust file changes")
        full = trust(self.random.choice(["code", "button"]))
        without = {name: p for name, p in full.people.items() if name != "anna"}
        choices = [full] * 4 + [CommandTrust(SERVER, without), None]
        self.trust = self.random.choice(choices)
        self.is_trust_broken = self.random.random() < 0.1

    def contact(self) -> None:
        """The link is back: answers and acknowledgements, and all that is unanswered again."""
        answers = self.gate.unanswered()
        assert not {answer.id for answer in answers} & self.orders.keys(), "servers ordered none"
        assert [a.number for a in answers] == sorted(a.number for a in answers)
        for answer in answers:
            self.answered(answer)
        self.stored_number = max([self.stored_number, *(a.number for a in answers)])
        if self.random.random() < 0.7:
            number = self.stored_number + self.random.choice([0, 0, 5])

            def acknowledging() -> list[Decision]:
                self.gate.acknowledged(number)
                return []

            self.act("acknowledges", acknowledging)
        for raw in self.sent[-5:]:
            self.give(raw)

    def restore_server(self) -> None:
        """A server comes back from its copy: it knows no answers, and sends everything again."""
        self.trail.append("a restored server")
        self.stored_number = 0
        for raw in self.sent[: self.random.randint(0, 20)]:
            self.give(raw)

    def break_disk(self) -> None:
        if self.random.random() < 0.5:
            self.disk.failures = {}
        elif self.random.random() < 0.5:
            self.disk.fill()
        else:
            self.disk.damage()
        self.trail.append(f"the disk: {self.disk.failures}")

    def arm(self) -> None:
        """The process will die in one of the next system calls."""
        self.disk.die_in = self.random.randint(1, 12)

    def lose(self) -> None:
        """The network loses or repeats what is on its way."""
        if self.frames and self.random.random() < 0.5:
            self.frames.pop(self.random.randrange(len(self.frames)))
        elif self.frames:
            self.frames.append(self.random.choice(self.frames))

    def live(self) -> None:
        steps = [
            (self.new_order, 22), (self.deliver, 28), (self.pass_time, 10), (self.mint, 8),
            (self.take_lease, 8), (self.give_order, 8), (self.confirm, 14), (self.end, 9),
            (self.abort, 2), (self.revoke, 3), (self.change_trust, 1), (self.contact, 4),
            (self.restore_server, 1),
            (self.break_disk, 2), (self.arm, 3), (self.lose, 4), (self.release, 1),
            (self.step_wall_clock, 3), (self.tick, 4), (lambda: self.crash(), 2),
        ]  # fmt: skip
        self.mint()
        self.take_lease()
        chosen = self.random.choices([s for s, _ in steps], [w for _, w in steps], k=STEPS)
        for step in chosen:
            step()
        self.settle()

    def settle(self) -> None:
        """At last everything has one end, and the next start finds nothing that is unknown."""
        self.disk.failures, self.disk.die_in = {}, 0
        self.tick()
        for command_id in list(self.running):
            self.ending[command_id] = "done"
            del self.running[command_id]
            self.act("ends", lambda i=command_id: self.gate.ended(i, "done"))  # type: ignore[misc]  # bound
        assert not self.ending
        for command_id in self.started:
            seen = self.log.seen(command_id)
            assert seen is not None and seen[1].state in FINAL, "what began has one end"
            state = self.final.setdefault(command_id, seen[1].state)
            assert state == seen[1].state
        assert self.unknown & set(self.started) <= {
            i for i, state in self.final.items() if state == "outcome_unknown"
        }
        self.asked = None
        self.unsure = set()
        self.crash(power=True)


def run_history(seed: int) -> World:
    world = None
    try:
        world = World(seed)
        world.live()
    except BaseException as error:
        trail = "\n".join(world.trail[-TRAIL:]) if world is not None else ""
        error.add_note(f"history {seed}:\n{trail}")
        raise
    return world


def test_random_histories() -> None:
    first = time.time_ns() // 1000 if SOAKING else 0
    moved = states = unknown = orders = limited = 0
    for seed in range(first, first + HISTORIES):
        world = run_history(seed)
        moved += sum(c.risk == "moves" for c in world.started.values())
        states += sum(c.risk == "state" for c in world.started.values())
        unknown += len(world.unknown)
        orders += len(world.orders.keys() & world.started.keys())
        limited += len(world.attempts) >= LIMIT.most
    # a model that nothing reaches would find nothing
    counts = moved, states, unknown, orders, limited
    assert min(counts) > HISTORIES / 20, counts
