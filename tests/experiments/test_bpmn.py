"""The reader of BPMN files: what real files hold, and what hostile ones are told."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import amberbox.sim
from amberbox.core.errors import Problem
from amberbox.experiments.bpmn import MOST_BYTES, BpmnModel, Element, parse_bpmn, read_bpmn
from amberbox.experiments.bpmn_writer import bpmn_text
from amberbox.experiments.drawing import draw_bpmn
from amberbox.experiments.profile import read_experiment
from amberbox.experiments.step_list import ordered_steps
from tests.experiments.bpmn_files import HEAD, every_shape, process
from tests.fuzzing import examples, fuzz

SAMPLES = sorted((Path(amberbox.sim.__file__).parent / "folder" / "experiments").glob("*.bpmn"))


def parsed(text: str) -> BpmnModel:
    """Return the model of a text without problems."""
    problems: list[Problem] = []
    model = parse_bpmn(text.encode(), "a.bpmn", problems)
    assert model is not None, [str(problem) for problem in problems]
    assert problems == []
    return model


def refused(data: bytes) -> str:
    """Return what is said of a file that is not read; each problem names its line."""
    problems: list[Problem] = []
    assert parse_bpmn(data, "a.bpmn", problems) is None
    assert problems
    assert all(problem.is_error and problem.line >= 1 for problem in problems)
    return "\n".join(map(str, problems))


def test_elements_have_their_properties() -> None:
    model = parsed(
        HEAD + '<error id="e" errorCode="lost"/><process id="p"><laneSet><lane id="outer">'
        "<flowNodeRef>t</flowNodeRef><childLaneSet><lane id='inner'><flowNodeRef>t</flowNodeRef>"
        "</lane></childLaneSet></lane></laneSet>"
        '<userTask id="t" name="A &lt;b&gt;"><documentation> why </documentation>'
        "<multiInstanceLoopCharacteristics isSequential='true'/></userTask>"
        '<boundaryEvent id="b" attachedToRef="t" cancelActivity="false">'
        "<timerEventDefinition><timeDuration>PT5S</timeDuration></timerEventDefinition>"
        '</boundaryEvent><endEvent id="x"><errorEventDefinition errorRef="e"/></endEvent>'
        '<sequenceFlow id="f" sourceRef="t" targetRef="x"><conditionExpression>a &lt; 1'
        "</conditionExpression></sequenceFlow></process></definitions>"
    )
    task, border = model.elements["t"], model.elements["b"]
    assert (task.name, task.documentation, task.loop, task.lane) == (
        "A <b>", "why", "sequential", "inner",
    )  # fmt: skip
    assert (border.attached_to, border.interrupting) == ("t", False)
    assert (border.events[0].timer, border.events[0].text) == ("duration", "PT5S")
    assert model.elements["x"].events[0].code == "lost"
    assert model.flows["f"].condition == "a < 1"
    assert model.boundary("t") == [border]


def test_names_with_any_prefix_are_the_same() -> None:
    model = parsed(
        HEAD.replace("xmlns=", "xmlns:m=").replace("<definitions", "<m:definitions")
        + "<m:process id='p'><m:userTask id='t'/></m:process></m:definitions>"
    )
    assert model.elements["t"].type == "userTask"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "document type"),
        ('<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "document type"),
        ("<a>&unknown;</a>", "undefined entity"),
        ("<a><b></a>", "mismatched tag"),
        ("", "no element found"),
        ("<html/>", "is no BPMN 2.0"),
        ("<definitions/>", "is no BPMN 2.0"),
        ("<?xml version='1.0' encoding='utf-777'?><a/>", "encoding"),
        (HEAD + "</definitions>", "has no process"),
        (HEAD + "<process id='p'>" + "<subProcess>" * 150 + "</definitions>", "nested more"),
        (process("<task id='a'/><task id='a'/>"), "the id is used twice"),
        (process("<task id='../../x'/>"), "cannot be an id"),
        (process(f"<task id='{'a' * 300}'/>"), "cannot be an id"),
        (process(f"<task id='a' name='{'n' * 30_000}'/>"), "more than 20000 characters"),
        (process("<task id='a'/><sequenceFlow id='f' sourceRef='a' targetRef='c'/>"), "'c'"),
        (process("<task id='a'/><sequenceFlow id='f' sourceRef='a'/>"), "targetRef is missing"),
        (process("<boundaryEvent id='b' attachedToRef='gone'/>"), "is no activity"),
        (process("<task id='a'/>", shape=("a", "0", "nan")), "is no number"),
        (process("<task id='a'/>", shape=("a", "0", "1e300")), "is no number"),
        (process("<task id='a'/>", shape=("a", "x", "10")), "is no number"),
    ],
)
def test_a_bad_file_is_refused(text: str, what: str) -> None:
    assert what in refused(text.encode())


def test_a_large_file_is_refused_without_reading_it(tmp_path: Path) -> None:
    path = tmp_path / "large.bpmn"
    path.write_bytes(b" " * (10 * 1024 * 1024))
    problems: list[Problem] = []
    assert read_bpmn(path, problems) is None
    assert "has more than 4 MB" in str(problems[0])
    many = HEAD + "<process id='p'>" + "<task/>" * 110_000 + "</process></definitions>"
    assert len(many) < MOST_BYTES
    assert "XML elements" in refused(many.encode())


def test_references_that_lead_nowhere_are_no_reason_to_draw_nothing() -> None:
    model = parsed(
        HEAD + "<collaboration id='c'><participant id='pool' processRef='gone'/></collaboration>"
        "<process id='p'><task id='a' default='gone'/><endEvent id='b'><errorEventDefinition "
        "errorRef='e'/></endEvent></process></definitions>"
    )
    assert model.elements["a"].default == ""
    assert model.elements["b"].events[0].code == "e"
    assert "pool" in str(draw_bpmn(model))


def test_a_large_diagram_is_refused() -> None:
    text = process("<task id='a'/>", shape=("a", "0", "9"))
    start, end = text.index("<bpmndi:BPMNShape"), text.index("</bpmndi:BPMNPlane>")
    shapes = text[start:end] * 2001
    assert "has diagrams of 2001 shapes" in refused((text[:start] + shapes + text[end:]).encode())


def test_a_missing_file_is_a_problem(tmp_path: Path) -> None:
    problems: list[Problem] = []
    assert read_bpmn(tmp_path / "none.bpmn", problems) is None
    assert "cannot be read" in str(problems[0])


def test_at_most_so_many_problems_are_listed() -> None:
    text = process("".join("<task id='1'/>" for _ in range(500)))
    assert len(refused(text.encode()).splitlines()) <= 200


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_a_written_model_is_read_back(path: Path) -> None:
    problems: list[Problem] = []
    model = read_bpmn(path, problems)
    assert model is not None
    again = parse_bpmn(bpmn_text(model).encode(), str(path), problems)
    assert again is not None
    assert problems == []
    assert again.diagrams == model.diagrams
    assert _without_lines(again) == _without_lines(model)


def _without_lines(model: BpmnModel) -> list[Element]:
    """Return the elements without the lines they are in."""
    return [
        replace(
            element, line=0, events=tuple(replace(event, line=0) for event in element.events),
            extension=element.extension and replace(
                element.extension, line=0, yaml="".join(element.extension.yaml.split())),
        )
        for element in sorted(model.elements.values(), key=lambda element: element.id)
    ]  # fmt: skip


@fuzz
@settings(max_examples=examples(60))
@given(seed=st.integers(0, 2**32), sample=st.sampled_from(range(len(SAMPLES) + 1)))
def test_mutated_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, seed: int, sample: int
) -> None:
    """Whatever is cut, repeated or replaced: no exception, and all that is read can be drawn."""
    chance = random.Random(seed)
    data = bytearray(([path.read_bytes() for path in SAMPLES] + [every_shape().encode()])[sample])
    words = [b"userTask", b"subProcess", b"id", b"&amp;", b"'", b"lane", b"\xff", b"-1"]
    for _ in range(chance.randint(1, 6)):
        at = chance.randrange(len(data))
        end = min(len(data), at + chance.choice((1, 8, 200)))
        piece = chance.choice((b"", data[at:end] * 2, chance.choice(words)))
        data[at:end] = piece
    path = tmp_path_factory.mktemp("mutated") / "a.bpmn"
    path.write_bytes(bytes(data))
    experiment, problems = read_experiment(path, draft=True)
    assert experiment is not None or any(problem.is_error for problem in problems)
    if experiment is not None:
        assert str(draw_bpmn(experiment.model)).startswith("<svg")
        assert str(draw_bpmn(replace(experiment.model, diagrams=()))).startswith("<svg")
        ordered_steps(experiment)
