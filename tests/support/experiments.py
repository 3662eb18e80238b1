"""Small experiments as BPMN text, for tests that run them."""

from __future__ import annotations

from collections.abc import Iterable

HEAD = """\
<?xml version="1.0" encoding="UTF-8"?>
<definitions xmlns="http://www.omg.org/spec/BPMN/20100524/MODEL"
 xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" id="defs" targetNamespace="urn:test">
"""


def bpmn(elements: Iterable[str], flows: Iterable[str], lanes: Iterable[tuple[str, str]]) -> str:
    """Return a BPMN file; flows are ``from to`` or ``from to condition``, lanes name and ids."""
    laned = "".join(
        f'<lane id="lane{n}" name="{name}">'
        + "".join(f"<flowNodeRef>{id}</flowNodeRef>" for id in ids.split())
        + "</lane>"
        for n, (name, ids) in enumerate(lanes)
    )
    drawn = []
    for n, flow in enumerate(flows):
        source, target, *condition = flow.split(" ", 2)
        inner = f"<conditionExpression>{condition[0]}</conditionExpression>" if condition else ""
        name = f'<sequenceFlow id="f{n}" sourceRef="{source}" targetRef="{target}">'
        drawn.append(f"{name}{inner}</sequenceFlow>")
    body = "".join([*elements, *drawn])
    return (
        f'{HEAD}<process id="main" isExecutable="true"><laneSet id="ls">{laned}</laneSet>'
        f"{body}</process></definitions>"
    )


DRIVE = bpmn(
    [
        '<startEvent id="start"/>',
        '<userTask id="clear" name="Is the path clear?"/>',
        '<exclusiveGateway id="ready" default="f3"/>',
        '<serviceTask id="drive" name="Drive"/>',
        '<boundaryEvent id="trouble" attachedToRef="drive"><errorEventDefinition/></boundaryEvent>',
        '<userTask id="look" name="What is to be seen?"/>',
        '<userTask id="recover" name="See to the robot"/>',
        '<endEvent id="passed" name="Driven"/>',
        '<endEvent id="unsafe" name="Not safe"/>',
        '<endEvent id="failed" name="Not driven"/>',
    ],
    [
        "start clear", "clear ready", "ready drive path_clear", "ready unsafe", "drive look",
        "look passed", "trouble recover", "recover failed",
    ],
    [("operator", "clear look recover"), ("robot", "drive"), ("technician", "start ready passed "
     "unsafe failed trouble")],
)  # fmt: skip
DRIVE_YAML = """\
experiment:
  title: Drive a little
  safety: Nobody stands before the robot.
  parameters:
    distance_m: {unit: m, min: 0, max: 1, default: 0.4}
  ends: {unsafe: aborted, failed: failed}
steps:
  clear:
    text: Look along the corridor.
    fields: {path_clear: {kind: pass_fail, label: Is the path clear?}}
  drive:
    action: drive_linear
    parameters: {distance_m: =distance_m}
    timeout: 30 s
  look:
    expected: The robot stands.
    fields: {seen: {kind: text, required: false}}
"""
DRIVE_FILES = {"experiments/drive.bpmn": DRIVE, "experiments/drive.yaml": DRIVE_YAML}
