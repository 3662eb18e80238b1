"""The same answers as SWI-Prolog, for built-in predicates, programs and random Datalog."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.diagnosis.prolog.program import export, read_text
from tests.diagnosis.prolog.swi import ask_swi, ask_us, difference, need_swipl

GOALS = r"""
X = f(Y, Z), Y = 1
f(X, b) = f(a, Y)
1 = 1.0
1 =:= 1.0
1 == 1.0
0.0 = -0.0
"abc" = abc
"abc" == "abc"
a \= b
a \= X
X == Y
X == X
f(X) \== f(Y)
a @< b
f(a) @> "text"
1 @< a
1.0 @< 1
1 @< 1.0
f(b) @< g(a)
f(a, b) @> g(a)
compare(O, 1, 2.0)
compare(O, 2, 2.0)
compare(O, a, "a")
X is 7 // 2
X is -7 // 2
X is -7 mod 3
X is -7 rem 3
X is 7 mod -3
X is -7 div 2
X is 7 / 2
X is 8 / 2
X is 7 / 2.0
X is 2 ** 3
X is 2 ** -1
X is 2 ** 3.0
X is 2 ^ 3
X is 2 ^ -1
X is 1 ^ -5
X is 2 ^ 100
X is -2 ** 2
X is - 2 ** 2
X is 10 - 3 - 2
X is 2 + 3 * 4 - 1
X is min(2, 3.5) + max(1, 1.0)
X is max(2, 2.0)
X is abs(-3) + sign(-2.5)
X is truncate(2.7) + round(2.5) + round(-2.5) + ceiling(2.1) + floor(-2.1) + integer(2.5)
X is sqrt(16) + sin(0) + cos(0) + atan2(0, 1) + exp(0) + log(1)
X is sqrt(-1)
X is pi
X is e
X is 5 / 0
X is 5 / 0.0
X is foo + 1
X is Y + 1
X is "5" + 1
X is a
X is 5 xor 3 + (5 /\ 3) + (5 \/ 3) + (1 << 4) + (64 >> 2) + \ 7
X is 1.5 // 2
X is gcd(12, 18)
X is 0x1F + 0'a + 0b101 + 0o17
X is [3]
X = 1.0e10
X = 1.5e300
X = 123456789.123456789
X = 1.0e-7
X is 10 ** 15 * 1.0
X is 1.0e22
1 + 2 =:= 3
1 < 2, 2 =< 2, 3 > 2, 3 >= 3, 1 =\= 2
a < 1
X < 1
atom(a), atomic(1), atomic("s"), number(1.5), integer(3), float(1.0), string("x"), compound(f(x))
atom(1)
atom("a")
atom([])
atom(X)
var(X), nonvar(a), callable(foo), callable(f(x)), is_list([a]), ground(f(a))
callable(1)
is_list([a|X])
ground(f(X))
number(a)
functor(f(a, b), N, A)
functor(a, N, A)
functor(1.5, N, A)
functor([a], N, A)
functor(T, f, 3)
functor(T, 5, 0)
functor(T, N, 2)
arg(1, f(a, b), X)
arg(N, f(a, b), X)
arg(3, f(a, b), X)
f(a, B) =.. L
X =.. [g, 1, Y]
X =.. [a]
X =.. [5]
[a] =.. L
copy_term(f(X, Y, X), C)
term_variables(f(X, g(Y), X), L)
f(X, Y) =@= f(A, B)
f(X, X) =@= f(A, B)
unify_with_occurs_check(X, f(X))
unify_with_occurs_check(X, f(Y))
member(X, [a, b, c])
member(X, [a|T]), !
member(f(X, 1), [f(a, 1), f(b, 2), f(c, 1)])
memberchk(X, [a, b])
append(X, Y, [1, 2, 3])
append([a], [b], X)
append([[a], [b, c], []], X)
append(X, [c], [a, b, c])
length([a, b], N)
length(L, 2)
length([a|T], 3)
length(a, N)
length(L, -1)
length([a, b|c], N)
length(L, L)
length([a|L], L)
nth0(1, [a, b, c], X)
nth1(I, [a, b, a], a)
nth0(I, [a, b], X)
nth0(5, [a], X)
nth1(0, [a], X)
reverse([1, 2, 3], X)
last([1, 2, 3], X)
msort([c, a, b, a, 1, "s", f(x), 2.0, Z], L), Z = 1
sort([c, a, b, a], L)
sort(0, @>=, [1, 3, 2, 3], L)
sort(1, @<, [f(2, a), f(1, b), f(2, c)], L)
keysort([b-1, a-2, b-0, a-1], L)
sum_list([1, 2.5, 3], S)
sum_list([], S)
max_list([1, 5, 3], M), min_list([4, 2, 8], N)
max_list([], M)
max_member(M, [a, 3, f(x)]), min_member(N, [a, 3, f(x)])
numlist(1, 5, L)
numlist(5, 1, L)
between(1, 3, X)
between(2, 2, X)
between(3, 1, X)
between(1, inf, X), X > 4, !
between(1, a, X)
between(1, 5, 3)
select(X, [a, b, c], R)
delete([a, b, a, c], a, L)
subtract([a, b, c], [b], L)
intersection([a, b, c], [c, a], L)
union([a, b], [b, c], L)
list_to_set([a, b, a, X, Y, X], L)
permutation([1, 2, 3], P)
pairs_keys_values(P, [a, b], [1, 2])
findall(X-Y, (member(X, [1, 2]), member(Y, [a, b])), L)
findall(X, fail, L)
findall(X, member(X, [A, B]), L)
findall(X, member(X, [1, 2]), L, [z])
forall(member(X, [1, 2]), X > 0)
forall(member(X, [1, 2]), X > 1)
aggregate_all(count, member(_, [a, b]), N)
aggregate_all(sum(X), member(X, [1, 2, 3]), S)
aggregate_all(max(X), member(X, [1, 3, 2]), S)
aggregate_all(bag(X), member(X, [c, a, b, a]), S)
aggregate_all(set(X), member(X, [c, a, b, a]), S)
\+ member(d, [a, b])
\+ member(X, [a, b])
not(fail)
once(member(X, [a, b]))
ignore(fail)
ignore((member(X, [a, b]), X == b))
call(member, X, [a, b])
call((member(X, [1, 2, 3]), !))
G = member(X, [a]), call(G)
G = (member(X, [1, 2, 3]), X > 1, !), G
( member(X, [1, 2, 3]), X > 1 -> true ; X = none )
( fail -> X = 1 ; X = 2 )
( member(X, [a, b]) ; X = c )
( member(X, [a, b]) -> true )
( X = 1 ; X = 2 ), \+ X = 1
( true ; true ), X = 1
member(X, [1, 2, 3]), ( X =:= 2 -> Y = two ; X > 2 -> Y = more ; Y = less )
atom_length(hello, N)
atom_length("hello", N)
atom_length(123, N)
atom_length(X, N)
atom_concat(abc, def, X)
atom_concat(abc, X, abcdef)
atom_concat(X, Y, abc)
atom_concat(a, 1, X)
atomic_list_concat([a, 1, "b", 2.5], X)
atomic_list_concat([a, b, c], '-', X)
atomic_list_concat(L, ',', 'a,b,c')
atom_chars(hello, L)
atom_chars(X, [a, b])
atom_chars(12, L)
atom_codes(ab, L)
char_code(a, X)
char_code(X, 98)
number_codes(X, "12")
atom_number('3.14', X)
atom_number(X, 5)
atom_number(foo, X)
atom_number('0x1A', X)
atom_string(X, "abc")
atom_string(abc, X)
upcase_atom('hello world', X)
upcase_atom('straße', X)
upcase_atom('ﬁn ᾳ', X)
downcase_atom('İΣΑΣ', X)
string_upper("straße", X)
string_lower("İ", X)
sub_atom(hello, 1, 3, A, S)
sub_atom(hello, B, 2, 0, S)
sub_atom(banana, B, L, A, an)
sub_atom(ab, B, L, A, S)
string_concat("ab", cd, X)
string_concat(X, Y, abc)
string_concat(X, bc, "abc")
string_concat(a, X, "abc")
string_concat(1, X, 123)
string_concat(b, X, "abc")
string_concat(a, b, ab)
string_concat(X, Y, Z)
atom_concat(X, 2, 12)
atomic_list_concat([1, 2], 12)
string_length("abc", N)
X = 'it''s', Y = 'a\nb', Z = '\\'
X = "say \"hi\""
X = [a, 'B', "c"|T]
X = - 1, Y = -(1), Z = -(-(1))
X = 1 - -1
X = (a :- b, c ; d -> e)
X = {a, b}
X = [1, 2|3]
X = 'hello'(world)
X = f(;, '|', [])
X = f(:- , a:-b)
X = (- - a)
X = - (2) ^ 2
X = -(2) ^ 2
X = 2 - 3 - 4, X = A - B
X = 0''', Y = 0'a, Z = 0'\n
X = "a\x41\b"
X is max(1, 1.0)
X is max(1.0, 1)
X is min(1, 1.0)
X is min(1.0, 1)
"""

PROGRAM = r"""
:- table path/2, far/2.
:- table reach(_,_).
:- dynamic nothing/1.
edge(a, b). edge(b, c). edge(c, a). edge(c, d).
path(X, Y) :- path(X, Z), edge(Z, Y).
path(X, Y) :- edge(X, Y).
reach(X, Y) :- edge(X, Y).
reach(X, Y) :- reach(X, Z), reach(Z, Y).
far(X, Y) :- edge(X, Z), far(Z, Y).
far(X, Y) :- edge(X, Y).
:- table even/1, odd/1.
even(0).
even(N) :- N > 0, M is N - 1, odd(M).
odd(N) :- N > 0, M is N - 1, even(M).
:- table win/1.
win(X) :- move(X, Y), \+ win(Y).
move(p, q). move(q, r). move(r, s). move(p, s).
:- table fib/2.
fib(0, 0). fib(1, 1).
fib(N, F) :- N > 1, A is N - 1, B is N - 2, fib(A, X), fib(B, Y), F is X + Y.
:- table conn/2.
conn(X, Y) :- conn(Y, X).
conn(X, Y) :- edge(X, Y).
:- table expr/3.
expr(X, A, C) :- expr(L, A, [plus|B]), term(R, B, C), X = add(L, R).
expr(X, A, B) :- term(X, A, B).
term(n(N), [N|T], T) :- integer(N).
:- table open/1.
open(f(_)).
open(g(X, X)).
open(h(X)) :- open(g(X, _)).
unreached(X) :- edge(X, _), \+ path(X, d).
reached(L) :- findall(Y, path(a, Y), L0), sort(L0, L).
max(X, Y, X) :- X >= Y, !.
max(_, Y, Y).
first(X) :- member(X, [1, 2, 3]), X > 1, !.
first(none).
t(X) :- ( X = 1 ; X = 2, ! ; X = 3 ).
t(4).
u(X) :- \+ \+ X = 1, X = 2.
count(N, N) :- !.
count(I, N) :- J is I + 1, count(J, N).
hanoi(0, _, _, _, []) :- !.
hanoi(N, A, B, C, M) :- K is N - 1, hanoi(K, A, C, B, M1), hanoi(K, C, B, A, M2),
    append(M1, [A-B|M2], M).
queens(N, Qs) :- numlist(1, N, Ns), permutation(Ns, Qs), safe(Qs).
safe([]).
safe([Q|Qs]) :- no_attack(Q, Qs, 1), safe(Qs).
no_attack(_, [], _).
no_attack(Q, [R|Rs], D) :- Q =\= R + D, Q =\= R - D, E is D + 1, no_attack(Q, Rs, E).
last([X], X).
last([_|T], X) :- last(T, X).
double(X, Y) :- Y is X * 2.
add(X, A, B) :- B is A + X.
big(X) :- X > 2.
any(_).
pair(X, X).
"""
PROGRAM_GOALS = r"""
path(a, X)
path(X, Y)
path(d, X)
reach(X, a)
far(b, X)
conn(X, Y)
conn(d, X)
even(40)
odd(40)
win(X)
win(p)
fib(40, F)
expr(X, [1, plus, 2, plus, 3], [])
open(X)
open(g(a, X))
unreached(X)
nothing(X)
max(3, 2, X)
max(3, 2, 2)
first(X)
t(X)
u(X)
count(0, 3000)
hanoi(4, l, r, m, M)
queens(5, Q)
last([a, b, c], X)
maplist(double, [1, 2, 3], L)
foldl(add, [1, 2, 3], 0, S)
include(big, [1, 2, 3, 4], L)
exclude(big, [1, 2, 3, 4], L)
any(X)
pair(X, Y)
reached(L)
forall(edge(X, Y), path(X, Y))
edge(X, Y), edge(Y, X)
edge(X, Y), \+ edge(Y, _)
"""


def _goals(text: str) -> list[str]:
    return [line for line in text.splitlines() if line]


@pytest.mark.parametrize(
    ("text", "goals"), [(PROGRAM, _goals(PROGRAM_GOALS)), ("ready(yes).\n", _goals(GOALS))]
)
def test_the_same_answers(tmp_path: Path, text: str, goals: list[str]) -> None:
    expected = ask_swi(tmp_path, text, goals)
    assert difference(goals, expected, list(ask_us(read_text(text), goals))) == []


def test_an_exported_program_has_the_same_answers(tmp_path: Path) -> None:
    goals = _goals(PROGRAM_GOALS)
    program = read_text(PROGRAM).with_facts([("edge", "Big One", 3.5), ("present", "it's")])
    goals += ["present(X)", "holds(X, Y, Z)"]
    expected = ask_swi(tmp_path, export(program), goals)
    assert difference(goals, expected, list(ask_us(program, goals))) == []


CONSTANTS = st.sampled_from(["a", "b", "c", "1", "2"])
VARIABLES = st.sampled_from(["X", "Y", "Z"])
SIZES = {"e": 2, "f": 1, "g": 2, "p": 1, "q": 2, "r": 2, "s": 1}


@st.composite
def _literal(draw: st.DrawFn, names: dict[str, int]) -> str:
    name = draw(st.sampled_from(sorted(names)))
    args = [draw(st.one_of(VARIABLES, VARIABLES, CONSTANTS)) for _ in range(names[name])]
    return f"{name}({', '.join(args)})"


@st.composite
def _rule(draw: st.DrawFn, head: str, known: dict[str, int], lower: dict[str, int]) -> str:
    """Write a rule whose variables are all bound; only those of lower layers are negated."""
    goals = draw(st.lists(_literal(known), min_size=1, max_size=3))
    bound = sorted({sign for goal in goals for sign in goal if sign in "XYZ"})
    value = st.sampled_from(bound) if bound else CONSTANTS
    extra = draw(st.sampled_from(["", "neg", "differ", "equal"]))
    if extra == "neg":
        negated = draw(st.sampled_from(sorted(lower)))
        args = [draw(value) for _ in range(lower[negated])]
        goals.append(f"\\+ {negated}({', '.join(args)})")
    elif extra:
        sign = "\\==" if extra == "differ" else "=="
        goals.append(f"{draw(value)} {sign} {draw(value)}")
    args = [draw(value) for _ in range(SIZES[head])]
    return f"{head}({', '.join(args)}) :- {', '.join(goals)}."


@st.composite
def datalog(draw: st.DrawFn) -> str:
    """Write facts and two layers of rules; the second may call itself and is tabled."""
    lines = ["r(a, c).", "s(c)."]  # for SWI-Prolog a tabled predicate without clauses is unknown
    for name in draw(st.lists(st.sampled_from("efg"), max_size=12)):
        lines.append(f"{name}({', '.join(draw(CONSTANTS) for _ in range(SIZES[name]))}).")
    facts, lower = _sizes("efg"), _sizes("efgpq")
    for name in draw(st.lists(st.sampled_from("pq"), max_size=3)):
        lines.append(draw(_rule(name, facts, facts)))
    for name in draw(st.lists(st.sampled_from("rs"), min_size=1, max_size=4)):
        lines.append(draw(_rule(name, lower | _sizes("rs"), lower)))
    declared = [":- table r/2, s/1.", ":- dynamic e/2, f/1, g/2, p/1, q/2."]
    return "\n".join([*declared, *sorted(lines, key=lambda line: line[0])]) + "\n"


def _sizes(names: str) -> dict[str, int]:
    return {name: SIZES[name] for name in names}


QUESTIONS = ["p(X)", "q(X, Y)", "r(X, Y)", "s(X)", "r(a, X)", "s(b)", "r(X, X), \\+ s(X)"]


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(datalog())
def test_random_datalog(tmp_path: Path, text: str) -> None:
    need_swipl()
    expected = ask_swi(tmp_path, text, QUESTIONS)
    assert difference(QUESTIONS, expected, list(ask_us(read_text(text), QUESTIONS))) == []
