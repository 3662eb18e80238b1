"""Turn clauses as read into the form that the solver runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from amberbox.diagnosis.rules import control
from amberbox.diagnosis.rules.builtins import SEVERAL, TESTS
from amberbox.diagnosis.rules.clauses import Clause, Goal, Op, chain, flatten
from amberbox.diagnosis.rules.faults import Place, RuleFault
from amberbox.diagnosis.rules.terms import Key, Pattern, Slot, Struct, Term, Var, deref, key_of

Where = Callable[[Term], "Place | None"]
"""Says where a goal stands."""

CONTROL: frozenset[Key] = frozenset(
    {(",", 2), (";", 2), ("|", 2), ("->", 2), ("\\+", 1), ("not", 1), ("!", 0), ("findall", 3),
     ("forall", 2), ("once", 1), ("ignore", 1), ("true", 0), ("fail", 0), ("false", 0),
     *(("call", count) for count in range(1, 9))}
)  # fmt: skip
"""Goals that steer the search; rules cannot define them."""

FIXED: frozenset[Key] = CONTROL | TESTS.keys() | SEVERAL.keys()
"""Goals that rules cannot define."""


def compile_clause(term: Term, place: Place, where: Where, names: dict[Var, str]) -> Clause:
    """Compile a fact or a rule; raise RuleFault if it can be neither."""
    head, body = term, None
    if isinstance(term, Struct) and term.name == ":-" and len(term.args) == 2:
        head, body = deref(term.args[0]), term.args[1]
    key = key_of(head)
    if key is None:
        raise RuleFault("a fact or the head of a rule must have a name", "such as: broken(X)")
    compiler = _Compiler(where)
    patterns = tuple(compiler.pattern(arg) for arg in head.args) if isinstance(head, Struct) else ()
    used = len(compiler.slots)
    goals = compiler.goals(body) if body is not None else None
    shown = () if body is None else tuple(compiler.pattern(goal) for goal in flatten(body))
    size = len(compiler.slots)
    labels = tuple(names.get(variable, "_") for variable in compiler.slots)
    return Clause(key, patterns, goals, size, tuple(range(used, size)), place, shown, labels)


def compile_goal(term: Term, place: Place | None = None) -> Goal | None:
    """Compile a goal whose variables are in use already; None if there is nothing to do."""
    return _Compiler(lambda _: place, in_use=True).goals(term)


@dataclass
class _Compiler:
    where: Where
    slots: dict[Var, Slot] = field(default_factory=dict)
    in_use: bool = False

    def pattern(self, term: Term) -> Term:
        """Replace variables by slots; what has none stays as it is."""
        if self.in_use:
            return term
        spine: list[tuple[Struct, list[Term]]] = []
        term = deref(term)
        while isinstance(term, Struct):
            spine.append((term, [self.pattern(part) for part in term.args[:-1]]))
            term = deref(term.args[-1])
        if isinstance(term, Var):
            term = self.slots.setdefault(term, Slot(len(self.slots)))
        for struct, parts in reversed(spine):
            args = (*parts, term)
            is_open = any(isinstance(arg, Slot | Pattern) for arg in args)
            term = Pattern(struct.name, args) if is_open else struct
        return term

    def goals(self, body: Term) -> Goal | None:
        """Compile a body to a chain of goals."""
        return chain([goal for term in flatten(body) for goal in self.goal(term)])

    def goal(self, term: Term) -> Iterator[Goal]:
        """Compile one goal that is no conjunction."""
        key = key_of(term)
        if isinstance(term, Var):
            yield Goal(control.call_term, ("call", 1), (self.pattern(term),))
        elif key is None:
            raise RuleFault("a number or a text is no goal", "a goal has a name: ready(X)")
        elif key in CONTROL:
            yield from self._control(term, key)
        else:
            args = self._args(term)
            yield self._plain(key, args, self.where(term))

    def _args(self, term: Term) -> tuple[Term, ...]:
        return tuple(self.pattern(arg) for arg in term.args) if isinstance(term, Struct) else ()

    def _plain(self, key: Key, args: tuple[Term, ...], place: Place | None) -> Goal:
        if key in TESTS:
            return Goal(control.test, key, args, TESTS[key], place)
        if key in SEVERAL:
            return Goal(control.several, key, args, SEVERAL[key], place)
        return Goal(control.call, key, args, None, place)

    def _control(self, term: Term, key: Key) -> Iterator[Goal]:
        name, place = key[0], self.where(term)
        inner = [deref(arg) for arg in term.args] if isinstance(term, Struct) else []
        args = () if name in (";", "|", "->") else self._args(term)
        if name in (";", "|"):
            yield self._choice(term)
        elif name == "!":
            goal = Goal(control.cut_clause, key, place=place)
            goal.cuts = True
            yield goal
        elif name in ("fail", "false"):
            yield Goal(control.fail, key, place=place)
        elif name == "->":
            parts = [*map(self.goals, inner), self.goals("fail")]
            yield _branching(control.if_then_else, key, parts, place)
        elif name in ("\\+", "not"):
            yield Goal(control.negation, key, args, self.goals(inner[0]), place)
        elif name == "findall":
            yield Goal(control.find_all, key, args, self.goals(inner[1]), place)
        elif name == "forall":
            unless = Struct("\\+", (Struct(",", (inner[0], Struct("\\+", (inner[1],)))),))
            yield Goal(control.negation, key, args, self.goals(unless.args[0]), place)
        elif name in ("once", "ignore"):
            otherwise = None if name == "ignore" else self.goals("fail")
            extra = self.goals(inner[0]), None, otherwise
            yield Goal(control.if_then_else, key, args, extra, place)
        elif name == "call":
            yield self._call(inner, args, place)

    def _call(self, inner: list[Term], args: tuple[Term, ...], place: Place | None) -> Goal:
        if len(inner) == 1 and isinstance(inner[0], Struct):
            return Goal(control.apart, ("call", 1), args, self.goals(inner[0]), place)
        return Goal(control.call_term, ("call", len(args)), args, None, place)

    def _choice(self, term: Term) -> Goal:
        """Compile ``a ; b ; c``, where any may be ``c -> a``, without descending once per ``;``."""
        spine: list[Struct] = []
        while isinstance(term, Struct) and key_of(term) in ((";", 2), ("|", 2)):
            spine.append(term)
            term = deref(term.args[1])
        rest = self.goals(term)
        for choice in reversed(spine):
            first, place = deref(choice.args[0]), self.where(choice)
            if isinstance(first, Struct) and key_of(first) == ("->", 2):
                parts = [*map(self.goals, first.args), rest]
                rest = _branching(control.if_then_else, (";", 2), parts, place)
            else:
                rest = _branching(control.either, (";", 2), [self.goals(first), rest], place)
        assert rest is not None  # there was a choice
        return rest


def _branching(op: Op, key: Key, parts: Sequence[Goal | None], place: Place | None) -> Goal:
    goal = Goal(op, key, (), tuple(parts), place)
    goal.cuts = any(part is not None and part.cuts for part in parts[-2:])  # not the condition's
    return goal
