"""Retention: what is older than its rule goes, journals and columns apart; incidents stay."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any

from sqlalchemy import Row

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.gather import Request, gather
from amberbox.blackbox.query.tabletext import plain
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.blackbox.segments.manifest import is_kept
from amberbox.core.clock import NS
from amberbox.core.names import identifier
from amberbox.fleet.archive.catalogue import COMMITTED, Catalogue, Source
from amberbox.fleet.archive.files import Layout, tables_of
from amberbox.fleet.archive.log import LiveFile
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.archive.segments import joined, segment_at
from amberbox.fleet.archive.store import OWN, Retention
from amberbox.fleet.data.remarks import pinned as marked

DATA = ("main", "bulk", "ring")
"""Classes that a rule for ``*`` is about."""
_DAY_NS = 24 * 3600 * NS
_RELEASED = "released"


def retain(layout: Layout, catalogue: Catalogue, rules: Sequence[Retention], now_ns: int) -> int:
    """Delete by the rules; what is to go is in the catalogue before anything goes.

    Whole days (UTC) go, so that files are not written anew for every journal. Return how many
    journals it concerned.
    """
    pinned = {
        source: [*_windows(layout, catalogue, source), *marked(catalogue.database, source.robot)]
        for source in catalogue.sources()
    }
    concerned: set[tuple[str, str, str]] = set()
    for row in catalogue.journals():
        if row.state != COMMITTED or _is_pinned(row, pinned[Source(row.robot, row.store_id)]):
            continue
        changes = {name: True for name in _over(row, rules, now_ns) if not getattr(row, name)}
        if changes:
            catalogue.change([row], **changes)
            concerned.add((row.robot, row.store_id, row.file))
    remove_columns(layout, catalogue)
    remove_journals(layout, catalogue)
    return len(concerned)


def _over(row: Row[Any], rules: Sequence[Retention], now_ns: int) -> Iterable[str]:
    """Name what of a journal is older than its rule."""
    age_s = (now_ns // _DAY_NS * _DAY_NS - row.put_ns) / NS
    rule, own = rule_of(row.robot, row.keeping, rules), rule_of(row.robot, OWN, rules)
    if rule is not None and rule.journals_s is not None and age_s > rule.journals_s:
        yield "raw_gone"
    if rule is not None and rule.columns_s is not None and age_s > rule.columns_s:
        yield "columns_gone"
    if own is not None and own.columns_s is not None and age_s > own.columns_s:
        yield "own_gone"


def rule_of(robot: str, keeping: str, rules: Sequence[Retention]) -> Retention | None:
    """Choose the rule that names robot and class most closely."""
    fitting = [
        rule
        for rule in rules
        if rule.robot in ("*", robot)
        and (rule.keeping == keeping or (rule.keeping == "*" and keeping in DATA))
    ]
    return max(fitting, key=lambda rule: (rule.robot != "*", rule.keeping != "*"), default=None)


def _windows(layout: Layout, catalogue: Catalogue, source: Source) -> list[tuple[int, int]]:
    """Return the windows of incidents that nobody has released."""
    reader = Reader(layout, catalogue, [source])
    table = identifier(reserved.INCIDENT)
    if table not in reader.schemas:
        return []
    found = gather(reader.of(source, table), Request(table, ("id", "state", "from_ns", "to_ns")))
    last: dict[str, tuple[str, int, int]] = {}
    for piece in sorted(found.pieces, key=lambda piece: (piece.run, int(piece.seq[0]))):
        columns = (plain(piece.columns[n]) for n in ("id", "state", "from_ns", "to_ns"))
        for name, state, from_ns, to_ns in zip(*columns, strict=True):
            last[name] = (state, from_ns, to_ns)
    return [(from_ns, to_ns) for state, from_ns, to_ns in last.values() if state != _RELEASED]


def _is_pinned(row: Row[Any], windows: Iterable[tuple[int, int]]) -> bool:
    return any(row.start_ns <= to_ns and row.end_ns >= from_ns for from_ns, to_ns in windows)


def remove_journals(layout: Layout, catalogue: Catalogue) -> int:
    """Delete the journal files that the catalogue says are gone; return how many there were."""
    removed = 0
    for row in catalogue.journals():
        if row.raw_gone:
            with suppress(FileNotFoundError):
                layout.journal(row.robot, row.store_id, row.file).unlink()
                removed += 1
    return removed


def remove_columns(layout: Layout, catalogue: Catalogue) -> None:
    """Take the rows of journals whose columns are gone out of the tables."""
    for source in catalogue.sources():
        rows = catalogue.journals(source)
        held = catalogue.held(source)
        for schema in (schema for schema in catalogue.schemas() if schema.id in held):
            flag = "own_gone" if is_kept(schema) else "columns_gone"
            gone = [row for row in rows if getattr(row, flag)]
            if gone:
                for table, kind in tables_of(schema):
                    remove_rows(layout, table, kind, source, gone)


def remove_rows(
    layout: Layout, table: str, schema: TableSchema, source: Source, gone: Sequence[Row[Any]],
    about: str = "rows older than their lifetime went",
) -> None:  # fmt: skip
    """Take the rows of some journals of a store out of a table."""
    from amberbox.fleet.archive import delta

    names = {row.file for row in gone}
    runs = {row.run for row in gone}
    for file in list(layout.snapshot(table).files.values()):
        if not _may_hold(file, source, runs):
            continue
        parts = segment_at(layout.tables, f"{table}/{file.path}").parts
        if any(part.journal in names for part in parts):
            rest = joined(layout.tables, table, schema, [file], names)
            added = [] if rest is None else [rest]
            delta.change(layout.table(table), schema, added, [file], about=about)


def _may_hold(file: LiveFile, source: Source, runs: Iterable[int]) -> bool:
    mine = (file.robot, file.low["store_id"]) == (source.robot, source.store_id)
    return mine and any(file.low["run"] <= run <= file.high["run"] for run in runs)
