"""A rule program: what files, facts, lookups and the library define; its export for SWI-Prolog.

Predicates about intervals of time, such as missions, have from and to as their last arguments.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Literal, TypeAlias

from amberbox.core.config import raise_errors
from amberbox.core.contracts import Span
from amberbox.core.errors import Problem, UsageError
from amberbox.diagnosis.prolog.compiler import FIXED, compile_clause
from amberbox.diagnosis.prolog.datalog import DeductiveDatabase
from amberbox.diagnosis.prolog.machine import (
    LIBRARY,
    LookupSource,
    PrologClause,
    PrologPredicate,
    SourcedRow,
    Virtual,
    flatten,
    refusal,
    unknown_predicate,
)
from amberbox.diagnosis.prolog.syntax import Sentence, atom, read_goal, sentences, write
from amberbox.diagnosis.prolog.terms import (
    TOO_DEEP,
    Key,
    RuleFault,
    SourcePosition,
    Struct,
    Term,
    TextTerm,
    Var,
    args_of,
    build,
    deref,
    free_variables,
    is_atomic,
    key_of,
    make,
    show_key,
    split_list,
    to_term,
)

# The arguments before the times, None where there is no value yet
Keys: TypeAlias = "tuple[Term | None, ...]"


@dataclass(frozen=True, slots=True)
class Interval:
    """An interval in which something held, without its end."""

    values: tuple[object, ...]
    from_ns: int
    to_ns: int
    source: LookupSource


# Returns the intervals of some keys that meet a span, or all: joined where they touch. What lies
# outside of the span may be cut off.
Find: TypeAlias = "Callable[[Keys, Span | None], Iterable[Interval]]"


@dataclass(frozen=True, slots=True)
class Intervals:
    """The definition of a predicate about intervals.

    ``read_time`` reads a time that is written as text. ``throughout``: with both times given it
    must have been so all the time, otherwise at some time.
    """

    name: str
    keys: int
    find: Find
    read_time: Callable[[str], int]
    throughout: bool = False
    needs: tuple[frozenset[int], ...] = ()
    hint: str = ""

    def virtual(self) -> Virtual:
        """Return the predicate."""
        rows, text = partial(_rows, self), partial(_interval_clauses, self)
        return Virtual(self.name, self.keys + 2, rows, self.needs, self.hint, text)


def _rows(of: Intervals, args: tuple[Term | None, ...]) -> Iterator[SourcedRow]:
    *keys, since, until = args
    from_ns, to_ns = _time(since, of), _time(until, of)
    both = None if from_ns is None or to_ns is None else (from_ns, to_ns)
    if both is not None and both[0] > both[1]:
        return
    for found in of.find(tuple(keys), both):
        if _fits(found, from_ns, to_ns, throughout=of.throughout):
            first = found.from_ns if since is None else since
            last = found.to_ns if until is None else until
            yield SourcedRow((*found.values, first, last), found.source)


def _time(given: Term | None, of: Intervals) -> int | None:
    """Return a time in nanoseconds since the epoch.

    Raises RuleFault for an invalid time.
    """
    if given is None or isinstance(given, int):
        return given
    if isinstance(given, str | TextTerm):
        try:
            return of.read_time(given if isinstance(given, str) else given.value)
        except UsageError as error:
            raise RuleFault(f"{of.name}: {error.what}", error.hint) from error
    hint = "times are whole numbers of nanoseconds since 1970, or texts like '2026-11-21T14:00:00Z'"
    raise RuleFault(f"{of.name}: {write(given)} is no time", hint)


def _fits(found: Interval, from_ns: int | None, to_ns: int | None, *, throughout: bool) -> bool:
    begin, end = found.from_ns, found.to_ns
    if from_ns is None:
        return to_ns is None or begin < to_ns <= end
    if to_ns is None or from_ns == to_ns:
        return begin <= from_ns < end
    if throughout:
        return begin <= from_ns and to_ns <= end
    return begin < to_ns and from_ns < end


def _interval_clauses(of: Intervals, firsts: Iterable[Term]) -> Iterator[str]:
    """Write all intervals down as facts, with the clause that answers as the lookup does."""
    names = [f"K{number}" for number in range(1, of.keys + 1)]
    spans = f"{of.name}_span"
    listed = ", ".join((*names, "S", "E"))
    test = "'$covers'" if of.throughout else "'$meets'"
    yield f"{atom(of.name)}({', '.join((*names, 'F', 'T'))}) :-"
    yield f"    {atom(spans)}({listed}),"
    yield f"    {test}(F, T, S, E)."
    yield f":- dynamic {atom(spans)}/{of.keys + 2}."
    for found in _all(of, firsts):
        values = (*found.values, found.from_ns, found.to_ns)
        yield f"{write(make(spans, map(to_term, values)), most=999)}."


def _all(of: Intervals, firsts: Iterable[Term]) -> Iterator[Interval]:
    if not any(1 in needed for needed in of.needs):
        yield from of.find((None,) * of.keys, None)
        return
    for first in firsts:
        yield from of.find((first, *(None,) * (of.keys - 1)), None)


# What the clauses above call, for the end of a program
HELPERS: Sequence[str] = (
    "'$meets'(F, T, S, E) :- var(F), var(T), !, F = S, T = E.",
    "'$meets'(F, T, S, E) :- var(F), !, S < T, T =< E, F = S.",
    "'$meets'(F, T, S, E) :- var(T), !, S =< F, F < E, T = E.",
    "'$meets'(F, F, S, E) :- !, S =< F, F < E.",
    "'$meets'(F, T, S, E) :- F < T, S < T, F < E.",
    "'$covers'(F, T, S, E) :- ( var(F) ; var(T) ; F =:= T ), !, '$meets'(F, T, S, E).",
    "'$covers'(F, T, S, E) :- F < T, S =< F, T =< E.",
)


_WIDEST = 100


class SourceText:
    """A text with the name of its file in messages."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.text = text
        starts = [0]
        for line in text.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self.starts = starts

    def place(self, at: int) -> SourcePosition:
        """Return line and column of a character."""
        line = min(bisect_right(self.starts, at), max(1, len(self.starts) - 1))
        return SourcePosition(self.file, line, at - self.starts[line - 1] + 1)

    def problem(self, fault: RuleFault, at: int, *, is_error: bool = True) -> Problem:
        """Return a problem with its position, and show the line."""
        place = self.place(fault.at if fault.at >= 0 else at)
        what = fault.what + self.picture(place)
        where = f"column {place.column}"
        return Problem(self.file, place.line, where, what, fault.hint, is_error)

    def picture(self, place: SourcePosition) -> str:
        """Return the line of a place with a mark below its column."""
        if not self.text:
            return ""
        start, end = self.starts[place.line - 1], self.starts[place.line]
        line = self.text[start:end].rstrip().expandtabs(1)
        left = max(0, place.column - _WIDEST)
        return f"\n    {line[left : left + _WIDEST + 20]}\n    {' ' * (place.column - 1 - left)}^"


def read_source(path: Path, problems: list[Problem]) -> SourceText | None:
    """Read a file; None and a problem if it cannot be read."""
    try:
        return SourceText(str(path), path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        what = f"cannot be read: {error.strerror}"
        problems.append(Problem(str(path), 1, "file", what))
    except UnicodeDecodeError:
        problems.append(Problem(str(path), 1, "file", "is not UTF-8 text", "save it as UTF-8"))
    return None


Declaration: TypeAlias = Literal["table", "dynamic", "discontiguous", "multifile"]
_DECLARATIONS = ("table", "dynamic", "discontiguous", "multifile")


def declarations(directive: Term) -> Iterator[tuple[Declaration, Key]]:
    """Yield the declarations of a directive; raise RuleFault if it is not a declaration."""
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


# Arguments that are goals
_GOALS: Mapping[Key, tuple[int, ...]] = {
    **{(name, 2): (0, 1) for name in (",", ";", "|", "->", "forall")},
    **{(name, 1): (0,) for name in ("\\+", "not", "once", "ignore", "call")},
    **{("findall", 3): (1,), ("findall", 4): (1,), ("aggregate_all", 3): (1,)},
}


def called_terms(goal: Term) -> Iterator[tuple[Key, Term]]:
    """Yield the goals in a goal that call something, from left to right."""
    open_goals = [goal]
    while open_goals:
        term = deref(open_goals.pop())
        key = key_of(term)
        if key is None:
            continue
        yield key, term
        if isinstance(term, Struct):
            open_goals.extend(term.args[number] for number in reversed(_GOALS.get(key, ())))


def called(goals: Iterable[Term]) -> dict[Key, None]:
    """Return what goals call, each name once."""
    return {key: None for goal in goals for key, _ in called_terms(goal)}


def reachable(goals: Iterable[Term], known: Mapping[Key, PrologPredicate]) -> dict[Key, None]:
    """Return everything that may be called when goals are run."""
    found = called(goals)
    open_keys = list(found)
    while open_keys:
        predicate = known.get(open_keys.pop())
        for clause in predicate.clauses if predicate is not None else ():
            for key in called(clause.goals):
                if key not in found:
                    found[key] = None
                    open_keys.append(key)
    return found


def suspicions(sentence: Sentence) -> Iterator[RuleFault]:
    """Yield warnings about a fact or a rule."""
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
    """Return whether a body is a choice as a whole; its branches need not share variables."""
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


# Predicates of the FMEA, the monitors and the record, with the meaning of the arguments
VOCABULARY: Mapping[Key, str] = {
    ("robot", 1): "a robot",
    ("component", 1): "a component of the FMEA or of the monitors",
    ("type", 2): "component, its type",
    ("part_of", 2): "component, the larger component or robot it belongs to",
    ("function", 1): "a function of the FMEA",
    ("needs", 2): "function or component, what it needs",
    ("failure_mode", 2): "component, one of its failure modes",
    ("class", 3): "component, failure mode, its class",
    ("cause", 3): "component, failure mode, what causes it",
    ("effect", 3): "component, failure mode, the function it takes away",
    ("severity", 3): "component, failure mode, warning, urgent, critical or fatal",
    ("probability", 3): "component, failure mode, how probable it is to be there",
    ("risk", 3): "component, failure mode, S x O x D",
    ("remedy", 3): "component, failure mode, what to do",
    ("symptom", 1): "a symptom of the FMEA",
    ("shows", 3): "component, failure mode, a symptom of it",
    ("test", 2): "a test of the FMEA, what it asks",
    ("outcome", 4): "component, failure mode, a test, what it gives then",
    ("present", 1): "a symptom that is there now",
    ("absent", 1): "a symptom that is known not to be there",
    ("unknown", 1): "a symptom of which nothing is known",
    ("now", 1): "the instant that is asked about: the end of the record, or --at, --to",
    ("status", 4): "component, level, from, to: what monitors said",
    ("state", 4): "component, state, from, to: nominal, not_initialised or a fault state",
    ("mission", 4): "mission, outcome, from, to",
    ("mission_name", 2): "mission, what kind it is",
    ("mission_parameter", 3): "mission, name of a parameter, its value",
    ("holds", 3): "condition, from, to: it was the case at some time",
    ("holds_throughout", 3): "condition, from, to: it was the case all the time",
}


_TEXT = """
append(X, Y, Z) :- '$append'(X, Y, Z).
append(Lists, List) :- '$append'(Lists, List).
'$append'([], []).
'$append'([L|Ls], As) :- '$append'(L, Ws, As), '$append'(Ls, Ws).
'$append'([], L, L).
'$append'([H|T], L, [H|R]) :- '$append'(T, L, R).
member(X, [H|T]) :- '$member'(T, X, H).
'$member'(_, X, X).
'$member'([H|T], X, _) :- '$member'(T, X, H).
memberchk(X, L) :- '$memberchk'(X, L).
'$memberchk'(X, [H|T]) :- ( X = H -> true ; '$memberchk'(X, T) ).
select(X, [X|T], T).
select(X, [H|T], [H|R]) :- select(X, T, R).
exclude(_, [], []).
exclude(P, [X|Xs], Ys) :- ( call(P, X) -> Ys = Zs ; Ys = [X|Zs] ), exclude(P, Xs, Zs).
include(_, [], []).
include(P, [X|Xs], Ys) :- ( call(P, X) -> Ys = [X|Zs] ; Ys = Zs ), include(P, Xs, Zs).
maplist(_, []).
maplist(P, [X|Xs]) :- call(P, X), maplist(P, Xs).
maplist(_, [], []).
maplist(P, [X|Xs], [Y|Ys]) :- call(P, X, Y), maplist(P, Xs, Ys).
maplist(_, [], [], []).
maplist(P, [X|Xs], [Y|Ys], [Z|Zs]) :- call(P, X, Y, Z), maplist(P, Xs, Ys, Zs).
foldl(P, L, A, B) :- '$foldl'(L, P, A, B).
'$foldl'([], _, A, A).
'$foldl'([X|Xs], P, A, C) :- call(P, X, A, B), '$foldl'(Xs, P, B, C).
reverse(L, R) :- '$reverse'(L, [], R).
'$reverse'([], R, R).
'$reverse'([H|T], A, R) :- '$reverse'(T, [H|A], R).
nth0(N, L, X) :- '$nth'(L, 0, N, X).
nth1(N, L, X) :- '$nth'(L, 1, N, X).
'$nth'(L, B, N, X) :- integer(N), !, N >= B, K is N - B, '$nth_known'(K, L, X).
'$nth'([H|T], B, N, X) :- '$nth_open'(T, H, B, N, X).
'$nth_known'(0, [X|_], X) :- !.
'$nth_known'(K, [_|T], X) :- J is K - 1, '$nth_known'(J, T, X).
'$nth_open'(_, H, B, B, H).
'$nth_open'([H|T], _, B, N, X) :- C is B + 1, '$nth_open'(T, H, C, N, X).
last([X], X) :- !.
last([_|T], X) :- last(T, X).
sum_list(L, S) :- '$sum'(L, 0, S).
sumlist(L, S) :- '$sum'(L, 0, S).
'$sum'([], S, S).
'$sum'([X|Xs], A, S) :- B is A + X, '$sum'(Xs, B, S).
max_list(L, M) :- '$max_of'(L, M).
'$max_of'([X|Xs], M) :- '$max'(Xs, X, M).
'$max'([], M, M).
'$max'([X|Xs], A, M) :- B is max(A, X), '$max'(Xs, B, M).
min_list(L, M) :- '$min_of'(L, M).
'$min_of'([X|Xs], M) :- '$min'(Xs, X, M).
'$min'([], M, M).
'$min'([X|Xs], A, M) :- B is min(A, X), '$min'(Xs, B, M).
max_member(M, L) :- '$max_member'(L, M).
'$max_member'([H|T], M) :- '$max_member'(T, H, M).
'$max_member'([], M, M).
'$max_member'([H|T], A, M) :- ( H @=< A -> '$max_member'(T, A, M) ; '$max_member'(T, H, M) ).
min_member(M, L) :- '$min_member'(L, M).
'$min_member'([H|T], M) :- '$min_member'(T, H, M).
'$min_member'([], M, M).
'$min_member'([H|T], A, M) :- ( H @>= A -> '$min_member'(T, A, M) ; '$min_member'(T, H, M) ).
numlist(L, H, []) :- L > H, !, fail.
numlist(H, H, [H]) :- !.
numlist(L, H, [L|T]) :- M is L + 1, numlist(M, H, T).
delete([], _, []).
delete([X|Xs], Y, Zs) :- ( X \\= Y -> Zs = [X|Ws] ; Zs = Ws ), delete(Xs, Y, Ws).
subtract([], _, []).
subtract([X|Xs], L, R) :- ( '$memberchk'(X, L) -> R = S ; R = [X|S] ), subtract(Xs, L, S).
intersection([], _, []).
intersection([X|Xs], L, R) :- ( '$memberchk'(X, L) -> R = [X|S] ; R = S ), intersection(Xs, L, S).
union([], L, L).
union([X|Xs], L, R) :- ( '$memberchk'(X, L) -> R = S ; R = [X|S] ), union(Xs, L, S).
list_to_set(L, S) :- '$to_set'(L, [], S).
'$to_set'([], _, []).
'$to_set'([X|Xs], Seen, S) :-
    ( '$seen'(X, Seen) -> S = T ; S = [X|T] ), '$to_set'(Xs, [X|Seen], T).
'$seen'(X, [Y|_]) :- X == Y, !.
'$seen'(X, [_|T]) :- '$seen'(X, T).
permutation([], []).
permutation([H|T], [X|P]) :- '$select'(X, [H|T], R), permutation(R, P).
'$select'(X, [X|T], T).
'$select'(X, [H|T], [H|R]) :- '$select'(X, T, R).
pairs_keys_values([], [], []).
pairs_keys_values([K-V|T], [K|Ks], [V|Vs]) :- pairs_keys_values(T, Ks, Vs).
pairs_keys([], []).
pairs_keys([K-_|T], [K|Ks]) :- pairs_keys(T, Ks).
pairs_values([], []).
pairs_values([_-V|T], [V|Vs]) :- pairs_values(T, Vs).
findall(T, G, L, Rest) :- findall(T, G, Found), '$append'(Found, Rest, L).
aggregate_all(What, G, R) :- '$aggregate'(What, G, R).
'$aggregate'(count, G, N) :- !, findall(x, G, L), length(L, N).
'$aggregate'(sum(X), G, S) :- !, findall(X, G, L), '$sum'(L, 0, S).
'$aggregate'(max(X), G, M) :- !, findall(X, G, L), '$max_of'(L, M).
'$aggregate'(min(X), G, M) :- !, findall(X, G, L), '$min_of'(L, M).
'$aggregate'(bag(X), G, L) :- !, findall(X, G, L).
'$aggregate'(set(X), G, S) :- !, findall(X, G, L), sort(L, S).
"""


@cache
def library() -> dict[Key, PrologPredicate]:
    """Return the predicates of the standard library."""
    found: dict[Key, PrologPredicate] = {}
    for sentence in sentences(_TEXT):
        if isinstance(sentence, RuleFault):
            raise sentence
        line = _TEXT.count("\n", 0, sentence.at) + 1
        clause = compile_clause(sentence.term, SourcePosition(LIBRARY, line), lambda _: None, {})
        predicate = found.setdefault(clause.key, PrologPredicate(clause.key, origin="library"))
        predicate.add(clause)
    return found


# A name and its values: ("drives", "motor_1", "wheel_2"); strings are atoms
Fact = Sequence[object]


@dataclass(frozen=True)
class Program:
    """Predicates by name and number of arguments, and notes on likely mistakes.

    It does not change; results computed from it are cached in it.
    """

    predicates: Mapping[Key, PrologPredicate]
    notes: tuple[Problem, ...] = ()
    sources: Mapping[str, SourceText] = field(default_factory=dict, repr=False)

    @cached_property
    def known(self) -> Mapping[Key, PrologPredicate]:
        """Everything that a goal may call besides built-in predicates."""
        empty = {key: PrologPredicate(key, origin="vocabulary") for key in VOCABULARY}
        return {**library(), **empty, **self.predicates}

    @cached_property
    def unknown(self) -> tuple[tuple[PrologClause, Key], ...]:
        """Calls of undefined predicates, with the clause that has them."""
        return tuple(
            (clause, key)
            for predicate in self.predicates.values()
            for clause in predicate.clauses
            if clause.body is not None
            for key in called(clause.goals)
            if key not in self.known and key not in FIXED
        )

    @cached_property
    def heads(self) -> Mapping[Key, SourcePosition]:
        """Names and positions of rules that no other rule calls: the conclusions of the program.

        Those of files called ``questions*.pl`` are for manual queries.
        """
        rules = {
            key: clause.place
            for key, predicate in self.predicates.items()
            for clause in reversed(predicate.clauses)
            if clause.body is not None and not Path(clause.place.file).name.startswith("questions")
        }
        used = {
            called_key
            for key, predicate in self.predicates.items()
            for clause in predicate.clauses
            for called_key in called(clause.goals)
            if called_key != key
        }
        return {key: place for key, place in rules.items() if key not in used}

    @cached_property
    def database(self) -> DeductiveDatabase:
        """The relations that were filled from the facts upwards."""
        return DeductiveDatabase(self.known)

    def problems(self) -> list[Problem]:
        """Return the problems of the program as a whole."""
        return [self.unknown_problem(clause, key) for clause, key in self.unknown]

    def unknown_problem(self, clause: PrologClause, key: Key) -> Problem:
        """Return the problem of a clause that calls an undefined predicate."""
        fault = unknown_predicate(key, [*self.known, *FIXED])
        place = clause.calls.get(key, clause.place)
        source = self.sources.get(place.file)
        picture = source.picture(place) if source is not None else ""
        where = f"column {place.column}"
        return Problem(place.file, place.line, where, fault.what + picture, fault.hint)

    def with_facts(self, facts: Iterable[Fact], source: str = "facts") -> Program:
        """Return a program with more facts; ``source`` names them in proofs.

        Raises RuleFault for a value that has no term.
        """
        added: dict[Key, list[PrologClause]] = {}
        for number, (name, *values) in enumerate(facts, 1):
            clause = _fact(
                str(name), [to_term(value) for value in values], SourcePosition(source, number)
            )
            added.setdefault(clause.key, []).append(clause)
        changed = {key: self._own(key).with_clauses(added[key]) for key in added}
        return Program({**self.predicates, **changed}, self.notes, self.sources)

    def with_virtual(self, *virtuals: Virtual) -> Program:
        """Return a program in which some predicates are lookups."""
        made = {v.key: PrologPredicate(v.key, origin="vocabulary", virtual=v) for v in virtuals}
        return Program({**self.predicates, **made}, self.notes, self.sources)

    def _own(self, key: Key) -> PrologPredicate:
        if key in FIXED:
            raise RuleFault(f"{show_key(key)} is built in and cannot have facts")
        return self.predicates.get(key) or PrologPredicate(key, origin="facts")


def _fact(name: str, values: list[Term], place: SourcePosition) -> PrologClause:
    if all(map(is_atomic, values)):
        return PrologClause((name, len(values)), tuple(values), None, 0, (), place)
    return compile_clause(Struct(name, tuple(values)), place, lambda _: None, {})


def read_rules(paths: Iterable[Path | str]) -> Program:
    """Read rule files as one program.

    Raises ConfigurationError with everything that is wrong in them.
    """
    problems: list[Problem] = []
    sources = [read_source(Path(path), problems) for path in paths]
    return _program([source for source in sources if source is not None], problems)


def read_text(text: str, file: str = "rules.pl") -> Program:
    """Read rules from a text; ``file`` is its name in messages."""
    return _program([SourceText(file, text)], [])


def _program(sources: Sequence[SourceText], problems: list[Problem]) -> Program:
    predicates: dict[Key, PrologPredicate] = {}
    for source in sources:
        for sentence in sentences(source.text):
            if isinstance(sentence, RuleFault):
                problems.append(source.problem(sentence, 0))
            else:
                problems.extend(_add(sentence, source, predicates))
    raise_errors(problems)
    return Program(predicates, tuple(problems), {source.file: source for source in sources})


def _add(
    sentence: Sentence, source: SourceText, predicates: dict[Key, PrologPredicate]
) -> Iterator[Problem]:
    """Add a sentence to the predicates; yield its problems."""
    try:
        term = sentence.term
        if isinstance(term, Struct) and term.name in (":-", "?-") and len(term.args) == 1:
            for kind, key in declarations(term.args[0]):
                if key in FIXED:
                    raise RuleFault(f"{show_key(key)} is built in")
                if kind in ("table", "dynamic"):
                    predicate = predicates.setdefault(key, PrologPredicate(key))
                    predicate.tabled = predicate.tabled or kind == "table"
            return
        clause = _compiled(sentence, source)
    except RuleFault as fault:
        yield source.problem(fault, sentence.at)
        return
    except RecursionError:
        yield source.problem(RuleFault(*TOO_DEEP), sentence.at)
        return
    predicates.setdefault(clause.key, PrologPredicate(clause.key)).add(clause)
    for suspicion in suspicions(sentence) if sentence.names else ():
        yield source.problem(suspicion, sentence.at, is_error=False)


def _compiled(sentence: Sentence, source: SourceText) -> PrologClause:
    place = source.place(sentence.at)
    if not sentence.names and not sentence.places and isinstance(sentence.term, Struct):
        term = sentence.term
        return _checked(_fact(term.name, list(term.args), place))

    def where(goal: Term) -> SourcePosition:
        return source.place(sentence.places.get(id(goal), sentence.at))

    names = {variable: name for name, variable in sentence.names.items()}
    clause = _checked(compile_clause(sentence.term, place, where, names))
    if clause.goals:
        body = sentence.term.args[1] if isinstance(sentence.term, Struct) else "true"
        clause.calls = {key: where(goal) for key, goal in called_terms(body)}
    return clause


def _checked(clause: PrologClause) -> PrologClause:
    if clause.key in FIXED:
        hint = "give the predicate another name"
        raise RuleFault(f"{show_key(clause.key)} is built in and cannot be defined", hint)
    if clause.key == ("-->", 2):
        raise RuleFault("grammar rules (-->) are not supported", "write a rule with :-")
    return clause


def export(program: Program, goal: str = "") -> str:
    """Return facts and rules with the declarations that SWI-Prolog needs.

    Results of lookups are written as facts, as far as they are known: for conditions those that the
    rules and ``goal`` name. Other lookups are declared as empty. Raises the errors of lookups.
    """
    lines = [*_declarations(program), "", *_clauses(program), *_found(program, goal)]
    return "\n".join(lines) + "\n"


def _declarations(program: Program) -> Iterator[str]:
    yield "% Facts and rules of a robot; load them with: swipl FILE"
    own = program.predicates
    tabled = [key for key, predicate in own.items() if predicate.tabled and predicate.clauses]
    for key in dict.fromkeys([*own, *VOCABULARY]):
        if key in tabled:
            yield f":- table {_indicator(key)}."
        elif key not in own or not own[key].clauses or own[key].origin != "file":
            yield f":- dynamic {_indicator(key)}."


def _indicator(key: Key) -> str:
    return f"{atom(key[0])}/{key[1]}"


def _clauses(program: Program) -> Iterator[str]:
    for predicate in program.predicates.values():
        for clause in predicate.clauses:
            yield clause_text(clause)


def clause_text(clause: PrologClause) -> str:
    """Write a clause with the names of its variables and its final dot."""
    env: list[Term] = [Var() for _ in range(clause.size)]
    labels = dict(zip(env, clause.names, strict=True))
    head = make(clause.key[0], (build(part, env) for part in clause.head))
    goals = [build(goal, env) for goal in clause.goals]
    if not goals:
        return f"{_shown(head, labels)}."
    inner = ",\n    ".join(_shown(goal, labels) for goal in goals)
    return f"{_shown(head, labels)} :-\n    {inner}."


def _shown(term: Term, labels: dict[Term, str]) -> str:
    return write(term, lambda variable: labels.get(variable, "_"), most=999)


def _found(program: Program, goal: str) -> Iterator[str]:
    """Write what lookups find."""
    written = False
    for predicate in program.predicates.values():
        clauses = predicate.virtual.clauses if predicate.virtual is not None else None
        if clauses is not None:
            yield from clauses(_firsts(program, predicate, goal))
            written = True
    yield from HELPERS if written else ()


def _firsts(program: Program, of: PrologPredicate, goal: str) -> list[Term]:
    """Return the values that calls of a predicate have as their first argument, each once."""
    bodies = [part for p in program.predicates.values() for c in p.clauses for part in c.goals]
    if goal:
        bodies.append(read_goal(goal).term)
    calls = (term for body in bodies for key, term in called_terms(body) if key == of.key)
    firsts = (deref(args_of(term)[0]) for term in calls)
    return list(dict.fromkeys(f for f in firsts if isinstance(f, str | TextTerm)))
