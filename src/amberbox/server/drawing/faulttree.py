"""Fault trees: unfolding, layout, and drawing with the usual symbols of gates and events."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from amberbox.core.svg import (
    SMALL,
    SvgElement,
    box,
    broken,
    classes,
    element,
    group,
    lettering,
    linked,
    root,
    title,
)
from amberbox.diagnosis.faulttree.tree import (
    BooleanConstant,
    FaultTree,
    Formula,
    GateOperation,
    Name,
)
from amberbox.server.drawing.symbols import DrawingTexts

# vote: k out of n; pass: a gate with a single input
GateKind: TypeAlias = Literal[
    "and", "or", "vote", "pass", "xor", "not", "nand", "nor", "iff", "imply", "cardinality"
]


@dataclass(frozen=True, slots=True)
class GateBox:
    """A gate with its inputs; ``k`` is the threshold of ``vote``."""

    id: str
    label: str
    kind: GateKind
    inputs: tuple[str, ...]
    k: int = 0
    probability: float | None = None
    href: str = ""


@dataclass(frozen=True, slots=True)
class EventBox:
    """A basic event; ``house`` events are switched on or off by hand."""

    id: str
    label: str
    probability: float | None = None
    kind: Literal["basic", "house", "undeveloped"] = "basic"
    href: str = ""


@dataclass(frozen=True, slots=True)
class TreeDrawing:
    """Gates and events by id; ``top`` is the id of the top gate."""

    top: str
    gates: Mapping[str, GateBox]
    events: Mapping[str, EventBox]


BranchKind: TypeAlias = Literal["gate", "event", "transfer", "cut"]


@dataclass(slots=True)
class TreeBranch:
    """A place in the drawing.

    ``transfer`` is a gate that is unfolded elsewhere, ``cut`` one that is not unfolded because of
    the limits.
    """

    id: str
    kind: BranchKind
    inputs: list[TreeBranch] = field(default_factory=list)

    def all(self) -> Iterator[TreeBranch]:
        """Yield the branch and all branches below it."""
        yield self
        for branch in self.inputs:
            yield from branch.all()


def unfold_tree(tree: TreeDrawing, depth: int, most: int) -> TreeBranch:
    """Return the top branch; each gate is unfolded where it occurs first, level by level.

    At most ``depth`` gates are above each other. When ``most`` places are taken, further gates are
    not unfolded. Raises KeyError for an unknown input.
    """
    top = TreeBranch(tree.top, "gate")
    taken, count = {tree.top}, 1 + len(tree.gates[tree.top].inputs)
    waiting = deque([(top, 1)])
    while waiting:
        branch, level = waiting.popleft()
        for name in tree.gates[branch.id].inputs:
            kind = _kind_of(tree, name, taken)
            more = len(tree.gates[name].inputs) if kind == "gate" else 0
            if kind == "gate" and (level >= depth or count + more > most):
                kind = "cut"
            below = TreeBranch(name, kind)
            branch.inputs.append(below)
            if kind == "gate":
                count += more
                taken.add(name)
                waiting.append((below, level + 1))
    return top


def _kind_of(tree: TreeDrawing, name: str, taken: Collection[str]) -> BranchKind:
    if name in tree.events:
        return "event"
    if name not in tree.gates:
        raise KeyError(name)
    return "transfer" if name in taken else "gate"


def count_below(tree: TreeDrawing, gate: str) -> int:
    """Return the number of different gates and events below a gate."""
    found: set[str] = set()
    waiting = [gate]
    while waiting:
        name = waiting.pop()
        inputs = tree.gates[name].inputs if name in tree.gates else ()
        new = [name for name in dict.fromkeys(inputs) if name not in found]
        found.update(new)
        waiting += new
    return len(found - {gate})


# Whether a gate is true, by its true inputs, all inputs and k; other kinds count as false
_HOLDS: Mapping[str, Callable[[int, int, int], bool]] = {
    "and": lambda true, count, k: true == count,
    "or": lambda true, count, k: true > 0,
    "pass": lambda true, count, k: true > 0,
    "vote": lambda true, count, k: true >= k,
    "xor": lambda true, count, k: true % 2 == 1,
    "not": lambda true, count, k: true == 0,
    "nor": lambda true, count, k: true == 0,
    "nand": lambda true, count, k: true < count,
    "iff": lambda true, count, k: true in (0, count),
}


def true_in_cut_set(tree: TreeDrawing, events: Collection[str]) -> set[str]:
    """Return the events and gates that are true when exactly these events occur."""
    found: dict[str, bool] = {name: name in set(events) for name in tree.events}
    waiting = [tree.top]
    while waiting:
        gate = tree.gates[waiting[-1]]
        open_ = [name for name in gate.inputs if name not in found]
        if open_:
            waiting += open_
            continue
        true = sum(found[name] for name in gate.inputs)
        holds = _HOLDS.get(gate.kind)
        found[gate.id] = holds is not None and holds(true, len(gate.inputs), gate.k)
        waiting.pop()
    return {name for name, holds in found.items() if holds}


def tree_drawing(tree: FaultTree) -> TreeDrawing:
    """Return a fault tree of the diagnosis as a drawing.

    Nested formulas become gates without a label. Gates that can never be true are left out of OR
    gates.
    """
    never = {name for name, gate in tree.gates.items() if gate.formula == BooleanConstant(False)}
    gates: dict[str, GateBox] = {}
    events = {
        name: EventBox(name, event.label or name, event.probability)
        for name, event in tree.events.items()
    }
    events |= {name: EventBox(name, name, float(on), "house") for name, on in tree.houses.items()}
    for name, gate in tree.gates.items():
        _add(name, gate.label or name, gate.formula, never, gates, events)
    return TreeDrawing(tree.top, gates, events)


def _add(
    name: str, label: str, formula: Formula, never: Collection[str], gates: dict[str, GateBox],
    events: dict[str, EventBox],
) -> None:  # fmt: skip
    """Add the gate of a formula, and gates for the formulas inside it."""
    if isinstance(formula, BooleanConstant):
        inputs: Sequence[Formula] = (formula,)
        kind, k = "or", 0
    elif isinstance(formula, Name):
        inputs, kind, k = (formula,), "or", 0
    else:
        inputs, kind, k = _possible(formula, never), formula.operator, formula.at_least
    names = []
    for place, part in enumerate(inputs):
        inner = part.name if isinstance(part, Name) else f"{name}/{place + 1}"
        names.append(inner)
        if isinstance(part, BooleanConstant):
            events[inner] = EventBox(inner, "", float(part.value), "house")
        elif isinstance(part, GateOperation):
            _add(inner, "", part, never, gates, events)
    gates[name] = GateBox(name, label, _kind(kind, len(names)), tuple(names), k)


def _possible(formula: GateOperation, never: Collection[str]) -> Sequence[Formula]:
    """Return the inputs of a formula, for OR without those that are never true."""
    if formula.operator != "or":
        return formula.inputs
    kept = [part for part in formula.inputs if not isinstance(part, Name) or part.name not in never]
    return kept or formula.inputs


def _kind(operator: str, inputs: int) -> GateKind:
    if inputs == 1 and operator in ("and", "or"):
        return "pass"
    kinds: dict[str, GateKind] = {
        "and": "and", "or": "or", "atleast": "vote", "xor": "xor", "not": "not", "nand": "nand",
        "nor": "nor", "iff": "iff", "imply": "imply", "cardinality": "cardinality",
    }  # fmt: skip
    return kinds[operator]


GATE = (204.0, 94.0)  # width and height of a gate: text and symbol
LEAF = (150.0, 126.0)
ROW = (330.0, 68.0)
APART = 24.0
DROP = 38.0  # distance from a gate down to its inputs
SIDE_BY_SIDE = 3  # leaves side by side; more are put into a column
TRUNK = 26.0  # distance of a column's symbols from its vertical line

Point = tuple[float, float]
Style: TypeAlias = Literal["gate", "leaf", "row"]


@dataclass(frozen=True, slots=True)
class PlacedBranch:
    """A branch and its position: the middle of its upper edge, for a row its left end."""

    branch: TreeBranch
    style: Style
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class TreeWire:
    """A line from a gate down to one of its inputs."""

    start: str
    branch: TreeBranch
    points: tuple[Point, ...]


@dataclass(frozen=True, slots=True)
class TreeBlock:
    """A part of the drawing: its size, its content, and where lines from above enter."""

    width: float
    height: float
    anchor: float
    items: tuple[PlacedBranch, ...]
    wires: tuple[TreeWire, ...]
    entries: tuple[tuple[TreeBranch, tuple[Point, ...]], ...]


def layout_branch(branch: TreeBranch) -> TreeBlock:
    """Return the layout of a branch and everything below it."""
    if branch.kind != "gate":
        item = PlacedBranch(branch, "leaf", LEAF[0] / 2, 0)
        return TreeBlock(*LEAF, LEAF[0] / 2, (item,), (), ((branch, ((LEAF[0] / 2, 0),)),))
    return _over(branch, _parts(branch))


def _parts(branch: TreeBranch) -> list[TreeBlock]:
    """Return the blocks of the inputs: gates first, then the leaves."""
    gates = [below for below in branch.inputs if below.kind == "gate"]
    leaves = [below for below in branch.inputs if below.kind != "gate"]
    most = 1 if gates else SIDE_BY_SIDE
    blocks = [layout_branch(below) for below in gates]
    if len(leaves) > most:
        return [*blocks, _column(leaves)]
    return [*blocks, *(layout_branch(below) for below in leaves)]


def _column(leaves: Sequence[TreeBranch]) -> TreeBlock:
    """Return leaves one below the other, beside a vertical line."""
    anchor = 8.0
    items, entries = [], []
    for place, branch in enumerate(leaves):
        y = ROW[1] * place + ROW[1] / 2
        items.append(PlacedBranch(branch, "row", anchor + TRUNK, y))
        entries.append((branch, ((anchor, 0.0), (anchor, y), (anchor + TRUNK, y))))
    return TreeBlock(ROW[0], ROW[1] * len(leaves), anchor, tuple(items), (), tuple(entries))


def _over(branch: TreeBranch, blocks: Sequence[TreeBlock]) -> TreeBlock:
    """Return a gate above the middle of its inputs, which are side by side."""
    lefts = _lefts(blocks)
    anchors = [left + block.anchor for left, block in zip(lefts, blocks, strict=True)]
    middle = (anchors[0] + anchors[-1]) / 2 if anchors else 0.0
    shift = max(0.0, GATE[0] / 2 - middle)
    middle += shift
    top = GATE[1] + DROP
    moved = [_moved(b, left + shift, top) for left, b in zip(lefts, blocks, strict=True)]
    wires = [
        TreeWire(branch.id, below, ((middle, GATE[1]), *points))
        for block in moved
        for below, points in block.entries
    ]
    right = max((left + shift + b.width for left, b in zip(lefts, blocks, strict=True)), default=0)
    return TreeBlock(
        max(right, middle + GATE[0] / 2),
        max((top + block.height for block in blocks), default=GATE[1]),
        middle,
        (
            PlacedBranch(branch, "gate", middle, 0),
            *(item for block in moved for item in block.items),
        ),
        (*wires, *(wire for block in moved for wire in block.wires)),
        ((branch, ((middle, 0.0),)),),
    )


def _lefts(blocks: Sequence[TreeBlock]) -> list[float]:
    lefts, x = [], 0.0
    for block in blocks:
        lefts.append(x)
        x += block.width + APART
    return lefts


def _moved(block: TreeBlock, x: float, y: float) -> TreeBlock:
    """Return a block whose positions are moved; its anchor and size stay."""

    def along(points: Sequence[Point]) -> tuple[Point, ...]:
        return tuple((px + x, py + y) for px, py in points)

    return replace(
        block,
        items=tuple(replace(item, x=item.x + x, y=item.y + y) for item in block.items),
        wires=tuple(replace(wire, points=along(wire.points)) for wire in block.wires),
        entries=tuple((branch, along(points)) for branch, points in block.entries),
    )


def elbow(points: Sequence[Point], radius: float = 7) -> str:
    """Return the SVG path of a line with round corners: down, across, down to each point."""
    (x, y), (end_x, end_y), *rest = points
    bus = y + DROP / 2
    corners = [(x, y), (x, bus), (end_x, bus), (end_x, end_y), *rest]
    if abs(x - end_x) < 1:
        corners = [(end_x, y), (end_x, end_y), *rest]
    merged = [p for place, p in enumerate(corners) if place == 0 or p != corners[place - 1]]
    return _rounded([p for place, p in enumerate(merged) if not _straight(merged, place)], radius)


def _straight(points: Sequence[Point], place: int) -> bool:
    """Return whether a point is on the straight line between its neighbours."""
    if not 0 < place < len(points) - 1:
        return False
    (ax, ay), (bx, by), (cx, cy) = points[place - 1 : place + 2]
    return ax == bx == cx or ay == by == cy


def _rounded(points: Sequence[Point], radius: float) -> str:
    steps = [f"M{points[0][0]:.1f} {points[0][1]:.1f}"]
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        start, end = _short(corner, before, radius), _short(corner, after, radius)
        steps.append(f"L{start[0]:.1f} {start[1]:.1f}")
        steps.append(f"Q{corner[0]:.1f} {corner[1]:.1f} {end[0]:.1f} {end[1]:.1f}")
    return "".join([*steps, f"L{points[-1][0]:.1f} {points[-1][1]:.1f}"])


def _short(corner: Point, other: Point, radius: float) -> Point:
    """Return the point at which the rounding of a corner begins, towards another point."""
    dx, dy = other[0] - corner[0], other[1] - corner[1]
    far = max(abs(dx), abs(dy)) or 1.0
    part = min(radius, far / 2) / far
    return corner[0] + dx * part, corner[1] + dy * part


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def probability_text(probability: float | None) -> str:
    """Return a probability with two digits: ``0.013``, ``5.8·10⁻⁶``; empty if unknown."""
    if probability is None:
        return ""
    if probability >= 0.001 or not probability:
        return f"{probability:.2g}"
    digits, power = f"{probability:.1e}".split("e")
    return f"{digits}·10{str(int(power)).translate(_RAISED)}"


MARGIN = 14.0
BOX = 50.0  # height of a gate's text, above its symbol

_OR = "M0 0C10 4 16 15 16 32C8 26-8 26-16 32C-16 15-10 4 0 0z"
_AND = "M-16 31V15a16 15 0 0 1 32 0V31z"
_SYMBOLS: Mapping[str, str] = {
    "and": _AND,
    "or": _OR,
    "vote": _OR,
    "xor": _OR,
    "nand": _AND,
    "nor": _OR,
    "not": "M0 2L15 31H-15z",
}
_SQUARE = "M-16 2h32v28h-32z"
_NEGATED = ("nand", "nor", "not")


@dataclass(frozen=True, slots=True)
class _Scene:
    """The tree, the true gates and events, and the texts of a drawing."""

    tree: TreeDrawing
    holds: Collection[str]
    words: DrawingTexts


def fault_tree(
    tree: TreeDrawing,
    *,
    label: str,
    cut_set: Collection[str] = (),
    depth: int = 5,
    most: int = 150,
    words: DrawingTexts,
) -> SvgElement:
    """Draw a fault tree top down; the paths of a cut set to the top are highlighted.

    A gate with several parents is unfolded once and drawn as a triangle elsewhere. Gates below
    ``depth`` or beyond ``most`` places are triangles with the number of gates and events below
    them. Raises KeyError for an unknown input.
    """
    scene = _Scene(tree, true_in_cut_set(tree, cut_set) if cut_set else frozenset(), words)
    block = layout_branch(unfold_tree(tree, depth, most))
    wires = [_wire(wire, scene) for wire in block.wires]
    wires.sort(key=lambda wire: "strong" in wire.get("class").split())
    parts = group(*wires, *(_item(item, scene) for item in block.items), at=(MARGIN, MARGIN))
    size = (block.width + 2 * MARGIN, block.height + 2 * MARGIN)
    return root(classes("faulttree", "chosen" if cut_set else ""), size, label, (parts,))


def _wire(wire: TreeWire, scene: _Scene) -> SvgElement:
    strong = wire.start in scene.holds and wire.branch.id in scene.holds
    return element(
        "path",
        class_=classes("line edge", "strong" if strong else ""),
        d=elbow(wire.points),
        data_start=wire.start,
        data_end=wire.branch.id,
    )


def _item(item: PlacedBranch, scene: _Scene) -> SvgElement:
    if item.style == "gate":
        return _gate(item, scene.tree.gates[item.branch.id], scene)
    if item.branch.kind == "event":
        event = scene.tree.events[item.branch.id]
        cut = item.branch.id in scene.holds
        about = [event.label, event.id, probability_text(event.probability)]
        below = probability_text(event.probability)
        if cut:
            about.append(scene.words.in_cut_set)
        return _leaf(item, event.kind, event, about, below, strong=cut)
    gate = scene.tree.gates[item.branch.id]
    below = scene.words.transfer
    if item.branch.kind == "cut":
        below = scene.words.below.format(n=count_below(scene.tree, gate.id))
    about = [gate.label, gate.id, below]
    return _leaf(item, "transfer", gate, about, below, strong=gate.id in scene.holds)


def _gate(item: PlacedBranch, gate: GateBox, scene: _Scene) -> SvgElement:
    strong = gate.id in scene.holds
    number = probability_text(gate.probability)
    kind = _gate_word(gate, scene.words)
    about = [part for part in (gate.label, gate.id, kind, number) if part]
    card = group(
        title(". ".join(dict.fromkeys(about))),
        *_plate(gate),
        *_symbol(gate),
        element("text", kind, x=24, y=BOX + 29, class_="small") if kind else None,
        element("text", number, x=-24, y=BOX + 29, class_="small end") if number else None,
        at=(item.x, item.y),
        class_=classes("gate", gate.kind, "strong" if strong else ""),
        data_id=gate.id,
    )
    return linked(gate.href, card)


def _plate(gate: GateBox) -> Iterator[SvgElement]:
    """Yield the box with the text of a gate, or a line for a gate without a text."""
    if not gate.label:
        yield element("path", class_="line", d=f"M0 0V{BOX:g}")
        return
    lines = broken(gate.label, GATE[0] - 16, 2)
    yield box(-GATE[0] / 2, 0, (GATE[0], BOX), 6, class_="box")
    for place, line in enumerate(lines):
        y = BOX / 2 + 4.5 + 17 * (place - (len(lines) - 1) / 2)
        yield element("text", line, x=0, y=y, class_="middle")


def _symbol(gate: GateBox) -> Iterator[SvgElement]:
    if gate.kind == "pass":
        yield element("path", class_="line", d=f"M0 {BOX:g}V{GATE[1]:g}")
        return
    yield element("path", class_="line", d=f"M0 {BOX:g}V{BOX + 10:g}M0 {BOX + 34:g}V{GATE[1]:g}")
    parts = [element("path", class_="symbol", d=_SYMBOLS.get(gate.kind, _SQUARE))]
    if gate.kind in _NEGATED:
        parts.append(element("circle", class_="symbol", cx=0, cy=-1, r=3.5))
    if gate.kind == "xor":
        parts.append(element("path", class_="line", d="M-16 36C-8 30 8 30 16 36"))
    if gate.kind == "vote":
        parts.append(
            element("text", f"{gate.k}/{len(gate.inputs)}", x=0, y=23, class_="vote-count")
        )
    yield group(*parts, at=(0, BOX + 8))


def _gate_word(gate: GateBox, words: DrawingTexts) -> str:
    known = {
        "and": words.gate_and,
        "or": words.gate_or,
        "vote": words.gate_vote.format(k=gate.k, n=len(gate.inputs)),
        "pass": "",
        "xor": words.gate_xor,
        "not": words.gate_not,
        "nand": words.gate_nand,
        "nor": words.gate_nor,
    }
    return known.get(gate.kind, gate.kind)


def _leaf(
    item: PlacedBranch,
    sign: str,
    of: GateBox | EventBox,
    about: list[str],
    small: str,
    *,
    strong: bool,
) -> SvgElement:
    row = item.style == "row"
    text = of.label or of.id
    inside = _beside_sign(text, small) if row else _below_sign(text, small)
    leaf = group(
        title(". ".join(dict.fromkeys(part for part in about if part))),
        _sign(sign, row=row),
        *inside,
        at=(item.x, item.y),
        class_=classes("leaf", sign, "strong" if strong else ""),
        data_id=of.id,
    )
    return linked(of.href, leaf)


def _beside_sign(text: str, small: str) -> Iterator[SvgElement]:
    left, most = 34.0, ROW[0] - TRUNK - 8 - 34
    lines = broken(text, most, 3)
    first = 4.5 - 8 * (len(lines) - 1) - (5.5 if small else 0)
    for place, line in enumerate(lines):
        yield element("text", line, x=left, y=first + 16 * place)
    if small:
        yield lettering(small, (left, first + 16 * len(lines) - 2), most, SMALL, class_="small")


def _below_sign(text: str, small: str) -> Iterator[SvgElement]:
    lines = broken(text, LEAF[0] - 6, 4)
    for place, line in enumerate(lines):
        yield element("text", line, x=0, y=50 + 16 * place, class_="middle")
    if small:
        y = 50 + 16 * len(lines) - 1
        yield element("text", small, x=0, y=y, class_="small middle")


def _sign(sign: str, *, row: bool) -> SvgElement:
    """Return the symbol of a leaf: beside the line in a row, else below it."""
    middle, size = ((12.0, 0.0), 11.0) if row else ((0.0, 16.0), 16.0)
    x, y = middle
    if sign == "basic":
        return element("circle", class_="symbol", cx=x, cy=y, r=size)
    return element("path", class_="symbol", d=_outline(sign, x, y, size))


def _outline(sign: str, x: float, y: float, size: float) -> str:
    """Return the path of a triangle (transfer), a house, or a diamond (undeveloped)."""
    corners = {
        "transfer": ((0, -1), (1, 0.9), (-1, 0.9)),
        "house": ((0, -1), (1, -0.3), (1, 1), (-1, 1), (-1, -0.3)),
        "undeveloped": ((0, -1), (1, 0), (0, 1), (-1, 0)),
    }[sign]
    points = (f"{x + size * dx:.1f} {y + size * dy:.1f}" for dx, dy in corners)
    return f"M{'L'.join(points)}z"
