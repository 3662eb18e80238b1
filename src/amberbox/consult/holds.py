"""When a condition held in a record: what ``holds/3`` of rules looks up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from amberbox.blackbox.keeper.conditions import condition_problem, instants_of
from amberbox.blackbox.query.variables import resolve
from amberbox.consult.span import DAY_NS, Window, in_words, joined
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.expression import Expression, parse
from amberbox.core.types import IntArray
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.intervals import Interval, Keys, Span
from amberbox.diagnosis.rules.proof import Source
from amberbox.diagnosis.rules.terms import Term, Text
from amberbox.diagnosis.rules.writer import write

_BLOCK_NS = 900 * NS
_MOST_BLOCKS = 16
"""So many blocks that are wanted together are read together."""
_LOOKBACKS_NS = (60 * NS, 3600 * NS)
"""So far back the value at the beginning is sought, before the whole run is."""
_HINT = "give both times in a goal before it (mission(M, failed, From, To)), or --from T --to T"


@dataclass(frozen=True, slots=True)
class _Read:
    """An address of an expression, and where the record has it."""

    address: str
    item: str
    variable: str
    column: str


@dataclass(frozen=True)
class _Question:
    """A condition, what it reads, and what is known of it by blocks of time."""

    when: Expression
    reads: tuple[_Read, ...]
    known: dict[int, list[Span]]


class Conditions:
    """Looks up when conditions held; what was read once is remembered."""

    def __init__(self, window: Window) -> None:
        self._window = window
        self._questions: dict[str, _Question] = {}

    def find(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield when a condition held, in order of time.

        Raises RuleFault for what is no condition, and for all of a long record.
        """
        (given,) = keys
        question = self._question(given)
        first, last = self._window.cut(span)
        if span is None and last - first > DAY_NS and not self._window.is_given:
            what = f"holds({write(given or '_')}, _, _) would look through {_days(last - first)}"
            raise RuleFault(what, _HINT)
        for found in self._held(question, first, max(last, first + 1)):
            yield Interval((given,), *found, _source(question, found))

    def _question(self, given: Term | None) -> _Question:
        if not isinstance(given, str | Text):
            what = "is no condition" if given is not None else "has no condition"
            shown = write(given) if given is not None else "holds(_, _, _)"
            hint = "write it as an expression in quotes: holds('sim_battery.charge < 20', F, T)"
            raise RuleFault(f"{shown} {what}", hint)
        text = given if isinstance(given, str) else given.value
        if text not in self._questions:
            try:
                self._questions[text] = self._made(parse(text))
            except AmberboxError as error:
                raise RuleFault(f"condition '{text}': {error.what}", error.hint) from error
        return self._questions[text]

    def _made(self, when: Expression) -> _Question:
        problem = condition_problem(when)
        if problem:
            raise UsageError(problem, "docs/expressions.md describes conditions")
        return _Question(when, tuple(map(self._read, when.addresses())), {})

    def _read(self, address: str) -> _Read:
        item, _, variable = address.partition(".")
        columns = self._window.record.variables(item).columns
        found = resolve(columns, [variable], item)
        if len(found) != 1:
            raise UsageError(f"'{address}' stands for {len(found)} variables", "name one of them")
        return _Read(address, item, variable, found[0].name)

    def _held(self, question: _Question, first: int, last: int) -> Iterator[Span]:
        """Yield when it held, at least as far as a span reaches, joined."""
        blocks = range(first // _BLOCK_NS, (last - 1) // _BLOCK_NS + 1)
        missing = [block for block in blocks if block not in question.known]
        for start, count in _stretches(missing):
            self._look(question, start, count)
        yield from joined(found for block in blocks for found in question.known[block])

    def _look(self, question: _Question, start: int, count: int) -> None:
        """Read some blocks, and remember when the condition held in each."""
        since, until = start * _BLOCK_NS, (start + count) * _BLOCK_NS
        found: list[Span] = []
        for run in self._window.recorded:
            first, last = self._window.cut((max(run[0], since), min(run[1], until)))
            if first < last:
                found.extend(self._in_run(question, run[0], first, last))
        for block in range(start, start + count):
            edges = block * _BLOCK_NS, (block + 1) * _BLOCK_NS
            inside = ((max(f, edges[0]), min(t, edges[1])) for f, t in found)
            question.known[block] = [(f, t) for f, t in inside if f < t]

    def _in_run(self, question: _Question, run_ns: int, first: int, last: int) -> Iterator[Span]:
        """Yield when it held within ``[first, last)`` of a run that began at ``run_ns``."""
        series = self._series(question, run_ns, first, last)
        edge = np.array([first], np.int64)
        instants = [edge, *instants_of(question.when, series, first, last - 1)]
        times = np.concatenate(instants)
        holds = _true(question.when.evaluate_series(series, times))
        yield from _spans(times, holds, last)

    def _series(self, question: _Question, run_ns: int, first: int, last: int) -> dict[str, Any]:
        series: dict[str, Any] = {}
        by_item: dict[str, list[_Read]] = {}
        for read in question.reads:
            by_item.setdefault(read.item, []).append(read)
        for item, reads in by_item.items():
            series |= self._rows(item, reads, question.when.history_ns, run_ns, first, last)
        return series

    def _rows(
        self, item: str, reads: list[_Read], history_ns: int, run_ns: int, first: int, last: int
    ) -> dict[str, Any]:
        """Return the rows of an item, beginning with the one that counts at ``first``."""
        names = ["received", *dict.fromkeys(read.variable for read in reads)]
        reached = first - history_ns
        for back_ns in (*_LOOKBACKS_NS, None):
            since = run_ns if back_ns is None else max(run_ns, reached - back_ns)
            table = self._window.record.query(item, names, since, last)
            received = table.columns["received"]
            assert isinstance(received, np.ndarray)  # it is never a list
            if since == run_ns or (len(received) and received.min() <= reached):
                break
        assert isinstance(received, np.ndarray)  # it is never a list
        times: IntArray = np.maximum.accumulate(received)
        return {read.address: (times, table.columns[read.column]) for read in reads}


def _true(values: Any) -> Any:
    """Tell where a condition is known to be true."""
    data = np.ma.getdata(values)
    if data.dtype != bool:
        if not np.ma.getmaskarray(values).all():
            raise RuleFault("is no condition", "compare it with something, such as: x > 0")
        return np.zeros(len(values), bool)
    return data & ~np.ma.getmaskarray(values)


def _spans(times: IntArray, holds: Any, end: int) -> Iterator[Span]:
    """Yield from where to where it holds; each value counts until the next instant."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8)))
    until = np.append(times, end)
    yield from zip(times[edges[::2]].tolist(), until[edges[1::2]].tolist(), strict=True)


def _stretches(blocks: list[int]) -> Iterator[tuple[int, int]]:
    """Join neighbouring blocks: first and how many."""
    start, count = 0, 0
    for block in blocks:
        if count and block == start + count and count < _MOST_BLOCKS:
            count += 1
            continue
        if count:
            yield start, count
        start, count = block, 1
    if count:
        yield start, count


def _source(question: _Question, span: Span) -> Source:
    items = ", ".join(dict.fromkeys(read.item for read in question.reads))
    evidence = tuple((read.address, *span) for read in question.reads)
    return Source(f"record, {items}, {in_words(span)}", evidence)


def _days(length_ns: int) -> str:
    return f"{length_ns / DAY_NS:.1f} days of the record"
