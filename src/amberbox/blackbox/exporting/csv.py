"""CSV files: one per table, times as RFC 3339, formulas made harmless."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from amberbox.blackbox.exporting.job import Job
from amberbox.blackbox.exporting.tablefiles import (
    only_table,
    streams_of,
    write_rows,
    write_tables,
)
from amberbox.blackbox.exporting.tables import Block, TableStream


@dataclass(frozen=True)
class _CsvFile:
    file: IO[str]
    raw_text: bool

    def write(self, block: Block) -> None:
        block.table.to_csv(self.file, header=False, raw_text=self.raw_text)


def write_csv(job: Job) -> None:
    """Write CSV files, or one table to stdout where no target is given."""
    if job.target is not None:
        write_tables(job, ".csv", partial(_opened, raw_text=job.options.raw_text))
        return
    stream = only_table(job, streams_of(job))
    stream.empty.to_csv(sys.stdout)
    write_rows(job, stream, _CsvFile(sys.stdout, job.options.raw_text))


@contextmanager
def _opened(stream: TableStream, path: Path, raw_text: bool) -> Iterator[_CsvFile]:
    with path.open("w", encoding="utf-8", newline="") as file:
        stream.empty.to_csv(file)
        yield _CsvFile(file, raw_text)
