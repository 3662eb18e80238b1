"""The syntax tree of expressions: its nodes, and the properties of a tree without data."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

# ``null`` if never known, ``any`` if it depends on the data
Kind: TypeAlias = Literal["number", "text", "condition", "null", "any"]


class ExpressionFault(Exception):  # noqa: N818 - becomes an ExpressionError once the text is at hand
    """An error at a place of an expression, counted in characters from 0."""

    def __init__(self, what: str, at: int, hint: str = "") -> None:
        super().__init__(what)
        self.what, self.at, self.hint = what, at, hint


@dataclass(frozen=True, slots=True)
class ExpressionNode:
    """A part; ``at`` is its place in the text."""

    at: int


@dataclass(frozen=True, slots=True)
class ConstantNode(ExpressionNode):
    """``3``, ``500ms`` (in seconds), ``'text'``, ``true``, ``null``."""

    value: int | float | str | bool | None


@dataclass(frozen=True, slots=True)
class AddressNode(ExpressionNode):
    """The latest value of a variable, an output or a failure mode."""

    name: str


@dataclass(frozen=True, slots=True)
class NegativeNode(ExpressionNode):
    """``-x``."""

    inner: ExpressionNode


@dataclass(frozen=True)
class ArithmeticNode(ExpressionNode):
    """``x + y`` and ``- * / %``."""

    operator: str
    left: ExpressionNode
    right: ExpressionNode

    @cached_property
    def text(self) -> str:
        """Return its text without its place: equal for equal nodes."""
        chain = [self]  # of a long sum, without a recursion as deep
        while isinstance(chain[-1].left, ArithmeticNode):
            chain.append(chain[-1].left)
        text = _text_of(chain[-1].left)
        for node in reversed(chain):
            text = f"({text}{node.operator}{_text_of(node.right)})"
        return text


@dataclass(frozen=True, slots=True)
class ComparisonNode(ExpressionNode):
    """``0 < x <= 5``: true if every neighbouring pair compares."""

    operators: tuple[str, ...]
    operands: tuple[ExpressionNode, ...]


@dataclass(frozen=True, slots=True)
class NotNode(ExpressionNode):
    """``not x``."""

    inner: ExpressionNode


@dataclass(frozen=True, slots=True)
class LogicNode(ExpressionNode):
    """``x and y``, ``x or y``."""

    operator: str
    operands: tuple[ExpressionNode, ...]


@dataclass(frozen=True, slots=True)
class CallNode(ExpressionNode):
    """A function of values at one instant, such as ``abs(x)``."""

    name: str
    arguments: tuple[ExpressionNode, ...]


@dataclass(frozen=True, slots=True)
class AgeNode(ExpressionNode):
    """Seconds since a variable was last known."""

    inner: AddressNode


@dataclass(frozen=True)
class WindowNode(ExpressionNode):
    """A function of the samples of the last while, such as ``mean(x over 5s)``."""

    name: str
    inner: ExpressionNode
    over_ns: int

    @cached_property
    def reads(self) -> tuple[str, ...]:
        """Return the addresses below, each once."""
        return addresses_of(self.inner)

    @cached_property
    def is_nested(self) -> bool:
        """Return whether a part below it looks back in time itself."""
        return needs_history(self.inner)

    @cached_property
    def text(self) -> str:
        """Return its text without its place: equal for equal windows."""
        return _parts_of(self)


@dataclass(frozen=True)
class HeldNode(ExpressionNode):
    """``x for 5s``: the condition has been true without a break for that long."""

    inner: ExpressionNode
    for_ns: int

    @cached_property
    def breakpoints(self) -> tuple[tuple[str, int], ...]:
        """Return when the condition may change: addresses, and the ns after their samples."""
        return tuple(dict.fromkeys(_breakpoints(self.inner)))


_KINDS: dict[type[ExpressionNode], Kind] = {
    **dict.fromkeys((NegativeNode, ArithmeticNode, AgeNode, WindowNode), "number"),
    **dict.fromkeys((ComparisonNode, NotNode, LogicNode, HeldNode), "condition"),
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


def kind_of(tree: ExpressionNode) -> Kind:
    """Return the kind of a node's value, as far as it follows from its form."""
    if isinstance(tree, ConstantNode):
        return kind_of_value(tree.value)
    if isinstance(tree, CallNode):
        return "condition" if tree.name in ("known", "bit") else "number"
    if isinstance(tree, AddressNode) and status_of(tree.name) is not None:
        return "text"
    return _KINDS.get(type(tree), "any")


def kind_of_value(value: object) -> Kind:
    """Return the kind of a Python value."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "condition"
    return "text" if isinstance(value, str) else "number"


def children(tree: ExpressionNode) -> Iterator[ExpressionNode]:
    """Yield the direct children, in order."""
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, ExpressionNode):
                yield part


def walk(tree: ExpressionNode) -> Iterator[ExpressionNode]:
    """Yield a tree and everything below it, from left to right."""
    yield tree
    for child in children(tree):
        yield from walk(child)


def height(tree: ExpressionNode) -> int:
    """Return how many nodes are above each other at most."""
    level, found = [tree], 0
    while level:
        level, found = [child for node in level for child in children(node)], found + 1
    return found


def with_addresses(
    tree: ExpressionNode, change: Callable[[AddressNode], AddressNode]
) -> ExpressionNode:
    """Return the tree with every address replaced."""
    if isinstance(tree, AddressNode):
        return change(tree)
    changed: dict[str, object] = {}
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        if isinstance(value, ExpressionNode):
            changed[field.name] = with_addresses(value, change)
        elif isinstance(value, tuple) and value and isinstance(value[0], ExpressionNode):
            changed[field.name] = tuple(with_addresses(part, change) for part in value)
    return dataclasses.replace(tree, **changed)  # type: ignore[arg-type]  # fields by name


def history_ns(tree: ExpressionNode) -> int:
    """Return how far back in time a tree looks."""
    own = tree.over_ns if isinstance(tree, WindowNode) else 0
    own = tree.for_ns if isinstance(tree, HeldNode) else own
    return own + max((history_ns(child) for child in children(tree)), default=0)


def shortest_ns(tree: ExpressionNode) -> int | None:
    """Return the shortest time of any ``over`` or ``for`` in a tree; None if it has none."""
    spans = [part.over_ns for part in walk(tree) if isinstance(part, WindowNode)]
    return min(
        spans + [part.for_ns for part in walk(tree) if isinstance(part, HeldNode)], default=None
    )


def delays_ns(tree: ExpressionNode) -> frozenset[int]:
    """Return how long after a sample the value of a tree may change."""
    own = {tree.over_ns} if isinstance(tree, WindowNode) else set()
    own |= {tree.for_ns} if isinstance(tree, HeldNode) else set()
    inner = frozenset({0}).union(*(delays_ns(child) for child in children(tree)))
    return frozenset(delay + more for delay in inner for more in (0, *own))


def needs_history(tree: ExpressionNode) -> bool:
    """Return whether a tree needs more than the values of one instant."""
    return any(isinstance(part, WindowNode | HeldNode | AgeNode) for part in walk(tree))


def _text_of(value: object) -> str:
    """Return a part as text, without its place."""
    if isinstance(value, tuple):
        return f"({','.join(map(_text_of, value))})"
    if isinstance(value, ArithmeticNode | WindowNode):
        return value.text
    return _parts_of(value) if isinstance(value, ExpressionNode) else repr(value)


def _parts_of(node: ExpressionNode) -> str:
    parts = (getattr(node, one.name) for one in dataclasses.fields(node) if one.name != "at")
    return f"{type(node).__name__}({','.join(map(_text_of, parts))})"


def addresses_of(tree: ExpressionNode) -> tuple[str, ...]:
    """Return the addresses in a tree, each once, from left to right."""
    return tuple(dict.fromkeys(part.name for part in walk(tree) if isinstance(part, AddressNode)))


def current_addresses(tree: ExpressionNode) -> tuple[str, ...]:
    """Return the addresses whose present value is read, each once; in windows only samples are."""
    if isinstance(tree, AddressNode):
        return (tree.name,)
    if isinstance(tree, WindowNode | AgeNode):
        return ()
    return tuple(dict.fromkeys(n for child in children(tree) for n in current_addresses(child)))


def _breakpoints(tree: ExpressionNode) -> Iterator[tuple[str, int]]:
    """Yield after which samples, and how long after them, the value of a tree may change.

    ``age`` grows between samples: it is evaluated right before each sample, where it is largest.
    """
    if isinstance(tree, AddressNode):
        yield tree.name, 0
    elif isinstance(tree, AgeNode):
        yield from ((tree.inner.name, 0), (tree.inner.name, -1))
    elif isinstance(tree, WindowNode):
        yield from ((name, delay_ns) for name in tree.reads for delay_ns in (0, tree.over_ns))
    else:
        for part in children(tree):
            yield from _breakpoints(part)
            if isinstance(tree, HeldNode):
                yield from ((name, delay + tree.for_ns) for name, delay in _breakpoints(part))
