"""Dependency graphs: every component and dependency once; in large ones healthy ones are
counted.
"""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from amberbox.server.drawing.graph import (
    ComponentBox,
    DependencyEdge,
    dependency_graph,
    indirect_links,
    select_components,
)
from tests.server.drawing.parsed import (
    HOSTILE,
    WORDS,
    frames,
    of_class,
    overlapping,
    parsed,
    shown,
    texts,
    titles,
)

LASER = ComponentBox("laser", "front laser", "error", "silent", "no scans", "/laser", root=True)
NAVIGATION = ComponentBox("navigation", "navigation", "stale")
WIFI = ComponentBox("wifi", "wifi", "ok")
ROBOT = (LASER, NAVIGATION, WIFI)
NEEDS = (
    DependencyEdge("navigation", "laser"),
    DependencyEdge("navigation", "wifi"),
    DependencyEdge("laser", "base", "part of"),
)


def _drawn() -> ElementTree.Element:
    return parsed(dependency_graph(ROBOT, NEEDS, label="What ropod_001 needs", words=WORDS))


def test_every_node_and_edge_stands_once() -> None:
    """Draw what there is, and the component that only an edge names."""
    tree = _drawn()
    assert sorted(node.get("data-id", "") for node in of_class(tree, "node")) == [
        "base", "laser", "navigation", "wifi",
    ]  # fmt: skip
    edges = [(e.get("data-start"), e.get("data-end")) for e in of_class(tree, "edge")]
    assert sorted(edges) == [("laser", "base"), ("navigation", "laser"), ("navigation", "wifi")]


def test_level_is_sign_word_and_class() -> None:
    """The level of a component is shown in three ways, not by colour alone."""
    laser = next(n for n in of_class(_drawn(), "node") if n.get("data-id") == "laser")
    assert "level-error" in laser.get("class", "").split()
    assert of_class(laser, "icon")
    assert "error, silent" in texts(laser)
    assert titles(laser)[0] == "front laser: error, silent. no scans (cause)"


def test_signs_differ_by_shape() -> None:
    """Draw another outline or sign for each level."""
    levels = ("ok", "warn", "error", "stale", "unknown")
    tree = parsed(
        dependency_graph([ComponentBox(x, x, x) for x in levels], (), label="x", words=WORDS)
    )
    signs = {tuple(part.get("d") for part in icon) for icon in of_class(tree, "icon")}
    assert len(signs) == len(levels)


def test_cause_is_a_word_on_a_thick_box() -> None:
    """The origin of a failure is marked."""
    tree = _drawn()
    assert [node.get("data-id") for node in of_class(tree, "root")] == ["laser"]
    assert texts(tree).count("cause") == 1


def test_what_fails_together_is_one_way() -> None:
    """The edges between failed components are marked."""
    bad = [(e.get("data-start"), e.get("data-end")) for e in of_class(_drawn(), "bad")]
    assert bad == [("navigation", "laser")]


def test_legend_explains_the_lines_there_are() -> None:
    """Explain each kind of line, and no other."""
    words = [texts(key)[0] for key in of_class(_drawn(), "key")]
    assert words == ["needs", "part of"]


def test_both_ways_are_no_circle() -> None:
    """Take no offence at parts that are needed by the whole."""
    edges = (DependencyEdge("base", "wheel"), DependencyEdge("wheel", "base", "part of"))
    tree = parsed(dependency_graph((), edges, label="x", words=WORDS))
    assert not of_class(tree, "broken")
    assert len(of_class(tree, "edge")) == 2


def test_circle_is_marked() -> None:
    """The dependency that closes a cycle is marked."""
    tree = parsed(
        dependency_graph(
            (), (DependencyEdge("a", "b"), DependencyEdge("b", "a")), label="x", words=WORDS
        )
    )
    assert len(of_class(tree, "edge")) == 2
    assert len(of_class(of_class(tree, "edge")[0], "line")) == 1
    assert "b needs a (closes a circle)" in titles(tree)


def test_much_that_is_fine_is_counted() -> None:
    """Failed components and their neighbours are drawn, others counted, paths between them kept."""
    chain = [ComponentBox(f"c{n}", f"c{n}", "error" if n in (0, 99) else "ok") for n in range(100)]
    edges = [DependencyEdge(f"c{n}", f"c{n + 1}") for n in range(99)]
    tree = parsed(dependency_graph(chain, edges, label="x", most=10, more_href="/all", words=WORDS))
    drawn = [node for node in of_class(tree, "node") if node.get("data-id")]
    assert len(drawn) == 10
    assert "+90 fine" in texts(tree)
    assert [e.get("data-start") for e in of_class(tree, "indirect") if e.get("data-start")] == [
        "c4"
    ]
    assert "c4 needs c95 (+90 fine)" in titles(tree)


def test_all_that_is_wrong_is_drawn() -> None:
    """Components that are not ok are never left out."""
    broken = [ComponentBox(f"c{n}", f"c{n}", "error") for n in range(80)]
    tree = parsed(dependency_graph(broken, (), label="x", most=60, words=WORDS))
    assert len(of_class(tree, "node")) == 80


@settings(max_examples=15)
@given(some.lists(some.tuples(some.integers(0, 15), some.integers(0, 15)), max_size=30))
def test_boxes_do_not_overlap(pairs: list[tuple[int, int]]) -> None:
    """Give each card room of its own, inside the drawing."""
    edges = [DependencyEdge(f"c{start}", f"c{end}") for start, end in pairs]
    components = [ComponentBox(f"c{n}", "x" * n, "ok") for n in range(16)]
    drawing = parsed(dependency_graph(components, edges, label="x", words=WORDS))
    found = frames(drawing, "node")
    assert len(found) == 16
    assert not overlapping(found)


@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_names_are_text(hostile: str) -> None:
    """Draw any name as text; elements are only our own."""
    component = ComponentBox(hostile, hostile, hostile, hostile, hostile, root=True)
    tree = parsed(
        dependency_graph(
            [component], [DependencyEdge(hostile, hostile + "2")], label=hostile, words=WORDS
        )
    )
    assert {part.tag.rpartition("}")[2] for part in tree.iter()} <= {
        "svg", "g", "title", "rect", "path", "text",
    }  # fmt: skip
    assert not [1 for part in tree.iter() for name in part.attrib if name.startswith("on")]


def test_words_come_from_the_caller() -> None:
    """Texts are those of a given catalogue."""
    words = replace(WORDS, error="kaputt", cause="Ursache", needs="braucht")
    said = shown(parsed(dependency_graph(ROBOT, NEEDS, label="x", words=words)))
    assert "kaputt" in said
    assert "Ursache" in said
    assert "navigation braucht wifi" in said


def test_same_data_same_drawing() -> None:
    """Draw the same thing the same way, with its name."""
    one, two = (dependency_graph(ROBOT, NEEDS, label="Needs", words=WORDS) for _ in range(2))
    assert str(one) == str(two)
    assert one.get("aria-label") == "Needs"


def test_kept_is_near_to_what_is_wrong() -> None:
    """Neighbours are kept first; without a failed component the first ones."""
    pairs = [("a", "b"), ("b", "c"), ("c", "d")]
    assert select_components("abcd", {"d"}, pairs, 2) == {"d", "c"}
    assert select_components("abcd", set(), pairs, 2) == {"a", "b"}


def test_bridges_count_what_they_pass() -> None:
    """Bridges lead over hidden components, except where there is a direct link."""
    pairs = [("a", "x"), ("x", "y"), ("y", "b"), ("x", "c"), ("a", "c"), ("x", "a")]
    assert indirect_links(pairs, "abc") == {("a", "b"): 2}
