"""Effects of a diagnosis: columns by kind, symptoms by sign and word, one way highlighted."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import pytest

from amberbox.server.drawing.effects import (
    EffectDiagram,
    EffectEdge,
    EffectNode,
    effect_diagram,
    effect_graph,
)
from tests.server.drawing.parsed import HOSTILE, WORDS, frames, of_class, overlapping, parsed, texts

GRAPH: dict[str, Any] = {
    "nodes": [
        {"id": "cause:laser#silent", "kind": "cause", "text": "The laser has no power",
         "small": "laser#silent", "mark": "leading", "probability": 0.86},
        {"id": "cause:laser#cable", "kind": "cause", "text": "The cable is broken",
         "small": "laser#cable", "mark": "", "probability": 0.09},
        {"id": "lost:see", "kind": "lost", "text": "see", "small": "see", "mark": "",
         "probability": None},
        {"id": "symptom:scans", "kind": "symptom", "text": "no scans", "small": "12:00 scans",
         "mark": "present", "probability": None},
        {"id": "symptom:lamp", "kind": "symptom", "text": "lamp is off", "small": "lamp",
         "mark": "contradicted", "probability": None},
        {"id": "symptom:wheel", "kind": "symptom", "text": "wheel slips", "small": "wheel",
         "mark": "unexplained", "probability": None},
    ],
    "edges": [
        {"start": "cause:laser#silent", "end": "lost:see", "missing": False, "leading": True},
        {"start": "lost:see", "end": "symptom:scans", "missing": False, "leading": True},
        {"start": "cause:laser#silent", "end": "symptom:lamp", "missing": True, "leading": True},
        {"start": "cause:laser#cable", "end": "symptom:scans", "missing": False, "leading": False},
    ],
    "more_causes": 2,
    "more_symptoms": 0,
}  # fmt: skip


def _drawn(*chosen: str) -> ElementTree.Element:
    return parsed(effect_graph(effect_diagram(GRAPH), label="Why", chosen=chosen, words=WORDS))


def test_json_of_an_explanation_is_drawn_whole() -> None:
    """Draw each node and each edge once."""
    tree = _drawn()
    names = [node.get("data-id") for node in of_class(tree, "node")]
    assert sorted(filter(None, names)) == sorted(node["id"] for node in GRAPH["nodes"])
    edges = [(e.get("data-start"), e.get("data-end")) for e in of_class(tree, "edge")]
    assert sorted(map(str, edges)) == sorted(
        str((edge["start"], edge["end"])) for edge in GRAPH["edges"]
    )


def test_kinds_stand_in_columns() -> None:
    """Put causes left, symptoms right (also one that nothing explains), with headings."""
    tree = _drawn()
    left = {frame.x for frame in frames(tree, "cause")}
    right = {frame.x for frame in frames(tree, "symptom")}
    assert len(left) == len(right) == 1
    assert max(left) < frames(tree, "lost")[0].x < min(right)
    assert not overlapping(frames(tree, "node"))
    headings = [part.text for part in of_class(tree, "heading")]
    assert headings == ["What may be broken", "What fails with it", "What is seen"]


def test_symptoms_have_a_word_and_a_sign_each() -> None:
    """Present and absent symptoms differ by a word and a sign, not by colour alone."""
    tree = _drawn()
    assert {"seen", "should show, does not", "seen, not explained"} <= set(texts(tree))
    signs = {tuple(part.get("d") for part in icon) for icon in of_class(tree, "icon")}
    assert len(signs) == 3


def test_causes_have_a_bar_and_a_number() -> None:
    """Show how probable each cause is."""
    tree = _drawn()
    assert {"86 %", "9 %"} <= set(texts(tree))
    bars = [float(bar.get("width", "0")) for bar in of_class(tree, "share")]
    assert bars[0] / bars[1] == pytest.approx(0.86 / 0.09, rel=0.01)


@pytest.mark.parametrize("name", ["laser#silent", "cause:laser#silent"])
def test_chosen_way_is_highlighted(name: str) -> None:
    """Highlight everything that the chosen cause brings about."""
    strong = {part.get("data-id") for part in of_class(_drawn(name), "strong")} - {None}
    assert strong == {"cause:laser#silent", "lost:see", "symptom:scans", "symptom:lamp"}


def test_nothing_is_highlighted_unless_chosen() -> None:
    """Leave all equal."""
    assert not of_class(_drawn(), "strong")
    assert not of_class(_drawn("battery#empty"), "chosen")


def test_what_is_missing_is_dashed_and_counted() -> None:
    """The arrow to an expected but absent symptom is dashed, and hidden ones are counted."""
    tree = _drawn()
    missing = of_class(tree, "missing")
    assert [part.get("data-end") for part in missing] == ["symptom:lamp"]
    assert "and 2 more" in texts(tree)


def test_long_text_is_broken_into_lines() -> None:
    """Write three lines rather than one and an ellipsis."""
    node = EffectNode("cause:x", "cause", "the plug of the front laser has come loose on the way")
    tree = parsed(effect_graph(EffectDiagram((node,), ()), label="x", words=WORDS))
    assert " ".join(part.text or "" for part in of_class(tree, "name")) == node.text


@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_texts_are_text(hostile: str) -> None:
    """Draw any text as text."""
    nodes = (
        EffectNode("cause:" + hostile, "cause", hostile, hostile, probability=1.0),
        EffectNode("symptom:x", "symptom", hostile, hostile, "unknown", href="/x"),
    )
    drawn = effect_graph(
        EffectDiagram(nodes, (EffectEdge(nodes[0].id, nodes[1].id),)),
        label=hostile,
        chosen=[hostile],
        words=WORDS,
    )
    assert {part.tag.rpartition("}")[2] for part in parsed(drawn).iter()} <= {
        "svg", "g", "a", "title", "rect", "path", "text",
    }  # fmt: skip


def test_links_and_states_come_along() -> None:
    """A node has its link, and an unknown symptom is marked."""
    effects = effect_diagram(GRAPH, {"symptom:scans": "/robots/r/data?from=1"})
    linked = [
        link.get("href") for link in parsed(effect_graph(effects, label="x", words=WORDS)).iter()
    ]
    assert "/robots/r/data?from=1" in linked
    node = EffectNode("symptom:x", "symptom", "x", state="unknown")
    assert "not known" in texts(
        parsed(effect_graph(EffectDiagram((node,), ()), label="x", words=WORDS))
    )
