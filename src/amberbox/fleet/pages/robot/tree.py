"""The tree of a robot's components as its page shows it: what is open, what is looked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Literal
from urllib.parse import quote

from amberbox.fleet.pages.figures import span
from amberbox.fleet.pages.robot.expected import failing
from amberbox.fleet.pages.wording import capital, readable
from amberbox.fleet.state.views import Component, StatusTree

Show = Literal["all", "trouble"]

OPENED = 3
"""So many components in trouble are open where nobody has chosen what is."""
NONE = "-"
"""Stands in the address where somebody has closed all."""
_KEPT = "!'()*"
"""What encodeURIComponent of browsers leaves as it is."""


@dataclass(frozen=True, slots=True)
class Branch:
    """A component with what is inside; ``root``: it is in trouble and nothing is in its way.

    ``holding`` are modes, and modes with an output, that are folded: others are what fails.
    """

    component: Component
    name: str
    id: str
    level: str
    is_open: bool
    is_hidden: bool
    root: bool
    holding: Set[tuple[str, str]]

    @property
    def held(self) -> int:
        """Count the outputs that are folded."""
        return sum(bool(output) for _, output in self.holding)


def branches(tree: StatusTree, q: str, show: Show, chosen: Sequence[str]) -> list[Branch]:
    """Return the components in their order; ``chosen`` are those that somebody has opened."""
    opened = set(chosen) or set(_in_trouble(tree.components))
    return [
        Branch(
            one, called(one.component, one.name), branch_id(one.component), level_of(one),
            one.component in opened, not _fits(one, q, show), is_root(one), set(_holding(one)),
        )
        for one in tree.components
    ]  # fmt: skip


def called(component: str, name: str = "") -> str:
    """Return what a component is called: as its file says, else its id with spaces."""
    return capital(name if name != component and name else readable(component))


def names(components: Sequence[Component]) -> Mapping[str, str]:
    """Return what each component is called."""
    return {one.component: called(one.component, one.name) for one in components}


def needs_id(component: str, name: str) -> bool:
    """Tell whether the id of a component says more than what it is called."""
    return component.casefold() != name.casefold()


def branch_id(component: str) -> str:
    """Return the id of a component's element: nothing in it has a meaning of its own."""
    return f"c-{quote(component, safe='')}"


def key(component: str, mode: str = "", output: str = "") -> str:
    """Return the name by which the browser finds what shows something, as live.js makes it."""
    return "/".join(quote(name, safe=_KEPT) for name in (component, mode, output))


def level_of(component: Component) -> str:
    """Return the level of a component; unknown where nothing was said of it."""
    return component.condition.level if component.condition else "unknown"


def is_root(component: Component) -> bool:
    """Tell whether trouble begins here: it is not well, and nothing that it needs is in the way."""
    said = component.condition
    return said is not None and said.level in ("error", "warn", "stale") and not said.blocked_by


def span_text(seconds: float) -> str:
    """Write how long something lasts, as pages do: in one unit, at least 1 s."""
    return span(max(1, seconds))


def _in_trouble(components: Sequence[Component]) -> Iterator[str]:
    worst = sorted(filter(is_root, components), key=lambda one: level_of(one) != "error")
    yield from (one.component for one in worst[:OPENED])


def _holding(component: Component) -> Iterator[tuple[str, str]]:
    """Yield what there is beside checks that fail; nothing where none does."""
    bad = {mode.mode: [one.name for one in mode.outputs if failing(mode, one)]
           for mode in component.modes}  # fmt: skip
    if not any(bad.values()):
        return
    for mode in component.modes:
        holds = mode.condition.level == "ok"
        if holds:
            yield mode.mode, ""
        if holds or bad[mode.mode]:
            yield from ((mode.mode, one.name) for one in mode.outputs
                        if one.name not in bad[mode.mode])  # fmt: skip


def _fits(component: Component, q: str, show: Show) -> bool:
    words = " ".join(_words(component)).casefold()
    return all(word in words for word in q.casefold().split()) and (
        show == "all" or level_of(component) != "ok"
    )


def _words(component: Component) -> Iterator[str]:
    yield from (component.component, called(component.component, component.name))
    for mode in component.modes:
        yield from (mode.mode, mode.name, *(output.name for output in mode.outputs))
