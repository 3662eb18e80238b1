"""BPMN diagrams as SVG, from the layout in their file; each shape and line names its element.

Symbols are those of BPMN 2.0.2, chapters 7 to 13. A drawing is the same for the same file. Colours
are custom properties of CSS (``STYLE``), states of a run are classes such as ``is-current``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

from amberbox.core.safe_text import one_line
from amberbox.core.svg import (
    SvgElement,
    classes,
    element,
    fitted,
    group,
    number,
    root,
    title,
    width,
    wrap_text,
)
from amberbox.experiments.bpmn import (
    CHOREOGRAPHIES,
    CONVERSATIONS,
    EVENTS,
    GATEWAYS,
    SUB_PROCESSES,
    Bounds,
    BpmnModel,
    Diagram,
    Edge,
    Element,
    Flow,
    Shape,
    type_words,
)
from amberbox.experiments.bpmn_symbols import (
    ICONS,
    activity_markers,
    bars,
    envelope,
    gateway_marker,
    plus_box,
    trigger,
)
from amberbox.experiments.diagram_layout import laid_out

State: TypeAlias = Literal["current", "done", "failed", "waiting"]

STYLE = """\
.bpmn{--bpmn-paper:#fff;--bpmn-line:#26323d;--bpmn-text:#17212b;--bpmn-fill:#fff;--bpmn-pool:#fbfcfd;
--bpmn-band:#e6eaee;--bpmn-current:#0b5fff;--bpmn-current-fill:#dbe8ff;--bpmn-done:#1e7a46;
--bpmn-done-fill:#e2f4e8;--bpmn-failed:#b42318;--bpmn-failed-fill:#fde4e1;--bpmn-waiting:#8a5a00;
--bpmn-waiting-fill:#fff0cf;font-family:system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
@media screen and (prefers-color-scheme:dark){.bpmn{--bpmn-paper:#12181f;--bpmn-line:#b9c4cf;
--bpmn-text:#e8edf2;--bpmn-fill:#1c252e;--bpmn-pool:#161d25;--bpmn-band:#35414d;--bpmn-current:#7fb0ff;
--bpmn-current-fill:#15305e;--bpmn-done:#6fd09a;--bpmn-done-fill:#143524;--bpmn-failed:#ff9287;
--bpmn-failed-fill:#4d1a15;--bpmn-waiting:#f0c060;--bpmn-waiting-fill:#3e2f0c}}
@page bpmn{size:landscape;margin:10mm}
@media print{.bpmn{print-color-adjust:exact}
:root.bpmn{page:bpmn;width:100%;height:auto;max-height:95vh}}
"""
RULES = """\
.bpmn{background:var(--bpmn-paper)}
.bpmn .paper{fill:var(--bpmn-paper)}
.bpmn text{fill:var(--bpmn-text)}
.bpmn .coloured text.inside{fill:#17212b}
.bpmn .halo{paint-order:stroke;stroke:var(--bpmn-paper);stroke-width:3px;stroke-linejoin:round}
.bpmn .line{fill:none;stroke-linejoin:round;stroke-linecap:round}
.bpmn .body:not([fill]){fill:var(--bpmn-fill)}
.bpmn .pool:not([fill]){fill:var(--bpmn-pool)}
.bpmn .band:not([fill]){fill:var(--bpmn-band)}
.bpmn .open:not([fill]){fill:none}
.bpmn .ink:not([fill]){fill:var(--bpmn-line)}
.bpmn :is(.line,.body,.ink):not([stroke]){stroke:var(--bpmn-line)}
.bpmn .blank{fill:var(--bpmn-paper);stroke:var(--bpmn-line)}
.bpmn .gap{fill:none;stroke:var(--bpmn-fill)}
.bpmn .is-done{--bpmn-line:var(--bpmn-done);--bpmn-fill:var(--bpmn-done-fill)}
.bpmn .is-failed{--bpmn-line:var(--bpmn-failed);--bpmn-fill:var(--bpmn-failed-fill)}
.bpmn .is-waiting{--bpmn-line:var(--bpmn-waiting);--bpmn-fill:var(--bpmn-waiting-fill)}
.bpmn .is-current{--bpmn-line:var(--bpmn-current);--bpmn-fill:var(--bpmn-current-fill)}
.bpmn .is-current .body{stroke-width:3.5}
.bpmn .is-waiting .body{stroke-dasharray:7 3}
"""

Point: TypeAlias = tuple[float, float]
_Candidate: TypeAlias = Callable[[float, float], Bounds]  # where a label of a size may be put

_MARGIN = 12.0
_TEXT = 12.0
_LABEL = 11.0
_LINE = 1.18  # height of a line in parts of the size of its letters
_BAND = 30.0  # where the name of a pool or a lane stands
_LABEL_WIDTH = 92.0
_MOST_PLACED = 300  # labels that are put where they cover least
_HEADING = 26.0


def draw_bpmn(
    model: BpmnModel, states: Mapping[str, State] | None = None, *, standalone: bool = True
) -> SvgElement:
    """Return all diagrams of a file, one below the other.

    ``states`` marks elements and flows by id. A file without a layout gets one. With
    ``standalone`` the rules of style are in the drawing, as a file of its own needs; a page has
    them in its style sheet, where it may set the custom properties.
    """
    states = states or {}
    diagrams = [d for d in model.diagrams if d.shapes or d.edges] or [laid_out(model)]
    parts: list[SvgElement] = []
    y, wide = 0.0, 0.0
    for diagram in diagrams:
        if len(diagrams) > 1:
            name = one_line(diagram.name or _name_of(model, diagram.element))
            if name:
                heading = element("text", name, x=_MARGIN, y=y + 18, font_size=14.0)
                parts.append(group(heading, class_="heading"))
                wide, y = max(wide, width(name, 14.0) + 2 * _MARGIN), y + _HEADING
        drawing = _Drawing(model, diagram, states)
        left, top, right, bottom = drawing.extent()
        shift = (_MARGIN - left, y + _MARGIN - top)
        parts.append(group(*drawing.parts, at=shift, class_="plane"))
        wide, y = max(wide, right - left + 2 * _MARGIN), y + bottom - top + 2 * _MARGIN
    style = [element("style", STYLE + RULES)] if standalone else []
    paper = element("rect", class_="paper", width=math.ceil(wide), height=math.ceil(y))
    label = one_line(_label(model))
    return root("bpmn", (wide, y), label, [*style, paper, *parts])


def _name_of(model: BpmnModel, own: str) -> str:
    found = model.elements.get(own)
    return found.name if found is not None else ""


def _label(model: BpmnModel) -> str:
    names = [e.name for e in model.of_type("participant", "process") if e.name]
    return f"BPMN diagram: {', '.join(dict.fromkeys(names))}" if names else "BPMN diagram"


@dataclass
class _Drawing:
    """One plane: its shapes from the outside to the inside, lines between, labels above."""

    model: BpmnModel
    diagram: Diagram
    states: Mapping[str, State]

    def __post_init__(self) -> None:
        # where no label should be put
        self.boxes = [shape.bounds for shape in self.diagram.shapes if not self._is_frame(shape)]
        self.labels: list[SvgElement] = []
        self.label_boxes: list[Bounds] = []
        self.lines = [
            Bounds(min(a[0], b[0]), min(a[1], b[1]), abs(a[0] - b[0]), abs(a[1] - b[1]))
            for edge in self.diagram.edges
            for a, b in pairwise(edge.points)
        ]
        self.parts = self._drawn()  # groups in the order in which they are painted

    def extent(self) -> tuple[float, float, float, float]:
        """Return left, top, right and bottom of everything."""
        boxes = [shape.bounds for shape in self.diagram.shapes] + self.lines + self.label_boxes
        if not boxes:
            return 0.0, 0.0, 1.0, 1.0
        return (
            min(box.x for box in boxes), min(box.y for box in boxes),
            max(box.x + box.width for box in boxes), max(box.y + box.height for box in boxes),
        )  # fmt: skip

    def _drawn(self) -> list[SvgElement]:
        shapes = sorted(self.diagram.shapes, key=self._layer)
        frames = [shape for shape in shapes if self._is_frame(shape)]
        nodes = [shape for shape in shapes if not self._is_frame(shape)]
        return [
            *(self._shape(shape) for shape in frames),
            *(self._edge(edge) for edge in self.diagram.edges),
            *(self._shape(shape) for shape in nodes),
            *self.labels,
        ]

    def _element(self, shape: Shape) -> Element:
        return self.model.elements[shape.element]

    def _is_frame(self, shape: Shape) -> bool:
        """Return whether a shape has others inside, and is painted below the lines."""
        kind = self._element(shape).type
        if kind in ("participant", "lane"):
            return not shape.band
        return kind == "group" or _is_expanded(self._element(shape), shape)

    def _layer(self, shape: Shape) -> tuple[int, float]:
        kind = self._element(shape).type
        first = {"participant": 0, "lane": 1, "group": 3, "boundaryEvent": 6}.get(kind, 4)
        if shape.band:
            first = 5
        elif first == 4 and _is_expanded(self._element(shape), shape):
            first = 2
        return first, -shape.bounds.width * shape.bounds.height if first < 3 else 0.0

    # ------------------------------------------------------------------------------ shapes

    def _shape(self, shape: Shape) -> SvgElement:
        own = self._element(shape)
        state = self.states.get(own.id)
        return element(
            "g",
            title(f"{_tooltip(own)}{f' ({state})' if state else ''}"),
            *self._figure(own, shape),
            class_=classes(
                "shape", own.type, f"is-{state}" if state else "",
                "coloured" if shape.fill and not state else "",
            ),
            data_bpmn_id=own.id,
        )  # fmt: skip

    def _figure(self, own: Element, shape: Shape) -> Iterator[SvgElement]:
        kind = own.type
        colour = {} if own.id in self.states else _colours(shape)
        if kind in EVENTS:
            yield from self._event(own, shape, colour)
        elif kind in GATEWAYS:
            yield from self._gateway(own, shape, colour)
        elif kind in ("participant", "lane"):
            yield from self._pool(own, shape, colour)
        elif kind in ("dataObject", "dataObjectReference", "dataInput", "dataOutput"):
            yield from self._data(own, shape, colour)
        elif kind in ("dataStore", "dataStoreReference"):
            yield _data_store(shape.bounds, colour)
            self._label_below(own, shape)
        elif kind == "textAnnotation":
            yield from self._annotation(own, shape)
        elif kind == "group":
            yield _rectangle(shape.bounds, 10, class_="line", stroke_dasharray="8 4 2 4",
                             stroke_width=1.5, **colour)  # fmt: skip
            yield from self._text_at(own.name, shape.label, _top_of(shape.bounds))
        elif kind == "message":
            yield from envelope(*_corner_and_size(shape.bounds), filled=False)
            self._label_below(own, shape)
        elif kind in CONVERSATIONS:
            yield from self._conversation(own, shape, colour)
        else:
            yield from self._activity(own, shape, colour)

    def _event(self, own: Element, shape: Shape, colour: Mapping[str, str]) -> Iterator[SvgElement]:
        (x, y), box = shape.bounds.middle, shape.bounds
        radius = min(box.width, box.height) / 2
        dashes = None if own.interrupting else "5 3"
        thick = 3.5 if own.type == "endEvent" else 1.6
        yield element("circle", class_="body", cx=x, cy=y, r=radius, stroke_width=thick,
                      stroke_dasharray=dashes, **colour)  # fmt: skip
        if own.type not in ("startEvent", "endEvent"):
            yield element("circle", class_="line", cx=x, cy=y, r=max(radius - 3.2, 1.0),
                          stroke_width=1.4, stroke_dasharray=dashes)  # fmt: skip
        throws = own.type in ("endEvent", "intermediateThrowEvent", "implicitThrowEvent")
        if own.events:
            place = f"translate({number(x)} {number(y)}) scale({number(max(radius, 1.0) / 18)})"
            yield element("g", *trigger(own.events, throws=throws, parallel=own.parallel_events),
                          class_="marker", transform=place)  # fmt: skip
        self._label_below(own, shape)

    def _gateway(
        self, own: Element, shape: Shape, colour: Mapping[str, str]
    ) -> Iterator[SvgElement]:
        (x, y), box = shape.bounds.middle, shape.bounds
        corners = [(x, box.y), (box.x + box.width, y), (x, box.y + box.height), (box.x, y)]
        yield element("polygon", class_="body", points=_points(corners), stroke_width=1.6, **colour)
        scale = number(max(min(box.width, box.height), 1.0) / 50)
        marks = list(gateway_marker(own, shape))
        if marks:
            place = f"translate({number(x)} {number(y)}) scale({scale})"
            yield element("g", *marks, class_="marker", transform=place)
        self._label_below(own, shape)

    def _activity(
        self, own: Element, shape: Shape, colour: Mapping[str, str]
    ) -> Iterator[SvgElement]:
        box = shape.bounds
        is_call = own.type in ("callActivity", "callChoreography")
        dashes = "2 4" if own.triggered_by_event else None
        yield _rectangle(box, 10, class_="body", stroke_width=3.6 if is_call else 1.6,
                         stroke_dasharray=dashes, **colour)  # fmt: skip
        if own.type == "transaction":
            inner = Bounds(box.x + 3, box.y + 3, max(box.width - 6, 0), max(box.height - 6, 0))
            yield _rectangle(inner, 8, class_="line", stroke_width=1.4)
        # a call of a global user task has the icon of a user task
        kind = own.called_type.replace("globalU", "u").replace("globalM", "m")
        kind = kind.replace("globalS", "s").replace("globalB", "b") if is_call else own.type
        icon = ICONS.get(kind)
        if icon is not None:
            yield element("g", *icon(own), class_="marker", transform=_moved(box.x + 6, box.y + 5))
        is_sub = own.type in SUB_PROCESSES or own.type in ("subChoreography", "callActivity")
        is_collapsed = is_sub and not shape.expanded and not own.called_type.startswith("global")
        marks = list(activity_markers(own, collapsed=is_collapsed))
        top, bottom = self._bands(own.id)
        below = 16.0 if marks else 0.0
        across = box.x + box.width / 2 - 8.5 * len(marks) + 1
        for place, mark in enumerate(marks):
            at = _moved(across + 17 * place, box.y + box.height - 17 - bottom)
            yield element("g", *mark, class_="marker", transform=at)
        if own.type in CHOREOGRAPHIES:
            room = Bounds(box.x + 4, box.y + top, box.width - 8, box.height - top - bottom - below)
            yield from _centred(own.name, room)
        elif _is_expanded(own, shape):
            left = 22.0 if icon is not None else 6.0
            shown = fitted(own.name, box.width - left - 6, _TEXT)
            yield _line_of(shown, box.x + box.width / 2, box.y + 16, _TEXT)
        else:
            yield from _centred(own.name, self._room(own, box, icon is not None, below))

    def _bands(self, own: str) -> tuple[float, float]:
        """Return the height of the bands of participants at the top and at the bottom."""
        bands = [s for s in self.diagram.shapes if s.band_of == own]
        top = sum(s.bounds.height for s in bands if s.band.startswith("top"))
        return top, sum(s.bounds.height for s in bands if not s.band.startswith("top"))

    def _room(self, own: Element, box: Bounds, has_icon: bool, below: float) -> Bounds:
        """Return where the name of an activity has room: beside icon, markers, border events."""
        top, bottom = box.y + 4, box.y + box.height - max(below, 4)
        for shape in self.diagram.shapes:
            if self._element(shape).attached_to != own.id:
                continue
            event = shape.bounds
            middle = event.middle[1]
            if abs(middle - (box.y + box.height)) < event.height:
                bottom = min(bottom, event.y - 1)
            elif abs(middle - box.y) < event.height:
                top = max(top, event.y + event.height + 1)
        if bottom - top < _TEXT * _LINE:  # events on both sides of a flat activity
            top, bottom = box.y + 4, box.y + box.height - max(below, 4)
        side = 5.0
        if has_icon and bottom - top > 3 * _TEXT * _LINE:
            top = max(top, box.y + 21)
        elif has_icon:
            side = 22.0
        return Bounds(box.x + side, top, max(box.width - 2 * side, 10), bottom - top)

    def _pool(self, own: Element, shape: Shape, colour: Mapping[str, str]) -> Iterator[SvgElement]:
        box = shape.bounds
        if shape.band:
            yield from self._choreography_band(own, shape)
            return
        across = self._is_horizontal(shape)
        kind = "body pool" if own.type == "participant" else "body open"
        yield _rectangle(box, 0, class_=kind, stroke_width=1.6, **colour)
        is_white = bool(own.process) and own.process in self.model.elements
        is_white = is_white and bool(self.model.children(own.process))
        if own.type == "participant" and not is_white:
            yield from _centred(own.name, Bounds(box.x + 6, box.y, box.width - 12, box.height))
        elif across:
            if own.type == "participant":
                yield _path([(box.x + _BAND, box.y), (box.x + _BAND, box.y + box.height)], 1.2)
            yield from _upright(own.name, Bounds(box.x, box.y, _BAND, box.height))
        else:
            if own.type == "participant":
                yield _path([(box.x, box.y + _BAND), (box.x + box.width, box.y + _BAND)], 1.2)
            yield from _centred(own.name, Bounds(box.x + 4, box.y, box.width - 8, _BAND))
        if own.multiple:
            at = _moved(box.x + box.width / 2 - 8, box.y + box.height - 18)
            yield element("g", *bars(upright=True), class_="marker", transform=at)

    def _is_horizontal(self, shape: Shape) -> bool:
        if shape.horizontal is not None:
            return shape.horizontal
        if self._element(shape).type == "lane":
            for pool in self.diagram.shapes:
                if self._element(pool).type == "participant" and _is_in(shape.bounds, pool.bounds):
                    return self._is_horizontal(pool)
        return shape.bounds.width >= shape.bounds.height

    def _choreography_band(self, own: Element, shape: Shape) -> Iterator[SvgElement]:
        box, is_top = shape.bounds, shape.band.startswith("top")
        rounded = 10.0 if shape.band.startswith(("top", "bottom")) else 0.0
        is_filled = shape.band.endswith("non_initiating")
        yield element("path", d=_band_path(box, rounded, is_top=is_top), stroke_width=1.4,
                      class_="body band" if is_filled else "body")  # fmt: skip
        below = 14.0 if own.multiple else 0.0
        yield from _centred(own.name, Bounds(box.x + 4, box.y, box.width - 8, box.height - below))
        if own.multiple:
            at = _moved(box.x + box.width / 2 - 8, box.y + box.height - 15)
            yield element("g", *bars(upright=True), class_="marker", transform=at)
        if shape.message_visible:
            x = box.x + box.width / 2
            y = box.y - 44 if is_top else box.y + box.height + 22
            ends = (box.y, y + 22) if is_top else (box.y + box.height, y)
            yield _path([(x, ends[0]), (x, ends[1])], 1.2, dashes="1 4")
            letter = Bounds(x - 16, y, 32, 22)
            self.label_boxes.append(letter)
            yield from envelope(*_corner_and_size(letter), filled=False, grey=is_filled)

    def _data(self, own: Element, shape: Shape, colour: Mapping[str, str]) -> Iterator[SvgElement]:
        box = shape.bounds
        fold = min(12.0, box.width / 3, box.height / 3)
        right, bottom = box.x + box.width, box.y + box.height
        corners = [(box.x, box.y), (right - fold, box.y), (right, box.y + fold), (right, bottom),
                   (box.x, bottom)]  # fmt: skip
        yield element("polygon", class_="body", points=_points(corners), stroke_width=1.5, **colour)
        yield _path(
            [(right - fold, box.y), (right - fold, box.y + fold), (right, box.y + fold)], 1.2
        )
        if own.type in ("dataInput", "dataOutput"):
            arrow = element("path", d="M0 5H8V1L15 8L8 15V11H0Z", stroke_width=1.2,
                            class_="ink" if own.type == "dataOutput" else "blank")  # fmt: skip
            yield element("g", arrow, class_="marker", transform=_moved(box.x + 4, box.y + 4))
        if own.collection:
            at = _moved(box.x + box.width / 2 - 8, bottom - 17)
            yield element("g", *bars(upright=True), class_="marker", transform=at)
        self._label_below(own, shape)

    def _annotation(self, own: Element, shape: Shape) -> Iterator[SvgElement]:
        box = shape.bounds
        x, y, end = box.x, box.y, box.y + box.height
        yield _rectangle(box, 0, class_="area", fill="transparent")
        yield _path([(x + 10, y), (x, y), (x, end), (x + 10, end)], 1.4)
        room = Bounds(x + 6, y + 2, max(box.width - 8, 10), max(box.height - 4, _LABEL))
        size, lines = _fitting(own.text or own.name, room)
        for place, line in enumerate(lines):
            at = y + 4 + size * (0.95 + _LINE * place)
            yield element("text", line, x=x + 7, y=at, font_size=size, class_="inside")

    def _conversation(
        self, own: Element, shape: Shape, colour: Mapping[str, str]
    ) -> Iterator[SvgElement]:
        box = shape.bounds
        side, right = min(box.width / 4, box.height / 2), box.x + box.width
        middle, bottom = box.y + box.height / 2, box.y + box.height
        corners = [(box.x + side, box.y), (right - side, box.y), (right, middle),
                   (right - side, bottom), (box.x + side, bottom), (box.x, middle)]  # fmt: skip
        thick = 3.6 if own.type == "callConversation" else 1.6
        yield element("polygon", class_="body", points=_points(corners), stroke_width=thick,
                      **colour)  # fmt: skip
        if own.type == "subConversation":
            at = _moved(box.x + box.width / 2 - 8, bottom - 17)
            yield element("g", *plus_box(), class_="marker", transform=at)
        self._label_below(own, shape)

    # ------------------------------------------------------------------------------- edges

    def _edge(self, edge: Edge) -> SvgElement:
        flow = self.model.flows[edge.element]
        state = self.states.get(flow.id)
        return element(
            "g",
            title(self._flow_text(flow)),
            *self._flow_figure(flow, edge, None if state else edge.stroke or None),
            class_=classes("edge", flow.type, f"is-{state}" if state else ""),
            data_bpmn_id=flow.id,
        )

    def _flow_text(self, flow: Flow) -> str:
        names = [one_line(_name_of(self.model, end) or end) for end in (flow.source, flow.target)]
        name = one_line(flow.name or flow.condition)
        words = {"sequenceFlow": "flow", "messageFlow": "message flow"}.get(
            flow.type, "association"
        )
        return f"{words}{f' {name}' if name else ''}: {' to '.join(filter(None, names))}"

    def _flow_figure(self, flow: Flow, edge: Edge, colour: str | None) -> Iterator[SvgElement]:
        points = edge.points
        dashes = {"sequenceFlow": None, "messageFlow": "7 4", "conversationLink": None}.get(
            flow.type, "1.5 4"
        )
        if flow.type == "conversationLink":
            yield _path(points, 5)
            yield element("path", d=_way(points), class_="gap", stroke_width=2.6)
        else:
            yield _path(_shortened(points, flow), 1.5, dashes=dashes, stroke=colour)
        if flow.type == "sequenceFlow":
            yield _arrow(points, "ink", colour)
            yield from self._flow_start(flow, points)
        elif flow.type == "messageFlow":
            yield _arrow(points, "blank")
            (x, y), (ux, uy) = points[0], _direction(points)
            yield element("circle", class_="blank", cx=x + 4 * ux, cy=y + 4 * uy, r=4.0,
                          stroke_width=1.4)  # fmt: skip
            if edge.message_visible:
                x, y = _along(points, 0.5)
                letter = Bounds(x - 15, y - 10, 30, 20)
                yield from envelope(*_corner_and_size(letter), filled=False,
                                     grey=edge.message_visible == "non_initiating")  # fmt: skip
        elif flow.type.startswith("data") or flow.direction in ("one", "both"):
            yield _open_arrow(points)
            if flow.direction == "both":
                yield _open_arrow(points[::-1])
        self._edge_label(flow, edge)

    def _flow_start(self, flow: Flow, points: Sequence[Point]) -> Iterator[SvgElement]:
        """Yield the stroke of a default flow or the diamond of a conditional one."""
        source = self.model.elements.get(flow.source)
        if source is None:
            return
        (x, y), (ux, uy) = points[0], _direction(points)
        if source.default == flow.id:
            at = (x + 10 * ux, y + 10 * uy)
            side = (ux * 0.5 - uy * 0.9, uy * 0.5 + ux * 0.9)
            ends = [(at[0] - 6 * side[0], at[1] - 6 * side[1]),
                    (at[0] + 6 * side[0], at[1] + 6 * side[1])]  # fmt: skip
            yield _path(ends, 1.5)
        elif flow.condition and source.type not in GATEWAYS:
            corners = [(x, y), (x + 8 * ux - 5 * uy, y + 8 * uy + 5 * ux),
                       (x + 16 * ux, y + 16 * uy),
                       (x + 8 * ux + 5 * uy, y + 8 * uy - 5 * ux)]  # fmt: skip
            yield element("polygon", class_="blank", points=_points(corners), stroke_width=1.4)

    # ------------------------------------------------------------------------------ labels

    def _label_below(self, own: Element, shape: Shape) -> None:
        """Place the name of an element that has no room for it inside."""
        text = own.name + (f" [{own.state}]" if own.state else "")
        box = shape.bounds
        candidates = [
            lambda w, h: Bounds(box.middle[0] - w / 2, box.y + box.height + 3, w, h),
            lambda w, h: Bounds(box.middle[0] - w / 2, box.y - h - 3, w, h),
            lambda w, h: Bounds(box.x + box.width + 4, box.y + box.height - 4, w, h),
            lambda w, h: Bounds(box.x - w - 4, box.y + box.height - 4, w, h),
            lambda w, h: Bounds(box.x + box.width + 4, box.y - h + 4, w, h),
        ]
        self._place(own.id, text, shape.label, candidates)

    def _edge_label(self, flow: Flow, edge: Edge) -> None:
        start, end = max(pairwise(edge.points), key=lambda pair: math.dist(*pair))
        x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
        (fx, fy), (ux, uy) = edge.points[0], _direction(edge.points)
        candidates = [
            lambda w, h: Bounds(fx + 20 * ux + 4, fy + (20 + h) * uy - h - 2, w, h),
            lambda w, h: Bounds(x - w / 2, y - h - 3, w, h),
            lambda w, h: Bounds(x + 5, y - h / 2, w, h),
            lambda w, h: Bounds(x - w / 2, y + 3, w, h),
            lambda w, h: Bounds(x - w - 5, y - h / 2, w, h),
        ]
        self._place(flow.id, flow.name, edge.label, candidates)

    def _place(
        self, own: str, text: str, label: Bounds | None, candidates: Sequence[_Candidate]
    ) -> None:
        """Write a label where the file says, or where it covers least."""
        if not text.strip():
            return
        if label is not None and label.width >= 1:
            place, lines = _in_label(text, label, label.width * 1.25 + 8)
            if any(_common(place, other) for other in self.label_boxes):
                place, lines = _in_label(text, label, label.width)
        else:
            lines = wrap_text(text, _LABEL_WIDTH, _LABEL)
            wide, high = max(width(t, _LABEL) for t in lines), len(lines) * _LABEL * _LINE
            places = [candidate(wide, high) for candidate in candidates]
            if len(self.label_boxes) < _MOST_PLACED:  # the search takes long in large diagrams
                place = min(places, key=lambda box: (self._covered(box), places.index(box)))
            else:
                place = places[0]
        self.label_boxes.append(place)
        texts = [
            _line_of(line, place.middle[0], place.y + _LABEL * (0.92 + _LINE * row), _LABEL, "halo")
            for row, line in enumerate(lines)
        ]
        self.labels.append(element("g", *texts, class_="label", data_bpmn_label=own))

    def _covered(self, box: Bounds) -> float:
        covered = sum(_common(box, other) for other in self.boxes)
        covered += 2 * sum(_common(box, other) for other in self.label_boxes)
        return covered + sum(40.0 for line in self.lines if _touches(box, line))

    def _text_at(self, text: str, label: Bounds | None, else_at: Bounds) -> Iterator[SvgElement]:
        room = label or else_at
        shown = fitted(text, max(room.width, 40.0), _LABEL)
        if shown:
            self.label_boxes.append(room)
            yield _line_of(shown, room.middle[0], room.y + _LABEL, _LABEL, "halo")


def _is_expanded(own: Element, shape: Shape) -> bool:
    is_sub = own.type in SUB_PROCESSES or own.type in ("subChoreography", "callActivity")
    return is_sub and bool(shape.expanded)


def _tooltip(own: Element) -> str:
    name = one_line(own.name or own.text)
    return f"{type_words(own.type)}: {name}" if name else type_words(own.type)


def _colours(shape: Shape) -> dict[str, str]:
    """Return the colours that the file gives a shape, as attributes."""
    given = {"fill": shape.fill, "stroke": shape.stroke}
    return {name: colour for name, colour in given.items() if colour}


def _corner_and_size(box: Bounds) -> tuple[float, float, float, float]:
    return box.x, box.y, box.width, box.height


def _rectangle(box: Bounds, radius: float, **attributes: str | float | None) -> SvgElement:
    return element("rect", x=box.x, y=box.y, width=box.width, height=box.height, rx=radius,
                   **attributes)  # fmt: skip


def _moved(x: float, y: float) -> str:
    return f"translate({number(x)} {number(y)})"


def _points(points: Sequence[Point]) -> str:
    return " ".join(f"{number(x)},{number(y)}" for x, y in points)


def _way(points: Sequence[Point]) -> str:
    return "M" + "L".join(f"{number(x)} {number(y)}" for x, y in points)


def _path(
    points: Sequence[Point], thick: float, *, dashes: str | None = None, stroke: str | None = None
) -> SvgElement:
    return element("path", class_="line", d=_way(points), stroke_width=thick,
                   stroke_dasharray=dashes, stroke=stroke)  # fmt: skip


def _direction(points: Sequence[Point]) -> Point:
    """Return the unit vector of the first part of a line that has a length."""
    for (x, y), (end_x, end_y) in pairwise(points):
        length = math.dist((x, y), (end_x, end_y))
        if length > 1e-6:
            return (end_x - x) / length, (end_y - y) / length
    return 1.0, 0.0


def _arrow_corners(points: Sequence[Point], long: float, half: float) -> list[Point]:
    (x, y), (ux, uy) = points[-1], _direction(points[::-1])
    foot = (x + long * ux, y + long * uy)
    return [(foot[0] - half * uy, foot[1] + half * ux), (x, y),
            (foot[0] + half * uy, foot[1] - half * ux)]  # fmt: skip


def _arrow(points: Sequence[Point], kind: str, colour: str | None = None) -> SvgElement:
    corners = _points(_arrow_corners(points, 10, 4.5))
    return element("polygon", class_=kind, points=corners, stroke_width=1.2, fill=colour,
                   stroke=colour)  # fmt: skip


def _open_arrow(points: Sequence[Point]) -> SvgElement:
    return _path(_arrow_corners(points, 9, 4.5), 1.4)


def _shortened(points: Sequence[Point], flow: Flow) -> list[Point]:
    """Return the line without its last bit, which is under the arrow."""
    if flow.type not in ("sequenceFlow", "messageFlow"):
        return list(points)
    (x, y), (ux, uy) = points[-1], _direction(points[::-1])
    by = min(8.0, math.dist(points[-1], points[-2]))
    return [*points[:-1], (x + by * ux, y + by * uy)]


def _along(points: Sequence[Point], share: float) -> Point:
    """Return the place at a share of the length of a line."""
    parts = list(pairwise(points))
    rest = share * sum(math.dist(*part) for part in parts)
    for start, end in parts:
        length = math.dist(start, end)
        if rest <= length and length:
            part = rest / length
            return start[0] + part * (end[0] - start[0]), start[1] + part * (end[1] - start[1])
        rest -= length
    return points[-1]


def _data_store(box: Bounds, colour: Mapping[str, str]) -> SvgElement:
    x, y, wide, high = _corner_and_size(box)
    cap = min(high / 5, 12.0)
    arc = f"A{number(wide / 2)} {number(cap)} 0 0"
    outline = (
        f"M{number(x)} {number(y + cap)}{arc} 1 {number(x + wide)} {number(y + cap)}"
        f"V{number(y + high - cap)}{arc} 1 {number(x)} {number(y + high - cap)}Z"
    )
    rings = "".join(
        f"M{number(x)} {number(y + cap + drop)}{arc} 0 {number(x + wide)} {number(y + cap + drop)}"
        for drop in (0.0, cap * 0.5, cap)
    )
    body = element("path", class_="body", d=outline, stroke_width=1.5, **colour)
    return group(body, element("path", class_="line", d=rings, stroke_width=1.3))


def _band_path(box: Bounds, radius: float, *, is_top: bool) -> str:
    """Return a rectangle whose upper or lower corners are round."""
    x, y, wide, high = _corner_and_size(box)
    r = min(radius, high, wide / 2)
    right, bottom = x + wide, y + high
    words: tuple[str | float, ...]
    if is_top:
        words = ("M", x, bottom, "V", y + r, "Q", x, y, x + r, y, "H", right - r, "Q", right, y,
                 right, y + r, "V", bottom, "Z")  # fmt: skip
    else:
        words = ("M", x, y, "H", right, "V", bottom - r, "Q", right, bottom, right - r, bottom,
                 "H", x + r, "Q", x, bottom, x, bottom - r, "Z")  # fmt: skip
    return " ".join(word if isinstance(word, str) else number(word) for word in words)


def _line_of(text: str, x: float, y: float, size: float, kind: str = "inside") -> SvgElement:
    return element("text", text, x=x, y=y, font_size=size, text_anchor="middle", class_=kind)


def _fitting(text: str, room: Bounds) -> tuple[float, list[str]]:
    """Return a size of letters and the lines of a text in a space; the last one may be cut."""
    for size in (_TEXT, 11.0, 10.0, 9.0):
        lines = [line for part in text.splitlines() for line in wrap_text(part, room.width, size)]
        if len(lines) * size * _LINE <= room.height + 2:
            return size, lines
    most = max(int(room.height / (9.0 * _LINE)), 1)
    return 9.0, [*lines[: most - 1], fitted(" ".join(lines[most - 1 :]), room.width, 9.0)]


def _centred(text: str, room: Bounds) -> Iterator[SvgElement]:
    if not text.strip():
        return
    size, lines = _fitting(text, room)
    top = room.y + (room.height - len(lines) * size * _LINE) / 2
    for row, line in enumerate(lines):
        yield _line_of(line, room.middle[0], top + size * (0.92 + _LINE * row), size)


def _upright(text: str, room: Bounds) -> Iterator[SvgElement]:
    """Yield a name that is read from bottom to top."""
    if not text.strip():
        return
    lines = wrap_text(text, max(room.height - 8, 20), _TEXT)
    lines = (
        lines if len(lines) <= 2 else [lines[0], fitted(" ".join(lines[1:]), room.height, _TEXT)]
    )
    x, y = room.middle
    texts = [
        _line_of(line, 0, _TEXT * (0.35 + _LINE * (row - (len(lines) - 1) / 2)), _TEXT)
        for row, line in enumerate(lines)
    ]
    yield element("g", *texts, transform=f"{_moved(x, y)} rotate(-90)")


def _in_label(text: str, label: Bounds, most: float) -> tuple[Bounds, list[str]]:
    """Return the space and the lines of a label at the place that the file gives it."""
    lines = wrap_text(text, max(most, 30.0), _LABEL)
    wide = max(width(line, _LABEL) for line in lines)
    place = Bounds(label.middle[0] - wide / 2, label.y, wide, len(lines) * _LABEL * _LINE)
    return place, lines


def _top_of(box: Bounds) -> Bounds:
    return Bounds(box.x, box.y + 3, box.width, 14)


def _is_in(inner: Bounds, outer: Bounds) -> bool:
    x, y = inner.middle
    return 0 <= x - outer.x <= outer.width and 0 <= y - outer.y <= outer.height


def _common(one: Bounds, other: Bounds) -> float:
    """Return the area that two rectangles have in common."""
    wide = min(one.x + one.width, other.x + other.width) - max(one.x, other.x)
    high = min(one.y + one.height, other.y + other.height) - max(one.y, other.y)
    return max(wide, 0.0) * max(high, 0.0)


def _touches(box: Bounds, line: Bounds) -> bool:
    """Return whether a part of a line, as the rectangle around it, crosses a rectangle."""
    apart_x = line.x > box.x + box.width or line.x + line.width < box.x
    apart_y = line.y > box.y + box.height or line.y + line.height < box.y
    return not (apart_x or apart_y)
