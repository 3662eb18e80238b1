"""A layout for BPMN files without one: columns from left to right, rows of lanes below each other.

Lines are horizontal and vertical. Those that do not lead to the next column run in gaps below the
rows and between the columns, each in a track of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.layered_layout import backward, ranks
from amberbox.core.svg import wrap_text
from amberbox.experiments.bpmn import (
    ARTIFACTS,
    CONVERSATIONS,
    DATA,
    EVENTS,
    FLOW_NODES,
    GATEWAYS,
    SUB_PROCESSES,
    Bounds,
    BpmnModel,
    Diagram,
    Edge,
    Element,
    Flow,
    Shape,
)

_TASK = (130.0, 74.0)
_EVENT = 36.0
_GATEWAY = 50.0
_BAND = 30.0
_COLUMN_GAP = 44.0
_ROW_GAP = 26.0
_TRACK = 12.0
_PAD = 20.0
_NAME_LINE = 13.0  # height of a line of a name below an event or a gateway
_NAME_WIDTH = 92.0
_POOL_GAP = 50.0


def laid_out(model: BpmnModel) -> Diagram:
    """Return a diagram of all processes of a file, pool below pool."""
    shapes: list[Shape] = []
    edges: list[Edge] = []
    pools = {e.process: e for e in model.of_type("participant") if e.process}
    y = 0.0
    for process in model.of_type("process", "collaboration", "choreography"):
        if not any(e.type in FLOW_NODES | CONVERSATIONS for e in model.children(process.id)):
            continue
        block = _Block(model, process.id)
        block.place()
        pool = pools.get(process.id)
        framed = block.framed(pool)
        shapes += (replace(s, bounds=_shifted(s.bounds, 0, y)) for s in framed.shapes)
        edges += (replace(e, points=_shifted_points(e.points, 0, y)) for e in framed.edges)
        y += framed.height + _POOL_GAP
    wide = max((s.bounds.x + s.bounds.width for s in shapes), default=600.0)
    for pool in model.of_type("participant"):
        if pool.id not in {s.element for s in shapes}:  # its process is not in the file
            shapes.append(Shape(pool.id, Bounds(0, y, wide, 60), horizontal=True))
            y += 60 + _POOL_GAP
    places = {shape.element: shape.bounds for shape in shapes}
    for flow in model.flows.values():
        ends = [places.get(end) for end in (flow.source, flow.target)]
        start, end = ends
        if flow.type != "sequenceFlow" and start is not None and end is not None:
            edges.append(Edge(flow.id, _between(start, end)))
    return Diagram("", "", tuple(shapes), tuple(edges))


@dataclass
class _Framed:
    shapes: list[Shape]
    edges: list[Edge]
    height: float


@dataclass
class _Route:
    """A flow through the grid: its tracks in the channels and in the gap below a row."""

    flow: Flow
    start: str  # the node it leaves, or the activity whose border event it leaves
    end: str
    kind: str = "straight"  # straight, step, corner or bus
    row: int = 0  # gap of a bus
    track: int = 0
    out_track: int = 0
    in_track: int = 0


@dataclass
class _Block:
    """The nodes of a process or a sub-process in columns and rows."""

    model: BpmnModel
    scope: str
    nodes: list[Element] = field(default_factory=list)
    sizes: dict[str, tuple[float, float]] = field(default_factory=dict)
    inner: dict[str, _Block] = field(default_factory=dict)
    column: dict[str, int] = field(default_factory=dict)
    row: dict[str, int] = field(default_factory=dict)
    lane_rows: list[tuple[Element | None, int, int]] = field(default_factory=list)
    boxes: dict[str, Bounds] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    row_tops: list[float] = field(default_factory=list)
    row_ends: list[float] = field(default_factory=list)
    channels: dict[int, int] = field(default_factory=dict)
    gaps: dict[int, int] = field(default_factory=dict)
    channel_ends: list[float] = field(default_factory=list)
    bus_tops: list[float] = field(default_factory=list)
    width: float = 0.0
    height: float = 0.0

    def place(self) -> None:
        """Find the bounds of all nodes and the points of all flows, from the corner (0, 0)."""
        every = [e for e in self.model.children(self.scope) if e.type in FLOW_NODES | CONVERSATIONS]
        self.nodes = [e for e in every if e.type != "boundaryEvent"]
        for node in self.nodes:
            self.sizes[node.id] = self._size(node)
        routes = self._routes()
        self._columns(routes)
        self._rows(routes)
        self._choose(routes)
        self._measure()
        for route in routes:
            self.edges.append(Edge(route.flow.id, tuple(self._points(route))))

    def framed(self, pool: Element | None) -> _Framed:
        """Return its shapes and edges with the frames of pool and lanes around them."""
        left = _BAND if pool is not None else 0.0
        lanes = [lane for lane, _, _ in self.lane_rows if lane is not None]
        inner = left + (_BAND if lanes else 0.0)
        shapes: list[Shape] = []
        wide = inner + self.width
        if pool is not None:
            shapes.append(Shape(pool.id, Bounds(0, 0, wide, self.height), horizontal=True))
        for lane, first, last in self.lane_rows:
            if lane is not None:
                top, end = self.row_tops[first], self.row_ends[last]
                bounds = Bounds(left, top, wide - left, end - top)
                shapes.append(Shape(lane.id, bounds, horizontal=True))
        shapes += (replace(s, bounds=_shifted(s.bounds, inner, 0)) for s in self.shapes())
        edges = [replace(e, points=_shifted_points(e.points, inner, 0)) for e in self.all_edges()]
        height = self.height
        loose = [e for e in self.model.children(self.scope) if e.type in DATA | ARTIFACTS]
        x = inner
        for part in loose:
            if part.type == "dataObject":
                continue  # its references are drawn
            size = (140.0, 54.0) if part.type in ARTIFACTS else (36.0, 50.0)
            shapes.append(Shape(part.id, Bounds(x, self.height + 24, *size)))
            x, height = x + size[0] + 60, self.height + 24 + size[1] + 30
        return _Framed(shapes, edges, height)

    def shapes(self) -> Iterable[Shape]:
        """Yield the shapes of all nodes, with what is inside and on the border of them."""
        for node in self.nodes:
            box = self.boxes[node.id]
            inside = self.inner.get(node.id)
            yield Shape(node.id, box, expanded=inside is not None, marker=True)
            if inside is not None:
                for shape in inside.shapes():
                    at = _shifted(shape.bounds, box.x + _PAD / 2, box.y + _PAD)
                    yield replace(shape, bounds=at)
            for event in self.model.boundary(node.id):
                yield Shape(event.id, self._border(event))

    def all_edges(self) -> Iterable[Edge]:
        """Yield the lines, with those inside of sub-processes."""
        yield from self.edges
        for own, block in self.inner.items():
            box = self.boxes[own]
            for edge in block.all_edges():
                points = _shifted_points(edge.points, box.x + _PAD / 2, box.y + _PAD)
                yield replace(edge, points=points)

    # -------------------------------------------------------------------------- the grid

    def _size(self, node: Element) -> tuple[float, float]:
        if node.type in EVENTS:
            return _EVENT, _EVENT
        if node.type in GATEWAYS:
            return _GATEWAY, _GATEWAY
        if node.type in SUB_PROCESSES and self.model.children(node.id):
            block = self.inner[node.id] = _Block(self.model, node.id)
            block.place()
            return max(block.width + _PAD, _TASK[0]), max(block.height + 1.5 * _PAD, _TASK[1])
        lines = len(wrap_text(node.name, _TASK[0] - 12, 12.0))
        return _TASK[0], max(_TASK[1], lines * 14.5 + 34)

    def _routes(self) -> list[_Route]:
        known = {node.id for node in self.nodes}
        routes = []
        for flow in self.model.flows.values():
            if flow.type != "sequenceFlow" or flow.target not in known:
                continue
            start = self.model.elements[flow.source]
            begin = start.attached_to if start.type == "boundaryEvent" else start.id
            if begin in known:
                routes.append(_Route(flow, begin, flow.target))
        return routes

    def _columns(self, routes: Sequence[_Route]) -> None:
        numbers = {node.id: place for place, node in enumerate(self.nodes)}
        links = [(numbers[route.start], numbers[route.end]) for route in routes]
        back = backward(len(self.nodes), links)
        ahead = dict.fromkeys(link for place, link in enumerate(links) if place not in back)
        first = [numbers[node.id] for node in self.nodes if node.type == "startEvent"]
        found = ranks(len(self.nodes), [link for link in ahead if link[0] != link[1]], first)
        self.column = {node.id: found[numbers[node.id]] for node in self.nodes}

    def _rows(self, routes: Sequence[_Route]) -> None:
        """Give each node a row of its lane: that of the node before it, if it is free."""
        lanes = self._lanes()
        before: dict[str, list[str]] = {}
        for route in routes:
            before.setdefault(route.end, []).append(route.start)
        row_in_lane: dict[str, int] = {}
        lane_of: dict[str, int] = {}
        taken: set[tuple[int, int, int]] = set()
        for node in sorted(self.nodes, key=lambda node: self.column[node.id]):
            lane = lanes.index(node.lane) if node.lane in lanes else 0
            mine = [row_in_lane[own] for own in before.get(node.id, ())
                    if own in row_in_lane and lane_of[own] == lane]  # fmt: skip
            row = min(mine, default=0)
            while (lane, row, self.column[node.id]) in taken:
                row += 1
            taken.add((lane, row, self.column[node.id]))
            row_in_lane[node.id], lane_of[node.id] = row, lane
        total = 0
        for place, lane_id in enumerate(lanes):
            rows = [row_in_lane[own] for own in row_in_lane if lane_of[own] == place]
            count = max(rows, default=0) + 1
            lane_element = self.model.elements.get(lane_id)
            self.lane_rows.append((lane_element, total, total + count - 1))
            for own in row_in_lane:
                if lane_of[own] == place:
                    self.row[own] = total + row_in_lane[own]
            total += count

    def _lanes(self) -> list[str]:
        """Return the innermost lanes from top to bottom; one without a name if there are none."""
        lanes = [e for e in self.model.of_type("lane") if self._is_ours(e)]
        parents = {lane.parent for lane in lanes}
        found = [lane.id for lane in lanes if lane.id not in parents]
        return found or [""]

    def _is_ours(self, lane: Element) -> bool:
        here = lane
        while here.type == "lane":
            if here.parent == self.scope:
                return True
            here = self.model.elements[here.parent]
        return False

    def _choose(self, routes: Sequence[_Route]) -> None:
        """Choose how each flow is drawn, and give it its tracks."""
        cells = {(self.row[node.id], self.column[node.id]) for node in self.nodes}
        channels, gaps = self.channels, self.gaps
        shared: dict[tuple[int, str], tuple[int, int]] = {}
        for route in routes:
            start, end = route.start, route.end
            source = self.model.elements[route.flow.source]
            on_border = source.type == "boundaryEvent"
            (row, column), (to_row, to) = (
                (self.row[own], self.column[own]) for own in (start, end)
            )
            between = range(column + 1, to)
            across = range(min(row, to_row), max(row, to_row) + 1)
            if not on_border and row == to_row and to > column and not any(
                (row, c) in cells for c in between
            ):  # fmt: skip
                route.kind = "straight"
            elif (not on_border and source.type in GATEWAYS and row != to_row and to > column
                  and not any((r, column) in cells for r in across if r != row)
                  and not any((to_row, c) in cells for c in between)):  # fmt: skip
                route.kind = "corner"
            elif not on_border and to > column and not any((row, c) in cells for c in between):
                route.kind = "step"
                route.in_track = channels[to] = channels.get(to, 0) + 1
            else:
                route.kind, route.row = "bus", row
                if (row, end) not in shared:  # lines to one node join
                    gaps[row] = gaps.get(row, 0) + 1
                    channels[to] = channels.get(to, 0) + 1
                    shared[row, end] = gaps[row], channels[to]
                route.track, route.in_track = shared[row, end]
                if not on_border and source.type not in GATEWAYS:
                    route.out_track = channels[column + 1] = channels.get(column + 1, 0) + 1

    def _measure(self) -> None:
        columns = max(self.column.values(), default=-1) + 1
        rows = max((last for _, _, last in self.lane_rows), default=-1) + 1
        x = 0.0
        middles = []
        for column in range(columns + 1):
            x += _COLUMN_GAP + _TRACK * self.channels.get(column, 0)
            self.channel_ends.append(x)
            mine = [self.sizes[n.id][0] for n in self.nodes if self.column[n.id] == column]
            middles.append(x + max(mine, default=0.0) / 2)
            x += max(mine, default=0.0)
        self.width = x
        y = 0.0
        row_middles = []
        for row in range(rows):
            self.row_tops.append(y)
            mine_nodes = [n for n in self.nodes if self.row[n.id] == row]
            high = max((self.sizes[n.id][1] for n in mine_nodes), default=_EVENT)
            row_middles.append(y + _ROW_GAP + high / 2)
            names = max((self._name_below(n, high) for n in mine_nodes), default=0.0)
            y += _ROW_GAP + high + names
            self.bus_tops.append(y)
            y += _ROW_GAP / 2 + _TRACK * self.gaps.get(row, 0)
            self.row_ends.append(y)
        self.height = y
        for node in self.nodes:
            wide, high = self.sizes[node.id]
            at = (
                middles[self.column[node.id]] - wide / 2,
                row_middles[self.row[node.id]] - high / 2,
            )
            self.boxes[node.id] = Bounds(*at, wide, high)

    def _name_below(self, node: Element, row_height: float) -> float:
        """Return how far below its row the names of a node and of the events on it reach."""
        room = (row_height - self.sizes[node.id][1]) / 2
        below = self.model.boundary(node.id)
        if below:
            lines = max(len(wrap_text(e.name, _NAME_WIDTH, 11.0)) if e.name else 0 for e in below)
            return _EVENT / 2 + 4 + lines * _NAME_LINE - room
        if node.type not in EVENTS | GATEWAYS or not node.name:
            return 0.0
        return 4 + len(wrap_text(node.name, _NAME_WIDTH, 11.0)) * _NAME_LINE - room

    def _border(self, event: Element) -> Bounds:
        """Return where an event on the border of an activity is: from the right, at the bottom."""
        box = self.boxes[event.attached_to]
        place = [e.id for e in self.model.boundary(event.attached_to)].index(event.id)
        return Bounds(box.x + box.width - _EVENT - 6 - place * (_EVENT + 8),
                      box.y + box.height - _EVENT / 2, _EVENT, _EVENT)  # fmt: skip

    # ------------------------------------------------------------------------- the lines

    def _points(self, route: _Route) -> list[tuple[float, float]]:
        source, target = self.boxes[route.start], self.boxes[route.end]
        right, middle = source.x + source.width, source.middle[1]
        into = (target.x, target.middle[1])
        column, to = self.column[route.start], self.column[route.end]
        if route.kind == "straight":
            return [(right, middle), into]
        if route.kind == "corner":
            x = source.middle[0]
            edge = source.y + source.height if into[1] > middle else source.y
            return [(x, edge), (x, into[1]), into]
        in_x = self.channel_ends[to] - 14 - _TRACK * (route.in_track - 1)
        if route.kind == "step":
            return [(right, middle), (in_x, middle), (in_x, into[1]), into]
        bus = self.bus_tops[route.row] + _TRACK * (route.track - 0.5)
        element = self.model.elements[route.flow.source]
        if element.type == "boundaryEvent":
            box = self._border(element)
            begin = [(box.middle[0], box.y + box.height)]
            out_x = box.middle[0]
        elif element.type in GATEWAYS:
            out_x = source.middle[0]
            begin = [(out_x, source.y + source.height)]
        else:
            out_x = self.channel_ends[column + 1] - 14 - _TRACK * (route.out_track - 1)
            begin = [(right, middle), (out_x, middle)]
        return [*begin, (out_x, bus), (in_x, bus), (in_x, into[1]), into]


def _shifted(box: Bounds, x: float, y: float) -> Bounds:
    return replace(box, x=box.x + x, y=box.y + y)


def _shifted_points(
    points: Sequence[tuple[float, float]], x: float, y: float
) -> tuple[tuple[float, float], ...]:
    return tuple((px + x, py + y) for px, py in points)


def _between(start: Bounds, end: Bounds) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a line from the border of one box to that of another, up or down."""
    if start.middle[1] <= end.middle[1]:
        return (start.middle[0], start.y + start.height), (end.middle[0], end.y)
    return (start.middle[0], start.y), (end.middle[0], end.y + end.height)
