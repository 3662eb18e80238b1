"""What an earlier run left behind: how far it reaches, what is damaged, what was not finished."""

from __future__ import annotations

from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.follow.read import JournalFile, holes, newest_first
from amberbox.blackbox.recorder.pipeline import Pipeline
from amberbox.blackbox.store import Store


def previous_end_ns(store: Store) -> int | None:
    """Corrected time up to which an earlier run recorded; None if there was none."""
    ends = [j.end_ns + (j.clock[-1][1] if j.clock else 0) for j in _last_files(store) if j.rows]
    return max(ends, default=None)


def report_recovery(pipeline: Pipeline) -> None:
    """Write an event for each journal that an earlier run left unfinished or damaged."""
    for journal in _last_files(pipeline.store):
        if not journal.finished or journal.damage:
            _report(pipeline, journal)


def _last_files(store: Store) -> list[JournalFile]:
    """Return each writer's last file with messages, and what came after it without any."""
    found: list[JournalFile] = []
    for writer in RECORDED:
        for journal in newest_first(store, writer):
            found.append(journal)
            if journal.rows:
                break
    return found


def _report(pipeline: Pipeline, journal: JournalFile) -> None:
    text = f"{journal.name} was not finished; {journal.rows} messages are there"
    if journal.damage:
        size = sum(damage.to_offset - damage.from_offset for damage in journal.damage)
        text += f", {size} bytes are not"
    pipeline.event(
        "recovered", text, file=journal.name, rows=journal.rows,
        damage=[(d.from_offset, d.to_offset, d.reason) for d in journal.damage],
        missing=[(gap.from_seq, gap.to_seq) for gap in holes(journal)],
        end_seq=journal.end_seq, end_ns=journal.end_ns,
    )  # fmt: skip
