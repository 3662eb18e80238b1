"""Evaluate one mode over a block of instants: freshness of its inputs, its function, its outputs.

A value that is too old counts as missing; outputs are compared with their expectation, one value or
a whole column.
"""

from __future__ import annotations

import math
import operator
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.conditions import as_json, from_json
from amberbox.core.contracts import ModeContract
from amberbox.core.flow import Flow, Stalls
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Given, Input
from amberbox.core.types import IntArray, Output
from amberbox.monitoring.findings import (
    OutputChange,
    OutputCondition,
    valid_text,
)
from amberbox.monitoring.plan import Expectation, MappingPlan, ModePlan, OutputPlan

FRESH, NO_VALUE, NEVER, OLD, LOST = 0, 1, 2, 3, 4  # in order: of several inputs the highest counts


def flow_codes(flow: Flow, stale_s: float | None, instants: IntArray) -> Any:
    """Return a freshness code for each instant: whether messages of an item still arrive."""
    ages = flow.age_s(instants)
    codes = np.where(np.isinf(ages), NEVER, FRESH)
    if stale_s is not None:
        codes = np.where(np.isfinite(ages) & (ages > stale_s), OLD, codes)
    if len(flow.gap_from_ns):
        codes = np.where(flow.lost(instants) & np.isfinite(ages), LOST, codes)
    return codes


def value_codes(entry: Input, instants: IntArray) -> Any:
    """Return where a variable has a value; None where it has one at all instants."""
    samples = entry.samples
    if samples.null is None and len(samples) and samples.times_ns[0] <= instants[0]:
        return None
    return np.where(samples.known(instants), FRESH, NO_VALUE)


def freshness_reason(
    code: int, entry: Input, stale_s: float | None, at_ns: int
) -> tuple[OutputCondition, str]:
    """Return the condition of an output whose input is not fresh, and the reason."""
    if code == OLD and _is_own_probe(entry):
        return "unknown", f"nobody has looked at {entry.name} for {stale_s:g} s"
    if code == OLD:
        return "stale", f"nothing received of {entry.name} for {stale_s:g} s"
    if code == LOST:
        why = entry.flow.reasons.get(int(entry.flow.gap_from_ns.at(at_ns)), "")
        return "stale", f"the publisher of {entry.name} is lost" + (f": {why}" if why else "")
    if code == NEVER:
        return "unknown", f"nothing received yet of {entry.name}"
    text = _probe_error(entry, at_ns)
    return "unknown", f"{entry.name}: {text}" if text else f"{entry.name} has no value"


def _is_own_probe(entry: Input) -> bool:
    """Return whether the watcher itself measures it: no recorder counts its rows.

    Where it is silent, the watcher was not running: no component is at fault.
    """
    return "ok" in entry.parts and not len(entry.flow.received)


def _probe_error(entry: Input, at_ns: int) -> str:
    """Return why a probe could not measure."""
    errors = entry.parts.get("error")
    if errors is None or not len(errors) or not errors.known(at_ns):
        return ""
    return str(errors.at(at_ns))


OK, BAD, NOT_KNOWN, AS_BEFORE = 0, 1, 2, 3  # verdicts on a value
_TEXT, _NUMBER = (str,), (int, float)
_WHOLE = 1 << 63  # whole numbers beyond this are kept as floats, which JSON can hold

_COMPARE: Mapping[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}


class OutputJudge:
    """Compares the results that one output of a plan is bound to with the expected value."""

    __slots__ = (
        *("result", "is_bool", "is_int", "is_discrete"),
        *("_expectation", "_expected", "_kinds", "_missing"),
    )

    def __init__(self, output: OutputPlan) -> None:
        self.result = output.result.name
        self.is_bool = output.type == "bool"
        self.is_int = output.type == "int"
        self.is_discrete = output.type in ("bool", "string")
        expects = output.expectation
        self._expectation: Expectation | None = None if expects.value is None else expects
        is_simple = self.is_bool and isinstance(expects.value, bool) and expects.relation == "=="
        self._expected = (TRUE if expects.value else FALSE) if is_simple else None
        self._kinds = "biu" if self.is_bool else "U" if self.is_discrete else "biuf"
        judged = self.is_bool or self._expectation is not None
        self._missing = NOT_KNOWN if judged else OK

    def one(self, result: Any) -> tuple[int, Any]:
        """Evaluate one value, or None; return the verdict and the kept value (bools as their code).

        Raises TypeError if it is not of the output's type.
        """
        if result is None:
            return self._missing, None
        if self.is_bool:
            code = int(result)
            if code > TRUE:
                return (AS_BEFORE if code == HOLD else NOT_KNOWN), code
            if self._expected is not None:
                return (OK if code == self._expected else BAD), code
            return self._compared(code), code
        plain = result.item() if isinstance(result, np.generic | np.ndarray) else result
        if not isinstance(plain, _TEXT if self.is_discrete else _NUMBER):
            wanted = "text" if self.is_discrete else "number"
            raise TypeError(f"{self.result} is no {wanted}: {repr(plain)[:60]}")
        if isinstance(plain, str):
            plain = valid_text(plain)
        elif isinstance(plain, int) and not -_WHOLE <= plain < _WHOLE:
            plain = float(plain)
        return self._compared(plain), plain

    def _compared(self, value: Any) -> int:
        expectation = self._expectation
        if expectation is None:
            return OK
        if value is None or value != value:
            return NOT_KNOWN
        try:
            good = meets(expectation, value)
        except TypeError:
            return NOT_KNOWN
        return OK if good else BAD

    def many(self, results: Any, count: int) -> tuple[Any, list[Any]]:
        """Evaluate a column; return the verdicts and the kept values."""
        column = np.broadcast_to(np.asarray(results), (count,))
        if column.dtype.kind not in self._kinds:
            judged = [self.one(value) for value in column]
            return np.array([code for code, _ in judged], np.int8), [value for _, value in judged]
        if self.is_bool:
            kept = column.astype(np.int8)
            if self._expected is not None:
                known = np.where(kept == self._expected, OK, BAD)
            else:
                known = self._compared_column(kept.astype(np.float64))
            unknown = np.where(kept == HOLD, AS_BEFORE, NOT_KNOWN)
            return np.where(kept > TRUE, unknown, known), kept.tolist()
        if self.is_discrete:
            return self._compared_column(column), [valid_text(text) for text in column.tolist()]
        return self._compared_column(column), column.tolist()

    def _compared_column(self, column: Any) -> Any:
        expectation = self._expectation
        if expectation is None:
            return np.full(len(column), OK)
        codes = np.where(meets(expectation, column), OK, BAD)
        return np.where(column != column, NOT_KNOWN, codes)

    def output(self, kept: Any) -> Output:
        """Return a kept value in its readable form."""
        if kept is None:
            return None
        if self.is_bool:
            return None if kept > TRUE else kept == TRUE
        if isinstance(kept, float):
            if math.isnan(kept):
                return None
            return int(kept) if self.is_int and abs(kept) < _WHOLE else kept
        value: Output = kept
        return value


def meets(expectation: Expectation, value: Any) -> Any:
    """Return whether a value, or each of a column, is as expected."""
    if expectation.relation == "within":
        return (value >= expectation.value) & (value <= expectation.high)
    return _COMPARE[expectation.relation](value, expectation.value)


QUARTER_NS = NS // 4  # modes that depend on time are evaluated at multiples of this
# Modes with a shorter window are evaluated wherever rows came, too: a jump between two samples is
# then in some window that is as long as two periods of the item, which ``check`` asks for.
SHORT_S = 0.5
_CODES = 8  # more than the number of freshness codes; multiplies the place of an input
_FEW = 4  # up to so many instants are evaluated one by one
_WHAT: tuple[OutputCondition, ...] = ("ok", "bad", "unknown")

CRASHES = (Exception, SystemExit)  # what disables a mode that raises it

Key = tuple[int, Any]  # verdict on an output and, of bools and texts, its value


class InstantBlock:
    """Instants that are evaluated together for all modes that read the same items."""

    __slots__ = ("codes", "few", "has_rows", "instants", "is_quarter", "times")

    def __init__(self, instants: IntArray, has_rows: Any) -> None:
        self.instants = instants
        self.times: list[int] = instants.tolist()
        self.has_rows = has_rows
        """Where rows arrived since the previous instant."""
        self.is_quarter = instants % QUARTER_NS == 0
        self.codes: dict[tuple[int, float | None], Any] = {}
        self.few = len(self.times) <= _FEW

    def without(self, stalls: Stalls, window_ns: int) -> InstantBlock:
        """Return the block without instants whose window holds a stall of the recorder."""
        if not window_ns or not len(stalls):
            return self
        keep = ~stalls.spoils(self.instants, window_ns)
        return self if keep.all() else InstantBlock(self.instants[keep], self.has_rows[keep])

    def flow_codes(self, entry: Input, stale_s: float | None) -> Any:
        """Return the freshness of an input's item, computed once per block."""
        key = (id(entry.flow), stale_s)
        codes = self.codes.get(key)
        if codes is None:
            codes = self.codes[key] = flow_codes(entry.flow, stale_s, self.instants)
        return codes


class OutputRun:
    """One output over several blocks: its last verdict, and its values in this block."""

    __slots__ = ("before", "column", "judge", "key", "number", "plan", "times")

    def __init__(self, number: int, plan: OutputPlan) -> None:
        self.number = number
        self.plan = plan
        self.judge = OutputJudge(plan)
        self.forget()

    def forget(self) -> None:
        """Reset: nothing was found yet."""
        self.key: Key | None = None
        self.times: list[int] = []
        self.column: list[Any] = []
        self.before: Any = None

    @property
    def last(self) -> Any:
        """Return its newest kept value."""
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
        contract: ModeContract,
        plan: MappingPlan,
        inputs: Sequence[Input],
        outputs: Sequence[OutputRun],
    ) -> None:
        self._mode = contract
        units = (output.plan.result.unit for output in outputs)
        self._unit = next((unit for unit in units if unit), "")
        self._timed = contract.is_timed(mode.config)
        self._is_short = 0 < contract.shortest_window_s(mode.config) < SHORT_S
        # How far back it looks at values; silence and rates take stalls into account themselves.
        self._sees_silence = contract.is_called_in_silence(mode.config)
        back_s = 0.0 if self._sees_silence else contract.looks_back_s(mode.config)
        self.window_ns = round(back_s * NS)
        self._config, self._stale_s = mode.config, mode.stale_s
        results = [*contract.results, *(output.plan.result for output in outputs)]
        self._bools = {result.name for result in results if result.type == "bool"}
        self.inputs, self.outputs = inputs, outputs
        kinds = [entry.kind for entry in (*plan.inputs, *plan.reads)]
        self._valued = [entry for entry, kind in zip(inputs, kinds, strict=True) if kind != "item"]
        self.code = FRESH - 1
        self.crashed = ""
        self.evaluations = 0

    def forget(self) -> None:
        """Reset all state."""
        self.code = FRESH - 1
        self.crashed = ""

    def snapshot(self) -> list[Any]:
        """Return the state needed by ``resume``."""
        outputs = [[output.key, as_json(output.last)] for output in self.outputs]
        return [self.code, self.crashed, outputs]

    def resume(self, snapshot: Sequence[Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self.code, self.crashed = snapshot[0], snapshot[1]
        for output, (key, before) in zip(self.outputs, snapshot[2], strict=True):
            output.key = None if key is None else (key[0], key[1])
            output.before = from_json(before)

    def run(self, block: InstantBlock, found: list[OutputChange]) -> None:
        """Evaluate a block; a function that raises is not called again, its outputs are unknown."""
        if self.crashed or not block.times:
            return
        codes = self._codes(block)
        if self._mode.columns and not block.few:
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
        self,
        found: list[OutputChange],
        code: int,
        keys: list[Key | None],
        count: int,
        evaluations: int,
    ) -> None:
        self.code, self.evaluations = code, evaluations
        del found[count:]
        for output, key in zip(self.outputs, keys, strict=True):
            output.key, output.times, output.column = key, [], []

    def _codes(self, block: InstantBlock) -> Any:
        """Return the worst freshness of the inputs; None where all are fresh everywhere."""
        if self._sees_silence:
            return None
        worst: Any = None
        for entry in self.inputs:
            codes = block.flow_codes(entry, self._stale_s)
            worst = codes if worst is None or worst is codes else np.maximum(worst, codes)
        for entry in self._valued:
            codes = value_codes(entry, block.instants)
            if codes is not None:
                worst = codes if worst is None else np.maximum(worst, codes)
        return worst

    def _one_by_one(self, block: InstantBlock, codes: Any, found: list[OutputChange]) -> None:
        listed = [FRESH] * len(block.times) if codes is None else codes.tolist()
        if any(listed):
            listed = self._with_culprits(block).tolist()
        is_due = self._is_due(block)
        for now, code, due in zip(block.times, listed, is_due.tolist(), strict=True):
            if code == FRESH:
                if due or self.code != code:
                    try:
                        self._evaluate_one(now, found)
                    except CRASHES as error:  # whatever it is: other modes go on
                        what = f"crashed: {type(error).__name__}: {error}"
                        self.crashed = valid_text(what.rstrip(": "))
                        self._emit_unknown(now, "unknown", self.crashed, found)
                        return
            elif code != self.code:
                self._not_fresh(now, code, found)
            self.code = code

    def _is_due(self, block: InstantBlock) -> Any:
        """Return at which instants of a block the results may differ from before."""
        if not self._timed:
            return block.has_rows
        return block.is_quarter | block.has_rows if self._is_short else block.is_quarter

    def _evaluate_one(self, now: int, found: list[OutputChange]) -> None:
        results = self._mode.evaluate(self._config, self.inputs, now)
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
        """Return the last verdict and value of an output; before any, the expected ones."""
        if output.key is not None and output.key[0] in (OK, BAD):
            return output.key
        return MappingRun._nominal(output)

    @staticmethod
    def _nominal(output: OutputRun) -> tuple[int, Any]:
        return OK, FALSE if output.plan.expectation.value is False else TRUE

    def _found(
        self, output: OutputRun, now: int, code: int, kept: Any, results: Mapping[str, Any]
    ) -> OutputChange:
        why = ""
        if code == BAD:
            why = self._why(now, results)
        elif code == NOT_KNOWN:
            why = self._explained(self._mode.explain_unknown, results)
            why = why or f"{output.plan.name} is not known"
        return OutputChange(now, output.number, _WHAT[code], output.judge.output(kept), why)

    def _why(self, now: int, results: Mapping[str, Any]) -> str:
        """Return why an output is bad: by the values that were evaluated, else by the results."""
        text = ""
        try:
            if self._mode.reason is not None:
                text = str(self._mode.reason(self._config, Given(self.inputs, now, self._unit)))
        except CRASHES as error:  # what was found stands, whatever its words
            return _not_explained(error)
        return valid_text(text) if text else self._explained(self._mode.explain, results)

    def _explained(self, explain: Any, results: Mapping[str, Any]) -> str:
        """Return the explanation of a mode's function; empty where it has none."""
        if explain is None:
            return ""
        plain = {n: _plain(value, n in self._bools) for n, value in results.items()}
        try:
            return valid_text(str(explain(self._config, plain)))
        except CRASHES as error:  # what was found stands, whatever its words
            return _not_explained(error)

    def _with_culprits(self, block: InstantBlock) -> Any:
        """Return the codes combined with the place of the first input that is the worst."""
        worst: Any = np.zeros(len(block.times), np.int64)
        places = np.zeros(len(block.times), np.int64)
        for place, entry in enumerate(self.inputs):
            codes = block.flow_codes(entry, self._stale_s)
            values = value_codes(entry, block.instants) if entry in self._valued else None
            codes = codes if values is None else np.maximum(codes, values)
            places[codes > worst] = place
            worst = np.maximum(worst, codes)
        return worst + places * _CODES

    def _not_fresh(self, now: int, code: int, found: list[OutputChange]) -> None:
        place, code = divmod(code, _CODES)
        self._emit_unknown(
            now, *freshness_reason(code, self.inputs[place], self._stale_s, now), found
        )

    def _emit_unknown(
        self, now: int, what: OutputCondition, why: str, found: list[OutputChange]
    ) -> None:
        for output in self.outputs:
            output.key = None
            output.times.append(now)
            output.column.append(None)
            found.append(OutputChange(now, output.number, what, None, why))

    def _at_once(self, block: InstantBlock, codes: Any, found: list[OutputChange]) -> None:
        count = len(block.times)
        codes = np.full(count, FRESH) if codes is None else codes
        if codes.any():
            codes = self._with_culprits(block)
        before = np.concatenate([[self.code], codes[:-1]])
        is_fresh = codes == FRESH
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

    def _evaluate_many(self, instants: IntArray, found: list[OutputChange]) -> None:
        results = self._mode.evaluate(self._config, self.inputs, instants)
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
                values = {n: v if np.ndim(v) == 0 else v[row] for n, v in results.items()}
                found.append(self._found(output, times[row], int(codes[row]), kept[row], values))

    def _filled(self, output: OutputRun, codes: Any, kept: list[Any]) -> tuple[Any, list[Any]]:
        """Replace HOLD by the last decided value; after an unknown one, by the nominal one."""
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
        """Return the rows at which an output has another verdict or value than before."""
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
    return valid_text(f"no explanation: {type(error).__name__}: {error}")


def _plain(value: Any, is_bool: bool) -> Any:
    """Return a result as plain Python; a bool that is not known is None, a number NaN."""
    if np.ndim(value) == 0 and isinstance(value, np.ndarray | np.generic):
        value = value.item()
    if is_bool and value is not None:
        return None if int(value) in (UNKNOWN, HOLD) else bool(value)
    return value
