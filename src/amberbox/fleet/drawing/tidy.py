"""Layout of a fault tree: gates side by side above each other, many leaves as a column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from amberbox.fleet.drawing.branches import Branch

GATE = (204.0, 94.0)
"""How much room a gate takes: its text and its symbol."""
LEAF = (150.0, 126.0)
ROW = (330.0, 68.0)
APART = 24.0
DROP = 38.0
"""How far below a gate its inputs begin."""
SIDE_BY_SIDE = 3
"""How many leaves stand side by side; more stand in a column."""
TRUNK = 26.0
"""How far the signs of a column stand right of the line that leads down it."""

Point = tuple[float, float]
Style: TypeAlias = Literal["gate", "leaf", "row"]


@dataclass(frozen=True, slots=True)
class Item:
    """A branch with the place of its sign: the middle of its upper edge, of a row its left end."""

    branch: Branch
    style: Style
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Wire:
    """A line from a gate down to one of its inputs."""

    start: str
    branch: Branch
    points: tuple[Point, ...]


@dataclass(frozen=True, slots=True)
class Block:
    """A part of the drawing: its size, what is in it, and where lines from above come in."""

    width: float
    height: float
    anchor: float
    items: tuple[Item, ...]
    wires: tuple[Wire, ...]
    entries: tuple[tuple[Branch, tuple[Point, ...]], ...]


def tidy(branch: Branch) -> Block:
    """Lay out a branch and everything below it."""
    if branch.kind != "gate":
        item = Item(branch, "leaf", LEAF[0] / 2, 0)
        return Block(*LEAF, LEAF[0] / 2, (item,), (), ((branch, ((LEAF[0] / 2, 0),)),))
    return _over(branch, _parts(branch))


def _parts(branch: Branch) -> list[Block]:
    """Return the blocks of the inputs: gates first, then the leaves."""
    gates = [below for below in branch.inputs if below.kind == "gate"]
    leaves = [below for below in branch.inputs if below.kind != "gate"]
    most = 1 if gates else SIDE_BY_SIDE
    blocks = [tidy(below) for below in gates]
    if len(leaves) > most:
        return [*blocks, _column(leaves)]
    return [*blocks, *(tidy(below) for below in leaves)]


def _column(leaves: Sequence[Branch]) -> Block:
    """Put leaves below each other, beside a line that leads down."""
    anchor = 8.0
    items, entries = [], []
    for place, branch in enumerate(leaves):
        y = ROW[1] * place + ROW[1] / 2
        items.append(Item(branch, "row", anchor + TRUNK, y))
        entries.append((branch, ((anchor, 0.0), (anchor, y), (anchor + TRUNK, y))))
    return Block(ROW[0], ROW[1] * len(leaves), anchor, tuple(items), (), tuple(entries))


def _over(branch: Branch, blocks: Sequence[Block]) -> Block:
    """Put a gate above the middle of its inputs, which stand side by side."""
    lefts = _lefts(blocks)
    anchors = [left + block.anchor for left, block in zip(lefts, blocks, strict=True)]
    middle = (anchors[0] + anchors[-1]) / 2 if anchors else 0.0
    shift = max(0.0, GATE[0] / 2 - middle)
    middle += shift
    top = GATE[1] + DROP
    moved = [_moved(b, left + shift, top) for left, b in zip(lefts, blocks, strict=True)]
    wires = [
        Wire(branch.id, below, ((middle, GATE[1]), *points))
        for block in moved
        for below, points in block.entries
    ]
    right = max((left + shift + b.width for left, b in zip(lefts, blocks, strict=True)), default=0)
    return Block(
        max(right, middle + GATE[0] / 2),
        max((top + block.height for block in blocks), default=GATE[1]),
        middle,
        (Item(branch, "gate", middle, 0), *(item for block in moved for item in block.items)),
        (*wires, *(wire for block in moved for wire in block.wires)),
        ((branch, ((middle, 0.0),)),),
    )


def _lefts(blocks: Sequence[Block]) -> list[float]:
    lefts, x = [], 0.0
    for block in blocks:
        lefts.append(x)
        x += block.width + APART
    return lefts


def _moved(block: Block, x: float, y: float) -> Block:
    """Return the block with all its places moved; its anchor and size stay its own."""

    def along(points: Sequence[Point]) -> tuple[Point, ...]:
        return tuple((px + x, py + y) for px, py in points)

    return replace(
        block,
        items=tuple(replace(item, x=item.x + x, y=item.y + y) for item in block.items),
        wires=tuple(replace(wire, points=along(wire.points)) for wire in block.wires),
        entries=tuple((branch, along(points)) for branch, points in block.entries),
    )


def elbow(points: Sequence[Point], radius: float = 7) -> str:
    """Return a line of upright and level parts with round corners: down, across, down to each."""
    (x, y), (end_x, end_y), *rest = points
    bus = y + DROP / 2
    corners = [(x, y), (x, bus), (end_x, bus), (end_x, end_y), *rest]
    if abs(x - end_x) < 1:
        corners = [(end_x, y), (end_x, end_y), *rest]
    merged = [p for place, p in enumerate(corners) if place == 0 or p != corners[place - 1]]
    return _rounded([p for place, p in enumerate(merged) if not _straight(merged, place)], radius)


def _straight(points: Sequence[Point], place: int) -> bool:
    """Return whether a point lies on the line from the one before to the one behind."""
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
    """Return the point on the way to the other one where the corner begins."""
    dx, dy = other[0] - corner[0], other[1] - corner[1]
    far = max(abs(dx), abs(dy)) or 1.0
    part = min(radius, far / 2) / far
    return corner[0] + dx * part, corner[1] + dy * part
