"""A fault tree with the usual signs of gates and events."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from amberbox.diagnosis.explanation.lettering import SMALL
from amberbox.fleet.drawing.branches import Event, Gate, Tree, below, held, unfolded
from amberbox.fleet.drawing.marks import box
from amberbox.fleet.drawing.numbers import chance
from amberbox.fleet.drawing.svg import (
    Element,
    broken,
    classes,
    element,
    group,
    lettering,
    linked,
    root,
    title,
)  # fmt: skip
from amberbox.fleet.drawing.tidy import GATE, LEAF, ROW, TRUNK, Item, Wire, elbow, tidy
from amberbox.fleet.drawing.words import Words

MARGIN = 14.0
BOX = 50.0
"""How high the text of a gate is; its symbol hangs below."""

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
    """What every part has to know."""

    tree: Tree
    holds: Collection[str]
    words: Words


def fault_tree(
    tree: Tree, *, label: str, cut_set: Collection[str] = (), depth: int = 5, most: int = 150,
    words: Words,
) -> Element:  # fmt: skip
    """Draw a fault tree top down; the way of a cut set up to the top is highlighted.

    A gate that several gates use is unfolded once and a triangle elsewhere. Gates below ``depth``
    or beyond ``most`` places are triangles that say how much is below them. Raises KeyError for an
    input that there is not.
    """
    scene = _Scene(tree, held(tree, cut_set) if cut_set else frozenset(), words)
    block = tidy(unfolded(tree, depth, most))
    wires = [_wire(wire, scene) for wire in block.wires]
    wires.sort(key=lambda wire: "strong" in wire.get("class").split())
    parts = group(*wires, *(_item(item, scene) for item in block.items), at=(MARGIN, MARGIN))
    size = (block.width + 2 * MARGIN, block.height + 2 * MARGIN)
    return root(classes("faulttree", "chosen" if cut_set else ""), size, label, (parts,))


def _wire(wire: Wire, scene: _Scene) -> Element:
    strong = wire.start in scene.holds and wire.branch.id in scene.holds
    return element(
        "path",
        class_=classes("line edge", "strong" if strong else ""),
        d=elbow(wire.points),
        data_start=wire.start,
        data_end=wire.branch.id,
    )


def _item(item: Item, scene: _Scene) -> Element:
    if item.style == "gate":
        return _gate(item, scene.tree.gates[item.branch.id], scene)
    if item.branch.kind == "event":
        event = scene.tree.events[item.branch.id]
        cut = item.branch.id in scene.holds
        about = [event.label, event.id, chance(event.probability)]
        said = chance(event.probability)
        if cut:
            about.append(scene.words.in_cut_set)
        return _leaf(item, event.kind, event, about, said, strong=cut)
    gate = scene.tree.gates[item.branch.id]
    said = scene.words.transfer
    if item.branch.kind == "cut":
        said = scene.words.below.format(n=below(scene.tree, gate.id))
    about = [gate.label, gate.id, said]
    return _leaf(item, "transfer", gate, about, said, strong=gate.id in scene.holds)


def _gate(item: Item, gate: Gate, scene: _Scene) -> Element:
    strong = gate.id in scene.holds
    number = chance(gate.probability)
    kind = _said(gate, scene.words)
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


def _plate(gate: Gate) -> Iterator[Element]:
    """Yield the box with the text of a gate; one without a text is only a line."""
    if not gate.label:
        yield element("path", class_="line", d=f"M0 0V{BOX:g}")
        return
    lines = broken(gate.label, GATE[0] - 16, 2)
    yield box(-GATE[0] / 2, 0, (GATE[0], BOX), 6, class_="box")
    for place, line in enumerate(lines):
        y = BOX / 2 + 4.5 + 17 * (place - (len(lines) - 1) / 2)
        yield element("text", line, x=0, y=y, class_="middle")


def _symbol(gate: Gate) -> Iterator[Element]:
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


def _said(gate: Gate, words: Words) -> str:
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
    item: Item, sign: str, of: Gate | Event, about: list[str], said: str, *, strong: bool
) -> Element:
    row = item.style == "row"
    text = of.label or of.id
    inside = _beside_sign(text, said) if row else _below_sign(text, said)
    leaf = group(
        title(". ".join(dict.fromkeys(part for part in about if part))),
        _sign(sign, row=row),
        *inside,
        at=(item.x, item.y),
        class_=classes("leaf", sign, "strong" if strong else ""),
        data_id=of.id,
    )
    return linked(of.href, leaf)


def _beside_sign(text: str, said: str) -> Iterator[Element]:
    left, most = 34.0, ROW[0] - TRUNK - 8 - 34
    lines = broken(text, most, 3)
    first = 4.5 - 8 * (len(lines) - 1) - (5.5 if said else 0)
    for place, line in enumerate(lines):
        yield element("text", line, x=left, y=first + 16 * place)
    if said:
        yield lettering(said, (left, first + 16 * len(lines) - 2), most, SMALL, class_="small")


def _below_sign(text: str, said: str) -> Iterator[Element]:
    lines = broken(text, LEAF[0] - 6, 4)
    for place, line in enumerate(lines):
        yield element("text", line, x=0, y=50 + 16 * place, class_="middle")
    if said:
        y = 50 + 16 * len(lines) - 1
        yield element("text", said, x=0, y=y, class_="small middle")


def _sign(sign: str, *, row: bool) -> Element:
    """Return the sign of a leaf: in a row right of the line, else below it."""
    middle, size = ((12.0, 0.0), 11.0) if row else ((0.0, 16.0), 16.0)
    x, y = middle
    if sign == "basic":
        return element("circle", class_="symbol", cx=x, cy=y, r=size)
    return element("path", class_="symbol", d=_outline(sign, x, y, size))


def _outline(sign: str, x: float, y: float, size: float) -> str:
    """Return a triangle (transfer), a house, or a diamond (not developed)."""
    corners = {
        "transfer": ((0, -1), (1, 0.9), (-1, 0.9)),
        "house": ((0, -1), (1, -0.3), (1, 1), (-1, 1), (-1, -0.3)),
        "undeveloped": ((0, -1), (1, 0), (0, 1), (-1, 0)),
    }[sign]
    points = (f"{x + size * dx:.1f} {y + size * dy:.1f}" for dx, dy in corners)
    return f"M{'L'.join(points)}z"
