"""What the robots of a team say themselves: the diagnoses in their own journals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from amberbox.blackbox.folder.folder import load_folder
from amberbox.blackbox.follow.newest import newest_records
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.store import Store, is_store, open_store
from amberbox.consult.case import Case, answered
from amberbox.consult.journal import was_watched
from amberbox.consult.knowledge import knowledge_of
from amberbox.consult.reading import watched
from amberbox.consult.telling import explained
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.diagnosis.explanation import Explanation
from amberbox.diagnosis.explanation.explanation import Group, Member, State
from amberbox.diagnosis.explanation.words import WORTH_TELLING, date_and_clock, sentence
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.monitoring.configuration import load_plan
from amberbox.monitoring.messages.board import WRITER

_LATE_NS = 10 * NS
"""A robot whose watcher is behind its team's so far has fallen silent."""


def with_members(
    knowledge: Knowledge, case: Case, explanation: Explanation | None
) -> Explanation | None:
    """Add to a team's explanation what the robots that it names say of that time.

    Only what their watchers have written is read; nothing of their records is evaluated.
    """
    if explanation is None or explanation.broken is None:
        return explanation
    names = _named(knowledge, (explanation.broken, *explanation.others))
    found = tuple(_member(name, knowledge.fmea.members[name], case.at_ns) for name in names)
    return replace(explanation, members=found)


def _named(knowledge: Knowledge, groups: Sequence[Group]) -> list[str]:
    """Return the robots of which something may be lost, the most probable first."""
    worth = (g for g in groups if g.probability >= WORTH_TELLING)
    faults = (f.id for g in worth for possible in g.members for f in possible.faults)
    robots = (fault.partition("#")[0].partition(":")[0] for fault in faults)
    return [name for name in dict.fromkeys(robots) if name in knowledge.fmea.members]


def _member(name: str, where: str, at_ns: int) -> Member:
    try:
        return _said(name, where, at_ns)
    except (AmberboxError, OSError) as error:
        lines = str(error).splitlines() or [""]
        return _nothing(name, where, f"its folder cannot be read: {lines[0]}")


def _said(name: str, where: str, at_ns: int) -> Member:
    """Return what a robot's watcher had written up to an instant of the same clock."""
    folder = load_folder(Path(where))
    plan, _ = load_plan(folder)
    knowledge, _ = knowledge_of(folder, plan)
    if knowledge is None:
        return _nothing(name, where, "it has no fmea.yaml that can be read")
    if not is_store(folder.store_path):
        return _nothing(name, where, f"{folder.store_path} is no store: nothing is recorded")
    store = open_store(folder.store_path)
    then_ns = min(at_ns, _said_ns(store))
    if at_ns - then_ns > _LATE_NS:
        since = f" since {date_and_clock(then_ns)}" if then_ns else ""
        return _nothing(name, where, f"its watcher has said nothing{since}")
    case = None
    if was_watched(store, knowledge.config_hash, then_ns):
        case = watched(knowledge, store, then_ns)
    if case is None:
        return _nothing(name, where, "nobody watched it then with the monitors that it has now")
    return _told(name, where, explained(knowledge, case, answered(knowledge, case)), then_ns)


def _said_ns(store: Store) -> int:
    """Return of when the newest is that a watcher has said; 0 if it never said anything."""
    newest = newest_records(store, WRITER, {reserved.STATUS}, 0.0)
    return max((record.values["measured_ns"] for record in newest), default=0)


def _told(name: str, where: str, own: Explanation | None, at_ns: int) -> Member:
    """Tell a robot's own explanation in short."""
    if own is None or own.state == "healed":
        text = "nothing is wrong with it"
        before = "" if own is None else f". {own.headline.rstrip('.')}"
        state: State = "none" if own is None else "healed"
        return Member(name, where, state, sentence(f"{text}{before}"), at_ns)
    return Member(
        name, where, "open", own.headline, own.at_ns, own.diagnosis, own.sure.probability,
        own.use.text, own.next.text,
    )  # fmt: skip


def _nothing(name: str, where: str, why: str) -> Member:
    return Member(name, where, "unknown", sentence(f"nothing is known of it: {why}"))
