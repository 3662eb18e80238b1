"""The parts that an expression is made of, as a tree."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

Kind: TypeAlias = Literal["number", "text", "condition", "null", "any"]
"""What a value is: ``null`` if it is never known, ``any`` if only the data can tell."""


class Fault(Exception):  # noqa: N818 - becomes an ExpressionError once the text is at hand
    """What is wrong at a place of an expression, counted in characters from 0."""

    def __init__(self, what: str, at: int, hint: str = "") -> None:
        super().__init__(what)
        self.what, self.at, self.hint = what, at, hint


@dataclass(frozen=True, slots=True)
class Tree:
    """A part; ``at`` is its place in the text."""

    at: int


@dataclass(frozen=True, slots=True)
class Constant(Tree):
    """``3``, ``500ms`` (in seconds), ``'text'``, ``true``, ``null``."""

    value: int | float | str | bool | None


@dataclass(frozen=True, slots=True)
class Address(Tree):
    """The latest value of a variable, an output or a failure mode."""

    name: str


@dataclass(frozen=True, slots=True)
class Negative(Tree):
    """``-x``."""

    inner: Tree


@dataclass(frozen=True, slots=True)
class Arithmetic(Tree):
    """``x + y`` and ``- * / %``."""

    operator: str
    left: Tree
    right: Tree


@dataclass(frozen=True, slots=True)
class Comparison(Tree):
    """``0 < x <= 5``: true if every neighbouring pair compares."""

    operators: tuple[str, ...]
    operands: tuple[Tree, ...]


@dataclass(frozen=True, slots=True)
class Not(Tree):
    """``not x``."""

    inner: Tree


@dataclass(frozen=True, slots=True)
class Logic(Tree):
    """``x and y``, ``x or y``."""

    operator: str
    operands: tuple[Tree, ...]


@dataclass(frozen=True, slots=True)
class Call(Tree):
    """A function of values at one instant, such as ``abs(x)``."""

    name: str
    arguments: tuple[Tree, ...]


@dataclass(frozen=True, slots=True)
class Age(Tree):
    """Seconds since a variable was last known."""

    inner: Address


@dataclass(frozen=True)
class Window(Tree):
    """A function of the samples of the last while, such as ``mean(x over 5s)``."""

    name: str
    inner: Tree
    over_ns: int

    @cached_property
    def reads(self) -> tuple[str, ...]:
        """The addresses below, each once."""
        return addresses_of(self.inner)

    @cached_property
    def is_nested(self) -> bool:
        """Whether what is below looks back in time itself."""
        return needs_history(self.inner)

    @cached_property
    def saying(self) -> str:
        """What it says, wherever it stands: the same for windows that are the same."""
        return _saying(self)


@dataclass(frozen=True)
class Held(Tree):
    """``x for 5s``: the condition has been true without a break for that long."""

    inner: Tree
    for_ns: int

    @cached_property
    def breakpoints(self) -> tuple[tuple[str, int], ...]:
        """When the condition may change: addresses, and how long (ns) after their samples."""
        return tuple(dict.fromkeys(_breakpoints(self.inner)))


_KINDS: dict[type[Tree], Kind] = {
    **dict.fromkeys((Negative, Arithmetic, Age, Window), "number"),
    **dict.fromkeys((Comparison, Not, Logic, Held), "condition"),
}


def status_address(subject: str) -> str:
    """Return the address of the level of a ``component``, or of a ``component/mode``."""
    return f"status({subject})"


def status_of(address: str) -> tuple[str, str] | None:
    """Return component and mode whose level an address is; the mode of a component is empty."""
    if not address.startswith("status("):
        return None
    component, _, mode = address[len("status(") : -1].partition("/")
    return component, mode


def output_of(address: str) -> tuple[str, str, str] | None:
    """Return component, mode and output of an address ``component/mode/output``; else None."""
    component, *rest = address.split("/", 2)
    return (component, rest[0], rest[1]) if len(rest) == 2 else None


def of_monitors(address: str) -> tuple[str, ...] | None:
    """Return component and mode of a status, or component, mode and output; None for others."""
    return status_of(address) or output_of(address)


def kind_of(tree: Tree) -> Kind:
    """Tell what a part gives, as far as its form says."""
    if isinstance(tree, Constant):
        return kind_of_value(tree.value)
    if isinstance(tree, Call):
        return "condition" if tree.name in ("known", "bit") else "number"
    if isinstance(tree, Address) and status_of(tree.name) is not None:
        return "text"
    return _KINDS.get(type(tree), "any")


def kind_of_value(value: object) -> Kind:
    """Tell what a Python value is."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "condition"
    return "text" if isinstance(value, str) else "number"


def children(tree: Tree) -> Iterator[Tree]:
    """Yield the parts right below, in order."""
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, Tree):
                yield part


def walk(tree: Tree) -> Iterator[Tree]:
    """Yield a tree and everything below it, from left to right."""
    yield tree
    for child in children(tree):
        yield from walk(child)


def with_addresses(tree: Tree, change: Callable[[Address], Address]) -> Tree:
    """Return the tree with every address replaced."""
    if isinstance(tree, Address):
        return change(tree)
    changed: dict[str, object] = {}
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        if isinstance(value, Tree):
            changed[field.name] = with_addresses(value, change)
        elif isinstance(value, tuple) and value and isinstance(value[0], Tree):
            changed[field.name] = tuple(with_addresses(part, change) for part in value)
    return dataclasses.replace(tree, **changed)  # type: ignore[arg-type]  # fields by name


def history_ns(tree: Tree) -> int:
    """Return how far back in time a tree looks."""
    own = tree.over_ns if isinstance(tree, Window) else 0
    own = tree.for_ns if isinstance(tree, Held) else own
    return own + max((history_ns(child) for child in children(tree)), default=0)


def shortest_ns(tree: Tree) -> int | None:
    """Return the shortest time that a tree looks back by ``over`` or ``for``; None without."""
    spans = [part.over_ns for part in walk(tree) if isinstance(part, Window)]
    return min(spans + [part.for_ns for part in walk(tree) if isinstance(part, Held)], default=None)


def delays_ns(tree: Tree) -> frozenset[int]:
    """Return how long after a sample the value of a tree may change."""
    own = {tree.over_ns} if isinstance(tree, Window) else set()
    own |= {tree.for_ns} if isinstance(tree, Held) else set()
    inner = frozenset({0}).union(*(delays_ns(child) for child in children(tree)))
    return frozenset(delay + more for delay in inner for more in (0, *own))


def needs_history(tree: Tree) -> bool:
    """Tell whether a tree cannot be judged from the values of one instant."""
    return any(isinstance(part, Window | Held | Age) for part in walk(tree))


def _saying(value: object) -> str:
    """Return a part as text, without its place."""
    if isinstance(value, tuple):
        return f"({','.join(map(_saying, value))})"
    if not isinstance(value, Tree):
        return repr(value)
    parts = (getattr(value, one.name) for one in dataclasses.fields(value) if one.name != "at")
    return f"{type(value).__name__}({','.join(map(_saying, parts))})"


def addresses_of(tree: Tree) -> tuple[str, ...]:
    """Return the addresses in a tree, each once, from left to right."""
    return tuple(dict.fromkeys(part.name for part in walk(tree) if isinstance(part, Address)))


def current_addresses(tree: Tree) -> tuple[str, ...]:
    """Return the addresses whose present value is read, each once; in windows only samples are."""
    if isinstance(tree, Address):
        return (tree.name,)
    if isinstance(tree, Window | Age):
        return ()
    return tuple(dict.fromkeys(n for child in children(tree) for n in current_addresses(child)))


def _breakpoints(tree: Tree) -> Iterator[tuple[str, int]]:
    """Yield after which samples, and how long after them, the value of a tree may change.

    ``age`` grows between samples: it is looked at right before each sample, where it is largest.
    """
    if isinstance(tree, Address):
        yield tree.name, 0
    elif isinstance(tree, Age):
        yield from ((tree.inner.name, 0), (tree.inner.name, -1))
    elif isinstance(tree, Window):
        yield from ((name, delay_ns) for name in tree.reads for delay_ns in (0, tree.over_ns))
    else:
        for part in children(tree):
            yield from _breakpoints(part)
            if isinstance(tree, Held):
                yield from ((name, delay + tree.for_ns) for name, delay in _breakpoints(part))
