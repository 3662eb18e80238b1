"""Built-in predicates on the text of atoms, texts and numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from amberbox.diagnosis.rules.builtin_terms import Args, proper_list
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.reader import read_goal
from amberbox.diagnosis.rules.terms import Key, Real, Term, Text, Var, deref, make_list, split_list
from amberbox.diagnosis.rules.unify import undo
from amberbox.diagnosis.rules.writer import number as number_text

if TYPE_CHECKING:
    from amberbox.diagnosis.rules.machine import Machine


def text_of(term: Term, what: str) -> str:
    """Return the characters of an atom, text or number; raise RuleFault for anything else."""
    found = _text(term)
    if found is None:
        has = "no value yet" if isinstance(deref(term), Var) else "another kind of value"
        raise RuleFault(f"{what} needs an atom or a text and has {has}")
    return found


def _text(term: Term) -> str | None:
    term = deref(term)
    if isinstance(term, str):
        return term
    if isinstance(term, Text):
        return term.value
    return number_text(term) if isinstance(term, int | Real) else None


def parse_number(text: str) -> int | Real | None:
    """Read a number as Prolog writes it, None if it is none."""
    try:
        term = read_goal(text).term
    except RuleFault:
        return None
    return term if isinstance(term, int | Real) else None


def _length(m: Machine, args: Args) -> bool:
    return m.unify(args[1], len(text_of(args[0], "the length of an atom")))


def _concatenation(make: Callable[[str], Term], what: str) -> Callable[[Any, Args], Iterator[None]]:
    """Make ``atom_concat/3`` or ``string_concat/3``: both parts to a whole, or a whole cut up."""
    return lambda m, args: _concat(m, args, make, what)


def _concat(m: Machine, args: Args, make: Callable[[str], Term], what: str) -> Iterator[None]:
    left, right = _text(args[0]), _text(args[1])
    if left is not None and right is not None:
        both = m.charge_text(left + right)
        if m.unify(args[2], make(both)) or _text(args[2]) == both:
            yield
        return
    whole = text_of(args[2], what)
    for place in _cuts(whole, left, right):
        m.charge_text(whole)
        mark = len(m.trail)
        if _bind(m, args[:2], (make(whole[:place]), make(whole[place:]))):
            yield
        undo(m.trail, mark)


def _cuts(whole: str, left: str | None, right: str | None) -> Iterable[int]:
    """Return the places at which a text can be cut so that the known part fits."""
    if left is not None:
        return [len(left)] if whole.startswith(left) else []
    if right is not None:
        return [len(whole) - len(right)] if whole.endswith(right) else []
    return range(len(whole) + 1)


def _bind(m: Machine, args: Args, texts: tuple[Term, Term]) -> bool:
    """Bind those of the arguments that are variables."""
    pairs = zip(args, texts, strict=True)
    return all(not isinstance(deref(arg), Var) or m.unify(arg, text) for arg, text in pairs)


def _join(m: Machine, args: Args) -> bool:
    """Join a list with a separator, or cut an atom at each: ``atomic_list_concat/3``."""
    separator = text_of(args[1], "atomic_list_concat/3") if len(args) == 3 else ""
    items, tail = split_list(args[0])
    parts = [_text(item) for item in items]
    if tail == "[]" and all(part is not None for part in parts):
        whole = separator.join(part for part in parts if part is not None)
        return m.unify(args[-1], m.charge_text(whole))
    if not separator:
        raise RuleFault("atomic_list_concat needs a list of values", "or a separator to cut at")
    pieces = m.charge_text(text_of(args[-1], "atomic_list_concat/3")).split(separator)
    m.charge(len(pieces))
    return m.unify(args[0], make_list([*pieces]))


def _parts(make: Callable[[str], Term], what: str) -> Callable[[Any, Args], bool]:
    """Make a predicate that takes an atom apart or puts it together: ``atom_chars/2``."""

    def convert(m: Machine, args: Args) -> bool:
        known = _text(args[0])
        if known is not None:
            m.charge(len(known))
            return m.unify(args[1], make_list([make(sign) for sign in known]))
        return m.unify(args[0], _joined(args[1], what))

    return convert


def _joined(term: Term, what: str) -> str:
    known = deref(term)
    if isinstance(known, Text):
        return known.value
    signs = [deref(item) for item in proper_list(term, what)]
    if not all(isinstance(sign, str) or _is_code(sign) for sign in signs):
        raise RuleFault(f"{what} needs a list of characters")
    return "".join(chr(sign) if isinstance(sign, int) else str(sign) for sign in signs)


def _is_code(sign: Term) -> bool:
    return isinstance(sign, int) and 0 <= sign <= 0x10FFFF


def _char_code(m: Machine, args: Args) -> bool:
    sign = deref(args[0])
    if isinstance(sign, str) and len(sign) == 1:
        return m.unify(args[1], ord(sign))
    return m.unify(sign, _joined(make_list(args[1:]), "char_code/2"))


def _number_codes(m: Machine, args: Args) -> bool:
    known = deref(args[0])
    if isinstance(known, int | Real):
        return m.unify(args[1], make_list([*map(ord, number_text(known))]))
    text = _joined(args[1], "number_codes/2")
    value = parse_number(text)
    if value is None:
        raise RuleFault(f"'{text}' is no number")
    return m.unify(known, value)


def _atom_number(m: Machine, args: Args) -> bool:
    known = _text(args[0])
    if known is None:
        given = deref(args[1])
        if not isinstance(given, int | Real):
            raise RuleFault("atom_number/2 needs an atom or a number")
        return m.unify(args[0], number_text(given))
    value = parse_number(known)
    return value is not None and m.unify(args[1], value)


def _convert(from_: Callable[[str], Term]) -> Callable[[Any, Args], bool]:
    """Make a predicate such as ``upcase_atom/2``."""

    def convert(m: Machine, args: Args) -> bool:
        text = m.charge_text(text_of(args[0], "a change of letters"))
        return m.unify(args[1], from_(text))

    return convert


def _upper(text: str) -> str:
    """Return capital letters; as in SWI-Prolog a letter that has no single one stays (ß)."""
    return "".join(
        next(new for new in (sign.upper(), sign.title(), sign) if len(new) == 1) for sign in text
    )


def _lower(text: str) -> str:
    """Return small letters, one for each letter, as SWI-Prolog does."""
    return "".join(sign.lower()[0] for sign in text)


def _atom_string(m: Machine, args: Args) -> bool:
    known = _text(args[0])
    if known is not None:
        wanted = _text(args[1])
        return wanted == known if wanted is not None else m.unify(args[1], Text(known))
    return m.unify(args[0], text_of(args[1], "atom_string/2"))


def _sub_atom(m: Machine, args: Args) -> Iterator[None]:
    """Find parts: ``sub_atom(Atom, Before, Length, After, Part)``."""
    whole = text_of(args[0], "sub_atom/5")
    part = _text(args[4])
    for start, end in _spans(whole, part, deref(args[1]), deref(args[2]), deref(args[3])):
        m.charge((end - start) // 8)
        mark = len(m.trail)
        numbers = (start, end - start, len(whole) - end)
        found = all(m.unify(arg, value) for arg, value in zip(args[1:4], numbers, strict=True))
        if found and (part is not None or m.unify(args[4], whole[start:end])):
            yield
        undo(m.trail, mark)


def _spans(
    whole: str, part: str | None, before: Term, length: Term, after: Term
) -> Iterator[tuple[int, int]]:
    if part is not None:
        start = whole.find(part)
        while start >= 0:
            yield start, start + len(part)
            start = whole.find(part, start + 1)
        return
    for start in _range(before, len(whole)):
        for count in _range(length, len(whole) - start):
            if not isinstance(after, int) or start + count + after == len(whole):
                yield start, start + count


def _range(known: Term, most: int) -> range:
    if not isinstance(known, int):
        return range(most + 1)
    return range(known, known + 1) if 0 <= known <= most else range(0)


TESTS: Mapping[Key, Callable[[Any, Args], bool]] = {
    ("atom_length", 2): _length,
    ("string_length", 2): _length,
    ("atomic_list_concat", 2): _join,
    ("atomic_list_concat", 3): _join,
    ("atom_chars", 2): _parts(lambda sign: sign, "atom_chars/2"),
    ("atom_codes", 2): _parts(ord, "atom_codes/2"),
    ("char_code", 2): _char_code,
    ("number_codes", 2): _number_codes,
    ("atom_number", 2): _atom_number,
    ("atom_string", 2): _atom_string,
    ("upcase_atom", 2): _convert(_upper),
    ("downcase_atom", 2): _convert(_lower),
    ("string_upper", 2): _convert(lambda text: Text(_upper(text))),
    ("string_lower", 2): _convert(lambda text: Text(_lower(text))),
}
SEVERAL: Mapping[Key, Callable[[Any, Args], Iterator[None]]] = {
    ("atom_concat", 3): _concatenation(str, "atom_concat/3"),
    ("string_concat", 3): _concatenation(Text, "string_concat/3"),
    ("sub_atom", 5): _sub_atom,
}
