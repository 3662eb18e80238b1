"""What a run carries out: the process of an experiment, and the steps of people and robot in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from amberbox.experiments.action import Value
from amberbox.experiments.bpmn import FLOW_NODES, Element
from amberbox.experiments.experiment import (
    ExperimentOptions,
    PersonStepOptions,
    RobotStepOptions,
    Role,
)
from amberbox.experiments.profile import PERSON_TASKS, Experiment
from amberbox.experiments.workflow import Boundary, Flow, Node, NodeKind, Process


@dataclass(frozen=True)
class Step:
    """A step of a person or of the robot; ``lane`` is the name of its lane."""

    path: str
    name: str
    role: Role
    lane: str = ""
    person: PersonStepOptions | None = None
    robot: RobotStepOptions | None = None


@dataclass(frozen=True)
class Procedure:
    """An experiment as it is run; elements are named by path.

    The path of an element is its id, after the ids of the call activities it is in: ``call/step``.
    ``names`` are those of all elements, for people; ``defaults`` the values of parameters of
    experiments that are called.
    """

    name: str
    sha256: str
    process: Process
    options: ExperimentOptions = field(default_factory=ExperimentOptions)
    steps: Mapping[str, Step] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    defaults: Mapping[str, Value] = field(default_factory=dict)

    def name_of(self, path: str) -> str:
        """Return what people call an element."""
        return self.names.get(path) or path


def procedure_of(experiment: Experiment) -> Procedure:
    """Return what a run of an experiment carries out; it has been judged to have no errors."""
    defaults = {
        name: parameter.accept(parameter.default)
        for one in experiment.called.values()
        for name, parameter in one.options.parameters.items()
        if parameter.default is not None
    }
    parts = list(_parts(experiment, ""))
    elements = {prefix + e.id: e for one, prefix in parts for e in one.model.elements.values()}
    return Procedure(
        experiment.name,
        experiment.sha256,
        _process(experiment, experiment.process, ""),
        replace(experiment.options, title=experiment.title),
        {step.path: step for one, prefix in parts for step in _steps(one, prefix)},
        {path: " ".join(element.name.split()) for path, element in elements.items()},
        defaults,
    )


def _parts(experiment: Experiment, prefix: str) -> Iterator[tuple[Experiment, str]]:
    """Yield an experiment and those that it calls, each with the prefix of its paths."""
    yield experiment, prefix
    for call, name in experiment.calls.items():
        yield from _parts(experiment.called[name], f"{prefix}{call}/")


def _steps(experiment: Experiment, prefix: str) -> Iterator[Step]:
    elements = experiment.model.elements
    for id, role in experiment.roles.items():
        element = elements[id]
        name = " ".join(element.name.split()) or id
        lane = elements[element.lane].name if element.lane in elements else ""
        person = experiment.person_steps.get(id)
        if person is not None:
            text = person.text or element.documentation or name
            person = replace(person, text=text)
        robot = experiment.robot_steps.get(id)
        yield Step(f"{prefix}{id}", name, role, lane, person, robot)


def _process(experiment: Experiment, scope: str, prefix: str) -> Process:
    nodes = (
        _node(experiment, element, prefix)
        for element in experiment.model.children(scope)
        if element.type in FLOW_NODES and element.type != "boundaryEvent"
    )
    return Process({node.path: node for node in nodes})


def _node(experiment: Experiment, element: Element, prefix: str) -> Node:
    inner = None
    path = f"{prefix}{element.id}"
    if element.type == "callActivity":
        called = experiment.called[experiment.calls[element.id]]
        inner = _process(called, called.process, f"{path}/")
    elif element.type == "subProcess":
        inner = _process(experiment, element.id, prefix)
    return Node(
        path,
        _kind(element),
        _flows(experiment, element.id, prefix),
        f"{prefix}{element.default}" if element.default else "",
        experiment.timers_ns.get(element.id, 0),
        element.events[0].code if element.events else "",
        tuple(
            Boundary(
                f"{prefix}{event.id}",
                _flows(experiment, event.id, prefix),
                experiment.timers_ns.get(event.id),
                event.events[0].code,
                event.interrupting or event.events[0].kind == "error",
            )
            for event in experiment.model.boundary(element.id)
        ),
        inner,
    )


def _flows(experiment: Experiment, element: str, prefix: str) -> tuple[Flow, ...]:
    return tuple(
        Flow(f"{prefix}{flow.id}", f"{prefix}{flow.target}", experiment.conditions.get(flow.id))
        for flow in experiment.model.outgoing(element)
    )


_KINDS: Mapping[str, NodeKind] = {
    "startEvent": "start",
    "serviceTask": "robot",
    "exclusiveGateway": "exclusive",
    "parallelGateway": "parallel",
    "intermediateCatchEvent": "timer",
    "subProcess": "inner",
    "callActivity": "inner",
    **dict.fromkeys(PERSON_TASKS, "person"),
}
_ENDS: Mapping[str, NodeKind] = {"error": "error_end", "terminate": "terminate_end"}


def _kind(element: Element) -> NodeKind:
    if element.type == "endEvent":
        return _ENDS[element.events[0].kind] if element.events else "end"
    return _KINDS[element.type]
