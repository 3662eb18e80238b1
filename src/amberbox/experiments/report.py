"""The report of a run, made from its events and its record, and the comparison of several."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct

from amberbox.blackbox.columns.arrays import null_mask
from amberbox.blackbox.query.record import Record
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.experiments.criteria import CriterionResult, Interval, Verdict, judge, verdict_of
from amberbox.experiments.experiment import Outcome
from amberbox.experiments.procedure import Procedure
from amberbox.experiments.run import RunEvent

PLOT_POINTS = 600
StepState = Literal["waiting", "running", "done", "failed", "interrupted"]


class StepRecord(Struct, frozen=True):
    """One visit of a step: who did it, when, and what came of it; ``to_ns`` None while it goes on.

    ``values`` are what a person entered, or the result of the robot; ``parameters`` what the robot
    was given.
    """

    element: str
    task: str
    name: str
    role: str
    state: StepState
    from_ns: int
    to_ns: int | None = None
    who: str = ""
    text: str = ""
    values: dict[str, Any] = {}
    parameters: dict[str, Any] = {}


class PlotData(Struct, frozen=True):
    """A recorded variable during the run; ``seconds`` count from its beginning.

    ``values`` are null where it is unknown. ``text`` says why there are none.
    """

    name: str
    unit: str = ""
    seconds: list[float] = []
    values: list[float | None] = []
    text: str = ""


class RunReport(Struct, frozen=True):
    """A run as a whole. ``about`` has versions, configuration hash, seeds and what else was given.

    Times of events are those of the keeper of the run; ``offset_ns`` leads to those of the record.
    """

    experiment: str
    title: str
    sha256: str
    run: str
    robot: str
    outcome: Outcome | None
    verdict: Verdict | None
    reasons: list[str]
    began_ns: int
    ended_ns: int | None
    parameters: dict[str, Any]
    people: dict[str, str]
    about: dict[str, Any]
    steps: list[StepRecord]
    criteria: list[CriterionResult]
    events: list[RunEvent]
    plots: list[PlotData] = []
    offset_ns: int = 0

    @property
    def deviations(self) -> list[RunEvent]:
        """Return what was not as expected, and remarks."""
        return [event for event in self.events if event.kind in ("deviation", "note")]

    @property
    def versions(self) -> dict[str, str]:
        """Return the versions of software by name."""
        return {key: str(value) for key, value in self.about.get("versions", {}).items()}

    def to_json(self) -> bytes:
        """Return it as JSON."""
        return msgspec.json.encode(self)

    @classmethod
    def from_json(cls, data: bytes) -> RunReport:
        """Read it from JSON; raises UsageError for anything else."""
        try:
            return msgspec.json.decode(data, type=cls)
        except msgspec.MsgspecError as error:
            raise UsageError(f"this is no report of a run: {error}") from error


def make_report(
    procedure: Procedure, events: Sequence[RunEvent], record: Record | None, offset_ns: int = 0
) -> RunReport:
    """Return the report of a run; ``offset_ns`` is added to its times to find it in the record."""
    begun = events[0]
    over = next((event for event in events if event.kind == "over"), None)
    given = dict(begun.values)
    own = ("experiment", "sha256", "run", "robot", "parameters", "people")
    known = {key: given.pop(key) for key in own}
    outcome: Outcome | None = None if over is None else over.values["outcome"]
    spans = {key: (a + offset_ns, b + offset_ns) for key, (a, b) in intervals(events).items()}
    results: list[CriterionResult] = []
    if over is not None:
        results = judge(procedure.options.criteria, record, spans)
        results += _missing_data(procedure.options.data, record, spans[""])
    verdict, reasons = None, []
    if over is not None and outcome is not None:
        verdict, more = verdict_of(outcome, results, over.values.get("skipped", ()))
        reasons = [*([] if outcome == "passed" and more else [over.text]), *more]
    end_ns = (events[-1] if over is None else over).at_ns
    return RunReport(
        known["experiment"],
        begun.text,
        known["sha256"],
        known["run"],
        known["robot"],
        outcome,
        verdict,
        reasons,
        begun.at_ns,
        None if over is None else over.at_ns,
        known["parameters"],
        known["people"],
        given,
        step_records(procedure, events),
        results,
        list(events),
        list(_plots(procedure, record, (begun.at_ns + offset_ns, end_ns + offset_ns))),
        offset_ns,
    )


def intervals(events: Sequence[RunEvent]) -> dict[str, Interval]:
    """Return from when to when (ns) each activity was carried out the last time, by its path.

    A step of the robot begins when it is started. The whole run has an empty path.
    """
    found: dict[str, Interval] = {}
    begun: dict[str, int] = {}
    for event in events:
        if event.kind in ("ready", "started", "entered"):
            begun[event.element] = event.at_ns
        elif event.kind == "over":
            found[""] = (events[0].at_ns, event.at_ns)
        elif _has_begun(event, events) and event.element in begun:
            found[event.element] = (begun[event.element], event.at_ns)
    return found


def _has_begun(event: RunEvent, events: Sequence[RunEvent]) -> bool:
    """Return whether an event ends an activity that was carried out, if only in part."""
    if event.kind == "ended":
        return any(e.kind == "started" and e.task == event.task for e in events)
    return event.kind in ("done", "passed", "interrupted")


def step_records(procedure: Procedure, events: Sequence[RunEvent]) -> list[StepRecord]:
    """Return every visit of a step, in the order in which they began to wait."""
    visits: dict[str, StepRecord] = {}
    for event in events:
        if event.kind == "ready":
            step = procedure.steps[event.element]
            visits[event.task] = StepRecord(
                event.element, event.task, step.name, step.role, "waiting", event.at_ns
            )
        elif event.task in visits and event.kind in _CHANGES:
            visits[event.task] = _CHANGES[event.kind](visits[event.task], event)
    return list(visits.values())


def _started(visit: StepRecord, event: RunEvent) -> StepRecord:
    parameters = event.values["parameters"]
    return msgspec.structs.replace(
        visit, state="running", from_ns=event.at_ns, text=event.text, parameters=parameters
    )


def _done(visit: StepRecord, event: RunEvent) -> StepRecord:
    return msgspec.structs.replace(
        visit, state="done", to_ns=event.at_ns, who=event.who, values=event.values
    )


def _ended(visit: StepRecord, event: RunEvent) -> StepRecord:
    well = event.values["state"] == "done"
    texts = [visit.text, "" if well else event.values["state"], event.text]
    state: StepState = "done" if well else "failed"
    return msgspec.structs.replace(
        visit,
        state="interrupted" if visit.state == "interrupted" else state,
        to_ns=event.at_ns,
        text=": ".join(filter(None, texts)),
        values=event.values.get("result", {}),
    )


def _interrupted(visit: StepRecord, event: RunEvent) -> StepRecord:
    return msgspec.structs.replace(visit, state="interrupted", to_ns=event.at_ns)


_CHANGES = {"started": _started, "done": _done, "ended": _ended, "interrupted": _interrupted}


def _missing_data(
    items: Sequence[str], record: Record | None, span: Interval
) -> Iterator[CriterionResult]:
    """Yield an unknown result for each item that had to be recorded and has no rows."""
    for item in items:
        try:
            if record is None:
                raise UsageError("there is no record of the run")
            if len(record.query(item, ["received"], span[0], span[1] + 1, points=1)):
                continue
            text = "it has no rows in the time of the run"
        except AmberboxError as error:
            text = error.what
        yield CriterionResult(f"data of {item}", "recorded", item, "unknown", text=text)


def _plots(procedure: Procedure, record: Record | None, span: Interval) -> Iterator[PlotData]:
    for name in procedure.options.plots:
        item, _, variable = name.partition(".")
        try:
            if record is None:
                raise UsageError("there is no record of the run")
            yield _plot(name, record, item, variable, span)
        except AmberboxError as error:
            yield PlotData(name, text=error.what)


def _plot(name: str, record: Record, item: str, variable: str, span: Interval) -> PlotData:
    table = record.query(item, [variable, "received"], span[0], span[1] + 1, points=PLOT_POINTS)
    field = next(one for one in table.fields if one.name not in ("timestamp", "received"))
    column = table[field.name]
    if not isinstance(column, np.ndarray) or column.dtype.kind not in "biuf":
        raise UsageError(f"'{name}' is no number")
    values = np.ma.getdata(column).astype(np.float64)
    is_unknown = null_mask(column) | ~np.isfinite(values)
    seconds = (np.asarray(table["received"], np.int64) - span[0]) / NS
    return PlotData(
        name,
        field.unit,
        np.round(seconds, 6).tolist(),
        [None if gone else value for value, gone in zip(values.tolist(), is_unknown, strict=True)],
        "" if len(values) else "no rows in the time of the run",
    )


class MeasureStatistics(Struct, frozen=True):
    """A measure over several runs. ``sd`` is that of a sample, None for fewer than two values.

    ``missing`` runs have no value. ``means`` are by version, in the order of time; ``change`` is
    the mean since a version minus the mean before it.
    """

    name: str
    unit: str
    n: int
    missing: int
    mean: float | None = None
    sd: float | None = None
    min: float | None = None
    max: float | None = None
    means: dict[str, float] = {}
    change: float | None = None


class Comparison(Struct, frozen=True):
    """Runs of one diagram side by side; ``overlay`` has the curves of each variable by run."""

    experiment: str
    sha256: str
    runs: list[str]
    verdicts: dict[str, str]
    since: str
    measures: list[MeasureStatistics]
    overlay: dict[str, dict[str, PlotData]]


def compare(reports: Sequence[RunReport], since: str = "", software: str = "") -> Comparison:
    """Compare runs; ``since`` is a version of the ``software`` named (else of the robot).

    Raises UsageError for fewer than two runs, and for runs of different diagrams.
    """
    ordered = sorted(reports, key=lambda report: report.began_ns)
    if len({report.run for report in ordered}) < 2:
        raise UsageError("to compare, name at least two runs")
    digests = {report.sha256 for report in ordered}
    if len(digests) > 1:
        names = ", ".join(f"{report.run} ({report.sha256[:8]})" for report in ordered)
        hint = "only runs of the same diagram and its files can be compared"
        raise UsageError(f"the runs are of different experiments: {names}", hint)
    versions = [_version(report, software) for report in ordered]
    if since and since not in versions:
        known = ", ".join(dict.fromkeys(versions))
        raise UsageError(f"no run has version '{since}'", f"versions: {known}")
    units = {c.name: c.unit for report in ordered for c in report.criteria}
    series = {name: [_value(report, name) for report in ordered] for name in units}
    series["duration of the run"] = [
        None if report.ended_ns is None else (report.ended_ns - report.began_ns) / NS
        for report in ordered
    ]
    units["duration of the run"] = "s"
    plots = dict.fromkeys(plot.name for report in ordered for plot in report.plots)
    return Comparison(
        ordered[0].experiment,
        ordered[0].sha256,
        [report.run for report in ordered],
        {report.run: report.verdict or "" for report in ordered},
        since,
        [_statistics(name, units[name], series[name], versions, since) for name in units],
        {
            name: {r.run: plot for r in ordered for plot in r.plots if plot.name == name}
            for name in plots
        },
    )


def _version(report: RunReport, software: str) -> str:
    versions = report.versions
    return versions.get(software or "robot", "") or (
        "" if software else versions.get("amberbox", "")
    )


def _value(report: RunReport, name: str) -> float | None:
    return next((c.value for c in report.criteria if c.name == name), None)


def _statistics(
    name: str, unit: str, values: Sequence[float | None], versions: Sequence[str], since: str
) -> MeasureStatistics:
    known = [(v, version) for v, version in zip(values, versions, strict=True) if v is not None]
    numbers = [value for value, _ in known]
    missing = len(values) - len(numbers)
    if not numbers:
        return MeasureStatistics(name, unit, 0, missing)
    by_version: dict[str, list[float]] = {}
    for value, version in known:
        by_version.setdefault(version, []).append(value)
    change = None
    if since and since in versions:
        first = versions.index(since)
        before = [v for v in values[:first] if v is not None]
        after = [v for v in values[first:] if v is not None]
        change = _mean(after) - _mean(before) if before and after else None
    return MeasureStatistics(
        name,
        unit,
        len(numbers),
        missing,
        _mean(numbers),
        statistics.stdev(numbers) if len(numbers) > 1 else None,
        min(numbers),
        max(numbers),
        {version: _mean(some) for version, some in by_version.items()},
        change,
    )


def _mean(values: Iterable[float]) -> float:
    return statistics.fmean(values)
