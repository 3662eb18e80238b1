"""The solver: goals run from left to right with choice points, and the proof of each answer.

Clauses and predicates in the form that it runs, predicates whose facts are looked up when they
are called, and the budget of a question.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from amberbox.core.contracts import Budget as Budget
from amberbox.diagnosis.prolog.syntax import Names, anonymous, write
from amberbox.diagnosis.prolog.terms import (
    TOO_DEEP,
    Copies,
    Env,
    Key,
    Memo,
    RuleError,
    RuleFault,
    Slot,
    SourcePosition,
    StopFault,
    Struct,
    Term,
    Trail,
    Var,
    copy,
    deref,
    freeze,
    make,
    match,
    show_key,
    to_term,
    undo,
    unify,
)

# What is left to do: goal, its variables, height to cut to, the frame after it, depth
Frame: TypeAlias = tuple["PrologGoal", Any, int, Any, int]

# Runs one goal and returns what to do next, None if the goal fails
Op: TypeAlias = "Callable[[PrologMachine, PrologGoal, Env, int, Frame], Frame | None]"

Origin: TypeAlias = Literal["file", "facts", "library", "vocabulary"]

_MOST_INDEXED = 4


class PrologGoal:
    """One goal of a clause, linked to the goal after it."""

    __slots__ = ("args", "cuts", "extra", "key", "next", "op", "place")

    def __init__(
        self, op: Op, key: Key, args: tuple[Term, ...] = (), extra: Any = None,
        place: SourcePosition | None = None,
    ) -> None:  # fmt: skip
        self.op = op
        self.key = key
        self.args = args
        self.extra = extra
        self.place = place
        self.next: PrologGoal | None = None
        self.cuts = False


@dataclass(slots=True, eq=False)
class PrologClause:
    """A fact or a rule: its head, its goals, and the text's own terms for showing it."""

    key: Key
    head: tuple[Term, ...]
    body: PrologGoal | None
    size: int
    fresh: tuple[int, ...]  # slots that only the body uses
    place: SourcePosition
    goals: tuple[Term, ...] = ()  # the body in source order, as patterns
    names: tuple[str, ...] = ()  # names of the variables by slot
    calls: dict[Key, SourcePosition] = field(default_factory=dict)  # where the body calls what


@dataclass(slots=True, eq=False)
class PrologPredicate:
    """All clauses of one name and number of arguments."""

    key: Key
    clauses: list[PrologClause] = field(default_factory=list)
    origin: Origin = "file"
    tabled: bool = False
    virtual: Virtual | None = None
    indexes: dict[int, _Index | None] = field(default_factory=dict)

    def add(self, clause: PrologClause) -> None:
        """Append a clause; the indexes are made again when they are needed."""
        self.clauses.append(clause)
        self.indexes.clear()

    def with_clauses(self, clauses: Sequence[PrologClause]) -> PrologPredicate:
        """Return a predicate with more clauses at its end."""
        return PrologPredicate(
            self.key, [*self.clauses, *clauses], self.origin, self.tabled, self.virtual
        )

    def select(self, args: Sequence[Term]) -> Sequence[PrologClause]:
        """Return the clauses that may match a call, in source order."""
        best: Sequence[PrologClause] = self.clauses
        if len(best) < 2:
            return best
        for place, arg in enumerate(args[:_MOST_INDEXED]):
            arg = deref(arg)
            if type(arg) is Var:
                continue
            index = self.indexes[place] if place in self.indexes else self._make_index(place)
            if index is not None:
                found = index.entries.get(index_key(arg), index.others)
                if len(found) < len(best):
                    best = found
                    if len(best) < 2:
                        break
        return best

    def _make_index(self, place: int) -> _Index | None:
        made = self.indexes[place] = _index(self.clauses, place)
        return made


@dataclass(slots=True)
class _Index:
    """Clauses by the value of one argument; ``others`` match every value."""

    entries: dict[Hashable, list[PrologClause]]
    others: list[PrologClause]


def index_key(term: Term) -> Hashable:
    """Return what two terms have in common if they may be equal."""
    return (term.name, len(term.args)) if isinstance(term, Struct) else term


def _index(clauses: Sequence[PrologClause], place: int) -> _Index | None:
    patterns = [clause.head[place] for clause in clauses]
    if all(type(pattern) is Slot for pattern in patterns):
        return None
    index = _Index({}, [])
    for pattern, clause in zip(patterns, clauses, strict=True):
        if type(pattern) is Slot:
            index.others.append(clause)
            for entry in index.entries.values():
                entry.append(clause)
        else:
            entry = index.entries.setdefault(index_key(pattern), list(index.others))
            entry.append(clause)
    return index


def chain(goals: Sequence[PrologGoal]) -> PrologGoal | None:
    """Link goals to each other and return the first one; None for no goals."""
    first: PrologGoal | None = None
    for goal in reversed(goals):
        goal.next = first
        goal.cuts = goal.cuts or (first is not None and first.cuts)
        first = goal
    return first


def flatten(term: Term) -> Iterator[Term]:
    """Yield the goals of a conjunction from left to right."""
    term = deref(term)
    while isinstance(term, Struct) and term.name == "," and len(term.args) == 2:
        yield from flatten(term.args[0])
        term = deref(term.args[1])
    if term != "true":
        yield term


# What was proved so far, newest first: (older, ENTER, clause, args), (older, EXIT) or (older, LEAF,
# term or Node)
Trace: TypeAlias = "tuple[Any, ...] | None"

ENTER, EXIT, LEAF = "enter", "exit", "leaf"

# Most characters of one goal that is shown as a reason; a longer one ends with ...
LONGEST_GOAL = 500

_DEEPEST = 40  # deepest goal of a proof that is shown by indentation, and that is nested in JSON

Kind: TypeAlias = Literal["rule", "fact", "builtin", "lookup"]


@dataclass(frozen=True, slots=True)
class LookupSource:
    """The source of a lookup, in words, and the measured data: address, from, to in ns."""

    text: str
    evidence: tuple[tuple[str, int, int], ...] = ()


class LookedUp(NamedTuple):
    """A goal that was proven by a lookup."""

    goal: Term
    source: LookupSource


@dataclass(slots=True, eq=False)
class ProofNode:
    """A goal that holds: by a rule (then its goals are below it), a fact, a lookup, or built in."""

    goal: Term
    kind: Kind
    place: SourcePosition | None = None
    children: list[ProofNode] = field(default_factory=list)
    source: LookupSource | None = None  # where it was looked up

    def leaves(self) -> Iterator[ProofNode]:
        """Yield the facts and built-in goals at the ends of the tree, from left to right."""
        for node, _, is_again in self.walk():
            if not node.children and not is_again:
                yield node

    def walk(self) -> Iterator[tuple[ProofNode, int, bool]]:
        """Yield every node with its depth, and whether it was already shown with its children."""
        shown: set[int] = set()
        open_nodes = [(self, 0)]
        while open_nodes:
            node, depth = open_nodes.pop()
            is_again = id(node) in shown and bool(node.children)
            yield node, depth, is_again
            if not is_again:
                shown.add(id(node))
                open_nodes.extend((child, depth + 1) for child in reversed(node.children))

    def text(self, names: Names = anonymous) -> str:
        """Write the tree, one goal per line, indented by depth; very deep ones by a number."""
        lines = []
        for node, depth, is_again in self.walk():
            note = "   (shown above)" if is_again else _source(node)
            goal = write(node.goal, names, longest=LONGEST_GOAL)
            lines.append(f"{_indent(depth)}{goal}{note}")
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return the tree as plain Python; the children of a repeated goal are given once.

        Goals deeper than 40 are in a flat list, in order, each with its ``depth``.
        """
        root: dict[str, Any] | None = None
        path: list[dict[str, Any]] = []
        for node, depth, is_again in self.walk():
            goal = write(node.goal, longest=LONGEST_GOAL)
            entry: dict[str, Any] = {"goal": goal, "by": node.kind}
            entry |= {"depth": depth} if depth > _DEEPEST else {}
            entry |= {"at": str(node.place)} if node.place is not None else {}
            entry |= {"at": node.source.text} if node.source is not None else {}
            entry |= {"shown_above": True} if is_again else {}
            del path[min(depth, _DEEPEST) :]
            if path:
                path[-1].setdefault("because", []).append(entry)
            path.append(entry)
            root = root or entry
        return root or {}


def _indent(depth: int) -> str:
    return "  " * depth if depth <= _DEEPEST else f"{'  ' * _DEEPEST}({depth}) "


def _source(node: ProofNode) -> str:
    if node.kind == "builtin":
        return ""
    if node.source is not None:
        return f"   {node.source.text}"
    return f"   {node.kind}, {node.place}" if node.place is not None else f"   {node.kind}"


def nodes_of(trace: Trace) -> list[ProofNode]:
    """Return the goals that a trace proves, in the order in which they were run."""
    root = ProofNode("true", "builtin")
    path = [root]
    copied: Copies = {}
    hidden: list[int] = []
    for event in _events(trace):
        if event[1] == EXIT:
            if hidden and hidden[-1] == len(path):
                hidden.pop()
            path.pop()
            continue
        node = event[2] if isinstance(event[2], ProofNode) else _node(event, copied)
        if not hidden:
            path[-1].children.append(node)
        if event[1] == ENTER:
            path.append(node)
            if event[2].place.file == LIBRARY and not hidden:
                hidden.append(len(path))
    return root.children


# File of the rules that come with the language: they are shown as if they were built in
LIBRARY = "library"


def node_of(trace: Trace, goal: Term) -> ProofNode:
    """Return the only goal that a trace proves, with the bindings after the proof."""
    node = nodes_of(trace)[0]
    return ProofNode(goal, node.kind, node.place, node.children)


def _events(trace: Trace) -> list[tuple[Any, ...]]:
    events = []
    while trace is not None:
        events.append(trace)
        trace = trace[0]
    return events[::-1]


def _node(event: tuple[Any, ...], copied: Copies) -> ProofNode:
    if event[1] == LEAF:
        leaf = event[2]
        if isinstance(leaf, LookedUp):
            return ProofNode(freeze(leaf.goal, copied), "lookup", source=leaf.source)
        return ProofNode(freeze(leaf, copied), "builtin")
    clause: PrologClause = event[2]
    goal = make(clause.key[0], [freeze(arg, copied) for arg in event[3]])
    if clause.place.file == LIBRARY:
        return ProofNode(goal, "builtin")
    return ProofNode(goal, "fact" if clause.body is None else "rule", clause.place)


def copy_trace(trace: Trace, memo: Memo) -> Trace:
    """Copy a trace together with terms that share its variables."""
    copied: Trace = None
    for _, kind, *rest in _events(trace):
        if kind == ENTER:
            args = tuple(copy(arg, memo) for arg in rest[1])
            copied = (copied, ENTER, rest[0], args)
        elif kind == LEAF:
            copied = (copied, LEAF, _copied(rest[0], memo))
        else:
            copied = (copied, EXIT)
    return copied


def _copied(leaf: Term | ProofNode | LookedUp, memo: Memo) -> Term | ProofNode | LookedUp:
    if isinstance(leaf, ProofNode):
        return leaf
    if isinstance(leaf, LookedUp):
        return LookedUp(copy(leaf.goal, memo), leaf.source)
    return copy(leaf, memo)


# One solution: a value for every argument; strings are atoms, sequences are lists
Row = Sequence[object]


class SourcedRow(NamedTuple):
    """A solution, and where it was found."""

    row: Row
    source: LookupSource


# Gets the arguments of a call, None where there is no value yet, and returns rows. It may return
# rows that do not match what it was given; they are left out.
Lookup: TypeAlias = "Callable[[tuple[Term | None, ...]], Iterable[Row | SourcedRow]]"


@dataclass(frozen=True, slots=True)
class Virtual:
    """A predicate that is a lookup.

    ``needs`` are the arguments, counted from 1, that must have a value; of several sets one is
    enough. Calls with too few are refused with ``hint``. ``clauses`` writes the results as Prolog
    that gives the same answers, for calls with given values of the first argument.
    """

    name: str
    arity: int
    solve: Lookup
    needs: tuple[frozenset[int], ...] = ()
    hint: str = ""
    clauses: Callable[[Iterable[Term]], Iterator[str]] | None = None

    @property
    def key(self) -> Key:
        """Return name and number of arguments."""
        return self.name, self.arity

    def solutions(self, m: PrologMachine, args: Sequence[Term]) -> Iterator[LookupSource | None]:
        """Bind the arguments of a call to one row after the other; yield where it was found."""
        given = tuple(_given(arg) for arg in args)
        bound = {number for number, value in enumerate(given, 1) if value is not None}
        if self.needs and not any(needed <= bound for needed in self.needs):
            raise self._unbounded(args)
        mark = len(m.trail)
        for found in self.solve(given):
            row, source = found if isinstance(found, SourcedRow) else (found, None)
            if len(row) != self.arity:
                raise RuleFault(f"a row for {show_key(self.key)} has {len(row)} values")
            if all(m.unify(arg, to_term(part)) for arg, part in zip(args, row, strict=True)):
                yield source
            undo(m.trail, mark)

    def _unbounded(self, args: Sequence[Term]) -> RuleFault:
        goal = write(make(self.name, args))
        wanted = " or ".join(_numbers(needed) for needed in self.needs)
        what = f"{goal} would look through everything: it needs {wanted}"
        return RuleFault(what, self.hint or "give them values, in a goal before this one")


def _given(arg: Term) -> Term | None:
    arg = deref(arg)
    return None if isinstance(arg, Var) else copy(arg, None)


def _numbers(needed: frozenset[int]) -> str:
    names = " and ".join(str(number) for number in sorted(needed))
    return f"argument{'s' if len(needed) > 1 else ''} {names}"


_CHANGES = "rules cannot change facts here: what is known comes from files and from the robot"
_OUTPUT = "rules cannot read or write: ask a goal and look at its answers"
_FILES = "give several files: they are read as one"
_REFUSED: dict[str, str] = {
    **dict.fromkeys(("assert", "asserta", "assertz", "retract", "retractall", "abolish"), _CHANGES),
    **dict.fromkeys(
        ("write", "print", "writeln", "nl", "format", "read", "writeq", "write_canonical",
         "put_char",
         "tab", "open", "close", "consult", "print_message", "read_term", "write_term"), _OUTPUT),
    **dict.fromkeys(("catch", "throw"), "an error ends the question and is shown"),
    **dict.fromkeys(("bagof", "setof", "^"), "use findall, and sort for each solution once"),
    **dict.fromkeys(("shell", "halt", "getenv", "setenv"), "rules cannot reach the system"),
    **dict.fromkeys(("use_module", "module", "ensure_loaded"), _FILES),
    **dict.fromkeys(("nb_setval", "b_setval", "nb_getval", "b_getval"), _CHANGES),
    **dict.fromkeys(
        ("+", "-", "*", "/", "//", "mod", "rem", "div", "**", "<<", "/\\", "\\/", "xor"),
        "it makes a number of numbers: X is 1 + 2, or compare with =:= and <"),
    ">>": "as a goal it is a lambda of SWI-Prolog's yall: write a rule of its own and call that; "
          "as a shift it stands behind is",
    "*->": "use (once(A) -> B ; C) or (A, B)",
    ":": "there are no modules: write the goal without its module",
}  # fmt: skip


def refusal(key: Key) -> str:
    """Return why something of Prolog is left out, nothing if it is not known."""
    return _REFUSED.get(key[0], "")


def unknown_predicate(key: Key, known: Iterable[Key]) -> RuleFault:
    """Return the fault of an unknown predicate, with the nearest known name."""
    name = show_key(key)
    hint = refusal(key)
    if hint:
        return RuleFault(f"{name} is not supported", hint)
    keys = list(known)
    counts = sorted(count for other, count in keys if other == key[0])
    if counts:
        there_is = " and ".join(show_key((key[0], count)) for count in counts)
        return RuleFault(f"there is no {name}, but {there_is}", "count the arguments")
    near = difflib.get_close_matches(key[0], sorted({other for other, _ in keys}), n=1, cutoff=0.7)
    suggestion = f"; did you mean '{near[0]}'?" if near else ""
    hint = f"define it, or declare that it may be empty: :- dynamic {name}."
    return RuleFault(f"there is no predicate {name}{suggestion}", hint)


# Length of the trail, trace, a function that goes on, and its arguments
Choice: TypeAlias = tuple[Any, ...]

_EVERY = 256
_LARGE = 65_536
_MOST_BOUND = 3_000_000


class PrologMachine:
    """Runs one goal; ``trace`` is kept only when the reasons are wanted."""

    def __init__(
        self, predicates: Mapping[Key, PrologPredicate], budget: Budget, *, proving: bool = False
    ) -> None:
        self.predicates = predicates
        self.budget = budget
        self.proving = proving
        self.trail: Trail = []
        self.choices: list[Choice] = []
        self.trace: Trace = None
        self.steps = 0
        self.charged = 0
        self.check_at = _EVERY
        self.solved = False
        self.goal: PrologGoal | None = None
        self.frame: Frame | None = None
        self.tables: dict[Any, Any] = {}
        self.stack: list[Any] = []  # tables that are being filled, outermost first

    def start(self, goal: PrologGoal | None) -> None:
        """Prepare to run a chain of goals."""
        done: Frame = (_DONE, [], 0, None, 0)
        self.frame = done if goal is None else (goal, [], 0, done, 1)

    def next(self) -> bool:
        """Run to the next solution; False when there are no more.

        Raises RuleError where a goal cannot be run and StopFault when the budget is used up.
        """
        frame, self.frame = self.frame, None
        try:
            return self._run(frame)
        except RuleFault as fault:
            raise self._explained(fault) from fault
        except RecursionError as error:
            raise self._explained(RuleFault(*TOO_DEEP)) from error

    def _run(self, frame: Frame | None) -> bool:
        steps = self.steps
        check_at = self.check_at
        while True:
            steps += 1
            if steps >= check_at:
                self.check_at = check_at = steps + _EVERY
                self.steps = steps
                self._check(0 if frame is None else frame[4])
            if frame is None:
                if self.solved or not self.choices:
                    self.steps = steps
                    found, self.solved = self.solved, False
                    return found
                frame = self._retry()
                continue
            goal, env, cut, up, depth = frame
            self.goal = goal
            follows = goal.next
            after = up if follows is None else (follows, env, cut, up, depth)
            frame = goal.op(self, goal, env, cut, after)

    def _retry(self) -> Frame | None:
        mark, self.trace, go_on, *rest = self.choices.pop()
        undo(self.trail, mark)
        frame: Frame | None = go_on(self, *rest)
        return frame

    def _check(self, depth: int) -> None:
        budget = self.budget
        if self.steps > budget.steps:
            raise StopFault(f"stopped after {self.steps:,} steps")
        if depth > budget.depth:
            raise StopFault(f"stopped {depth:,} goals deep, after {self.steps:,} steps")
        if len(self.trail) + len(self.choices) > _MOST_BOUND:
            raise StopFault(f"stopped after {self.steps:,} steps for want of memory")
        if budget.is_over():
            raise StopFault(f"stopped after {self.steps:,} steps, the time is over")
        if not self.choices:
            self.trail.clear()

    def charge(self, size: int) -> None:
        """Count work on something large as steps, so that few steps cannot take for ever."""
        before = self.charged
        self.charged += size
        if self.charged > self.budget.steps:
            raise StopFault(f"stopped after {self.charged:,} steps on ever larger terms")
        if self.charged // _LARGE > before // _LARGE and self.budget.is_over():
            raise StopFault(f"stopped after {self.steps:,} steps, the time is over")

    def charge_text(self, text: str) -> str:
        """Count a text that was made as steps, one for eight characters, and return it."""
        self.charge(len(text) // 8)
        return text

    def choose(self, go_on: Callable[..., Frame | None], *rest: Any) -> None:
        """Add a choice point: an alternative that may be tried from here."""
        self.choices.append((len(self.trail), self.trace, go_on, *rest))

    def cut(self, height: int) -> None:
        """Forget the choices above a height."""
        del self.choices[height:]

    def unify(self, left: Term, right: Term) -> bool:
        """Unify two terms; the bindings are undone on backtracking."""
        return unify(left, right, self.trail)

    def predicate(self, key: Key) -> PrologPredicate:
        """Return the predicate that a goal calls; raise RuleFault if there is none of that name."""
        found = self.predicates.get(key)
        if found is None:
            raise unknown_predicate(key, self.predicates)
        return found

    def call(self, predicate: PrologPredicate, args: Sequence[Term], after: Frame) -> Frame | None:
        """Try the clauses of a predicate that may match."""
        return self._try(predicate.select(args), 0, args, after)

    def _try(
        self, clauses: Sequence[PrologClause], number: int, args: Sequence[Term], after: Frame
    ) -> Frame | None:
        mark, count = len(self.trail), len(clauses)
        while number < count:
            clause = clauses[number]
            number += 1
            env = self._head(clause, args)
            if env is None:
                undo(self.trail, mark)
                continue
            height = len(self.choices)
            if number < count:
                again = (mark, self.trace, PrologMachine._try, clauses, number, args, after)
                self.choices.append(again)
            return self._enter(clause, env, args, height, after)
        return None

    def _head(self, clause: PrologClause, args: Sequence[Term]) -> list[Any] | None:
        env: list[Any] = [None] * clause.size
        for pattern, arg in zip(clause.head, args, strict=True):
            if not match(pattern, arg, env, self.trail):
                return None
        return env

    def _enter(
        self, clause: PrologClause, env: list[Any], args: Sequence[Term], height: int, after: Frame
    ) -> Frame:
        if self.proving:
            self.trace = (self.trace, ENTER, clause, tuple(args))
            after = (_EXIT, None, 0, after, after[4])
        if clause.body is None:
            return after
        for slot in clause.fresh:
            env[slot] = Var()
        return (clause.body, env, height, after, after[4] + 1)

    def each(
        self, solutions: Iterator[Any], goal: PrologGoal, leaf: Term, after: Frame
    ) -> Frame | None:
        """Go on once for every solution that an iterator makes by binding variables."""
        self.goal = goal
        mark, trace = len(self.trail), self.trace
        for source in solutions:
            # What the iterator bound since the mark is undone before it makes the next one.
            self.choices.append((mark, trace, PrologMachine.each, solutions, goal, leaf, after))
            self.note(leaf if source is None else LookedUp(leaf, source))
            return after
        undo(self.trail, mark)
        return None

    def note(self, leaf: Any) -> None:
        """Remember a goal that is true without clauses, or a node of a proof."""
        if self.proving:
            self.trace = (self.trace, LEAF, leaf)

    def _explained(self, fault: RuleFault) -> RuleError:
        goal = self.goal
        where = f"{goal.place}: " if goal is not None and goal.place is not None else ""
        return RuleError(f"{where}{fault.what}", fault.hint)


def term_of(goal: PrologGoal, args: Sequence[Term]) -> Term:
    """Return a goal as a term with its present arguments."""
    return Struct(goal.key[0], tuple(args)) if args else goal.key[0]


def _solved(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> None:
    m.solved = True


def _leave(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    m.trace = (m.trace, EXIT)
    return after


_DONE = PrologGoal(_solved, ("$done", 0))
_EXIT = PrologGoal(_leave, ("$exit", 0))
