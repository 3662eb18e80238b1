"""The robot's decision whether a command runs: checks, lease, confirmation on site, revocation.

Orders that come from the robot itself, of somebody who stands at it or of its recovery policy, are
not signed. Everything else holds for them as for the commands of a server.

A state machine without threads and without input or output of its own: clock, log, trust file,
actions and randomness are handed in. Times are those of CLOCK_BOOTTIME, so that no step of the wall
clock makes a late command young. Every method works off what is due first. Those that return a
list return what the process that holds the gate has to do and to record, in this order.
"""

from __future__ import annotations

import hashlib
import hmac
import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeVar

from amberbox.agent.command_log import CommandLogError
from amberbox.agent.command_trust import CommandTrust
from amberbox.core.clock import NS, Clock
from amberbox.core.command import (
    CHALLENGE_BYTES,
    FINAL,
    MOST_TTL_S,
    REASON_LENGTH,
    RESULT_BYTES,
    RISKS,
    AnswerState,
    Command,
    CommandAnswer,
    CommandError,
    LeaseState,
    OrderLimit,
    Risk,
    decode_command,
    encode_command,
    is_command_id,
    unread_id,
    verify_command,
)
from amberbox.core.errors import AmberboxError, ConfigurationError

# A lease that was not renewed for longer is lost
LEASE_S = 3.0
# A motion has to be confirmed at the robot within this
CONFIRM_S = 30.0
CONFIRM_TRIES = 3
_CODE_DIGITS = 6
_CHALLENGES = 1000
_LABEL_LENGTH = 128
# Refusals that could not be stored yet: the newest
_REMEMBERED = 1000
# A server that revokes more is not trusted any further: no signed command runs
_MOST_REVOKED = 10_000
_KEY_ID_DIGITS = 16

# The reason of an answer that is repeated
CAME_AGAIN = "came again"

DecisionKind = Literal["run", "ask", "answer", "stop", "note"]


@dataclass(frozen=True, slots=True)
class Decision:
    """One thing to do, and to record.

    ``run``: start the action of ``command`` now; that it was accepted is on the disk. ``ask``: show
    ``code`` at the robot, or where it is empty wait for the button, to confirm ``command``.
    ``answer``: send ``answer`` to the server, unless it ``is_local``. ``stop``: stop the running
    command ``id`` safely. ``note``: only record ``text``. ``text`` is the reason; ``person`` is
    whose key signed, while the command's ``issuer`` is only what the server states.
    """

    kind: DecisionKind
    id: str = ""
    text: str = ""
    command: Command | None = None
    answer: CommandAnswer | None = None
    code: str = ""
    person: str = ""
    is_local: bool = False


@dataclass(frozen=True, slots=True)
class WaitingState:
    """A motion that waits: its command, whether by a code, and how many wrong ones came."""

    id: str
    by_code: bool
    tries: int


class CommandLog(Protocol):
    """The durable part of the gate; methods that store raise CommandLogError."""

    @property
    def lease_number(self) -> int:
        """The number of the last lease."""

    @property
    def revoked(self) -> Collection[str]:
        """Ids of the keys that were revoked."""

    def seen(self, command_id: str, /) -> tuple[str, CommandAnswer] | None:
        """Return digest and newest answer of a known command."""

    def running(self) -> list[tuple[str, CommandAnswer]]:
        """Return digest and answer of the commands that were accepted and have not ended."""

    def unanswered(self) -> list[CommandAnswer]:
        """Return the answers that the server has not stored yet."""

    def origin(self, command_id: str, /) -> str:
        """Return where an order of this robot itself came from; empty for any other command."""

    def attempts(self, origin: str, /) -> list[CommandAnswer]:
        """Return the newest answer of each order of an origin that was accepted."""

    def add(self, answer: CommandAnswer, digest: str, origin: str = "", /) -> CommandAnswer:
        """Store an answer durably; return it with its number."""

    def add_lease(self, number: int, /) -> None:
        """Store the number of a lease durably."""

    def add_revoked(self, keys: Iterable[str], /) -> None:
        """Store ids of revoked keys durably."""

    def acknowledge(self, number: int, /) -> None:
        """Note that the server has all answers up to a number."""

    def tidy(self) -> None:
        """Give room free that is no longer needed; may take seconds."""


class GateActions(Protocol):
    """The actions that this robot announces."""

    def risk(self, action: str, /) -> Risk | None:
        """Return the risk of an action; None for one that is not announced."""

    def problem(self, action: str, parameters: str, /) -> str:
        """Return what is wrong with parameters (JSON text); empty where nothing is."""


@dataclass(slots=True)
class _Challenge:
    """When a challenge was minted (ns of boot time), and the commands accepted with it."""

    minted_ns: int
    used: set[str] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class _Signer:
    """Who signed a command, and how motions are confirmed here; nobody for risk ``record``."""

    name: str = ""
    by_code: bool = False


@dataclass(slots=True)
class _Running:
    command: Command
    digest: str
    person: str


@dataclass(slots=True)
class _Waiting:
    """A motion that waits for its confirmation."""

    command: Command
    digest: str
    person: str
    code: str
    asked_ns: int
    tries: int = 0


@dataclass(slots=True)
class _Lease:
    """``order`` is the order of this robot itself that took it, and alone uses it."""

    number: int
    holder: str
    run: str
    renewed_ns: int
    order: str = ""
    keys: set[str] = field(default_factory=set)


class CommandGate:
    """Decides about the commands of one robot, in one process.

    ``trust`` reads the trust file: None where there is none, AmberboxError where it cannot be used.
    """

    def __init__(
        self,
        robot: str,
        log: CommandLog,
        clock: Clock,
        trust: Callable[[], CommandTrust | None],
        actions: GateActions,
        random: Callable[[int], bytes] = os.urandom,
    ) -> None:
        self._robot, self._log, self._clock = robot, log, clock
        self._trust, self._actions, self._random = trust, actions, random
        self._challenges: dict[bytes, _Challenge] = {}
        self._lease: _Lease | None = None
        self._waiting: _Waiting | None = None
        self._running: dict[str, _Running] = {}
        # what the disk did not take yet; refusals with their origin
        self._refused: dict[str, tuple[str, CommandAnswer, str]] = {}
        self._ends: dict[str, tuple[str, CommandAnswer, str]] = {}
        self._revoked: set[str] = set()
        self._out: list[Decision] = []

    def boot(self) -> list[Decision]:
        """Begin: the outcome of what was accepted earlier and has no end is unknown."""
        why = "the robot's command process ended while this was carried out"
        for digest, answer in self._log.running():
            self._ends[answer.id] = digest, self._answer(answer.id, "outcome_unknown", why), ""
        return self.step()

    def step(self) -> list[Decision]:
        """Work off what is due; call it a few times a second."""
        self._settle()
        found, self._out = self._out, []
        return found

    def _settle(self) -> None:
        now_ns = self._clock.boot_ns()
        self._store_late()
        if self._lease is not None and now_ns - self._lease.renewed_ns > LEASE_S * NS:
            self._end_lease(f"lost: it was not renewed for {LEASE_S:g} s")
        waiting = self._waiting
        if waiting is not None and now_ns - waiting.asked_ns > CONFIRM_S * NS:
            self._refuse_waiting(f"not confirmed at the robot within {CONFIRM_S:g} s")
        if not self._running and waiting is None and self._lease is None:
            self._log.tidy()

    def _store_late(self) -> None:
        """Store what the disk did not take before."""
        try:
            if self._revoked:
                self._log.add_revoked(self._revoked)
                self._revoked = set()
            for waiting in (self._ends, self._refused):
                for command_id, (digest, answer, origin) in list(waiting.items()):
                    stored = self._log.add(answer, digest, origin)
                    del waiting[command_id]
                    self._say(stored)
        except CommandLogError:
            return  # with the next step

    # -- challenges

    def mint(self) -> bytes:
        """Return a new challenge; on each connection, and every 10 s."""
        now_ns = self._clock.boot_ns()
        young = {c: k for c, k in self._challenges.items() if _is_young(now_ns, k, MOST_TTL_S)}
        self._challenges = dict(list(young.items())[1 - _CHALLENGES :])
        made = self._random(CHALLENGE_BYTES)
        self._challenges[made] = _Challenge(now_ns)
        return made

    # -- commands

    def receive(self, raw: bytes) -> list[Decision]:
        """Decide about an encoded command from the server."""
        self._settle()
        self._decide(raw)
        return self.step()

    def _decide(self, raw: bytes) -> None:
        digest = hashlib.sha256(raw).hexdigest()
        try:
            command = decode_command(raw)
        except CommandError as error:
            self._refuse_unread(unread_id(raw), digest, error.what)
            return
        if command.robot != self._robot:
            why = f"it is for the robot {command.robot}, and this one is {self._robot}"
            self._say(self._answer(command.id, "refused", why))
            return
        known = self._known(command.id)
        if known is not None:
            self._repeat(command.id, digest, *known)
            return
        why, signer = self._problem(command)
        if why:
            self._conclude(command.id, digest, "refused", why, signer.name)
        elif command.risk == "moves":
            self._ask(command, digest, signer)
        else:
            self._accept(command, digest, signer.name)

    def _refuse_unread(self, command_id: str, digest: str, why: str) -> None:
        """Answer what cannot be read, if it names an id, so that it is not sent again for ever."""
        known = self._known(command_id) if command_id else None
        if not command_id:
            self._note(f"a command was refused: {why}"[:REASON_LENGTH])
        elif known is None:
            self._say(self._answer(command_id, "refused", f"it cannot be read: {why}"))
        else:
            self._repeat(command_id, digest, *known)

    def _known(self, command_id: str) -> tuple[str, CommandAnswer | None] | None:
        """Return digest and answer of a command that came before; no answer while it waits."""
        if self._waiting is not None and self._waiting.command.id == command_id:
            return self._waiting.digest, None
        refused = self._refused.get(command_id)
        return refused[:2] if refused is not None else self._log.seen(command_id)

    def _repeat(
        self, command_id: str, digest: str, known: str, answer: CommandAnswer | None
    ) -> None:
        if digest != known and known:
            why = "a command with this id and other content came before"
            self._say(self._answer(command_id, "refused", why))
        elif answer is None:
            self._note("came again, and still waits for its confirmation", command_id)
        else:
            self._say(answer, CAME_AGAIN)

    def _problem(self, command: Command) -> tuple[str, _Signer]:
        """Return why a command is refused (empty if it is not), and who signed it."""
        why = self._content_problem(command)
        if why or command.risk == "record":
            return why, _Signer()
        why, signer = self._right_problem(command)
        why = why or self._freshness_problem(command) or self._lease_problem(command)
        if not why and command.risk == "moves" and self._waiting is not None:
            why = f"the command {self._waiting.command.id} waits for its confirmation"
        return why, signer

    def _content_problem(self, command: Command) -> str:
        least = self._actions.risk(command.action)
        if least is None:
            return f"this robot has no action {command.action}"
        wrong = self._actions.problem(command.action, command.parameters)
        if wrong:
            return wrong
        if RISKS.index(command.risk) < RISKS.index(least):
            return f"{command.action} has the risk {least}, and the command says {command.risk}"
        return ""

    def _right_problem(self, command: Command) -> tuple[str, _Signer]:
        """Return why this was not signed by a person who may order it, and who signed."""
        try:
            trust = self._trust()
        except AmberboxError as error:
            return _one_line(error), _Signer()
        signature = command.signature
        if trust is None:
            return "this robot takes no signed commands: robot.yaml has no 'commands:'", _Signer()
        if signature is None:
            return f"it is not signed, as the risk {command.risk} needs", _Signer()
        if signature.server != trust.server:
            return "it is signed for another server", _Signer()
        found = trust.person(signature.key_id)
        if found is None:
            return f"the key {signature.key_id} is not in the trust file", _Signer()
        name, public, rights = found
        signer = _Signer(name, trust.confirm == "code")
        if self._is_revoked(signature.key_id):
            return f"the key {signature.key_id} of {name} was revoked", signer
        if not rights.may(command.action, command.risk):
            return f"{name} may not order {command.action} ({command.risk}) here", signer
        if not verify_command(command, public):
            return f"the signature is not that of {name}", _Signer()
        return "", signer

    def _is_revoked(self, key: str) -> bool:
        revoked = self._log.revoked
        too_many = len(revoked) + len(self._revoked) >= _MOST_REVOKED
        return too_many or key in revoked or key in self._revoked

    def _freshness_problem(self, command: Command) -> str:
        signature = command.signature
        assert signature is not None, "checked before"
        challenge = self._challenges.get(signature.challenge)
        if challenge is None:
            return "its challenge is not one of this robot since it started"
        if signature.ttl_s > MOST_TTL_S:
            return f"its time to live is {signature.ttl_s} s: {MOST_TTL_S} s are the most"
        if not _is_young(self._clock.boot_ns(), challenge, signature.ttl_s):
            return f"it came later than {signature.ttl_s} s after its challenge"
        if command.id in challenge.used:
            return "it was accepted before"
        return ""

    def _lease_problem(self, command: Command) -> str:
        assert command.signature is not None, "checked before"
        lease = self._lease
        if lease is None:
            return "no run holds the lease of this robot"
        given = lease.number, lease.run
        if lease.order or given != (command.signature.lease, command.run):
            return f"the lease of this robot is held by {_holder(lease)}"
        return ""

    def _ask(self, command: Command, digest: str, signer: _Signer) -> None:
        number = int.from_bytes(self._random(8), "big") % 10**_CODE_DIGITS
        code = f"{number:0{_CODE_DIGITS}d}" if signer.by_code else ""
        now_ns = self._clock.boot_ns()
        self._waiting = _Waiting(command, digest, signer.name, code, now_ns)
        self._use_lease(command)
        text = f"{signer.name} orders {command.action}: to be confirmed within {CONFIRM_S:g} s"
        self._out.append(Decision("ask", command.id, text, command, code=code, person=signer.name))

    def _use_lease(self, command: Command) -> None:
        if self._lease is not None and command.signature is not None:
            self._lease.keys.add(command.signature.key_id)

    def _accept(self, command: Command, digest: str, person: str, origin: str = "") -> None:
        """Store that a command is accepted, and only then let it run."""
        try:
            stored = self._log.add(self._answer(command.id, "accepted"), digest, origin)
        except CommandLogError as error:
            self._conclude(command.id, digest, "refused", error.what, person, origin)
            return
        if command.signature is not None:
            self._challenges[command.signature.challenge].used.add(command.id)
            self._use_lease(command)
        self._running[command.id] = _Running(command, digest, person)
        self._say(stored, person=person)
        self._out.append(Decision("run", command.id, "", command, person=person))

    def _conclude(
        self, command_id: str, digest: str, state: AnswerState, why: str, person: str = "",
        origin: str = "",
    ) -> None:  # fmt: skip
        """Answer a command that does not run."""
        answer = self._answer(command_id, state, why)
        try:
            answer = self._log.add(answer, digest, origin)
        except CommandLogError:
            self._refused[command_id] = digest, answer, origin
            _keep_newest(self._refused)
        self._say(answer, person=person)

    def ended(
        self, command_id: str, state: AnswerState, reason: str = "", result: str = ""
    ) -> list[Decision]:
        """Take how a running command ended: done, failed, aborted or outcome_unknown.

        Its answer comes once it is stored. ``result`` is JSON text.
        """
        if state not in FINAL:
            raise ValueError(f"{state} is no end of a command")
        running = self._running.pop(command_id, None)
        if running is None:
            self._note(f"{state} came of a command that does not run", command_id)
        else:
            if len(result.encode("utf-8", "replace")) > RESULT_BYTES:
                result, reason = "", f"{reason} (its result was too large)".strip()
            answer = self._answer(command_id, state, reason, result)
            self._ends[command_id] = running.digest, answer, ""
            if self._is_leased_to(command_id):
                self._end_lease("its order has ended")
        return self.step()

    # -- orders of this robot itself

    def order(
        self, command_id: str, action: str, parameters: str, who: str, *,
        is_confirmed: bool = False, rule: str = "", limit: OrderLimit | None = None,
    ) -> list[Decision]:  # fmt: skip
        """Decide about an order of somebody at the robot, or of a ``rule`` of its policy.

        It takes the lease as ``who``, for as long as it runs; ``renew_order`` keeps it.
        ``is_confirmed``: the person who ordered a motion stands at the robot and sees that its way
        is free. A rule never moves anything, and orders at most as often as its ``limit``.
        """
        self._settle()
        risk = self._actions.risk(action)
        command = Command(command_id, self._robot, action, parameters, who, risk or "state")
        try:
            raw = encode_command(command)
        except CommandError as error:
            self._note(f"refused: {error.what}"[:REASON_LENGTH], command_id)
            return self.step()
        digest, origin = hashlib.sha256(raw).hexdigest(), _origin(rule)
        known = self._known(command_id)
        if known is not None:
            self._repeat(command_id, digest, *known)
            return self.step()
        why = self._content_problem(command) or self._order_problem(command, rule, limit)
        if risk == "moves" and not (is_confirmed or why):
            why = f"{action} moves the robot, and was not confirmed at the robot"
        if not why and risk != "record":
            why = self._give_lease(who, "", command_id)
        if why:
            self._conclude(command_id, digest, "refused", why[:REASON_LENGTH], who, origin)
        else:
            self._accept(command, digest, who, origin)
            if command_id not in self._running and self._is_leased_to(command_id):
                self._end_lease("its order was refused")
        return self.step()

    def _order_problem(self, command: Command, rule: str, limit: OrderLimit | None) -> str:
        """Return why the policy may not order this; empty for a person."""
        if not rule:
            return ""
        if command.risk == "moves":
            return f"{command.action} moves the robot: only a person may order that"
        if limit is None or self.attempts(rule, limit.per_s) >= limit.most:
            return "it was ordered as often as its rule allows"
        return ""

    def order_obstacle(self) -> str:
        """Return why no order of this robot itself is possible now; empty if it is free."""
        self._settle()
        return self._take_problem("the robot itself", "", "order")

    def attempts(self, rule: str, within_s: float) -> int:
        """Return how many orders of a rule were accepted in the last seconds (``OrderLimit``)."""
        now_ns, boot = self._clock.boot_ns(), self._clock.boot_id()
        ages_ns = (
            now_ns - (answer.mono_ns if answer.boot == boot else 0)
            for answer in self._log.attempts(_origin(rule))
        )
        return sum(age_ns <= within_s * NS for age_ns in ages_ns)

    def renew_order(self, command_id: str) -> bool:
        """Renew the lease that an order has taken; return whether it has it still."""
        self._settle()
        if self._lease is None or not self._is_leased_to(command_id):
            return False
        self._lease.renewed_ns = self._clock.boot_ns()
        return True

    def _is_leased_to(self, command_id: str) -> bool:
        return self._lease is not None and self._lease.order == command_id

    # -- confirmation on site

    def waiting(self) -> WaitingState | None:
        """Return which motion waits for its confirmation."""
        one = self._waiting
        return None if one is None else WaitingState(one.command.id, bool(one.code), one.tries)

    def confirmed(
        self, code: str = "", command: str = "", *, on_site: bool = False
    ) -> list[Decision]:
        """Take a confirmation of the motion that waits; with an id only if it is this one.

        ``on_site``: given at the robot, by its button or ``amberbox confirm``, which needs no code.
        From elsewhere only the code that is shown at the robot counts.
        """
        self._settle()
        waiting = self._waiting
        if waiting is None or command not in ("", waiting.command.id):
            self._note("confirmed, but it does not wait for a confirmation", command)
        elif on_site or _is_code(code, waiting.code):
            self._waiting = None
            self._accept_confirmed(waiting)
        elif not waiting.code:
            self._note("a code was entered, but the robot waits for its button", waiting.command.id)
        else:
            waiting.tries += 1
            if waiting.tries >= CONFIRM_TRIES:
                self._refuse_waiting(f"a wrong code was entered {waiting.tries} times")
            else:
                self._note("a wrong code was entered", waiting.command.id)
        return self.step()

    def _accept_confirmed(self, waiting: _Waiting) -> None:
        """Accept a motion unless the right to it, or the lease, went while it waited."""
        command = waiting.command
        why = self._right_problem(command)[0] or self._lease_problem(command)
        if why:
            self._conclude(command.id, waiting.digest, "refused", why, waiting.person)
        else:
            self._keep_challenge(command)
            self._accept(command, waiting.digest, waiting.person)

    def _keep_challenge(self, command: Command) -> None:
        """Have the challenge of a motion again, which may have been dropped while it waited."""
        assert command.signature is not None, "only signed commands wait"
        long_ago_ns = self._clock.boot_ns() - 2 * MOST_TTL_S * NS
        self._challenges.setdefault(command.signature.challenge, _Challenge(long_ago_ns))

    def _refuse_waiting(self, why: str, state: AnswerState = "refused") -> None:
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self._conclude(waiting.command.id, waiting.digest, state, why, waiting.person)

    # -- lease

    def lease(self) -> LeaseState:
        """Return who holds the robot."""
        self._settle()
        return self._lease_state()

    def _lease_state(self, reason: str = "") -> LeaseState:
        reason = reason[:REASON_LENGTH]
        if self._lease is None:
            return LeaseState(self._log.lease_number, reason=reason)
        return LeaseState(self._lease.number, self._lease.holder, self._lease.run, reason)

    def take_lease(self, holder: str, run: str) -> LeaseState:
        """Give the lease to a run, with the next number; refuse it while another one has it.

        The same holder and run get the lease that they have, which is not renewed by that.
        """
        self._settle()
        wrong = self._give_lease(holder, run)
        what = f"not given to {_name(holder, run)}: {wrong}" if wrong else "given"
        self._note(f"lease {self._log.lease_number} {what}")
        return self._lease_state(wrong)

    def _give_lease(self, holder: str, run: str, order: str = "") -> str:
        """Give the lease, unless it is given already; return why it was not."""
        wrong = self._take_problem(holder, run, order)
        if not wrong and self._lease is None:
            number = self._log.lease_number + 1
            try:
                self._log.add_lease(number)
            except CommandLogError as error:
                return error.what
            self._lease = _Lease(number, holder, run, self._clock.boot_ns(), order)
        return wrong

    def _take_problem(self, holder: str, run: str, order: str) -> str:
        if not _is_label(holder) or (run and not _is_label(run)):
            return "the holder of a lease has a name of at most 128 printable characters"
        lease = self._lease
        is_own = lease is not None and not (lease.order or order)
        if lease is not None and not (is_own and (lease.holder, lease.run) == (holder, run)):
            return f"the lease of this robot is held by {_holder(lease)}"
        signed = [r for r in self._running.values() if r.command.risk != "record"]
        if lease is None and signed:
            return f"{signed[0].command.action} of {signed[0].person} is still being stopped"
        return ""

    def renew(self, number: int) -> LeaseState:
        """Renew a lease, each second; the state has a reason where it is lost."""
        self._settle()
        if self._lease is None or self._lease.number != number or self._lease.order:
            return self._lease_state(f"lease {number} is lost")
        self._lease.renewed_ns = self._clock.boot_ns()
        return self._lease_state()

    def release(self, number: int) -> list[Decision]:
        """End a lease; what runs under it is stopped."""
        self._settle()
        lease = self._lease
        if lease is not None and lease.number == number and not lease.order:
            self._end_lease("released")
        return self.step()

    def _end_lease(self, why: str) -> None:
        """End the lease, with it the motion that waits and what runs under it."""
        lease, self._lease = self._lease, None
        if lease is None:
            return
        if lease.order not in self._running and lease.order:
            return  # with its order, of which the record has everything
        reason = f"lease {lease.number} of {_holder(lease)} ended: {why}"
        self._note(reason)
        self._refuse_waiting(reason)
        self._stop(lambda command: command.risk != "record", reason)

    def _stop(self, chosen: Callable[[Command], bool], why: str) -> None:
        stopped = {decision.id for decision in self._out if decision.kind == "stop"}
        for command_id, running in self._running.items():
            if chosen(running.command) and command_id not in stopped:
                self._out.append(Decision("stop", command_id, why, running.command))

    # -- abort and revocation

    def abort(self, target: str = "", who: str = "") -> list[Decision]:
        """Stop a command (its id), a run (its name, which also ends its lease), or all (empty).

        Always possible, by everybody, as often as wanted.
        """
        self._settle()
        why = f"aborted by {who}"[:REASON_LENGTH] if who else "aborted"

        def is_meant(command: Command) -> bool:
            return target in ("", command.id, command.run)

        if self._waiting is not None and is_meant(self._waiting.command):
            self._refuse_waiting(why, "aborted")
        self._stop(is_meant, why)
        if self._lease is not None and target in ("", self._lease.run):
            self._end_lease(why)
        if is_command_id(target) and self._known(target) is None:
            # the command may come later than its abort, with a digest that is not known yet
            self._conclude(target, "", "aborted", f"{why} before it came"[:REASON_LENGTH])
        self._note(f"{why}: {target or 'everything'}"[:REASON_LENGTH])
        return self.step()

    def revoke(self, key_ids: Iterable[str]) -> list[Decision]:
        """Revoke keys for good; a lease that one of them used ends, and what runs by it."""
        self._settle()
        new = {key for key in key_ids if _is_key_id(key) and not self._is_revoked(key)}
        if new:
            room = max(0, _MOST_REVOKED - len(self._log.revoked) - len(self._revoked))
            self._revoked.update(sorted(new)[:room])
            self._note(f"revoked: {', '.join(sorted(new))}"[:REASON_LENGTH])
            self._end_by_keys(new)
        return self.step()

    def _end_by_keys(self, keys: Collection[str]) -> None:
        def is_by(command: Command) -> bool:
            return command.signature is not None and command.signature.key_id in keys

        why = "the key that signed it was revoked"
        if self._waiting is not None and is_by(self._waiting.command):
            self._refuse_waiting(why)
        if self._lease is not None and self._lease.keys & set(keys):
            self._end_lease("a key that used it was revoked")
        else:
            self._stop(is_by, why)

    # -- answers

    def unanswered(self) -> list[CommandAnswer]:
        """Return the stored answers that the server has not acknowledged, in order."""
        return self._log.unanswered()

    def acknowledged(self, number: int) -> None:
        """Note that the server has stored all answers up to a number."""
        try:
            self._log.acknowledge(number)
        except CommandLogError:
            return  # they are sent again, and acknowledged again

    def _answer(
        self, command_id: str, state: AnswerState, reason: str = "", result: str = ""
    ) -> CommandAnswer:
        clock = self._clock
        return CommandAnswer(
            command_id, state, reason[:REASON_LENGTH], result,
            clock.wall_ns(), clock.boot_id(), clock.boot_ns(),
        )  # fmt: skip

    def _say(self, answer: CommandAnswer, text: str = "", person: str = "") -> None:
        refused = self._refused.get(answer.id)
        is_local = bool(refused[2] if refused is not None else self._log.origin(answer.id))
        self._out.append(
            Decision("answer", answer.id, text or answer.reason, answer=answer, person=person,
                     is_local=is_local)
        )  # fmt: skip

    def _note(self, text: str, command_id: str = "") -> None:
        self._out.append(Decision("note", command_id, text))


def _origin(rule: str) -> str:
    return f"policy {rule}" if rule else "site"


def _is_young(now_ns: int, challenge: _Challenge, ttl_s: int) -> bool:
    return now_ns - challenge.minted_ns <= ttl_s * NS


def _is_code(given: str, code: str) -> bool:
    return bool(code) and hmac.compare_digest(given.encode("utf-8", "replace"), code.encode())


def _is_label(text: str) -> bool:
    return 0 < len(text) <= _LABEL_LENGTH and text.isprintable()


def _is_key_id(text: str) -> bool:
    return len(text) == _KEY_ID_DIGITS and not set(text) - set("0123456789abcdef")


def _holder(lease: _Lease) -> str:
    return _name(lease.holder, lease.run)


def _name(holder: str, run: str) -> str:
    return f"{holder} (run {run})" if run else holder


_T = TypeVar("_T")


def _keep_newest(entries: dict[str, _T]) -> None:
    while len(entries) > _REMEMBERED:
        del entries[next(iter(entries))]


def _one_line(error: AmberboxError) -> str:
    """Return the reason of a refusal: of many problems the first one, and their number."""
    if isinstance(error, ConfigurationError) and error.problems:
        more = len(error.problems) - 1
        return f"the trust file is wrong: {error.problems[0]}" + (f"; {more} more" if more else "")
    return error.what
