"""Predicates that come with the language and are written in it; a rule file may replace them."""

from __future__ import annotations

from functools import cache

from amberbox.diagnosis.rules.clauses import Predicate
from amberbox.diagnosis.rules.compile import compile_clause
from amberbox.diagnosis.rules.faults import Place, RuleFault
from amberbox.diagnosis.rules.proof import LIBRARY
from amberbox.diagnosis.rules.reader import sentences
from amberbox.diagnosis.rules.terms import Key

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
def library() -> dict[Key, Predicate]:
    """Return the predicates that come with the language."""
    found: dict[Key, Predicate] = {}
    for sentence in sentences(_TEXT):
        if isinstance(sentence, RuleFault):
            raise sentence
        line = _TEXT.count("\n", 0, sentence.at) + 1
        clause = compile_clause(sentence.term, Place(LIBRARY, line), lambda _: None, {})
        predicate = found.setdefault(clause.key, Predicate(clause.key, origin="library"))
        predicate.add(clause)
    return found
