"""The built-in predicates by name: those with one solution at most, and those with several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from amberbox.diagnosis.rules import builtin_atoms, builtin_lists, builtin_terms
from amberbox.diagnosis.rules.terms import Key, Term

if TYPE_CHECKING:
    from amberbox.diagnosis.rules.machine import Machine

Test: TypeAlias = "Callable[[Machine, list[Term]], bool]"
Several: TypeAlias = "Callable[[Machine, list[Term]], Iterator[Any]]"

TESTS: Mapping[Key, Test] = {
    **builtin_terms.TESTS,
    **builtin_atoms.TESTS,
    **builtin_lists.TESTS,
}
SEVERAL: Mapping[Key, Several] = {
    **builtin_terms.SEVERAL,
    **builtin_atoms.SEVERAL,
    **builtin_lists.SEVERAL,
}
