"""Why an answer holds: the tree of clauses and facts that it was derived from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from amberbox.diagnosis.rules.clauses import Clause
from amberbox.diagnosis.rules.faults import Place
from amberbox.diagnosis.rules.terms import Term, make
from amberbox.diagnosis.rules.unify import Copies, Memo, copy, freeze
from amberbox.diagnosis.rules.writer import Names, anonymous, write

Trace: TypeAlias = "tuple[Any, ...] | None"
"""What was proved so far, newest first: ``(older, ENTER, clause, args)``, ``(older, EXIT)`` or
``(older, LEAF, term or Node)``."""

ENTER, EXIT, LEAF = "enter", "exit", "leaf"

LONGEST_GOAL = 500
"""Most characters of one goal that is shown as a reason; a longer one ends with ``...``."""

_DEEPEST = 40
"""Deepest goal of a proof that is shown by indentation, and that is nested in JSON."""

Kind: TypeAlias = Literal["rule", "fact", "builtin", "lookup"]


@dataclass(frozen=True, slots=True)
class Source:
    """Where something was looked up, in words, and what was measured: address, from, to in ns."""

    text: str
    evidence: tuple[tuple[str, int, int], ...] = ()


class Looked(NamedTuple):
    """A goal that holds because of what was looked up."""

    goal: Term
    source: Source


@dataclass(slots=True, eq=False)
class Node:
    """A goal that holds: by a rule (then its goals are below it), a fact, a lookup, or built in."""

    goal: Term
    kind: Kind
    place: Place | None = None
    children: list[Node] = field(default_factory=list)
    source: Source | None = None
    """Where it was looked up."""

    def leaves(self) -> Iterator[Node]:
        """Yield the facts and built-in goals at the ends of the tree, from left to right."""
        for node, _, is_again in self.walk():
            if not node.children and not is_again:
                yield node

    def walk(self) -> Iterator[tuple[Node, int, bool]]:
        """Yield every node with its depth, and whether it was shown before with what is below."""
        shown: set[int] = set()
        open_nodes = [(self, 0)]
        while open_nodes:
            node, depth = open_nodes.pop()
            is_again = id(node) in shown and bool(node.children)
            yield node, depth, is_again
            if not is_again:
                shown.add(id(node))
                open_nodes.extend((child, depth + 1) for child in reversed(node.children))

    def text(self, names: Names = anonymous) -> str:
        """Write the tree, one goal per line, indented by depth; very deep ones by a number."""
        lines = []
        for node, depth, is_again in self.walk():
            note = "   (shown above)" if is_again else _source(node)
            goal = write(node.goal, names, longest=LONGEST_GOAL)
            lines.append(f"{_indent(depth)}{goal}{note}")
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return the tree as plain Python; what is below a repeated goal is given once.

        Goals deeper than 40 are beside each other there, in order, each with its ``depth``.
        """
        root: dict[str, Any] | None = None
        path: list[dict[str, Any]] = []
        for node, depth, is_again in self.walk():
            goal = write(node.goal, longest=LONGEST_GOAL)
            entry: dict[str, Any] = {"goal": goal, "by": node.kind}
            entry |= {"depth": depth} if depth > _DEEPEST else {}
            entry |= {"at": str(node.place)} if node.place is not None else {}
            entry |= {"at": node.source.text} if node.source is not None else {}
            entry |= {"shown_above": True} if is_again else {}
            del path[min(depth, _DEEPEST) :]
            if path:
                path[-1].setdefault("because", []).append(entry)
            path.append(entry)
            root = root or entry
        return root or {}


def _indent(depth: int) -> str:
    return "  " * depth if depth <= _DEEPEST else f"{'  ' * _DEEPEST}({depth}) "


def _source(node: Node) -> str:
    if node.kind == "builtin":
        return ""
    if node.source is not None:
        return f"   {node.source.text}"
    return f"   {node.kind}, {node.place}" if node.place is not None else f"   {node.kind}"


def nodes_of(trace: Trace) -> list[Node]:
    """Return the goals that a trace proves, in the order in which they were run."""
    root = Node("true", "builtin")
    path = [root]
    copied: Copies = {}
    hidden: list[int] = []
    for event in _events(trace):
        if event[1] == EXIT:
            if hidden and hidden[-1] == len(path):
                hidden.pop()
            path.pop()
            continue
        node = event[2] if isinstance(event[2], Node) else _node(event, copied)
        if not hidden:
            path[-1].children.append(node)
        if event[1] == ENTER:
            path.append(node)
            if event[2].place.file == LIBRARY and not hidden:
                hidden.append(len(path))
    return root.children


LIBRARY = "library"
"""File of the rules that come with the language: they are shown as if they were built in."""


def node_of(trace: Trace, goal: Term) -> Node:
    """Return the only goal that a trace proves, as it is known after the proof."""
    node = nodes_of(trace)[0]
    return Node(goal, node.kind, node.place, node.children)


def _events(trace: Trace) -> list[tuple[Any, ...]]:
    events = []
    while trace is not None:
        events.append(trace)
        trace = trace[0]
    return events[::-1]


def _node(event: tuple[Any, ...], copied: Copies) -> Node:
    if event[1] == LEAF:
        return _leaf(event[2], copied)
    clause: Clause = event[2]
    goal = make(clause.key[0], [freeze(arg, copied) for arg in event[3]])
    if clause.place.file == LIBRARY:
        return Node(goal, "builtin")
    return Node(goal, "fact" if clause.body is None else "rule", clause.place)


def _leaf(leaf: Term | Looked, copied: Copies) -> Node:
    if isinstance(leaf, Looked):
        return Node(freeze(leaf.goal, copied), "lookup", source=leaf.source)
    return Node(freeze(leaf, copied), "builtin")


def copy_trace(trace: Trace, memo: Memo) -> Trace:
    """Copy a trace together with terms that share its variables."""
    copied: Trace = None
    for _, kind, *rest in _events(trace):
        if kind == ENTER:
            args = tuple(copy(arg, memo) for arg in rest[1])
            copied = (copied, ENTER, rest[0], args)
        elif kind == LEAF:
            copied = (copied, LEAF, _copied(rest[0], memo))
        else:
            copied = (copied, EXIT)
    return copied


def _copied(leaf: Term | Node | Looked, memo: Memo) -> Term | Node | Looked:
    if isinstance(leaf, Node):
        return leaf
    if isinstance(leaf, Looked):
        return Looked(copy(leaf.goal, memo), leaf.source)
    return copy(leaf, memo)
