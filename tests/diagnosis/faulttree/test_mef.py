"""Open-PSA files: accepted and refused elements, and writing without loss."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings

from amberbox.core.errors import ConfigurationError, UsageError
from amberbox.diagnosis.faulttree.analysis import analyse
from amberbox.diagnosis.faulttree.open_psa import read_mef, write_mef
from amberbox.diagnosis.faulttree.tree import (
    BasicEvent,
    BooleanConstant,
    FaultTree,
    Gate,
    Name,
    all_of,
    any_of,
    at_least,
    fault_tree,
)
from tests.diagnosis.faulttree.brute import trees

GOOD = """<?xml version="1.0"?>
<opsa-mef>
  <define-fault-tree name="drive">
    <label>The drive</label>
    <define-gate name="lost">
      <label>cannot drive</label>
      <or>
        <gate name="wheels"/>
        <and> <basic-event name="battery"/> <not> <house-event name="docked"/> </not> </and>
        <gate name="front.private_one"/>
      </or>
    </define-gate>
    <define-component name="front">
      <define-gate name="wheels">
        <atleast min="2">
          <event name="left"/> <event name="right"/> <event name="middle"/>
        </atleast>
      </define-gate>
      <define-gate name="private_one" role="private"> <basic-event name="left"/> </define-gate>
      <define-basic-event name="left" role="private"> <float value="0.5"/> </define-basic-event>
    </define-component>
    <define-basic-event name="left"> <float value="0.125"/> </define-basic-event>
  </define-fault-tree>
  <model-data>
    <define-parameter name="rate"> <float value="1e-3"/> </define-parameter>
    <define-parameter name="twice" unit="hours-1">
      <mul> <int value="2"/> <parameter name="rate"/> </mul>
    </define-parameter>
    <define-basic-event name="right">
      <exponential> <parameter name="twice"/> <system-mission-time/> </exponential>
    </define-basic-event>
    <define-basic-event name="middle">
      <sub> <float value="0.5"/> <div> <float value="1"/> <float value="8"/> </div> </sub>
    </define-basic-event>
    <define-basic-event name="battery"><label>battery empty</label></define-basic-event>
    <define-house-event name="docked"> <constant value="false"/> </define-house-event>
  </model-data>
</opsa-mef>
"""


def read(tmp_path: Path, text: str, top: str = "", mission_time_h: float = 100.0) -> FaultTree:
    path = tmp_path / "tree.xml"
    path.write_text(text, encoding="utf-8")
    return read_mef(path, top, mission_time_h)


def refused(tmp_path: Path, text: str) -> list[tuple[int, str]]:
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, text)
    return [(problem.line, f"{problem.where}: {problem.what}") for problem in caught.value.problems]


def inside(*gates: str, data: str = "") -> str:
    """A file whose gates begin in line 3, one per line, and its data after them."""
    lines = ["<opsa-mef>", '<define-fault-tree name="t">', *gates, "</define-fault-tree>"]
    return "\n".join([*lines, "<model-data>", data, "</model-data>", "</opsa-mef>"])


def test_a_file_with_components_parameters_and_house_events(tmp_path: Path) -> None:
    tree = read(tmp_path, GOOD)
    assert (tree.name, tree.top, tree.gates["lost"].label) == ("drive", "lost", "cannot drive")
    assert tree.houses == {"docked": False}
    assert tree.gates["drive.front.private_one"].formula == Name("drive.front.left")
    wheels = at_least(2, "drive.front.left", "right", "middle")
    assert tree.gates["wheels"].formula == wheels, "inside a component its own names come first"
    chances = {name: event.probability for name, event in tree.events.items()}
    assert chances == {
        "drive.front.left": 0.5,
        "left": 0.125,
        "right": pytest.approx(1 - math.exp(-0.2)),
        "middle": 0.375,
        "battery": None,
    }
    analysis = analyse(tree)
    assert analysis.without_probability == ("battery",) and analysis.top_probability is None
    assert set(analysis.cut_sets or ()) == {
        frozenset({"drive.front.left"}), frozenset({"battery"}), frozenset({"right", "middle"}),
    }  # fmt: skip


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    tree = read(tmp_path, GOOD)
    assert read(tmp_path, write_mef(tree)) == tree


@settings(max_examples=15)
@given(trees())
def test_any_tree_survives_being_written(
    tmp_path_factory: pytest.TempPathFactory, tree: FaultTree
) -> None:
    path = tmp_path_factory.getbasetemp() / "any_tree.xml"
    path.write_text(write_mef(tree), encoding="utf-8")
    assert read_mef(path, tree.top) == tree


def test_names_and_labels_that_xml_does_not_like_survive(tmp_path: Path) -> None:
    events = {"laser#no_data": 0.5, "laser_no_data": 0.25, "räder <&>": None, "2nd": 0.0}
    tree = fault_tree("Ärger & more", "see/obstacles", {"see/obstacles": any_of(*events)}, events)
    labelled = {**tree.events, "2nd": BasicEvent("2nd", 0.0, 'the "2nd" <one> & more')}
    tree = replace(tree, events=labelled)
    text = write_mef(tree)
    assert 'name="laser_no_data_2"' in text and 'name="laser_no_data"' in text
    assert read(tmp_path, text, mission_time_h=tree.mission_time_h) == tree


def test_the_top_is_what_no_gate_uses_or_what_is_asked_for(tmp_path: Path) -> None:
    text = inside(
        '<define-gate name="a"><basic-event name="x"/></define-gate>',
        '<define-gate name="b"><not><basic-event name="x"/></not></define-gate>',
        data='<define-basic-event name="x"/>',
    )
    with pytest.raises(UsageError, match="has 2 top events: a, b"):
        read(tmp_path, text)
    assert read(tmp_path, text, "b").top == "b"
    with pytest.raises(UsageError, match="has no gate 'aa'; did you mean 'a'"):
        read(tmp_path, text, "aa")


X = '<basic-event name="x"/>'
EVENT_X = '<define-basic-event name="x"><float value="0.5"/></define-basic-event>'


@pytest.mark.parametrize(
    ("gate", "what"),
    [
        ("", "g: the gate has no input"),
        ("<and/>", "<and>: 'and' has no input"),
        (X + X, "g: a gate has one formula only"),
        (f"<not>{X}{X}</not>", "<not>: 'not' needs exactly 1 input, not 2"),
        (f"<xor>{X}</xor>", "<xor>: 'xor' needs exactly 2 inputs, not 1"),
        (f'<atleast min="3">{X}{X}</atleast>', "<atleast>: 'atleast' asks for 3 of 2 inputs"),
        (f"<atleast>{X}{X}</atleast>", "<atleast>: min='' is no whole number"),
        (
            f'<cardinality min="2" max="1">{X}{X}</cardinality>',
            "<cardinality>: 'cardinality' asks for at least 2, at most 1",
        ),
        ('<or><gate name="x"/></or>', "x: is a basic event, not a gate"),
        ('<or><basic-event name="y"/></or>', "y: no such basic event"),
        ('<or><gate name="h"/></or>', "h: no such gate"),
        ("<maybe/>", "<maybe>: is no gate that is known"),
        ('<constant value="yes"/>', "<constant>: 'yes' is neither true nor false"),
        ("<basic-event/>", "<basic-event>: no such basic event"),
    ],
)
def test_what_is_wrong_with_a_gate_is_said_with_its_line(
    tmp_path: Path, gate: str, what: str
) -> None:
    text = inside("", f'<define-gate name="g">{gate}</define-gate>', data=EVENT_X)
    assert refused(tmp_path, text) == [(4, what)]


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ('<float value="1.5"/>', "y: the probability 1.5 is not between 0 and 1"),
        ('<neg><float value="0.5"/></neg>', "y: the probability -0.5 is not between 0 and 1"),
        ('<float value="much"/>', "<float>: 'much' is no number"),
        ('<float value="nan"/>', "<float>: 'nan' is no number"),
        ('<div><int value="1"/><int value="0"/></div>', "y: has no value: float division by zero"),
        ('<parameter name="p"/>', "p: no such parameter"),
        ("<exponential><pi/></exponential>", "<exponential>: 'exponential' needs exactly 2"),
        ("<dice/>", "<dice>: is no expression that is known"),
        ("<pi/><pi/>", "y: there is more than one expression"),
    ],
)
def test_what_is_wrong_with_a_probability_is_said_with_its_line(
    tmp_path: Path, value: str, what: str
) -> None:
    event = f'\n<define-basic-event name="y">{value}</define-basic-event>'
    text = inside(f'<define-gate name="g">{X}</define-gate>', data=EVENT_X + event)
    problems = refused(tmp_path, text)
    assert problems[0][0] == 7 and problems[0][1].startswith(what)


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ('<define-gaet name="a"/>', "<define-gaet>: unknown element in <define-fault-tree>"),
        ('<define-CCF-group name="a"/>', "<define-CCF-group>: common-cause groups are not"),
        ('<include file="other.xml"/>', "<include>: included files are not supported"),
        ('<define-gate name="g"><constant value="true"/></define-gate>', "g: is defined twice"),
        ('<define-basic-event name="x"/>', "x: is defined twice"),
        ("<define-gate/>", "<define-gate>: has no name"),
        ("<define-component/>", "<define-component>: has no name"),
    ],
)
def test_what_does_not_belong_into_a_tree_is_named(tmp_path: Path, line: str, what: str) -> None:
    text = inside(f'<define-gate name="g">{X}</define-gate>{EVENT_X}', line)
    assert [(n, w[: len(what)]) for n, w in refused(tmp_path, text)] == [(4, what)]


def test_a_cycle_is_shown_with_its_path(tmp_path: Path) -> None:
    gates = [
        f'<define-gate name="{name}"><or><gate name="{used}"/>{X}</or></define-gate>'
        for name, used in (("top", "a"), ("a", "b"), ("b", "c"), ("c", "a"))
    ]
    problems = refused(tmp_path, inside(*gates, data=EVENT_X))
    assert problems == [(4, "a: the gate depends on itself: a > b > c > a")]


def test_a_cycle_of_parameters_is_shown_with_its_path(tmp_path: Path) -> None:
    data = "".join(
        f'\n<define-parameter name="{name}"><parameter name="{used}"/></define-parameter>'
        for name, used in (("p", "q"), ("q", "p"))
    )
    text = inside(f'<define-gate name="g">{X}</define-gate>', data=EVENT_X + data)
    assert refused(tmp_path, text) == [(7, "p: the parameter depends on itself: p > q > p")]


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("<opsa-mef>\n<and></opsa-mef>", 2, "syntax: is no XML: mismatched tag"),
        ("", 1, "syntax: is no XML: no element found"),
        ("<html/>", 1, "file: does not begin with <opsa-mef>"),
        ("<opsa-mef/>", 1, "file: defines no gate"),
        (
            '<!DOCTYPE x [\n<!ENTITY a "aaaa">]>\n<opsa-mef>&a;</opsa-mef>',
            2,
            "syntax: entities are not allowed",
        ),
        (
            '<!DOCTYPE x SYSTEM "other.dtd">\n<opsa-mef>&a;</opsa-mef>',
            2,
            "syntax: entities are not allowed",
        ),
        ("<and>" * 200, 1, "syntax: elements are nested deeper than 100"),
    ],
)
def test_what_is_no_such_file_is_refused(tmp_path: Path, text: str, line: int, what: str) -> None:
    assert refused(tmp_path, text) == [(line, what)]


def test_a_tree_made_by_hand_is_checked_as_well() -> None:
    gates = {"top": any_of("a", "nobody"), "a": all_of("top", "e"), "b": all_of()}
    tree = fault_tree("t", "tpo", gates, {"e": 1.5})
    with pytest.raises(ConfigurationError) as caught:
        analyse(tree)
    assert [(p.where, p.what) for p in caught.value.problems] == [
        ("top", "'nobody' is not defined"),
        ("b", "'and' has no input"),
        ("e", "the probability 1.5 is not between 0 and 1"),
        ("tpo", "there is no such gate to be the top"),
        ("top", "the gate depends on itself: top > a > top"),
    ]


def test_a_constant_top_has_no_event() -> None:
    answers: tuple[tuple[bool, list[frozenset[str]]], ...] = ((True, [frozenset()]), (False, []))
    for value, cut_sets in answers:
        analysis = analyse(replace(fault_tree("t", "g", {}, {}), gates={
            "g": Gate("g", BooleanConstant(value)),
        }))  # fmt: skip
        assert analysis.top_probability == float(value)
        assert list(analysis.cut_sets or ()) == cut_sets


def test_a_file_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.xml:1: file: cannot be read: No such"):
        read_mef(tmp_path / "none.xml")


SECOND = """<opsa-mef>
  <define-fault-tree name="power">
    <define-gate name="dark"> <and> <gate name="lost"/> <event name="fuse"/> </and> </define-gate>
    <define-basic-event name="fuse"> <float value="0.5"/> </define-basic-event>
  </define-fault-tree>
</opsa-mef>
"""


def test_a_model_of_several_files_is_one_tree(tmp_path: Path) -> None:
    first, second = tmp_path / "gates.xml", tmp_path / "power.xml"
    first.write_text(GOOD.replace("<label>battery empty</label>", '<float value="0.25"/>'))
    second.write_text(SECOND)
    both = read_mef([second, first])
    assert (both.top, both.name) == ("dark", "power") and "lost" in both.gates
    assert analyse(both).top_probability == analyse(read_mef([first, second])).top_probability
    alone = analyse(read_mef(first)).top_probability
    assert alone is not None
    assert analyse(both).top_probability == pytest.approx(alone / 2)


def test_what_is_wrong_between_files_names_both(tmp_path: Path) -> None:
    first, second = tmp_path / "gates.xml", tmp_path / "power.xml"
    first.write_text(GOOD)
    second.write_text(SECOND.replace('"fuse"> <float', '"right"> <float'))
    with pytest.raises(ConfigurationError) as caught:
        read_mef([first, second])
    told = {(p.file, p.line, p.what) for p in caught.value.problems}
    assert (str(second), 4, f"is defined twice, first in {first}:29") in told
    assert (str(second), 3, "no such gate or basic event or house event") in told
    with pytest.raises(ConfigurationError) as caught:
        read_mef(second)
    assert "amberbox faulttree A.xml B.xml" in caught.value.problems[0].hint


def test_an_event_tree_is_refused_with_what_to_write_instead(tmp_path: Path) -> None:
    path = tmp_path / "sequences.xml"
    path.write_text(GOOD.replace("<opsa-mef>", """<opsa-mef>
      <define-initiating-event name="fire" event-tree="escape"/>
      <define-event-tree name="escape"/>""", 1))  # fmt: skip
    with pytest.raises(ConfigurationError) as caught:
        read_mef(path)
    first, second = caught.value.problems
    assert {first.where, second.where} == {"<define-initiating-event>", "<define-event-tree>"}
    assert first.what == second.what == "event trees are not supported"
    assert "write each sequence as a gate" in first.hint and "--effect" in first.hint
