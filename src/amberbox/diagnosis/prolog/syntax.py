"""The syntax of the rule language: read clauses and goals from text, write terms as text."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

from amberbox.diagnosis.prolog.terms import (
    NIL,
    PAIR,
    Real,
    RuleFault,
    Struct,
    Term,
    TextTerm,
    Var,
    deref,
    make_list,
    split_list,
)

_PLAIN = re.compile(r"[^\W\d_A-Z]\w*|[-+*/\\^<>=~:.?@#&$]+|\[\]|[!;]|\{\}")
_ESCAPES = {"\n": "\\n", "\t": "\\t", "\r": "\\r", "\\": "\\\\", "\0": "\\0\\"}
_ALPHA = re.compile(r"\w+")

Names = Callable[[Var], str]


def anonymous(_variable: Var) -> str:
    """Write every free variable as ``_``."""
    return "_"


def write(
    term: Term, names: Names = anonymous, *, quoted: bool = True, most: int = 1200,
    longest: int | None = None,
) -> str:  # fmt: skip
    """Write a term; ``names`` gives its free variables names.

    ``longest`` ends a text of more characters with ``...``, however large the term is.
    """
    return _Writer(names, quoted, longest).write(term, most)


def atom(text: str) -> str:
    """Write an atom, in quotes where it needs them."""
    return text if _PLAIN.fullmatch(text) else _quote(text, "'")


def number(value: int | Real) -> str:
    """Write a number as SWI-Prolog does: a float always has a point."""
    if isinstance(value, int):
        return str(value)
    text = f"{float(value):.15g}"
    if float(text) != value:
        text = repr(float(value))
    mantissa, sign, exponent = text.partition("e")
    if "inf" in text or "nan" in text:
        return text
    if not sign and "." not in mantissa:
        return f"{mantissa}.0"
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if sign else text


def _quote(text: str, sign: str) -> str:
    escapes = _ESCAPES | {sign: f"\\{sign}"}
    return sign + "".join(escapes.get(part, part) for part in text) + sign


class _Glued(NamedTuple):
    """An operator that needs a blank before a neighbour with which it would form one token."""

    text: str
    is_prefix: bool = False


# What is still to be written: a text, an operator, or a term with its highest priority
_Open: TypeAlias = "str | _Glued | tuple[Term, int]"


class _Writer:
    """Writes from left to right with a stack of its own, so that no term is nested too deeply."""

    def __init__(self, names: Names, quoted: bool, longest: int | None) -> None:
        self.names = names
        self.quoted = quoted
        self.longest = longest
        self.out: list[str] = []
        # The operator that was written last, if nothing stands behind it yet
        self.glue: _Glued | None = None

    def write(self, term: Term, most: int) -> str:
        todo: list[_Open] = [(term, most)]
        size = 0
        while todo:
            part = todo.pop()
            if isinstance(part, tuple) and not isinstance(part, _Glued):
                todo.extend(reversed(self._parts(*part)))
                continue
            text = part.text if isinstance(part, _Glued) else part
            if not text:
                continue
            glued = isinstance(part, _Glued) and not part.is_prefix
            if self._needs_blank(text, glued=glued):
                self.out.append(" ")
            self.out.append(text)
            self.glue = part if isinstance(part, _Glued) else None
            size += len(text)
            if self.longest is not None and size > self.longest:
                return "".join(self.out)[: self.longest] + "..."
        return "".join(self.out)

    def _needs_blank(self, text: str, *, glued: bool) -> bool:
        before = self.out[-1] if self.out else ""
        last = self.glue
        if last is not None and last.is_prefix:
            negative = last.text in "+-" and text[0].isdigit()
            return text[0] == "(" or negative or _would_join(before, text)
        return (glued or last is not None) and _would_join(before, text)

    def _parts(self, term: Term, most: int) -> list[_Open]:
        """Return the parts of a term's written form."""
        term = deref(term)
        if isinstance(term, Struct):
            return self._struct(term, most)
        if isinstance(term, str):
            text = self._atom(term)
            is_operand = most not in (999, 1200)
            return [f"({text})" if is_operand and (term in INFIX or term in PREFIX) else text]
        if isinstance(term, Var):
            return [self.names(term)]
        if isinstance(term, TextTerm):
            return [_quote(term.value, '"') if self.quoted else term.value]
        return [number(term) if isinstance(term, int | Real) else "_"]

    def _atom(self, text: str) -> str:
        return atom(text) if self.quoted else text

    def _struct(self, term: Struct, most: int) -> list[_Open]:
        name, args = term.name, term.args
        if name == PAIR and len(args) == 2:
            items, tail = split_list(term)
            end: list[_Open] = ["]"] if tail == NIL else ["|", (tail, 999), "]"]
            return ["[", *_with_commas(items), *end]
        if name == "{}" and len(args) == 1:
            return ["{", (args[0], 1200), "}"]
        if len(args) == 2 and name in INFIX:
            return self._infix(term, most)
        if len(args) == 1 and name in PREFIX and not isinstance(deref(args[0]), int | Real):
            operator = PREFIX[name]
            sign = _Glued(self._atom(name), is_prefix=True)
            return _in_brackets([sign, (args[0], operator.right)], operator.priority > most)
        functor = f"'{name}'" if name in (NIL, "{}") and self.quoted else self._atom(name)
        return [f"{functor}(", *_with_commas(args), ")"]

    def _infix(self, term: Struct, most: int) -> list[_Open]:
        operator = INFIX[term.name]
        sign = self._atom(term.name)
        middle: _Open = _Glued(sign)
        if term.name == ",":
            middle = ","
        elif term.name in ("->", ":-", "*->", "-->") or _ALPHA.fullmatch(sign):
            middle = f" {sign} "
        parts: list[_Open] = [(term.args[0], operator.left), middle, (term.args[1], operator.right)]
        return _in_brackets(parts, operator.priority > most)


def _with_commas(items: Sequence[Term]) -> Iterator[_Open]:
    for number, item in enumerate(items):
        if number:
            yield ","
        yield item, 999


def _in_brackets(parts: list[_Open], needed: bool) -> list[_Open]:
    return ["(", *parts, ")"] if needed else parts


def _would_join(left: str, right: str) -> bool:
    """Return whether two words side by side would be read as one."""
    before, after = left[-1:], right[:1]
    return any(
        pattern.match(before) and pattern.match(after) for pattern in (_ALPHA, _SYMBOL, _QUOTE)
    )


_SYMBOL = re.compile(r"[-+*/\\^<>=~:.?@#&$]")
_QUOTE = re.compile(r"'")


class Operator(NamedTuple):
    """Priority of an operator and the most that its operands may have."""

    priority: int
    left: int
    right: int
    is_right: bool = False


_INFIX = {
    (1200, "xfx"): ":- -->",
    (1100, "xfy"): "; |",
    (1050, "xfy"): "-> *->",
    (1000, "xfy"): ",",
    (700, "xfx"): "< = =.. =@= \\=@= =:= =< == =\\= > >= @< @=< @> @>= \\= \\== as is",
    (600, "xfy"): ":",
    (500, "yfx"): "+ - /\\ \\/ xor",
    (400, "yfx"): "* / // mod rem div << >> divmod rdiv",
    (200, "xfx"): "**",
    (200, "xfy"): "^",
}
_PREFIX = {
    (1200, "fx"): ":- ?-",
    (1150, "fx"): "dynamic discontiguous initialization meta_predicate multifile table",
    (900, "fy"): "\\+",
    (200, "fy"): "- + \\",
}


def _operator(priority: int, kind: str) -> Operator:
    left = priority if kind[0] == "y" else priority - 1
    right = priority if kind[-1] == "y" else priority - 1
    return Operator(priority, left, right, kind == "xfy")


INFIX: Mapping[str, Operator] = {
    name: _operator(*form) for form, names in _INFIX.items() for name in names.split()
}
PREFIX: Mapping[str, Operator] = {
    name: _operator(*form) for form, names in _PREFIX.items() for name in names.split()
}


Sort: TypeAlias = Literal["name", "quoted", "var", "value", "punct", "stop", "end"]


class RuleToken(NamedTuple):
    """One token: its sort, its text or value, its position, and whether it touches its
    neighbours.
    """

    sort: Sort
    value: Term
    at: int
    after_blank: bool
    opens: bool = False  # the next character is (: this is the name of a structure


_WORDS = re.compile(
    r"""
    (?P<blank>(?:\s+|%[^\n]*|/\*.*?\*/)+)
  | (?P<stop>\.(?=\s|%|\Z))
  | (?P<name>[^\W\d_A-Z]\w*|[-+*/\\^<>=~:.?@\#&$]+|[!;])
  | (?P<var>[A-Z_]\w*)
  | (?P<char>0'(?:\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.|''|[^\\'\n]))
  | (?P<number>0x[0-9a-fA-F]+|0o[0-7]+|0b[01]+
      |\d+(?:_\d+)*(?:\.\d+(?:[eE][-+]?\d+)?|[eE][-+]?\d+)?)
  | (?P<quoted>'(?:[^'\\]|''|\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.)*')
  | (?P<text>"(?:[^"\\]|""|\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.)*")
  | (?P<codes>`(?:[^`\\]|``|\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.)*`)
  | (?P<punct>[()\[\]{},|])
    """,
    re.VERBOSE | re.DOTALL,
)
_ESCAPE = re.compile(r"\\(?:x([0-9a-fA-F]+)\\?|([0-7]+)\\?|(\n|.))", re.DOTALL)
_ESCAPED = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v",
            "0": "\0", "e": "\x1b", "s": " ", "\n": ""}  # fmt: skip
_FOREIGN = {
    "'": "a quote (') is missing at the end of a name",
    '"': 'a quote (") is missing at the end of a text',
    "`": "a backtick (`) is missing at the end",
    "/*": "a comment is not closed: */ is missing",
}


def tokens(text: str, at: int = 0) -> Iterator[RuleToken]:
    """Cut a text into words from ``at`` on, the last one of sort ``end``.

    Raises RuleFault where that is impossible.
    """
    blank = True
    length = len(text)
    while at < length:
        match = _WORDS.match(text, at)
        if match is None or (text.startswith("/*", at) and match.lastgroup != "blank"):
            raise _foreign(text, at)
        sort, end = match.lastgroup, match.end()
        if sort == "blank":
            blank = True
        else:
            yield _token(sort or "", match[0], at, blank, text.startswith("(", end))
            blank = False
        at = end
    yield RuleToken("end", "", length, True)


def _token(sort: str, word: str, at: int, blank: bool, opens: bool) -> RuleToken:
    if sort in ("name", "punct", "stop", "var"):
        return RuleToken(sort, word, at, blank, opens)  # type: ignore[arg-type]  # one of Sort
    if sort == "quoted":
        return RuleToken("quoted", _unescape(word, at), at, blank, opens)
    if sort == "text":
        return RuleToken("value", TextTerm(_unescape(word, at)), at, blank)
    if sort == "codes":
        return RuleToken("value", make_list([*map(ord, _unescape(word, at))]), at, blank)
    return RuleToken("value", _number(sort, word, at), at, blank)


def _number(sort: str, word: str, at: int) -> Term:
    if sort == "char":
        inner = word[2:]
        return ord("'" if inner == "''" else _escaped(inner, at))
    if len(word) > 4000:
        raise RuleFault("a number of more than 4,000 digits", at=at)
    if word[:2] in ("0x", "0o", "0b"):
        return int(word, 0)
    if word.replace("_", "").isdigit():
        return int(word.replace("_", ""))
    value = float(word)
    if value == float("inf"):
        raise RuleFault(f"the number {word} is too large", at=at)
    return Real(value)


def _unescape(word: str, at: int) -> str:
    quote, inner = word[0], word[1:-1]
    return _escaped(inner.replace(quote * 2, quote), at)


def _escaped(text: str, at: int) -> str:
    def replaced(match: re.Match[str]) -> str:
        code, octal, sign = match.groups()
        if sign is None:
            value = int(code, 16) if code else int(octal, 8)
            if value > 0x10FFFF:
                raise RuleFault("an escape for no character", at=at)
            return chr(value)
        if sign.isalnum() and sign not in _ESCAPED:
            raise RuleFault(f"the escape \\{sign} is unknown", "a backslash is written \\\\", at)
        return _ESCAPED.get(sign, sign)

    return _ESCAPE.sub(replaced, text)


def _foreign(text: str, at: int) -> RuleFault:
    for sign, hint in _FOREIGN.items():
        if text.startswith(sign, at):
            return RuleFault(f"{sign} is not closed", hint, at)
    return RuleFault(f"the character {text[at]!r} is not understood", at=at)


_DEEPEST = 100
_LONGEST_LEFT = 200
_VALUE = r"\s*(?:[a-z]\w*|\d{1,18})\s*"
# A fact of plain words and numbers: nearly all of a long file, so it has a short way
_FACT = re.compile(rf"\s*([a-z]\w*)\(({_VALUE}(?:,{_VALUE})*)\)\.(?=\s|\Z)", re.ASCII)
_CLOSING = frozenset(")]},|")


@dataclass(slots=True)
class Sentence:
    """A term up to its dot: the names of its variables, and how often each occurs."""

    term: Term
    at: int
    names: dict[str, Var] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    places: dict[int, int] = field(default_factory=dict)  # places of structures in the text, by id


def sentences(text: str, at: int = 0) -> Iterator[Sentence | RuleFault]:
    """Yield the sentences of a text; a fault for each that cannot be read."""
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
        self.next = RuleToken("end", "", at, True)
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

    def advance(self) -> RuleToken:
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

    def _bracketed(self, token: RuleToken) -> Term:
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
        """Read an argument between the commas of a structure or a list."""
        outside, self.in_argument = self.in_argument, True
        term = self.term(1200)
        self.in_argument = outside
        return term

    def _list(self, token: RuleToken) -> Term:
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

    def _name(self, token: RuleToken, most: int) -> tuple[Term, int]:
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

    def _is_number(self, token: RuleToken) -> bool:
        return not token.after_blank and isinstance(token.value, int | float)

    def _signed(self, sign: str) -> Term:
        value = self.advance().value
        assert isinstance(value, int | float)  # looked at before
        return type(value)(-value) if sign == "-" else value

    def _ends_operand(self) -> bool:
        """Return whether what follows a prefix operator cannot be its argument."""
        token = self.next
        if token.sort in ("stop", "end"):
            return True
        if token.sort == "punct":
            return token.value in _CLOSING
        is_infix = token.sort == "name" and str(token.value) in INFIX
        return is_infix and str(token.value) not in PREFIX and not token.opens

    def _call(self, name: str, token: RuleToken) -> Term:
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

    def _expect(self, sign: str, opening: RuleToken) -> None:
        if not self._take(sign):
            raise self._unexpected(hint=f"is '{sign}' missing, for '{opening.value}'?")

    def _unexpected(self, token: RuleToken | None = None, hint: str = "") -> RuleFault:
        token = token or self.next
        if token.sort == "end":
            hint = hint or "is the dot missing that ends a sentence?"
            return RuleFault("the text ends in the middle of a sentence", hint, token.at)
        if token.sort == "stop":
            return RuleFault("the sentence ends too early", hint, token.at)
        hint = hint or "is a comma or the dot of the sentence before missing?"
        return RuleFault(f"'{_shown(token)}' is not expected here", hint, token.at)


def _shown(token: RuleToken) -> str:
    value = token.value
    return str(value) if isinstance(value, str | int | float) else "a text"
