"""Recovery without a person: the rules of ``robot.yaml`` order actions while their cause lasts.

The causes are what the robot's own watcher writes. Without it, or when it is late, nothing is
known and nothing is done; nor is it while a person or a run holds the robot. The gate counts the
attempts, in its log.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, Protocol

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.robot_folder.robot_yaml import RecoveryRule
from amberbox.blackbox.store.live_condition import LiveCondition
from amberbox.blackbox.store.own_records import OwnRecords, WrittenRecord, newest_records
from amberbox.blackbox.store.store import Store, is_locked
from amberbox.core.clock import NS, Clock
from amberbox.core.command import AnswerState
from amberbox.core.errors import Problem, UsageError, did_you_mean
from amberbox.core.files import replace_file
from amberbox.core.types import Diagnosis, Status
from amberbox.core.yaml_nodes import Node
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.experiments.action import DeclaredAction, check_parameters
from amberbox.monitoring.current_state import WRITER, CurrentStateReader
from amberbox.monitoring.findings import finding_of
from amberbox.monitoring.plan import MonitoringPlan

ISSUER = "policy"
STATE_FILE = "recovery.json"
# So probable must be what leads a diagnosis before anything is done about it
LEADS = 0.5
_READ_S = 1.0
_OLD_S = 5.0


# -- the causes


@dataclass(frozen=True, slots=True)
class PresentCauses:
    """What the watcher had found at ``read_ns`` (boot time): the newest statuses by address
    (``component``, ``component/mode``), and the failure modes that lead the diagnosis.
    """

    read_ns: int
    statuses: Mapping[str, Status]
    leading: frozenset[str]

    def has(self, cause: str) -> bool | None:
        """Return whether a cause is present; None where that is not known."""
        if "#" in cause:
            return cause in self.leading if self.statuses else None
        status = self.statuses.get(cause)
        if status is None or status.level == "unknown":
            return None
        return status.level in ("error", "stale") and not status.blocked_by


def leading_modes(diagnosis: Diagnosis | None, statuses: Mapping[str, Status]) -> frozenset[str]:
    """Return the failure modes that lead a diagnosis and still show.

    These are in all hypotheses that the evidence cannot distinguish from the most probable one,
    which have to be more probable than everything else together. A diagnosis remembers a fault for
    a while; here it leads no more once the monitors of its symptoms are well again: those of its
    own component, or where that shows none, of any.
    """
    if diagnosis is None or diagnosis.state != "open":
        return frozenset()
    leading = diagnosis.leading()
    share = diagnosis.groups[0].probability if diagnosis.groups else sum(
        hypothesis.probability for hypothesis in leading
    )  # fmt: skip
    if not leading or share <= LEADS:
        return frozenset()
    explained = frozenset(symptom for one in leading for symptom in one.explains)
    faults = frozenset.intersection(*(hypothesis.faults for hypothesis in leading))
    return frozenset(fault for fault in faults if _shows(fault, explained, statuses))


def _shows(fault: str, symptoms: Collection[str], statuses: Mapping[str, Status]) -> bool:
    """Return whether a fault shows now; symptoms that no monitor gives count as they are."""
    component = fault.partition("#")[0]
    own = [symptom for symptom in symptoms if symptom.startswith(f"{component}/")]
    found = (statuses.get(symptom.rpartition("/")[0]) for symptom in own or symptoms)
    return any(status is None or status.level != "ok" for status in found)


class Causes(Protocol):
    """What the rules depend on."""

    def has(self, cause: str, /) -> bool | None:
        """Return whether a cause is present; None where that is not known."""

    def allows(self, rule: RecoveryRule, /) -> bool:
        """Return whether the condition of a rule is known to be true, if it has one."""


class CauseReader:
    """Reads the causes once a second in a thread, so that the command process never waits."""

    def __init__(self, store: Store, clock: Clock, rules: Sequence[RecoveryRule]) -> None:
        self._store, self._clock = store, clock
        self._conditions = {
            rule.key: LiveCondition(store.path, rule.condition) for rule in rules if rule.condition
        }
        self._stop = threading.Event()
        self._present: PresentCauses | None = None
        self._diagnosis: Diagnosis | None = None

    def start(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._run, name="causes", daemon=True).start()
        for condition in self._conditions.values():
            condition.start()

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()
        for condition in self._conditions.values():
            condition.close()

    def allows(self, rule: RecoveryRule) -> bool:
        """Return whether the condition of a rule is true by new data, if it has one."""
        condition = self._conditions.get(rule.key)
        return condition is None or condition.is_true(_OLD_S)

    def has(self, cause: str) -> bool | None:
        """Return whether a cause is present; None where that is not known, or known too long."""
        present = self._present
        if present is None or self._clock.boot_ns() - present.read_ns > _OLD_S * NS:
            return None
        return present.has(cause)

    def _run(self) -> None:
        statuses = CurrentStateReader(self._store)
        diagnoses = OwnRecords(self._store, WRITER, {channels.DIAGNOSIS})
        diagnoses.skip()
        self._take(newest_records(self._store, WRITER, {channels.DIAGNOSIS}, 0.0))
        while not self._stop.is_set():
            with suppress(OSError):  # what was read last soon counts no more
                self._take(diagnoses.step())
                self._present = self._read(statuses)
            self._stop.wait(_READ_S)

    def _take(self, records: Sequence[WrittenRecord]) -> None:
        for record in records:
            found = finding_of(record.channel, record.values)
            if isinstance(found, Diagnosis):
                self._diagnosis = found

    def _read(self, reader: CurrentStateReader) -> PresentCauses:
        read_ns = self._clock.boot_ns()
        state = reader.read(self._clock.wall_ns())
        if state.silence:
            return PresentCauses(read_ns, {}, frozenset())
        found = {f"{s.component}/{s.mode}".rstrip("/"): s for s in state.statuses}
        return PresentCauses(read_ns, found, leading_modes(self._diagnosis, found))


# -- the rules at work


_PROCESS = "act"  # the writer whose lock the command process holds
RuleState = Literal["idle", "waits", "acts", "stands_back", "gave_up"]


_WORDS: Mapping[RuleState, str] = {
    "idle": "is not needed",
    "waits": "waits",
    "acts": "is at work",
    "stands_back": "stands back until the cause has gone",
    "gave_up": "gave up until the cause has gone; somebody has to look",
}


class RuleReport(msgspec.Struct, frozen=True):
    """The state of a rule for people; ``attempts`` are those that count now."""

    when: str
    do: str
    parameters: str
    limit: str
    state: RuleState
    attempts: int
    text: str = ""


class RecoveryGate(Protocol):
    """What the policy asks the gate."""

    def attempts(self, rule: str, within_s: float, /) -> int:
        """Return how many orders of a rule count now."""

    def order_obstacle(self) -> str:
        """Return why no order is possible now; empty if the robot is free."""


@dataclass(slots=True)
class _Rule:
    """``since_ns``: its cause is there since, or since its last attempt. ``text`` is how that one
    ended, or why there are no more; ``obstacle`` is why there is none now.
    """

    rule: RecoveryRule
    state: RuleState = "idle"
    since_ns: int | None = None
    command_id: str = ""
    text: str = ""
    obstacle: str = ""


class RecoveryPolicy:
    """Decides which action is due; the process that holds the gate orders it.

    A rule gives up when its limit is reached, and stands back when a person has stopped it or the
    robot has refused its order; both until its cause has gone. Of rules for one cause the first
    one goes on until it has given up.
    """

    def __init__(
        self, rules: Sequence[RecoveryRule], gate: RecoveryGate, clock: Clock, causes: Causes
    ) -> None:
        self._rules = [_Rule(rule) for rule in rules]
        self._gate, self._clock, self._causes = gate, clock, causes

    def due(self) -> RecoveryRule | None:
        """Return the rule whose action has to be ordered now, if any."""
        obstacle = self._gate.order_obstacle()
        for one in self._rules:
            self._follow(one)
            one.obstacle = obstacle if one.state == "waits" else ""
        if obstacle:
            return None
        tried: set[str] = set()
        for one in self._rules:
            if one.state != "waits" or one.rule.when in tried:
                continue
            tried.add(one.rule.when)
            if self._is_due(one):
                return one.rule
        return None

    def _follow(self, one: _Rule) -> None:
        """Follow the cause of a rule."""
        if one.state == "acts":
            return
        is_there = self._causes.has(one.rule.when)
        if is_there and one.since_ns is None:
            one.since_ns = self._clock.boot_ns()
            one.state = "waits" if one.state == "idle" else one.state
        elif not is_there:
            one.since_ns = None
            # what is not known may be there still: who gave up does not begin anew by that
            if is_there is False or one.state == "waits":
                one.state, one.text = "idle", ""

    def _is_due(self, one: _Rule) -> bool:
        rule, since_ns = one.rule, one.since_ns
        if since_ns is None or self._clock.boot_ns() - since_ns < rule.wait * NS:
            return False
        if self._gate.attempts(rule.key, rule.at_most.per_s) >= rule.at_most.most:
            one.state, one.text = "gave_up", f"tried as often as it may, {rule.at_most}"
            return False
        if self._causes.allows(rule):
            return True
        one.obstacle = f"'{rule.condition}' is not known to be true"
        return False

    def ordered(self, rule: RecoveryRule, command_id: str, refusal: str) -> None:
        """Take what the gate said to the order of a rule."""
        one = next(one for one in self._rules if one.rule is rule)
        if refusal:
            one.state, one.text = "stands_back", f"refused: {refusal}"
        else:
            one.state, one.command_id, one.text = "acts", command_id, ""

    def ended(self, command_id: str, state: AnswerState, reason: str) -> None:
        """Take how an order ended; the cause then has to last for as long again."""
        one = next((one for one in self._rules if one.command_id == command_id), None)
        if one is None:
            return
        one.command_id, one.text = "", f"{state.replace('_', ' ')}: {reason}".rstrip(": ")
        one.state = "stands_back" if state == "aborted" else "waits"
        for other in self._rules:
            if other.rule.when == one.rule.when and other.since_ns is not None:
                other.since_ns = self._clock.boot_ns()

    def reports(self) -> list[RuleReport]:
        """Return the state of each rule."""
        return [
            RuleReport(
                one.rule.when, one.rule.do, one.rule.parameters_json,
                str(one.rule.at_most), one.state,
                self._gate.attempts(one.rule.key, one.rule.at_most.per_s),
                one.obstacle or one.text,
            )
            for one in self._rules
        ]  # fmt: skip


def write_recovery(store: Store, reports: Sequence[RuleReport]) -> None:
    """Write the state of the rules for those who show it; without the disk they show an old one."""
    with suppress(OSError):
        replace_file(store.path / STATE_FILE, msgspec.json.encode(reports).decode())


def read_recovery(store: Store) -> list[RuleReport]:
    """Return the state of the rules; empty where no command process follows any."""
    if not is_locked(store, _PROCESS):
        return []
    try:
        content = (store.path / STATE_FILE).read_bytes()
        return msgspec.json.decode(content, type=list[RuleReport])
    except (OSError, msgspec.MsgspecError):
        return []


def recovery_lines(reports: Sequence[RuleReport]) -> Iterator[str]:
    """Yield a line for each rule whose cause is there."""
    for one in reports:
        if one.state == "idle":
            continue
        doing = _WORDS[one.state]
        text = f": {one.text}" if one.text else ""
        tried = f"{one.attempts} of {one.limit}" if one.attempts else f"at most {one.limit}"
        yield f"recovery of {one.when} by {one.do} ({tried}) {doing}{text}"


# -- the check


def recovery_problems(
    root: Node,
    rules: Sequence[RecoveryRule],
    actions: Mapping[str, DeclaredAction],
    plan: MonitoringPlan,
    fmea: Fmea | None,
) -> Iterator[Problem]:
    """Yield a problem for each action, parameter or cause that the robot folder does not have.

    ``root`` is ``robot.yaml``.
    """
    entries = ((root.mapping or {}).get("recovery") or root).items or ()
    for index, (node, rule) in enumerate(zip(entries, rules, strict=False)):
        keys, where = node.mapping or {}, f"recovery[{index}]"
        action = actions.get(rule.do)
        if action is None:
            what = f"there is no action '{rule.do}'{did_you_mean(rule.do, actions)}"
            yield keys.get("do", node).problem(f"{where}.do", what, "see actions/*.yaml")
        elif action.options.risk != "state":
            what = f"{rule.do} moves the robot: only a person may order that"
            yield keys.get("do", node).problem(f"{where}.do", what)
        else:
            try:
                check_parameters(action, rule.parameters_json)
            except UsageError as error:
                place = keys.get("with", keys.get("parameters", node))
                yield place.problem(f"{where}.with", error.what, error.hint)
        what = _cause_problem(rule.when, plan, fmea)
        if what:
            yield keys.get("when", node).problem(f"{where}.when", what)


def _cause_problem(cause: str, plan: MonitoringPlan, fmea: Fmea | None) -> str:
    if "#" in cause:
        known = fmea.modes if fmea is not None else {}
        no_file = "" if fmea is not None else ": there is no fmea.yaml without errors"
        what = f"there is no failure mode '{cause}'{no_file}{did_you_mean(cause, known)}"
        return "" if cause in known else what
    known_ids = [component.id for component in plan.components]
    known_ids += [f"{component.id}/{mode.id}" for component, mode in plan.modes()]
    what = f"there is no component or mode '{cause}'{did_you_mean(cause, known_ids)}"
    return "" if cause in known_ids else what
