"""Needs of a component: all, any, or at least some of the things named, nested freely.

In a file it is a list (all of them), ``{any: [...]}``, ``{all: [...]}`` or
``{at_least: 2, of: [...]}``; an entry is a name or such a mapping again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.yaml_nodes import Node

_KEYS = ("all", "any", "at_least", "of")
_HINT = "write a list of names, {any: [...]}, {all: [...]} or {at_least: 2, of: [...]}"


@dataclass(frozen=True, slots=True)
class Needs:
    """Needs that are met when at least a number of parts are up; a part is a name or nested needs.

    ``Needs(0, ())`` needs nothing and is always met.
    """

    at_least: int
    parts: tuple[Needs | str, ...]

    def met(self, is_up: Callable[[str], bool]) -> bool:
        """Return whether they are met; ``is_up`` states whether a name is up."""
        up = sum(is_up(p) if isinstance(p, str) else p.met(is_up) for p in self.parts)
        return up >= self.at_least

    def names(self) -> tuple[str, ...]:
        """Return the names in order, each once."""
        return tuple(dict.fromkeys(_names(self)))

    def restricted(self, is_known: Callable[[str], bool]) -> Needs:
        """Return what remains when all names that are not known are taken to be up."""
        count, parts = self.at_least, list[Needs | str]()
        for part in self.parts:
            rest = part.restricted(is_known) if isinstance(part, Needs) else part
            if rest == NOTHING or (isinstance(rest, str) and not is_known(rest)):
                count -= 1
            else:
                parts.append(rest)
        return Needs(count, tuple(parts)) if count > 0 else NOTHING

    def __str__(self) -> str:
        if not self.parts:
            return "nothing"
        inner = [f"({p})" if isinstance(p, Needs) and len(p.parts) > 1 else str(p)
                 for p in self.parts]  # fmt: skip
        if len(inner) == self.at_least:
            return " and ".join(inner)
        return (
            " or ".join(inner)
            if self.at_least == 1
            else f"at least {self.at_least} of {', '.join(inner)}"
        )


NOTHING = Needs(0, ())


def all_of(*parts: Needs | str) -> Needs:
    """Return needs that are met when every part is up."""
    return Needs(len(parts), parts)


def any_of(*parts: Needs | str) -> Needs:
    """Return needs that are met when one part is up."""
    return Needs(1, parts)


def at_least(count: int, *parts: Needs | str) -> Needs:
    """Return needs that are met when at least ``count`` parts are up."""
    return Needs(count, parts)


def parse_needs(
    node: Node, problems: list[Problem], where: str, *, may_be_empty: bool = False
) -> Needs | None:
    """Read needs from a file; if they are invalid return None and add the reason to ``problems``.

    ``may_be_empty`` allows the empty list: nothing is needed.
    """
    if may_be_empty and node.items == ():
        return NOTHING
    return _Reader(problems).needs(node, where)


def cycles(needs: Mapping[str, Needs]) -> Iterator[tuple[str, ...]]:
    """Yield each cycle found: its names in order; the last one needs the first again.

    At least one is found if there is any; depth first, without recursion.
    """
    done: set[str] = set()
    for start in needs:
        if start not in done:
            path, on_path = [start], {start}
            waiting = [iter(needs[start].names())]
            while waiting:
                target = next(waiting[-1], None)
                if target is None:
                    waiting.pop()
                    done.add(path[-1])
                    on_path.discard(path.pop())
                elif target in on_path:
                    yield tuple(path[path.index(target) :])
                elif target in needs and target not in done:
                    path.append(target)
                    on_path.add(target)
                    waiting.append(iter(needs[target].names()))


def _names(needs: Needs) -> Iterator[str]:
    for part in needs.parts:
        if isinstance(part, str):
            yield part
        else:
            yield from _names(part)


@dataclass(frozen=True, slots=True)
class _Reader:
    """Reads needs and reports everything wrong with them."""

    problems: list[Problem]

    def needs(self, node: Node, where: str) -> Needs | None:
        """Read a list or a mapping."""
        if node.items is not None:
            return self._gate(node, where, None)
        entries = node.mapping
        if entries is None:
            return self._fail(node, where, f"expected what is needed, got {node.kind}", _HINT)
        for key, value in entries.items():
            if key not in _KEYS:
                near = did_you_mean(key, _KEYS)
                return self._fail(value, where, f"unknown key '{key}'{near}", _HINT)
        return self._mapping(node, entries, where)

    def _mapping(self, node: Node, entries: Mapping[str, Node], where: str) -> Needs | None:
        if set(entries) == {"at_least", "of"}:
            return self._at_least(entries["at_least"], entries["of"], where)
        if len(entries) != 1 or not set(entries) <= {"all", "any"}:
            keys = " and ".join(entries) or "nothing"
            return self._fail(node, where, f"{keys} make no needs", _HINT)
        key, value = next(iter(entries.items()))
        return self._gate(value, f"{where}.{key}", 1 if key == "any" else None)

    def _at_least(self, count: Node, of: Node, where: str) -> Needs | None:
        number = count.value
        if not isinstance(number, int) or isinstance(number, bool) or number < 1:
            what = f"expected a whole number from 1, got {count.kind} '{count.text}'"
            return self._fail(count, f"{where}.at_least", what)
        needs = self._gate(of, f"{where}.of", number)
        if needs is not None and number > len(needs.parts):
            what = f"{number} of {len(needs.parts)} can never be up"
            return self._fail(count, f"{where}.at_least", what)
        return needs

    def _gate(self, node: Node, where: str, count: int | None) -> Needs | None:
        if node.items is None:
            return self._fail(node, where, f"expected a list of names, got {node.kind}", _HINT)
        if not node.items:
            return self._fail(node, where, "nothing is named: a gate without input", _HINT)
        parts = [self._part(n, f"{where}[{place}]") for place, n in enumerate(node.items)]
        good = tuple(part for part in parts if part is not None)
        if len(good) < len(parts):
            return None
        for place, part in enumerate(good):
            if part in good[:place]:
                return self._fail(node.items[place], f"{where}[{place}]", f"'{part}' comes twice")
        return Needs(len(good) if count is None else count, good)

    def _part(self, node: Node, where: str) -> Needs | str | None:
        if node.mapping is not None:
            return self.needs(node, where)
        if node.items is not None or node.value is None or not node.text:
            return self._fail(node, where, f"expected a name, got {node.kind}", _HINT)
        return node.text

    def _fail(self, node: Node, where: str, what: str, hint: str = "") -> Needs | None:
        """Report a problem; always returns None."""
        self.problems.append(node.problem(where, what, hint))
        return None
