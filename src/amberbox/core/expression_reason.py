"""Why a condition holds or not, in words: its terms with what they are and what they may be."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from typing import Any, Final

from amberbox.core.expression import Expression, ExpressionError
from amberbox.core.expression_tree import (
    Address,
    Age,
    Arithmetic,
    Call,
    Comparison,
    Constant,
    Held,
    Logic,
    Negative,
    Not,
    Tree,
    Window,
)
from amberbox.core.samples import Samples

TERMS: Final = 2
"""So many terms are told."""
_LONG: Final = 90
"""Characters: what compares more than this is not read by anybody."""
_NOT: Final = {"<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "=="}
_TURNED: Final = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_WORDS: Final = {
    "<": "below", "<=": "at most", ">": "above", ">=": "at least",
    "==": "expected", "!=": "expected other than",
}  # fmt: skip


def reason(
    expression: Expression, samples: Mapping[str, Samples], now_ns: int, *, expected: bool
) -> str:
    """Say which terms make a condition what it should not be; empty where that is too long.

    ``expected`` is what it should be. ``sim_battery.current < 0.3`` that is expected and does not
    hold gives ``current is 0.52, below 0.3``.
    """
    terms = dict.fromkeys(_Values(samples, now_ns).terms(expression.tree, expected))
    told = "; ".join(list(terms)[:TERMS])
    return told if len(told) <= TERMS * _LONG else ""


def number_text(value: float) -> str:
    """Write a number so that people can compare it with a limit."""
    return f"{value:.4g}"


def variable_text(address: str) -> str:
    """Call a variable by its own name, without its item: ``cell voltage[3]``."""
    return address.rpartition("/")[2].partition(".")[2].replace("_", " ").strip() or address


class _Values:
    """Says what terms are at an instant."""

    def __init__(self, samples: Mapping[str, Samples], now_ns: int) -> None:
        self._samples = samples
        self._now_ns = now_ns

    def terms(self, tree: Tree, expected: bool) -> Iterator[str]:
        """Yield the terms that make a part other than it is expected to be."""
        if isinstance(tree, Not):
            yield from self.terms(tree.inner, not expected)
        elif isinstance(tree, Held):
            yield from self.terms(tree.inner, expected)
        elif isinstance(tree, Logic):
            for part in self._to_blame(tree, expected):
                yield from self.terms(part, expected)
        elif isinstance(tree, Comparison):
            yield from self._compared(tree, expected)
        elif isinstance(tree, Address):
            yield f"{variable_text(tree.name)} is {'false' if expected else 'true'}"

    def _to_blame(self, tree: Logic, expected: bool) -> Iterable[Tree]:
        """Return the parts that are other than expected; without guards that only count samples."""
        wrong = [part for part in tree.operands if self._number(part) == float(not expected)]
        return [part for part in wrong if not _is_guard(part)] or wrong

    def _compared(self, tree: Comparison, expected: bool) -> Iterator[str]:
        for operator, (left, right) in zip(tree.operators, pairwise(tree.operands), strict=True):
            pair = Comparison(tree.at, (operator,), (left, right))
            if self._number(pair) != float(not expected):
                continue
            allowed = operator if expected else _NOT[operator]
            if isinstance(left, Constant):
                left, right, allowed = right, left, _TURNED[allowed]
            yield f"{_words(left)} is {self._shown(left)}, {_WORDS[allowed]} {self._limit(right)}"

    def _limit(self, tree: Tree) -> str:
        if isinstance(tree, Constant):
            return _constant(tree.value)
        return f"{self._shown(tree)} ({_words(tree)})"

    def _shown(self, tree: Tree) -> str:
        if isinstance(tree, Address):
            return _constant(self._samples[tree.name].at(self._now_ns))
        return number_text(self._number(tree))

    def _number(self, tree: Tree) -> float:
        """Return a part as a number; NaN where it is unknown, or no number."""
        try:
            return float(Expression("", tree).numbers(self._samples, self._now_ns))
        except (ExpressionError, ValueError, TypeError):
            return float("nan")


def _is_guard(tree: Tree) -> bool:
    """Tell whether a part only asks whether there are samples enough."""
    operands = tree.operands if isinstance(tree, Comparison) else ()
    return any(isinstance(part, Window) and part.name == "count" for part in operands)


def _constant(value: Any) -> str:
    if hasattr(value, "item"):
        value = value.item()
    if value is None or isinstance(value, bool):
        return {True: "true", False: "false", None: "unknown"}[value]
    return number_text(value) if isinstance(value, int | float) else f"'{value}'"


def _words(tree: Tree) -> str:
    """Write a part in plain words, the more so the longer it is."""
    if isinstance(tree, Constant):
        return _constant(tree.value)
    if isinstance(tree, Address):
        return variable_text(tree.name)
    if isinstance(tree, Age):
        return f"the age of {_words(tree.inner)}"
    if isinstance(tree, Window):
        return f"the {tree.name} of {_words(tree.inner)} over {tree.over_ns / 1e9:g} s"
    if isinstance(tree, Negative):
        return f"-{_words(tree.inner)}"
    if isinstance(tree, Arithmetic):
        return f"{_words(tree.left)} {tree.operator} {_words(tree.right)}"
    if isinstance(tree, Call):
        shown = [_words(part) for part in tree.arguments[:1]]
        return f"{tree.name}({', '.join([*shown, *(['...'] if len(tree.arguments) > 1 else [])])})"
    return "the condition"
