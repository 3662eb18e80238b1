"""Fault trees: the usual signs, every gate unfolded once, the way of a cut set up to the top."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from amberbox import sim
from amberbox.diagnosis.faulttree.tree import BooleanConstant, all_of, any_of, at_least, none_of
from amberbox.diagnosis.faulttree.tree import fault_tree as of_formulas
from amberbox.diagnosis.fmea.fault_trees import effects, fault_tree_of
from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.server.drawing.faulttree import (
    GATE,
    LEAF,
    ROW,
    TRUNK,
    EventBox,
    GateBox,
    GateKind,
    TreeBranch,
    TreeDrawing,
    count_below,
    elbow,
    fault_tree,
    layout_branch,
    probability_text,
    tree_drawing,
    true_in_cut_set,
    unfold_tree,
)
from tests.server.drawing.parsed import (
    HOSTILE,
    WORDS,
    Frame,
    of_class,
    overlapping,
    parsed,
    texts,
    titles,
)

TREE = TreeDrawing(
    "stranded",
    {
        "stranded": GateBox("stranded", "Stranded", "or", ("drive", "wheels", "power"), 0, 0.013),
        "drive": GateBox("drive", "No drive", "and", ("left", "power")),
        "wheels": GateBox("wheels", "Two wheels fail", "vote", ("left", "right", "rear"), 2),
        "power": GateBox("power", "No power", "or", ("battery", "fuse")),
    },
    {
        name: EventBox(name, name, 5.8e-6)
        for name in ("left", "right", "rear", "battery", "fuse")
    },
)  # fmt: skip


def _drawn(*cut_set: str, tree: TreeDrawing = TREE, depth: int = 9) -> ElementTree.Element:
    return parsed(fault_tree(tree, label="Stranded", cut_set=cut_set, depth=depth, words=WORDS))


def _ids(tree: ElementTree.Element, kind: str) -> list[str]:
    return sorted(part.get("data-id", "") for part in of_class(tree, kind))


def test_every_gate_is_unfolded_once() -> None:
    """Unfold a shared gate where it is nearest to the top, and transfer elsewhere."""
    tree = _drawn()
    assert _ids(tree, "gate") == ["drive", "power", "stranded", "wheels"]
    assert _ids(tree, "transfer") == ["power"]
    assert _ids(tree, "basic") == ["battery", "fuse", "left", "left", "rear", "right"]


def test_every_edge_is_drawn_once() -> None:
    """Draw a line to each input of each gate."""
    edges = [(e.get("data-start"), e.get("data-end")) for e in of_class(_drawn(), "edge")]
    inputs = [(gate.id, name) for gate in TREE.gates.values() for name in gate.inputs]
    assert sorted(map(str, edges)) == sorted(map(str, inputs))


def test_gates_differ_by_sign_and_word() -> None:
    """AND, OR, and k out of n are drawn with their signs and explained in words."""
    tree = _drawn()
    signs = {
        kind: [part.get("d") for part in of_class(gate, "symbol")]
        for kind in ("and", "or", "vote")
        for gate in of_class(tree, kind)
    }
    assert signs["and"] != signs["or"]
    assert {"all of", "any of", "2 of 3", "2/3"} <= set(texts(tree))


@pytest.mark.parametrize("kind", ["xor", "not", "nand", "nor", "iff", "imply", "cardinality"])
def test_other_gates_are_drawn_too(kind: GateKind) -> None:
    """Draw every operator that a file may have, none like another."""
    tree = TreeDrawing("t", {"t": GateBox("t", "top", kind, ("a",))}, {"a": EventBox("a", "a")})
    drawn = _drawn(tree=tree)
    assert of_class(drawn, "symbol")
    assert len(texts(drawn)) == 3


def test_cut_set_is_highlighted_up_to_the_top() -> None:
    """Highlight the events of a cut set and all that it brings about."""
    tree = _drawn("left", "right")
    assert set(_ids(tree, "strong")) - {""} == {"left", "right", "wheels", "stranded"}
    wires = {(e.get("data-start"), e.get("data-end")) for e in of_class(tree, "edge")
             if "strong" in e.get("class", "")}  # fmt: skip
    assert wires == {("wheels", "left"), ("wheels", "right"), ("stranded", "wheels")}
    assert any("in this combination" in title for title in titles(tree))


def test_nothing_is_highlighted_without_a_cut_set() -> None:
    """Leave all equal, also what holds of itself."""
    tree = TreeDrawing("t", {"t": GateBox("t", "top", "nor", ("a",))}, {"a": EventBox("a", "a")})
    assert not of_class(_drawn(tree=tree), "strong")


def test_deep_gates_say_how_much_is_below() -> None:
    """Below a certain depth, vertices are only counted."""
    tree = _drawn(depth=1)
    assert _ids(tree, "gate") == ["stranded"]
    assert "4 below" in _said(tree, "drive")


def _said(tree: ElementTree.Element, name: str) -> str:
    return " ".join(t for part in tree.iter() if part.get("data-id") == name for t in texts(part))


def test_large_tree_stops_unfolding() -> None:
    """At most a given number of vertices is drawn, except for the inputs of drawn ones."""
    wide = tuple(f"g{n}" for n in range(50))
    gates = {name: GateBox(name, name, "or", ("a", "b")) for name in wide}
    tree = TreeDrawing(
        "t", {"t": GateBox("t", "t", "or", wide), **gates}, {n: EventBox(n, n) for n in "ab"}
    )
    assert len(list(unfold_tree(tree, 9, 40).all())) == 51
    assert len(list(unfold_tree(tree, 9, 60).all())) <= 60


@pytest.mark.parametrize(("probability", "text"), [
    (None, ""), (0.0, "0"), (0.0134, "0.013"), (1.0, "1"), (5.8e-6, "5.8·10⁻⁶"),
])  # fmt: skip
def test_probabilities_are_readable(probability: float | None, text: str) -> None:
    """Write small numbers as people do."""
    assert probability_text(probability) == text


@some.composite
def trees(draw: some.DrawFn) -> TreeDrawing:
    """Return a tree of any shape: gates over later gates and events."""
    count = draw(some.integers(1, 8))
    names = [f"g{n}" for n in range(count)]
    events = [f"e{n}" for n in range(6)]
    gates = {}
    for place, name in enumerate(names):
        inputs = draw(some.lists(some.sampled_from([*names[place + 1 :], *events]),
                                 min_size=1, max_size=7, unique=True))  # fmt: skip
        kind: GateKind = draw(some.sampled_from(("and", "or", "vote")))
        gates[name] = GateBox(name, name, kind, tuple(inputs), 2)
    return TreeDrawing("g0", gates, {name: EventBox(name, name) for name in events})


_ROOM = {
    "gate": (-GATE[0] / 2, 0.0, *GATE),
    "leaf": (-LEAF[0] / 2, 0.0, *LEAF),
    "row": (0.0, -ROW[1] / 2, ROW[0] - TRUNK - 8, ROW[1]),
}


@settings(max_examples=30)
@given(trees())
def test_parts_do_not_overlap(tree: TreeDrawing) -> None:
    """Give every gate and every leaf room of its own, inside the drawing."""
    block = layout_branch(unfold_tree(tree, 9, 99))
    found = []
    for item in block.items:
        x, y, wide, high = _ROOM[item.style]
        found.append(Frame(item.x + x, item.y + y, wide, high))
    assert not overlapping(found)
    assert min(frame.x for frame in found) >= -0.01
    assert max(frame.x + frame.width for frame in found) <= block.width + 0.01
    assert max(frame.y + frame.height for frame in found) <= block.height + 0.01


@settings(max_examples=30)
@given(trees(), some.sets(some.sampled_from([f"e{n}" for n in range(6)])))
def test_held_agrees_with_the_definition(tree: TreeDrawing, events: set[str]) -> None:
    """Find what holds as a plain recursion does."""

    def holds(name: str) -> bool:
        if name in tree.events:
            return name in events
        gate = tree.gates[name]
        true = sum(holds(part) for part in gate.inputs)
        return true >= {"and": len(gate.inputs), "or": 1, "vote": gate.k}[gate.kind]

    assert ("g0" in true_in_cut_set(tree, events)) == holds("g0")


def test_many_leaves_stand_in_a_column() -> None:
    """Put more than three leaves below each other."""
    few = layout_branch(TreeBranch("t", "gate", [TreeBranch(str(n), "event") for n in range(3)]))
    many = layout_branch(TreeBranch("t", "gate", [TreeBranch(str(n), "event") for n in range(9)]))
    assert [item.style for item in few.items] == ["gate", "leaf", "leaf", "leaf"]
    assert {item.style for item in many.items[1:]} == {"row"}
    assert many.width < few.width


def test_lines_turn_round_corners() -> None:
    """Go down, across, down."""
    assert elbow([(0, 0), (50, 100)]) == (
        "M0.0 0.0L0.0 12.0Q0.0 19.0 7.0 19.0L43.0 19.0Q50.0 19.0 50.0 26.0L50.0 100.0"
    )
    assert elbow([(5, 0), (5, 100)]) == "M5.0 0.0L5.0 100.0"


def test_tree_of_the_diagnosis_is_drawn() -> None:
    """Take over gates, events and formulas inside formulas; leave out what never happens."""
    tree = tree_drawing(
        of_formulas(
            "robot", "top",
            {"top": any_of("two", all_of("a", none_of("b")), "host"),
             "two": at_least(2, "a", "b", "c"), "host": BooleanConstant(False), "one": any_of("a")},
            {"a": 0.1, "b": 0.2, "c": None}, {"dock": True},
        )
    )  # fmt: skip
    assert tree.gates["top"].inputs == ("two", "top/2")
    assert (tree.gates["two"].kind, tree.gates["two"].k) == ("vote", 2)
    assert tree.gates["top/2"] == GateBox("top/2", "", "and", ("a", "top/2/2"))
    assert tree.gates["one"].kind == "pass"
    assert tree.events["dock"].kind == "house"
    assert tree.events["b"].probability == 0.2
    assert of_class(_drawn("a", tree=tree), "strong")


def test_gate_that_never_holds_is_a_house() -> None:
    """Draw a constant as a house event."""
    tree = tree_drawing(of_formulas("robot", "t", {"t": BooleanConstant(False)}, {}))
    assert len(of_class(_drawn(tree=tree), "house")) == 1


def test_below_counts_everything_once() -> None:
    """Count gates and events, shared ones once."""
    assert count_below(TREE, "stranded") == 8


def test_input_that_is_not_there_is_an_error() -> None:
    """Refuse a gate over nothing."""
    with pytest.raises(KeyError):
        _drawn(tree=TreeDrawing("t", {"t": GateBox("t", "t", "or", ("x",))}, {}))


@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_names_are_text(hostile: str) -> None:
    """Draw any name as text."""
    top = GateBox("t", hostile, "or", (hostile,), href="/t")
    drawn = _drawn(
        hostile, tree=TreeDrawing("t", {"t": top}, {hostile: EventBox(hostile, hostile)})
    )
    assert {part.tag.rpartition("}")[2] for part in drawn.iter()} <= {
        "svg", "g", "a", "title", "rect", "path", "text", "circle",
    }  # fmt: skip


def test_tree_of_a_real_robot_is_drawn() -> None:
    """Draw the trees of the simulated robot."""
    fmea, _ = load_fmea(Path(sim.__file__).parent / "folder" / "fmea.yaml")
    assert fmea is not None
    for effect in effects(fmea):
        tree = tree_drawing(fault_tree_of(fmea, effect))
        drawn = parsed(fault_tree(tree, label=effect, words=WORDS))
        assert len(set(_ids(drawn, "gate"))) == len(_ids(drawn, "gate"))
