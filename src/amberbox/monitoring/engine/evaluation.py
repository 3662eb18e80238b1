"""One mode, run over a block of instants: its function called where its inputs are fresh.

A few instants, as live, are evaluated one by one, many, as in a replay, at once; both give the
same. What is found are changes: of what an output was judged to be, and of bools and texts.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Given, Input, shortest_window_s
from amberbox.core.stalls import Stalls
from amberbox.core.types import IntArray, Output
from amberbox.monitoring.engine import freshness
from amberbox.monitoring.engine.findings import Found, What
from amberbox.monitoring.engine.judging import AS_BEFORE, BAD, NOT_KNOWN, OK, Judge
from amberbox.monitoring.engine.keeping import as_json, of_json, readable
from amberbox.monitoring.plan import MappingPlan, ModePlan, OutputPlan

QUARTER_NS = NS // 4
"""Modes whose results change with time are evaluated at multiples of this."""
SHORT_S = 0.5
"""Those that look back over less are evaluated wherever rows came as well.

What two samples in a row have between them (a jump) is then in some window, if a window is as
long as two of the item's periods, which ``check`` looks after.
"""
_CODES = 8
"""There are fewer codes of freshness than this; the place of an input is counted above them."""
_FEW = 4
"""Up to so many instants are evaluated one by one."""
_WHAT: tuple[What, ...] = ("ok", "bad", "unknown")

CRASHES = (Exception, SystemExit)
"""What a mode may raise so that it is not called any more."""

Key = tuple[int, Any]
"""What an output was judged to be and, of bools and texts, its value."""


class Block:
    """Instants that are looked at together for all modes that read the same items."""

    __slots__ = ("codes", "few", "has_rows", "instants", "is_quarter", "times")

    def __init__(self, instants: IntArray, has_rows: Any) -> None:
        self.instants = instants
        self.times: list[int] = instants.tolist()
        self.has_rows = has_rows
        """Where rows came since the instant before."""
        self.is_quarter = instants % QUARTER_NS == 0
        self.codes: dict[tuple[int, float | None], Any] = {}
        self.few = len(self.times) <= _FEW

    def without(self, stalls: Stalls, window_ns: int) -> Block:
        """Return the block without instants whose window holds a stall of the recorder."""
        if not window_ns or not len(stalls):
            return self
        keep = ~stalls.spoils(self.instants, window_ns)
        return self if keep.all() else Block(self.instants[keep], self.has_rows[keep])

    def flow_codes(self, entry: Input, stale_s: float | None) -> Any:
        """Return the freshness of an input's item, computed once for all that ask."""
        key = (id(entry.flow), stale_s)
        codes = self.codes.get(key)
        if codes is None:
            codes = self.codes[key] = freshness.flow_codes(entry.flow, stale_s, self.instants)
        return codes


class OutputRun:
    """One output as the blocks go by: how it was judged last, and its values in this block."""

    __slots__ = ("before", "column", "judge", "key", "number", "plan", "times")

    def __init__(self, number: int, plan: OutputPlan) -> None:
        self.number = number
        self.plan = plan
        self.judge = Judge(plan)
        self.forget()

    def forget(self) -> None:
        """Begin anew: nothing was found yet."""
        self.key: Key | None = None
        self.times: list[int] = []
        self.column: list[Any] = []
        self.before: Any = None

    @property
    def last(self) -> Any:
        """Its newest value, as it is kept."""
        return self.column[-1] if self.column else self.before

    def begin_block(self) -> None:
        """Keep the last value of the block before."""
        if self.column:
            self.before = self.column[-1]
            self.times, self.column = [], []

    def value(self, at_ns: int) -> Output:
        """Return its value at an instant of this block, None where it has none."""
        last = bisect_right(self.times, at_ns) - 1
        return self.judge.output(self.column[last] if last >= 0 else self.before)


class MappingRun:
    """One call of a mode's function: its inputs, and the outputs made of its results."""

    def __init__(
        self,
        mode: ModePlan,
        plan: MappingPlan,
        inputs: Sequence[Input],
        outputs: Sequence[OutputRun],
    ) -> None:
        module: Any = mode.module
        self._evaluate: Callable[..., Mapping[str, Any]] = module.evaluate
        self._explain = getattr(module, "explain", None)
        self._explain_unknown = getattr(module, "explain_unknown", None)
        self._reason = getattr(module, "reason", None)
        units = (output.plan.result.unit for output in outputs)
        self._unit = next((unit for unit in units if unit), "")
        self._columns = getattr(module, "COLUMNS", False)
        timed = getattr(module, "timed", None)
        self._timed = timed(mode.config) if timed else getattr(module, "TIMED", False)
        self._is_short = 0 < shortest_window_s(module, mode.config) < SHORT_S
        self._sees_silence = getattr(module, "SEES_SILENCE", False)
        history = getattr(module, "history_s", None)
        self.window_ns = 0
        """How far back it looks at values; silence and rates know themselves of stalls."""
        if history is not None and not self._sees_silence:
            self.window_ns = round(float(history(mode.config)) * NS)
        self._config, self._stale_s = mode.config, mode.stale_s
        results = [*getattr(module, "RESULTS", ()), *(output.plan.result for output in outputs)]
        self._bools = {result.name for result in results if result.type == "bool"}
        self.inputs, self.outputs = inputs, outputs
        kinds = [entry.kind for entry in (*plan.inputs, *plan.reads)]
        self._valued = [entry for entry, kind in zip(inputs, kinds, strict=True) if kind != "item"]
        self.code = freshness.FRESH - 1
        self.crashed = ""
        self.evaluations = 0

    def forget(self) -> None:
        """Begin anew."""
        self.code = freshness.FRESH - 1
        self.crashed = ""

    def snapshot(self) -> list[Any]:
        """Return what it has to know to go on."""
        outputs = [[output.key, as_json(output.last)] for output in self.outputs]
        return [self.code, self.crashed, outputs]

    def resume(self, snapshot: Sequence[Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self.code, self.crashed = snapshot[0], snapshot[1]
        for output, (key, before) in zip(self.outputs, snapshot[2], strict=True):
            output.key = None if key is None else (key[0], key[1])
            output.before = of_json(before)

    def run(self, block: Block, found: list[Found]) -> None:
        """Evaluate a block; a function that raises is not called again, its outputs are unknown."""
        if self.crashed or not block.times:
            return
        codes = self._codes(block)
        if self._columns and not block.few:
            counts = (len(found), self.evaluations)
            before = (self.code, [output.key for output in self.outputs], *counts)
            try:
                self._at_once(block, codes, found)
            except CRASHES:  # one by one shows at which instant
                self._set_back(found, *before)
            else:
                return
        self._one_by_one(block, codes, found)

    def _set_back(
        self, found: list[Found], code: int, keys: list[Key | None], count: int, evaluations: int
    ) -> None:
        self.code, self.evaluations = code, evaluations
        del found[count:]
        for output, key in zip(self.outputs, keys, strict=True):
            output.key, output.times, output.column = key, [], []

    def _codes(self, block: Block) -> Any:
        """Return how fresh the worst of the inputs is; None where all are fresh everywhere."""
        if self._sees_silence:
            return None
        worst: Any = None
        for entry in self.inputs:
            codes = block.flow_codes(entry, self._stale_s)
            worst = codes if worst is None or worst is codes else np.maximum(worst, codes)
        for entry in self._valued:
            codes = freshness.value_codes(entry, block.instants)
            if codes is not None:
                worst = codes if worst is None else np.maximum(worst, codes)
        return worst

    def _one_by_one(self, block: Block, codes: Any, found: list[Found]) -> None:
        listed = [freshness.FRESH] * len(block.times) if codes is None else codes.tolist()
        if any(listed):
            listed = self._with_culprits(block).tolist()
        is_due = self._is_due(block)
        for now, code, due in zip(block.times, listed, is_due.tolist(), strict=True):
            if code == freshness.FRESH:
                if due or self.code != code:
                    try:
                        self._evaluate_one(now, found)
                    except CRASHES as error:  # whatever it is: other modes go on
                        self._crash(now, error, found)
                        return
            elif code != self.code:
                self._not_fresh(now, code, found)
            self.code = code

    def _is_due(self, block: Block) -> Any:
        """Return at which instants of a block the results may be others than before."""
        if not self._timed:
            return block.has_rows
        return block.is_quarter | block.has_rows if self._is_short else block.is_quarter

    def _crash(self, now: int, error: BaseException, found: list[Found]) -> None:
        self.crashed = readable(f"crashed: {type(error).__name__}: {error}".rstrip(": "))
        self._say(now, "unknown", self.crashed, found)

    def _evaluate_one(self, now: int, found: list[Found]) -> None:
        results = self._evaluate(self._config, self.inputs, now)
        self.evaluations += 1
        for output in self.outputs:
            judge = output.judge
            code, kept = judge.one(results.get(judge.result))
            if code == AS_BEFORE:
                code, kept = self._as_before(output)
            key = (code, kept if judge.is_discrete else None)
            output.times.append(now)
            output.column.append(kept)
            if key != output.key:
                output.key = key
                found.append(self._found(output, now, code, kept, results))

    @staticmethod
    def _as_before(output: OutputRun) -> tuple[int, Any]:
        """Return what an output was last, or as it should be if it was nothing yet."""
        if output.key is not None and output.key[0] in (OK, BAD):
            return output.key
        return MappingRun._nominal(output)

    @staticmethod
    def _nominal(output: OutputRun) -> tuple[int, Any]:
        return OK, FALSE if output.plan.expectation.value is False else TRUE

    def _found(
        self, output: OutputRun, now: int, code: int, kept: Any, results: Mapping[str, Any]
    ) -> Found:
        why = ""
        if code == BAD:
            why = self._why(now, results)
        elif code == NOT_KNOWN:
            why = self._explained(self._explain_unknown, results)
            why = why or f"{output.plan.name} is not known"
        return Found(now, output.number, _WHAT[code], output.judge.output(kept), why)

    def _why(self, now: int, results: Mapping[str, Any]) -> str:
        """Say why an output is bad: by what was looked at, else by the results."""
        told = ""
        try:
            if self._reason is not None:
                told = str(self._reason(self._config, Given(self.inputs, now, self._unit)))
        except CRASHES as error:  # what was found stands, whatever its words
            return _not_explained(error)
        return readable(told) if told else self._explained(self._explain, results)

    def _explained(self, explain: Any, results: Mapping[str, Any]) -> str:
        """Ask a function of the mode to explain its results; empty where it has none."""
        if explain is None:
            return ""
        plain = {n: _plain(value, n in self._bools) for n, value in results.items()}
        try:
            return readable(str(explain(self._config, plain)))
        except CRASHES as error:  # what was found stands, whatever its words
            return _not_explained(error)

    def _with_culprits(self, block: Block) -> Any:
        """Return the codes with the place of the first input that is as bad: it changes alone."""
        worst: Any = np.zeros(len(block.times), np.int64)
        places = np.zeros(len(block.times), np.int64)
        for place, entry in enumerate(self.inputs):
            codes = block.flow_codes(entry, self._stale_s)
            values = freshness.value_codes(entry, block.instants) if entry in self._valued else None
            codes = codes if values is None else np.maximum(codes, values)
            places[codes > worst] = place
            worst = np.maximum(worst, codes)
        return worst + places * _CODES

    def _not_fresh(self, now: int, code: int, found: list[Found]) -> None:
        place, code = divmod(code, _CODES)
        self._say(now, *freshness.reason(code, self.inputs[place], self._stale_s, now), found)

    def _say(self, now: int, what: What, why: str, found: list[Found]) -> None:
        for output in self.outputs:
            output.key = None
            output.times.append(now)
            output.column.append(None)
            found.append(Found(now, output.number, what, None, why))

    def _at_once(self, block: Block, codes: Any, found: list[Found]) -> None:
        count = len(block.times)
        codes = np.full(count, freshness.FRESH) if codes is None else codes
        if codes.any():
            codes = self._with_culprits(block)
        before = np.concatenate([[self.code], codes[:-1]])
        is_fresh = codes == freshness.FRESH
        is_due = self._is_due(block)
        wanted = is_fresh & (is_due | (codes != before))
        turns = np.flatnonzero(~is_fresh & (codes != before)).tolist()
        starts = [0, *turns, count]
        for start, end in pairwise(starts):
            if start in turns:
                self._not_fresh(block.times[start], int(codes[start]), found)
            rows = np.flatnonzero(wanted[start:end]) + start
            if len(rows):
                self._evaluate_many(block.instants[rows], found)
        self.code = int(codes[-1])

    def _evaluate_many(self, instants: IntArray, found: list[Found]) -> None:
        results = self._evaluate(self._config, self.inputs, instants)
        count = len(instants)
        self.evaluations += count
        times: list[int] = instants.tolist()
        for output in self.outputs:
            codes, kept = output.judge.many(results.get(output.judge.result), count)
            if (codes == AS_BEFORE).any():
                codes, kept = self._filled(output, codes, kept)
            output.times += times
            output.column += kept
            for row in self._changes(output, codes, kept):
                values = {name: _row(value, row, count) for name, value in results.items()}
                found.append(self._found(output, times[row], int(codes[row]), kept[row], values))

    def _filled(self, output: OutputRun, codes: Any, kept: list[Any]) -> tuple[Any, list[Any]]:
        """Fill in what it was before where it is to stay like that; unknown is no such thing."""
        decided = np.where(np.isin(codes, (OK, BAD)), np.arange(len(codes)), -1)
        last = np.maximum.accumulate(decided)
        was_unknown = np.maximum.accumulate(np.where(codes == NOT_KNOWN, np.arange(len(codes)), -1))
        first = self._as_before(output)
        nominal = self._nominal(output)
        codes, kept = codes.copy(), list(kept)
        for row in np.flatnonzero(codes == AS_BEFORE).tolist():
            if was_unknown[row] > last[row]:
                codes[row], kept[row] = nominal
            elif last[row] < 0:
                codes[row], kept[row] = first
            else:
                codes[row], kept[row] = codes[last[row]], kept[last[row]]
        return codes, kept

    @staticmethod
    def _changes(output: OutputRun, codes: Any, kept: list[Any]) -> list[int]:
        """Return the rows where an output is judged otherwise than before, or has another value."""
        if output.judge.is_bool:
            marks = codes.astype(np.int64) * 8 + np.array([v or 0 for v in kept], np.int64)
        elif output.judge.is_discrete:
            numbers: dict[Any, int] = {}
            marks = np.array([numbers.setdefault(v, len(numbers)) for v in kept]) * 8 + codes
        else:
            marks = np.asarray(codes, np.int64)
        rows: list[int] = (np.flatnonzero(marks[1:] != marks[:-1]) + 1).tolist()
        key = (int(codes[0]), kept[0] if output.judge.is_discrete else None)
        changed = [0, *rows] if key != output.key else rows
        output.key = (int(codes[-1]), kept[-1] if output.judge.is_discrete else None)
        return changed


def _not_explained(error: BaseException) -> str:
    return readable(f"no explanation: {type(error).__name__}: {error}")


def _plain(value: Any, is_bool: bool) -> Any:
    """Return a result as plain Python; a bool that is not known is None, a number NaN."""
    if np.ndim(value) == 0 and isinstance(value, np.ndarray | np.generic):
        value = value.item()
    if is_bool and value is not None:
        return None if int(value) in (UNKNOWN, HOLD) else bool(value)
    return value


def _row(value: Any, row: int, count: int) -> Any:
    return value if np.ndim(value) == 0 else value[row]
