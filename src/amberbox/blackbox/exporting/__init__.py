"""Export: a view of a record becomes files that other tools read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.blackbox.exporting.csv import write_csv
from amberbox.blackbox.exporting.job import ExportOptions, Job, Progress
from amberbox.blackbox.exporting.looking import Looking
from amberbox.blackbox.exporting.mcap import write_mcap
from amberbox.blackbox.exporting.mcap_json import write_mcap_json
from amberbox.blackbox.exporting.parquet import write_parquet
from amberbox.blackbox.exporting.report import ExportReport
from amberbox.blackbox.exporting.rosbag import write_bag
from amberbox.blackbox.exporting.view import View, Window
from amberbox.core.errors import UsageError

if TYPE_CHECKING:
    from amberbox.blackbox.query.record import Record

__all__ = ["FORMS", "ExportOptions", "ExportReport", "View", "Window", "export"]

FORMS: Mapping[str, Callable[[Job], None]] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "mcap": write_mcap,
    "mcap-json": write_mcap_json,
    "bag": write_bag,
}
"""What a record can be exported to."""


def export(
    record: Record,
    view: View,
    target: Path | None,
    form: str,
    progress: Progress = lambda fraction: None,
    options: ExportOptions | None = None,
) -> ExportReport:
    """Write a view of a record in one of ``FORMS``.

    Memory is bounded whatever the range. The target appears when it is complete; without one,
    CSV goes to stdout. What was asked for and could not be exported stands in the report.
    Raises UsageError for what cannot be chosen, AmberboxError where there is nothing.
    """
    if form not in FORMS:
        raise UsageError(f"there is no format {form!r}", f"choose {', '.join(FORMS)}")
    if target is None and form != "csv":
        raise UsageError(f"{form} needs a file", "add -o FILE")
    report = ExportReport(target, form)
    looking = Looking(record.path, report)
    FORMS[form](Job(looking, view, target, report, progress, options or ExportOptions()))
    return report
