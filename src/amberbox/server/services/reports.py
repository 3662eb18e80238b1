"""Reports of runs for API and pages: as JSON, as a page to print, as JUnit XML; comparisons."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any, Literal

import msgspec

from amberbox.core.errors import UsageError
from amberbox.experiments.report import RunReport
from amberbox.experiments.report import compare as compare_reports
from amberbox.experiments.report_junit import junit
from amberbox.experiments.report_page import report_page
from amberbox.server.experiments.judge import REPORT
from amberbox.server.services import experiments
from amberbox.server.services.context import Caller, NotNowError, Services


async def read_report(fleet: Services, who: Caller, robot: str, id: str) -> RunReport:
    """Return the report of a run as its record is now; raises NotNowError before it has begun."""
    stored = await asyncio.to_thread(experiments.find_run, fleet, robot, id)
    if stored.begun_ns is None:
        raise NotNowError("the run has not begun", "begin it, or wait until it is")
    data = await fleet.worker_pool.ask(
        REPORT, {"run": id, "step_ns": fleet.runner.register.step_ns()}, origin=who.person
    )
    return RunReport.from_json(data)


async def report(
    fleet: Services, who: Caller, robot: str, id: str, format: Literal["json", "html", "junit"]
) -> str | bytes:
    """Return the report of a run in a format."""
    found = await read_report(fleet, who, robot, id)
    if format == "json":
        return found.to_json()
    if format == "junit":
        return junit(found)
    has_diagram = bool(found.sha256)
    if not has_diagram:
        return await asyncio.to_thread(report_page, found)
    drawn = await asyncio.to_thread(experiments.run_diagram, fleet, robot, id)
    return await asyncio.to_thread(report_page, found, lambda: drawn)


async def compare(
    fleet: Services, who: Caller, robot: str, ids: Sequence[str], since: str = "",
    software: str = "",
) -> dict[str, Any]:  # fmt: skip
    """Compare runs of one experiment; ``since`` is a version of a software, else of the robot."""
    found = [await read_report(fleet, who, robot, id) for id in dict.fromkeys(ids)]
    if len(found) < 2:
        raise UsageError("at least two runs are compared", "name another one")
    comparison = await asyncio.to_thread(compare_reports, found, since, software)
    built: dict[str, Any] = msgspec.to_builtins(comparison)
    return built
