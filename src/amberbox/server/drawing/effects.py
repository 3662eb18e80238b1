"""The effect graph of a diagnosis: from possible causes to symptoms."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from amberbox.core.layered_layout import GraphLayout, LayoutBox, LayoutGaps, LinkRoute, layered
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
    width,
)
from amberbox.core.units import percent
from amberbox.server.drawing.symbols import DrawingTexts, arrow_head

MARGIN = 14.0
TOP = 24.0
WIDE, HIGH, LINE = 250.0, 54.0, 17.0
LINES = 3
GAPS = LayoutGaps(ranks=72, boxes=14)
TEXT = 14.0

Kind: TypeAlias = Literal["cause", "lost", "symptom"]
State: TypeAlias = Literal["", "present", "absent", "unknown", "unexplained"]


@dataclass(frozen=True, slots=True)
class EffectNode:
    """A box: a failure mode, a lost function, or a symptom.

    ``small`` is its id for experts, ``state`` that of a symptom, ``probability`` that of a cause.
    """

    id: str
    kind: Kind
    text: str
    small: str = ""
    state: State = ""
    probability: float | None = None
    href: str = ""


@dataclass(frozen=True, slots=True)
class EffectEdge:
    """``start`` causes ``end``; ``missing``: the effect is expected, but absent."""

    start: str
    end: str
    missing: bool = False


@dataclass(frozen=True, slots=True)
class EffectDiagram:
    """Boxes and arrows, and the numbers of causes and symptoms that were left out."""

    nodes: tuple[EffectNode, ...]
    edges: tuple[EffectEdge, ...]
    more_causes: int = 0
    more_symptoms: int = 0


def effect_diagram(
    graph: Mapping[str, Any], hrefs: Mapping[str, str] | None = None
) -> EffectDiagram:
    """Return the ``graph`` of an explanation (JSON) as a diagram, with links by id of node."""
    links = hrefs or {}
    nodes = (
        EffectNode(
            str(node["id"]), node["kind"], str(node["text"]), str(node["small"]), _state(node),
            node["probability"], links.get(str(node["id"]), ""),
        )
        for node in graph["nodes"]
    )  # fmt: skip
    edges = (EffectEdge(str(e["start"]), str(e["end"]), bool(e["missing"])) for e in graph["edges"])
    return EffectDiagram(tuple(nodes), tuple(edges), graph["more_causes"], graph["more_symptoms"])


def _state(node: Mapping[str, Any]) -> State:
    """Return the state of a symptom by the mark of its node; empty for other nodes."""
    if node["kind"] != "symptom":
        return ""
    states: dict[str, State] = {"contradicted": "absent", "unexplained": "unexplained"}
    return states.get(node["mark"], "present")


def effect_graph(
    effects: EffectDiagram, *, label: str, chosen: Collection[str] = (), words: DrawingTexts
) -> SvgElement:
    """Draw causes on the left, lost functions in the middle, symptoms on the right.

    ``chosen`` are ids of failure modes (with or without ``cause:``): all their effects are
    highlighted, other elements are dimmed.
    """
    nodes = {node.id: node for node in effects.nodes}
    edges = [e for e in dict.fromkeys(effects.edges) if e.start in nodes and e.end in nodes]
    strong = _brought_about(nodes, edges, chosen)
    causes, symptoms = (
        [node.id for node in nodes.values() if node.kind == kind] for kind in ("cause", "symptom")
    )
    layout = layered(
        [LayoutBox(node.id, WIDE, _high(node)) for node in nodes.values()],
        [(edge.start, edge.end) for edge in edges],
        gaps=GAPS,
        first=causes,
        last=symptoms,
    )
    lines = [
        _edge(edge, route, edge.start in strong and edge.end in strong)
        for edge, route in zip(edges, layout.routes, strict=True)
    ]
    lines.sort(key=lambda line: "strong" in line.get("class").split())
    cards = [_node(node, layout.corners[node.id], strong, words) for node in nodes.values()]
    parts = (
        *_headings(nodes.values(), layout, words),
        group(*lines, *cards, at=(MARGIN, MARGIN + TOP)),
        *_left_out(effects, layout, words),
    )
    more = 22.0 if effects.more_causes or effects.more_symptoms else 0.0
    size = (max(layout.width, WIDE) + 2 * MARGIN, layout.height + TOP + 2 * MARGIN + more)
    return root(classes("effects", "chosen" if strong else ""), size, label, parts)


def _brought_about(
    nodes: Mapping[str, EffectNode], edges: Sequence[EffectEdge], chosen: Collection[str]
) -> set[str]:
    """Return the chosen causes and all their effects."""
    outgoing: dict[str, list[str]] = {}
    for edge in edges:
        outgoing.setdefault(edge.start, []).append(edge.end)
    ids = {name for one in chosen for name in (one, f"cause:{one}")}
    waiting = [name for name in nodes if name in ids]
    found = set(waiting)
    while waiting:
        new = [end for end in outgoing.get(waiting.pop(), ()) if end not in found]
        found.update(new)
        waiting += new
    return found


def _edge(edge: EffectEdge, route: LinkRoute, strong: bool) -> SvgElement:
    return group(
        element("path", class_="line", d=route.path),
        arrow_head(route.tip, route.turn),
        class_=classes(
            "edge", "strong" if strong else "", "missing" if edge.missing else "",
            "broken" if route.broken else "",
        ),
        data_start=edge.start,
        data_end=edge.end,
    )  # fmt: skip


def _node(
    node: EffectNode, corner: tuple[float, float], strong: Collection[str], words: DrawingTexts
) -> SvgElement:
    shown = _shown_text(node, words)
    parts = (node.text, shown, node.small)
    card = group(
        title(". ".join(part for part in parts if part)),
        box(0, 0, (WIDE, _high(node)), class_="box"),
        *_inside(node, shown),
        at=corner,
        class_=classes("node", node.kind, node.state, "strong" if node.id in strong else ""),
        data_id=node.id,
    )
    return linked(node.href, card)


def _shown_text(node: EffectNode, words: DrawingTexts) -> str:
    """Return the text of a box: probability of a cause, or state of a symptom."""
    if node.probability is not None:
        return percent(node.probability)
    states = {
        "present": words.present,
        "absent": words.absent,
        "unknown": words.unsure,
        "unexplained": words.unexplained,
    }
    return states.get(node.state, "")


def _left(node: EffectNode) -> float:
    return TEXT + (24 if node.kind == "symptom" else 0)


def _lines(node: EffectNode) -> list[str]:
    return broken(node.text, WIDE - _left(node) - 10, LINES, bold=True)


def _high(node: EffectNode) -> float:
    return HIGH + LINE * (len(_lines(node)) - 1)


def _inside(node: EffectNode, shown: str) -> Iterator[SvgElement]:
    left, high = _left(node), _high(node)
    if node.kind == "symptom":
        yield _sign(node.state, high)
    for place, line in enumerate(_lines(node)):
        yield element("text", line, x=left, y=22 + LINE * place, class_="name")
    if node.probability is not None:
        yield from _share(node.probability, shown, high)
        return
    below = (left, high - 14)
    yield lettering(shown or node.small, below, WIDE - left - 10, SMALL, class_="small")


def _share(probability: float, shown: str, high: float) -> Iterator[SvgElement]:
    """Yield a bar for a probability, and its text."""
    long = WIDE - 2 * TEXT - 76
    full = min(1.0, max(0.0, probability)) * long
    yield box(TEXT, high - 20.5, (long, 6), 3, class_="share-all")
    yield box(TEXT, high - 20.5, (full, 6), 3, class_="share")
    yield element("text", shown, x=WIDE - TEXT, y=high - 13.5, class_="small end")


# Outline and sign: disc with a tick, diamond, crossed ring, box with a question mark
_SIGNS: Mapping[str, tuple[str, str]] = {
    "present": ("M8 1a7 7 0 1 1 0 14a7 7 0 1 1 0-14z", "M4.8 8.3l2.2 2.2l4.3-4.7"),
    "unexplained": ("M8 .5L15.5 8L8 15.5L.5 8z", "M8 4.6v4M8 11.2v.1"),
    "absent": ("M8 1.5a6.5 6.5 0 1 1 0 13a6.5 6.5 0 1 1 0-13z", "M3.6 12.4l8.8-8.8"),
    "unknown": (
        "M3 1.5h10a1.5 1.5 0 0 1 1.5 1.5v10a1.5 1.5 0 0 1-1.5 1.5H3A1.5 1.5 0 0 1 1.5 13V3"
        "A1.5 1.5 0 0 1 3 1.5z",
        "M6 6.2a2 2 0 1 1 3 1.7c-.6.4-1 .7-1 1.5M8 11.8v.1",
    ),
}


def _sign(state: str, high: float) -> SvgElement:
    ground, sign = _SIGNS.get(state, _SIGNS["present"])
    return group(
        element("path", class_="ground", d=ground),
        element("path", class_="sign", d=sign),
        at=(TEXT - 2, (high - 16) / 2),
        class_="icon",
    )


def _headings(
    nodes: Iterable[EffectNode], layout: GraphLayout, words: DrawingTexts
) -> Iterator[SvgElement]:
    """Yield a heading above the first column of each kind."""
    headings = {"cause": words.may_be_broken, "lost": words.fails, "symptom": words.seen}
    firsts: dict[str, float] = {}
    for node in nodes:
        x = layout.corners[node.id][0]
        firsts[node.kind] = min(x, firsts.get(node.kind, x))
    taken = set()
    for kind, x in firsts.items():
        if x not in taken:
            taken.add(x)
            yield element("text", headings[kind], x=MARGIN + x, y=MARGIN + 8, class_="heading")


def _left_out(
    effects: EffectDiagram, layout: GraphLayout, words: DrawingTexts
) -> Iterator[SvgElement]:
    """Yield the numbers of causes and symptoms that are not drawn, below their columns."""
    y = layout.height + TOP + MARGIN + 20
    if effects.more_causes:
        text = words.more.format(n=effects.more_causes)
        yield element("text", text, x=MARGIN, y=y, class_="small")
    if effects.more_symptoms:
        text = words.more.format(n=effects.more_symptoms)
        x = max(layout.width - WIDE, width(text, SMALL)) + MARGIN
        yield element("text", text, x=x, y=y, class_="small")
