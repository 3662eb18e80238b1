"""What is probably a mistake in a rule: variables that nothing links to the rest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

from amberbox.diagnosis.rules.clauses import flatten
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.reader import Sentence
from amberbox.diagnosis.rules.terms import Struct, Term, Var, deref
from amberbox.diagnosis.rules.unify import free_variables


def suspicions(sentence: Sentence) -> Iterator[RuleFault]:
    """Yield what is odd about a fact or a rule."""
    names = {variable: name for name, variable in sentence.names.items()}
    single = [n for n, count in sentence.counts.items() if count == 1 and n[0] != "_"]
    if single:
        which = " and ".join(single)
        verb = "occurs" if len(single) == 1 else "occur"
        hint = f"is it misspelt? If it may be anything, write _{single[0]}"
        yield RuleFault(f"{which} {verb} only once in this rule", hint)
    term = sentence.term
    if isinstance(term, Struct) and term.name == ":-" and len(term.args) == 2:
        yield from _unlinked(term.args[0], term.args[1], names)


def _unlinked(head: Term, body: Term, names: Mapping[Var, str]) -> Iterator[RuleFault]:
    in_head = free_variables([head])
    goals = [set(free_variables([goal])) for goal in flatten(body)]
    if not in_head or _is_choice(body):
        return
    groups = _linked(group for group in goals if group)
    strangers = [
        sorted(names[variable] for variable in group if variable in names)
        for group in groups
        if not group & set(in_head)
    ]
    loose = [name for group in strangers for name in group if name[0] != "_"]
    if loose:
        which, others = _joined(names.get(v, "_") for v in in_head), _joined(loose)
        what = f"nothing links {which} of the head to {others}: it holds for every {which}"
        yield RuleFault(what, f"add a goal with both, or write _{loose[0]} if any will do")


def _is_choice(body: Term) -> bool:
    """Tell whether the body as a whole is a choice, whose branches need not be linked."""
    body = deref(body)
    return isinstance(body, Struct) and body.name in (";", "->")


def _linked(goals: Iterable[set[Var]]) -> list[set[Var]]:
    """Join goals that share variables."""
    groups: list[set[Var]] = []
    for goal in goals:
        touching = [group for group in groups if group & goal]
        groups = [group for group in groups if not group & goal]
        groups.append(goal.union(*touching))
    return groups


def _joined(words: Iterable[str]) -> str:
    return " or ".join(Counter(words))
