"""Layout: no boxes on each other, no lines through boxes, few crossings, always the same."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from amberbox.core.layered_layout import (
    GraphLayout,
    LayoutBox,
    backward,
    crossings,
    layered,
    ordered,
    ranks,
    rising,
)
from tests.server.drawing.parsed import Frame, along, overlapping

Links = list[tuple[str, str]]


@some.composite
def graphs(draw: some.DrawFn) -> tuple[list[LayoutBox], Links]:
    """Return boxes of any size and any links between them, with circles."""
    count = draw(some.integers(1, 24))
    size = some.sampled_from((30.0, 46.0, 120.0, 180.0))
    boxes = [LayoutBox(f"b{number}", draw(size), draw(size)) for number in range(count)]
    name = some.integers(0, count - 1).map("b{}".format)
    return boxes, draw(some.lists(some.tuples(name, name), max_size=40))


def _frames(boxes: Sequence[LayoutBox], layout: GraphLayout) -> dict[str, Frame]:
    return {box.id: Frame(*layout.corners[box.id], box.width, box.height) for box in boxes}


@settings(max_examples=30)
@given(graphs(), some.booleans())
def test_boxes_do_not_overlap(graph: tuple[list[LayoutBox], Links], down: bool) -> None:
    """Give every box room of its own, inside the drawing."""
    boxes, links = graph
    layout = layered(boxes, links, down=down)
    frames = list(_frames(boxes, layout).values())
    assert len(frames) == len(boxes)
    assert not overlapping(frames)
    assert all(frame.x >= -0.01 and frame.y >= -0.01 for frame in frames)
    assert max(frame.x + frame.width for frame in frames) <= layout.width + 0.01
    assert max(frame.y + frame.height for frame in frames) <= layout.height + 0.01


@settings(max_examples=30)
@given(graphs(), some.booleans())
def test_lines_cross_no_box(graph: tuple[list[LayoutBox], Links], down: bool) -> None:
    """Lead lines around the boxes, from the edge of one to the edge of the other."""
    boxes, links = graph
    layout = layered(boxes, links, down=down)
    frames = _frames(boxes, layout)
    assert len(layout.routes) == len(links)
    for route in layout.routes:
        points = list(along(route.path))
        assert not [1 for f in frames.values() for point in points if f.holds(*point)]


@settings(max_examples=20)
@given(graphs())
def test_lines_begin_and_end_at_their_boxes(graph: tuple[list[LayoutBox], Links]) -> None:
    """Join the two boxes of a link; the arrow points at the second one."""
    boxes, links = graph
    layout = layered(boxes, links)
    frames = _frames(boxes, layout)
    for (start, end), route in zip(links, layout.routes, strict=True):
        points = list(along(route.path))
        assert _touches(frames[start], points[0])
        assert _touches(frames[end], points[-1])
        assert route.tip == pytest.approx(points[-1], abs=0.06)


def _touches(frame: Frame, point: tuple[float, float]) -> bool:
    x, y = point
    level = frame.y - 0.1 <= y <= frame.y + frame.height + 0.1
    return level and min(abs(x - frame.x), abs(x - frame.x - frame.width)) < 0.1


@settings(max_examples=20)
@given(graphs())
def test_same_graph_same_layout(graph: tuple[list[LayoutBox], Links]) -> None:
    """Draw the same thing the same way."""
    assert layered(*graph) == layered(*graph)


def test_one_link_of_a_circle_is_broken() -> None:
    """Mark the link that leads back, and keep the others in order."""
    boxes = [LayoutBox(name, 40, 40) for name in "abc"]
    layout = layered(boxes, [("a", "b"), ("b", "c"), ("c", "a")])
    assert [route.broken for route in layout.routes] == [False, False, True]
    assert [layout.corners[name][0] for name in "abc"] == sorted(
        layout.corners[name][0] for name in "abc"
    )
    assert layout.routes[2].turn == 180


def test_top_down_ranks_lie_below_each_other() -> None:
    """Go down instead of right."""
    boxes = [LayoutBox(name, 80, 40) for name in "ab"]
    layout = layered(boxes, [("a", "b")], down=True)
    assert layout.corners == {"a": (0, 0), "b": (0, 104)}
    assert layout.routes[0].turn == 90


def test_unlinked_boxes_stand_below() -> None:
    """Boxes without links are in rows below all others."""
    boxes = [LayoutBox(name, 300, 40) for name in "abcdef"]
    layout = layered(boxes, [("a", "b")])
    assert [layout.corners[name][1] for name in "cdef"] == [72, 72, 128, 128]


def test_last_boxes_stand_in_the_last_rank() -> None:
    """Put symptoms on the right, however short the way to them is."""
    boxes = [LayoutBox(name, 40, 40) for name in "abcdx"]
    links = [("a", "b"), ("b", "c"), ("a", "d")]
    layout = layered(boxes, links, last=["d", "x", "c"])
    right = max(x for x, _ in layout.corners.values())
    assert [layout.corners[name][0] for name in "cdx"] == [right] * 3


def test_unknown_box_is_an_error() -> None:
    """Refuse a link to nowhere."""
    with pytest.raises(KeyError):
        layered([LayoutBox("a", 1, 1)], [("a", "b")])


def test_nothing_is_drawn_of_nothing() -> None:
    """Lay out no boxes."""
    assert layered([], []) == GraphLayout(0, 0, {}, ())


def test_ranks_follow_the_longest_path() -> None:
    """A box is after all boxes that lead there; a source is close to its target."""
    assert ranks(5, [(0, 1), (1, 2), (0, 2), (2, 3), (4, 3)]) == [0, 1, 2, 3, 2]


@given(some.lists(some.tuples(some.integers(0, 9), some.integers(0, 9)), max_size=30))
def test_without_its_broken_links_a_graph_has_ranks(links: list[tuple[int, int]]) -> None:
    """Break enough links that every other one leads to a later rank."""
    broken = backward(10, links)
    kept = [link for place, link in enumerate(links) if place not in broken]
    turned = [(end, start) for start, end in (links[place] for place in broken) if start != end]
    found = ranks(10, kept)
    assert all(found[start] < found[end] for start, end in kept)
    found = ranks(10, list(dict.fromkeys(kept + turned)))
    assert all(found[start] < found[end] for start, end in kept + turned)


def test_crossings_are_removed() -> None:
    """Put two ranks in order so that nothing crosses."""
    below: list[list[int]] = [[5], [4], [3], [], [], []]
    above: list[list[int]] = [[], [], [], [2], [1], [0]]
    rows = [[0, 1, 2], [3, 4, 5]]
    assert crossings(rows, below, 6) == 3
    assert crossings(ordered(rows, above, below), below, 6) == 0


@given(some.lists(some.tuples(some.floats(-50, 50), some.floats(0.1, 9)), max_size=20))
def test_rising_is_the_nearest_in_order(pairs: list[tuple[float, float]]) -> None:
    """Rise, keep the weighted mean, and leave alone what rises already."""
    wishes, weights = [wish for wish, _ in pairs], [weight for _, weight in pairs]
    found = rising(wishes, weights)
    assert found == sorted(found)
    before = sum(wish * weight for wish, weight in pairs)
    after = sum(place * weight for place, weight in zip(found, weights, strict=True))
    assert after == pytest.approx(before, abs=1e-6)
    assert rising(sorted(wishes), weights) == sorted(wishes)
