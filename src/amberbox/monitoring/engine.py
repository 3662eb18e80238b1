"""The engine: rows of the record in, statuses, transitions and alarms out.

The same code runs live and in replay. A plan is first made ready to run: outputs numbered,
inputs tied to tables, modes grouped by items.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.conditions import ticks
from amberbox.core.contracts import ModeContract
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Input, Result
from amberbox.core.samples import Now
from amberbox.core.types import Batch, IntArray, Output, Status
from amberbox.monitoring.findings import TICK_NS, Finding, OutputChange
from amberbox.monitoring.mode_evaluation import QUARTER_NS, InstantBlock, MappingRun, OutputRun
from amberbox.monitoring.plan import MappingPlan, ModePlan, MonitoringPlan
from amberbox.monitoring.sample_tables import SampleTable, SampleTables
from amberbox.monitoring.states import RobotStates


def evaluate_for_all(
    evaluate: Callable[..., Mapping[str, Any]], results: Sequence[Result]
) -> Callable[..., Mapping[str, Any]]:
    """Return a function of several inputs: its bools are nominal where those of all inputs are."""
    nominal = {r.name: r.nominal for r in results if r.type == "bool"}

    def evaluate_all(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
        each = [evaluate(config, [entry], now) for entry in inputs]
        return {name: _joined([r.get(name) for r in each], nominal[name]) for name in nominal}

    return evaluate_all


def _joined(results: Sequence[Any], nominal: bool) -> Any:
    """Join bools: bad where one is, else unknown where one is, else as before where one is."""
    good, bad = (TRUE, FALSE) if nominal else (FALSE, TRUE)
    if any(result is None for result in results):
        results = [UNKNOWN if result is None else result for result in results]
    codes = [np.asarray(result).astype(np.int8) for result in results]
    held = np.where(_any(codes, HOLD), HOLD, good)
    unknown = np.where(_any(codes, UNKNOWN), UNKNOWN, held)
    return np.where(_any(codes, bad), bad, unknown)


def _any(codes: Sequence[Any], value: int) -> Any:
    return np.logical_or.reduce([code == value for code in codes])


@dataclass(slots=True)
class RunGroup:
    """Runs that read the same items: they are evaluated at the same instants."""

    items: tuple[str, ...]
    runs: list[MappingRun] = field(default_factory=list)

    def forget(self) -> None:
        """Reset all windows and results."""
        for run in self.runs:
            run.forget()
            for output in run.outputs:
                output.forget()


def build_groups(
    plan: MonitoringPlan, tables: SampleTables
) -> tuple[list[RunGroup], list[OutputRun]]:
    """Make runs of all modes that can run; outputs are numbered in the order of the plan."""
    groups: dict[tuple[str, ...], RunGroup] = {}
    outputs: list[OutputRun] = []
    for _, mode in plan.modes():
        for mapping in mode.mappings:
            own = [
                OutputRun(len(outputs) + place, output)
                for place, output in enumerate(mapping.outputs)
            ]
            outputs += own
            if not mode.problem:
                for run, items in _runs(mode, mapping, own, tables):
                    groups.setdefault(items, RunGroup(items)).runs.append(run)
    return list(groups.values()), outputs


def _runs(
    mode: ModePlan, mapping: MappingPlan, outputs: Sequence[OutputRun], tables: SampleTables
) -> list[tuple[MappingRun, tuple[str, ...]]]:
    """Make one run of a mapping, or several where a mode is called for each input alone."""
    contract = ModeContract.of(mode.module)
    if not contract.per_input:
        return [_run(mode, contract, mapping, outputs, tables)]
    runs = []
    for place, entry in enumerate(mapping.inputs):
        own = [output for output in outputs if output.plan.place == place]
        if own:
            runs.append(_run(mode, contract, replace(mapping, inputs=[entry]), own, tables))
    joined = [output for output in outputs if output.plan.place is None]
    if joined:
        if len(mapping.inputs) > 1:
            results = [output.plan.result for output in joined]
            evaluate = evaluate_for_all(contract.evaluate, results)
            contract = replace(contract, evaluate=evaluate, explain=None)
        runs.append(_run(mode, contract, mapping, joined, tables))
    return runs


def _run(
    mode: ModePlan,
    contract: ModeContract,
    mapping: MappingPlan,
    outputs: Sequence[OutputRun],
    tables: SampleTables,
) -> tuple[MappingRun, tuple[str, ...]]:
    history_s, parts = contract.looks_back_s(mode.config), bool(contract.parts)
    plans = [*mapping.inputs, *mapping.reads]
    inputs: list[Input] = [tables.input(entry, history_s, parts) for entry in plans]
    items = tuple(sorted({entry.item for entry in plans}))
    return MappingRun(mode, contract, mapping, inputs, outputs), items


_BLOCK_NS = 30 * NS  # length of record evaluated at once
_FORGET_NS = 2 * NS


class Engine:
    """Runs a plan over a record: ``begin`` an epoch, ``feed`` rows, ``advance``."""

    def __init__(self, plan: MonitoringPlan) -> None:
        self.plan = plan
        self.states = RobotStates(plan)
        self._tables = SampleTables()
        self._groups, self._outputs = build_groups(plan, self._tables)
        self.history_s = max((table.keep_ns / NS for table in self._tables), default=1.0)
        self._until_ns = 0
        self._forgot_ns = 0
        self._put_off_ns = 0
        """Time until which ``for`` and ``heal`` are deferred because of a stall of the recorder."""
        self._began_ns: int | None = None
        self._pending: list[Finding] = []
        self._view = _View(plan, self._outputs)

    @property
    def items(self) -> frozenset[str]:
        """Return the names of the items needed from the record."""
        return self._tables.items

    @property
    def until_ns(self) -> int:
        """Return the last instant that has been evaluated, ns."""
        return self._until_ns

    @property
    def evaluations(self) -> int:
        """Return the number of evaluations of modes so far, each instant counted."""
        return sum(run.evaluations for group in self._groups for run in group.runs)

    def begin(self, at_ns: int) -> None:
        """Begin an epoch (a run of the recorder, or what follows a step of its clock).

        Log times before and after it are not comparable: nothing is known yet.
        """
        for table in self._tables:
            table.forget()
        self._tables.stalls.clear()
        self._put_off_ns = 0
        for group in self._groups:
            group.forget()
        self._until_ns = self._forgot_ns = at_ns // TICK_NS * TICK_NS
        self._listen_since(self._until_ns)
        self._pending += self.states.begin(self._until_ns)

    def _listen_since(self, began_ns: int | None) -> None:
        self._began_ns = began_ns
        for table in self._tables:
            table.flow.began_ns = began_ns

    def feed(self, batch: Batch) -> None:
        """Add rows of any item; its log times must not decrease from batch to batch."""
        self._tables.feed(batch, self._evaluated_ns())

    def _evaluated_ns(self) -> int:
        """Return up to when rows are evaluated, ns: without those of a present stall."""
        stall = self._tables.stalls.next_after(self._until_ns)
        return self._until_ns if stall is None else min(self._until_ns, stall[0])

    def advance(self, until_ns: int) -> list[Finding]:
        """Return the findings up to an instant, for which the record must be complete."""
        until_ns = until_ns // TICK_NS * TICK_NS
        findings, self._pending = self._pending, []
        with np.errstate(all="ignore"):
            while self._until_ns < until_ns:
                end_ns = min(until_ns, self._until_ns + _BLOCK_NS)
                stall = self._tables.stalls.next_after(self._until_ns)
                if stall is None or stall[0] // TICK_NS * TICK_NS >= end_ns:
                    findings += self._block(self._until_ns, end_ns)
                elif stall[0] // TICK_NS * TICK_NS > self._until_ns:
                    end_ns = stall[0] // TICK_NS * TICK_NS
                    findings += self._block(self._until_ns, end_ns)
                else:
                    end_ns = min(until_ns, -(-stall[1] // TICK_NS) * TICK_NS)
                    findings += self._stalled(stall, end_ns)
                self._until_ns = end_ns
        if until_ns - self._forgot_ns >= _FORGET_NS:
            self._forgot_ns = until_ns
            for table in self._tables:
                table.forget_before(until_ns)
        return findings

    def _block(self, after_ns: int, until_ns: int) -> list[Finding]:
        self._view.begin_block()
        found: list[OutputChange] = []
        came = {table.item: _ticks(table, after_ns, until_ns) for table in self._tables}
        quarters = ticks(QUARTER_NS, after_ns, until_ns)
        for group in self._groups:
            block = _block_of(group, came, quarters)
            if block is not None:
                for run in group.runs:
                    run.run(block.without(self._tables.stalls, run.window_ns), found)
        found.sort(key=lambda change: (change.at_ns, change.output))
        return self.states.advance(found, until_ns, self._view)

    def _stalled(self, stall: tuple[int, int], until_ns: int) -> list[Finding]:
        """Skip a stall of the recorder: all findings stay as they were before it.

        Rows received meanwhile are evaluated at the first instant after it.
        """
        from_ns, over_ns = stall
        if over_ns > self._put_off_ns:
            self.states.postpone(max(from_ns, self._put_off_ns), over_ns)
            self._put_off_ns = over_ns
        self._view.begin_block()
        return self.states.advance((), until_ns, self._view)

    def statuses(self) -> list[Status]:
        """Return the newest status of every mode and component."""
        return self.states.statuses()

    def snapshot(self) -> dict[str, Any]:
        """Return the state needed by ``resume``, as JSON, without the rows of ``history_s``."""
        tables = {table.item: table.snapshot(self._until_ns) for table in self._tables}
        runs = [run.snapshot() for group in self._groups for run in group.runs]
        return {
            "version": 1,
            "until_ns": self._until_ns,
            "began_ns": self._began_ns,
            "stalls": self._tables.stalls.snapshot(),
            "put_off_ns": self._put_off_ns,
            "tables": tables,
            "runs": runs,
            "states": self.states.snapshot(),
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a snapshot of an engine with the same plan.

        The rows of the last ``history_s`` before it, and all after it, have to be fed again.
        """
        self._until_ns = self._forgot_ns = int(snapshot["until_ns"])
        self._listen_since(snapshot["began_ns"])
        self._put_off_ns = int(snapshot.get("put_off_ns", 0))
        for stall in snapshot.get("stalls", ()):
            self._tables.stalls.add(*stall)
        for table in self._tables:
            if table.item in snapshot["tables"]:
                table.resume(snapshot["tables"][table.item])
        runs = [run for group in self._groups for run in group.runs]
        for run, held in zip(runs, snapshot["runs"], strict=True):
            run.resume(held)
        self.states.resume(snapshot["states"])


class _View:
    """The values of outputs at the instants of a block, for the states."""

    def __init__(self, plan: MonitoringPlan, outputs: Sequence[OutputRun]) -> None:
        self._outputs = outputs
        self._of_mode: list[list[OutputRun]] = []
        place = 0
        for _, mode in plan.modes():
            count = len(mode.outputs)
            self._of_mode.append(list(outputs[place : place + count]))
            place += count

    def begin_block(self) -> None:
        for output in self._outputs:
            output.begin_block()

    def outputs(self, mode: int, at_ns: int) -> Mapping[str, Output]:
        return {output.plan.name: output.value(at_ns) for output in self._of_mode[mode]}


def _ticks(table: SampleTable, after_ns: int, until_ns: int) -> IntArray:
    """Return the instants at which rows of an item have arrived since the previous instant.

    Rows for which no instant was evaluated, because the recorder was held up, count for the first
    one.
    """
    if not table.fresh:
        return _NONE
    times = table.fresh[0] if len(table.fresh) == 1 else np.concatenate(table.fresh)
    taken = int(times.searchsorted(until_ns, "right"))
    table.fresh = [times[taken:]] if taken < len(times) else []
    ticks = -(-times[:taken] // TICK_NS) * TICK_NS
    sorted_ns = np.maximum(ticks, after_ns // TICK_NS * TICK_NS + TICK_NS)
    if len(sorted_ns) < 2:
        return sorted_ns
    kept: IntArray = sorted_ns[np.concatenate([[True], sorted_ns[1:] != sorted_ns[:-1]])]
    return kept


def _block_of(
    group: RunGroup, came: Mapping[str, IntArray], quarters: IntArray
) -> InstantBlock | None:
    """Return the instants at which the modes of a group are evaluated."""
    parts = [ticks for item in group.items if len(ticks := came[item])]
    if not parts:
        return InstantBlock(quarters, np.zeros(len(quarters), bool)) if len(quarters) else None
    rows = parts[0] if len(parts) == 1 else np.unique(np.concatenate(parts))
    if not len(quarters):
        return InstantBlock(rows, np.ones(len(rows), bool))
    instants = np.union1d(rows, quarters)
    return InstantBlock(instants, np.isin(instants, rows))


_NONE: IntArray = np.zeros(0, np.int64)
