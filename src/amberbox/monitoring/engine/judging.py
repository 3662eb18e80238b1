"""Whether an output is as it is expected to be: one value, or a column of them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from amberbox.core.mode import FALSE, HOLD, TRUE
from amberbox.core.types import Output
from amberbox.monitoring.engine.keeping import readable
from amberbox.monitoring.plan import Expectation, OutputPlan

OK, BAD, NOT_KNOWN, AS_BEFORE = 0, 1, 2, 3
"""What a value is judged to be."""
_TEXT, _NUMBER = (str,), (int, float)
_WHOLE = 1 << 63
"""Whole numbers beyond this are kept as floats, which JSON can hold."""

_COMPARE: Mapping[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}


class Judge:
    """Judges the results that one output of a plan is bound to."""

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
        """Judge one value, None if there is none; return it as it is kept (bools as their code).

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
            plain = readable(plain)
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
            good = holds(expectation, value)
        except TypeError:
            return NOT_KNOWN
        return OK if good else BAD

    def many(self, results: Any, count: int) -> tuple[Any, list[Any]]:
        """Judge a column; return codes and the values as they are kept."""
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
            return self._compared_column(column), [readable(text) for text in column.tolist()]
        return self._compared_column(column), column.tolist()

    def _compared_column(self, column: Any) -> Any:
        expectation = self._expectation
        if expectation is None:
            return np.full(len(column), OK)
        codes = np.where(holds(expectation, column), OK, BAD)
        return np.where(column != column, NOT_KNOWN, codes)

    def output(self, kept: Any) -> Output:
        """Return a value that was kept as people read it."""
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


def holds(expectation: Expectation, value: Any) -> Any:
    """Tell whether a value, or each of a column, is as expected."""
    if expectation.relation == "within":
        return (value >= expectation.value) & (value <= expectation.high)
    return _COMPARE[expectation.relation](value, expectation.value)
