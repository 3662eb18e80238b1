"""``part_of``: the tree of components."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.monitoring.configuration.dependencies import Named


def part_problems(components: Sequence[Named]) -> Iterator[Problem]:
    """Yield what is wrong with the tree: parts of nothing, and of themselves."""
    above = {entry.plan.id: entry.plan.part_of for entry in components}
    for entry in components:
        place = (entry.node.mapping or {}).get("part_of", entry.node)
        wanted = entry.plan.part_of
        if wanted and wanted not in above:
            what = f"there is no component '{wanted}'{did_you_mean(wanted, above)}"
            yield place.problem("part_of", what)
        elif wanted and entry.plan.id in _all_above(entry.plan.id, above):
            yield place.problem("part_of", f"{entry.plan.id} is a part of itself")


def _all_above(name: str, above: Mapping[str, str]) -> list[str]:
    found: list[str] = []
    while (name := above.get(name, "")) and name not in found:
        found.append(name)
    return found
