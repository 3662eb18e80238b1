"""The order in which components are shown."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from amberbox.monitoring.plan import ComponentPlan, DependencyPlan, MonitoringPlan, branches


def component(name: str, *needs: str, part_of: str = "") -> ComponentPlan:
    dependencies = [DependencyPlan(need, component=need) for need in needs]
    return ComponentPlan(name, name, dependencies=dependencies, part_of=part_of)


def drawn(*components: ComponentPlan) -> list[str]:
    return ["-" * b.depth + b.component for b in branches(MonitoringPlan("r", "", components))]


def test_parts_stand_below_what_they_are_part_of() -> None:
    assert drawn(
        component("laser", part_of="base"),
        component("navigation", "laser"),
        component("base"),
        component("wheel", part_of="base"),
    ) == ["navigation", "base", "-laser", "-wheel"]


def test_without_parts_what_is_needed_stands_below_what_needs_it_first() -> None:
    assert drawn(
        component("laser", "ethercat"),
        component("localisation", "laser"),
        component("navigation", "localisation", "laser", "no_such"),
        component("ethercat"),
        component("wifi"),
    ) == ["navigation", "-localisation", "--laser", "---ethercat", "wifi"]


NAMES = st.sampled_from("abcdef")


@given(st.dictionaries(NAMES, st.tuples(st.lists(NAMES, max_size=3), NAMES | st.just(""))))
def test_each_component_is_shown_once_also_in_a_circle(
    graph: dict[str, tuple[list[str], str]],
) -> None:
    components = [component(n, *needs, part_of=whole) for n, (needs, whole) in graph.items()]
    shown = [line.lstrip("-") for line in drawn(*components)]
    assert sorted(shown) == sorted(graph)


def test_a_long_chain_is_shown() -> None:
    """Deeper than Python calls itself."""
    chain = [component(f"c{k}", f"c{k + 1}") for k in range(1500)]
    assert [branch.depth for branch in branches(MonitoringPlan("r", "h", chain))] == list(
        range(1500)
    )
