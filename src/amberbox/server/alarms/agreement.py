"""Agreement of server and robots on what people did with alarms: acknowledged, shelved, resolved.

What a person did last counts at both ends, by the server's estimate of when it was. What an end
decides by itself (it got worse, it came back, its shelf is over) does not travel. The robot states
in its record what its people did, and what the server's commands did there: an echo of a command
changes nothing here. As long as its last word is another one than what is wanted, it is told
again, a few times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final

import msgspec
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.core.record_commands import (
    NOTE_LENGTH,
    AlarmAcknowledge,
    AlarmCommand,
    AlarmResolve,
    AlarmShelve,
    AlarmUnshelve,
)
from amberbox.monitoring.findings import AlarmChange, AlarmState
from amberbox.server import record_orders
from amberbox.server.alarms import lifecycle
from amberbox.server.alarms.alarm import Alarm, AlarmPart, HistoryEntry, Step
from amberbox.server.alarms.reports import AlarmReport
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.database import upsert_rows
from amberbox.server.record_orders import RecordOrder
from amberbox.server.schema import ALARM_WORD, HISTORY

# What people do that robots are told; in the history of an alarm
_DONE: Final = ("acknowledged", "shelved", "unshelved", "resolved")
# The ends of shelving may differ by this: commands take a while, and clocks are estimated
_SHELF_NS: Final = 120 * NS
_LATEST_NS: Final = 1 << 62


@dataclass(frozen=True, slots=True)
class RobotWord:
    """What a person did last with an alarm of a robot, by the robot's record.

    ``said_ns`` is its log time, ``at_ns`` the server's estimate of it; ``until_ns`` by the server's
    clock. ``command`` is the command of the server by which it came; empty for one given there.
    """

    robot: str
    source: str
    state: AlarmState
    who: str
    until_ns: int | None
    said_ns: int
    at_ns: int
    command: str

    def is_shelved(self, now_ns: int) -> bool:
        """Return whether it was put on the shelf and will still be there for a while."""
        is_over = self.until_ns is not None and self.until_ns <= now_ns + _SHELF_NS
        return self.state == "shelved" and not is_over


def take_word(
    register: AlarmRegister, report: AlarmReport, change: AlarmChange, part: AlarmPart, now_ns: int
) -> None:
    """Take what a robot says that a person did with its alarm; later words count more."""
    if change.said_ns is None or not (change.who or change.command):
        return
    word = RobotWord(
        report.robot, part.source, change.state, f"{change.who[:100]} at the robot",
        None if change.until_ns is None else _time(change.until_ns + report.offset_ns),
        _time(change.said_ns), _time(change.said_ns + report.offset_ns), change.command[:32],
    )  # fmt: skip
    before = _words(register, [part]).get(part.source)
    if before is not None and _same(before, word):
        return  # written again, as at the start of each file
    _keep(register, word)
    if word.command:
        about = _about(part)
        record_orders.see(register.connection, report.robot, about, word.command)
        return
    alarm = register.alarm(part.alarm)
    if alarm is None:
        return
    last = _last_done(register, alarm.number)
    if last is not None and last.at_ns >= word.at_ns:
        text = f"{change.state} by {word.who}, before {last.who} {last.what} it: {last.who} counts"
        register.keep(alarm, (alarm, [HistoryEntry(word.at_ns, "note", text, word.who)]))
        return
    try:
        register.keep(alarm, _applied(alarm, word, change.note))
    except lifecycle.AlarmStateError as error:  # it is over meanwhile, here or there
        text = f"{change.state}, but {error.what}"
        register.keep(alarm, (alarm, [HistoryEntry(word.at_ns, "note", text, word.who)]))


def _same(one: RobotWord, other: RobotWord) -> bool:
    return (one.state, one.said_ns, one.command) == (other.state, other.said_ns, other.command)


def _applied(alarm: Alarm, word: RobotWord, note: str) -> Step:
    """Return an alarm after what a person did at the robot, where one thing replaces the other."""
    if word.state == "acknowledged":
        if alarm.state == "shelved":
            alarm, _ = lifecycle.unshelved(alarm, word.who, word.at_ns)
        return lifecycle.acknowledged(alarm, word.who, word.at_ns, note)
    if word.state == "shelved":
        until_ns = _LATEST_NS if word.until_ns is None else word.until_ns
        return lifecycle.shelved(alarm, word.who, word.at_ns, until_ns, note)
    if word.state == "resolved":
        return lifecycle.resolved(alarm, word.who, word.at_ns, note)
    return lifecycle.unshelved(alarm, word.who, word.at_ns)


def agree(register: AlarmRegister, number: int, now_ns: int) -> None:
    """Tell the robot of an alarm what people want, where its last word is another one."""
    alarm = register.alarm(number)
    if alarm is None or alarm.kind != "robot" or alarm.merged_into is not None:
        return
    parts, connection = register.parts(number), register.connection
    words, last = _words(register, parts), _last_done(register, number)
    orders = record_orders.found(connection, alarm.robot, [_about(part) for part in parts])
    for part in parts:
        known = orders.get(_about(part))
        if part.active:
            wanted = _wanted(alarm, part, last, words.get(part.source), now_ns)
            if wanted is not None:
                _tell(register, alarm, part, known, wanted, now_ns)
        elif known is not None:
            record_orders.withdraw(connection, now_ns, part.robot, known.about)


def _wanted(
    alarm: Alarm, part: AlarmPart, last: HistoryEntry | None, word: RobotWord | None, now_ns: int
) -> AlarmCommand | None:
    """Return what the robot has to be told; None where it agrees."""
    state = None if word is None else word.state
    component, note = part.component, ""
    if last is not None and last.what == alarm.state:  # a shelf begins with its end
        note = _fitting(last.text.partition(": ")[2] if last.what == "shelved" else last.text)
    if alarm.state == "shelved" and alarm.shelved_until_ns is not None:
        until_ns = alarm.shelved_until_ns
        if until_ns <= now_ns + NS or (word is not None and _is_until(word, until_ns)):
            return None
        who = record_orders.person_label(alarm.shelved_by)
        for_s = record_orders.shelf_s(now_ns, until_ns)
        return AlarmShelve(component, for_s, who, note, part.source)
    if alarm.state == "acknowledged" and state != "acknowledged":
        who = record_orders.person_label(alarm.acknowledged_by)
        return AlarmAcknowledge(component, who, note, part.source)
    if alarm.state == "resolved" and alarm.resolved_by and state != "resolved":
        who = record_orders.person_label(alarm.resolved_by)
        return AlarmResolve(component, who, _fitting(alarm.resolution), part.source)
    is_shelved_there = word is not None and word.is_shelved(now_ns)
    if alarm.state == "open" and last is not None and last.what == "unshelved" and is_shelved_there:
        return AlarmUnshelve(component, record_orders.person_label(last.who), part.source)
    return None


def _is_until(word: RobotWord, until_ns: int) -> bool:
    """Return whether the alarm is on the robot's shelf for as long as here."""
    is_near = word.until_ns is not None and abs(word.until_ns - until_ns) <= _SHELF_NS
    return word.state == "shelved" and is_near


def _tell(
    register: AlarmRegister, alarm: Alarm, part: AlarmPart, known: RecordOrder | None,
    wanted: AlarmCommand, now_ns: int,
) -> None:  # fmt: skip
    """Order it, unless that was done already; a few times if it was undone there since."""
    until_ns = alarm.shelved_until_ns if isinstance(wanted, AlarmShelve) else None
    tries = 1
    if known is not None and _is_alike(known, wanted, until_ns):
        is_hopeless = known.state == "refused" or known.tries >= record_orders.MOST_TRIES
        if known.is_under_way or is_hopeless:
            return
        tries = known.tries + 1
    is_sent = record_orders.order(
        register.connection, now_ns, part.robot, _about(part), wanted, wanted.who, until_ns,
        tries=tries,
    )  # fmt: skip
    if is_sent:
        register.commanded.add(part.robot)


def _is_alike(known: RecordOrder, wanted: AlarmCommand, until_ns: int | None) -> bool:
    """Return whether an order was about the same; how long a shelf still lasts may differ."""
    before = known.wanted
    if isinstance(before, AlarmShelve) and isinstance(wanted, AlarmShelve):
        before = msgspec.structs.replace(before, for_s=wanted.for_s)
    return before == wanted and known.until_ns == until_ns


def _last_done(register: AlarmRegister, number: int) -> HistoryEntry | None:
    """Return what a person did last with an alarm."""
    h = HISTORY.c
    chosen = select(h.at_ns, h.what, h.text, h.who).where(
        h.alarm == number, h.what.in_(_DONE), h.who != ""
    )
    row = register.connection.execute(chosen.order_by(h.at_ns.desc(), h.number.desc()).limit(1))
    found = row.one_or_none()
    return None if found is None else HistoryEntry(*found)


def _words(register: AlarmRegister, parts: Sequence[AlarmPart]) -> Mapping[str, RobotWord]:
    """Return what the robot says of its alarms, by their ids there."""
    w = ALARM_WORD.c
    chosen = select(ALARM_WORD).where(
        w.robot.in_({part.robot for part in parts}), w.source.in_([part.source for part in parts])
    )
    rows = register.connection.execute(chosen).mappings()
    return {row["source"]: RobotWord(**row) for row in rows}


def _keep(register: AlarmRegister, word: RobotWord) -> None:
    row: Mapping[str, object] = asdict(replace(word, who=record_orders.person_label(word.who)))
    changed = [name for name in row if name not in ("robot", "source")]
    upsert_rows(register.connection, ALARM_WORD, [row], changed)


def _about(part: AlarmPart) -> str:
    return f"alarm:{part.source}"


def _fitting(text: str) -> str:
    """Return a note as a command can carry it."""
    return "".join(c for c in text if c.isprintable() or c in "\n\t")[:NOTE_LENGTH]


def _time(value: int) -> int:
    return min(max(value, 0), _LATEST_NS)
