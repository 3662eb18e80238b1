"""What a question is answered with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from amberbox.diagnosis.rules.proof import Node
from amberbox.diagnosis.rules.terms import Real, Term, Text, Var, deref, split_list
from amberbox.diagnosis.rules.whynot import Failure
from amberbox.diagnosis.rules.writer import write

Answer: TypeAlias = Mapping[str, Term]
"""The values of the goal's variables; empty for a goal without variables that is true."""


@dataclass(frozen=True)
class Answers:
    """All answers, each once, why each holds, or why there is none."""

    answers: tuple[Answer, ...]
    proof: tuple[tuple[Node, ...], ...] = ()
    """For each answer the goals that hold, with what they follow from."""
    failed: tuple[Failure, ...] = ()
    steps: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return plain Python for programs."""
        return {
            "answers": [{k: plain(v) for k, v in answer.items()} for answer in self.answers],
            "proof": [[node.to_json() for node in nodes] for nodes in self.proof],
            "failed": [failure.to_json() for failure in self.failed],
        }


_DEEPEST = 100


def plain(term: Term, depth: int = 0) -> Any:
    """Turn a term into plain Python: atoms and texts are strings, structures are written.

    So are lists nested more than 100 deep.
    """
    term = deref(term)
    if isinstance(term, str | int):
        return [] if term == "[]" else term
    if isinstance(term, Real):
        return float(term)
    if isinstance(term, Text):
        return term.value
    items, tail = split_list(term)
    if items and tail == "[]" and depth < _DEEPEST:
        return [plain(item, depth + 1) for item in items]
    return None if isinstance(term, Var) else write(term)


def show(answer: Answer) -> str:
    """Write an answer as one line: ``X = m1, Y = 3``, or yes."""
    return ", ".join(f"{k} = {write(v, most=699)}" for k, v in answer.items()) or "yes"
