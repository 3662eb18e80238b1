"""The order of words on a command line: ``VERB ACTION WHERE``, options anywhere between them.

``VERB WHERE ACTION`` is understood as well: some verbs were written that way before.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping, Sequence

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError


def accept_any_order(parser: argparse.ArgumentParser) -> None:
    """Let options stand between words: ``--json ack ID`` as well as ``ack ID --json``.

    By itself argparse takes words that may be left out only where the first ones are.
    """
    vars(parser)["parse_args"] = parser.parse_intermixed_args


def add_actions(
    parser: argparse.ArgumentParser,
    actions: Mapping[str, Sequence[str]],
    default: str,
    place: str,
    *,
    where_first: bool = False,
) -> None:
    """Add the words ACTION WHERE ...; they are parsed into ``action``, ``where`` and ``rest``.

    ``actions`` names the words of each action after WHERE, ``place`` explains WHERE. One word alone
    is WHERE, for the action ``default``. With ``where_first`` a command line that can be read in
    both orders is WHERE ACTION, the only order of such a verb before.
    """
    listed = ", ".join(actions)
    parser.add_argument("words", nargs="+", metavar="ACTION WHERE", help=f"one of {listed} "
                        f"(without: {default}), then {place}")  # fmt: skip

    def parse_args(arguments: Sequence[str]) -> argparse.Namespace:
        parsed = parser.parse_intermixed_args(arguments)
        words = _action_first(parsed.words, actions, default, where_first=where_first)
        if len(words) < 2:
            hint = f"{parser.usage}; a folder called {words[0]}: ./{words[0]}"
            raise UsageError(f"{parser.prog} {words[0]} needs WHERE", hint)
        if words[0] not in actions:
            guesses = [(word, did_you_mean(word, actions)) for word in (words[1], words[0])]
            wrong, near = next((guess for guess in guesses if guess[1]), guesses[0])
            what = f"what is '{wrong}'? there is no action '{wrong}'{near}"
            raise UsageError(what, str(parser.usage))
        parsed.action, parsed.where, parsed.rest = words[0], words[1], words[2:]
        return parsed

    vars(parser)["parse_args"] = parse_args


def accept_where_first(
    parser: argparse.ArgumentParser, actions: Collection[str], default: str = ""
) -> None:
    """Let WHERE stand before the action of a parser that takes the action as its first word.

    With ``default`` an action need not be named.
    """
    parse = parser.parse_args

    def parse_args(arguments: Sequence[str]) -> argparse.Namespace:
        first, second = [*arguments[:2], "", ""][:2]
        if first.startswith("-") or first in actions or not first:
            return parse(arguments)
        if second in actions:
            return parse([second, first, *arguments[2:]])
        if default and (not second or second.startswith("-")):
            return parse([default, *arguments])
        return parse(arguments)

    vars(parser)["parse_args"] = parse_args


def _action_first(
    words: list[str], actions: Mapping[str, Sequence[str]], default: str, *, where_first: bool
) -> list[str]:
    if len(words) == 1 and (where_first or words[0] not in actions or words[0] == default):
        return [default, *words]
    orders = [words, [*words[1:2], *words[:1], *words[2:]]]
    known = [order for order in orders if order[0] in actions]
    whole = [order for order in known if len(order) == 2 + len(actions[order[0]])]
    choice = whole or known or orders[:1]
    return choice[-1] if where_first else choice[0]
