"""Groups of nodes of a graph that lead to each other."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import TypeVar

Node = TypeVar("Node", bound=Hashable)


def cyclic_groups(graph: Mapping[Node, Iterable[Node]]) -> list[list[Node]]:
    """Return groups of nodes that lead to each other, each after those that it leads to.

    A node on no cycle is a group of its own. Nodes that are no keys of the graph are left out.
    Uses Tarjan's algorithm, without recursion.
    """
    number: dict[Node, int] = {}
    lowest: dict[Node, int] = {}
    path: list[Node] = []
    on_path: set[Node] = set()
    found: list[list[Node]] = []
    for start in graph:
        if start in number:
            continue
        work = [(start, iter(list(graph[start])))]
        number[start] = lowest[start] = len(number)
        path.append(start)
        on_path.add(start)
        while work:
            key, needed = work[-1]
            for other in needed:
                if other not in graph:
                    continue
                if other not in number:
                    number[other] = lowest[other] = len(number)
                    path.append(other)
                    on_path.add(other)
                    work.append((other, iter(list(graph[other]))))
                    break
                if other in on_path:
                    lowest[key] = min(lowest[key], number[other])
            else:
                work.pop()
                if work:
                    above = work[-1][0]
                    lowest[above] = min(lowest[above], lowest[key])
                if lowest[key] == number[key]:
                    group = path[path.index(key) :]
                    del path[path.index(key) :]
                    on_path.difference_update(group)
                    found.append(group)
    return found
