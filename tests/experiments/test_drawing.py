"""Drawings of BPMN diagrams: complete, valid, the same each time, and safe."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import pytest

import amberbox.sim
from amberbox.core.errors import Problem
from amberbox.core.svg import SvgElement
from amberbox.experiments.bpmn import FLOW_NODES, Bounds, BpmnModel, parse_bpmn, read_bpmn
from amberbox.experiments.diagram_layout import laid_out
from amberbox.experiments.drawing import draw_bpmn
from tests.experiments.bpmn_files import EVENTS, every_shape, line

SAMPLES = sorted((Path(amberbox.sim.__file__).parent / "folder" / "experiments").glob("*.bpmn"))


def model_of(text: str) -> BpmnModel:
    """Return the model of a text."""
    problems: list[Problem] = []
    model = parse_bpmn(text.encode(), "a.bpmn", problems)
    assert model is not None, problems
    return model


def drawn(drawing: SvgElement, own: str) -> SvgElement:
    """Return the group of an element."""
    return next(part for part in drawing.all() if part.get("data-bpmn-id") == own)


def classes(part: SvgElement) -> set[str]:
    """Return the classes of a part and of all in it."""
    return {word for inner in part.all() for word in inner.get("class").split()}


def assert_complete(model: BpmnModel, drawing: SvgElement) -> None:
    """Check that every shape and edge of the layout is drawn, with a title, as valid XML."""
    groups = [part for part in drawing.all() if part.get("data-bpmn-id")]
    expected = [s.element for d in model.diagrams for s in d.shapes]
    expected += [e.element for d in model.diagrams for e in d.edges]
    assert sorted(part.get("data-bpmn-id") for part in groups) == sorted(expected)
    for part in groups:
        first, *figure = part.children
        assert isinstance(first, SvgElement)
        assert first.tag == "title"
        assert figure, part.get("data-bpmn-id")
    ElementTree.fromstring(str(drawing))


def test_every_shape_is_drawn() -> None:
    model = model_of(every_shape())
    drawing = draw_bpmn(model)
    assert_complete(model, drawing)
    assert str(drawing) == str(draw_bpmn(model_of(every_shape())))


def test_markers_differ() -> None:
    """Each trigger, task, gateway and loop looks different from all others of its kind."""
    model = model_of(every_shape())
    drawing = draw_bpmn(model)
    looks: dict[str, set[str]] = {}
    shown = {shape.element for diagram in model.diagrams for shape in diagram.shapes}
    for element in model.elements.values():
        if element.type not in FLOW_NODES or element.id not in shown:
            continue
        group = drawn(drawing, element.id)
        marks = [str(part) for part in group.all() if part.get("class") == "marker"]
        look = re.sub(r"translate\([^)]*\)|scale\([^)]*\)", "", "".join(marks))
        kind = "event" if element.type in EVENTS else element.type
        trigger = element.events[0].kind if len(element.events) == 1 else len(element.events)
        about = f"{kind} {trigger} {element.loop} {element.type[-10:]} {element.interrupting}"
        looks.setdefault(look, set()).add(about)
    bare = looks.pop("")
    assert any("startEvent" in about for about in bare)
    for look, users in looks.items():
        triggers = {about.split()[1] for about in users if about.startswith("event")}
        assert len(triggers) <= 1, (look, users)


def test_ends_of_events_are_thick_and_what_does_not_interrupt_is_dashed() -> None:
    model = model_of(every_shape())
    drawing = draw_bpmn(model)
    for element in model.elements.values():
        if element.type not in EVENTS:
            continue
        rings = [p for p in drawn(drawing, element.id).all() if p.tag == "circle"]
        outer = rings[0]
        assert (float(outer.get("stroke-width")) > 3) == (element.type == "endEvent")
        assert bool(outer.get("stroke-dasharray")) == (not element.interrupting)
        body = [p for p in rings if "body" in p.get("class") or p.get("class") == "line"]
        assert (len(body) == 2) == (element.type not in ("startEvent", "endEvent"))


def test_states_are_classes() -> None:
    problems: list[Problem] = []
    model = read_bpmn(SAMPLES[-1], problems)
    assert model is not None
    drawing = draw_bpmn(model, {"drive": "current", "confirm_path": "done", "safe": "failed"})
    assert "is-current" in drawn(drawing, "drive").get("class").split()
    assert "is-done" in drawn(drawing, "confirm_path").get("class").split()
    assert "(done)</title>" in str(drawn(drawing, "confirm_path"))  # not by colour alone
    assert "is-failed" in drawn(drawing, "safe").get("class").split()
    assert not classes(drawn(drawing, "end")) & {"is-current", "is-done", "is-failed"}
    assert "<style>" in str(drawing)
    assert "<style>" not in str(draw_bpmn(model, standalone=False))


def test_hostile_texts_are_only_text() -> None:
    name = "&lt;/text&gt;&lt;script&gt;alert(1)&lt;/script&gt;&#x202e;"
    text = line(f"<userTask id='a' name='{name}'/>")
    drawing = str(draw_bpmn(model_of(text)))
    assert "<script" not in drawing
    assert "\\u202e" in drawing
    assert "\u202e" not in drawing
    ElementTree.fromstring(drawing)


def test_a_long_name_stays_in_its_box() -> None:
    text = line(f"<userTask id='a' name='{'very long words ' * 40}'/>")
    part = drawn(draw_bpmn(model_of(text)), "a")
    box = next(p for p in part.all() if "body" in p.get("class"))
    lines = [float(p.get("y")) for p in part.all() if p.tag == "text"]
    top, high = float(box.get("y")), float(box.get("height"))
    assert len(lines) > 2
    assert top < min(lines)
    assert max(lines) < top + high


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_a_file_without_layout_gets_one(path: Path) -> None:
    """All nodes and flows are placed; no two nodes overlap, and no flow is slanted."""
    problems: list[Problem] = []
    model = read_bpmn(path, problems)
    assert model is not None
    diagram = laid_out(model)
    nodes = {e.id for e in model.elements.values() if e.type in FLOW_NODES}
    assert nodes <= {shape.element for shape in diagram.shapes}
    assert {edge.element for edge in diagram.edges} == set(model.flows)
    boxes = [
        shape.bounds for shape in diagram.shapes
        if model.elements[shape.element].type in FLOW_NODES - {"boundaryEvent"}
    ]  # fmt: skip
    assert not [pair for pair in combinations(boxes, 2) if _overlap(*pair)]
    for edge in diagram.edges:
        for (x, y), (to_x, to_y) in zip(edge.points, edge.points[1:], strict=False):
            assert abs(x - to_x) < 0.01 or abs(y - to_y) < 0.01
    bare = replace(model, diagrams=())
    assert_complete(replace(model, diagrams=(diagram,)), draw_bpmn(bare))


def _overlap(one: Bounds, other: Bounds) -> bool:
    apart_x = one.x + one.width <= other.x or other.x + other.width <= one.x
    return not (apart_x or one.y + one.height <= other.y or other.y + other.height <= one.y)


@pytest.mark.needs_data
def test_public_models_are_drawn(shared_data: Path) -> None:
    for path in sorted((shared_data / "bpmn").glob("*.bpmn")):
        problems: list[Problem] = []
        model = read_bpmn(path, problems)
        assert model is not None, problems
        assert problems == []
        assert_complete(model, draw_bpmn(model))
        assert str(draw_bpmn(replace(model, diagrams=()))).startswith("<svg")
