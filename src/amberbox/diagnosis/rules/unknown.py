"""Names that nobody defined: what was meant, or why there is no such thing here."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.terms import Key, show_key

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
    """Say why something of Prolog is left out, nothing if it is not known."""
    return _REFUSED.get(key[0], "")


def unknown_predicate(key: Key, known: Iterable[Key]) -> RuleFault:
    """Say that there is no such predicate, and what may have been meant."""
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
