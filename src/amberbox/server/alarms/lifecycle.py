"""The lifecycle of an alarm: pure functions of an alarm, a report or action, and a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Literal

from amberbox.core.api import AlarmState
from amberbox.core.errors import UsageError
from amberbox.core.robot_status import RANK, Severity
from amberbox.core.timestamps import format_to_second
from amberbox.server.alarms.alarm import (
    Alarm,
    AlarmPart,
    AlarmSettings,
    HistoryEntry,
    Step,
    decode_words,
    is_worse,
    worst,
)

OVER: Final = "over"
MERGED: Final = "merged"


class AlarmStateError(UsageError):
    """The action is not possible in the present state of the alarm."""


def updated_by_parts(
    alarm: Alarm, parts: Sequence[AlarmPart], now_ns: int, settings: AlarmSettings
) -> Step:
    """Update a robot's alarm from its parts."""
    lasting = [part for part in parts if part.active]
    alarm = _about_what_lasts(alarm, parts, lasting)
    root = [part for part in parts if part.component == alarm.origin] or list(parts)
    latest = max(root, key=lambda part: (part.active, part.changed_ns))
    named = next((part for part in [latest, *lasting] if part.diagnosis), None)
    count = max(1, sum(part.count for part in root))
    came_back = count > alarm.count or (bool(lasting) and not alarm.active)
    alarm, entries = _reopened(alarm, now_ns, settings) if came_back and lasting else (alarm, [])
    severity = worst([alarm.severity, *(part.severity for part in lasting)])
    changed = replace(
        alarm, count=max(count, alarm.count), reason=latest.reason, active=bool(lasting),
        level=max((part.level for part in lasting or root), key=lambda level: RANK[level]),
        cleared_ns=None if lasting else max(part.changed_ns for part in parts),
        changed_ns=max(alarm.changed_ns, *(part.changed_ns for part in parts)),
        cause=alarm.cause if named is None else named.cause,
    )  # fmt: skip
    if named is not None and named.diagnosis != alarm.diagnosis:
        changed = replace(changed, diagnosis=named.diagnosis, revised=0, effect="", words="")
    if changed.cause != alarm.cause:
        entries = [*entries, HistoryEntry(now_ns, "cause", changed.cause)]
        changed = replace(changed, revision=changed.revision + 1)
    worse, more = worsened(changed, changed.effect or severity, now_ns, settings)
    return worse, [*entries, *more]


def _about_what_lasts(
    alarm: Alarm, parts: Sequence[AlarmPart], lasting: Sequence[AlarmPart]
) -> Alarm:
    """Give an alarm the first active component as its origin if its present origin has recovered.

    Its origin and its reason are then of the same component.
    """
    is_over = any(part.component == alarm.origin for part in parts) and not any(
        part.component == alarm.origin for part in lasting
    )
    return replace(alarm, origin=lasting[0].component) if is_over and lasting else alarm


def revised(alarm: Alarm, revision: int) -> Alarm:
    """Set the revision of the diagnosis while the alarm is active; later it keeps the last one."""
    return replace(alarm, revised=revision) if alarm.active else alarm


def explained(
    alarm: Alarm, effect: Severity | Literal[""], words: str, now_ns: int, settings: AlarmSettings
) -> Step:
    """Apply the explanation of its diagnosis: severity of the effect, and words.

    The severity goes down only if the explanation is likely.
    """
    decoded = decode_words(words)
    if effect and not (decoded and decoded.is_likely):
        effect = worst([alarm.severity, effect])
    changed = replace(alarm, effect=effect, words=words)
    if not effect or effect == alarm.severity:
        return changed, []
    highest = alarm.worst or alarm.severity
    if alarm.active and is_worse(effect, highest):
        return worsened(changed, effect, now_ns, settings, "effect")
    entry = HistoryEntry(now_ns, "effect", f"{alarm.severity} -> {effect}")
    changed = replace(changed, severity=effect, worst=worst([highest, effect]))
    return replace(changed, revision=alarm.revision + 1), [entry]


def _reopened(alarm: Alarm, now_ns: int, settings: AlarmSettings) -> Step:
    """Reopen a resolved alarm; return any other unchanged."""
    if alarm.state != "resolved":
        return alarm, []
    notify_ns = None if alarm.told else now_ns + settings.ns("settle_s")
    again = replace(
        alarm, state="open", resolved_by="", resolved_ns=None, resolution="",
        acknowledged_by="", acknowledged_ns=None, shelved_by="", shelved_until_ns=None,
        notify_ns=notify_ns, revision=alarm.revision + 1,
    )  # fmt: skip
    return again, [HistoryEntry(now_ns, "reopened", "it came back")]


def worsened(
    alarm: Alarm, severity: Severity, now_ns: int, settings: AlarmSettings, what: str = "worse"
) -> Step:
    """Raise the severity; above the worst so far, void the acknowledgement and notify again.

    Up to the worst so far the acknowledgement holds.
    """
    if not is_worse(severity, alarm.severity):
        return alarm, []
    entry = HistoryEntry(now_ns, what, f"{alarm.severity} -> {severity}")
    if not is_worse(severity, alarm.worst or alarm.severity):
        return replace(alarm, severity=severity, revision=alarm.revision + 1), [entry]
    alarm, entries = _reopened(alarm, now_ns, settings)
    worse = replace(
        alarm, severity=severity, worst=severity,
        state="shelved" if alarm.state == "shelved" else "open",
        acknowledged_by="", acknowledged_ns=None, revision=alarm.revision + 1,
        notify_ns=alarm.notify_ns or now_ns + settings.ns("settle_s"),
    )  # fmt: skip
    return worse, [*entries, entry]


def lost_again(alarm: Alarm, reason: str, now_ns: int, settings: AlarmSettings) -> Step:
    """Update an alarm of offline robots: more are away, or they are away again."""
    again, entries = _reopened(alarm, now_ns, settings)
    changed = replace(again, active=True, cleared_ns=None, changed_ns=now_ns, reason=reason,
                      count=again.count + 1)  # fmt: skip
    return changed, [*entries, HistoryEntry(now_ns, "away", reason)]


def settled(alarm: Alarm, now_ns: int, settings: AlarmSettings) -> Step:
    """Resolve an alarm that has been inactive long enough, or unshelve one whose time is over."""
    if alarm.state == "resolved":
        return alarm, []
    if not alarm.active and alarm.cleared_ns is not None:
        over_ns = alarm.cleared_ns + settings.ns("quiet_s")
        if now_ns >= over_ns:
            times = "" if alarm.count == 1 else f", it came {alarm.count} times"
            closed = replace(
                alarm, state="resolved", resolved_ns=over_ns, resolution=OVER,
                revision=alarm.revision + 1,
            )  # fmt: skip
            return closed, [HistoryEntry(over_ns, "resolved", OVER + times)]
    until_ns = alarm.shelved_until_ns
    if alarm.state == "shelved" and until_ns is not None and now_ns >= until_ns:
        return _off_the_shelf(alarm, now_ns, ""), [
            HistoryEntry(now_ns, "unshelved", "its time is over")
        ]
    return alarm, []


def merged(keep: Alarm, gone: Alarm, origin: str, now_ns: int) -> tuple[Step, Step]:
    """Merge two alarms of the same root; ``keep`` stays, with its acknowledgement.

    It takes the owner of the other if it has none.
    """
    notified = keep.told if not is_worse(gone.told, keep.told) else gone.told
    effect = keep.effect or gone.effect
    severity = effect or worst([keep.severity, gone.severity])
    one = replace(
        keep, origin=origin, severity=severity, effect=effect, told=notified,
        owner=keep.owner or gone.owner,
        opened_ns=min(keep.opened_ns, gone.opened_ns), late=keep.late and gone.late,
        revision=keep.revision + 1,
    )  # fmt: skip
    if not keep.told and notified and not is_worse(severity, notified):
        one = replace(one, notify_ns=None)
    other = replace(
        gone, state="resolved", active=False, resolved_ns=now_ns, resolution=MERGED,
        cleared_ns=gone.cleared_ns or now_ns, merged_into=keep.number, notify_ns=None,
        revision=gone.revision + 1,
    )  # fmt: skip
    return (
        (
            one,
            [
                HistoryEntry(
                    now_ns, MERGED, f"{gone.origin} ({gone.number}) has the same root: {origin}"
                )
            ],
        ),
        (other, [HistoryEntry(now_ns, MERGED, f"part of {keep.number} now")]),
    )


def acknowledged(alarm: Alarm, who: str, now_ns: int, note: str = "", person: str = "") -> Step:
    """Acknowledge an alarm; raises AlarmStateError when it is resolved.

    If it has no owner, ``person`` becomes its owner.
    """
    _refuse_resolved(alarm, "acknowledged")
    state: AlarmState = "shelved" if alarm.state == "shelved" else "acknowledged"
    changed = replace(alarm, state=state, acknowledged_by=who, acknowledged_ns=now_ns,
                      owner=alarm.owner or person, notify_ns=None,
                      revision=alarm.revision + 1)  # fmt: skip
    return changed, [HistoryEntry(now_ns, "acknowledged", note, who)]


def shelved(alarm: Alarm, who: str, now_ns: int, until_ns: int, reason: str) -> Step:
    """Shelve an alarm until a time; raises AlarmStateError for a past time or a resolved alarm."""
    _refuse_resolved(alarm, "shelved")
    if until_ns <= now_ns:
        raise AlarmStateError("an alarm is shelved until a time to come", "say for instance now+2h")
    changed = replace(alarm, state="shelved", shelved_by=who, shelved_until_ns=until_ns,
                      revision=alarm.revision + 1)  # fmt: skip
    text = f"until {format_to_second(until_ns)}: {reason}"
    return changed, [HistoryEntry(now_ns, "shelved", text, who)]


def unshelved(alarm: Alarm, who: str, now_ns: int) -> Step:
    """Unshelve an alarm; raises AlarmStateError when it is not shelved."""
    if alarm.state != "shelved":
        raise AlarmStateError(f"the alarm {alarm.number} is not shelved")
    return _off_the_shelf(alarm, now_ns, who), [HistoryEntry(now_ns, "unshelved", "", who)]


def _off_the_shelf(alarm: Alarm, now_ns: int, who: str) -> Alarm:
    """Return the alarm in its state before shelving.

    When the time of shelving is over (no ``who``), a missing notification is due at once.
    """
    known = alarm.acknowledged_ns is not None
    is_unnotified = not known and not who and is_worse(alarm.severity, alarm.told) and alarm.active
    return replace(
        alarm, state="acknowledged" if known else "open", shelved_by="", shelved_until_ns=None,
        notify_ns=now_ns if is_unnotified else alarm.notify_ns, revision=alarm.revision + 1,
    )  # fmt: skip


def owned(alarm: Alarm, who: str, now_ns: int, owner: str) -> Step:
    """Assign an owner; an empty name removes the owner."""
    _refuse_resolved(alarm, "given to somebody")
    changed = replace(alarm, owner=owner, revision=alarm.revision + 1)
    return changed, [HistoryEntry(now_ns, "owned", owner or "nobody", who)]


def noted(alarm: Alarm, who: str, now_ns: int, text: str) -> Step:
    """Add a note to the history."""
    return replace(alarm, revision=alarm.revision + 1), [HistoryEntry(now_ns, "note", text, who)]


def resolved(alarm: Alarm, who: str, now_ns: int, reason: str) -> Step:
    """Resolve an alarm by hand; it reopens if the robot reports the fault again."""
    _refuse_resolved(alarm, "resolved")
    changed = replace(
        alarm, state="resolved", resolved_by=who, resolved_ns=now_ns, resolution=reason,
        shelved_by="", shelved_until_ns=None, notify_ns=None, revision=alarm.revision + 1,
    )  # fmt: skip
    return changed, [HistoryEntry(now_ns, "resolved", reason, who)]


def notified(alarm: Alarm, now_ns: int) -> Step:
    """Record that a notification was queued."""
    changed = replace(alarm, told=alarm.severity, notify_ns=None)
    return changed, [HistoryEntry(now_ns, "notified", alarm.severity)]


def _refuse_resolved(alarm: Alarm, what: str) -> None:
    if alarm.state == "resolved":
        hint = f"look at alarm {alarm.merged_into}" if alarm.merged_into else "it opens by itself"
        raise AlarmStateError(f"the alarm {alarm.number} is over: it cannot be {what}", hint)
