"""BPMN 2.0 files: read into frozen classes, what they mean and how they are drawn.

A file may come from anybody: its size, depth and number of elements are limited, document types and
entities are refused, ids and numbers are checked. Which elements are run is not judged here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeAlias
from xml.parsers import expat

from amberbox.core.errors import Problem
from amberbox.core.safe_text import one_line
from amberbox.experiments.experiment import NAMESPACE

MODEL = "http://www.omg.org/spec/BPMN/20100524/MODEL"

MOST_BYTES = 4_000_000
MOST_ELEMENTS = 100_000  # of XML
DEEPEST = 100
LONGEST_TEXT = 20_000  # characters of a name, a documentation or a condition
LONGEST_ID = 200
FARTHEST = 100_000.0  # coordinates of a diagram
MOST_SHAPES = 2000  # of all diagrams; and nodes of all processes
MOST_POINTS = 6000  # of all edges; and flows
MOST_PROBLEMS = 100

TASKS = frozenset({
    "task", "userTask", "manualTask", "serviceTask", "sendTask", "receiveTask", "scriptTask",
    "businessRuleTask",
})  # fmt: skip
SUB_PROCESSES = frozenset({"subProcess", "transaction", "adHocSubProcess"})
EVENTS = frozenset({
    "startEvent", "endEvent", "intermediateCatchEvent", "intermediateThrowEvent", "boundaryEvent",
    "implicitThrowEvent",
})  # fmt: skip
GATEWAYS = frozenset({
    "exclusiveGateway", "parallelGateway", "inclusiveGateway", "complexGateway",
    "eventBasedGateway",
})  # fmt: skip
CHOREOGRAPHIES = frozenset({"choreographyTask", "subChoreography", "callChoreography"})
ACTIVITIES = TASKS | SUB_PROCESSES | {"callActivity"} | CHOREOGRAPHIES
FLOW_NODES = ACTIVITIES | EVENTS | GATEWAYS
DATA = frozenset({
    "dataObject", "dataObjectReference", "dataStore", "dataStoreReference", "dataInput",
    "dataOutput",
})  # fmt: skip
ARTIFACTS = frozenset({"textAnnotation", "group"})
CONVERSATIONS = frozenset({"conversation", "subConversation", "callConversation"})
SCOPES = frozenset({"process", "collaboration", "choreography", "globalChoreographyTask"})
_ELEMENTS = FLOW_NODES | DATA | ARTIFACTS | CONVERSATIONS | SCOPES | {"participant", "lane"}
_ROOT_ELEMENTS = frozenset({
    "error", "message", "signal", "escalation", "globalTask", "globalUserTask", "globalManualTask",
    "globalScriptTask", "globalBusinessRuleTask",
})  # fmt: skip
FLOWS = frozenset({
    "sequenceFlow", "messageFlow", "association", "dataInputAssociation", "dataOutputAssociation",
    "conversationLink",
})  # fmt: skip

EventKind: TypeAlias = Literal[
    "message", "timer", "error", "signal", "escalation", "cancel", "compensate", "conditional",
    "link", "terminate",
]  # fmt: skip
_EVENT_KINDS: Mapping[str, EventKind] = {
    "messageEventDefinition": "message",
    "timerEventDefinition": "timer",
    "errorEventDefinition": "error",
    "signalEventDefinition": "signal",
    "escalationEventDefinition": "escalation",
    "cancelEventDefinition": "cancel",
    "compensateEventDefinition": "compensate",
    "conditionalEventDefinition": "conditional",
    "linkEventDefinition": "link",
    "terminateEventDefinition": "terminate",
}
Loop: TypeAlias = Literal["", "standard", "parallel", "sequential"]
_ID = re.compile(r"[^\W\d][\w.\-]*")
_COLOUR = re.compile(r"#(?:[0-9a-fA-F]{3}|[0-9a-fA-F]{6})")


@dataclass(frozen=True, slots=True)
class ExtensionText:
    """YAML in an extension element; it begins in the line that it says."""

    line: int
    yaml: str


@dataclass(frozen=True, slots=True)
class EventDefinition:
    """What an event waits for or raises.

    ``code`` is the code of an error or an escalation, else the name of the message, signal or
    link; empty where the event catches any. ``timer`` says what ``text`` is.
    """

    kind: EventKind
    line: int
    code: str = ""
    timer: Literal["", "duration", "date", "cycle"] = ""
    text: str = ""


@dataclass(frozen=True, slots=True)
class Element:
    """An element of the model; ``type`` is its tag in BPMN, ``parent`` what it stands in."""

    id: str
    type: str
    line: int
    name: str = ""
    documentation: str = ""
    parent: str = ""
    lane: str = ""
    text: str = ""  # of an annotation
    events: tuple[EventDefinition, ...] = ()
    parallel_events: bool = False  # all of several events are waited for
    interrupting: bool = True  # of a boundary event, or the start of an event sub-process
    attached_to: str = ""  # activity of a boundary event
    default: str = ""  # default flow of a gateway or an activity
    called: str = ""  # what a call activity calls
    called_type: str = ""  # type of the global task that is called
    loop: Loop = ""
    compensation: bool = False
    triggered_by_event: bool = False
    instantiates: bool = False
    event_gateway: Literal["exclusive", "parallel"] = "exclusive"
    collection: bool = False
    multiple: bool = False  # of a participant
    state: str = ""  # of data
    process: str = ""  # of a participant
    executable: bool | None = None  # of a process
    initiator: str = ""  # participant that begins a choreography task
    participants: tuple[str, ...] = ()
    extension: ExtensionText | None = None


@dataclass(frozen=True, slots=True)
class Flow:
    """A flow or an association; ``type`` is its tag in BPMN."""

    id: str
    type: str
    line: int
    source: str
    target: str
    name: str = ""
    parent: str = ""
    condition: str = ""
    condition_line: int = 0
    direction: Literal["none", "one", "both"] = "none"
    message: str = ""


@dataclass(frozen=True, slots=True)
class Bounds:
    """A rectangle: upper left corner and size."""

    x: float
    y: float
    width: float
    height: float

    @property
    def middle(self) -> tuple[float, float]:
        """Return its centre."""
        return self.x + self.width / 2, self.y + self.height / 2


@dataclass(frozen=True, slots=True)
class Shape:
    """How an element is drawn; None where the file does not say it."""

    element: str
    bounds: Bounds
    label: Bounds | None = None
    horizontal: bool | None = None
    expanded: bool | None = None
    marker: bool | None = None
    fill: str = ""
    stroke: str = ""
    band: str = ""  # participant of a choreography: top_initiating, bottom_non_initiating ...
    band_of: str = ""  # the shape of the choreography task, by its element
    message_visible: bool = False


@dataclass(frozen=True, slots=True)
class Edge:
    """How a flow is drawn."""

    element: str
    points: tuple[tuple[float, float], ...]
    label: Bounds | None = None
    stroke: str = ""
    message_visible: str = ""  # an envelope at its middle: initiating or non_initiating


@dataclass(frozen=True, slots=True)
class Diagram:
    """One plane with its shapes and edges; ``element`` is what it shows."""

    element: str
    name: str = ""
    shapes: tuple[Shape, ...] = ()
    edges: tuple[Edge, ...] = ()


@dataclass(frozen=True)
class BpmnModel:
    """A BPMN file: its elements and flows by id in the order of the file, and its diagrams."""

    file: str
    elements: Mapping[str, Element]
    flows: Mapping[str, Flow]
    diagrams: tuple[Diagram, ...] = ()

    def of_type(self, *types: str) -> list[Element]:
        """Return the elements of these types."""
        return [element for element in self.elements.values() if element.type in types]

    def children(self, parent: str) -> list[Element]:
        """Return the elements that stand directly in a process, a sub-process or another."""
        return self._children.get(parent, [])

    def outgoing(self, node: str) -> list[Flow]:
        """Return the sequence flows that leave a node."""
        return self._outgoing.get(node, [])

    def incoming(self, node: str) -> list[Flow]:
        """Return the sequence flows that reach a node."""
        return self._incoming.get(node, [])

    def boundary(self, activity: str) -> list[Element]:
        """Return the boundary events of an activity."""
        return self._boundary.get(activity, [])

    def inside(self, parent: str) -> Iterator[Element]:
        """Yield all elements inside a process or a sub-process, at any depth."""
        for element in self.children(parent):
            yield element
            yield from self.inside(element.id)

    @cached_property
    def _children(self) -> dict[str, list[Element]]:
        found: dict[str, list[Element]] = {}
        for element in self.elements.values():
            found.setdefault(element.parent, []).append(element)
        return found

    @cached_property
    def _boundary(self) -> dict[str, list[Element]]:
        found: dict[str, list[Element]] = {}
        for event in self.of_type("boundaryEvent"):
            found.setdefault(event.attached_to, []).append(event)
        return found

    @cached_property
    def _outgoing(self) -> dict[str, list[Flow]]:
        found: dict[str, list[Flow]] = {}
        for flow in self.flows.values():
            if flow.type == "sequenceFlow":
                found.setdefault(flow.source, []).append(flow)
        return found

    @cached_property
    def _incoming(self) -> dict[str, list[Flow]]:
        found: dict[str, list[Flow]] = {}
        for flow in self.flows.values():
            if flow.type == "sequenceFlow":
                found.setdefault(flow.target, []).append(flow)
        return found


def type_words(element_type: str) -> str:
    """Return the type of an element in words: ``businessRuleTask`` is ``business rule task``."""
    words = re.sub(r"(?<!^)([A-Z])", r" \1", element_type).lower()
    return words.replace("sub process", "sub-process").replace("ad hoc", "ad-hoc")


def read_bpmn(path: Path, problems: list[Problem]) -> BpmnModel | None:
    """Read a BPMN file; add its errors to ``problems``. None if it cannot be read at all."""
    file = str(path)
    try:
        with path.open("rb") as opened:
            data = opened.read(MOST_BYTES + 1)
    except OSError as error:
        what = f"cannot be read: {error.strerror or error}"
        problems.append(Problem(file, 1, "file", what))
        return None
    return parse_bpmn(data, file, problems)


def parse_bpmn(data: bytes, file: str, problems: list[Problem]) -> BpmnModel | None:
    """Turn the bytes of a BPMN file into a model; ``file`` is its name in messages."""
    if len(data) > MOST_BYTES:
        what = f"has more than {MOST_BYTES / 1e6:g} MB, the most that an experiment may have"
        problems.append(Problem(file, 1, "file", what, "is it the right file?"))
        return None
    reading = _XmlReading(file)
    try:
        root = reading.read(data)
    except _RefusedError as refused:
        problems.append(refused.problem)
        return None
    except expat.ExpatError as error:
        what = f"is no valid XML: {expat.errors.messages.get(error.code, str(error))}"
        hint = f"column {error.offset + 1}; save it again with a BPMN modeller"
        problems.append(Problem(file, max(error.lineno, 1), "file", what, hint))
        return None
    except (ValueError, LookupError):
        what = "has an encoding that is not supported"
        problems.append(Problem(file, 1, "file", what, "save it as UTF-8"))
        return None
    if root.tag != "definitions" or root.space != MODEL:
        what = f"is no BPMN 2.0: its root is '{short_text(root.tag)}', not 'definitions' of BPMN"
        hint = "save or export it as BPMN 2.0 with a BPMN modeller"
        problems.append(Problem(file, root.line, "file", what, hint))
        return None
    return _ModelReading(file, problems).read(root)


# ---------------------------------------------------------------------------------- XML


class _RefusedError(Exception):
    """XML that is not read any further."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.what)
        self.problem = problem


@dataclass(slots=True)
class _Xml:
    """An element of XML with the line of its tag, and the line that its text begins in."""

    space: str
    tag: str
    attributes: dict[str, str]
    line: int
    children: list[_Xml] = field(default_factory=list)
    parts: list[str] = field(default_factory=list)
    text_line: int = 0

    @property
    def text(self) -> str:
        return "".join(self.parts)

    def get(self, name: str) -> str:
        return self.attributes.get(name, "").strip()

    def each(self, *tags: str) -> Iterator[_Xml]:
        return (child for child in self.children if child.tag in tags)

    def first(self, tag: str) -> _Xml | None:
        return next(self.each(tag), None)

    def content(self, tag: str) -> str:
        child = self.first(tag)
        return "" if child is None else child.text.strip()


class _XmlReading:
    """Reads XML into a tree. Raises _RefusedError for what no BPMN file needs."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.count = 0
        self.open: list[_Xml] = []
        self.root: _Xml | None = None
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._characters
        self.parser.StartDoctypeDeclHandler = self._doctype

    def read(self, data: bytes) -> _Xml:
        self.parser.Parse(data, True)
        assert self.root is not None  # else expat reports that there is no element
        return self.root

    def _refuse(self, what: str, hint: str) -> None:
        raise _RefusedError(Problem(self.file, self.parser.CurrentLineNumber, "file", what, hint))

    def _doctype(self, name: str, system: str | None, public: str | None, subset: int) -> None:
        what = "has a document type declaration (DTD), which may define entities: it is not read"
        self._refuse(what, "BPMN needs none: remove <!DOCTYPE ...>")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self.count += 1
        if self.count > MOST_ELEMENTS:
            self._refuse(f"has more than {MOST_ELEMENTS} XML elements", "is it the right file?")
        if len(self.open) >= DEEPEST:
            self._refuse(f"is nested more than {DEEPEST} deep", "use call activities")
        space, _, tag = name.rpartition(" ")
        plain = {key.rpartition(" ")[2]: value for key, value in attributes.items()}
        found = _Xml(space, tag, plain, self.parser.CurrentLineNumber)
        if self.open:
            self.open[-1].children.append(found)
        else:
            self.root = found
        self.open.append(found)

    def _end(self, name: str) -> None:
        self.open.pop()

    def _characters(self, text: str) -> None:
        here = self.open[-1]
        if not here.parts:
            here.text_line = self.parser.CurrentLineNumber
        here.parts.append(text)


# -------------------------------------------------------------------------------- model


class _ModelReading:
    """Reads elements, flows and diagrams out of the tree."""

    def __init__(self, file: str, problems: list[Problem]) -> None:
        self.file = file
        self.problems = problems
        self.failed = 0
        self.elements: dict[str, Element] = {}
        self.flows: dict[str, Flow] = {}
        self.lines: dict[str, int] = {}
        self.lanes: dict[str, str] = {}  # lane of each node
        self.roots: dict[str, tuple[str, str]] = {}  # code and name of errors, messages ...
        self.categories: dict[str, str] = {}
        self.unnamed = 0

    def read(self, root: _Xml) -> BpmnModel | None:
        for child in root.children:
            if child.space == MODEL:
                self._root_element(child)
        for child in root.children:
            if child.space == MODEL and child.tag in (*SCOPES, "dataStore"):
                self._element(child, "")
        self._settle()
        diagrams = tuple(
            diagram
            for child in root.each("BPMNDiagram")
            for plane in child.each("BPMNPlane")
            if (diagram := self._diagram(child, plane)) is not None
        )
        shapes = sum(len(diagram.shapes) for diagram in diagrams)
        points = sum(len(edge.points) for diagram in diagrams for edge in diagram.edges)
        nodes = sum(element.type in FLOW_NODES for element in self.elements.values())
        if nodes > MOST_SHAPES or len(self.flows) > MOST_POINTS:
            what = f"has {nodes} events, activities and gateways, and {len(self.flows)} flows"
            hint = f"at most {MOST_SHAPES} and {MOST_POINTS}; divide it with call activities"
            self._fail(root.line, "file", what, hint)
        if shapes > MOST_SHAPES or points > MOST_POINTS:
            what = f"has diagrams of {shapes} shapes and lines of {points} points"
            hint = f"at most {MOST_SHAPES} and {MOST_POINTS}; divide it with call activities"
            self._fail(root.line, "file", what, hint)
        if not any(element.type in SCOPES for element in self.elements.values()):
            self._fail(root.line, "file", "has no process", "draw at least one task or event")
        if self.failed:
            return None
        return BpmnModel(self.file, self.elements, self.flows, diagrams)

    def _fail(self, line: int, where: str, what: str, hint: str = "") -> None:
        self.failed += 1
        if self.failed <= MOST_PROBLEMS:
            self.problems.append(Problem(self.file, line, where, what, hint))

    def _root_element(self, xml: _Xml) -> None:
        if xml.tag in _ROOT_ELEMENTS:
            code = xml.get("errorCode") or xml.get("escalationCode") or xml.get("name")
            self.roots[xml.get("id")] = (code or xml.get("id"), xml.get("name"))
            if xml.tag == "message" or xml.tag.startswith("global"):
                self._element(xml, "")
        for value in xml.each("categoryValue"):
            self.categories[value.get("id")] = value.get("value")

    def _identify(self, xml: _Xml) -> str:
        """Return the id of an element; one of our own if it has none or it cannot be used."""
        found = xml.get("id")
        if found and (len(found) > LONGEST_ID or not _ID.fullmatch(found)):
            hint = f"letters, digits, _ . - and at most {LONGEST_ID} characters"
            self._fail(xml.line, xml.tag, f"'{short_text(found)}' cannot be an id", hint)
        elif found in self.lines:
            what = f"the id is used twice, first in line {self.lines[found]}"
            self._fail(xml.line, short_text(found), what, "each element needs an id of its own")
        elif found:
            self.lines[found] = xml.line
            return found
        self.unnamed += 1
        return f"{xml.tag}~{self.unnamed}"  # no id of the file has a ~

    def _text(self, xml: _Xml, text: str) -> str:
        """Return a text; an error if it is too long."""
        if len(text) > LONGEST_TEXT:
            what = f"has a text of more than {LONGEST_TEXT} characters"
            self._fail(xml.line, short_text(xml.get("id") or xml.tag), what, "shorten it")
            return ""
        return text.strip()

    def _element(self, xml: _Xml, parent: str) -> None:
        """Read an element and all inside it."""
        own = self._identify(xml)
        loop: Loop = "standard" if xml.first("standardLoopCharacteristics") else ""
        multi = xml.first("multiInstanceLoopCharacteristics")
        if multi is not None:
            loop = "sequential" if _yes(multi.get("isSequential")) else "parallel"
        state = xml.first("dataState")
        name = xml.get("name") or self.categories.get(xml.get("categoryValueRef"), "")
        executable = xml.get("isExecutable")
        called = xml.get("calledElement") or xml.get("calledChoreographyRef")
        self.elements[own] = Element(
            own,
            xml.tag,
            xml.line,
            name=self._text(xml, name),
            documentation=self._text(xml, xml.content("documentation")),
            parent=parent,
            text=self._text(xml, xml.content("text")),
            events=tuple(self._events(xml)),
            parallel_events=_yes(xml.get("parallelMultiple")),
            interrupting=not any(
                xml.get(key) in ("false", "0") for key in ("cancelActivity", "isInterrupting")
            ),
            attached_to=xml.get("attachedToRef"),
            default=xml.get("default"),
            called=self._text(xml, called),
            loop=loop,
            compensation=_yes(xml.get("isForCompensation")),
            triggered_by_event=_yes(xml.get("triggeredByEvent")),
            instantiates=_yes(xml.get("instantiate")),
            event_gateway="parallel" if xml.get("eventGatewayType") == "Parallel" else "exclusive",
            collection=_yes(xml.get("isCollection")),
            multiple=xml.first("participantMultiplicity") is not None,
            state=self._text(xml, state.get("name")) if state is not None else "",
            process=xml.get("processRef") or xml.get("dataObjectRef") or xml.get("dataStoreRef"),
            executable=_yes(executable) if executable else None,
            initiator=xml.get("initiatingParticipantRef"),
            participants=tuple(child.text.strip() for child in xml.each("participantRef")),
            extension=self._extension(xml, own),
        )
        self._inside(xml, own)

    def _inside(self, xml: _Xml, own: str) -> None:
        for node in xml.each("flowNodeRef"):  # those of lanes inside come later, and count
            self.lanes[node.text.strip()] = own
        for child in xml.children:
            if child.space != MODEL:
                continue
            if child.tag in _ELEMENTS:
                self._element(child, own)
            elif child.tag in FLOWS:
                self._flow(child, own)
            elif child.tag in ("laneSet", "childLaneSet", "ioSpecification"):
                self._inside(child, own)

    def _events(self, xml: _Xml) -> Iterator[EventDefinition]:
        for child in xml.children:
            kind = _EVENT_KINDS.get(child.tag)
            if kind is None:
                continue
            timer: Literal["", "duration", "date", "cycle"] = ""
            text = child.content("condition")
            if child.first("timeDuration") is not None:
                timer, text = "duration", child.content("timeDuration")
            elif child.first("timeDate") is not None:
                timer, text = "date", child.content("timeDate")
            elif child.first("timeCycle") is not None:
                timer, text = "cycle", child.content("timeCycle")
            refs = ("errorRef", "escalationRef", "messageRef", "signalRef")
            ref = next((child.get(name) for name in refs if child.get(name)), "")
            code = (self._known_root(ref) or (ref, ""))[0] if ref else child.get("name")
            yield EventDefinition(
                kind, child.line, self._text(child, code), timer, self._text(child, text)
            )
        for child in xml.each("eventDefinitionRef"):  # shared definitions are rare
            kinds = [kind for tag, kind in _EVENT_KINDS.items() if kind in child.text.lower()]
            yield EventDefinition(kinds[0] if kinds else "signal", child.line)

    def _known_root(self, ref: str) -> tuple[str, str] | None:
        found = self.roots.get(ref)
        return found if found is not None else self.roots.get(ref.rpartition(":")[2])

    def _extension(self, xml: _Xml, own: str) -> ExtensionText | None:
        expected = "experiment" if xml.tag in ("process", "collaboration") else "step"
        found: ExtensionText | None = None
        for holder in xml.each("extensionElements"):
            for child in holder.children:
                if child.space != NAMESPACE:
                    continue
                if child.tag != expected:
                    what = f"'{short_text(child.tag)}' does not belong here"
                    self._fail(child.line, own, what, f"write <amberbox:{expected}>")
                elif found is not None:
                    self._fail(child.line, own, f"<amberbox:{expected}> is given twice")
                else:
                    found = ExtensionText(child.text_line or child.line, child.text)
        return found

    def _flow(self, xml: _Xml, parent: str) -> None:
        own = self._identify(xml)
        source = xml.get("sourceRef") or xml.content("sourceRef")
        target = xml.get("targetRef") or xml.content("targetRef")
        if xml.tag == "dataInputAssociation":
            target = parent
        if xml.tag == "dataOutputAssociation":
            source = parent
        condition = xml.first("conditionExpression")
        directions: dict[str, Literal["one", "both"]] = {"One": "one", "Both": "both"}
        self.flows[own] = Flow(
            own,
            xml.tag,
            xml.line,
            source,
            target,
            name=self._text(xml, xml.get("name")),
            parent=parent,
            condition=self._text(xml, condition.text) if condition is not None else "",
            condition_line=0 if condition is None else condition.text_line or condition.line,
            direction=directions.get(xml.get("associationDirection"), "none"),
            message=xml.get("messageRef"),
        )

    # ------------------------------------------------------- references between elements

    def _settle(self) -> None:
        """Resolve references, which may have prefixes and come before what they name."""
        for own, flow in self.flows.items():
            source, target = self._resolved(flow.source), self._resolved(flow.target)
            self.flows[own] = replace(flow, source=source, target=target)
            for key, ref in (("sourceRef", source), ("targetRef", target)):
                if flow.type == "sequenceFlow" and not ref:
                    self._fail(flow.line, own, f"the attribute {key} is missing")
                elif flow.type == "sequenceFlow" and not self._is_node(ref):
                    what = (
                        f"{key} names '{short_text(ref)}', which is no event, activity or gateway"
                    )
                    self._fail(flow.line, own, what)
        for own, element in self.elements.items():
            self.elements[own] = self._settled(element)

    def _is_node(self, ref: str) -> bool:
        return ref in self.elements and self.elements[ref].type in FLOW_NODES

    def _settled(self, element: Element) -> Element:
        attached, process = self._resolved(element.attached_to), self._resolved(element.process)
        collection = element.collection
        if element.type in ("dataObjectReference", "dataStoreReference"):
            referred = self.elements.get(process)
            collection = collection or (referred is not None and referred.collection)
        if element.type == "boundaryEvent" and (
            attached not in self.elements or self.elements[attached].type not in ACTIVITIES
        ):
            what = f"attachedToRef names '{short_text(attached)}', which is no activity"
            self._fail(element.line, element.id, what)
        default = self._resolved(element.default)
        if default and (default not in self.flows or self.flows[default].source != element.id):
            default = ""  # it does not leave this element; a gateway without one is judged later
        called = self.elements.get(self._resolved(element.called))
        return replace(
            element,
            attached_to=attached,
            process=process,
            collection=collection,
            default=default,
            lane=self.lanes.get(element.id, ""),
            called_type=called.type if called is not None else "",
            initiator=self._resolved(element.initiator),
            participants=tuple(map(self._resolved, element.participants)),
        )

    def _resolved(self, ref: str) -> str:
        if not ref or ref in self.elements or ref in self.flows:
            return ref
        local = ref.rpartition(":")[2]
        return local if local in self.elements or local in self.flows else ref

    # ------------------------------------------------------------------------- diagrams

    def _diagram(self, xml: _Xml, plane: _Xml) -> Diagram | None:
        shapes: list[Shape] = []
        edges: list[Edge] = []
        of_shape = {
            shape.get("id"): self._resolved(shape.get("bpmnElement"))
            for shape in plane.each("BPMNShape")
        }
        for child in plane.children:
            ref = self._resolved(child.get("bpmnElement"))
            if child.tag == "BPMNShape" and ref in self.elements:
                bounds = self._bounds(child)
                if bounds is not None:
                    shapes.append(self._shape(child, ref, bounds, of_shape))
            elif child.tag == "BPMNEdge" and ref in self.flows:
                points = tuple(
                    (self._number(point, "x"), self._number(point, "y"))
                    for point in child.each("waypoint")
                )
                if len(points) < 2:
                    continue  # there is nothing to draw
                stroke = _colour(child, "border-color", "stroke")
                visible = child.get("messageVisibleKind")
                edges.append(Edge(ref, points, self._label(child), stroke, visible))
        name = self._text(xml, xml.get("name"))
        return Diagram(self._resolved(plane.get("bpmnElement")), name, tuple(shapes), tuple(edges))

    def _shape(self, xml: _Xml, ref: str, bounds: Bounds, of_shape: Mapping[str, str]) -> Shape:
        return Shape(
            ref,
            bounds,
            self._label(xml),
            _tri(xml.get("isHorizontal")),
            _tri(xml.get("isExpanded")),
            _tri(xml.get("isMarkerVisible")),
            _colour(xml, "background-color", "fill"),
            _colour(xml, "border-color", "stroke"),
            xml.get("participantBandKind"),
            of_shape.get(xml.get("choreographyActivityShape").rpartition(":")[2], ""),
            _yes(xml.get("isMessageVisible")),
        )

    def _label(self, xml: _Xml) -> Bounds | None:
        label = xml.first("BPMNLabel")
        if label is None or label.first("Bounds") is None:
            return None
        return self._bounds(label)

    def _bounds(self, xml: _Xml) -> Bounds | None:
        found = xml.first("Bounds")
        if found is None:
            self._fail(xml.line, short_text(xml.get("bpmnElement") or xml.tag), "has no bounds")
            return None
        x, y, wide, high = (self._number(found, key) for key in ("x", "y", "width", "height"))
        if wide < 0 or high < 0:
            self._fail(found.line, "Bounds", "the size is negative")
        return Bounds(x, y, max(wide, 0.0), max(high, 0.0))

    def _number(self, xml: _Xml, key: str) -> float:
        try:
            value = float(xml.get(key))
        except ValueError:
            value = math.nan
        if math.isfinite(value) and abs(value) <= FARTHEST:
            return value
        what = f"'{short_text(xml.get(key))}' is no number from {-FARTHEST:g} to {FARTHEST:g}"
        self._fail(xml.line, f"{short_text(xml.tag)}.{key}", what)
        return 0.0


def _yes(text: str) -> bool:
    return text in ("true", "1")


def _tri(text: str) -> bool | None:
    return _yes(text) if text else None


def _colour(xml: _Xml, *names: str) -> str:
    """Return the first attribute that is a colour; others are ignored."""
    values = (xml.get(name) for name in names)
    return next((value for value in values if _COLOUR.fullmatch(value)), "")


def short_text(text: str) -> str:
    """Return a text that anybody may have written as a short one for a message."""
    line = one_line(text)
    return line if len(line) <= 60 else f"{line[:60]}..."
