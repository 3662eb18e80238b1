"""The graph: well-formed, nothing overlaps or is cut, readable in light and dark."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations, pairwise

import pytest

from amberbox.core.svg import SIZE, SMALL, width
from amberbox.diagnosis.fmea.loader import load_fmea, read_fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.report.causal_graph import CAUSES, SYMPTOMS
from amberbox.diagnosis.report.explain import explain
from amberbox.diagnosis.report.explanation import CausalGraph, Explanation, GraphEdge, GraphNode
from amberbox.diagnosis.report.svg import DARK, LIGHT, Box, Drawing, Line, as_svg, layout
from tests.diagnosis.report.page import FOLDER
from tests.diagnosis.report.robot import (
    BLIND,
    ENCODER,
    ODD,
    SCANS,
    STOPPED,
    WINDOW,
    diagnosis,
    explained,
    knowledge,
    symptoms,
)

SETS = (ENCODER, WINDOW, STOPPED, BLIND, SCANS, ODD)
SVG = "{http://www.w3.org/2000/svg}"
NASTY = 'a<b> & "c" \x00\x1b\ud800 ]]> </svg><script>alert(1)</script> ' + "W" * 90 + " 電池" * 9


@pytest.mark.parametrize("present", SETS)
def test_it_is_well_formed_and_needs_nothing_from_outside(present: tuple[str, ...]) -> None:
    text = as_svg(explained(*present))
    root = ElementTree.fromstring(text)
    assert root.tag == f"{SVG}svg" and root.get("role") == "img"
    title, desc = root.find(f"{SVG}title"), root.find(f"{SVG}desc")
    assert title is not None and title.text == explained(*present).headline
    assert desc is not None and desc.text
    outside = re.findall(r"https?://[^\"']+|url\(|@import|href|<script|@font-face", text)
    assert outside == ["http://www.w3.org/2000/svg"]


@pytest.mark.parametrize("present", SETS)
def test_nothing_overlaps_or_is_cut(present: tuple[str, ...]) -> None:
    check_geometry(layout(explained(*present)))


def test_nothing_overlaps_with_every_failure_mode_of_the_simulated_robot() -> None:
    fmea, _ = load_fmea(FOLDER / "fmea.yaml")
    assert fmea is not None
    of = Knowledge("ropod_001", fmea)
    modes = [mode for mode in fmea.modes.values() if len(mode.symptoms) > 1][::6]
    for mode in modes:
        seen = symptoms(of, [link.symptom for link in mode.symptoms])
        check_geometry(layout(explain(diagnosis(of, seen), of, seen)))
    assert len(modes) > 5


def test_anything_may_be_written() -> None:
    told = explained(*STOPPED)
    graph = replace(told.graph, nodes=tuple(replace(n, text=NASTY) for n in told.graph.nodes))
    nasty = replace(told, headline=NASTY, robot=NASTY, graph=graph)
    root = ElementTree.fromstring(as_svg(nasty))
    assert not list(root.iter(f"{SVG}script"))
    assert any("<script>" in (text.text or "") for text in root.iter(f"{SVG}text"))
    check_geometry(layout(nasty))


def test_too_much_is_counted_instead_of_layout() -> None:
    told = many(causes=20, seen=40)
    kinds = [node.kind for node in told.graph.nodes]
    assert (kinds.count("cause"), kinds.count("symptom")) == (CAUSES, SYMPTOMS)
    assert told.graph.more_symptoms == 40 - SYMPTOMS and told.graph.more_causes > 0
    texts = [line.text for line in layout(told).lines]
    assert f"and {40 - SYMPTOMS} more" in texts and f"and {told.graph.more_causes} more" in texts
    check_geometry(layout(told))


def test_what_is_seen_stands_in_order_of_time() -> None:
    nodes = [n.id for n in explained(*reversed(STOPPED)).graph.nodes if n.kind == "symptom"]
    assert nodes == [f"symptom:{name}" for name in reversed(STOPPED)]


def test_what_is_lost_stands_between() -> None:
    graph = explained(*STOPPED).graph
    pairs = {(edge.start, edge.end) for edge in graph.edges if edge.leading}
    for pair in (
        ("cause:safety#pressed", "lost:safety"),
        ("lost:safety", "lost:power_drives"),
        ("lost:power_drives", "symptom:wheel_left/power/on"),
    ):
        assert pair in pairs
    boxes = {
        n.id: box for n, box in zip(graph.nodes, layout(explained(*STOPPED)).boxes, strict=True)
    }
    way = (
        "cause:safety#pressed",
        "lost:safety",
        "lost:power_drives",
        "symptom:wheel_left/power/on",
    )
    assert [boxes[name].x for name in way] == sorted({boxes[name].x for name in way})


def test_marks_and_bars() -> None:
    told = explained(*ENCODER, *SCANS)
    marks = {node.id: node.mark for node in told.graph.nodes}
    assert marks["cause:wheel_left#encoder_stuck"] == "leading"
    assert marks[f"symptom:{ENCODER[0]}"] == "present"
    assert marks[f"symptom:{SCANS[0]}"] == "unexplained"
    assert marks["symptom:wheel_left.pulls_harder"] == "contradicted"
    missing = [edge.end for edge in told.graph.edges if edge.missing]
    assert missing == ["symptom:wheel_left.pulls_harder"]
    root = ElementTree.fromstring(as_svg(told))
    (share,) = (r for r in root.iter(f"{SVG}rect") if r.get("class") == "share")
    (bar,) = (r for r in root.iter(f"{SVG}rect") if r.get("class") == "bar")
    (cause,) = (node for node in told.graph.nodes if node.kind == "cause")
    filled = float(share.get("width", "0")) / float(bar.get("width", "1"))
    assert filled == pytest.approx(cause.probability, abs=1e-3)


def test_an_empty_graph_is_a_headline() -> None:
    told = replace(explained(*SCANS), graph=CausalGraph((), ()))
    check_geometry(layout(told))
    assert "false alarm" in as_svg(told)


def test_several_ways_through_the_columns() -> None:
    names = [f"lost:{n}" for n in range(4)]
    nodes = (
        *(GraphNode(f"cause:{n}", "cause", "a cause", f"c#{n}", "", 0.2) for n in range(3)),
        *(GraphNode(name, "lost", "something", name) for name in names),
        *(GraphNode(f"symptom:{n}", "symptom", "a symptom", f"s{n}", "present") for n in range(5)),
    )
    chain = [GraphEdge(start, end) for start, end in pairwise(names)]
    starts = [GraphEdge(f"cause:{n}", names[n]) for n in range(3)]
    ends = [GraphEdge(start, f"symptom:{n}") for start in (*names, "cause:1") for n in range(5)]
    graph = CausalGraph(nodes, (*starts, *ends, *reversed(chain)))
    check_geometry(layout(replace(explained(*SCANS), graph=graph)))


@pytest.mark.parametrize("dark", [False, True])
def test_all_text_has_contrast(dark: bool) -> None:
    of = colours(dark)
    text, faint = of["text"]["fill"], of[".small"]["fill"]
    fills = [
        of[k]["fill"]
        for k in (".ground", ".box", ".leading", ".unexplained", ".contradicted", ".lost")
    ]
    for ground in fills:
        assert contrast(text, ground) >= 7
        assert contrast(faint, ground) >= 4.5
    for kind in (".box", ".leading", ".unexplained", ".lost", ".contradicted", ".edge", ".strong"):
        assert contrast(of[kind]["stroke"], of[".ground"]["fill"]) >= 3
    assert contrast(of[".share"]["fill"], of[".bar"]["fill"]) >= 2.5


def check_geometry(drawing: Drawing) -> None:
    """Assert that boxes, texts and lines keep clear of each other, and all is in the image."""
    for box in drawing.boxes:
        assert box.x >= 0 and box.y >= 0
        assert box.x + box.width <= drawing.width and box.y + box.height <= drawing.height
    for one, other in combinations(map(edges_of, drawing.boxes), 2):
        assert not overlap(one, other)
    texts = [(line, room(line)) for line in drawing.lines]
    for line, (left, top, right, bottom) in texts:
        assert left >= 0 and top >= 0 and right <= drawing.width and bottom <= drawing.height
        holding = [box for box in drawing.boxes if overlap(edges_of(box), room(line))]
        assert len(holding) <= 1
        for box in holding:
            assert box.x <= left and right <= box.x + box.width
            low = box.y + box.height - (0 if box.share is None else 12)
            assert box.y <= top and bottom <= low
    for (_, upper), (_, lower) in combinations(texts, 2):
        assert not overlap(upper, lower)
    for stroke in drawing.strokes:
        for point in points(stroke.path):
            assert not any(inside(point, edges_of(box)) for box in drawing.boxes)
            assert 0 <= point[0] <= drawing.width and 0 <= point[1] <= drawing.height


Rectangle = tuple[float, float, float, float]


def edges_of(box: Box) -> Rectangle:
    return (box.x, box.y, box.x + box.width, box.y + box.height)


def room(line: Line) -> Rectangle:
    size = SMALL if line.kind == "small" else SIZE
    right = line.x + width(line.text, size, bold=line.kind == "title")
    return (line.x, line.y - 0.8 * size, right, line.y + 0.2 * size)


def overlap(one: Rectangle, other: Rectangle) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def inside(point: tuple[float, float], of: Rectangle) -> bool:
    return of[0] + 0.1 < point[0] < of[2] - 0.1 and of[1] < point[1] < of[3]


def points(path: str) -> Iterator[tuple[float, float]]:
    numbers = [float(number) for number in re.findall(r"-?[\d.]+", path)]
    if "C" not in path:
        x, y, wide = numbers
        yield from ((x + wide * share / 20, y) for share in range(21))
        return
    places = [(numbers[n], numbers[n + 1]) for n in range(0, 8, 2)]
    for step in range(41):
        u = step / 40
        weights = ((1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u * u * (1 - u), u**3)
        yield (
            sum(w * x for w, (x, _) in zip(weights, places, strict=True)),
            sum(w * y for w, (_, y) in zip(weights, places, strict=True)),
        )


def colours(dark: bool) -> Mapping[str, dict[str, str]]:
    of: dict[str, dict[str, str]] = {}
    for names, body in (*LIGHT, *(DARK if dark else ())):
        for name in names.split(","):
            of.setdefault(name, {}).update(part.split(":", 1) for part in body.split(";"))
    return of


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours as WCAG 2 defines it."""
    lighter, darker = sorted((luminance(one), luminance(other)), reverse=True)
    return (lighter + 0.05) / (darker + 0.05)


def luminance(colour: str) -> float:
    parts = [int(colour[n : n + 2], 16) / 255 for n in (1, 3, 5)]
    red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def many(causes: int, seen: int) -> Explanation:
    """Return the explanation of many symptoms that any of many failure modes shows."""
    shows = ", ".join(f"part/output/o{n}" for n in range(seen))
    modes = "".join(
        f"      m{n}: {{probability: 0.01, symptoms: [{shows}]}}\n" for n in range(causes)
    )
    fmea, problems = read_fmea(f"types:\n  part:\n    failure_modes:\n{modes}")
    assert fmea is not None, problems
    of = Knowledge("ropod_001", fmea)
    present = symptoms(of, sorted(fmea.symptoms))
    return explain(diagnosis(of, present), of, present)


def test_the_same_is_drawn_again() -> None:
    seen = symptoms(knowledge(), STOPPED)
    one, other = (explain(diagnosis(knowledge(), s), knowledge(), s) for s in (seen, seen[::-1]))
    assert as_svg(one) == as_svg(other)
