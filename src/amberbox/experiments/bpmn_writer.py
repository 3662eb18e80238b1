"""BPMN files written from a model: one process with its pool, lanes, steps and diagram."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from xml.sax.saxutils import escape, quoteattr

from amberbox.core.svg import number
from amberbox.experiments.bpmn import (
    FLOW_NODES,
    MODEL,
    Bounds,
    BpmnModel,
    Diagram,
    Edge,
    Element,
    Flow,
    Shape,
)
from amberbox.experiments.experiment import NAMESPACE

_NAMESPACES = {
    "xmlns": MODEL,
    "xmlns:bpmndi": "http://www.omg.org/spec/BPMN/20100524/DI",
    "xmlns:dc": "http://www.omg.org/spec/DD/20100524/DC",
    "xmlns:di": "http://www.omg.org/spec/DD/20100524/DI",
    "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
    "xmlns:amberbox": NAMESPACE,
}


def bpmn_text(model: BpmnModel) -> str:
    """Return the model as a BPMN 2.0 file.

    Written are pools, lanes, events with timers and errors, user, manual and service tasks, call
    activities, gateways, sub-processes, annotations, flows, declarations and diagrams.
    """
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', *_definitions(model), ""])


def _definitions(model: BpmnModel) -> Iterator[str]:
    yield f"<definitions{_attributes(_NAMESPACES)}\n    targetNamespace={quoteattr(NAMESPACE)}>"
    pools = model.of_type("participant")
    if pools:
        yield '  <collaboration id="collaboration">'
        for pool in pools:
            yield _tag("participant", 4, id=pool.id, name=pool.name, processRef=pool.process)
        yield "  </collaboration>"
    for code in _codes(model):
        yield _tag("error", 2, id=f"error_{code}", name=code, errorCode=code)
    for process in model.of_type("process"):
        executable = "false" if process.executable is False else "true"
        about = {"id": process.id, "name": process.name, "isExecutable": executable}
        yield f"  <process{_attributes(about)}>"
        yield from _inside(model, process, 4)
        yield "  </process>"
    for place, diagram in enumerate(model.diagrams):
        yield from _diagram(diagram, place, "collaboration" if pools else "")
    yield "</definitions>"


def _codes(model: BpmnModel) -> list[str]:
    codes = [d.code for e in model.elements.values() for d in e.events if d.kind == "error"]
    return list(dict.fromkeys(filter(None, codes)))


def _inside(model: BpmnModel, scope: Element, indent: int) -> Iterator[str]:
    yield from _extension(scope, indent)
    yield from _lanes(model, scope, indent)
    children = model.children(scope.id)
    blank = " " * indent
    for child in children:
        if child.type in FLOW_NODES:
            yield from _node(model, child, indent)
    flows = [flow for flow in model.flows.values() if flow.parent == scope.id]
    for flow in flows:
        if flow.type == "sequenceFlow":
            yield from _flow(flow, indent)
    for child in children:
        if child.type == "textAnnotation":
            yield f"{blank}<textAnnotation id={quoteattr(child.id)}>"
            yield f"{blank}  <text>{escape(child.text)}</text>\n{blank}</textAnnotation>"
    for flow in flows:
        if flow.type == "association":
            ends = {"sourceRef": flow.source, "targetRef": flow.target}
            yield _tag("association", indent, id=flow.id, **ends)


def _lanes(model: BpmnModel, scope: Element, indent: int) -> Iterator[str]:
    lanes = [e for e in model.children(scope.id) if e.type == "lane"]
    if not lanes:
        return
    blank = " " * indent
    yield f'{blank}<laneSet id="lanes_{scope.id}">'
    for lane in lanes:
        yield f"{blank}  <lane{_attributes({'id': lane.id, 'name': lane.name})}>"
        for node in model.elements.values():
            if node.lane == lane.id:
                yield f"{blank}    <flowNodeRef>{node.id}</flowNodeRef>"
        yield f"{blank}  </lane>"
    yield f"{blank}</laneSet>"


def _node(model: BpmnModel, node: Element, indent: int) -> Iterator[str]:
    blank = " " * indent
    about = {
        "id": node.id, "name": node.name, "attachedToRef": node.attached_to,
        "cancelActivity": "" if node.interrupting else "false", "default": node.default,
        "calledElement": node.called,
    }  # fmt: skip
    yield f"{blank}<{node.type}{_attributes(about)}>"
    if node.documentation:
        yield f"{blank}  <documentation>{escape(node.documentation)}</documentation>"
    yield from _inside(model, node, indent + 2)
    for event in node.events:
        if event.kind == "timer":
            yield f"{blank}  <timerEventDefinition>"
            duration = f'<timeDuration xsi:type="tFormalExpression">{escape(event.text)}'
            yield f"{blank}    {duration}</timeDuration>\n{blank}  </timerEventDefinition>"
        else:
            ref = f"error_{event.code}" if event.kind == "error" and event.code else ""
            yield _tag(f"{event.kind}EventDefinition", indent + 2, errorRef=ref)
    yield f"{blank}</{node.type}>"


def _extension(element: Element, indent: int) -> Iterator[str]:
    if element.extension is None:
        return
    blank = " " * indent
    word = "experiment" if element.type == "process" else "step"
    yield f"{blank}<extensionElements>\n{blank}  <amberbox:{word}>"
    for line in element.extension.yaml.strip("\n").splitlines():
        yield f"{blank}    {escape(line)}".rstrip()
    yield f"{blank}  </amberbox:{word}>\n{blank}</extensionElements>"


def _flow(flow: Flow, indent: int) -> Iterator[str]:
    about = {"id": flow.id, "name": flow.name, "sourceRef": flow.source, "targetRef": flow.target}
    if not flow.condition:
        yield _tag("sequenceFlow", indent, **about)
        return
    blank = " " * indent
    yield f"{blank}<sequenceFlow{_attributes(about)}>"
    start = '<conditionExpression xsi:type="tFormalExpression">'
    yield f"{blank}  {start}{escape(flow.condition)}</conditionExpression>"
    yield f"{blank}</sequenceFlow>"


def _diagram(diagram: Diagram, place: int, plane: str) -> Iterator[str]:
    number_text = "" if not place else f"_{place}"
    shown = diagram.element or plane
    yield f'  <bpmndi:BPMNDiagram id="diagram{number_text}">'
    about = {"id": f"plane{number_text}", "bpmnElement": shown}
    yield f"    <bpmndi:BPMNPlane{_attributes(about)}>"
    for shape in diagram.shapes:
        yield from _shape(shape)
    for edge in diagram.edges:
        yield from _edge(edge)
    yield "    </bpmndi:BPMNPlane>\n  </bpmndi:BPMNDiagram>"


def _shape(shape: Shape) -> Iterator[str]:
    about = {
        "id": f"{shape.element}_di", "bpmnElement": shape.element,
        "isHorizontal": _flag(shape.horizontal), "isExpanded": _flag(shape.expanded),
        "isMarkerVisible": _flag(shape.marker),
    }  # fmt: skip
    yield f"      <bpmndi:BPMNShape{_attributes(about)}>"
    yield f"        {_bounds(shape.bounds)}"
    yield from _label(shape.label)
    yield "      </bpmndi:BPMNShape>"


def _edge(edge: Edge) -> Iterator[str]:
    about = {"id": f"{edge.element}_di", "bpmnElement": edge.element}
    yield f"      <bpmndi:BPMNEdge{_attributes(about)}>"
    for x, y in edge.points:
        yield f'        <di:waypoint x="{number(x)}" y="{number(y)}"/>'
    yield from _label(edge.label)
    yield "      </bpmndi:BPMNEdge>"


def _label(label: Bounds | None) -> Iterator[str]:
    if label is not None:
        yield f"        <bpmndi:BPMNLabel>{_bounds(label)}</bpmndi:BPMNLabel>"


def _bounds(box: Bounds) -> str:
    values = zip(("x", "y", "width", "height"), (box.x, box.y, box.width, box.height), strict=True)
    return f"<dc:Bounds{_attributes({key: number(value) for key, value in values})}/>"


def _flag(value: bool | None) -> str:
    return "" if value is None else str(value).lower()


def _tag(tag: str, indent: int, **attributes: str) -> str:
    return f"{' ' * indent}<{tag}{_attributes(attributes)}/>"


def _attributes(values: Mapping[str, str]) -> str:
    return "".join(f" {name}={quoteattr(value)}" for name, value in values.items() if value)
