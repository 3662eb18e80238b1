"""Directives of a rule file: ``:- table p/2.`` and ``:- dynamic p/1.``; others are refused."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, TypeAlias

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.terms import (
    Key,
    Struct,
    Term,
    Var,
    args_of,
    deref,
    key_of,
    split_list,
)
from amberbox.diagnosis.rules.unknown import refusal

Declaration: TypeAlias = Literal["table", "dynamic", "discontiguous", "multifile"]
_DECLARATIONS = ("table", "dynamic", "discontiguous", "multifile")


def declarations(directive: Term) -> Iterator[tuple[Declaration, Key]]:
    """Yield what a directive declares; raise RuleFault if it is no declaration."""
    directive = deref(directive)
    key = key_of(directive)
    if key is None or not isinstance(directive, Struct) or key[0] not in _DECLARATIONS:
        name = "this" if key is None else key[0]
        hint = refusal(key) if key is not None else ""
        listing = "there are :- table name/2. and :- dynamic name/1."
        raise RuleFault(f"the directive {name} is not supported", hint or listing)
    kind: Declaration = key[0]  # type: ignore[assignment]  # it is one of them
    for part in directive.args:
        for indicator in _parts(part):
            yield kind, _indicated(indicator, kind)


def _parts(term: Term) -> Iterator[Term]:
    term = deref(term)
    if isinstance(term, Struct) and term.name == "," and len(term.args) == 2:
        yield from _parts(term.args[0])
        yield from _parts(term.args[1])
    elif isinstance(term, Struct) and term.name == "[|]":
        yield from split_list(term)[0]
    else:
        yield term


def _indicated(term: Term, kind: Declaration) -> Key:
    term = deref(term)
    if isinstance(term, Struct) and term.name == "/" and len(term.args) == 2:
        name, count = deref(term.args[0]), deref(term.args[1])
        if isinstance(name, str) and isinstance(count, int) and count >= 0:
            return name, count
    elif kind == "table" and isinstance(term, Struct) and all(map(_is_free, args_of(term))):
        return term.name, len(term.args)
    raise RuleFault(f"{kind} needs a name and a number of arguments", f"such as: :- {kind} p/2.")


def _is_free(arg: Term) -> bool:
    return isinstance(deref(arg), Var)
