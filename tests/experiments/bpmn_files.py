"""BPMN files made for tests: one with every shape, and small processes to be judged."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<definitions xmlns="http://www.omg.org/spec/BPMN/20100524/MODEL"
  xmlns:bpmndi="http://www.omg.org/spec/BPMN/20100524/DI"
  xmlns:dc="http://www.omg.org/spec/DD/20100524/DC"
  xmlns:di="http://www.omg.org/spec/DD/20100524/DI"
  xmlns:bioc="http://bpmn.io/schema/bpmn/biocolor/1.0"
  xmlns:amberbox="urn:amberbox:experiment:1" id="defs" targetNamespace="urn:test">
"""

TRIGGERS = ("message", "timer", "error", "signal", "escalation", "cancel", "compensate",
            "conditional", "link", "terminate")  # fmt: skip
EVENTS: Mapping[str, tuple[str, ...]] = {
    "startEvent": ("message", "timer", "conditional", "signal"),
    "intermediateCatchEvent": ("message", "timer", "conditional", "link", "signal"),
    "intermediateThrowEvent": ("message", "escalation", "link", "compensate", "signal"),
    "endEvent": ("message", "error", "escalation", "cancel", "compensate", "signal", "terminate"),
    "boundaryEvent": ("message", "timer", "error", "escalation", "cancel", "compensate",
                      "conditional", "signal"),
}  # fmt: skip
TASKS = ("task", "userTask", "manualTask", "serviceTask", "sendTask", "receiveTask", "scriptTask",
         "businessRuleTask", "callActivity")  # fmt: skip
GATEWAYS = ("exclusiveGateway", "parallelGateway", "inclusiveGateway", "complexGateway",
            "eventBasedGateway")  # fmt: skip


class Sheet:
    """Collects elements in rows, with their shapes."""

    def __init__(self) -> None:
        self.elements: list[str] = []
        self.shapes: list[str] = []
        self.x, self.y, self.count = 40.0, 40.0, 0

    def row(self, height: float) -> None:
        """Begin a row below the last one, which had this height."""
        self.x, self.y = 40.0, self.y + height

    def add(
        self, tag: str, size: tuple[float, float], inside: str = "", more: str = "",
        look: str = "", name: str = "",
    ) -> str:  # fmt: skip
        """Add an element at the next place of the row; return its id."""
        self.count += 1
        own = f"{tag}_{self.count}"
        label = name or tag
        self.elements.append(f'<{tag} id="{own}" name="{label}" {more}>{inside}</{tag}>')
        self.shape(own, (self.x, self.y, *size), look)
        self.x += max(size[0], 60) + 50
        return own

    def shape(self, own: str, bounds: tuple[float, float, float, float], look: str = "") -> None:
        """Add the shape of an element."""
        x, y, wide, high = bounds
        self.shapes.append(
            f'<bpmndi:BPMNShape bpmnElement="{own}" {look}>'
            f'<dc:Bounds x="{x}" y="{y}" width="{wide}" height="{high}"/></bpmndi:BPMNShape>'
        )


def every_shape() -> str:
    """Return a file with every shape of BPMN 2.0: a process, a collaboration, choreographies."""
    return "".join([HEAD, *_process(), *_conversation(), *_choreography(), "</definitions>"])


def _definition(kind: str) -> str:
    return f"<{kind}EventDefinition/>"


def _process() -> list[str]:
    sheet = Sheet()
    for tag, kinds in EVENTS.items():
        if tag == "boundaryEvent":
            continue
        sheet.add(tag, (36, 36))
        for kind in kinds:
            sheet.add(tag, (36, 36), _definition(kind), name=kind)
        several = _definition("message") + _definition("signal")
        sheet.add(tag, (36, 36), several, name="multiple")
        if tag in ("startEvent", "intermediateCatchEvent"):
            sheet.add(tag, (36, 36), several, 'parallelMultiple="true"', name="parallel multiple")
        if tag == "startEvent":
            for kind in ("message", "error", "escalation", "compensate"):
                more = 'isInterrupting="false"' if kind != "error" else ""
                sheet.add(tag, (36, 36), _definition(kind), more, name=f"{kind} of sub-process")
        sheet.row(90)
    for interrupting in ("true", "false"):
        for kind in EVENTS["boundaryEvent"]:
            host = sheet.add("userTask", (110, 70), name=f"watched by {kind}")
            x, y = sheet.x - 100, sheet.y + 52
            sheet.count += 1
            own = f"boundary_{sheet.count}"
            sheet.elements.append(
                f'<boundaryEvent id="{own}" name="{kind}" attachedToRef="{host}" '
                f'cancelActivity="{interrupting}">{_definition(kind)}</boundaryEvent>'
            )
            sheet.shape(own, (x, y, 36, 36))
        sheet.row(140)
    for tag in TASKS:
        sheet.add(tag, (120, 80))
    sheet.add("receiveTask", (120, 80), more='instantiate="true"', name="instantiating")
    sheet.row(120)
    _activities(sheet)
    flows, edges = _others(sheet)
    return [
        '<message id="letter" name="letter"/><globalUserTask id="global_user" name="g"/>'
        '<category><categoryValue id="value" value="group of things"/></category>'
        '<process id="shapes" isExecutable="true">',
        *sheet.elements, *flows, "</process>",
        '<bpmndi:BPMNDiagram name="Process"><bpmndi:BPMNPlane bpmnElement="shapes">',
        *sheet.shapes, *edges, "</bpmndi:BPMNPlane></bpmndi:BPMNDiagram>",
    ]  # fmt: skip


def _activities(sheet: Sheet) -> None:
    loops = {
        "standard loop": "<standardLoopCharacteristics/>",
        "parallel": "<multiInstanceLoopCharacteristics/>",
        "sequential": '<multiInstanceLoopCharacteristics isSequential="true"/>',
    }
    for name, inside in loops.items():
        sheet.add("task", (120, 80), inside, name=name)
    sheet.add("task", (120, 80), loops["parallel"], 'isForCompensation="true"', name="compensation")
    endless = "Any task with a name that is much too long to fit into its box, however small its"
    sheet.add("task", (120, 80), name=f"{endless} letters are, and goes on and on and on and on")
    colours = 'bioc:fill="#ffe0b2" bioc:stroke="#e65100"'
    sheet.add("userTask", (120, 80), look=colours, name="colour")
    sheet.add("callActivity", (120, 80), more='calledElement="global_user"', name="global task")
    sheet.row(120)
    for tag in ("subProcess", "transaction", "adHocSubProcess"):
        sheet.add(tag, (120, 80), loops["sequential"] if tag == "adHocSubProcess" else "",
                  name=f"{tag} collapsed")  # fmt: skip
    sheet.add("subProcess", (120, 80), more='triggeredByEvent="true"', name="event sub-process")
    for tag in ("subProcess", "transaction", "adHocSubProcess"):
        x, y = sheet.x, sheet.y
        inner = f"inner_{tag}"
        sheet.add(tag, (200, 110), f'<task id="{inner}" name="inside"/>', look='isExpanded="true"',
                  name=f"{tag} expanded")  # fmt: skip
        sheet.shape(inner, (x + 50, y + 35, 90, 50))
    sheet.row(150)


def _others(sheet: Sheet) -> tuple[list[str], list[str]]:
    """Add gateways, data and artifacts; return the flows and their edges."""
    for tag in GATEWAYS:
        sheet.add(tag, (50, 50), look='isMarkerVisible="true"')
        sheet.x += 40
    sheet.add("exclusiveGateway", (50, 50), name="no marker")
    sheet.x += 40
    sheet.add("eventBasedGateway", (50, 50), more='instantiate="true"', name="instantiates")
    sheet.x += 40
    sheet.add("eventBasedGateway", (50, 50), name="instantiates in parallel",
              more='instantiate="true" eventGatewayType="Parallel"')  # fmt: skip
    sheet.row(110)
    sheet.elements.append('<dataObject id="many" isCollection="true"/><dataObject id="one"/>')
    sheet.add("dataObjectReference", (36, 50), '<dataState name="checked"/>', 'dataObjectRef="one"')
    sheet.add("dataObjectReference", (36, 50), more='dataObjectRef="many"', name="collection")
    sheet.elements.append('<ioSpecification><dataInput id="in" name="input"/>'
                          '<dataOutput id="out" name="output" isCollection="true"/>'
                          "</ioSpecification>")  # fmt: skip
    for own in ("in", "out"):
        sheet.shape(own, (sheet.x, sheet.y, 36, 50))
        sheet.x += 110
    store = sheet.add("dataStoreReference", (50, 50), name="store")
    sheet.elements.append('<textAnnotation id="note"><text>An annotation in two lines that '
                          "explains</text></textAnnotation>")  # fmt: skip
    sheet.shape("note", (sheet.x, sheet.y, 130, 44))
    sheet.x += 180
    sheet.elements.append('<group id="group" categoryValueRef="value"/>')
    sheet.shape("group", (sheet.x, sheet.y - 10, 150, 70))
    sheet.row(110)
    return _flows(sheet, store)


def edge(own: str, *points: tuple[float, float]) -> str:
    """Return the edge of a flow."""
    way = "".join(f'<di:waypoint x="{x}" y="{y}"/>' for x, y in points)
    return f'<bpmndi:BPMNEdge bpmnElement="{own}">{way}</bpmndi:BPMNEdge>'


def _flows(sheet: Sheet, store: str) -> tuple[list[str], list[str]]:
    y = sheet.y + 25
    start = sheet.add("task", (100, 50), more='default="by_default"', name="begin")
    ends = [sheet.add("task", (100, 50), name=name) for name in ("plain", "default", "conditional")]
    names = ("plain", "by_default", "conditional")
    conditions = ("", "", "<conditionExpression>x &lt; 1</conditionExpression>")
    flows, edges = [], []
    for place, (own, end, inside) in enumerate(zip(names, ends, conditions, strict=True)):
        flows.append(f'<sequenceFlow id="{own}" name="{own}" sourceRef="{start}" targetRef="{end}">'
                     f"{inside}</sequenceFlow>")  # fmt: skip
        below, x = y + 45 + 20 * place, 60 + 30 * place
        to = 240 + 150 * place
        edges.append(edge(own, (x, y + 25), (x, below), (to, below), (to, y + 25)))
    for place, direction in enumerate(("None", "One", "Both")):
        own = f"association_{place}"
        flows.append(f'<association id="{own}" sourceRef="note" targetRef="{ends[0]}" '
                     f'associationDirection="{direction}"/>')  # fmt: skip
        edges.append(edge(own, (700, y + 20 * place), (900, y + 20 * place)))
    source = f'<dataInputAssociation id="data_in"><sourceRef>{store}</sourceRef>'
    sheet.elements.append(f'<task id="with_data">{source}</dataInputAssociation></task>')
    sheet.shape("with_data", (1000, y - 25, 100, 50))
    edges.append(edge("data_in", (930, y), (1000, y)))
    return flows, edges


def _conversation() -> list[str]:
    sheet = Sheet()
    pools = (
        '<participant id="pool_a" name="Robot and its technician" processRef="inside"/>'
        '<participant id="pool_b" name="Hospital"><participantMultiplicity minimum="2"/>'
        '</participant><participant id="pool_c" name="Upright" processRef="beside"/>'
        '<messageFlow id="call" name="call" sourceRef="pool_a" targetRef="pool_b"/>'
        '<messageFlow id="answer" sourceRef="pool_b" targetRef="pool_a" messageRef="letter"/>'
    )
    for tag in ("conversation", "subConversation", "callConversation"):
        sheet.x += 80
        sheet.y = 420
        sheet.add(tag, (60, 50))
    sheet.shape("pool_a", (40, 40, 700, 200), 'isHorizontal="true"')
    sheet.shape("lane_1", (70, 40, 670, 100), 'isHorizontal="true"')
    sheet.shape("lane_2", (70, 140, 670, 100), 'isHorizontal="true"')
    sheet.shape("work", (140, 55, 110, 60))
    sheet.shape("pool_b", (40, 320, 700, 60), 'isHorizontal="true"')
    sheet.shape("pool_c", (800, 40, 260, 340), 'isHorizontal="false"')
    sheet.shape("lane_3", (800, 70, 130, 310), 'isHorizontal="false"')
    sheet.shape("lane_4", (930, 70, 130, 310), 'isHorizontal="false"')
    sheet.shape("letter", (640, 265, 36, 24))
    link = '<conversationLink id="link" sourceRef="pool_b" targetRef="conversation_1"/>'
    answer = edge("answer", (500, 320), (500, 240)).replace(
        "<bpmndi:BPMNEdge ", '<bpmndi:BPMNEdge messageVisibleKind="non_initiating" '
    )
    return [
        '<process id="inside"><laneSet><lane id="lane_1" name="Operator"><flowNodeRef>work'
        '</flowNodeRef></lane><lane id="lane_2" name="Robot"/></laneSet>'
        '<userTask id="work" name="Work"/></process>',
        '<process id="beside"><laneSet><lane id="lane_3" name="Left"/><lane id="lane_4" '
        'name="Right"/></laneSet><task id="more"/></process>',
        f'<collaboration id="together">{pools}{"".join(sheet.elements)}{link}</collaboration>',
        '<bpmndi:BPMNDiagram name="Collaboration"><bpmndi:BPMNPlane bpmnElement="together">',
        *sheet.shapes,
        edge("call", (300, 240), (300, 320)), answer, edge("link", (150, 380), (150, 420)),
        "</bpmndi:BPMNPlane></bpmndi:BPMNDiagram>",
    ]  # fmt: skip


def _choreography() -> list[str]:
    shapes, elements = [], []
    for place, tag in enumerate(("choreographyTask", "callChoreography", "subChoreography")):
        x, own = 60 + 220 * place, f"{tag}_x"
        elements.append(f'<{tag} id="{own}" name="{tag}" initiatingParticipantRef="asks">'
                        f"<participantRef>asks</participantRef><participantRef>answers"
                        f"</participantRef></{tag}>")  # fmt: skip
        shapes.append(f'<bpmndi:BPMNShape id="s_{own}" bpmnElement="{own}"><dc:Bounds x="{x}" '
                      f'y="100" width="140" height="120"/></bpmndi:BPMNShape>')  # fmt: skip
        for band, top, who in (("top_initiating", 100, "asks"),
                               ("bottom_non_initiating", 190, "answers")):  # fmt: skip
            shapes.append(f'<bpmndi:BPMNShape bpmnElement="{who}" participantBandKind="{band}" '
                          f'isMessageVisible="true" choreographyActivityShape="s_{own}">'
                          f'<dc:Bounds x="{x}" y="{top}" width="140" height="30"/>'
                          f"</bpmndi:BPMNShape>")  # fmt: skip
    return [
        '<choreography id="dance"><participant id="asks" name="Asks"/>'
        '<participant id="answers" name="Answers"><participantMultiplicity/></participant>',
        *elements, "</choreography>",
        '<bpmndi:BPMNDiagram name="Choreography"><bpmndi:BPMNPlane bpmnElement="dance">',
        *shapes, "</bpmndi:BPMNPlane></bpmndi:BPMNDiagram>",
    ]  # fmt: skip


def process(
    inside: str, *, about: str = "", shape: tuple[str, str, str] | None = None
) -> str:  # fmt: skip
    """Return a file with one process; ``shape`` is an element, its x and its width."""
    plane = ""
    if shape is not None:
        own, x, wide = shape
        plane = (
            '<bpmndi:BPMNDiagram><bpmndi:BPMNPlane bpmnElement="p">'
            f'<bpmndi:BPMNShape bpmnElement="{own}"><dc:Bounds x="{x}" y="0" width="{wide}" '
            'height="10"/></bpmndi:BPMNShape></bpmndi:BPMNPlane></bpmndi:BPMNDiagram>'
        )
    return f'{HEAD}<process id="p" {about}>{inside}</process>{plane}</definitions>'


def flows(*pairs: str) -> str:
    """Return sequence flows; each pair is written ``a>b``."""
    found = []
    for pair in pairs:
        source, target = pair.split(">")
        found.append(f'<sequenceFlow id="{source}_{target}" sourceRef="{source}" '
                     f'targetRef="{target}"/>')  # fmt: skip
    return "".join(found)


def line(*nodes: str, more: str = "") -> str:
    """Return a process that leads from a start through nodes, as XML with ids, to an end."""
    ids = [node.split("id='")[1].split("'")[0] for node in nodes]
    way = ["start", *ids, "end"]
    pairs = [f"{a}>{b}" for a, b in pairwise(way)]
    return process(
        f"<startEvent id='start'/>{''.join(nodes)}<endEvent id='end'/>{flows(*pairs)}{more}"
    )
