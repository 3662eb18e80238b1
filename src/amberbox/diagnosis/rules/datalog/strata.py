"""The order in which relations are filled: those first that others need."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from amberbox.diagnosis.rules.terms import Key

Graph = Mapping[Key, Iterable[Key]]


def components(graph: Graph) -> list[list[Key]]:
    """Return groups of relations that depend on each other, after those that they need.

    Tarjan's algorithm, without recursion.
    """
    number: dict[Key, int] = {}
    lowest: dict[Key, int] = {}
    path: list[Key] = []
    on_path: set[Key] = set()
    found: list[list[Key]] = []
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
