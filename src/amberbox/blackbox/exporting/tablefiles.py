"""One file per table: in a folder, or a single one where the target names a file."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from amberbox.blackbox.exporting.job import Job, new_file, new_folder, size_of
from amberbox.blackbox.exporting.tables import Block, TableStream, table_streams
from amberbox.core.errors import UsageError
from amberbox.core.files import below
from amberbox.core.names import fitted


class TableWriter(Protocol):
    """An open file that takes the rows of one table."""

    def write(self, block: Block) -> None:
        """Append rows."""


OpenTable = Callable[[TableStream, Path], AbstractContextManager[TableWriter]]


def write_tables(job: Job, ending: str, open_table: OpenTable) -> None:
    """Write each table of the view to a file of its own."""
    streams = streams_of(job)
    if job.path.suffix == ending:
        stream = only_table(job, streams)
        with new_file(job.path) as part, open_table(stream, part) as writer:
            write_rows(job, stream, writer)
    else:
        with new_folder(job.path) as folder:
            for number, stream in enumerate(streams):
                path = below(folder, f"{fitted(stream.schema.item)}{ending}")
                with open_table(stream, path) as writer:
                    write_rows(job, stream, writer, number, len(streams))
    job.report.bytes = size_of(job.path)
    job.progress(1.0)


def streams_of(job: Job) -> list[TableStream]:
    """Choose tables and columns."""
    return job.looking.ask(lambda catalogue: table_streams(catalogue, job.view))


def only_table(job: Job, streams: list[TableStream]) -> TableStream:
    """Return the table that a single file is for; its child tables are named in the report."""
    tops = [stream for stream in streams if not stream.schema.parent] or streams
    if len(tops) > 1:
        names = ", ".join(stream.schema.item for stream in tops[:5])
        raise UsageError(
            f"one file cannot hold {len(tops)} tables: {names}{', ...' if tops[5:] else ''}",
            f"choose one with --item, or name a folder and --format {job.report.form}",
        )
    for stream in streams:
        if stream is not tops[0]:
            name = stream.schema.item
            job.report.note(f"{name} is a table of its own: --item {name}, or export to a folder")
    return tops[0]


def write_rows(
    job: Job, stream: TableStream, writer: TableWriter, number: int = 0, count: int = 1
) -> None:
    """Write one table, ``number`` of ``count``."""
    name = stream.schema.item
    job.report.add(name, 0)
    for block in stream.blocks(job.looking):
        writer.write(block)
        job.report.add(name, len(block.table))
        job.progress((number + block.done) / count)
