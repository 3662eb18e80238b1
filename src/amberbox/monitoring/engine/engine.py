"""The engine: rows of the record in, statuses, transitions and alarms out.

It looks at no clock: everything happens at instants, multiples of ``TICK_NS`` of the record's log
time. A mode is evaluated where a row of its inputs came since the instant before; one that depends
on time, at every quarter of a second. How rows are split into batches, and how often
``advance`` is called, does not matter; so live and replay give the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.types import Batch, IntArray, Output, Status
from amberbox.monitoring.engine.building import Group, build_groups
from amberbox.monitoring.engine.evaluation import QUARTER_NS, Block, OutputRun
from amberbox.monitoring.engine.findings import TICK_NS, Finding, Found
from amberbox.monitoring.engine.states import States
from amberbox.monitoring.engine.tables import Table, Tables
from amberbox.monitoring.plan import Plan

__all__ = ["Engine"]

_BLOCK_NS = 30 * NS
"""So much of the record is looked at together."""
_FORGET_NS = 2 * NS


class Engine:
    """Runs a plan over a record: ``begin`` an epoch, ``feed`` rows, ``advance``."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.states = States(plan)
        self._tables = Tables()
        self._groups, self._outputs = build_groups(plan, self._tables)
        self.history_s = max((table.keep_ns / NS for table in self._tables), default=1.0)
        self._until_ns = 0
        self._forgot_ns = 0
        self._put_off_ns = 0
        """Up to when a stall of the recorder has put off what lasts."""
        self._began_ns: int | None = None
        self._pending: list[Finding] = []
        self._view = _View(plan, self._outputs)

    @property
    def items(self) -> frozenset[str]:
        """Names of the items that are wanted from the record."""
        return self._tables.items

    @property
    def until_ns(self) -> int:
        """The last instant that has been evaluated."""
        return self._until_ns

    @property
    def evaluations(self) -> int:
        """How often modes were evaluated so far, each instant counted."""
        return sum(run.evaluations for group in self._groups for run in group.runs)

    def begin(self, at_ns: int) -> None:
        """Begin an epoch (a run of the recorder, or what follows a step of its clock).

        Log times before and after it have nothing to do with each other: nothing is known yet.
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
        """Take rows of any item; its log times must not decrease from batch to batch."""
        self._tables.feed(batch, self._evaluated_ns())

    def _evaluated_ns(self) -> int:
        """Return up to when rows are evaluated: not those of a stall that is being left out."""
        stall = self._tables.stalls.next_after(self._until_ns)
        return self._until_ns if stall is None else min(self._until_ns, stall[0])

    def advance(self, until_ns: int) -> list[Finding]:
        """Return what is found up to an instant, for which the record must be complete."""
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
        found: list[Found] = []
        came = {table.item: _ticks(table, after_ns, until_ns) for table in self._tables}
        quarters = _multiples(QUARTER_NS, after_ns, until_ns)
        for group in self._groups:
            block = _block_of(group, came, quarters)
            if block is not None:
                for run in group.runs:
                    run.run(block.without(self._tables.stalls, run.window_ns), found)
        found.sort(key=_order)
        return self.states.advance(found, until_ns, self._view)

    def _stalled(self, stall: tuple[int, int], until_ns: int) -> list[Finding]:
        """Evaluate nothing while the recorder was held up: all stays as it was found before.

        What rows say that came meanwhile is evaluated at the first instant after it.
        """
        from_ns, over_ns = stall
        if over_ns > self._put_off_ns:
            self.states.hold_up(max(from_ns, self._put_off_ns), over_ns)
            self._put_off_ns = over_ns
        self._view.begin_block()
        return self.states.advance((), until_ns, self._view)

    def statuses(self) -> list[Status]:
        """Return the newest status of every mode and component."""
        return self.states.statuses()

    def snapshot(self) -> dict[str, Any]:
        """Return what has to be known to go on, as JSON, beside the rows of ``history_s``."""
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

    def __init__(self, plan: Plan, outputs: Sequence[OutputRun]) -> None:
        self._outputs = outputs
        self._of_mode: list[list[OutputRun]] = []
        place = 0
        for _, mode in plan.modes():
            count = sum(len(mapping.outputs) for mapping in mode.mappings)
            self._of_mode.append(list(outputs[place : place + count]))
            place += count

    def begin_block(self) -> None:
        for output in self._outputs:
            output.begin_block()

    def outputs(self, mode: int, at_ns: int) -> Mapping[str, Output]:
        return {output.plan.name: output.value(at_ns) for output in self._of_mode[mode]}


def _order(found: Found) -> tuple[int, int]:
    return found.at_ns, found.output


def _ticks(table: Table, after_ns: int, until_ns: int) -> IntArray:
    """Return the instants up to one at which rows of an item have come since the one before.

    Rows that no instant was evaluated for, as the recorder was held up, count for the first.
    """
    if not table.fresh:
        return _NONE
    times = table.fresh[0] if len(table.fresh) == 1 else np.concatenate(table.fresh)
    taken = int(times.searchsorted(until_ns, "right"))
    table.fresh = [times[taken:]] if taken < len(times) else []
    ticks = -(-times[:taken] // TICK_NS) * TICK_NS
    return _distinct(np.maximum(ticks, after_ns // TICK_NS * TICK_NS + TICK_NS))


def _distinct(sorted_ns: IntArray) -> IntArray:
    if len(sorted_ns) < 2:
        return sorted_ns
    kept: IntArray = sorted_ns[np.concatenate([[True], sorted_ns[1:] != sorted_ns[:-1]])]
    return kept


def _multiples(step_ns: int, after_ns: int, until_ns: int) -> IntArray:
    return np.arange(after_ns // step_ns + 1, until_ns // step_ns + 1, dtype=np.int64) * step_ns


def _block_of(group: Group, came: Mapping[str, IntArray], quarters: IntArray) -> Block | None:
    """Return the instants at which the modes of a group are looked at."""
    parts = [ticks for item in group.items if len(ticks := came[item])]
    if not parts:
        return Block(quarters, np.zeros(len(quarters), bool)) if len(quarters) else None
    rows = parts[0] if len(parts) == 1 else np.unique(np.concatenate(parts))
    if not len(quarters):
        return Block(rows, np.ones(len(rows), bool))
    instants = np.union1d(rows, quarters)
    return Block(instants, np.isin(instants, rows))


_NONE: IntArray = np.zeros(0, np.int64)
