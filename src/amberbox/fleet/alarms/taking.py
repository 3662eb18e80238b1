"""Take what robots say: one alarm per root, whatever order its parts become known in."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace

from amberbox.core.types import Diagnosis
from amberbox.fleet.alarms import machine
from amberbox.fleet.alarms.alarm import Alarm, Entry, Part
from amberbox.fleet.alarms.consequences import note_blocked, root_of, show_consequences
from amberbox.fleet.alarms.register import Register
from amberbox.fleet.alarms.reports import Report
from amberbox.fleet.alarms.settings import AlarmSettings
from amberbox.fleet.alarms.tables import ALARM
from amberbox.fleet.alarms.words import Explanation, written
from amberbox.monitoring.engine.alarms import FOLLOWS
from amberbox.monitoring.engine.findings import AlarmChange
from amberbox.monitoring.watcher.leading import leading

_SURE = 0.5
"""A diagnosis that is less probable than this does not make one alarm of two."""
_LATEST_NS = 1 << 62
_NAMED = 100
"""Components that a diagnosis may blame; more are not of use to anybody."""


def take(
    register: Register, told: Iterable[Report], now_ns: int, settings: AlarmSettings
) -> set[int]:
    """Take reports in order; return the numbers of the alarms that are others than before."""
    robots: set[str] = set()
    for report in told:
        robots.add(report.robot)
        if isinstance(report.told, AlarmChange):
            _take_alarm(register, report, report.told, now_ns, settings)
        elif isinstance(report.told, Diagnosis):
            _take_diagnosis(register, report.robot, report.told, now_ns, settings)
            _join(register, report.robot, report.told.id, now_ns, settings)
        else:
            note_blocked(register, report, report.told)
    for robot in robots:
        show_consequences(register, robot)
    return register.touched


def _take_alarm(
    register: Register, report: Report, told: AlarmChange, now_ns: int, settings: AlarmSettings
) -> None:
    known = register.part(report.robot, told.id)
    if known is not None and not _is_newer(report, told, known):
        return
    part = _part_of(report, told, 0 if known is None else known.alarm)
    if known is None:
        part = _housed(register, report, part, now_ns, settings)
    register.keep_part(part)
    _judge(register, part.alarm, now_ns, settings, late=report.late)
    if not part.active and told.reason.startswith(FOLLOWS):
        _follow(register, part, told.reason.removeprefix(FOLLOWS), now_ns, settings)
    elif part.diagnosis and part.active:
        _join(register, report.robot, part.diagnosis, now_ns, settings)


def _is_newer(report: Report, told: AlarmChange, known: Part) -> bool:
    """Compare positions in one store; of another store the times, as both say them."""
    if report.store_id == known.store_id:
        return (report.run, report.seq) > (known.run, known.seq)
    return _time(told.changed_ns + report.offset_ns) >= known.changed_ns


def _part_of(report: Report, told: AlarmChange, alarm: int) -> Part:
    return Part(
        report.robot, told.id[:128], alarm, told.component[:128], told.severity, told.level,
        told.reason, told.cause, told.diagnosis, told.state != "healed",
        _time(told.opened_ns + report.offset_ns), _time(told.changed_ns + report.offset_ns),
        _time(told.count), report.store_id, report.run, report.seq,
    )  # fmt: skip


def _time(value: int) -> int:
    return min(max(value, 0), _LATEST_NS)


def _housed(
    register: Register, report: Report, part: Part, now_ns: int, settings: AlarmSettings
) -> Part:
    """Find the alarm that a new alarm of a robot belongs to, or open one."""
    found = _unresolved(register, part, settings) or _last(register, part, settings)
    if found is not None:
        _end_others(register, found.number, part)
        return replace(part, alarm=found.number)
    notify_ns = now_ns + settings.ns("settle_s") if part.active else None
    alarm = Alarm(
        0, "robot", part.robot, part.component, part.severity, part.level, part.reason,
        part.opened_ns, part.changed_ns, part.cause, part.diagnosis, active=part.active,
        count=max(1, part.count), late=report.late, notify_ns=notify_ns,
    )  # fmt: skip
    entry = Entry(part.opened_ns, "opened", part.reason)
    added = register.add(alarm, [(part.robot, part.opened_ns)], entry)
    return replace(part, alarm=added.number)


def _unresolved(register: Register, part: Part, settings: AlarmSettings) -> Alarm | None:
    """Return the alarm that has this component already; one that had been over is resolved.

    An alarm about another component has it only while it lasts: what comes later is another fault.
    """
    for other in register.of_component(part.robot, part.component):
        alarm = register.alarm(other.alarm)
        if alarm is None:
            continue
        kept = register.keep(alarm, machine.settled(alarm, part.opened_ns, settings))
        if kept.state != "resolved" and (kept.active or kept.origin == part.component):
            return kept
    return None


def _last(register: Register, part: Part, settings: AlarmSettings) -> Alarm | None:
    """Return the last alarm of the component, if this one comes soon enough after its end."""
    last = register.newest(part.robot, part.component, "robot")
    if last is None:
        return None
    ended_ns = last.cleared_ns if last.cleared_ns is not None else last.resolved_ns
    soon = ended_ns is not None and abs(part.opened_ns - ended_ns) <= settings.ns("reopen_s")
    return last if soon else None


def _end_others(register: Register, number: int, part: Part) -> None:
    """End what a robot forgot to end: of a component it has one alarm at a time."""
    for other in register.parts(number):
        if other.active and other.component == part.component:
            register.keep_part(replace(other, active=False, changed_ns=part.opened_ns))


def _judge(
    register: Register, number: int, now_ns: int, settings: AlarmSettings, *, late: bool
) -> None:
    alarm = register.alarm(number)
    if alarm is None:
        return
    changed, entries = machine.judged(alarm, register.parts(number), now_ns, settings)
    if changed.active and not late:
        changed = replace(changed, late=False)
    kept = register.keep(alarm, (changed, entries))
    if kept.active and kept.diagnosis and not (kept.revised and alarm.active):
        _follow_diagnosis(register, kept, now_ns, settings)
    register.touched.add(number)


def _follow(
    register: Register, part: Part, origin: str, now_ns: int, settings: AlarmSettings
) -> None:
    """Fold an alarm into that of the component which turned out to be to blame."""
    root = root_of(register, part.robot, origin)
    if root is not None and root.alarm != part.alarm and _is_other(register, part):
        register.keep_part(replace(part, alarm=root.alarm))
        _judge(register, root.alarm, now_ns, settings, late=False)
    elif root is not None and root.alarm != part.alarm:
        _merge(register, sorted((root.alarm, part.alarm)), root.component, now_ns, settings)
    elif root is not None:
        alarm = register.alarm(part.alarm)
        if alarm is not None and alarm.origin == part.component:
            register.keep(alarm, (replace(alarm, origin=root.component), []))
            _judge(register, part.alarm, now_ns, settings, late=alarm.late)


def _is_other(register: Register, part: Part) -> bool:
    """Tell whether a part belongs to an alarm that is about another component."""
    alarm = register.alarm(part.alarm)
    others = [one.component for one in register.parts(part.alarm) if one.source != part.source]
    return alarm is not None and alarm.origin != part.component and alarm.origin in others


def _merge(
    register: Register, numbers: list[int], origin: str, now_ns: int, settings: AlarmSettings
) -> None:
    """Make one alarm of some: the oldest stays."""
    keep = register.alarm(numbers[0])
    for number in numbers[1:]:
        gone = register.alarm(number)
        if keep is None or gone is None or "resolved" in (keep.state, gone.state):
            continue
        one, other = machine.merged(keep, gone, origin, now_ns)
        register.move_parts(keep.number, number)
        keep = register.keep(keep, one)
        register.keep(gone, other)
    if keep is not None:
        _judge(register, keep.number, now_ns, settings, late=keep.late)


def take_explanation(
    register: Register, told: Explanation, now_ns: int, settings: AlarmSettings
) -> None:
    """Keep what a diagnosis means, with it and with the alarms of which it was the last word."""
    text = written(told.words)
    register.keep_words(told.robot, told.diagnosis[:128], told.effect, text)
    for alarm in _explained_by(register, told.robot, told.diagnosis):
        if alarm.revised == told.revision:
            step = machine.explained(alarm, told.effect, text, now_ns, settings)
            register.keep(alarm, step)


def _explained_by(register: Register, robot: str, diagnosis: str) -> list[Alarm]:
    return register.alarms(
        ALARM.c.robot == robot, ALARM.c.diagnosis == diagnosis[:128], ALARM.c.kind == "robot",
        ALARM.c.merged_into.is_(None),
    )  # fmt: skip


def _follow_diagnosis(
    register: Register, alarm: Alarm, now_ns: int, settings: AlarmSettings
) -> None:
    """Take what is known of the diagnosis of an alarm already."""
    roots = register.roots(alarm.robot, alarm.diagnosis)
    if roots is None:
        return
    alarm = register.keep(alarm, (machine.revised(alarm, roots["revision"]), []))
    if roots["words"]:
        step = machine.explained(alarm, roots["effect"], roots["words"], now_ns, settings)
        register.keep(alarm, step)


def _take_diagnosis(
    register: Register, robot: str, diagnosis: Diagnosis, now_ns: int, settings: AlarmSettings
) -> None:
    """Note which component has failed, if the leading answer says one."""
    answers = leading(diagnosis)
    failed = [{fault.partition("#")[0] for fault in answer.faults} for answer in answers]
    single = bool(failed) and all(len(components) == 1 for components in failed)
    names = sorted(set().union(*failed)) if single and diagnosis.state == "open" else []
    names = [name[:128] for name in names[:_NAMED]]
    share = diagnosis.groups[0].probability if diagnosis.groups else sum(
        answer.probability for answer in answers
    )  # fmt: skip
    revision = _time(diagnosis.revision)
    register.keep_roots(robot, diagnosis.id[:128], revision, names, share)
    if diagnosis.state == "open":
        for alarm in _explained_by(register, robot, diagnosis.id):
            if revision > alarm.revised:
                register.keep(alarm, (machine.revised(alarm, revision), []))


def _join(
    register: Register, robot: str, diagnosis: str, now_ns: int, settings: AlarmSettings
) -> None:
    """Make one alarm of those that a diagnosis says come from one component."""
    roots = register.roots(robot, diagnosis[:128])
    if roots is None or roots["probability"] < _SURE:
        return
    names = json.loads(roots["components"])
    parts = [part for part in register.lasting(robot) if part.diagnosis == diagnosis]
    if len({part.cause for part in parts}) > 1:  # the robot tells their causes apart
        return
    numbers = sorted({part.alarm for part in parts})
    if not names or len(numbers) < 2:
        return
    first = register.alarm(numbers[0])
    known = [part.component for part in parts if part.component in names]
    if first is not None:
        _merge(register, numbers, known[0] if known else first.origin, now_ns, settings)
