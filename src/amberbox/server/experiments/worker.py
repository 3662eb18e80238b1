"""Worker operation on runs: the report of one, from its events and the robot's record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.experiments.criteria import LOOKBACK_NS
from amberbox.experiments.procedure import procedure_of
from amberbox.experiments.report import RunReport, make_report
from amberbox.experiments.run import ExperimentRun
from amberbox.server.archive.catalogue import PUT, ArchiveCatalogue
from amberbox.server.data.snapshot import READ_BYTES, SnapshotRecord, open_catalogue
from amberbox.server.experiments import runs
from amberbox.server.experiments.shelf import PLACE, read_kept, unit_test
from amberbox.server.live.records import clock_offsets_ns
from amberbox.server.schema import EXPERIMENT_RUN, JOURNALS


def report(folder: Path, arguments: dict[str, Any]) -> bytes:
    """Return the report of a run (``run``: its id) as JSON of ``RunReport``.

    With ``whole`` it is empty as long as the end of the record is missing; ``late``: its last
    second may be missing. ``step_ns`` is how far the server's wall clock is ahead of the time of
    runs.
    """
    catalogue = open_catalogue(folder)
    with catalogue.database.reading() as connection:
        stored = runs.find(connection, str(arguments["run"]))
        assert stored is not None, "the caller has found it"
        kept = connection.execute(
            select(EXPERIMENT_RUN.c.kept).where(EXPERIMENT_RUN.c.id == stored.id)
        ).scalar_one()
        ahead_ns = clock_offsets_ns(connection, [stored.robot]).get(stored.robot, 0)
    ahead_ns = 0 if stored.at_robot else ahead_ns - int(arguments.get("step_ns", 0))
    if not kept:
        what = "what has happened in this run is not here: its experiment is not known any more"
        raise UsageError(what, "at the robot: amberbox experiment show FOLDER RUN")
    if stored.kind == "unit_test":
        procedure = unit_test(stored.name)
    else:
        procedure = procedure_of(read_kept(folder / PLACE / stored.sha256, stored.name))
    run = ExperimentRun.restore(procedure, bytes(kept))
    begin_ns, end_ns = (run.events[at].at_ns - ahead_ns for at in (0, -1))
    history_ns = max((one.history_ns for one in procedure.options.criteria), default=0)
    span = begin_ns - LOOKBACK_NS - history_ns, end_ns
    if arguments.get("whole") and not _is_there(
        catalogue, stored.robot, span, is_late=bool(arguments.get("late"))
    ):
        return b""
    record = SnapshotRecord(folder, catalogue, (stored.robot,), span=span)
    found: RunReport = make_report(procedure, run.events, record, -ahead_ns)
    return found.to_json()


def _is_there(
    catalogue: ArchiveCatalogue, robot: str, span: tuple[int, int], *, is_late: bool
) -> bool:
    """Return whether a robot's record is there to the end of a span, and can be read at once.

    The recorder writes main journals at least once a second, those of bulk only with a message.
    ``is_late``: the last second may be missing.
    """
    c = JOURNALS.c
    chosen = select(c.writer, c.state, c.bytes, c.start_ns, c.end_ns)
    chosen = chosen.where(c.robot == robot, c.end_ns >= span[0], c.raw_gone.is_(False))
    with catalogue.database.reading() as connection:
        journals = connection.execute(chosen).all()
    ends_ns: dict[str, int] = {}
    for row in journals:
        ends_ns[row.writer] = max(ends_ns.get(row.writer, 0), row.end_ns)
    waiting = (row for row in journals if row.state == PUT and row.start_ns <= span[1])
    if ends_ns.get("main", 0) < span[1] - (NS if is_late else 0):
        return False
    is_bulk_there = is_late or ends_ns.get("bulk", span[1]) >= span[1] - 2 * NS
    return is_bulk_there and sum(row.bytes for row in waiting) <= READ_BYTES
