"""The steps of an experiment as an ordered list, for people who read, listen or print."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from amberbox.core.safe_text import one_line
from amberbox.core.svg import ELLIPSIS
from amberbox.experiments.bpmn import FLOW_NODES, Element, Flow, type_words
from amberbox.experiments.profile import Experiment

_LONGEST = 400  # characters of a text in the list


@dataclass(frozen=True, slots=True)
class Branch:
    """Where it goes on: ``when`` is empty for the usual way, ``to`` the number of a step."""

    when: str
    to: int


@dataclass(frozen=True, slots=True)
class OrderedStep:
    """A step in reading order; ``level`` counts the sub-processes that it is in.

    ``branches`` says where it goes on, if that is not only the next step of the list.
    """

    number: int
    id: str
    type: str
    who: str
    name: str
    text: str = ""
    expected: str = ""
    deviation: str = ""
    level: int = 0
    hints: tuple[str, ...] = ()
    branches: tuple[Branch, ...] = ()

    @property
    def line(self) -> str:
        """Return the step as one line of text."""
        who = f"{self.who}: " if self.who else ""
        about = f". {self.text}" if self.text else ""
        ways = "; ".join(
            f"{branch.when + ': ' if branch.when else ''}go to step {branch.to}"
            for branch in self.branches
        )
        return f"{who}{self.name}{about}{f' ({ways})' if ways else ''}"


def ordered_steps(experiment: Experiment) -> tuple[OrderedStep, ...]:
    """Return all steps in reading order: the usual way first, then what events lead to."""
    scope = experiment.process
    order = list(_walk(experiment, scope, 0)) if scope else []
    numbers = {element.id: place + 1 for place, (element, _) in enumerate(order)}
    return tuple(_step(experiment, element, numbers, level) for element, level in order)


def _walk(experiment: Experiment, scope: str, level: int) -> Iterator[tuple[Element, int]]:
    """Yield the elements of a process or sub-process, those inside after what they are in."""
    model = experiment.model
    nodes = {e.id: e for e in model.children(scope) if e.type in FLOW_NODES}
    starts = [e.id for e in nodes.values() if e.type == "startEvent"]
    first = starts or [own for own in nodes if not model.incoming(own)]
    seen: set[str] = set()
    for entrance in [*first, *nodes]:  # what no flow leads to comes last
        waiting = [entrance]
        while waiting:
            own = waiting.pop()
            if own in seen or own not in nodes or nodes[own].type == "boundaryEvent":
                continue
            seen.add(own)
            if nodes[own].type != "startEvent":
                yield nodes[own], level
            yield from _walk(experiment, own, level + 1)
            later = [flow for event in model.boundary(own) for flow in model.outgoing(event.id)]
            ways = [*_in_order(nodes[own], model.outgoing(own)), *later]
            waiting += [flow.target for flow in reversed(ways)]


def _in_order(element: Element, flows: Sequence[Flow]) -> list[Flow]:
    """Return flows with conditions first, the default one last."""
    return sorted(flows, key=lambda flow: flow.id == element.default)


def _step(
    experiment: Experiment, element: Element, numbers: Mapping[str, int], level: int
) -> OrderedStep:
    person = experiment.person_steps.get(element.id)
    name = _plain(element.name) or type_words(element.type)
    text = (person.text if person is not None else "") or element.documentation
    return OrderedStep(
        numbers[element.id], element.id, element.type, experiment.roles.get(element.id, ""),
        f"End: {name}" if element.type == "endEvent" and element.name else name,
        _plain(text) or _robot_text(experiment, element),
        _plain(person.expected) if person is not None else "",
        _plain(person.deviation) if person is not None else "",
        level, _hints(experiment, element), tuple(_branches(experiment, element, numbers)),
    )  # fmt: skip


def _robot_text(experiment: Experiment, element: Element) -> str:
    """Return what the robot does in a step, or which other experiment is carried out."""
    step = experiment.robot_steps.get(element.id)
    if step is not None:
        given = ((name, str(value).removeprefix("=")) for name, value in step.parameters.items())
        values = " ".join(f"{name}={value}" for name, value in given)
        return _plain(f"{step.action or f'test {step.test}'} {values}")
    call = experiment.calls.get(element.id)
    if call is not None:
        return f"all steps of {experiment.called[call].title}"
    timer = experiment.timers_ns.get(element.id)
    return f"waits {duration_text(timer)}" if timer is not None else ""


def _hints(experiment: Experiment, element: Element) -> tuple[str, ...]:
    """Return the texts of the annotations of a step."""
    model = experiment.model
    found = []
    for flow in model.flows.values():
        other = {flow.source: flow.target, flow.target: flow.source}.get(element.id, "")
        if flow.type == "association" and other in model.elements:
            note = model.elements[other]
            if note.type == "textAnnotation":
                found.append(_plain(note.text or note.name))
    return tuple(filter(None, found))


def _branches(
    experiment: Experiment, element: Element, numbers: Mapping[str, int]
) -> Iterator[Branch]:
    model = experiment.model
    flows = [f for f in _in_order(element, model.outgoing(element.id)) if f.target in numbers]
    inside = sum(1 for e in model.inside(element.id) if e.id in numbers)
    following = numbers[element.id] + 1 + inside
    together = len(flows) > 1 and element.type != "exclusiveGateway"
    for flow in flows:
        to = numbers[flow.target]
        if together:
            yield Branch("at the same time" if flow is not flows[0] else "", to)
        elif len(flows) > 1:
            yield Branch(_condition(element, flow), to)
        elif to != following:
            yield Branch("then" if model.boundary(element.id) else "", to)
    for event in model.boundary(element.id):
        for flow in model.outgoing(event.id):
            if flow.target in numbers:
                yield Branch(_occasion(experiment, event), numbers[flow.target])


def _condition(gateway: Element, flow: Flow) -> str:
    name = _plain(flow.name)
    if flow.id == gateway.default:
        return f"else ({name})" if name else "else"
    condition = _plain(flow.condition)
    return f"if {condition}{f' ({name})' if name and name != condition else ''}"


def _occasion(experiment: Experiment, event: Element) -> str:
    """Return when an event on the border of a step happens."""
    timer = experiment.timers_ns.get(event.id)
    also = "" if event.interrupting else ", besides"
    if timer is not None:
        return f"if it takes longer than {duration_text(timer)}{also}"
    definition = event.events[0] if event.events else None
    if definition is not None and definition.kind == "error":
        return f"on the error {_plain(definition.code)}" if definition.code else "on any error"
    return f"on {_plain(event.name) or type_words(event.type)}{also}"


def duration_text(nanoseconds: int) -> str:
    """Return a duration in its largest fitting units: ``1 h 30 min``, ``2.5 s``."""
    seconds = nanoseconds / 1e9
    hours, seconds = divmod(seconds, 3600)
    minutes, seconds = divmod(seconds, 60)
    parts = [(hours, "h"), (minutes, "min"), (seconds, "s")]
    return " ".join(f"{value:g} {unit}" for value, unit in parts if value) or "0 s"


def _plain(text: str) -> str:
    line = " ".join(one_line(text).split())
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]}{ELLIPSIS}"
