"""The graph of what needs what on a robot's page, and the same as a list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.fleet.drawing.graph import Component as Box
from amberbox.fleet.drawing.graph import Edge, dependency_graph
from amberbox.fleet.drawing.svg import Element
from amberbox.fleet.pages.drawingwords import drawing_words
from amberbox.fleet.pages.robot.tree import branch_id, called, is_root, level_of, names
from amberbox.fleet.pages.wording import readable
from amberbox.fleet.state.views import Component


@dataclass(frozen=True, slots=True)
class Line:
    """A component in the list: what it needs, and what needs it."""

    component: Component
    name: str
    id: str
    level: str
    root: bool
    needs: Sequence[str]
    needed_by: Sequence[str]


def edges(components: Sequence[Component]) -> list[Edge]:
    """Return what needs what, and what is part of what; only between components that are known."""
    known = {one.component for one in components}
    found: list[Edge] = []
    for one in components:
        needs = dict.fromkeys(need.component for need in one.needs)
        found += [Edge(one.component, name) for name in needs if name in known - {one.component}]
        if one.part_of in known and one.part_of != one.component and one.part_of not in needs:
            found.append(Edge(one.component, one.part_of, "part of"))
    return found


def graph(components: Sequence[Component], label: str) -> Element | None:
    """Draw it, each box a link to its row in the tree; None where nothing needs anything."""
    lines = edges(components)
    if not lines:
        return None
    return dependency_graph(
        [_box(one) for one in components], lines, label=label, words=drawing_words()
    )


def as_list(components: Sequence[Component]) -> list[Line]:
    """Return the same line by line, what is not well first."""
    needs = [edge for edge in edges(components) if edge.kind == "needs"]
    name = names(components)
    found = [
        Line(
            one, name[one.component], branch_id(one.component), level_of(one), is_root(one),
            [name[edge.end] for edge in needs if edge.start == one.component],
            [name[edge.start] for edge in needs if edge.end == one.component],
        )
        for one in components
    ]  # fmt: skip
    return sorted(found, key=lambda line: (not line.root, line.level == "ok"))


def _box(one: Component) -> Box:
    said = one.condition
    state = readable(said.state) if said and said.level != "ok" else ""
    return Box(
        one.component, called(one.component, one.name), level_of(one), state,
        said.reason if said else "", f"#{branch_id(one.component)}", is_root(one),
    )  # fmt: skip
