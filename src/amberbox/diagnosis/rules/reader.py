"""Read terms of Prolog: the standard syntax with its operators."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.operators import INFIX, PREFIX, Operator
from amberbox.diagnosis.rules.terms import NIL, Struct, Term, Var, make_list
from amberbox.diagnosis.rules.tokens import Token, tokens

_DEEPEST = 100
_LONGEST_LEFT = 200
_VALUE = r"\s*(?:[a-z]\w*|\d{1,18})\s*"
_FACT = re.compile(rf"\s*([a-z]\w*)\(({_VALUE}(?:,{_VALUE})*)\)\.(?=\s|\Z)", re.ASCII)
"""A fact of plain words and numbers: nearly all of a long file, so it has a short way."""
_CLOSING = frozenset(")]},|")


@dataclass(slots=True)
class Sentence:
    """A term up to its dot: the names of its variables, how often each stands there."""

    term: Term
    at: int
    names: dict[str, Var] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    places: dict[int, int] = field(default_factory=dict)
    """Places of structures in the text, by ``id``."""


def sentences(text: str, at: int = 0) -> Iterator[Sentence | RuleFault]:
    """Yield what a text says, sentence by sentence; a fault for each that cannot be read."""
    while True:
        fact = _FACT.match(text, at)
        if fact is not None:
            yield _fact(fact)
            at = fact.end()
            continue
        reader = _Reader(text, at)
        try:
            sentence = reader.sentence()
        except RuleFault as fault:
            yield fault
            resume_at = _after_stop(text, max(at, fault.at, reader.next.at))
            if resume_at is None:
                return
            at = resume_at
            continue
        if sentence is None:
            return
        yield sentence
        at = reader.end


def _fact(fact: re.Match[str]) -> Sentence:
    words = (word.strip() for word in fact[2].split(","))
    args = tuple(int(word) if word[0].isdigit() else word for word in words)
    return Sentence(Struct(fact[1], args), fact.start(1))


def read_goal(text: str) -> Sentence:
    """Read one goal, with or without a dot at its end; raise RuleFault."""
    reader = _Reader(text, 0)
    sentence = reader.sentence(needs_stop=False)
    if sentence is None:
        raise RuleFault("there is no goal", "such as: broken(X)", 0)
    return sentence


def _after_stop(text: str, at: int) -> int | None:
    """Return where the next sentence may begin after a fault."""
    while at < len(text):
        try:
            for token in tokens(text, at):
                if token.sort == "stop":
                    return token.at + 1
            return None
        except RuleFault as fault:
            if text.startswith("/*", fault.at):
                return None  # all the rest is in a comment that is not closed
            line_end = text.find("\n", max(fault.at, at))
            if line_end < 0:
                return None
            at = line_end + 1
    return None


class _Reader:
    """Reads tokens from left to right; operators by their priorities."""

    def __init__(self, text: str, at: int) -> None:
        self.tokens = tokens(text, at)
        self.next = Token("end", "", at, True)
        self.end = at
        self.depth = 0
        self.in_argument = False
        self.read = Sentence(NIL, at)

    def sentence(self, needs_stop: bool = True) -> Sentence | None:
        self.advance()
        if self.next.sort == "end":
            return None
        self.read.at = self.next.at
        self.read.term = self.term(1200)
        stop = self.next
        if stop.sort == "stop":
            self.end = stop.at + 1
            if not needs_stop:
                self.advance()
        if self.next.sort != ("stop" if needs_stop else "end"):
            raise self._unexpected()
        return self.read

    def advance(self) -> Token:
        """Return the token that is next, and go on to the one after it."""
        token = self.next
        self.next = next(self.tokens, token)
        return token

    def term(self, most: int) -> Term:
        """Read a term whose operators have at most this priority."""
        self.depth += 1
        if self.depth > _DEEPEST:
            raise RuleFault(f"is nested more than {_DEEPEST} deep", at=self.next.at)
        left, priority = self._primary(most)
        for _ in range(_LONGEST_LEFT):
            name, operator = self._infix()
            if operator is None or operator.priority > most or priority > operator.left:
                self.depth -= 1
                return left
            if operator.is_right:
                left = self._chain(left, name, operator)
            else:
                at = self.advance().at
                left = self._struct(name, (left, self.term(operator.right)), at)
            priority = operator.priority
        raise RuleFault(f"has more than {_LONGEST_LEFT} operators in a row", at=self.next.at)

    def _infix(self) -> tuple[str, Operator | None]:
        token = self.next
        if token.sort == "name" or (token.sort == "punct" and not self.in_argument):
            name = str(token.value)
            return name, INFIX.get(name)
        return "", None

    def _chain(self, left: Term, name: str, operator: Operator) -> Term:
        """Read ``a, b, c`` without descending once per comma."""
        parts, places = [left], list[int]()
        while self._infix()[0] == name:
            places.append(self.advance().at)
            parts.append(self.term(operator.priority - 1))
        result = parts.pop()
        while parts:
            result = self._struct(";" if name == "|" else name, (parts.pop(), result), places.pop())
        return result

    def _primary(self, most: int) -> tuple[Term, int]:
        token = self.advance()
        if token.sort == "value":
            return token.value, 0
        if token.sort == "var":
            return self._variable(str(token.value)), 0
        if token.sort in ("name", "quoted"):
            return self._name(token, most)
        if token.sort == "punct" and token.value in ("(", "[", "{"):
            return self._bracketed(token), 0
        raise self._unexpected(token)

    def _bracketed(self, token: Token) -> Term:
        if token.value == "[":
            return self._list(token)
        if token.value == "{" and self._take("}"):
            return "{}"
        outside, self.in_argument = self.in_argument, False
        inner = self.term(1200)
        self.in_argument = outside
        self._expect("}" if token.value == "{" else ")", token)
        return Struct("{}", (inner,)) if token.value == "{" else inner

    def _argument(self) -> Term:
        """Read what stands between the commas of a structure or a list."""
        outside, self.in_argument = self.in_argument, True
        term = self.term(1200)
        self.in_argument = outside
        return term

    def _list(self, token: Token) -> Term:
        if self._take("]"):
            return NIL
        items = [self._argument()]
        while self._take(","):
            items.append(self._argument())
        tail = self._argument() if self._take("|") else NIL
        self._expect("]", token)
        return make_list(items, tail)

    def _variable(self, name: str) -> Term:
        if name == "_":
            return Var()
        self.read.counts[name] = self.read.counts.get(name, 0) + 1
        return self.read.names.setdefault(name, Var())

    def _name(self, token: Token, most: int) -> tuple[Term, int]:
        name = str(token.value)
        if token.opens:
            return self._call(name, token), 0
        follows = self.next
        if token.sort == "name" and name in "+-" and self._is_number(follows):
            return self._signed(name), 0
        operator = PREFIX.get(name) if token.sort == "name" else None
        if operator is None or operator.priority > most or self._ends_operand():
            return name, 0
        argument = self.term(operator.right)
        return self._struct(name, (argument,), token.at), operator.priority

    def _is_number(self, token: Token) -> bool:
        return not token.after_blank and isinstance(token.value, int | float)

    def _signed(self, sign: str) -> Term:
        value = self.advance().value
        assert isinstance(value, int | float)  # looked at before
        return type(value)(-value) if sign == "-" else value

    def _ends_operand(self) -> bool:
        """Tell whether what follows a prefix operator cannot be its argument."""
        token = self.next
        if token.sort in ("stop", "end"):
            return True
        if token.sort == "punct":
            return token.value in _CLOSING
        is_infix = token.sort == "name" and str(token.value) in INFIX
        return is_infix and str(token.value) not in PREFIX and not token.opens

    def _call(self, name: str, token: Token) -> Term:
        opening = self.advance()
        if self._take(")"):
            raise RuleFault(f"{name}() has no arguments", f"write {name}", opening.at)
        args = [self._argument()]
        while self._take(","):
            args.append(self._argument())
        self._expect(")", opening)
        return self._struct(name, tuple(args), token.at)

    def _struct(self, name: str, args: tuple[Term, ...], at: int) -> Struct:
        term = Struct(name, args)
        self.read.places[id(term)] = at
        return term

    def _take(self, sign: str) -> bool:
        found = self.next.sort == "punct" and self.next.value == sign
        if found:
            self.advance()
        return found

    def _expect(self, sign: str, opening: Token) -> None:
        if not self._take(sign):
            raise self._unexpected(hint=f"is '{sign}' missing, for '{opening.value}'?")

    def _unexpected(self, token: Token | None = None, hint: str = "") -> RuleFault:
        token = token or self.next
        if token.sort == "end":
            hint = hint or "is the dot missing that ends a sentence?"
            return RuleFault("the text ends in the middle of a sentence", hint, token.at)
        if token.sort == "stop":
            return RuleFault("the sentence ends too early", hint, token.at)
        hint = hint or "is a comma or the dot of the sentence before missing?"
        return RuleFault(f"'{_shown(token)}' is not expected here", hint, token.at)


def _shown(token: Token) -> str:
    value = token.value
    return str(value) if isinstance(value, str | int | float) else "a text"
