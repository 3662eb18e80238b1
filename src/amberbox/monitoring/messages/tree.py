"""The order in which components are shown: as parts of each other, else by what needs what."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from amberbox.monitoring.plan import Plan


class Branch(NamedTuple):
    """One component and how deep it stands in the tree."""

    depth: int
    component: str


def branches(plan: Plan) -> list[Branch]:
    """Return every component of a plan once, each below what it is part of.

    Where nothing is part of anything, what others need stands below the first that needs it.
    """
    known = [component.id for component in plan.components]
    parts = {c.id: c.part_of for c in plan.components if c.part_of in known}
    below: dict[str, list[str]] = {name: [] for name in known}
    if parts:
        for part, whole in parts.items():
            below[whole].append(part)
    else:
        for component in plan.components:
            needs = (d.component for d in component.dependencies if d.component in below)
            below[component.id] += [name for name in needs if name]
    return list(_walked(known, below))


def _walked(known: Sequence[str], below: Mapping[str, Sequence[str]]) -> Iterator[Branch]:
    """Walk from those that are below nothing, then from what is left (a circle)."""
    lower = {name for names in below.values() for name in names}
    roots = [name for name in known if name not in lower]
    seen: set[str] = set()
    left = [Branch(0, name) for name in reversed((*roots, *known))]
    while left:
        branch = left.pop()
        if branch.component not in seen:
            seen.add(branch.component)
            yield branch
            children = reversed(below[branch.component])
            left += [Branch(branch.depth + 1, child) for child in children]
