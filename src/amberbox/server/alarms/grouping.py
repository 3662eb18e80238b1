"""Grouping of reports into alarms: one per root cause, in any order of the reports."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from sqlalchemy import RowMapping, select

from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.notes import RecordedNote
from amberbox.core.types import Diagnosis
from amberbox.monitoring.alarms import FOLLOWS
from amberbox.monitoring.findings import AlarmChange, Transition
from amberbox.server.alarms import lifecycle
from amberbox.server.alarms.agreement import agree, take_word
from amberbox.server.alarms.alarm import (
    Alarm,
    AlarmExplanation,
    AlarmPart,
    AlarmSettings,
    HistoryEntry,
    encode_words,
)
from amberbox.server.alarms.reports import AlarmReport
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.annotations import take_note
from amberbox.server.database import upsert
from amberbox.server.knowledge.explanations import take_answer
from amberbox.server.schema import ALARM, CONSEQUENCE

_MOST = 100
"""Maximum number of names in a list of blocking components."""


def note_blocked(register: AlarmRegister, report: AlarmReport, transition: Transition) -> None:
    """Store a transition of a component, unless a later one is stored."""
    if transition.mode:
        return
    component = transition.component[:128]
    known = register.blocked(report.robot).get(component)
    same = known is not None and known["store_id"] == report.store_id
    if known is not None and same and (report.run, report.seq) <= (known["run"], known["seq"]):
        return
    register.keep_blocked({
        "robot": report.robot, "component": component, "level": transition.after.level,
        "blocked_by": json.dumps([name[:128] for name in transition.blocked_by[:_MOST]]),
        "reason": transition.reason,
        "since_ns": min(max(transition.at_ns + report.offset_ns, 0), 1 << 62),
        "store_id": report.store_id, "run": report.run, "seq": report.seq,
    })  # fmt: skip


def root_of(register: AlarmRegister, robot: str, origin: str) -> AlarmPart | None:
    """Return the active part of a component, or of the nearest active one that blocks it."""
    lasting = {part.component: part for part in register.lasting(robot)}
    blocked = register.blocked(robot)
    waiting, seen = [origin], {origin}
    while waiting:
        name = waiting.pop(0)
        if name in lasting:
            return lasting[name]
        new = [by for by in _blockers(blocked, name) if by not in seen]
        waiting += new
        seen.update(new)
    return None


def _blockers(blocked: Mapping[str, Any], name: str) -> list[str]:
    row = blocked.get(name)
    return [] if row is None else list(json.loads(row["blocked_by"]))


def show_consequences(register: AlarmRegister, robot: str) -> None:
    """Update the consequences of each unresolved alarm of a robot."""
    blocked = register.blocked(robot)
    open_ones = register.alarms(
        ALARM.c.robot == robot, ALARM.c.state != "resolved", ALARM.c.kind == "robot"
    )
    for alarm in open_ones:
        parts = register.parts(alarm.number)
        own = {part.component for part in parts if part.component == alarm.origin}
        found = _below(own, blocked) if alarm.active else {}
        for part in parts:
            if part.component not in own and part.active:
                found[part.component] = (part.level, part.reason, part.opened_ns)
            elif part.component not in own and alarm.active and _still_fails(part, blocked):
                row = blocked[part.component]
                found[part.component] = (row["level"], row["reason"], row["since_ns"])
        _keep(register, alarm, found, blocked)


def _still_fails(part: AlarmPart, blocked: Mapping[str, Any]) -> bool:
    """Return whether the last known level of a part's component is warn, stale or error."""
    row = blocked.get(part.component)
    return row is not None and row["level"] in ("warn", "stale", "error")


def _below(roots: set[str], blocked: Mapping[str, Any]) -> dict[str, tuple[str, str, int]]:
    """Return the components that are directly or indirectly blocked by the roots.

    Each with its level, its reason and since when (ns).
    """
    found: dict[str, tuple[str, str, int]] = {}
    grown = True
    while grown:
        grown = False
        for name, row in blocked.items():
            if name in found or name in roots or row["level"] == "ok":
                continue
            by = set(json.loads(row["blocked_by"]))
            if by & (roots | found.keys()):
                found[name] = (row["level"], row["reason"], row["since_ns"])
                grown = True
    return found


def _keep(
    register: AlarmRegister, alarm: Alarm, found: Mapping[str, tuple[str, str, int]],
    blocked: Mapping[str, Any],
) -> None:  # fmt: skip
    """Store the consequences of an alarm, and the end of those that are over."""
    chosen = select(CONSEQUENCE).where(CONSEQUENCE.c.alarm == alarm.number)
    known = {row["component"]: row for row in register.connection.execute(chosen).mappings()}
    rows = [
        {"alarm": alarm.number, "component": name, "level": level, "reason": reason[:2000],
         "from_ns": _beginning(known.get(name), from_ns), "to_ns": None}
        for name, (level, reason, from_ns) in found.items()
    ]  # fmt: skip
    rows += [{**row, "to_ns": _end(alarm, row, blocked.get(name))} for name, row in known.items()
             if name not in found and row["to_ns"] is None]  # fmt: skip
    changed = [row for row in rows if row != dict(known.get(row["component"], {}))]
    if changed:
        change = ("level", "reason", "from_ns", "to_ns")
        statement = upsert(register.connection.dialect, CONSEQUENCE, ("alarm", "component"), change)
        register.connection.execute(statement, changed)
        register.touched.add(alarm.number)


def _beginning(known: RowMapping | None, from_ns: int) -> int:
    """Return since when (ns) a consequence lasts; a change of its state is no new beginning."""
    lasts = known is not None and known["to_ns"] is None
    return min(known["from_ns"], from_ns) if known is not None and lasts else from_ns


def _end(alarm: Alarm, row: RowMapping, now: RowMapping | None) -> int:
    """Return when (ns) a consequence ended: at its own last transition, or with the alarm.

    Never before it began: the last change of the alarm can be older than that.
    """
    begun_ns: int = row["from_ns"]
    ends = [] if now is None else [now["since_ns"]]
    if not alarm.active:
        ends.append(alarm.changed_ns if alarm.cleared_ns is None else alarm.cleared_ns)
    return min(
        (at_ns for at_ns in ends if at_ns > begun_ns), default=max(begun_ns, alarm.changed_ns)
    )


_SURE = 0.5
"""A diagnosis that is less probable than this does not make one alarm of two."""
_LATEST_NS = 1 << 62
_NAMED = 100
"""Maximum number of components of a diagnosis that are considered."""


def apply_reports(
    register: AlarmRegister, reported: Iterable[AlarmReport], now_ns: int, settings: AlarmSettings
) -> set[int]:
    """Apply reports in order; return the numbers of the alarms that changed."""
    robots: set[str] = set()
    heard: set[tuple[str, str]] = set()
    for report in reported:
        robots.add(report.robot)
        if isinstance(report.content, AlarmChange):
            _take_alarm(register, report, report.content, now_ns, settings)
            heard.add((report.robot, report.content.id))
        elif isinstance(report.content, RecordedAnswer):
            if take_answer(register.connection, now_ns, report, report.content):
                register.commanded.add(report.robot)
        elif isinstance(report.content, RecordedNote):
            take_note(register.connection, report.robot, report.content)
        elif isinstance(report.content, Diagnosis):
            _take_diagnosis(register, report.robot, report.content, now_ns, settings)
            _join(register, report.robot, report.content.id, now_ns, settings)
        else:
            note_blocked(register, report, report.content)
    for robot in robots:
        show_consequences(register, robot)
    parts = [register.part(robot, source[:128]) for robot, source in sorted(heard)]
    for number in sorted({part.alarm for part in parts if part is not None}):
        agree(register, number, now_ns)
    return register.touched


def _take_alarm(
    register: AlarmRegister,
    report: AlarmReport,
    change: AlarmChange,
    now_ns: int,
    settings: AlarmSettings,
) -> None:
    known = register.part(report.robot, change.id)
    if known is not None and not _is_newer(report, change, known):
        return
    part = _part_of(report, change, 0 if known is None else known.alarm)
    if known is None:
        part = _housed(register, report, part, now_ns, settings)
    register.keep_part(part)
    _judge(register, part.alarm, now_ns, settings, late=report.late)
    take_word(register, report, change, part, now_ns)
    if not part.active and change.reason.startswith(FOLLOWS):
        _follow(register, part, change.reason.removeprefix(FOLLOWS), now_ns, settings)
    elif part.diagnosis and part.active:
        _join(register, report.robot, part.diagnosis, now_ns, settings)


def _is_newer(report: AlarmReport, change: AlarmChange, known: AlarmPart) -> bool:
    """Return whether a report is newer than the known part.

    Positions decide within one store, times of change between different stores.
    """
    if report.store_id == known.store_id:
        return (report.run, report.seq) > (known.run, known.seq)
    return _time(change.changed_ns + report.offset_ns) >= known.changed_ns


def _part_of(report: AlarmReport, change: AlarmChange, alarm: int) -> AlarmPart:
    return AlarmPart(
        report.robot, change.id[:128], alarm, change.component[:128], change.severity, change.level,
        change.reason, change.cause, change.diagnosis, change.state != "healed",
        _time(change.opened_ns + report.offset_ns), _time(change.changed_ns + report.offset_ns),
        _time(change.count), report.store_id, report.run, report.seq,
    )  # fmt: skip


def _time(value: int) -> int:
    return min(max(value, 0), _LATEST_NS)


def _housed(
    register: AlarmRegister,
    report: AlarmReport,
    part: AlarmPart,
    now_ns: int,
    settings: AlarmSettings,
) -> AlarmPart:
    """Assign a robot's new alarm to an existing alarm, or open one; return the part."""
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
    entry = HistoryEntry(part.opened_ns, "opened", part.reason)
    added = register.add(alarm, [(part.robot, part.opened_ns)], entry)
    return replace(part, alarm=added.number)


def _unresolved(register: AlarmRegister, part: AlarmPart, settings: AlarmSettings) -> Alarm | None:
    """Return the unresolved alarm that already contains this component.

    An alarm that has been inactive for long enough is resolved first. An alarm about another
    component counts only while it is active: a later failure is another fault.
    """
    for other in register.of_component(part.robot, part.component):
        alarm = register.alarm(other.alarm)
        if alarm is None:
            continue
        kept = register.keep(alarm, lifecycle.settled(alarm, part.opened_ns, settings))
        if kept.state != "resolved" and (kept.active or kept.origin == part.component):
            return kept
    return None


def _last(register: AlarmRegister, part: AlarmPart, settings: AlarmSettings) -> Alarm | None:
    """Return the last alarm of the component if the new part begins soon enough after its end."""
    last = register.newest(part.robot, part.component, "robot")
    if last is None:
        return None
    ended_ns = last.cleared_ns if last.cleared_ns is not None else last.resolved_ns
    soon = ended_ns is not None and abs(part.opened_ns - ended_ns) <= settings.ns("reopen_s")
    return last if soon else None


def _end_others(register: AlarmRegister, number: int, part: AlarmPart) -> None:
    """End other active parts of the component: a robot has one alarm per component at a time."""
    for other in register.parts(number):
        if other.active and other.component == part.component:
            register.keep_part(replace(other, active=False, changed_ns=part.opened_ns))


def _judge(
    register: AlarmRegister, number: int, now_ns: int, settings: AlarmSettings, *, late: bool
) -> None:
    alarm = register.alarm(number)
    if alarm is None:
        return
    changed, entries = lifecycle.updated_by_parts(alarm, register.parts(number), now_ns, settings)
    if changed.active and not late:
        changed = replace(changed, late=False)
    kept = register.keep(alarm, (changed, entries))
    if kept.active and kept.diagnosis and not (kept.revised and alarm.active):
        _follow_diagnosis(register, kept, now_ns, settings)
    register.touched.add(number)


def _follow(
    register: AlarmRegister, part: AlarmPart, origin: str, now_ns: int, settings: AlarmSettings
) -> None:
    """Move a part, or merge its alarm, into the alarm of the component that caused it."""
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


def _is_other(register: AlarmRegister, part: AlarmPart) -> bool:
    """Return whether the alarm of a part is about another component, which is one of its parts."""
    alarm = register.alarm(part.alarm)
    others = [one.component for one in register.parts(part.alarm) if one.source != part.source]
    return alarm is not None and alarm.origin != part.component and alarm.origin in others


def _merge(
    register: AlarmRegister, numbers: list[int], origin: str, now_ns: int, settings: AlarmSettings
) -> None:
    """Merge alarms of one root into the oldest of them."""
    keep = register.alarm(numbers[0])
    for number in numbers[1:]:
        gone = register.alarm(number)
        if keep is None or gone is None or "resolved" in (keep.state, gone.state):
            continue
        one, other = lifecycle.merged(keep, gone, origin, now_ns)
        register.move_parts(keep.number, number)
        keep = register.keep(keep, one)
        register.keep(gone, other)
    if keep is not None:
        _judge(register, keep.number, now_ns, settings, late=keep.late)


def apply_explanation(
    register: AlarmRegister, explanation: AlarmExplanation, now_ns: int, settings: AlarmSettings
) -> None:
    """Store the explanation of a diagnosis, and apply it to the alarms that hold this revision."""
    text = encode_words(explanation.words)
    register.keep_words(explanation.robot, explanation.diagnosis[:128], explanation.effect, text)
    for alarm in _explained_by(register, explanation.robot, explanation.diagnosis):
        if alarm.revised == explanation.revision:
            step = lifecycle.explained(alarm, explanation.effect, text, now_ns, settings)
            register.keep(alarm, step)


def _explained_by(register: AlarmRegister, robot: str, diagnosis: str) -> list[Alarm]:
    return register.alarms(
        ALARM.c.robot == robot, ALARM.c.diagnosis == diagnosis[:128], ALARM.c.kind == "robot",
        ALARM.c.merged_into.is_(None),
    )  # fmt: skip


def _follow_diagnosis(
    register: AlarmRegister, alarm: Alarm, now_ns: int, settings: AlarmSettings
) -> None:
    """Apply what is already stored about the diagnosis of an alarm."""
    roots = register.roots(alarm.robot, alarm.diagnosis)
    if roots is None:
        return
    alarm = register.keep(alarm, (lifecycle.revised(alarm, roots["revision"]), []))
    if roots["words"]:
        step = lifecycle.explained(alarm, roots["effect"], roots["words"], now_ns, settings)
        register.keep(alarm, step)


def _take_diagnosis(
    register: AlarmRegister, robot: str, diagnosis: Diagnosis, now_ns: int, settings: AlarmSettings
) -> None:
    """Store the failed component of a diagnosis, if the leading hypotheses agree on one each."""
    answers = diagnosis.leading()
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
                register.keep(alarm, (lifecycle.revised(alarm, revision), []))


def _join(
    register: AlarmRegister, robot: str, diagnosis: str, now_ns: int, settings: AlarmSettings
) -> None:
    """Merge the alarms that a diagnosis traces to one component."""
    roots = register.roots(robot, diagnosis[:128])
    if roots is None or roots["probability"] < _SURE:
        return
    names = json.loads(roots["components"])
    parts = [part for part in register.lasting(robot) if part.diagnosis == diagnosis]
    if len({part.cause for part in parts}) > 1:  # the robot reports different causes
        return
    numbers = sorted({part.alarm for part in parts})
    if not names or len(numbers) < 2:
        return
    first = register.alarm(numbers[0])
    known = [part.component for part in parts if part.component in names]
    if first is not None:
        _merge(register, numbers, known[0] if known else first.origin, now_ns, settings)
